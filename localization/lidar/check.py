"""Scans that cannot be true: a scanner that says the same again while the robot drives, or that jumps as no robot can."""

from __future__ import annotations

import math

import numpy as np

from localization.events import Scan
from localization.lidar.matcher import LidarConfig, Registration
from motion_models.se2 import FloatArray


class ScanCheck:
    """Give it every scan in the order of time; it counts what it finds."""

    def __init__(self, config: LidarConfig) -> None:
        self._config = config
        self._points: FloatArray | None = None
        self._is_frozen = False
        self._jumps = 0
        self.counts = dict.fromkeys(("stale", "jumps", "degenerate"), 0)

    def is_stale(self, scan: Scan, is_standing: bool) -> bool:
        """The very same ranges as last time although the wheels turn: noise alone would have changed them. Once they were, they stay stale
        until they change: a scanner that froze while the robot drove is no better when it stands."""
        last, self._points = self._points, scan.points
        is_same = last is not None and len(last) > 0 and np.array_equal(last, scan.points)
        self._is_frozen = is_same and (self._is_frozen or not is_standing)
        self.counts["stale"] += self._is_frozen
        return self._is_frozen

    def miss(self, scan: Scan) -> None:
        """There was too little in the scan to be matched; one without any point is no scan at all."""
        if len(scan.points):
            self.counts["sparse"] = self.counts.get("sparse", 0) + 1

    def is_jump(self, off: FloatArray, found: Registration, since_s: float) -> bool:
        """The scan lies ``off`` (3,) where the wheels say, farther than the robot can slip in ``since_s`` [s] since the last one.

        A jump that lasts is believed.
        """
        c = self._config
        self.counts["degenerate"] += found.is_degenerate
        sigma = 3.0 * np.sqrt(np.diag(found.cov))
        far = math.hypot(off[0], off[1]) > c.max_jump_m_s * since_s + float(np.max(sigma[:2]))
        turned = abs(float(off[2])) > c.max_jump_rad_s * since_s + float(sigma[2])
        is_jump = since_s > 0.0 and (far or turned)
        self._jumps = self._jumps + 1 if is_jump else 0
        if not is_jump or self._jumps > c.max_jumps:
            return False
        self.counts["jumps"] += 1
        return True
