"""Scan-to-submap matching: registration from a prior (`registration`), and a correlative search where its result does not fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from scipy.spatial import cKDTree

from localization.bounded_settings import Allowed, Below, Count, Positive, Settings, Share
from localization.lidar import registration
from localization.lidar.correlative_search import OUTLIER_COST, find_place, prior_outlier_cov
from localization.lidar.key_scans import KeyScanError, KeyScans, key_scan_noise
from localization.lidar.registration import Alignment, align_points, is_narrow, linearize, mahalanobis
from localization.lidar.submap import MAX_RINGS, voxel_means
from localization.small_filters import FORGETTING
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2, Tangent2, triple

MIN_POINTS = 10
"""Points without which a scan is not matched."""
_CELL_OF_RANGE = 0.02
"""Voxel of a submap, as a share of the first scan's median range: in five buildings and six rooms 3 % is as robust and less precise."""
_NO_OFFSET = np.zeros(3)
_WITH_SURFACE = 0.8
"""Least share of the first scan's points that have a surface in a submap of this scan alone: more than `LidarConfig.search_below`, below
which each scan of a place that is mapped would be searched. A scanner with 80 beams has 0.4 at 2 % of its range, ACES's with 180 0.7."""
_WRONG_WHEELS = 2.0 / 3.0
"""Sigma of the factor by which wheels that are outliers are wrong: within 3 sigma the robot has moved by anything from
the opposite of what they count to three times that. Between scans a second apart that is metres."""
MIN_PLACE_OVERLAP = 0.6
"""Share of points on the submap, below which a place found from a wide prior is not taken: Cartographer's least score of a place without
a prior (`global_localization_min_score`)."""
_SWEEP_PARTS = 8
"""Parts of a sweep, over which slip within it is summed: 24 parts change no sigma of a bent scan by more than 3 %."""
OPEN_INFORMATION = np.diag([1e-2, 1e-2, 1.0])
"""Added to the information of a match, so that an open direction has a sigma of 10 m or 1 rad, times that of the residuals
[1/m^2, 1/m^2, 1/rad^2]."""


@dataclass(frozen=True)
class LidarConfig(Settings):
    """How scans are matched."""

    matcher: Literal["submap", "kiss"] = "submap"
    """What aligns scans first: Gauss-Newton on the `submap` from the prediction, or KISS-ICP from it (`kiss`), which the submap refines."""
    voxel_size_m: Annotated[float, Allowed("0, or from 0.01 to 10", lambda value: value == 0.0 or 0.01 <= value <= 10.0)] = 0.0
    """Edge of the voxels [m]; 0 takes 2 % of the first scan's median range (KISS-ICP: 5 %), at least 2 sigma of a range, and more where the
    scanner has few beams."""
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


