"""What is reported of objects that move in the scans."""

from __future__ import annotations

import math

from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault
from localization.sensor_checks.window import BIN_S

MOVING_OBJECTS = SensorFault(
    "moving objects in up to {percent:.0f} % of the beams, for {seconds:.0f} s in all. Only beams on surfaces that agree with the motion by"
    " the wheels are matched meanwhile. Without people and vehicles about the robot, check the wheels' radius and what covers the LiDAR."
)


class MovingReport:
    """What is reported of all times in which objects moved."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults, self._seconds, self._largest = faults, 0.0, 0.0
        self._begin_s, self._last_s = math.nan, -math.inf
        self.scans = 0
        """Scans in which objects moved."""

    def add(self, share: float) -> None:
        """Objects move in this ``share`` of the beams now."""
        now_s = self._faults.now_s
        self._begin_s = now_s if math.isnan(self._begin_s) else self._begin_s
        self._seconds += min(now_s - self._last_s, BIN_S)
        self.scans, self._last_s, self._largest = self.scans + 1, now_s, max(self._largest, share)
        message = MOVING_OBJECTS.message.format(percent=100.0 * self._largest, seconds=self._seconds)
        self._faults.revise(DetectedFault(MOVING_OBJECTS, self._begin_s, message))
