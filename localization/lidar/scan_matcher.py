"""Scan-to-submap matching: Gauss-Newton from a prior, and a correlative search where its result does not fit.

    minimise   sum_i rho(e_i)  +  |log(prior^-1 x)|^2_P,      e_i = n_i^T (T(x) p_i - mu_i) / s_i

over the pose x, with mean mu_i, normal n_i and variance s_i^2 of the surface nearest to each point p_i. rho is Geman-McClure's. The prior
stays quadratic: a robust loss on it lets the pose jump along directions that the scene leaves open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np

from localization.lidar.correlative_search import CORRELATED_BEAMS, LikelihoodImage, draw_image, search
from localization.lidar.submap import VoxelGrid, fill_surface, find_nearest, make_grid, measure_shares, voxel_means
from localization.settings import Allowed, Below, Count, Positive, Settings, Share
from motion_models import se2
from motion_models.compiled import kernel, subroutine
from motion_models.linear_equations import diagonalize, multiply, solve, transform_symmetric
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2, Tangent2, Triple, triple

MIN_POINTS = 10
"""Points without which a scan is not matched."""
_KERNEL = 3.0
"""Scale of Geman-McClure's loss, and residuals of inliers, in sigmas."""
_REACH_CELLS = 2.5
"""How far a point may be from the voxel that it is associated with [cells]."""
_MAX_ASSOCIATION_M = 3.0
"""Surfaces farther from a point are not associated with it, however wide the prior is: from there Gauss-Newton does not converge."""
_ITERATIONS, _MIN_STEP = 20, 0.1
"""Most steps of Gauss-Newton, and length below which a step is the last [sigmas]: 0.1 mm and 0.002 deg from the minimum on real logs."""
_CELL_OF_RANGE, _MIN_CELL_M = 0.02, 0.04
"""Voxel of a submap, as a share of the first scan's median range, and at least [m]."""
_BLOCK = 30
"""Neighbouring beams whose residuals are summed, to measure how they err together [beams]: the residuals of real scans are correlated over
10 to 20 beams, those of simulated rooms over 1 to 10."""
FORGETTING = 0.98
"""Factor per measurement of older statistics of residuals, innovations and slip: they are means over the last 50."""
OUTLIER_SIGMAS = 5.0
"""What is farther off is an outlier: scans, wheels that slip or count wrongly, positions."""
_OUTLIER_COST = 0.5 * OUTLIER_SIGMAS**2
"""-log of the odds that the prior is an outlier."""
_SEARCH_FACTOR = 9.0
SEARCH_FLOOR = np.diag([0.1, 0.1, 0.03]) ** 2
"""The search covers 3 sigma of 9 P + this [m^2, m^2, rad^2] + j j^T, j from the prior to where the motion of the last step would lead."""
_NO_OFFSET = np.zeros(3)
_SEARCH_LIMIT, _WIDEST_SEARCH = np.array([3.0, 3.0, 1.0]), np.array([15.0, 15.0, math.pi])
"""Half the window of a search at most, for a prior that may be an outlier, and for one that is wide itself [m, m, rad]."""
_MAX_RIVAL = 0.9
"""A search is ambiguous where a pose elsewhere scores more than this share of the best; where the prior is wider than its window, where one
is more probable than exp(-`_OUTLIER_COST`) of the best."""
_BASIN_M, _BASIN_RAD = 0.15, 0.15
"""Sigma of a prior from which Gauss-Newton alone may end elsewhere: from .3 m, .15 rad it does in 14 to 31 % of trials."""
MIN_PLACE_OVERLAP = 0.6
"""Share of points on the submap, below which a place found from a wide prior is not taken: Cartographer's least score of a place without
a prior (`global_localization_min_score`)."""
_SWEEP_PARTS = 8
"""Parts of a sweep, over which slip within it is summed: 24 parts change no sigma of a bent scan by more than 3 %."""
_MAX_OLD_SUBMAPS = 3
"""Key scans older than the last ones, at most, in units of their number."""
_OPEN_INFORMATION = np.diag([1e-2, 1e-2, 1.0])
"""Added to the information of a match, so that an open direction has a sigma of 10 m or 1 rad, times that of the residuals
[1/m^2, 1/m^2, 1/rad^2]."""
_MAPPED_INFORMATION = np.diag([1e2, 1e2, 1e2])
"""Information of a key scan along a direction, from which on its noise moves its surfaces along it [1/m^2, 1/m^2, 1/rad^2]."""