class ScanMatcher:
    """Where scans fit into a submap of the last key scans. Poses are ``odom_T_body``, points (N, 2) of the body frame."""

    def __init__(self, config: LidarConfig, cell: float) -> None:
        """``cell``: edge of the submap's voxels [m]."""
        self._config = config
        self.submap = KeyScans(cell, config.range_noise_m, config.key_scans)
        """The last key scans."""
        self.is_new_place = False
        """Most of the last scan lies in unmapped space, the rest are inliers and the prior is narrow: it is a key scan."""
        self.mapped_share = 1.0
        """Share of the last scan's points with a surface of the submap near them."""
        self._residuals = np.full(3, 1e-3)  # sums over the last scans: squares, squares of blocks, inliers

    def match(
        self,
        points: Points2,
        prior: Pose2,
        cov: Cov3,
        guess: Pose2 | None = None,
        offset: Tangent2 = _NO_OFFSET,
        moved: Pose2 = _NO_OFFSET,
    ) -> ScanMatch | None:
        """The pose of ``points`` near ``prior`` (3,), whose error against the submap has covariance ``cov`` (3, 3); None where it is lost.

        Gauss-Newton starts from ``guess`` (3,), or from the prior. A pose is searched where what the scan takes off the prior is wider than
        the basin of convergence, or where the result does not fit; one that fits far from the prior is aligned again with the prior as an
        outlier. ``offset`` (3,), from the prior to where the twist of the last step would lead, widens the search, and is tried beside it.
        ``moved`` (3,), by the wheels since the last scan, widens it by what these may be wrong by (`_WRONG_WHEELS`).
        """
        fit = align_points(self.submap.grid, points, prior, cov, prior if guess is None else guess)
        self.mapped_share = fit.n_associated / len(points)
        self.is_new_place = fit.n_associated < 0.5 * len(points) and fit.n_inliers >= 0.5 * fit.n_associated and is_narrow(cov)
        taken_off = cov - np.linalg.inv(np.linalg.inv(cov) + fit.information)  # little along directions that the scene leaves open
        converges, agrees = is_narrow(taken_off), mahalanobis(prior, fit.pose, cov) < 2.0 * OUTLIER_COST
        fits = converges and fit.overlap >= self._config.search_below
        if not (fits and agrees):
            added = prior_outlier_cov(cov) + np.outer(offset, offset) + _WRONG_WHEELS**2 * np.outer(moved, moved)
            start: Pose2 | None = fit.pose
            if not fits:
                start = find_place(self.submap.image, voxel_means(points, self.submap.cell), prior, cov + added, cov)
            if start is not None and not converges and mahalanobis(prior, start, cov) < 2.0 * OUTLIER_COST:
                added = np.zeros((3, 3))  # within a prior that is wide itself
            found = None if start is None else align_points(self.submap.grid, points, prior, cov + added, start, self.submap.cell)
            least = MIN_PLACE_OVERLAP  # the place may not be mapped
            if is_narrow(cov):
                least, ahead = self._config.lost_below, se2.retract(prior, offset)
                goes_on = align_points(self.submap.grid, points, prior, cov + added, ahead, self.submap.cell)
                if goes_on.overlap >= self._config.search_below and (found is None or _is_better(goes_on, found, prior, cov)):
                    found = goes_on
            if found is not None and found.overlap >= least and (not converges or _is_better(found, fit, prior, cov)):
                return self._result(found, added)
        return self._result(fit, np.zeros((3, 3))) if converges and fit.overlap >= self._config.lost_below else None

    def refine(self, points: Points2, prior: Pose2, cov: Cov3, match: ScanMatch) -> ScanMatch | None:
        """``match`` again, for the same scan deskewed anew."""
        fit = align_points(self.submap.grid, points, prior, cov + match.outlier_cov, match.pose, 0.0)
        return None if fit.overlap < self._config.lost_below else self._result(fit, match.outlier_cov)

    def locate(self, points: Points2, prior: Pose2, cov: Cov3) -> tuple[Pose2, Cov3] | None:
        """The pose that ``points`` alone give near ``prior`` (3,) of covariance ``cov`` (3, 3), and its covariance with errors that
        neighbouring beams share; None where too few fit. What `match` has learned of residuals stays as it is."""
        fit = align_points(self.submap.grid, points, prior, cov, prior)
        if fit.overlap < self._config.search_below:
            return None
        cov = np.asarray(np.linalg.inv(fit.information + OPEN_INFORMATION), dtype=float)
        return se2.retract(fit.pose, -cov @ fit.gradient), cov * self._block_variance

    def intra_scan_slip_cov(self, points: Points2, times: FloatArray, pose: Pose2, slip_rate: Cov3) -> Cov3:
        """(3, 3) covariance of the match of a scan that is bent: it was deskewed with one twist, while the body's motion is a random walk w
        about it, of covariance ``slip_rate`` (3, 3) a second. ``times`` (N,) of the ``points`` are from the middle of the sweep, where w is
        zero and ``pose`` (3,) is matched. Part k of the sweep, with information H_k, pulls the pose by w(t_k):

            e = R sum_k H_k w(t_k),  R = (sum_k H_k)^-1,  cov = R sum_g |t_g+1 - t_g| M_g Q M_g^T R,

        where M_g is the information of all parts beyond gap g, seen from the middle, as a step of w there displaces them all.
        """
        order, H = np.argsort(times, kind="stable"), np.empty((_SWEEP_PARTS, 3, 3))
        registration.fill_informations(self.submap.grid, points[order], triple(pose), H)
        t = times[order[(np.arange(0.5, _SWEEP_PARTS) * len(points) / _SWEEP_PARTS).astype(np.intp)]]  # of the middle of each part
        later, earlier = H[::-1].cumsum(axis=0)[::-1][1:], H.cumsum(axis=0)[:-1]
        after, before = np.diff(np.maximum(t, 0.0)), np.diff(np.minimum(t, 0.0))  # how much of each gap is on either side of the middle
        pull = sum(np.einsum("g,gij,jk,glk->il", gap, M, slip_rate, M) for gap, M in ((after, later), (before, earlier)))
        R = np.linalg.inv(H.sum(axis=0) + OPEN_INFORMATION)
        return np.asarray(R @ pull @ R)

    def insert_key_scan(self, pose: Pose2, points: Points2, map_cov: Cov3 | None = None) -> KeyScanError:
        """Draw a scan from ``pose`` (3,). ``map_cov`` (3, 3) of the submap's error there: with it, old scans stay while they fit."""
        share, new = self.submap.insert(pose, points, map_cov)
        fit = linearize(self.submap.grid, points, pose)
        if len(self.submap.keys) == 1:  # sums over neighbours cancel here: the surfaces are of the scan's own points
            self._residuals += np.array([fit.sum_squares, fit.sum_squares, fit.n_inliers])
        noise = np.asarray(np.linalg.inv(fit.information + OPEN_INFORMATION) * self._block_variance, dtype=float)
        return KeyScanError(share, key_scan_noise(noise, new))

    @property
    def _residual_variance(self) -> float:
        """Mean square of the residuals of the last scans, in units of the assumed noise."""
        return float(self._residuals[0] / self._residuals[2])

    @property
    def _block_variance(self) -> float:
        """Mean square of the sums of residuals over blocks of neighbouring beams, which contains how these err together (batch means)."""
        return float(self._residuals[1] / self._residuals[2])

    def _result(self, fit: Alignment, outlier_cov: Cov3) -> ScanMatch:
        """The match of the scan alone: one more Gauss-Newton step from the minimum, without the prior's pull."""
        R = np.asarray(np.linalg.inv(fit.information + OPEN_INFORMATION), dtype=float)
        measured = se2.retract(fit.pose, -R @ fit.gradient)
        self._residuals = FORGETTING * self._residuals + [fit.sum_squares, fit.sum_block_squares, fit.n_inliers]
        return ScanMatch(fit.pose, measured, R * self._residual_variance, fit.overlap, outlier_cov)


def choose_cell(config: LidarConfig, points: Points2) -> float:
    """Edge of the voxels [m] for a submap that begins with ``points`` (N, 2) of the body frame: at least two sigma of a range, and as large
    as it has to be for surfaces, which take the points of three voxels within `MAX_RINGS` (`submap.fill_surface`)."""
    if config.voxel_size_m:
        return config.voxel_size_m
    to_third = cKDTree(points).query(points, k=3)[0][:, 2] / MAX_RINGS
    of_range = _CELL_OF_RANGE * float(np.median(np.hypot(points[:, 0], points[:, 1])))
    return max(of_range, 2.0 * config.range_noise_m, float(np.quantile(to_third, _WITH_SURFACE)))


def _is_better(found: Alignment, fit: Alignment, prior: Pose2, cov: Cov3) -> bool:
    """Whether the pose that was ``found`` is more probable than ``fit``, where the prior may be an outlier."""
    return _total_cost(found, prior, cov) < _total_cost(fit, prior, cov)


def _total_cost(fit: Alignment, prior: Pose2, cov: Cov3) -> float:
    return fit.cost + min(mahalanobis(prior, fit.pose, cov) / 2.0, OUTLIER_COST)
