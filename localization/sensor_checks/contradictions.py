"""Sensors that contradict the others in their turns (`turn_votes`), a LiDAR that travels another way, and a gyro that repeats one value.

Gyro or scans are left out then, wheels count as unknown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from localization.sensor_checks.faults import MEMORY_S, Evidence, FaultLog, SensorFault
from localization.sensor_checks.travel_direction import SLIDE_RAD, direction_of
from localization.sensor_checks.turn_votes import Sensor, TurnVotes
from localization.sensor_checks.window import WINDOW_BINS, Bins, Window

GYRO_STUCK = SensorFault(
    "stopped_gyro.repeats",
    reference="wheels",
)
LIDAR_DIRECTION = SensorFault(
    "lidar_yaw.turned",
    reference="wheels and gyro",
    is_of_scans=True,
)
_MAX_SLIDE_RAD = math.radians(20.0)
"""Directions that no slide explains are compared over seconds: 99.9 % of the windows of CSAIL, fr079 and ACES are below 17 deg. Windows
of 3 s would take a time for a turned LiDAR in which the wheels of fr079 count backwards as forwards (6 s, ATE .13 -> .18 m)."""
_SLIDE_S = 120.0
"""A robot that slides has a direction of travel that is wrong (fr079: 14 deg for 7 s); it is compared over two minutes."""
_REPEATED_RAD_S = 1e-7
"""A gyro's mean rates never repeat to the last digit, but for its noise [rad/s]."""
_MIN_STUCK_OFF_RAD_S, _MIN_STUCK_WHEELS_RAD_S = 0.05, 0.002
"""A gyro that repeats is stuck where the wheels turn by something else, which its bias (ten prior sigmas of the shipped robots) does not
explain; over a whole window, where the wheels turn at all [rad/s]."""
_DIRECTIONS = (SLIDE_RAD, _SLIDE_S), (_MAX_SLIDE_RAD, MEMORY_S)
"""Directions of travel of a LiDAR whose mount is turned, and the times of which most comparisons show them [rad, s]."""


class Contradictions:
    """`compare` at each bin of the window; `excluded` are the sensors that contradict the others."""

    def __init__(self, faults: FaultLog, usual: Mapping[int, float]) -> None:
        """``usual``: what healthy wheels' turns err by, as `pairs.usual_errors` has it."""
        self._faults, self._stuck, self._turns = faults, Evidence(), TurnVotes(faults, usual)
        self._directions = [Evidence(memory_s) for _, memory_s in _DIRECTIONS]
        self._is_any_shown = False  # by the last comparison

    def compare(self, window: Window) -> bool:
        """Declare faults that last; whether the turns show no fault, ways are equal where there are scans, and nothing contradicts."""
        is_stuck, way = window.has_gyro and is_repeating(window.bins), direction_of(window.bins)
        least_rad = way.least
        are_turns_equal, are_ways_equal = self._turns.compare(window, has_gyro=not is_stuck), way.is_equal
        self._is_any_shown = is_stuck or self._turns.is_likely
        self._stuck.add(is_stuck, window.end_s, window.begin_s)
        if is_stuck and self._stuck.is_lasting and self._stuck.is_majority:
            self._faults.declare(GYRO_STUCK, self._stuck.since_s, {})
        for (beyond, _), evidence in zip(_DIRECTIONS, self._directions, strict=True):
            is_shown = least_rad > beyond
            evidence.add(True if is_shown else False if are_ways_equal else None, window.end_s, window.begin_s)
            if is_shown and evidence.is_lasting and evidence.is_majority:
                degrees = math.degrees(way.angle)
                numbers = {"degrees": abs(degrees), "side": "left" if degrees > 0.0 else "right", "correction": -degrees}
                self._faults.declare(LIDAR_DIRECTION, evidence.since_s, numbers)
            self._is_any_shown |= is_shown
        return are_turns_equal and (are_ways_equal or not window.has_scans) and not self._is_any_shown

    @property
    def is_acting(self) -> bool:
        """Sensors are left out, or may have to be soon."""
        return self._is_any_shown or bool(self._faults.declared and self.excluded)

    @property
    def excluded(self) -> set[Sensor]:
        """Sensors that are not to be used now."""
        found: set[Sensor] = set() if self._turns.excluded is None else {self._turns.excluded}
        if LIDAR_DIRECTION in self._faults.declared and any(evidence.is_majority for evidence in self._directions):
            found.add("LiDAR")
        if GYRO_STUCK in self._faults.declared and self._stuck.is_majority:
            found.add("gyro")
        return found


def is_repeating(bins: Bins) -> bool:
    """Whether the gyro repeats one value, while the wheels turn by something else."""
    first, last = (bins.gyro[[0, -1]] / bins.durations_s[[0, -1]]).tolist()
    if not abs(last - first) <= _REPEATED_RAD_S:
        return False  # at once, of nearly all windows
    wheels, gyro = bins.rows[:, [3, 4]].T / bins.durations_s
    if not np.ptp(gyro) <= _REPEATED_RAD_S:
        return False
    is_off = float(np.mean((wheels - gyro) ** 2)) > _MIN_STUCK_OFF_RAD_S**2
    return is_off or (len(wheels) == WINDOW_BINS and float(wheels.std()) > _MIN_STUCK_WHEELS_RAD_S)
