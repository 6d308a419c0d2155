"""Beams that hit the robot itself: they show the same range while the robot drives and turns."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.events import Scan
from motion_models.se2 import FloatArray

_BEARINGS = 360
_MAX_RANGE_M = 1.0
"""Parts of a robot of 1 m are nearer to its LiDAR."""
_SAME_RANGE_M = 0.03
_MIN_TRAVEL_M, _MIN_TURN_RAD = 1.5, 0.4
"""A wall keeps its range only while the robot drives along it without turning. On ACES, 0.15 rad leave 3 % of the beams on a wall at 0.9 m
that is hit at a right angle; 0.4 rad change these by 8 %."""
_MIN_SHARE = 0.01


class OwnBodyFilter:
    """Removes points of the robot itself from scans, once they are recognized."""

    def __init__(self) -> None:
        self._range = np.full(_BEARINGS, np.nan)
        self._travel = np.zeros(_BEARINGS)
        self._headings = np.zeros((2, _BEARINGS))  # least and greatest since the range is the same [rad]
        self._is_own = np.zeros(_BEARINGS, dtype=bool)
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
        r = np.nan_to_num(np.hypot(points[:, 0], points[:, 1]), nan=np.inf)
        bearings = np.nan_to_num(np.arctan2(points[:, 1], points[:, 0]))  # a point that is not finite is on no part of the robot
        bins = np.floor(bearings * (_BEARINGS / (2.0 * math.pi))).astype(np.intp) % _BEARINGS
        nearest = np.full(_BEARINGS, np.inf)
        np.minimum.at(nearest, bins, r)
        nearest[nearest > _MAX_RANGE_M] = np.nan
        is_same = np.abs(nearest - self._range) <= _SAME_RANGE_M
        self._travel = np.where(is_same, self._travel + self._travelled, 0.0)
        least, greatest = self._headings
        self._headings = np.where(is_same, [np.minimum(least, self._heading), np.maximum(greatest, self._heading)], self._heading)
        self._range = np.where(is_same, self._range, nearest)
        self._travelled = 0.0
        has_turned = self._headings[1] - self._headings[0] >= _MIN_TURN_RAD
        self._is_own = is_same & (self._is_own | ((self._travel >= _MIN_TRAVEL_M) & has_turned))
        is_own = self._is_own[bins] & (np.abs(r - self._range[bins]) <= _SAME_RANGE_M)
        share = float(is_own.mean())
        if share < _MIN_SHARE:
            return scan
        self.share = max(self.share, share)
        return replace(scan, points=points[~is_own], offsets=scan.offsets[~is_own] if len(scan.offsets) else scan.offsets)
