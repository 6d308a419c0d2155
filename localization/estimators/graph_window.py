"""Fixed lag: a window over the newest nodes, solved by square-root information smoothing.

Nodes are eliminated in order of time by Householder reflections. What is left on a node after its predecessors were eliminated is the
square root of the information that the past has about it: to marginalise the oldest node is to forget it. A new node costs one
elimination and one back substitution; where the way between two nodes is not as it was when it was linearised, the window is linearised
anew (as parts of the graph are in iSAM2).
Square roots keep half the digits that the information matrix itself would lose between metres of drift and micrometres of standing
still (Bierman, "Factorization methods for discrete sequential estimation", 1977, ch. V).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from localization.errors import EstimatorError
from localization.estimators.graph import Block, chain, marginals, solve
from localization.estimators.graph_factors import Closure, Kernel, Pairs, Position, linearize, linearize_seen, whitening
from localization.estimators.graph_qr import eliminate, inverse_of_upper, is_regular, substitute, triangularize
from motion_models import se2
from motion_models.base import Motion
from motion_models.se2 import FloatArray

_ITERATIONS = 10
_UNARY = 3  # rows that positions leave on the pose of a node
_TURNED = 0.1  # rad


class SingularError(EstimatorError):
    """A system whose solution is not determined, or not finite."""


@dataclass(frozen=True)
class Node:
    """What is known of one node: a mean, and the square root of the information about it."""

    pose: FloatArray
    """(3,)"""
    slow: FloatArray
    """(m,)"""
    root: FloatArray
    """(n, n) R, upper triangular, with R^T R = covariance^-1, for right perturbations of the pose and for the slow states."""

    @classmethod
    def known(cls, pose: FloatArray, slow: FloatArray, cov: FloatArray) -> Self:
        """With the covariance ``cov`` (n, n). Raises `EstimatorError` if that is not positive definite."""
        root = whitening(cov)
        triangularize(root, len(root))
        return cls(pose, slow, root)

    @cached_property
    def covariance(self) -> FloatArray:
        """(n, n)"""
        inverse = inverse_of_upper(self.root)
        return np.asarray(inverse @ inverse.T)


@dataclass(frozen=True)
class Ahead:
    """A node that could be added, its predecessor with it."""

    node: Node
    pair: Pairs
    conditional: FloatArray
    """(n, 2n + 1): the predecessor, given this node."""

    def motion_covariance(self) -> FloatArray:
        """(6, 6) joint covariance of the poses of the predecessor and of this node."""
        n = self.node.root.shape[0]
        inverse = inverse_of_upper(self.conditional[:, :n])
        G, P = -inverse @ self.conditional[:, n : 2 * n], self.node.covariance
        both = np.empty((6, 6))
        both[:3, :3] = (inverse @ inverse.T + G @ P @ G.T)[:3, :3]
        both[:3, 3:] = (G @ P)[:3, :3]
        both[3:, :3], both[3:, 3:] = both[:3, 3:].T, P[:3, :3]
        return both


class Window:
    """The newest ``lag`` nodes and what is known of each."""

    def __init__(self, first: Node, lag: int, relinearize_at: float, kernel: Kernel | None = None) -> None:
        """``relinearize_at`` [m, rad]: how far the way between two nodes may be off that at which it was linearised."""
        if lag < 2:
            raise EstimatorError(f"the lag is {lag} nodes; it must be at least 2.")
        self._lag, self._relinearize_at, self._kernel = lag, relinearize_at, kernel or Kernel()
        self._n = n = len(first.root)
        room = 2 * lag + 2
        self._poses, self._slow = np.zeros((room, 3)), np.zeros((room, n - 3))
        self._roots = np.zeros((room, n, n + 1))
        self._conditionals = np.zeros((room, n, 2 * n + 1))
        self._unary = np.zeros((room, _UNARY, 4))
        self._positions: list[list[Position]] = [[] for _ in range(room)]
        self._change = np.zeros((room, n))
        self._ways = np.zeros((room, 3))  # from each node to the next, as it was when it was linearised
        self._pairs: Pairs | None = None
        self._newest: Node | None = None
        self._first_index = 0
        self._seed(first)

    def _seed(self, node: Node) -> None:
        self._size, self._newest = 1, node
        self._poses[0], self._slow[0] = node.pose, node.slow
        self._roots[0, :, :-1], self._roots[0, :, -1] = node.root, 0.0
        self._change[0] = 0.0
        self._unary[0], self._positions[0] = 0.0, []
        if not is_regular(self._roots[0]):
            raise SingularError("the prior of the first node is singular or not finite.")

    def restart(self, node: Node) -> None:
        """Forget all but the newest node, of which from now on ``node`` is known."""
        self._first_index += self._size - 1
        self._seed(node)

    @property
    def newest(self) -> Node:
        """The newest node by all that is known up to now."""
        if self._newest is None:
            i = self._size - 1
            self._newest = Node(self._poses[i].copy(), self._slow[i].copy(), self._roots[i, :, :-1].copy())
        return self._newest

    def poses(self) -> FloatArray:
        """(k, 3) of the nodes from `oldest` on, by all that is known up to now."""
        here = slice(self._size - min(self._size, self._lag), self._size)
        return se2.compose(self._poses[here], se2.exp(self._change[here, :3]))

    def extend(self, pair: Pairs) -> Ahead:
        """The node that ``pair`` leads to. Raises `SingularError`."""
        n, i = self._n, self._size - 1
        poses, slow = np.empty((2, 3)), np.empty((2, n - 3))
        poses[0], slow[0], slow[1] = self._poses[i], self._slow[i], self._slow[i]
        shift = pair.d_slow[0] @ (slow[0] - pair.at[0])
        poses[1] = se2.compose(poses[0], se2.compose(pair.delta[0], se2.exp(shift)))
        roots, conditionals = np.empty((2, n, n + 1)), np.empty((1, n, 2 * n + 1))
        roots[0] = self._roots[i]
        eliminate(roots, conditionals, linearize(pair, poses, slow), np.zeros((2, _UNARY, 4)))
        return self._ahead(pair, poses[1], slow[1], roots[1], conditionals)

    def see(self, ahead: Ahead, motion: Motion, mount: FloatArray | None = None) -> Ahead:
        """``ahead`` with the motion that a LiDAR saw on the way to it, and what of its ``mount`` (3, m) shows. Raises `SingularError`."""
        n, node, pair, i = self._n, ahead.node, ahead.pair.seeing(motion, mount), self._size - 1
        work = np.zeros((2 * n + 3, 2 * n + 1))
        work[:n], work[n : 2 * n, n : 2 * n] = ahead.conditional, node.root
        work[2 * n :] = linearize_seen(pair, self._poses[None, i], node.pose[None], self._slow[None, i])[0]
        triangularize(work, 2 * n)
        return self._ahead(pair, node.pose, node.slow, work[n : 2 * n, n:].copy(), work[None, :n].copy())

    def _ahead(self, pair: Pairs, pose: FloatArray, slow: FloatArray, root: FloatArray, conditionals: FloatArray) -> Ahead:
        n = self._n
        change = np.empty((2, n))
        if not is_regular(root) or not substitute(root, conditionals, change):
            raise SingularError("the motion to a new node is not determined by what was measured.")
        J = se2.right_jacobian_inverse(change[1, :3])
        _move(root, 0, change[1], J)
        _move(conditionals[0], n, change[1], J)
        node = Node(se2.compose(pose, se2.exp(change[1, :3])), slow + change[1, 3:], root[:, :-1])
        return Ahead(node, pair, conditionals[0])

    def commit(self, ahead: Ahead) -> None:
        """Add the node, forget the oldest one if there are too many. Raises `SingularError`."""
        if self._pairs is None:
            self._pairs = ahead.pair.resized(len(self._poses))
        if self._size == len(self._poses):
            self._drop(self._size - self._lag + 1)
        i = self._size
        self._pairs.put(i - 1, ahead.pair)
        self._poses[i], self._slow[i] = ahead.node.pose, ahead.node.slow
        self._roots[i, :, :-1], self._roots[i, :, -1] = ahead.node.root, 0.0
        self._conditionals[i - 1] = ahead.conditional
        self._unary[i], self._positions[i] = 0.0, []
        self._size += 1
        self._newest = ahead.node
        self._solve()

    def add_position(self, index: int, position: Position) -> None:
        """A position of the node ``index``, counted from the very first. Raises `EstimatorError` if it has left the window."""
        k = index - self.oldest
        if not 0 <= k < self._size:
            raise EstimatorError(f"node {index} is not in the window; it holds {self.oldest} to {self._first_index + self._size - 1}.")
        self._positions[k].append(position)
        first = self._size - min(self._size, self._lag)
        if k == first:
            rows = np.zeros((2, self._n + 1))
            block = position.linearize(self._poses[k], self._kernel)
            rows[:, :3], rows[:, -1] = block[:, :3], block[:, 3]
            work = np.vstack([self._roots[k], rows])
            triangularize(work, self._n)
            self._roots[k] = work[: self._n]
            self._positions[k] = []
        self._again()

    def close(self, closure: Closure) -> None:
        """A motion between two nodes of the window, counted from the very first. Raises `EstimatorError`.

        It ties nodes that are no neighbours: the window is solved once as a whole, and begins anew from what is then known of the newest.
        """
        first, last = self._size - min(self._size, self._lag), self._size
        a, b = closure.a - self._first_index, closure.b - self._first_index
        if not (first <= min(a, b) and max(a, b) < last) or a == b:
            raise EstimatorError(f"no motion between nodes {closure.a} and {closure.b} in a window from {self.oldest} on.")
        poses, slow, fixed = self._poses[first:last].copy(), self._slow[first:last].copy(), self._poses[first]
        n, count = self._n, last - first
        for _ in range(_ITERATIONS):
            off = se2.log(se2.between(fixed, poses[0]))
            J = np.eye(n)
            J[:3, :3] = se2.right_jacobian_inverse(off)
            moved = np.concatenate([off, slow[0] - self._slow[first]])
            root, rhs = self._roots[first, :, :-1], self._roots[first, :, -1]
            blocks = [Block((0,), (root @ J,), rhs - root @ moved)]
            if count > 1:
                assert self._pairs is not None
                blocks += chain(linearize(self._pairs[slice(first, last - 1)], poses, slow))
            for k in range(first + 1, last):
                blocks += [self._block((k - first,), p.linearize(poses[k - first], self._kernel)) for p in self._positions[k]]
            rows = replace(closure, a=a - first, b=b - first).linearize(poses, self._kernel)
            blocks.append(self._block((a - first, b - first), rows))
            changes = solve(blocks, count, n)
            poses, slow = se2.compose(poses, se2.exp(changes[:, :3])), slow + changes[:, 3:]
            if np.abs(changes[:, :3]).max() < 1e-9:
                break
        self.restart(Node.known(poses[-1], slow[-1], marginals(blocks, [count - 1], count, n)[0]))

    def _block(self, nodes: tuple[int, ...], rows: FloatArray) -> Block:
        wide = np.zeros((len(rows), self._n - 3))
        return Block(nodes, tuple(np.hstack([rows[:, 3 * i : 3 * i + 3], wide]) for i in range(len(nodes))), rows[:, -1])

    @property
    def oldest(self) -> int:
        """Number of the oldest node that is still smoothed, counted from the very first. Arrays hold some more, to be moved less often."""
        return self._first_index + self._size - min(self._size, self._lag)

    def _drop(self, count: int) -> None:
        assert self._pairs is not None
        keep = self._size - count
        for a in (self._poses, self._slow, self._roots, self._conditionals, self._unary, self._change, self._ways):
            a[:keep] = a[count : self._size].copy()
        self._positions = self._positions[count:] + [[] for _ in range(count)]
        kept = self._pairs[slice(count, self._size - 1)]
        self._pairs = kept.resized(len(self._poses))
        self._first_index += count
        self._size = keep

    def _solve(self) -> None:
        """All changes by back substitution; where a way between two nodes has changed, all are linearised anew, once.

        Nodes that move together as one rigid body need not be, however far: what ties them is relative, and for a motion of the world by
        xi their changes are Ad(pose^-1) xi exactly. After hours, whatever is learned of a slow state moves all that was ever driven with
        it, at every step. Positions alone are of the world, and a turn by much is more than their changes' curvature allows.
        """
        first, last = self._size - min(self._size, self._lag), self._size
        self._back(first)
        change = self._change[first:last, :3]
        poses = se2.compose(self._poses[first:last], se2.exp(change))
        ways = se2.between(poses[:-1], poses[1:])
        self._ways[last - 2] = ways[-1]
        is_far = np.abs(se2.log(se2.between(self._ways[first : last - 1], ways))).max() > self._relinearize_at
        is_far |= np.abs(change[:, 2]).max() > _TURNED
        if is_far or (any(self._positions[first:last]) and np.abs(change).max() > self._relinearize_at):
            self._again()

    def _again(self) -> None:
        """Linearise the nodes where they are now, and eliminate them."""
        first, last = self._size - min(self._size, self._lag), self._size
        self._newest = None
        here = slice(first, last)
        moved = self._change[here].copy()
        _move(self._roots[first], 0, moved[0], se2.right_jacobian_inverse(moved[0, :3]))
        self._poses[here] = se2.compose(self._poses[here], se2.exp(moved[:, :3]))
        self._slow[here] += moved[:, 3:]
        for k in range(first, last):
            if self._positions[k]:
                self._unary[k] = self._position_rows(k)
        if last - first > 1:
            assert self._pairs is not None
            self._ways[first : last - 1] = se2.between(self._poses[first : last - 1], self._poses[first + 1 : last])
            rows = linearize(self._pairs[slice(first, last - 1)], self._poses[here], self._slow[here])
            eliminate(self._roots[here], self._conditionals[first : last - 1], rows, self._unary[here])
        self._back(first)

    def _back(self, first: int) -> None:
        """Changes of all nodes by what is known now; the newest node is always linearised where it is."""
        n, i = self._n, self._size - 1
        ok = is_regular(self._roots[i])
        ok = ok and substitute(self._roots[i], self._conditionals[first:i], self._change[first : i + 1])
        if not ok:
            raise SingularError("the window's system is singular or not finite.")
        newest = self._change[i]
        if newest.any():
            self._newest = None
            J = se2.right_jacobian_inverse(newest[:3])
            _move(self._roots[i], 0, newest, J)
            self._roots[i, :, -1] = 0.0
            if i > first:
                _move(self._conditionals[i - 1], n, newest, J)
            self._poses[i] = se2.compose(self._poses[i], se2.exp(newest[:3]))
            self._slow[i] += newest[3:]
            self._change[i] = 0.0

    def _position_rows(self, k: int) -> FloatArray:
        rows = np.vstack([p.linearize(self._poses[k], self._kernel) for p in self._positions[k]])
        work = np.zeros((max(len(rows), _UNARY), 4))
        work[: len(rows)] = rows
        triangularize(work, 3)
        return work[:_UNARY]


def _move(rows: FloatArray, at: int, change: FloatArray, jacobian: FloatArray) -> None:
    """Expand ``rows`` (r, c + 1) about a node whose columns begin at ``at`` anew, where ``change`` (n,) has moved it."""
    rows[:, -1] -= rows[:, at : at + len(change)] @ change
    rows[:, at : at + 3] = rows[:, at : at + 3] @ jacobian
