"""Scans of the mounted LiDARs as the checks compare them: profiles, points about the LiDAR, and the motion from one to the next."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from localization.events import Scan
from localization.lidar import LidarConfig
from localization.sensor_checks.scan_motion import Profile, ScanMotion, ScanOdometry, profile_of
from motion_models.robot import Mount
from motion_models.se2 import Points2

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
