"""Points of the robot itself in its LiDAR's scans."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.events import Scan, Step
from localization.sensor_checks.check import Check
from localization.sensor_checks.faults import Fault, FaultLog
from motion_models.se2 import FloatArray

LIDAR_OWN_BODY = Fault(
    "{percent:.0f} % of the LiDAR's points are the robot itself (same ranges while it drives and turns). They are left out"
    " from then on. Remove what covers the LiDAR, or filter these beams in its driver (laser_filters).",
    reference="wheels and gyro",
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


class OwnBody(Check):
    """Leaves out the points of the robot itself."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._filters: dict[str, OwnBodyFilter] = {}  # by the LiDAR's frame

    def prepare(self, step: Step) -> Step:
        """``step`` without these points."""
        for each in self._filters.values():
            each.add_motion(step.predicted.delta)
        if step.scan is None:
            return step
        body = self._filters.setdefault(step.scan.frame_id, OwnBodyFilter())
        scan = body.filter(step.scan)
        if body.share > _MIN_OWN_SHARE:
            self._faults.declare(LIDAR_OWN_BODY, self._faults.now_s, {"percent": 100.0 * body.share})
        return replace(step, scan=scan)


class OwnBodyFilter:
    """Removes points of the robot itself from the scans of one LiDAR: their beams have the same range while the robot drives and turns."""

    def __init__(self) -> None:
        self._range = np.full(_BODY_BEARINGS, np.nan)
        self._travel = np.zeros(_BODY_BEARINGS)
        self._headings = np.zeros((2, _BODY_BEARINGS))  # least and greatest since the range is the same [rad]
        self._is_own = np.zeros(_BODY_BEARINGS, dtype=bool)
        self._travelled = self._heading = 0.0
        self.share = 0.0
        """Largest share of a scan's points that were the robot itself, 0 to 1."""

    def add_motion(self, delta: FloatArray) -> None:
        """Motion (3,) of the body since the last call."""
        self._travelled += math.hypot(delta[0], delta[1])
        self._heading += float(delta[2])

    def filter(self, scan: Scan) -> Scan:
        """``scan`` without the points that were recognized as the robot itself. Only planar scans are examined."""
        points = scan.points
        if not scan.is_planar or not len(points):
            return scan
        r2 = points[:, 0] ** 2 + points[:, 1] ** 2
        near = np.flatnonzero(r2 < _MAX_BODY_RANGE_M**2)  # no point that is not finite
        if not len(near):
            self._range, self._travelled = np.full(_BODY_BEARINGS, np.nan), 0.0
            return scan
        r = np.sqrt(r2[near])
        bins = np.floor(np.arctan2(points[near, 1], points[near, 0]) * (_BODY_BEARINGS / (2.0 * math.pi))).astype(np.intp) % _BODY_BEARINGS
        nearest = np.full(_BODY_BEARINGS, np.inf)
        np.minimum.at(nearest, bins, r)
        nearest[np.isinf(nearest)] = np.nan
        is_same = np.abs(nearest - self._range) <= _SAME_RANGE_M
        self._travel = np.where(is_same, self._travel + self._travelled, 0.0)
        least, greatest = self._headings
        self._headings = np.where(is_same, [np.minimum(least, self._heading), np.maximum(greatest, self._heading)], self._heading)
        self._range = np.where(is_same, self._range, nearest)
        self._travelled = 0.0
        has_turned = self._headings[1] - self._headings[0] >= _MIN_BODY_TURN_RAD
        self._is_own = is_same & (self._is_own | ((self._travel >= _MIN_BODY_TRAVEL_M) & has_turned))
        is_own = np.zeros(len(points), dtype=bool)
        is_own[near] = self._is_own[bins] & (np.abs(r - self._range[bins]) <= _SAME_RANGE_M)
        share = float(is_own.mean())
        if share < _MIN_BODY_SHARE:
            return scan
        self.share = max(self.share, share)
        return replace(scan, points=points[~is_own], offsets=scan.offsets[~is_own] if len(scan.offsets) else scan.offsets)
