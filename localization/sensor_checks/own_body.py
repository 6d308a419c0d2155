"""Points of the robot itself in its LiDAR's scans."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.events import Step
from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.trajectory import BoolArray
from motion_models.compiled import kernel
from motion_models.se2 import FloatArray

LIDAR_OWN_BODY = SensorFault(
    "{percent:.0f} % of the LiDAR's points are the robot itself (same ranges while it drives and turns). They are left out"
    " from then on. Remove what covers the LiDAR, or filter these beams in its driver (laser_filters).",
    reference="wheels and gyro",
    is_of_scans=True,
    draws_map=True,
)

_MIN_OWN_SHARE = 0.05
"""Share of a scan's points on the robot itself, from where on they are reported."""
_MIN_BODY_SHARE = 0.01
"""Share of a scan's points on the robot itself, from where on they are left out."""
_BODY_BEARINGS = 360
_MAX_BODY_RANGE_M = 1.0
"""Parts of a robot of 1 m are nearer to its LiDAR."""
_SAME_RANGE_M = 0.03
_MIN_BODY_TRAVEL_M, _MIN_BODY_TURN_RAD = 1.5, 0.4
"""A wall keeps its range only while the robot drives along it without turning. On ACES, 0.15 rad leave 3 % of the beams on a wall at 0.9 m
that is hit at a right angle; 0.4 rad change these by 8 %."""


class OwnBody:
    """Leaves out the points of the robot itself: their beams have the same range while the robot drives and turns.

    Until some are found, `remove` is called to find them, of steps that the estimator has had; from then on before it has them.
    """

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._way = self._heading = 0.0  # since the first step [m, rad]
        self._lidars: dict[str, tuple[FloatArray, float]] = {}  # by frame: bearings as `_find_own` has them, and the way at the last scan
        self._share = 0.0  # largest of a scan since the last report
        self.is_found = False
        """Points of the robot itself were found in a scan: `remove` them from all that come."""

    def remove(self, step: Step) -> Step:
        """``step`` without these points. Only planar scans are examined."""
        x, y, turn = step.predicted.delta.tolist()
        if step.turn is not None:  # the smaller turn: one of both in a wrong unit makes every wall the robot itself
            turn = min(turn, step.turn.angle, key=abs)
        self._way, self._heading = self._way + math.hypot(x, y), self._heading + turn
        scan = step.scan
        if scan is None or not scan.is_planar or not len(scan.points):
            return step
        bearings, way = self._lidars.get(scan.frame_id) or (np.full((_BODY_BEARINGS, 5), np.nan), self._way)
        self._lidars[scan.frame_id] = bearings, self._way
        is_own = np.zeros(len(scan.points), dtype=bool)
        share = _find_own(scan.points, self._way - way, self._heading, bearings, is_own) / len(scan.points)
        self._share = max(self._share, share)
        if share < _MIN_BODY_SHARE:
            return step
        self.is_found = True
        return replace(step, scan=scan.select(~is_own))

    def report(self) -> None:
        """Declare what was left out, if it is more than a few points."""
        if self._share > _MIN_OWN_SHARE:
            self._faults.declare(LIDAR_OWN_BODY, self._faults.now_s, {"percent": 100.0 * self._share})
        self._share = 0.0


@kernel
def _find_own(points: FloatArray, travelled: float, heading: float, bearings: FloatArray, is_own: BoolArray) -> int:
    """Set ``is_own`` (N,) of the ``points`` (N, 3) that are the robot itself, and count them; ``bearings`` (360, 5) are updated,
    ``travelled`` [m] later.

    Of each bearing: range to the nearest point [m], for how long a way it is the same [m], least and greatest ``heading`` meanwhile [rad],
    and whether it is the robot itself, 0 or 1.
    """
    n = points.shape[0]
    nearest, ranges, bins = np.full(_BODY_BEARINGS, np.inf), np.empty(n), np.empty(n, dtype=np.int64)
    for i in range(n):
        x, y = points[i, 0], points[i, 1]
        ranges[i], bins[i] = math.sqrt(x * x + y * y), -1
        if ranges[i] < _MAX_BODY_RANGE_M:
            bins[i] = k = math.floor(math.atan2(y, x) * (_BODY_BEARINGS / (2.0 * math.pi))) % _BODY_BEARINGS
            nearest[k] = min(nearest[k], ranges[i])
    for k in range(_BODY_BEARINGS):
        b = bearings[k]
        if not abs(nearest[k] - b[0]) <= _SAME_RANGE_M:  # also where there is no point, before or now
            b[0], b[1], b[2], b[3], b[4] = nearest[k], 0.0, heading, heading, 0.0
            continue
        b[1], b[2], b[3] = b[1] + travelled, min(b[2], heading), max(b[3], heading)
        if b[1] >= _MIN_BODY_TRAVEL_M and b[3] - b[2] >= _MIN_BODY_TURN_RAD:
            b[4] = 1.0
    count = 0
    for i in range(n):
        k = bins[i]
        is_own[i] = k >= 0 and bearings[k, 4] == 1.0 and abs(ranges[i] - bearings[k, 0]) <= _SAME_RANGE_M
        count += is_own[i]
    return count
