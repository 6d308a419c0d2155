"""GTSAM behind one door: sparse least squares over all nodes of a graph, their marginal covariances, and iSAM2.

GTSAM gets matrices, never Python functions: its optimisers copy all values at every call back into Python, which makes ten thousand poses
cost a minute and a half, and a Jacobian of the wrong shape would end the process. So relinearising is ours (`graph_history`),
and every array is checked before it goes in. Each factor costs tens of microseconds on its way: of long chains, only what is left of
them comes here (`graph_chain`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from localization.errors import EstimatorError
from motion_models.se2 import FloatArray


class IndeterminateError(EstimatorError):
    """Nothing says where some node is."""


@dataclass(frozen=True)
class Block:
    """Rows of the linear system ``sum of matrices @ changes = rhs`` in unit variances, about one or two nodes."""

    nodes: tuple[int, ...]
    matrices: tuple[FloatArray, ...]
    """Each (r, n)."""
    rhs: FloatArray
    """(r,)"""


def chain(rows: FloatArray, first: int = 0) -> Iterator[Block]:
    """The blocks of `graph_factors.linearize`, whose first pair is (``first``, ``first`` + 1)."""
    n = (rows.shape[-1] - 1) // 2
    check_rows(rows, first)
    for i, block in enumerate(rows, start=first):
        yield Block((i, i + 1), (block[:, :n], block[:, n : 2 * n]), block[:, -1])


def check_rows(rows: FloatArray, first: int = 0) -> None:
    """Raises `EstimatorError` unless the rows of `graph_factors.linearize`, whose first pair begins at ``first``, are finite."""
    if not np.isfinite(rows).all():
        bad = first + int(np.argmin(np.isfinite(rows).all(axis=(1, 2))))
        raise EstimatorError(f"the factors between nodes {bad} and {bad + 1} are not finite.")


def solve(blocks: Iterable[Block], nodes: Sequence[int], n: int) -> FloatArray:
    """(k, n) changes of ``nodes``, which are all. Raises `IndeterminateError` and `EstimatorError`."""
    tree = _tree(list(blocks), nodes, n)
    try:
        found = tree.optimize()
    except RuntimeError as error:
        raise _indeterminate(error) from error
    return checked_changes(np.array([found.at(i) for i in nodes]).reshape(len(nodes), n))


def marginals(blocks: Iterable[Block], of: Iterable[int], nodes: Sequence[int], n: int) -> FloatArray:
    """(k, n, n) covariances ``of`` some of all ``nodes``. Raises `IndeterminateError` and `EstimatorError`."""
    tree = _tree(list(blocks), nodes, n)
    try:
        return checked_covariances(np.array([tree.marginalCovariance(i) for i in of]).reshape(-1, n, n))
    except RuntimeError as error:
        raise _indeterminate(error) from error


def joint_marginals(blocks: Iterable[Block], of: Sequence[tuple[int, int]], nodes: Sequence[int], n: int) -> FloatArray:
    """(k, 2n, 2n) covariances ``of`` some pairs (a, b), a < b, of all ``nodes``. Raises `IndeterminateError` and `EstimatorError`."""
    if not of:
        return np.empty((0, 2 * n, 2 * n))
    tree = _tree(list(blocks), nodes, n)
    try:
        return checked_covariances(np.array([tree.jointMarginalCovariance(list(pair)).fullMatrix() for pair in of]))
    except RuntimeError as error:
        raise _indeterminate(error) from error


class Incremental:
    """iSAM2 on changes of nodes from fixed points of linearisation; QR, for Cholesky loses too many digits."""

    def __init__(self, n: int) -> None:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.enableRelinearization = False
        self._isam, self._n = gtsam.ISAM2(params), n
        self._known: set[int] = set()

    def update(self, blocks: Iterable[Block], new: Iterable[int]) -> None:
        """Add ``blocks`` and ``new`` nodes. Raises `IndeterminateError` and `EstimatorError`; this object is then lost."""
        nodes = set(new)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for i in sorted(nodes):
            values.insert(i, np.zeros(self._n))
        known, touched = self._known | nodes if nodes - self._known else self._known, set[int]()
        for block in blocks:
            factors.add(gtsam.LinearContainerFactor(_factor(block, known, self._n)))
            touched.update(block.nodes)
        if nodes - touched:
            raise EstimatorError(f"no factor speaks of node {min(nodes - touched)}.")
        try:
            self._isam.update(factors, values)
        except RuntimeError as error:
            raise _indeterminate(error) from error
        self._known |= nodes

    def changes(self, nodes: Iterable[int]) -> FloatArray:
        """(k, n) of ``nodes`` by all that was added."""
        try:
            estimate = self._isam.calculateBestEstimate()
        except RuntimeError as error:
            raise _indeterminate(error) from error
        return checked_changes(np.array([estimate.atVector(i) for i in nodes]).reshape(-1, self._n))

    def marginals(self, nodes: Iterable[int]) -> FloatArray:
        """(k, n, n) covariances of ``nodes``."""
        try:
            return checked_covariances(np.array([self._isam.marginalCovariance(i) for i in nodes]).reshape(-1, self._n, self._n))
        except RuntimeError as error:
            raise _indeterminate(error) from error


def _tree(blocks: Sequence[Block], nodes: Sequence[int], n: int) -> Any:
    """The Bayes tree, by Cholesky, which is fast; where that runs out of digits, by QR."""
    try:
        return _system(blocks, nodes, n, _unit).eliminateMultifrontal()
    except RuntimeError:
        try:
            return _system(blocks, nodes, n, _unit_by_qr).eliminateMultifrontal()
        except RuntimeError as error:
            raise _indeterminate(error) from error


def _system(blocks: Sequence[Block], nodes: Sequence[int], n: int, noise: Callable[[int], Any]) -> Any:
    system, known, touched = gtsam.GaussianFactorGraph(), set(nodes), set[int]()
    for block in blocks:
        system.add(_factor(block, known, n, noise))
        touched.update(block.nodes)
    if known - touched:
        raise IndeterminateError(f"no factor speaks of node {min(known - touched)}.")
    return system


def _factor(block: Block, known: set[int], n: int, noise: Callable[[int], Any] | None = None) -> Any:
    rows = len(block.rhs)
    arguments: list[Any] = []
    for node, matrix in zip(block.nodes, block.matrices, strict=True):
        if node not in known:
            raise EstimatorError(f"a factor speaks of node {node}, which is not in the graph.")
        if matrix.shape != (rows, n):
            raise EstimatorError(f"a factor's matrix for node {node} has shape {matrix.shape} instead of {(rows, n)}.")
        if not np.isfinite(matrix).all():
            raise EstimatorError(f"a factor's matrix for node {node} is not finite: {matrix.tolist()}.")
        arguments += [node, matrix]
    if rows == 0 or len(set(block.nodes)) != len(block.nodes):
        raise EstimatorError(f"a factor between nodes {block.nodes} with {rows} rows says nothing.")
    if not np.isfinite(block.rhs).all():
        raise EstimatorError(f"a factor's right side for nodes {block.nodes} is not finite: {block.rhs.tolist()}.")
    return gtsam.JacobianFactor(*arguments, block.rhs, (noise or _unit)(rows))  # type: ignore[call-overload]


_UNITS: dict[int, Any] = {}


def _unit(rows: int) -> Any:
    if rows not in _UNITS:
        _UNITS[rows] = gtsam.noiseModel.Unit.Create(rows)
    return _UNITS[rows]


def _unit_by_qr(rows: int) -> Any:
    """Unit noise of the kind that might hold constraints, for which GTSAM always takes QR."""
    return gtsam.noiseModel.Constrained.MixedSigmas(1.0, np.ones(rows))


def checked_changes(changes: FloatArray) -> FloatArray:
    """``changes`` (k, n) of nodes. Raises `IndeterminateError` unless they are finite."""
    if not np.isfinite(changes).all():
        bad = int(np.argmin(np.isfinite(changes).all(axis=1)))
        raise IndeterminateError(f"the solution is not finite from node {bad} on.")
    return changes


def checked_covariances(found: FloatArray) -> FloatArray:
    """``found`` (k, n, n). Raises `IndeterminateError` unless they are finite."""
    if not np.isfinite(found).all():
        raise IndeterminateError("the graph's factors are so unlike in size that its covariances are not finite.")
    return found


def _indeterminate(error: RuntimeError) -> IndeterminateError:
    text = " ".join(str(error).split())
    return IndeterminateError(f"the graph is singular: {text[:120]}. Something must say where each node is.")
