"""Registration of a scan to the surfaces of a submap: Gauss-Newton from a prior.

    minimise   sum_i rho(e_i)  +  |log(prior^-1 x)|^2_P,      e_i = n_i^T (T(x) p_i - mu_i) / s_i

over the pose x, with mean mu_i, normal n_i and variance s_i^2 of the surface nearest to each point p_i. rho is Geman-McClure's. The prior
stays quadratic: a robust loss on it lets the pose jump along directions that the scene leaves open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from localization.lidar.submap import VoxelGrid, fill_surface, find_nearest
from motion_models import se2
from motion_models.compiled import kernel, subroutine
from motion_models.linear_equations import diagonalize, multiply, solve, transform_symmetric
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2, Tangent2, Triple, triple

_KERNEL = 3.0
"""Scale of Geman-McClure's loss, and residuals of inliers, in sigmas."""
_REACH_CELLS = 2.5
"""How far a point may be from the voxel that it is associated with [cells]."""
_MAX_ASSOCIATION_M = 3.0
"""Surfaces farther from a point are not associated with it, however wide the prior is: from there Gauss-Newton does not converge."""
_ITERATIONS, _MIN_STEP = 20, 0.1
"""Most steps of Gauss-Newton, and length below which a step is the last [sigmas]: 0.1 mm and 0.002 deg from the minimum on real logs."""
CORRELATED_BEAMS = 6
"""Neighbouring beams that err together and count as one, at most. The variance of sums over `_BLOCK` neighbours over that of independent
ones is 1.3 on simulated laps, 1.7 on ACES, 2.9 on fr079 and 4.3 on MIT-CSAIL (medians; 5.6 in nine of ten scans)."""
_BLOCK = 5 * CORRELATED_BEAMS
"""Neighbouring beams whose residuals are summed, to measure how they err together [beams]: batch means take blocks of several times the
length of the correlation, which is 10 to 20 beams at most in real scans, 1 to 10 in simulated rooms."""
_BASIN = 0.15
"""Sigma of a prior from which Gauss-Newton alone may end elsewhere [m, rad]: from .3 m, .15 rad it does in 14 to 31 % of trials."""
OUTLIER_SIGMAS = 5.0
"""What is farther off is an outlier: scans, wheels that slip or count wrongly, positions."""


@dataclass(frozen=True)
class Alignment:
    """The cost above, linearized at a pose: as a rule its minimum."""

    pose: Pose2
    information: FloatArray
    """(3, 3) of the points alone."""
    gradient: Tangent2
    """(3,) of the points' cost, which the prior balances."""
    overlap: float
    """Share of points that are inliers: within 3 sigma of a surface."""
    cost: float
    """-log likelihood of the points, those that err together counted once."""
    n_inliers: int
    n_associated: int
    """Points with a surface of the submap near them."""
    sum_squares: float
    """Sum of the squared residuals e of the inliers."""
    sum_block_squares: float
    """Sum of the squared sums of e over blocks of `_BLOCK` neighbouring inliers."""


def align_points(grid: VoxelGrid, points: Points2, prior: Pose2, cov: Cov3, guess: Pose2, guess_error: float | None = None) -> Alignment:
    """Gauss-Newton from ``guess`` (3,) for ``points`` (N, 2), with the ``prior`` (3,) of covariance ``cov`` (3, 3).

    ``guess_error``: how far the guess may be off at a point [m]; None for a guess that is as uncertain as the prior.
    """
    information, H, g = np.asarray(np.linalg.inv(cov), dtype=float), np.empty((3, 3)), np.empty(3)
    first = prior_error_at_points(points, cov) if guess_error is None else guess_error
    pose, sums = _align(grid, points, tuple(prior.tolist()), information, tuple(guess.tolist()), first, H, g)
    return Alignment(np.array(pose), H, g, *sums)


