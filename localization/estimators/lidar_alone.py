"""LiDAR alone: KISS-ICP as it comes, guessing by its own constant velocity. The other yardstick; wheels are never asked."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from localization.errors import EstimatorError
from localization.estimators.base import NO_POINTS, Estimate
from localization.lidar import LidarConfig, LidarOdometry, body_points
from localization.steps import Step
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import FloatArray


class LidarAlone:
    """A pose for each scan; between scans it stays where it was. No covariance: KISS-ICP has none."""

    clock_offset_s = 0.0
    params = None

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig | None = None) -> None:
        self._mounts, self._odometry = mounts, LidarOdometry(config)
        self._used: dict[str, Mount] = {}  # a frame stays where it was taken to be: KISS-ICP has but one map, drawn from there
        self._pose, self._twist, self._stamp_ns = np.zeros(3), np.zeros(3), 0
        self._n_scans = 0

    def step(self, step: Step) -> Estimate:
        if step.scan is not None:
            frame = step.scan.frame_id
            points = body_points(step.scan, self._used.setdefault(frame, self._mounts.get(frame, Mount())), self._twist)
            pose = self._odometry.register(points)
            if not np.isfinite(pose).all():
                raise EstimatorError(f"KISS-ICP lost itself at stamp {step.end_ns} ns: its pose is not finite.")
            if self._n_scans and step.end_ns > self._stamp_ns:
                self._twist = se2.log(se2.between(self._pose, pose)) / ((step.end_ns - self._stamp_ns) * 1e-9)
            self._pose, self._stamp_ns = pose, step.end_ns
            self._n_scans += 1
        return Estimate(step.end_ns, self._pose, None, self._twist, None)

    def settle(self) -> None:
        return None

    def finish(self, moments: Trajectory | None = None) -> None:
        return None

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        return {}

    def counts(self) -> Mapping[str, int]:
        return {"scans": self._n_scans}

    def map_points(self) -> FloatArray:
        return self._odometry.point_cloud() if self._n_scans else NO_POINTS
