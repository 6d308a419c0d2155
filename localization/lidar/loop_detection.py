"""Loop detection: whether a keyframe is at a place that was mapped long before, by correlative search and alignment of local submaps."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from localization.lidar.correlative_search import draw_image, find_place, prior_outlier_cov, search_limit
from localization.lidar.registration import align_points, is_narrow
from localization.lidar.scan_matcher import MIN_PLACE_OVERLAP, LidarConfig
from localization.lidar.submap import make_grid, voxel_means
from motion_models import se2
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

_MIN_TRAVEL_SUBMAPS = 1.25
"""Travel between both visits, over that of the filter's own submap: what is nearer is in that submap already."""
_OLD_KEYFRAMES = 8
"""Keyframes before and after the old one whose scans make its submap."""
_NEW_KEYFRAMES = 5
"""Keyframes whose scans are matched together: one scan fits many places, five of them few. After a loop is closed, the next trial waits
for as many: loops that share scans share their errors, and would count twice."""
_MIN_INFORMATION = 1e-6
"""Added to a loop's information, so that a direction which the scene leaves open has a sigma of 1 km, and is seen to be open
[1/m^2, 1/rad^2]."""
FLOOR_COV = np.diag([0.02, 0.02, 0.005]) ** 2
"""Submaps bend: covariance of a loop, at least [m^2, m^2, rad^2]."""
_MAX_DISTANCE_RANGES = 1.5
"""How far from its place a scan still shows the same walls [median range]."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A keyframe of the graph, with its scan."""

    odometry: Pose2
    """(3,) ``odom_T_body`` of the filter."""
    points: Points2
    """(N, 2) of its scan, in the body frame [m]."""
    stamp_ns: int = 0
    lidar: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) where the LiDAR of the scan is in the body frame [m]."""


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """Keyframe ``b`` was measured from keyframe ``a``, visited long before."""

    a: int
    b: int
    delta: Pose2
    """(3,) ``a_T_b``."""
    cov: Cov3
    """(3, 3) of its right perturbation."""


class LoopDetector:
    """`add` each keyframe, then `detect` the loop that ends there."""

    def __init__(self, config: LidarConfig) -> None:
        self._config = config
        self._least_travel_m = _MIN_TRAVEL_SUBMAPS * config.key_scans * config.key_distance_m
        self.keyframes: list[Keyframe] = []
        self._travelled_m: list[float] = []
        self._next_trial = 0

    def add(self, keyframe: Keyframe) -> None:
        """Append a keyframe."""
        if self.keyframes:
            x, y, _ = se2.between(self.keyframes[-1].odometry, keyframe.odometry)
            self._travelled_m.append(self._travelled_m[-1] + math.hypot(x, y))
        else:
            self._travelled_m.append(0.0)
        self.keyframes.append(keyframe)

    def detect(self, cell: float, poses: Callable[[], FloatArray], marginal: Callable[[int], FloatArray]) -> LoopClosure | None:
        """The loop that ends at the newest keyframe, or None.

        ``cell``: edge of voxels [m]; ``poses()`` (K, 3) are the graph's, ``marginal(k)`` (3, 3) is the covariance of one."""
        k = len(self.keyframes) - 1
        old = bisect.bisect_right(self._travelled_m, self._travelled_m[k] - self._least_travel_m)
        if not old or k < self._next_trial or not len(self.keyframes[k].points):
            return None
        found = self._match(k, old, cell, poses(), marginal(k))
        if found is not None:
            self._next_trial = k + _NEW_KEYFRAMES
        return found

    def _match(self, k: int, n_old: int, cell: float, poses: FloatArray, marginal: FloatArray) -> LoopClosure | None:
        """Keyframe ``k`` where the nearest of the first ``n_old`` keyframes was."""
        points = self.keyframes[k].points
        median = float(np.median(np.hypot(points[:, 0], points[:, 1])))
        old = poses[:n_old]
        has_points = [len(keyframe.points) > 0 for keyframe in self.keyframes[: len(old)]]
        distance = np.where(has_points, np.hypot(*(old[:, :2] - poses[k, :2]).T), math.inf)
        j = int(np.argmin(distance))
        prior = se2.between(poses[j], poses[k])
        if distance[j] > 3.0 * math.sqrt(float(np.linalg.eigvalsh(marginal[:2, :2])[-1])) + _MAX_DISTANCE_RANGES * median:
            return None
        place = self._merge(range(max(0, j - _OLD_KEYFRAMES), min(n_old, j + _OLD_KEYFRAMES + 1)), poses, j)
        recent = voxel_means(self._merge(range(max(0, k - _NEW_KEYFRAMES + 1), k + 1), poses, k), 1.5 * cell)
        wide = marginal + prior_outlier_cov(marginal)
        reachable = within_reach(place, recent, prior, wide, search_limit(marginal))
        if not len(reachable):
            return None
        found = find_place(draw_image(reachable, cell), recent, prior, wide, marginal)
        if found is None:
            return None
        near = np.diag([2.0 * cell, 2.0 * cell, 0.03]) ** 2
        fit = align_points(make_grid(place, cell, self._config.range_noise_m), recent, found, near, found)
        own_cov = np.asarray(np.linalg.inv(fit.information + _MIN_INFORMATION * np.eye(3)), dtype=float)
        if fit.overlap < MIN_PLACE_OVERLAP or not is_narrow(own_cov):  # the latter where the scene leaves a direction open
            return None
        return LoopClosure(j, k, fit.pose, own_cov + FLOOR_COV)

    def _merge(self, ids: range, poses: FloatArray, base: int) -> FloatArray:
        """(N, 2) the scans of keyframes ``ids`` in the frame of keyframe ``base``."""
        moved = [se2.transform(se2.between(poses[base], poses[i]), self.keyframes[i].points) for i in ids if len(self.keyframes[i].points)]
        return np.vstack(moved)


def within_reach(place: Points2, points: Points2, prior: Pose2, cov: Cov3, limit: FloatArray) -> FloatArray:
    """Points of ``place`` (N, 2) where `search` with the same arguments can put ``points`` (M, 2): no larger image is needed."""
    moved = se2.transform(prior, points)
    half = np.minimum(3.0 * np.sqrt([np.trace(cov[:2, :2]), np.trace(cov[:2, :2]), cov[2, 2]]), limit)
    swept = half[:2] + half[2] * np.hypot(points[:, 0], points[:, 1]).max()
    is_near = ((place >= moved.min(axis=0) - swept) & (place <= moved.max(axis=0) + swept)).all(axis=1)
    return np.asarray(place[is_near])