@dataclass(frozen=True)
class LidarConfig(Settings):
    """How scans are matched."""

    matcher: Literal["submap", "kiss"] = "submap"
    """What aligns scans: `submap`, or `kiss` for KISS-ICP started from the prediction."""
    voxel_size_m: Annotated[float, Allowed("0, or from 0.01 to 10", lambda value: value == 0.0 or 0.01 <= value <= 10.0)] = 0.0
    """Edge of the voxels [m]; 0 takes 2 % of the first scan's median range (KISS-ICP: 5 %), at least 0.04 m."""
    min_range_m: Annotated[float, Below("max_range_m")] = 0.1
    """Nearer points are the robot itself [m]."""
    max_range_m: Positive = 50.0
    """Farther points are left out [m]."""
    range_noise_m: Positive = 0.02
    """Sigma of a range, added to the thickness of surfaces [m]."""
    key_distance_m: Positive = 0.5
    """A scan enters the submap when the robot has moved this far since the last that did [m]."""
    key_angle_rad: Positive = 0.35
    """A scan enters the submap when the robot has turned this far since the last that did [rad]."""
    key_scans: Count = 40
    """Key scans of a submap."""
    search_below: Share = 0.7
    """Share of points on the submap, below which a better pose is searched."""
    lost_below: Share = 0.4
    """Share of points on the submap, below which a scan is lost and the pose is by wheels and gyro."""


@dataclass(frozen=True)
class ScanMatch:
    """Where a scan fits into the submap."""

    pose: Pose2
    """(3,) ``odom_T_body`` that scan and prior give together."""
    measured: Pose2
    """(3,) the pose that the scan alone gives: the prior's share is taken off."""
    cov: Cov3
    """(3, 3) of the right perturbation of ``measured``; wide open along directions that the scene leaves open."""
    overlap: float
    """Share of points within 3 sigma of a surface of the submap."""
    outlier_cov: Cov3
    """(3, 3) to be added to the prior's covariance where the search showed that it was an outlier; else zero."""


@dataclass(frozen=True)
class KeyScanError:
    """How the error of a key scan enters that of the submap around the robot: e_map' = (1 - s) e_map + s e_pose + m."""

    share: float
    """s, 0 to 1: the scan's share of its surroundings in the submap."""
    new_cov: Cov3
    """(3, 3) of m: places that were not mapped before have this scan alone."""


@dataclass(frozen=True, eq=False)
class KeyScan:
    """A scan of the submap."""

    points: Points2
    """(N, 2) in the odometry frame [m]."""
    pose: Pose2
    """(3,) from which it was drawn."""
    map_cov: Cov3
    """(3, 3) covariance of the submap's error around it, before it was drawn; a right perturbation."""

    def drift_variance(self, pose: Pose2, map_cov: Cov3, range_m: float) -> float:
        """Variance [m^2] by which points at ``range_m`` have drifted from this scan to the submap around ``pose`` (3,)."""
        A = se2.adjoint(se2.inverse(se2.between(self.pose, pose)))
        grown = map_cov - A @ self.map_cov @ A.T
        return float(grown[0, 0] + grown[1, 1] + range_m**2 * grown[2, 2])


@dataclass(frozen=True)
class Fit:
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


