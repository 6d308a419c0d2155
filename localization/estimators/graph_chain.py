"""A chain of nodes, few of which are tied to others than their neighbours: what is between those is eliminated here, the rest is GTSAM's.

Ten thousand poses with a dozen loop closures are a small graph between the two dozen nodes that these tie, and long chains that hang in
it. A chain needs no ordering and no tree: its nodes are eliminated one by one, in compiled loops (`graph_qr.eliminate`), and what they then
say of the nodes at both ends goes to GTSAM as one factor. That is exact: it is the same elimination, in another order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numba
import numpy as np

from localization.estimators.graph import (
    Block,
    IndeterminateError,
    check_rows,
    checked_changes,
    checked_covariances,
    joint_marginals,
    marginals,
    solve,
)
from localization.estimators.graph_qr import (
    add_spread,
    add_square,
    eliminate,
    inverse_of_upper,
    is_regular,
    place,
    product,
    solve_upper,
    substitute_given,
    take,
    triangularize,
)
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Chain:
    """The linear system of N nodes, of n numbers each, with all about single nodes and neighbours eliminated but for the tied nodes."""

    rows: FloatArray
    """(N - 1, r, 2n + 1) about neighbours: `graph_factors.linearize`."""
    unary: FloatArray
    """(N, u, c + 1) rows about the first c numbers of each node, the last column their right side."""
    prior: Block
    """About node 0."""
    ties: Sequence[Block]
    """About any two nodes."""

    def solve(self) -> FloatArray:
        """(N, n) changes of all nodes. Raises `IndeterminateError` and `EstimatorError`."""
        rest = self._rest
        changes = np.full((len(self.unary), self._n), np.nan)
        changes[rest.nodes] = solve(rest.blocks, rest.nodes, self._n)
        substitute_given(rest.before, changes[: rest.nodes[0] + 1])
        for (a, b), conditionals in zip(pairwise(rest.nodes), rest.between, strict=True):
            _substitute_between(conditionals, changes[a : b + 1])
        return checked_changes(changes)

    def marginals(self) -> FloatArray:
        """(N, n, n) covariances of all nodes. Raises `IndeterminateError` and `EstimatorError`."""
        rest, n = self._rest, self._n
        covariances = np.zeros((len(self.unary), n, n))
        if len(rest.nodes) == 1:
            covariances[-1] = marginals(rest.blocks, rest.nodes, rest.nodes, n)[0]
        joints = joint_marginals(rest.blocks, list(pairwise(rest.nodes)), rest.nodes, n)
        for (a, b), conditionals, joint in zip(pairwise(rest.nodes), rest.between, joints, strict=True):
            _spread_between(conditionals, joint, covariances[a : b + 1])
        _spread(rest.before, covariances[: rest.nodes[0] + 1])
        return checked_covariances(0.5 * (covariances + covariances.transpose(0, 2, 1)))

    @property
    def _n(self) -> int:
        return len(self.prior.matrices[0][0])

    @cached_property
    def _rest(self) -> _Rest:
        check_rows(self.rows)
        n, last = self._n, len(self.unary) - 1
        nodes = sorted({last, *(node for tie in self.ties for node in tie.nodes)})
        first = nodes[0]
        roots, before = np.zeros((first + 1, n, n + 1)), np.empty((first, n, 2 * n + 1))
        roots[0] = _root(self.prior, self.unary[0])
        eliminate(roots, before, self.rows[:first], self.unary[: first + 1])
        _check_regular(before, 0)
        blocks = [Block((first,), (roots[first, :, :n],), roots[first, :, n]), *self.ties]
        between = []
        for a, b in pairwise(nodes):
            conditionals, link = np.empty((b - a - 1, n, 3 * n + 1)), np.empty((2 * n, 2 * n + 1))
            _eliminate_between(self.rows[a:b], self.unary[a + 1 : b + 1], conditionals, link)
            _check_regular(conditionals, a + 1)
            between.append(conditionals)
            blocks.append(Block((a, b), (link[:, :n], link[:, n : 2 * n]), link[:, 2 * n]))
        return _Rest(nodes, blocks, before, between)


@dataclass(frozen=True)
class _Rest:
    """What is left of a chain."""

    nodes: list[int]
    """The tied ones and the last."""
    blocks: list[Block]
    before: FloatArray
    """(k, n, 2n + 1): each node before the first of these, given the next node."""
    between: list[FloatArray]
    """(k, n, 3n + 1) for two neighbours of these: each node between them, given the earlier one of the two and the next node."""


def _check_regular(conditionals: FloatArray, first: int) -> None:
    """Raises `IndeterminateError` unless each of these, about the node ``first`` and the next ones, tells where its node is."""
    bad = _first_irregular(conditionals)
    if bad >= 0:
        raise IndeterminateError(f"the graph is singular or not finite at node {first + bad}. Something must say where each node is.")


@numba.njit(cache=True)
def _first_irregular(conditionals: FloatArray) -> int:  # pragma: no cover
    for p in range(conditionals.shape[0]):
        if not is_regular(conditionals[p]):
            return p
    return -1


def _root(prior: Block, unary: FloatArray) -> FloatArray:
    """(n, n + 1): the ``prior`` and what is said of its node besides."""
    (matrix,), (rows, n) = prior.matrices, prior.matrices[0].shape
    work = np.zeros((max(rows + len(unary), n), n + 1))
    work[:rows, :n], work[:rows, n] = matrix, prior.rhs
    c = unary.shape[1] - 1
    work[rows : rows + len(unary), :c], work[rows : rows + len(unary), n] = unary[:, :c], unary[:, c]
    triangularize(work, n)
    return work[:n]


@numba.njit(cache=True)
def _eliminate_between(rows: FloatArray, unary: FloatArray, conditionals: FloatArray, link: FloatArray) -> None:  # pragma: no cover
    """Eliminate nodes 1 .. N - 1 of N + 1 in order, and none of both ends.

    ``rows`` (N, r, 2n + 1); ``unary`` (N, u, c + 1) about nodes 1 .. N; filled are ``conditionals`` (N - 1, n, 3n + 1) of each node given
    node 0 and the next one, and ``link`` (2n, 2n + 1), what is left about nodes 0 and N.
    """
    count, r, width = rows.shape
    n, u, c = width // 2, unary.shape[1], unary.shape[2] - 1
    first = np.zeros((max(r + u, 2 * n), width))
    place(rows[0], 0, 2 * n, first, 0, 0)
    place(unary[0], 0, c, first, r, n)
    triangularize(first, 2 * n)
    take(link, first, 0, 0)
    work = np.empty((2 * n + r + u, 3 * n + 1))  # columns of node p, node 0, node p + 1
    for p in range(1, count):
        work[:] = 0.0
        place(link, 0, n, work, 0, n)
        place(link, n, n, work, 0, 0)
        place(rows[p], 0, n, work, 2 * n, 0)
        place(rows[p], n, n, work, 2 * n, 2 * n)
        place(unary[p], 0, c, work, 2 * n + r, 2 * n)
        triangularize(work, 3 * n)
        take(conditionals[p - 1], work, 0, 0)
        take(link, work, n, n)


@numba.njit(cache=True)
def _substitute_between(conditionals: FloatArray, change: FloatArray) -> bool:  # pragma: no cover
    """Fill the inner of ``change`` (N + 1, n) from its ends."""
    n = change.shape[1]
    for p in range(change.shape[0] - 2, 0, -1):
        given = conditionals[p - 1]
        for i in range(n):
            value = given[i, 3 * n]
            for j in range(n):
                value -= given[i, n + j] * change[0, j] + given[i, 2 * n + j] * change[p + 1, j]
            change[p, i] = value
        if not solve_upper(given, change[p]):
            return False
    return True


@numba.njit(cache=True)
def _spread(conditionals: FloatArray, covariances: FloatArray) -> None:  # pragma: no cover
    """Fill ``covariances`` (N + 1, n, n), zero, from the last one."""
    n = covariances.shape[1]
    for p in range(covariances.shape[0] - 2, -1, -1):
        own = inverse_of_upper(conditionals[p])
        add_square(covariances[p], own)
        add_spread(covariances[p], product(own, conditionals[p, :, n : 2 * n]), covariances[p + 1])


@numba.njit(cache=True)
def _spread_between(conditionals: FloatArray, joint: FloatArray, covariances: FloatArray) -> None:  # pragma: no cover
    """Fill ``covariances`` (N + 1, n, n), zero, from the ``joint`` one (2n, 2n) of both ends, which is changed."""
    n, last = covariances.shape[1], covariances.shape[0] - 1
    take(covariances[0], joint, 0, 0)
    take(covariances[last], joint, n, n)
    shared = np.empty((n, n))
    for p in range(last - 1, 0, -1):  # joint: that of node 0 and of node p + 1
        own = inverse_of_upper(conditionals[p - 1])
        by_both = product(own, conditionals[p - 1, :, n : 3 * n])
        add_square(covariances[p], own)
        add_spread(covariances[p], by_both, joint)
        for i in range(n):
            for j in range(n):
                shared[i, j] = 0.0
                for k in range(2 * n):
                    shared[i, j] -= joint[i, k] * by_both[j, k]
        for i in range(n):
            for j in range(n):
                joint[i, n + j], joint[n + j, i], joint[n + i, n + j] = shared[i, j], shared[i, j], covariances[p, i, j]
