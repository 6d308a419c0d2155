"""The factors between neighbouring nodes as one table, and their rows of Gauss-Newton's linear system. Compiled scalar loops.

A node is a pose and m slow states, n = 3 + m numbers. Between a node a and the next one b stand the link (`graph_link`), what it says of
the slow states, their random walk, and the LiDAR's motion. The table is all that every back end needs, and `residuals` is the same
for the filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from localization.errors import EstimatorError
from localization.estimators.graph_link import Link
from localization.estimators.graph_qr import add_product, apply, inverse_root, product
from localization.residuals import fill_motion_residual
from motion_models import se2
from motion_models.base import Motion
from motion_models.se2 import FloatArray, Triple, triple


@dataclass(frozen=True)
class Pairs:
    """Factors of N pairs of nodes (a, b). Whitening matrices W have W^T W = inverse covariance.

    The table holds for each row of `linearize` what it is made of: whitening, derivative by the slow states, value.
    """

    table: FloatArray
    """(N, 6 + 2m, n + 1)"""

    @classmethod
    def one(cls, link: Link, walk: FloatArray) -> Pairs:
        """The table of a single pair, without a LiDAR; ``walk`` (m, m) as in `Pairs.walk`."""
        m = link.n_slow
        pair = cls(np.zeros((1, 6 + 2 * m, 4 + m)))
        pair.white[0], pair.d_slow[0], pair.delta[0] = whitening(link.cov), link.d_slow, link.delta
        pair.rows[0], pair.rhs[0] = link.compressed()
        pair.at[0], pair.walk[0] = link.at, walk
        return pair

    def seeing(self, motion: Motion, mount: FloatArray | None = None) -> Pairs:
        """The single pair, with the motion that the LiDAR saw, and what of its ``mount`` (3, m) that shows."""
        seeing = Pairs(self.table.copy())
        seeing.seen_white[0], seeing.seen[0] = whitening(motion.cov), motion.delta
        if mount is not None:
            seeing.mount[0] = mount
        return seeing

    @property
    def n_slow(self) -> int:
        """m"""
        return int(self.table.shape[2]) - 4

    @property
    def white(self) -> FloatArray:
        """(N, 3, 3) of the link."""
        return self.table[:, :3, :3]

    @property
    def d_slow(self) -> FloatArray:
        """(N, 3, m) change of ``delta`` by the slow states."""
        return self.table[:, :3, 3:-1]

    @property
    def delta(self) -> FloatArray:
        """(N, 3) motion by the link at the slow states ``at``."""
        return self.table[:, :3, -1]

    @property
    def at(self) -> FloatArray:
        """(N, m)"""
        return self.table[:, 3 : 3 + self.n_slow, 0]

    @property
    def rows(self) -> FloatArray:
        """(N, m, m) and `rhs` (N, m): rows of unit variance about the slow states of a."""
        return self.table[:, 3 : 3 + self.n_slow, 3:-1]

    @property
    def rhs(self) -> FloatArray:
        return self.table[:, 3 : 3 + self.n_slow, -1]

    @property
    def walk(self) -> FloatArray:
        """(N, m, m) whitening of the random walk from a to b."""
        return self.table[:, 3 + self.n_slow : -3, 3:-1]

    @property
    def seen_white(self) -> FloatArray:
        """(N, 3, 3), zero where the LiDAR saw nothing."""
        return self.table[:, -3:, :3]

    @property
    def mount(self) -> FloatArray:
        """(N, 3, m): the LiDAR's mount is off by ``exp(mount @ slow)`` in the body frame, where this motion shows it."""
        return self.table[:, -3:, 3:-1]

    @property
    def seen(self) -> FloatArray:
        """(N, 3) motion by the LiDAR."""
        return self.table[:, -3:, -1]

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, part: slice) -> Pairs:
        return Pairs(self.table[part])

    def put(self, index: int, pair: Pairs) -> None:
        """Write the single ``pair`` into row ``index``."""
        self.table[index] = pair.table[0]

    def resized(self, size: int) -> Pairs:
        """A copy with room for ``size`` pairs."""
        table, kept = np.zeros((size, *self.table.shape[1:])), min(size, len(self))
        table[:kept] = self.table[:kept]
        return Pairs(table)


def whitening(cov: FloatArray) -> FloatArray:
    """W (n, n), lower triangular, with W^T W = ``cov``^-1 (n, n). Raises `EstimatorError` if that is not positive definite."""
    W = inverse_root(cov)
    if math.isnan(W[0, 0]):
        raise EstimatorError(f"a covariance is not positive definite: {cov.tolist()}.")
    return np.asarray(W)


def linearize(pairs: Pairs, poses: FloatArray, slow: FloatArray) -> FloatArray:
    """Rows (N, 6 + 2m, 2n + 1) of the system ``J (change of a, change of b) = rhs`` in unit variances, the last column its right side.

    ``poses`` (N + 1, 3) and ``slow`` (N + 1, m) are those of all nodes in order; changes of poses act on the right.
    """
    m = pairs.n_slow
    J = np.zeros((len(pairs), 6 + 2 * m, 2 * (3 + m) + 1))
    _linearize(pairs.table, poses, slow, J)
    return J


