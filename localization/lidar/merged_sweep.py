"""Scans of several LiDARs as one sweep, by their mounts and times.

One draws the map, against which the mounts of the others are measured; once these are known, all draw it. With one degree between a front
and a rear scanner, a sweep of both by their mounts is worse than either scan. What it brings on simulated drives is in docs/online.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from localization.events import Scan
from localization.lidar.deskew import Sweep
from localization.lidar.registration import OUTLIER_SIGMAS
from localization.lidar.scan_matcher import MIN_POINTS, LidarConfig, ScanMatcher
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import Cov3, FloatArray, Pose2, Twist2

MOUNT_COV = np.diag([0.02, 0.02, math.radians(1.0)]) ** 2
"""Covariance of a mount that was measured by hand, about the body's origin [m^2, m^2, rad^2]; by judgement."""

_SHARED = 3.0
"""Variance of measurements of a mount over that of independent ones, as successive ones share surfaces: the mean square of the normalised
error of yaw on 13 simulated drives with views of 90 to 270 deg. With it, it is 1.0 on six others."""
_KNOWN = 0.2
"""Variance of a mount over that of two scans, from where on all draw the map. At 1 the errors of mounts, which are the same in all scans,
take a drive with a wide view from .0025 to .006 m."""
_OTHER_VIEW_RAD = 1.0
"""Turn after which a scanner measures other surfaces."""


@dataclass(eq=False)
class MountCorrection:
    """What a LiDAR's points in the body frame are moved by, to fit those of the LiDAR that draws the map."""

    pose: Pose2 = field(default_factory=lambda: np.zeros(3))
    """(3,)"""
    cov: Cov3 = field(default_factory=lambda: MOUNT_COV.copy())
    """(3, 3) of its left perturbation."""
    is_known: bool = False
    """The points are part of the sweep, and draw the map."""
    _measured_at: Pose2 | None = None
    """Where the robot was at the last measurement (3,)."""
    _far_m: float = 0.0
    """How far the surfaces were drawn from there [m]."""
    _misfits: int = 0
    """Measurements in a row that are far off."""

    def is_due(self, pose: Pose2) -> bool:
        """Whether a measurement from ``pose`` (3,) is of other surfaces than the last one: until the robot has come to where it drew those,
        or has turned, the drift of the map since is the same."""
        if self._measured_at is None:
            return True
        x, y, yaw = se2.between(self._measured_at, pose).tolist()
        return math.hypot(x, y) > self._far_m or abs(yaw) > _OTHER_VIEW_RAD

    def apply(self, points: FloatArray) -> FloatArray:
        """``points`` (N, 3), moved."""
        x, y, yaw = self.pose
        c, s = math.cos(yaw), math.sin(yaw)
        return np.column_stack([x + c * points[:, 0] - s * points[:, 1], y + s * points[:, 0] + c * points[:, 1], points[:, 2]])

    def update(self, off: FloatArray, R: Cov3, drift: Cov3, seen_from: tuple[Pose2, float]) -> None:
        """The points, already moved, were measured to be ``off`` (3,): a Kalman filter's update.

        ``R`` (3, 3) is the covariance by the scans of both LiDARs, ``drift`` (3, 3) that of the map since it drew these surfaces,
        ``seen_from`` a pose (3,) and how far from there they were drawn [m].

        One that is far beyond these covariances is a scan that fits at a wrong place; two in a row, of different surfaces, are a mount
        that has changed, and it is measured anew. What is known is not measured again, as it has drawn the map.
        """
        R, drift = _SHARED * R, _SHARED * drift
        S, (self._measured_at, self._far_m) = self.cov + R + drift, seen_from
        self._misfits = self._misfits + 1 if off @ np.linalg.solve(S, off) > OUTLIER_SIGMAS**2 else 0
        if self._misfits > 1:
            self.cov, self.is_known, self._misfits = MOUNT_COV.copy(), False, 0
        elif not self._misfits and not self.is_known:
            K = self.cov @ np.linalg.inv(S)
            self.pose = se2.compose(se2.exp(K @ off), self.pose)
            self.cov = self.cov - K @ self.cov
            self.is_known = bool(np.linalg.eigvals(np.linalg.solve(R, self.cov)).real.max() < _KNOWN)


class MergedSweeps:
    """`sweep` of each scan, with the points of the others beside it whose mounts are known; `measure` those at key scans."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig) -> None:
        self._mounts, self._config = mounts, config
        self._beside: dict[str, Sweep] = {}  # of the scan at hand, by frame
        self.corrections: dict[str, MountCorrection] = {}
        """By frame, of LiDARs that do not draw the map."""

    def begin(self) -> None:
        """Another LiDAR draws the map from here on."""
        self.corrections, self._beside = {}, {}

    def is_aligned(self, frame: str) -> bool:
        """Whether the map can be continued by the scans of ``frame``: its mount is known against the LiDAR that has drawn it so far."""
        return frame in self.corrections and self.corrections[frame].is_known

    def parameters(self) -> dict[str, tuple[float, float]]:
        """Mean and sigma of the corrections of mounts so far, by name [m, m, rad]."""
        return {
            f"{frame}_{name}": (float(correction.pose[i]), math.sqrt(correction.cov[i, i]))
            for frame, correction in self.corrections.items()
            for i, name in enumerate(("offset_x_m", "offset_y_m", "offset_yaw_rad"))
        }

    def sweep(self, scan: Scan) -> Sweep:
        """``scan``, and those beside it whose mounts are known, in the body frame, at times from the middle of ``scan``."""
        parts, self._beside = [self._in_body(scan, scan, self.corrections.get(scan.frame_id))], {}
        for other in scan.beside:
            if other.frame_id not in self._mounts:
                continue
            correction = self.corrections.setdefault(other.frame_id, MountCorrection())
            found = self._in_body(other, scan, correction)
            if len(found.points) < MIN_POINTS:
                continue
            self._beside[other.frame_id] = found
            if correction.is_known:
                parts.append(found)
        if len(parts) == 1:
            return parts[0]
        return Sweep(np.concatenate([part.points for part in parts]), np.concatenate([_times(part) for part in parts]))

    def measure(self, matcher: ScanMatcher, pose: Pose2, covs: tuple[Cov3, Cov3], twist: Twist2) -> None:
        """Where the scans beside the last one fit the map, of a body at ``pose`` (3,). ``covs``: its covariance (3, 3) against the map, and
        that of the map's own error there, (3, 3)."""
        for frame, sweep in self._beside.items():
            correction = self.corrections[frame]
            if not correction.is_due(pose):
                continue
            points = sweep.project(sweep.deskew(twist))
            drift, far_m = matcher.submap.drift_cov(points, pose, covs[1])
            found = matcher.locate(points, pose, correction.cov + covs[0] + drift)
            if found is not None:
                measured, R = found
                correction.update(se2.local(pose, measured), R + covs[0], drift, (pose, far_m))

    def _in_body(self, scan: Scan, at: Scan, correction: MountCorrection | None) -> Sweep:
        """``scan`` in the body frame, at times from the middle of ``at``."""
        mount = self._mounts.get(scan.frame_id, Mount())
        sweep = Sweep.from_scan(scan, mount, self._config.min_range_m, self._config.max_range_m)
        later_s = (scan.middle_ns - at.middle_ns) * 1e-9
        if correction is None and not later_s:
            return sweep
        points = sweep.points if correction is None else correction.apply(sweep.points)
        return Sweep(points, _times(sweep) + later_s, sweep.is_planar)


def _times(sweep: Sweep) -> FloatArray:
    return sweep.times if len(sweep.times) else np.zeros(len(sweep.points))