@kernel
def prior_error_at_points(points: Points2, cov: Cov3) -> float:
    """How far a point of ``points`` (N, 2) may be off with a prior of ``cov`` (3, 3): 3 sigma at the median range, within limits [m]."""
    r2 = np.median(points[:, 0] ** 2 + points[:, 1] ** 2)
    return min(3.0 * math.sqrt(cov[0, 0] + cov[1, 1] + cov[2, 2] * r2), _MAX_ASSOCIATION_M)


def is_narrow(cov: Cov3) -> bool:
    """Whether a pose with ``cov`` (3, 3) is within the basin of Gauss-Newton."""
    (xx, xy, _), (_, yy, _), (_, _, yaw) = cov.tolist()
    longest = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)  # eigenvalue
    return bool(longest < _BASIN**2 and yaw < _BASIN**2)


def mahalanobis(prior: Pose2, pose: Pose2, cov: Cov3) -> float:
    """Squared distance of ``pose`` from ``prior`` in sigmas of ``cov``."""
    off = se2.local(prior, pose)
    return float(off @ np.linalg.solve(cov, off))


def linearize(grid: VoxelGrid, points: Points2, x: Pose2) -> Alignment:
    """The cost of ``points`` (N, 2) at ``x`` (3,), with information and gradient."""
    H, g = np.empty((3, 3)), np.empty(3)
    return Alignment(x, H, g, *_linearize(grid, points, triple(x), 0.0, H, g))


@kernel
def _align(
    grid: VoxelGrid,
    points: Points2,
    prior: Triple,
    information: FloatArray,
    guess: Triple,
    guess_error: float,
    H: FloatArray,
    g: FloatArray,
) -> tuple[Triple, _Sums]:
    """The pose of least cost, from ``guess`` that may be off by ``guess_error`` at a point [m], and `_linearize` there; ``information``
    (3, 3) of the prior."""
    least, x, jacobian = _REACH_CELLS * grid.cell, guess, np.empty((3, 3))
    for _ in range(_ITERATIONS):
        _linearize(grid, points, x, guess_error, H, g)
        off = se2.scalar_log(se2.scalar_between(prior, x))
        se2.fill_right_jacobian_inverse(off, jacobian)
        _add_prior(information, off, jacobian, H, g)
        a, b, c = solve(H, g)
        x = se2.scalar_compose(x, se2.scalar_exp((-a, -b, -c)))
        if a * g[0] + b * g[1] + c * g[2] < _MIN_STEP**2 and guess_error < least / 3.0:  # g^T H^-1 g
            break
        guess_error = guess_error / 2.0 if guess_error > least / 4.0 else 0.0
    return x, _linearize(grid, points, x, 0.0, H, g)


@subroutine
def _add_prior(information: FloatArray, off: Triple, jacobian: FloatArray, H: FloatArray, g: FloatArray) -> None:
    """Add J^T P^-1 J to ``H`` (3, 3) and J^T P^-1 ``off`` to ``g`` (3,)."""
    for a in range(3):
        for b in range(3):
            pull = 0.0
            for c in range(3):
                pull += jacobian[c, a] * information[c, b]
            g[a] += pull * off[b]
            for c in range(3):
                H[a, c] += pull * jacobian[b, c]


_Sums = tuple[float, float, int, int, float, float]
"""Overlap, cost, inliers, associated points, squares and those of blocks, as `Alignment` has them."""


