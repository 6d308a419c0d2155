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
from localization.estimators.graph_link import Link, compress
from localization.estimators.graph_qr import add_product, inverse_root, product
from localization.residuals import fill_motion_residual
from motion_models import se2
from motion_models.base import Motion
from motion_models.se2 import FloatArray, Three, Triple


@dataclass(frozen=True)
class Pairs:
    """Factors of N pairs of nodes (a, b). Whitening matrices W have W^T W = inverse covariance."""

    table: FloatArray
    """(N, w): a row for each pair, of which the properties are columns (`_begins`)."""
    n_slow: int
    """m"""

    @classmethod
    def one(cls, link: Link, walk: FloatArray) -> Pairs:
        """The table of a single pair, without a LiDAR; ``walk`` (m, m) as in `Pairs.walk`."""
        m = link.n_slow
        table = np.zeros((1, _begins(m)[-1]))
        if not _put_link(table[0], link.delta, link.cov, link.d_slow, link.at, link.rows, link.rhs, walk):
            raise _not_positive(link.cov)
        return cls(table, m)

    def seeing(self, motion: Motion, mount: FloatArray | None = None) -> Pairs:
        """The single pair, with the motion that the LiDAR saw, and what of its ``mount`` (3, m) that shows."""
        table = self.table.copy()
        if not _put_seen(table[0], motion.delta, motion.cov, np.zeros((3, self.n_slow)) if mount is None else mount):
            raise _not_positive(motion.cov)
        return Pairs(table, self.n_slow)

    @property
    def delta(self) -> FloatArray:
        """(N, 3) motion by the link at the slow states ``at``."""
        return self._columns(0, 3)

    @property
    def white(self) -> FloatArray:
        """(N, 3, 3)"""
        return self._columns(1, 3, 3)

    @property
    def d_slow(self) -> FloatArray:
        """(N, 3, m)"""
        return self._columns(2, 3, self.n_slow)

    @property
    def at(self) -> FloatArray:
        """(N, m)"""
        return self._columns(3, self.n_slow)

    @property
    def rows(self) -> FloatArray:
        """(N, m, m) and `rhs` (N, m): rows of unit variance about the slow states of a."""
        return self._columns(4, self.n_slow, self.n_slow)

    @property
    def rhs(self) -> FloatArray:
        return self._columns(5, self.n_slow)

    @property
    def walk(self) -> FloatArray:
        """(N, m, m) whitening of the random walk from a to b."""
        return self._columns(6, self.n_slow, self.n_slow)

    @property
    def seen(self) -> FloatArray:
        """(N, 3) motion by the LiDAR."""
        return self._columns(7, 3)

    @property
    def seen_white(self) -> FloatArray:
        """(N, 3, 3), zero where it saw nothing."""
        return self._columns(8, 3, 3)

    @property
    def mount(self) -> FloatArray:
        """(N, 3, m): the LiDAR's mount is off by ``exp(mount @ slow)`` in the body frame, where this motion shows it."""
        return self._columns(9, 3, self.n_slow)

    def _columns(self, part: int, *shape: int) -> FloatArray:
        begins = _begins(self.n_slow)
        return self.table[:, begins[part] : begins[part + 1]].reshape(len(self), *shape)

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, part: slice) -> Pairs:
        return Pairs(self.table[part], self.n_slow)

    def put(self, index: int, pair: Pairs) -> None:
        """Write the single ``pair`` into row ``index``."""
        self.table[index] = pair.table[0]

    def resized(self, size: int) -> Pairs:
        """A copy with room for ``size`` pairs."""
        table, kept = np.zeros((size, self.table.shape[1])), min(size, len(self))
        table[:kept] = self.table[:kept]
        return Pairs(table, self.n_slow)


def whitening(cov: FloatArray) -> FloatArray:
    """W (n, n), lower triangular, with W^T W = ``cov``^-1 (n, n). Raises `EstimatorError` if that is not positive definite."""
    W = inverse_root(cov)
    if math.isnan(W[0, 0]):
        raise _not_positive(cov)
    return np.asarray(W)


def _not_positive(cov: FloatArray) -> EstimatorError:
    return EstimatorError(f"a covariance is not positive definite: {cov.tolist()}.")


