"""Fixed lag: a window over the newest nodes, solved by square-root information smoothing.

Nodes are eliminated in order of time by Householder reflections. What is left on a node after its predecessors were eliminated is the
square root of the information that the past has about it: to marginalise the oldest node is to forget it. A new node costs one
elimination and one back substitution; where the way between two nodes is not as it was when it was linearised, the window is linearised
anew (as parts of the graph are in iSAM2).
Square roots keep half the digits that the information matrix itself would lose between metres of drift and micrometres of standing
still (Bierman, "Factorization methods for discrete sequential estimation", 1977, ch. V).
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np

from localization.errors import EstimatorError
from localization.estimators.graph import Block, chain, marginals, solve
from localization.estimators.graph_factors import Pairs, linearize
from localization.estimators.graph_node import Ahead, Node, SingularError, expand_anew, extend, move_newest, see
from localization.estimators.graph_qr import eliminate, is_regular, substitute, triangularize
from localization.estimators.graph_robust import UNARY, Closure, Kernel, Position, position_rows
from motion_models import se2
from motion_models.base import Motion
from motion_models.se2 import FloatArray, triple

_ITERATIONS = 10
_TURNED = 0.1  # rad


class Window:
    """The newest ``lag`` nodes and what is known of each."""

    def __init__(self, first: Node, lag: int, relinearize_at: float, kernel: Kernel | None = None) -> None:
        """``relinearize_at`` [m, rad]: how far the way between two nodes may be off that at which it was linearised."""
        self._lag, self._relinearize_at, self._kernel = lag, relinearize_at, kernel or Kernel()
        self._n = n = len(first.root)
        room = 2 * lag + 2
        self._poses, self._slow = np.zeros((room, 3)), np.zeros((room, n - 3))
        self._roots = np.zeros((room, n, n + 1))
        self._conditionals = np.zeros((room, n, 2 * n + 1))
        self._unary = np.zeros((room, UNARY, 4))
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
        return extend(self.newest, pair)

    def see(self, ahead: Ahead, motion: Motion, mount: FloatArray | None = None) -> Ahead:
        """``ahead`` with the motion that a LiDAR saw on the way to it, and what of its ``mount`` (3, m) shows. Raises `SingularError`."""
        return see(self.newest, ahead, motion, mount)

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
            changes = solve(blocks, range(count), n)
            poses, slow = se2.compose(poses, se2.exp(changes[:, :3])), slow + changes[:, 3:]
            if np.abs(changes[:, :3]).max() < 1e-9:
                break
        self.restart(Node.known(poses[-1], slow[-1], marginals(blocks, [count - 1], range(count), n)[0]))

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
        bent, turned, moved = _changes(self._poses[first:last], self._change[first:last], self._ways[first:last])
        if bent > self._relinearize_at or turned > _TURNED or (moved > self._relinearize_at and any(self._positions[first:last])):
            self._again()

    def _again(self) -> None:
        """Linearise the nodes where they are now, and eliminate them."""
        first, last = self._size - min(self._size, self._lag), self._size
        self._newest = None
        here = slice(first, last)
        expand_anew(self._roots[first], 0, self._change[first])
        self._poses[here] = se2.compose(self._poses[here], se2.exp(self._change[here, :3]))
        self._slow[here] += self._change[here, 3:]
        for k in range(first, last):
            if self._positions[k]:
                self._unary[k] = position_rows(self._positions[k], self._poses[k], self._kernel)
        if last - first > 1:
            assert self._pairs is not None
            self._ways[first : last - 1] = se2.between(self._poses[first : last - 1], self._poses[first + 1 : last])
            rows = linearize(self._pairs[slice(first, last - 1)], self._poses[here], self._slow[here])
            eliminate(self._roots[here], self._conditionals[first : last - 1], rows, self._unary[here])
        self._back(first)

    def _back(self, first: int) -> None:
        """Changes of all nodes by what is known now; the newest node is always linearised where it is."""
        i, here = self._size - 1, slice(first, self._size)
        root, change = self._roots[i], self._change[here]
        if not (is_regular(root) and substitute(root, self._conditionals[first:i], change)):
            raise SingularError("the window's system is singular or not finite.")
        if change[-1].any():
            self._newest = None
            # before the first node there is none: what is written there is not read
            move_newest(self._poses[i], self._slow[i], root, self._conditionals[i - 1], change[-1])
            root[:, -1], change[-1] = 0.0, 0.0


@numba.njit(cache=True)
def _changes(poses: FloatArray, change: FloatArray, ways: FloatArray) -> tuple[float, float, float]:  # pragma: no cover
    """How far the ways between k nodes are off ``ways`` (k, 3), where they were linearised; that to the last node is filled.

    And how far any node has turned, and moved in any direction [m, rad].
    """
    last = poses.shape[0] - 1
    bent, turned, moved = 0.0, 0.0, 0.0
    here = se2.scalar_compose(triple(poses[0]), se2.scalar_exp(triple(change[0])))
    for i in range(last + 1):
        turned = max(turned, abs(change[i, 2]))
        moved = max(moved, abs(change[i, 0]), abs(change[i, 1]), abs(change[i, 2]))
        before, here = here, se2.scalar_compose(triple(poses[i]), se2.scalar_exp(triple(change[i])))
        if i > 0:
            way = se2.scalar_between(before, here)
            if i == last:
                ways[i - 1, 0], ways[i - 1, 1], ways[i - 1, 2] = way
            off = se2.scalar_log(se2.scalar_between(triple(ways[i - 1]), way))
            bent = max(bent, abs(off[0]), abs(off[1]), abs(off[2]))
    return bent, turned, moved
