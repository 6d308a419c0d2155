"""Motion of the last seconds by each sensor, in bins: what is compared."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from localization.events import Scan, Step
from localization.lidar import LidarConfig, Sweep
from localization.sensor_checks.scan_motion import Profile, ScanOdometry, make_profile
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Points2

BIN_S = 0.25
WINDOW_BINS, MIN_BINS = 24, 10
"""Bins that are compared (6 s), and the fewest (2.5 s)."""
_MAX_BIN_S = 1.0
"""How long a bin waits for a scan: LiDARs give 2 to 40 scans a second."""


@dataclass(frozen=True, eq=False)
class Bin:
    """Motion over a quarter of a second or more."""

    duration_s: float
    wheels: FloatArray
    """(3,) by the wheels; NaN where they were missing."""
    gyro: float
    """Turn [rad]; NaN where it was missing."""
    lidar: FloatArray
    """(3,) by the scans; NaN where unknown, translation where the scene does not show it."""
    is_standing: bool


class Window:
    """`add` each step. The LiDAR's motion is that of `scan_motion`, which uses neither the filter nor the other sensors."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig) -> None:
        self._mounts, self._config = mounts, config
        self._scans = ScanOdometry()
        self._open = _Accumulator()
        self._durations_s = np.zeros(0)
        self.bins: deque[Bin] = deque(maxlen=WINDOW_BINS)
        self.has_scans = False
        """Whether any scan has come."""
        self.begin_s = self.end_s = 0.0
        """After the first step [s]."""
        self.is_scene_moving = False
        """Objects move in the scans: they show no way of the robot."""
        self.registered: Scan | None = None
        """The last scan that ended a bin."""

    def add(self, step: Step, now_s: float) -> bool:
        """Whether ``step`` ends a bin and there are enough to compare. A bin ends where it is long enough, at a scan if there are any."""
        self._open.add(step)
        self.has_scans |= step.scan is not None
        waits_for_scan = self.has_scans and step.scan is None
        if self._open.duration_s < (_MAX_BIN_S if waits_for_scan else BIN_S):
            return False
        lidar = np.full(3, np.nan) if step.scan is None else self._register(step.scan)
        self.bins.append(self._open.close(lidar))
        self._open = _Accumulator(has_scan_at_start=step.scan is not None)
        self._durations_s = np.array([b.duration_s for b in self.bins])
        self.begin_s, self.end_s = max(now_s - float(self._durations_s.sum()), 0.0), now_s
        return len(self.bins) >= MIN_BINS

    def _register(self, scan: Scan) -> FloatArray:
        """Motion (3,) in the open bin, which ``scan`` ends."""
        self.registered = scan
        motion = self._scans.register(*self.project(scan))
        if motion is None or not self._open.has_scan_at_start:
            return np.full(3, np.nan)
        is_known = motion.has_translation and not self.is_scene_moving
        return motion.delta if is_known else np.array([np.nan, np.nan, motion.delta[2]])

    def project(self, scan: Scan) -> tuple[Points2, FloatArray]:
        """Points (M, 2) of ``scan`` in the plane of the body, and where its LiDAR is (2,) [m]."""
        mount = self._mounts.get(scan.frame_id, Mount())
        sweep = Sweep.from_scan(scan, mount).within(self._config.min_range_m, self._config.max_range_m)
        return sweep.project(sweep.points), np.array([mount.x, mount.y])

    def profile(self, scan: Scan) -> Profile | None:
        """Profile of ``scan``; None for too few points."""
        if scan is self.registered:
            return self._scans.last
        points, center = self.project(scan)
        return make_profile(points - center, center)

    def points_about_lidar(self, scan: Scan) -> Points2:
        """(N, 2) all points of a planar ``scan`` about its LiDAR, in the body's axes."""
        R = self._mounts.get(scan.frame_id, Mount()).rotation()
        return np.ascontiguousarray(scan.points[:, :2] @ R[:2, :2].T)

    @property
    def turn_rates(self) -> FloatArray:
        """(3, n) by wheels, gyro and LiDAR [rad/s]; NaN where unknown."""
        return np.array([[b.wheels[2], b.gyro, b.lidar[2]] for b in self.bins]).T / self._durations_s


@dataclass
class _Accumulator:
    """The open bin."""

    has_scan_at_start: bool = False
    duration_s: float = 0.0
    _wheels: FloatArray | None = None
    _gyro: float = 0.0
    _is_standing: bool = True
    _has_wheels: bool = True

    def add(self, step: Step) -> None:
        if step.duration == 0.0:
            return
        self.duration_s += step.duration
        self._has_wheels &= step.has_wheels
        if self._has_wheels:
            self._wheels = step.predicted.delta if self._wheels is None else se2.compose(self._wheels, step.predicted.delta)
        self._gyro += math.nan if step.turn is None else step.turn.angle
        self._is_standing &= step.is_standing

    def close(self, lidar: FloatArray) -> Bin:
        wheels = self._wheels if self._wheels is not None and self._has_wheels else np.full(3, np.nan)
        return Bin(self.duration_s, wheels, self._gyro, lidar, self._is_standing)