def linearize(pairs: Pairs, poses: FloatArray, slow: FloatArray) -> FloatArray:
    """Rows (N, 6 + 2m, 2n + 1) of the system ``J (change of a, change of b) = rhs`` in unit variances, the last column its right side.

    ``poses`` (N + 1, 3) and ``slow`` (N + 1, m) are those of all nodes in order; changes of poses act on the right.
    """
    m = pairs.n_slow
    J = np.empty((len(pairs), 6 + 2 * m, 2 * (3 + m) + 1))
    _linearize(pairs.table, poses, slow, J)
    return J


@numba.njit(cache=True)
def _linearize(table: FloatArray, poses: FloatArray, slow: FloatArray, J: FloatArray) -> None:  # pragma: no cover
    for i in range(table.shape[0]):
        linearize_pair(table[i], poses[i], slow[i], poses[i + 1], slow[i + 1], J[i])


@numba.njit(cache=True)
def linearize_pair(
    pair: FloatArray, pose_a: FloatArray, slow_a: FloatArray, pose_b: FloatArray, slow_b: FloatArray, J: FloatArray
) -> None:  # pragma: no cover
    """Fill ``J`` (6 + 2m, 2n + 1) with the rows of one ``pair`` (w,): see `linearize`."""
    m = slow_a.shape[0]
    n = 3 + m
    _, white, d_slow, at, rows, rhs, walk, _, _, _ = _parts(pair, m)
    J[:] = 0.0

    # wheels and gyro: log(measured^-1 (a^-1 b)) with measured = delta exp(D (slow_a - at))
    measured, shift = link_at(pair, slow_a)
    by_measured, by_shift = np.empty((3, 3)), np.empty((3, 3))
    error = fill_motion_residual(pose_a, pose_b, measured, J[:3, :3], J[:3, n : n + 3])
    se2.fill_right_jacobian_inverse((-error[0], -error[1], -error[2]), by_measured)
    se2.fill_right_jacobian(shift, by_shift)
    add_product(J[:3, 3:n], -1.0, product(by_measured, by_shift), d_slow)
    _whiten(J[:3], white, error)

    # both together about the slow states, and these from a to b
    for i in range(m):
        J[3 + i, -1] = rhs[i]
        for j in range(m):
            J[3 + i, 3 + j] = rows[i, j]
            J[3 + i, -1] -= rows[i, j] * (slow_a[j] - at[j])
            J[n + i, 3 + j] = -walk[i, j]
            J[n + i, n + 3 + j] = walk[i, j]
            J[n + i, -1] += walk[i, j] * (slow_a[j] - slow_b[j])

    linearize_seen(pair, pose_a, slow_a, pose_b, J[n + m :])


@numba.njit(cache=True)
def linearize_seen(pair: FloatArray, pose_a: FloatArray, slow_a: FloatArray, pose_b: FloatArray, J: FloatArray) -> None:  # pragma: no cover
    """Fill ``J`` (3, 2n + 1) with the last rows of `linearize_pair`, the LiDAR's."""
    m = slow_a.shape[0]
    n = 3 + m
    _, _, _, _, _, _, _, seen, seen_white, mount = _parts(pair, m)
    J[:] = 0.0
    if not seen_white.any():
        return
    d_mount = np.empty((3, 3))
    error = seen_residual(pose_a, pose_b, seen, apply(mount, slow_a), J[:, :3], J[:, n : n + 3], d_mount)
    add_product(J[:, 3:n], 1.0, d_mount, mount)
    _whiten(J, seen_white, error)


@numba.njit(cache=True)
def seen_residual(
    a: FloatArray, b: FloatArray, seen: FloatArray, off: Three, d_a: FloatArray, d_b: FloatArray, d_mount: FloatArray
) -> Triple:  # pragma: no cover
    """`motion_residual` for a LiDAR that sits ``exp(off)`` off where it is believed to sit; its Jacobians by a, b and ``off`` are filled.

    Points are brought into the body by the believed mount, so what it measures is the motion of that frame, C^-1 (a^-1 b) C.
    """
    body_T_believed = se2.scalar_exp(off)
    error = fill_motion_residual(se2.scalar_compose(a, body_T_believed), se2.scalar_compose(b, body_T_believed), seen, d_a, d_b)
    A, J = np.empty((3, 3)), np.empty((3, 3))
    se2.fill_adjoint(se2.scalar_inverse(body_T_believed), A)
    se2.fill_right_jacobian(off, J)
    d_mount[:] = product(d_a, J)
    add_product(d_mount, 1.0, d_b, J)
    d_a[:], d_b[:] = product(d_a, A), product(d_b, A)
    return error