@kernel
def _linearize(grid: VoxelGrid, points: Points2, x: Triple, guess_error: float, H: FloatArray, g: FloatArray) -> _Sums:
    """Fill ``H`` (3, 3) and ``g`` (3,), and return the sums of `Alignment`.

    While the pose may still be off by ``guess_error`` [m] at a point, points are associated from so far, and residuals are weighed by it.
    """
    spurious, c, s = np.empty((3, 3)), math.cos(x[2]), math.sin(x[2])
    H[:], g[:], spurious[:] = 0.0, 0.0, 0.0
    reach, guess_variance = max(_REACH_CELLS * grid.cell, guess_error), (guess_error / _KERNEL) ** 2
    inliers, associated, cost, block, squares, block_squares = 0, 0, 0.0, 0.0, 0.0, 0.0
    for i in range(points.shape[0]):
        px, py = points[i, 0], points[i, 1]
        wx, wy = x[0] + c * px - s * py - grid.origin[0], x[1] + s * px + c * py - grid.origin[1]
        v = find_nearest(grid, wx, wy, reach)
        if v < 0:
            cost += _KERNEL**2
            continue
        surface = grid.surfaces[v]
        if math.isnan(surface[4]):
            fill_surface(grid, v)
        var = surface[4]
        if math.isinf(var):
            cost += _KERNEL**2
            continue
        associated += 1
        e = surface[2] * (wx - surface[0]) + surface[3] * (wy - surface[1])
        square = e * e / var
        cost += min(square, _KERNEL**2)
        if square < _KERNEL**2:
            block += e / math.sqrt(var)
            inliers += 1
            squares += square
            if inliers % _BLOCK == 0:
                block_squares, block = block_squares + block * block, 0.0
        scale = _KERNEL**2 * var + guess_variance
        weight = (scale / (scale + e * e)) ** 2 / (var + guess_variance)
        nx, ny = c * surface[2] + s * surface[3], -s * surface[2] + c * surface[3]  # the normal in the body frame
        across, along = (nx, ny, px * ny - py * nx), (-ny, nx, px * nx + py * ny)  # derivatives of the distances
        _add_outer(H, across, weight)
        _add_outer(spurious, along, weight * min(surface[5], 1.0))
        g[0], g[1], g[2] = g[0] + weight * nx * e, g[1] + weight * ny * e, g[2] + weight * across[2] * e
    _remove_spurious_information(H, g, spurious)
    overlap = inliers / max(points.shape[0], 1)
    return overlap, 0.5 * cost / CORRELATED_BEAMS, inliers, associated, squares, block_squares + block * block


@kernel
def fill_informations(grid: VoxelGrid, points: Points2, x: Triple, H: FloatArray) -> None:
    """Fill ``H`` (n, 3, 3) with the information of each n-th part of the ``points``."""
    gradient, size = np.empty(3), points.shape[0] / len(H)
    for k in range(len(H)):
        _linearize(grid, points[int(k * size) : int((k + 1) * size)], x, 0.0, H[k], gradient)


@subroutine
def _remove_spurious_information(H: FloatArray, g: FloatArray, spurious: FloatArray) -> None:
    """Take off, in place, the information that comes from the noise of normals: along a bare wall it would hold the robot where it is.

    In the directions where the share m of ``spurious`` in ``H`` is largest, information is scaled by 1 - 2 m, at least 0: it is as likely
    to be false as not from m = 1/2 on. Directions are those of both matrices' generalised eigenvectors.
    """
    V, old = diagonalize(H), triple(g)
    size = (math.sqrt(max(H[0, 0], 1e-6)), math.sqrt(max(H[1, 1], 1e-6)), math.sqrt(max(H[2, 2], 1e-6)))
    for a in range(3):
        for i in range(3):
            V[i, a] /= size[a]  # V^T H V = 1
    whitened = transform_symmetric(V, spurious)
    U = diagonalize(whitened)
    H[:], g[:] = 0.0, 0.0
    for a in range(3):
        kept, v = max(1.0 - 2.0 * whitened[a, a], 0.0), (U[0, a], U[1, a], U[2, a])
        root = multiply(V, (v[0] * size[0] ** 2, v[1] * size[1] ** 2, v[2] * size[2] ** 2))
        inverse = multiply(V, v)
        pull = kept * (inverse[0] * old[0] + inverse[1] * old[1] + inverse[2] * old[2])
        _add_outer(H, root, kept)
        for i in range(3):
            g[i] += pull * root[i]


@subroutine
def _add_outer(total: FloatArray, v: Triple, weight: float) -> None:
    """Add ``weight`` v v^T to ``total`` (3, 3)."""
    for a in range(3):
        for b in range(3):
            total[a, b] += weight * v[a] * v[b]
