"""All nodes and factors of a run: solved at the end in a batch (Gauss-Newton, Levenberg-Marquardt), or on the way by iSAM2."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from typing import Literal

import numpy as np
from scipy.linalg import block_diag

from localization.errors import EstimatorError
from localization.estimators.graph import Block, Incremental, IndeterminateError, chain
from localization.estimators.graph_chain import Chain
from localization.estimators.graph_factors import Pairs, linearize
from localization.estimators.graph_link import Link
from localization.estimators.graph_node import Node
from localization.estimators.graph_robust import UNARY, Closure, Kernel, Position, position_rows
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.se2 import FloatArray

_ITERATIONS = 25
_CONVERGED = 1e-6  # relative fall of the cost
_RELINEARIZE_AT = 0.02  # m, rad: how far iSAM2's poses may be off where they were linearised before all are linearised anew


class History:
    """Grows with the log. Nodes are numbered from 0; `add` appends one behind the last."""

    def __init__(self, first: Node, backend: Literal["batch", "isam2"], kernel: Kernel) -> None:
        self._first, self._kernel = first, kernel
        self._n = len(first.root)
        self._count, self._frozen = 1, 0
        self._poses, self._slow = np.zeros((64, 3)), np.zeros((64, self._n - 3))
        self._poses[0], self._slow[0] = first.pose, first.slow
        self._pairs: Pairs | None = None
        self._positions: list[tuple[int, Position]] = []
        self._closures: list[Closure] = []
        self._stamps, self._node_of = array("q"), array("q")
        self._between: dict[int, Link] = {}
        self._isam = Incremental(self._n) if backend == "isam2" else None
        if self._isam is not None:
            self._isam.update([self._prior()], [0])

    @property
    def count(self) -> int:
        """Nodes."""
        return self._count

    def add(self, pair: Pairs, node: Node) -> bool:
        """The next node, near ``node``, behind ``pair``; returns whether the graph was singular and begun anew from ``node``."""
        k = self._count
        if k == len(self._poses):
            self._poses, self._slow = (np.concatenate([a, np.zeros_like(a)]) for a in (self._poses, self._slow))
        if self._pairs is None or k == len(self._pairs):
            self._pairs = (pair if self._pairs is None else self._pairs).resized(2 * k + 64)
        self._pairs.put(k - 1, pair)
        self._poses[k], self._slow[k] = node.pose, node.slow
        self._count += 1
        if self._isam is None:
            return False
        try:
            self._isam.update(chain(linearize(pair, self._poses[k - 1 : k + 1], self._slow[k - 1 : k + 1]), k - 1), [k])
        except IndeterminateError:
            self._begin_anew(node)
            return True
        return False

    def mark(self, stamp_ns: int, since_node: Link | None) -> None:
        """The moment ``stamp_ns`` is that of the newest node, or ``since_node`` behind it."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        if since_node is not None:
            self._between[len(self._stamps)] = since_node
        self._stamps.append(stamp_ns)
        self._node_of.append(self._count - 1)

    def add_position(self, node: int, position: Position) -> bool:
        """Returns whether the graph was singular and begun anew."""
        self._positions.append((node, position))
        return node >= self._frozen and self._add_block(self._position_block(node, position))

    def add_closure(self, closure: Closure) -> bool:
        """Returns whether the graph was singular and begun anew. Raises `EstimatorError` for a closure of a node with itself."""
        if closure.a == closure.b:
            raise EstimatorError(f"a loop closure of node {closure.a} with itself says nothing.")
        self._closures.append(closure)
        return min(closure.a, closure.b) >= self._frozen and self._add_block(self._closure_block(closure))

    def _add_block(self, block: Block) -> bool:
        if self._isam is None:
            return False
        last = self._count - 1
        known = Node.known(self._poses[last].copy(), self._slow[last].copy(), self._isam.marginals([last])[0])
        try:
            self._isam.update([block], [])
        except IndeterminateError:
            self._begin_anew(known)
            return True
        return False

    def newest(self) -> Node | None:
        """iSAM2's newest node by all that is known now; None for the batch, which waits for the end."""
        if self._isam is None:
            return None
        self._settle()
        k = self._count - 1
        return Node.known(self._poses[k].copy(), self._slow[k].copy(), self._isam.marginals([k])[0])

    def solve(self) -> float:
        """Move all nodes to where the cost (half the sum of squares, less where the kernel doubts; it is returned) is least.

        Gauss-Newton; where a step does not help, damped after Levenberg and Marquardt. Raises `EstimatorError` if the graph is singular.
        """
        rows, cost = self._linear()
        damping = 0.0
        for _ in range(_ITERATIONS):
            changes = self._chain(rows, damping).solve()
            before = self._poses.copy(), self._slow.copy()
            self._move(changes)
            new_rows, new_cost = self._linear()
            if new_cost > cost * (1.0 + 1e-12) + 1e-12:
                (self._poses, self._slow), damping = before, max(10.0 * damping, 1e-3)
                continue
            done = cost - new_cost <= _CONVERGED * cost + 1e-9
            rows, cost, damping = new_rows, new_cost, 0.1 * damping if damping > 1e-6 else 0.0
            if done:
                break
        return cost

    def trajectory(self) -> Trajectory:
        """Poses at all marks by all that is known, with their marginal covariances."""
        if self._isam is None:
            self.solve()
            covariances = self._chain(self._linear()[0]).marginals()
        else:
            self._settle()
            alive = self._isam.marginals(range(self._frozen, self._count))
            covariances = np.concatenate([np.repeat(alive[:1], self._frozen, axis=0), alive])
        nodes = np.array(self._node_of, dtype=np.int64)
        poses, found = self._poses[nodes], covariances[nodes][:, :3, :3]
        for i, link in self._between.items():
            node = nodes[i]
            link = link.rebased(self._slow[node])
            F = np.hstack([se2.adjoint(se2.inverse(link.delta)), link.d_slow])
            poses[i] = se2.compose(poses[i], link.delta)
            found[i] = F @ covariances[node] @ F.T + link.cov
        return Trajectory(np.array(self._stamps, dtype=np.int64), poses, found)

    def poses(self) -> FloatArray:
        """(count, 3)"""
        return self._poses[: self._count].copy()

    def slow(self) -> FloatArray:
        """(count, m)"""
        return self._slow[: self._count].copy()

    def _linear(self) -> tuple[FloatArray, float]:
        """Rows of all pairs, and the cost where the nodes are now."""
        k, f = self._count, self._frozen
        rows = (
            np.zeros((0, 1, 2 * self._n + 1))
            if self._pairs is None
            else linearize(self._pairs[f : k - 1], self._poses[f:k], self._slow[f:k])
        )
        prior = self._prior().rhs
        cost = float(np.sum(rows[..., -1] ** 2)) + float(prior @ prior)
        cost += sum(p.cost(self._poses[node], self._kernel) for node, p in self._positions if node >= f)
        cost += sum(c.cost(self._poses, self._kernel) for c in self._closures if min(c.a, c.b) >= f)
        return rows, 0.5 * cost

    def _blocks(self, rows: FloatArray) -> Iterator[Block]:
        yield from chain(rows, self._frozen)
        yield from self._others()

    def _others(self) -> Iterator[Block]:
        """All that is not between neighbours."""
        yield self._prior()
        yield from (self._position_block(node, p) for node, p in self._positions if node >= self._frozen)
        yield from (self._closure_block(c) for c in self._closures if min(c.a, c.b) >= self._frozen)

    def _chain(self, rows: FloatArray, damping: float = 0.0) -> Chain:
        """The same of a batch, none of whose nodes is frozen, each pulled towards where it is with a root weight of ``damping``."""
        at: dict[int, list[Position]] = {}
        for node, position in self._positions:
            at.setdefault(node, []).append(position)
        n, u, d = self._n, UNARY if at else 0, self._n if damping > 0.0 else 0
        unary = np.zeros((self._count, u + d, n + 1))
        for node, positions in at.items():
            found = position_rows(positions, self._poses[node], self._kernel)
            unary[node, :u, :3], unary[node, :u, n] = found[:, :3], found[:, 3]
        if d:
            unary[:, u:, :n] = np.sqrt(damping) * self._unit
        return Chain(rows, unary, self._prior(), [self._closure_block(c) for c in self._closures])

    @property
    def _unit(self) -> FloatArray:
        """(n, n): a metre, a radian, and what is not known of the slow states at first are one unit each."""
        return np.asarray(block_diag(np.eye(3), self._first.root[3:, 3:]))

    def _prior(self) -> Block:
        node, f = self._first, self._frozen
        off = se2.log(se2.between(node.pose, self._poses[f]))
        J = np.eye(self._n)
        J[:3, :3] = se2.right_jacobian_inverse(off)
        return Block((f,), (node.root @ J,), -node.root @ np.concatenate([off, self._slow[f] - node.slow]))

    def _position_block(self, node: int, position: Position) -> Block:
        rows = position.linearize(self._poses[node], self._kernel)
        return Block((node,), (self._wide(rows[:, :3]),), rows[:, 3])

    def _closure_block(self, closure: Closure) -> Block:
        rows = closure.linearize(self._poses, self._kernel)
        return Block((closure.a, closure.b), (self._wide(rows[:, :3]), self._wide(rows[:, 3:6])), rows[:, 6])

    def _wide(self, rows: FloatArray) -> FloatArray:
        return np.hstack([rows, np.zeros((len(rows), self._n - 3))])

    def _move(self, changes: FloatArray) -> None:
        here = slice(self._frozen, self._count)
        self._poses[here] = se2.compose(self._poses[here], se2.exp(changes[:, :3]))
        self._slow[here] = self._slow[here] + changes[:, 3:]

    def _settle(self) -> None:
        """Move all nodes to iSAM2's solution; where that is far from the points of linearisation, linearise anew and solve again."""
        assert self._isam is not None
        for _ in range(_ITERATIONS):
            nodes = range(self._frozen, self._count)
            changes = self._isam.changes(nodes)
            if not changes.any():
                return
            self._move(changes)
            self._isam = Incremental(self._n)
            self._isam.update(self._blocks(self._linear()[0]), nodes)
            if np.abs(changes[:, :3]).max() < 1e-3 * _RELINEARIZE_AT:
                return

    def _begin_anew(self, node: Node) -> None:
        """Freeze all nodes but the newest, of which ``node`` is known."""
        self._first, self._frozen = node, self._count - 1
        self._poses[self._frozen], self._slow[self._frozen] = node.pose, node.slow
        self._isam = Incremental(self._n)
        self._isam.update([self._prior()], [self._frozen])
