"""What is reported of objects that move in the scans."""

from __future__ import annotations

import math

from localization.sensor_checks.contradictions import LIDAR_DIRECTION
from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault
from localization.sensor_checks.own_body import LIDAR_OWN_BODY, LIDAR_OWN_PARTS
from localization.sensor_checks.standstill import WHEELS_STANDING
from localization.sensor_checks.turn_votes import LIDAR_OPPOSITE, WHEELS_OPPOSITE
from localization.sensor_checks.window import BIN_S

MOVING_OBJECTS = SensorFault(
    "moving_objects.in_scans",
)
_EXPLAINING = (LIDAR_OWN_BODY, LIDAR_OWN_PARTS, LIDAR_DIRECTION, LIDAR_OPPOSITE, WHEELS_OPPOSITE, WHEELS_STANDING)
"""Named faults of which parts of a scan, or the wheels, move otherwise."""


class MovingReport:
    """What is reported of all times in which objects moved."""

    def __init__(self, faults: FaultLog, explained: tuple[SensorFault, ...] = ()) -> None:
        """``explained``: named faults so far that explain what was taken for moving objects."""
        self._faults, self._explained, self._seconds, self._largest = faults, explained, 0.0, 0.0
        self._begin_s, self._last_s = math.nan, -math.inf
        self.scans = 0
        """Scans in which objects moved."""

    def add(self, share: float) -> None:
        """Objects move in this ``share`` of the beams now."""
        now_s = self._faults.now_s
        self._begin_s = now_s if math.isnan(self._begin_s) else self._begin_s
        self._seconds += min(now_s - self._last_s, BIN_S)
        self.scans, self._last_s, self._largest = self.scans + 1, now_s, max(self._largest, share)
        message = MOVING_OBJECTS.describe({"percent": 100.0 * self._largest, "seconds": self._seconds})
        self._faults.revise(DetectedFault(MOVING_OBJECTS, self._begin_s, message))

    def is_explained(self) -> bool:
        """Whether a fault was named since that explains what was taken for moving objects."""
        return any(fault in self._faults.declared for fault in _EXPLAINING if fault not in self._explained)

    def begin_again(self) -> MovingReport:
        """Report nothing of what is explained; the report of later objects."""
        self._faults.retract(MOVING_OBJECTS)
        return MovingReport(self._faults, tuple(fault for fault in _EXPLAINING if fault in self._faults.declared))