@numba.njit(cache=True)
def link_at(pair: FloatArray, slow: FloatArray) -> tuple[Triple, Triple]:  # pragma: no cover
    """The motion by the link at the ``slow`` states (m,), and the tangent by which it is off that at `Pairs.at`."""
    delta, _, d_slow, at, _, _, _, _, _, _ = _parts(pair, slow.shape[0])
    shift = apply(d_slow, slow - at)
    return se2.scalar_compose(delta, se2.scalar_exp(shift)), shift


@numba.njit(cache=True)
def apply(D: FloatArray, change: FloatArray) -> Triple:  # pragma: no cover
    """``D`` (3, m) @ ``change`` (m,)."""
    x, y, t = 0.0, 0.0, 0.0
    for k in range(change.shape[0]):
        x, y, t = x + D[0, k] * change[k], y + D[1, k] * change[k], t + D[2, k] * change[k]
    return x, y, t


@numba.njit(cache=True)
def _whiten(J: FloatArray, white: FloatArray, error: Triple) -> None:  # pragma: no cover
    """Give the rows ``J`` (3, c) of a residual its ``error`` as right side, and unit variances."""
    for i in range(3):
        J[i, -1] = -error[i]
    for k in range(J.shape[1]):
        x, y, t = J[0, k], J[1, k], J[2, k]
        for i in range(3):
            J[i, k] = white[i, 0] * x + white[i, 1] * y + white[i, 2] * t


# --- the table


@numba.njit(cache=True)
def _begins(m: int) -> tuple[int, int, int, int, int, int, int, int, int, int, int]:  # pragma: no cover
    """Where the columns of `Pairs` begin in a row of its table, in the order of its properties, and where the last one ends."""
    at = 12 + 3 * m
    rhs = at + m + m * m
    seen = rhs + m + m * m
    return 0, 3, 12, at, at + m, rhs, rhs + m, seen, seen + 3, seen + 12, seen + 12 + 3 * m


@numba.njit(cache=True)
def _parts(pair: FloatArray, m: int) -> tuple[FloatArray, ...]:  # pragma: no cover
    """The columns of one ``pair`` (w,)."""
    a, b, c, d, e, f, g, h, i, j, end = _begins(m)
    return (
        pair[a:b],
        pair[b:c].reshape(3, 3),
        pair[c:d].reshape(3, m),
        pair[d:e],
        pair[e:f].reshape(m, m),
        pair[f:g],
        pair[g:h].reshape(m, m),
        pair[h:i],
        pair[i:j].reshape(3, 3),
        pair[j:end].reshape(3, m),
    )


@numba.njit(cache=True)
def _put_link(
    pair: FloatArray,
    by_link: FloatArray,
    cov: FloatArray,
    by_slow: FloatArray,
    slow: FloatArray,
    about: FloatArray,
    right: FloatArray,
    white_walk: FloatArray,
) -> bool:  # pragma: no cover
    """Write a link and the whitening of a random walk; returns whether its ``cov`` (3, 3) is positive definite."""
    delta, white, d_slow, at, rows, rhs, walk, _, _, _ = _parts(pair, slow.shape[0])
    delta[:], white[:], d_slow[:], at[:], walk[:] = by_link, inverse_root(cov), by_slow, slow, white_walk
    compress(about, right, rows, rhs)
    return not math.isnan(white[0, 0])


@numba.njit(cache=True)
def _put_seen(pair: FloatArray, motion: FloatArray, cov: FloatArray, shown: FloatArray) -> bool:  # pragma: no cover
    """Write what a LiDAR saw; returns whether its ``cov`` (3, 3) is positive definite."""
    _, _, _, _, _, _, _, seen, seen_white, mount = _parts(pair, shown.shape[1])
    seen[:], seen_white[:], mount[:] = motion, inverse_root(cov), shown
    return not math.isnan(seen_white[0, 0])