@numba.njit(cache=True)
def _linearize(table: FloatArray, poses: FloatArray, slow: FloatArray, J: FloatArray) -> None:  # pragma: no cover
    """Fill ``J``, which is zero."""
    m = slow.shape[1]
    for i in range(table.shape[0]):
        _link_rows(table[i], triple(poses[i]), slow[i], triple(poses[i + 1]), J[i])
        _slow_rows(table[i], slow[i], slow[i + 1], J[i])
        seen_rows(table[i], poses[i], slow[i], poses[i + 1], J[i, 3 + 2 * m :])


@numba.njit(cache=True)
def _link_rows(pair: FloatArray, a: Triple, slow: FloatArray, b: Triple, J: FloatArray) -> None:  # pragma: no cover
    """Wheels and gyro: log(measured^-1 (a^-1 b)) with measured = delta exp(D (slow - at)), in the first three rows of ``J``."""
    m = slow.shape[0]
    d_a, d_b, by_measured, by_shift = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    off = np.empty(m)
    for k in range(m):
        off[k] = slow[k] - pair[3 + k, 0]
    D = pair[:3, 3 : 3 + m]
    shift = apply(D, off)
    measured = se2.scalar_compose(triple(pair[:3, -1]), se2.scalar_exp(shift))
    error = fill_motion_residual(a, b, measured, d_a, d_b)
    se2.fill_right_jacobian_inverse((-error[0], -error[1], -error[2]), by_measured)
    se2.fill_right_jacobian(shift, by_shift)
    d_slow = product(product(by_measured, by_shift), D)
    for i in range(3):
        for k in range(m):
            d_slow[i, k] = -d_slow[i, k]
    _put_whitened(J[:3], pair[:3, :3], d_a, d_slow, d_b, error)


@numba.njit(cache=True)
def _slow_rows(pair: FloatArray, slow_a: FloatArray, slow_b: FloatArray, J: FloatArray) -> None:  # pragma: no cover
    """What wheels and gyro say together about the slow states, and the random walk of these from a to b."""
    m = slow_a.shape[0]
    n = 3 + m
    for i in range(m):
        J[3 + i, 2 * n] = pair[3 + i, n]
        for k in range(m):
            row, walk = pair[3 + i, 3 + k], pair[n + i, 3 + k]
            J[3 + i, 3 + k] = row
            J[3 + i, 2 * n] -= row * (slow_a[k] - pair[3 + k, 0])
            J[n + i, 3 + k], J[n + i, n + 3 + k] = -walk, walk
            J[n + i, 2 * n] += walk * (slow_a[k] - slow_b[k])


@numba.njit(cache=True)
def seen_rows(pair: FloatArray, pose_a: FloatArray, slow: FloatArray, pose_b: FloatArray, J: FloatArray) -> None:  # pragma: no cover
    """What the LiDAR saw, in ``J`` (3, 2n + 1), which is zero."""
    m = slow.shape[0]
    white, mount = pair[3 + 2 * m :, :3], pair[3 + 2 * m :, 3 : 3 + m]
    if white[0, 0] == 0.0:
        return
    d_a, d_b, d_mount = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    seen = triple(pair[3 + 2 * m :, 3 + m])
    error = seen_residual(triple(pose_a), triple(pose_b), seen, apply(mount, slow), d_a, d_b, d_mount)
    _put_whitened(J, white, d_a, product(d_mount, mount), d_b, error)


@numba.njit(cache=True)
def _put_whitened(
    J: FloatArray, white: FloatArray, d_a: FloatArray, d_slow: FloatArray, d_b: FloatArray, error: Triple
) -> None:  # pragma: no cover
    """The rows ``J`` (3, 2n + 1), zero, of a residual ``error`` with these derivatives by pose and slow states of a and pose of b."""
    n = 3 + d_slow.shape[1]
    add_product(J[:, :3], white, d_a)
    add_product(J[:, 3:n], white, d_slow)
    add_product(J[:, n : n + 3], white, d_b)
    for i in range(3):
        J[i, 2 * n] = -(white[i, 0] * error[0] + white[i, 1] * error[1] + white[i, 2] * error[2])


@numba.njit(cache=True)
def seen_residual(
    a: Triple, b: Triple, seen: Triple, off: Triple, d_a: FloatArray, d_b: FloatArray, d_mount: FloatArray
) -> Triple:  # pragma: no cover
    """`motion_residual` for a LiDAR that sits ``exp(off)`` off where it is believed to sit; its Jacobians by a, b and ``off`` are filled.

    Points are brought into the body by the believed mount, so what it measures is the motion of that frame, C^-1 (a^-1 b) C.
    """
    body_T_believed = se2.scalar_exp(off)
    by_a, by_b, A, J = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    error = fill_motion_residual(se2.scalar_compose(a, body_T_believed), se2.scalar_compose(b, body_T_believed), seen, by_a, by_b)
    se2.fill_adjoint(se2.scalar_inverse(body_T_believed), A)
    se2.fill_right_jacobian(off, J)
    d_a[:], d_b[:], d_mount[:] = 0.0, 0.0, 0.0
    add_product(d_a, by_a, A)
    add_product(d_b, by_b, A)
    add_product(d_mount, by_a, J)
    add_product(d_mount, by_b, J)
    return error