class ScanMatcher:
    """The submap of the last key scans, and where scans fit into it. Poses are ``odom_T_body``, points (N, 2) of the body frame."""

    def __init__(self, config: LidarConfig, cell: float) -> None:
        """``cell``: edge of the submap's voxels [m]."""
        self._config, self.cell = config, cell
        self._keys: list[KeyScan] = []
        self._grid: VoxelGrid | None = None
        self._image: LikelihoodImage | None = None
        self.is_new_place = False
        """Most of the last scan lies in unmapped space, the rest are inliers and the prior is narrow: it is a key scan."""
        self.mapped_share = 1.0
        """Share of the last scan's points with a surface of the submap near them."""
        self._residuals = np.full(3, 1e-3)  # sums over the last scans: squares, squares of blocks, inliers

    def match(
        self, points: Points2, prior: Pose2, cov: Cov3, guess: Pose2 | None = None, offset: Tangent2 = _NO_OFFSET
    ) -> ScanMatch | None:
        """The pose of ``points`` near ``prior`` (3,), whose error against the submap has covariance ``cov`` (3, 3); None where it is lost.

        Gauss-Newton starts from ``guess`` (3,), or from the prior. A pose is searched where the prior is wider than the basin of
        convergence, or where the result does not fit; one that fits far from the prior is aligned again with the prior as an outlier.
        ``offset`` (3,), from the prior to where the twist of the last step would lead, widens the search.
        """
        fit = self._align(points, prior, cov, prior if guess is None else guess)
        self.mapped_share = fit.n_associated / len(points)
        self.is_new_place = fit.n_associated < 0.5 * len(points) and fit.n_inliers >= 0.5 * fit.n_associated and is_narrow(cov)
        converges, agrees = _is_within_basin(fit, cov), mahalanobis(prior, fit.pose, cov) < 2.0 * _OUTLIER_COST
        fits = converges and fit.overlap >= self._config.search_below
        if not (fits and agrees):
            added = prior_outlier_cov(cov) + np.outer(offset, offset)
            start = fit.pose if fits else self._search(points, prior, cov + added, cov)
            if start is not None and not converges and mahalanobis(prior, start, cov) < 2.0 * _OUTLIER_COST:
                added = np.zeros((3, 3))  # within a prior that is wide itself
            found = None if start is None else self._align(points, prior, cov + added, start, self.cell)
            least = self._config.lost_below if is_narrow(cov) else MIN_PLACE_OVERLAP  # the place may not be mapped
            if found is not None and found.overlap >= least and (not converges or _is_better(found, fit, prior, cov)):
                return self._result(found, added)
        return self._result(fit, np.zeros((3, 3))) if converges and fit.overlap >= self._config.lost_below else None

    def refine(self, points: Points2, prior: Pose2, cov: Cov3, match: ScanMatch) -> ScanMatch | None:
        """``match`` again, for the same scan deskewed anew."""
        fit = self._align(points, prior, cov + match.outlier_cov, match.pose, 0.0)
        return None if fit.overlap < self._config.lost_below else self._result(fit, match.outlier_cov)

    def intra_scan_slip_cov(self, points: Points2, times: FloatArray, pose: Pose2, slip_rate: Cov3) -> Cov3:
        """(3, 3) covariance of the match of a scan that is bent: it was deskewed with one twist, while the body's motion is a random walk w
        about it, of covariance ``slip_rate`` (3, 3) a second. ``times`` (N,) of the ``points`` are from the middle of the sweep, where w is
        zero and ``pose`` (3,) is matched. Part k of the sweep, with information H_k, pulls the pose by w(t_k):

            e = R sum_k H_k w(t_k),  R = (sum_k H_k)^-1,  cov = R sum_g |t_g+1 - t_g| M_g Q M_g^T R,

        where M_g is the information of all parts beyond gap g, seen from the middle, as a step of w there displaces them all.
        """
        assert self._grid is not None
        order, H = np.argsort(times, kind="stable"), np.empty((_SWEEP_PARTS, 3, 3))
        _fill_informations(self._grid, points[order], triple(pose), H)
        t = times[order[(np.arange(0.5, _SWEEP_PARTS) * len(points) / _SWEEP_PARTS).astype(np.intp)]]  # of the middle of each part
        later, earlier = H[::-1].cumsum(axis=0)[::-1][1:], H.cumsum(axis=0)[:-1]
        after, before = np.diff(np.maximum(t, 0.0)), np.diff(np.minimum(t, 0.0))  # how much of each gap is on either side of the middle
        pull = sum(np.einsum("g,gij,jk,glk->il", gap, M, slip_rate, M) for gap, M in ((after, later), (before, earlier)))
        R = np.linalg.inv(H.sum(axis=0) + _OPEN_INFORMATION)
        return np.asarray(R @ pull @ R)

    def evaluate(self, points: Points2, pose: Pose2) -> ScanMatch | None:
        """The match of ``points`` at ``pose`` (3,), which another method has found; None where too few of them fit there."""
        assert self._grid is not None
        fit = linearize(self._grid, points, pose)
        if fit.overlap < self._config.lost_below:
            return None
        return self._result(replace(fit, gradient=np.zeros(3)), np.zeros((3, 3)))

    def insert_key_scan(self, pose: Pose2, points: Points2, map_cov: Cov3 | None = None) -> KeyScanError:
        """Draw a scan from ``pose`` (3,). ``map_cov`` (3, 3) of the submap's error there: with it, old scans stay while they fit."""
        drawn = np.asarray(se2.transform(pose, points))
        scan = make_grid(drawn, self.cell, self._config.range_noise_m)
        share, new = (1.0, 1.0) if self._grid is None else measure_shares(self._grid, scan)
        self._keys = [*self._fitting_keys(pose, points, map_cov), KeyScan(drawn, pose, np.zeros((3, 3)) if map_cov is None else map_cov)]
        self._draw()
        assert self._grid is not None
        fit = linearize(self._grid, points, pose)
        if len(self._keys) == 1:  # sums over neighbours cancel here: the surfaces are of the scan's own points
            self._residuals += np.array([fit.sum_squares, fit.sum_squares, fit.n_inliers])
        noise = np.asarray(np.linalg.inv(fit.information + _OPEN_INFORMATION) * self._block_variance, dtype=float)
        W = np.linalg.inv(np.eye(3) + noise @ _MAPPED_INFORMATION)  # not along directions that the scene leaves open
        return KeyScanError(share, new * W @ noise @ W.T)

    def _fitting_keys(self, pose: Pose2, points: Points2, map_cov: Cov3 | None) -> list[KeyScan]:
        """The key scans that stay beside a new one: the last ones, and older ones from which the drift is below the noise of a range.

        These thicken no surface; the drift does not grow where the robot comes back to them.
        """
        n = self._config.key_scans - 1
        recent = self._keys[max(len(self._keys) - n, 0) :]
        if map_cov is None:
            return recent
        range_m, limit = float(np.median(np.hypot(points[:, 0], points[:, 1]))), self._config.range_noise_m**2
        older = [key for key in self._keys[: len(self._keys) - len(recent)] if key.drift_variance(pose, map_cov, range_m) < limit]
        return [*older[-_MAX_OLD_SUBMAPS * self._config.key_scans :], *recent]

    def __getstate__(self) -> dict[str, Any]:
        """The key scans; grid and image are computed from them."""
        return {name: value for name, value in vars(self).items() if name not in ("_grid", "_image")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _grid=None, _image=None)
        if self._keys:
            self._draw()

    @property
    def _residual_variance(self) -> float:
        """Mean square of the residuals of the last scans, in units of the assumed noise."""
        return float(self._residuals[0] / self._residuals[2])

    @property
    def _block_variance(self) -> float:
        """Mean square of the sums of residuals over blocks of neighbouring beams, which contains how these err together (batch means)."""
        return float(self._residuals[1] / self._residuals[2])

    def points(self) -> FloatArray:
        """(M, 2) of the submap, in the odometry frame [m]."""
        return np.vstack([key.points for key in self._keys]) if self._keys else np.empty((0, 2))

    def _draw(self) -> None:
        self._grid, self._image = make_grid(self.points(), self.cell, self._config.range_noise_m), None

    def _align(self, points: Points2, prior: Pose2, cov: Cov3, guess: Pose2, guess_error: float | None = None) -> Fit:
        assert self._grid is not None
        return align_points(self._grid, points, prior, cov, guess, guess_error)

    def _search(self, points: Points2, prior: Pose2, wide: FloatArray, cov: Cov3) -> Pose2 | None:
        """The best pose (3,) of ``points`` in the submap, as `find_place` returns it; None where it is ambiguous."""
        assert self._grid is not None
        if self._image is None:
            self._image = draw_image(self._grid.means, self.cell)
        return find_place(self._image, voxel_means(points, self.cell), prior, wide, cov)

    def _result(self, fit: Fit, outlier_cov: Cov3) -> ScanMatch:
        """The match of the scan alone: one more Gauss-Newton step from the minimum, without the prior's pull."""
        R = np.asarray(np.linalg.inv(fit.information + _OPEN_INFORMATION), dtype=float)
        measured = se2.compose(fit.pose, se2.exp(-R @ fit.gradient))
        self._residuals = FORGETTING * self._residuals + [fit.sum_squares, fit.sum_block_squares, fit.n_inliers]
        return ScanMatch(fit.pose, measured, R * self._residual_variance, fit.overlap, outlier_cov)


