"""The scans of the last keyframes, joined by the odometry, and by each other where the odometry is wider than they are.

After a robot was carried, or its submap lost, the filter goes on by wheels alone: after a few turns the scans would no longer belong
together. Neighbouring scans measure the same walls, so that each scan is aligned with those before it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.lidar.registration import align_points, is_narrow, mahalanobis
from localization.lidar.scan_matcher import MIN_POINTS, OPEN_INFORMATION
from localization.lidar.submap import make_grid, voxel_means
from motion_models import se2
from motion_models.se2 import Cov3, Points2, Pose2

_MAX_KEYFRAMES = 12
"""Keyframes whose scans are joined, at most: 6 m of way."""
_ALIGNED = 4
"""The last of them, with which a scan is aligned: 2 m of way."""
_CELL_M = 0.08
"""Voxel of their surfaces [m]."""
_WIDE_M, _WIDE_RAD = 0.02, 0.01
"""Sigma of the odometry from keyframe to keyframe, from which on it is aligned: scans give 0.003 m and 0.001 rad, wheels 0.03 m and
0.08 rad in turns of 25 degrees (fr079)."""
_MAX_SIGMA_M, _MAX_SIGMA_RAD = 0.4, 0.3
"""Sigma of the odometry up to which it is: alignments converge from about there."""
_LEAST_COV = np.diag([1e-3, 1e-3, 1e-4]) ** 2
"""Covariance of any motion at least [m^2, m^2, rad^2]: a robot that stands in a bare corridor may be pushed along it, and in no other
direction, so that its covariance alone has no inverse."""
_LEAST_OVERLAP = 0.6
"""Share of a scan's points on those before, from which on it is aligned."""
_NEW_VIEW_M = 2.0 / math.pi
"""Way that a turn counts for, where the LiDAR does not measure all around: after 90 degrees half of a view of 180 is new [m/rad]."""


_FARTHEST_SQUARE = 16.3
"""Squared distance of an aligned motion from the odometry's, beyond which one in a thousand is right [sigma^2]: one of both is wrong."""


class RecentMotion(NamedTuple):
    """Motion since the keyframe before."""

    delta: Pose2
    cov: Cov3


@dataclass(frozen=True, eq=False)
class _Keyframe:
    pose: Pose2
    """(3,) in the frame of the joined odometry."""
    points: Points2
    cov: Cov3
    """(3, 3) of the motion since."""
    way_m: float
    """Way that the robot had driven there, turns to new views included [m]."""


class RecentScans:
    """`move` by each motion, then `add` the scan that was taken there; `joined` are all of them as seen from the last."""

    def __init__(self, range_noise_m: float) -> None:
        """``range_noise_m``: sigma of a range [m]."""
        self._range_noise_m = range_noise_m
        self._keys: deque[_Keyframe] = deque(maxlen=_MAX_KEYFRAMES)
        self._pose, self._way_m = np.zeros(3), 0.0

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def way_m(self) -> float:
        """Way from the first to the last of the scans, turns to new views included [m]."""
        return self._way_m - self._keys[0].way_m if self._keys else 0.0

    def clear(self) -> None:
        """Discard all scans: the odometry does not connect them with later ones."""
        self._keys.clear()

    def keep_last(self) -> None:
        """Discard all scans but the last."""
        self._keys = deque(list(self._keys)[-1:], _MAX_KEYFRAMES)

    def move(self, motion: RecentMotion, points: Points2) -> RecentMotion:
        """Add ``motion``, at whose end ``points`` (N, 2) of the body frame are measured [m]. Returns the motion by scans and odometry where
        the odometry is wide."""
        motion = self._aligned(motion, points)
        if not is_narrow(motion.cov):
            self.clear()  # carried, or driven blind
        A = se2.adjoint(se2.inverse(motion.delta))
        covs = A @ np.array([key.cov for key in self._keys]).reshape(-1, 3, 3) @ A.T + motion.cov
        moved = [replace(key, cov=cov) for key, cov in zip(self._keys, covs, strict=True) if is_narrow(cov)]
        self._keys = deque(moved, _MAX_KEYFRAMES)
        self._pose = se2.compose(self._pose, motion.delta)
        self._way_m += math.hypot(motion.delta[0], motion.delta[1])
        self._way_m += _NEW_VIEW_M * abs(motion.delta[2]) if _is_partial(points) else 0.0
        return motion

    def add(self, points: Points2) -> None:
        """The scan ``points`` (N, 2) [m] was taken where the robot is."""
        self._keys.append(_Keyframe(self._pose, points, np.zeros((3, 3)), self._way_m))

    def joined(self, cell_m: float, n: int = _MAX_KEYFRAMES) -> Points2:
        """(M, 2) the last ``n`` scans as seen from the last one, one point in each voxel of ``cell_m`` [m]."""
        return voxel_means(self._seen_from(self._pose, n), cell_m)

    def _seen_from(self, pose: Pose2, n: int) -> Points2:
        return np.vstack([se2.transform(se2.between(pose, key.pose), key.points) for key in list(self._keys)[-n:]])

    def _aligned(self, motion: RecentMotion, points: Points2) -> RecentMotion:
        delta, cov = motion.delta, motion.cov + _LEAST_COV
        is_wide = np.trace(cov[:2, :2]) > _WIDE_M**2 or cov[2, 2] > _WIDE_RAD**2
        is_near = np.trace(cov[:2, :2]) < _MAX_SIGMA_M**2 and cov[2, 2] < _MAX_SIGMA_RAD**2
        if not (is_wide and is_near) or not self._keys or len(points) < MIN_POINTS:
            return motion
        grid = make_grid(self._seen_from(self._pose, _ALIGNED), _CELL_M, self._range_noise_m)
        fit = align_points(grid, points, delta, cov, delta)
        if fit.overlap < _LEAST_OVERLAP:
            return motion
        if mahalanobis(delta, fit.pose, cov) > _FARTHEST_SQUARE:
            self.clear()
            return motion
        by_scans = (fit.information + OPEN_INFORMATION) / max(fit.sum_squares / fit.n_inliers, 1.0)
        return RecentMotion(fit.pose, np.asarray(np.linalg.inv(np.linalg.inv(cov) + by_scans), dtype=float))


def _is_partial(points: Points2) -> bool:
    """Whether the bearings of ``points`` (N, 2) leave a quarter of a turn open."""
    bearings = np.sort(np.arctan2(points[:, 1], points[:, 0]))
    return len(points) < 2 or float(np.diff(bearings, append=bearings[0] + 2.0 * math.pi).max()) > 0.5 * math.pi
