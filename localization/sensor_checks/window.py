"""Motion of the last seconds by each sensor, in bins: what is compared."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from localization.events import Scan, Step
from localization.lidar import LidarConfig
from localization.sensor_checks.scan_motion import Profile, ScanMotion, ScanOdometry, profile_of
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Points2

_NO_MOUNT = Mount()


class MountedScans:
    """`register` the scans whose motion is asked for; `profile` any, which for the last of these costs nothing."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig) -> None:
        self._mounts, self._config, self._odometry = mounts, config, ScanOdometry()
        self.registered: Scan | None = None
        """The last scan whose motion was asked for."""

    def register(self, scan: Scan) -> ScanMotion | None:
        """Motion of the body since the scan registered before; None where it is not shown."""
        motion = self._odometry.register(self.profile(scan))
        self.registered = scan
        return motion

    def profile(self, scan: Scan) -> Profile | None:
        """Profile of ``scan``; None for too few points."""
        if scan is self.registered:
            return self._odometry.last
        return profile_of(scan, self._mounts.get(scan.frame_id, _NO_MOUNT), self._config)

    def points_about_lidar(self, scan: Scan) -> Points2:
        """(N, 2) all points of ``scan`` about its LiDAR, in the body's axes."""
        return np.ascontiguousarray(scan.points @ self._mounts.get(scan.frame_id, _NO_MOUNT).rotation[:2].T)


BIN_S = 0.25
WINDOW_BINS = 24
"""Bins that are compared: 6 s."""
MIN_BINS = 10
"""Fewest bins that are compared: 2.5 s."""
_MAX_BIN_S = 1.0
"""How long a bin waits for a scan: LiDARs give 2 to 40 scans a second."""
_COLUMNS = 12
_UNKNOWN = np.full(3, np.nan)


class Bins(NamedTuple):
    """Motion over the last quarters of a second or more, the oldest first. NaN is what was not measured."""

    rows: FloatArray
    """(n, 12) all of what follows."""
    durations_s: FloatArray
    """(n,) [s]"""
    wheels: FloatArray
    """(n, 3) by the wheels [m, m, rad]."""
    gyro: FloatArray
    """(n,) turn [rad]."""
    lidar: FloatArray
    """(n, 3) by the scans [m, m, rad]; NaN is the way where the scene does not show it."""
    is_standing: FloatArray
    """(n,) 1 where the wheels stand, else 0."""
    across: FloatArray
    """(n, 3) way by the scans across the surfaces of which there are most [m], and its unit vector; known in any scene."""

    @classmethod
    def of(cls, rows: FloatArray) -> Bins:
        """Columns of ``rows`` (n, 12)."""
        rows = np.asfortranarray(rows)  # so that each is contiguous
        return cls(rows, rows[:, 0], rows[:, 1:4], rows[:, 4], rows[:, 5:8], rows[:, 8], rows[:, 9:])


class Window:
    """`add` each step. The LiDAR's motion is that of `scan_motion`, which uses neither the filter nor the other sensors."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig) -> None:
        self.scans = MountedScans(mounts, config)
        """The last that was registered is the one that ended the last bin."""
        self._open, self._frame = _Accumulator(), ""
        self.bins = Bins.of(np.empty((0, _COLUMNS)))
        self.has_scans = self.has_gyro = False
        """Whether any scan, or turn by a gyro, has come."""
        self.begin_s = self.end_s = 0.0
        """After the first step [s]."""
        self.is_scene_moving = False
        """Objects move in the scans: they show no way of the robot."""

    def add(self, step: Step, now_s: float) -> bool:
        """Whether ``step`` ends a bin and there are enough to compare. A bin ends where it is long enough, at a scan if there are any."""
        self._open.add(step)
        self.has_scans |= step.scan is not None
        self.has_gyro |= step.turn is not None
        waits_for_scan = self.has_scans and step.scan is None
        if self._open.duration_s < (_MAX_BIN_S if waits_for_scan else BIN_S):
            return False
        if step.scan is not None and step.scan.frame_id != self._frame:  # another LiDAR: its scans are registered from here on
            self._frame, self._open.has_scan_at_start = step.scan.frame_id, False
        lidar, across = (_UNKNOWN, _UNKNOWN) if step.scan is None else self._register(step.scan)
        closed, self._open = self._open, _Accumulator(has_scan_at_start=step.scan is not None)
        row = np.array([[closed.duration_s, *closed.wheels, closed.gyro, *lidar, closed.is_standing, *across]])
        self.bins = Bins.of(np.concatenate((self.bins.rows[1 - WINDOW_BINS :], row)))
        self.begin_s, self.end_s = max(now_s - float(self.bins.durations_s.sum()), 0.0), now_s
        return len(self.bins.rows) >= MIN_BINS

    def _register(self, scan: Scan) -> tuple[FloatArray, FloatArray]:
        """Motion (3,) in the open bin, which ``scan`` ends, and `Bins.across` (3,)."""
        motion = self.scans.register(scan)
        if motion is None or not self._open.has_scan_at_start:
            return _UNKNOWN, _UNKNOWN
        turn_alone = np.array([np.nan, np.nan, motion.delta[2]])
        if self.is_scene_moving:
            return turn_alone, _UNKNOWN
        if not motion.has_translation and not scan.is_planar:  # a few trees on hills: what is below them is no wall
            return turn_alone, _UNKNOWN
        across = np.array([motion.delta[:2] @ motion.normal, *motion.normal])
        return motion.delta if motion.has_translation else turn_alone, across


@dataclass
class _Accumulator:
    """The open bin."""

    has_scan_at_start: bool = False
    duration_s: float = 0.0
    gyro: float = 0.0
    is_standing: bool = True
    _wheels: FloatArray | None = None
    _has_wheels: bool = True

    def add(self, step: Step) -> None:
        if step.duration == 0.0:
            return
        self.duration_s += step.duration
        self._has_wheels &= step.has_wheels
        if self._has_wheels:
            self._wheels = step.predicted.delta if self._wheels is None else se2.compose(self._wheels, step.predicted.delta)
        self.gyro += math.nan if step.turn is None else step.turn.angle
        self.is_standing &= step.is_standing

    @property
    def wheels(self) -> FloatArray:
        """(3,) motion by the wheels; NaN where they were missing."""
        return self._wheels if self._wheels is not None and self._has_wheels else _UNKNOWN