def align_points(grid: VoxelGrid, points: Points2, prior: Pose2, cov: Cov3, guess: Pose2, guess_error: float | None = None) -> Fit:
    """Gauss-Newton from ``guess`` (3,) for ``points`` (N, 2), with the ``prior`` (3,) of covariance ``cov`` (3, 3).

    ``guess_error``: how far the guess may be off at a point [m]; None for a guess that is as uncertain as the prior.
    """
    information = np.asarray(np.linalg.inv(cov), dtype=float)
    first = _prior_error_at_points(points, cov) if guess_error is None else guess_error
    return linearize(grid, points, np.asarray(_align(grid, points, triple(prior), information, triple(guess), first), dtype=float))


def _prior_error_at_points(points: Points2, cov: Cov3) -> float:
    """How far a prior of ``cov`` (3, 3) may move a point of ``points`` (N, 2) [m]."""
    r2 = float(np.median(np.einsum("ij,ij->i", points, points)))
    return min(3.0 * math.sqrt(cov[0, 0] + cov[1, 1] + cov[2, 2] * r2), _MAX_ASSOCIATION_M)


def find_place(image: LikelihoodImage, points: Points2, prior: Pose2, wide: FloatArray, cov: Cov3) -> Pose2 | None:
    """The best pose (3,) of ``points`` (N, 2) within 3 sigma of ``wide`` (3, 3) from the ``prior`` (3,), limited by `search_limit`; None
    where it is ambiguous. ``cov`` (3, 3) of the prior itself."""
    limit = search_limit(cov)
    best = search(image, points, prior, wide, limit)
    if (limit <= _SEARCH_LIMIT).all():
        return best.pose if best.rival_score < _MAX_RIVAL * best.score else None
    return best.pose if best.margin >= _OUTLIER_COST else None  # the place is unknown


def search_limit(cov: Cov3) -> FloatArray:
    """(3,) half the window of a search at most [m, m, rad], for a prior with ``cov`` (3, 3)."""
    return np.asarray(np.minimum(np.maximum(_SEARCH_LIMIT, 3.0 * np.sqrt(np.diagonal(cov))), _WIDEST_SEARCH))


def prior_outlier_cov(cov: Cov3) -> Cov3:
    """(3, 3) to be added to the covariance ``cov`` (3, 3) of a prior that may be an outlier."""
    return np.asarray((_SEARCH_FACTOR - 1.0) * cov + SEARCH_FLOOR)


def choose_cell(config: LidarConfig, points: Points2) -> float:
    """Edge of the voxels [m] for a submap that begins with ``points`` (N, 2) of the body frame."""
    return config.voxel_size_m or max(_CELL_OF_RANGE * float(np.median(np.hypot(points[:, 0], points[:, 1]))), _MIN_CELL_M)


def _is_within_basin(fit: Fit, cov: Cov3) -> bool:
    """Whether Gauss-Newton from a prior with ``cov`` (3, 3) converges to the right pose: what the scan takes off the prior is within its
    basin. Along directions that the scene leaves open, the prior may be of any width.
    """
    return is_narrow(cov - np.linalg.inv(np.linalg.inv(cov) + fit.information))


def is_narrow(cov: Cov3) -> bool:
    """Whether a pose with ``cov`` (3, 3) is within the basin of Gauss-Newton."""
    return bool(np.linalg.eigvalsh(cov[:2, :2])[-1] < _BASIN_M**2 and cov[2, 2] < _BASIN_RAD**2)


def _is_better(found: Fit, fit: Fit, prior: Pose2, cov: Cov3) -> bool:
    """Whether the pose that was ``found`` is more probable than ``fit``, where the prior may be an outlier."""
    return _total_cost(found, prior, cov) < _total_cost(fit, prior, cov)


def _total_cost(fit: Fit, prior: Pose2, cov: Cov3) -> float:
    return fit.cost + min(mahalanobis(prior, fit.pose, cov) / 2.0, _OUTLIER_COST)


def mahalanobis(prior: Pose2, pose: Pose2, cov: Cov3) -> float:
    """Squared distance of ``pose`` from ``prior`` in sigmas of ``cov``."""
    off = se2.log(se2.between(prior, pose))
    return float(off @ np.linalg.solve(cov, off))


def linearize(grid: VoxelGrid, points: Points2, x: Pose2) -> Fit:
    """The cost of ``points`` (N, 2) at ``x`` (3,), with information and gradient."""
    H, g, n = np.zeros((3, 3)), np.zeros(3), max(len(points), 1)
    inliers, associated, cost, squares, block_squares = _linearize(grid, points, triple(x), 0.0, H, g)
    return Fit(x, H, g, inliers / n, 0.5 * cost / CORRELATED_BEAMS, inliers, associated, squares, block_squares)


@kernel
def _align(grid: VoxelGrid, points: Points2, prior: Triple, information: FloatArray, guess: Triple, guess_error: float) -> Triple:
    """The pose of least cost, from ``guess``; ``information`` (3, 3) of the prior, and how far it may move a point [m]."""
    least, x, jacobian = _REACH_CELLS * grid.cell, guess, np.empty((3, 3))
    H, g = np.empty((3, 3)), np.empty(3)
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
    return x


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


@kernel
def _linearize(
    grid: VoxelGrid, points: Points2, x: Triple, guess_error: float, H: FloatArray, g: FloatArray
) -> tuple[int, int, float, float, float]:
    """Fill ``H`` (3, 3) and ``g`` (3,), and return inliers, associated points, cost, squares and those of blocks.

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
    return inliers, associated, cost, squares, block_squares + block * block


@kernel
def _fill_informations(grid: VoxelGrid, points: Points2, x: Triple, H: FloatArray) -> None:
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
