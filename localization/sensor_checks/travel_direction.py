"""Direction of travel by the LiDAR against that by the wheels: a LiDAR whose yaw is wrong."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from localization.events import Step
from localization.sensor_checks.faults import Evidence, FaultLog, SensorFault
from localization.sensor_checks.sensor_check import SensorCheck, without_scan
from localization.sensor_checks.window import Window
from motion_models.compiled import kernel
from motion_models.se2 import FloatArray

LIDAR_DIRECTION = SensorFault(
    "by the LiDAR the robot travels {degrees:.0f} deg to the {side} of where the wheels drive. Its scans are not used while that lasts."
    " Correct the yaw of its frame by {correction:+.0f} deg in /tf_static or in the robot file's [mounts].",
    reference="wheels and gyro",
    is_of_scans=True,
)

_MEMORY_S = 120.0
"""A robot that slides has a direction of travel that is wrong (fr079: 14 deg for 7 s); it is compared over two minutes."""
_MAX_DIRECTION_RAD = math.radians(12.0)
"""A robot on a side slope or in curves slides by a few degrees."""
_MAX_SLIDE_RAD = math.radians(20.0)
"""Directions that no slide explains are compared over seconds: 99.9 % of the windows of CSAIL, fr079 and ACES are below 17 deg. Windows
of 3 s would take a time for a turned LiDAR in which the wheels of fr079 count backwards as forwards (6 s, ATE .13 -> .18 m)."""
_MIN_TRAVEL_M = 0.05
"""Least way by the wheels, and by the LiDAR, in a bin whose direction counts [m]."""
_MIN_TRAVEL_BINS = 6
_MAX_LENGTH_RATIO = 2.0
"""Ways whose lengths differ by more show wheels that spin, or another unit, and no direction."""
_CONFIDENCE = 0.999
"""Confidence of a direction's one-sided bound: windows overlap, so that one of a thousand is one of some minutes."""
_NOISE_M, _SLIDE_M_PER_RAD = 0.005, 0.5
"""Noise of a bin's way by scans at least [m], and what a robot may slide in a turn: half its length [m/rad]."""


class TravelDirection(SensorCheck):
    """Leaves out scans while most comparisons show another direction than the wheels."""

    is_of_declared_faults = True

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._off, self._far_off = Evidence(_MEMORY_S), Evidence()

    def compare(self, window: Window) -> bool:
        """Declare a fault that lasts; whether the directions agree, or no scans have come."""
        direction = travel_direction(window.bins.wheels, window.bins.lidar)
        for evidence, most in ((self._off, _MAX_DIRECTION_RAD), (self._far_off, _MAX_SLIDE_RAD)):
            evidence.add(None if direction is None else direction.exceeds(most), window.end_s, window.begin_s)
        if direction is None:
            return not window.has_scans
        if self._off.is_lasting and self._is_contradicted:
            degrees = math.degrees(direction.angle)
            numbers = {"degrees": abs(degrees), "side": "left" if degrees > 0.0 else "right", "correction": -degrees}
            self._faults.declare(LIDAR_DIRECTION, self._off.since_s, numbers)
        return direction.exceeds(_MAX_DIRECTION_RAD) is False

    def apply(self, step: Step) -> Step:
        """``step`` without its scan."""
        return without_scan(step) if LIDAR_DIRECTION in self._faults.declared and self._is_contradicted else step

    @property
    def _is_contradicted(self) -> bool:
        return self._off.is_majority or self._far_off.is_majority


class LidarDirection(NamedTuple):
    """Direction of the LiDAR's travel against the wheels'."""

    angle: float
    """[rad]"""
    bound: float
    """Its error at most [rad], by the scatter of the bins (`_CONFIDENCE`)."""

    def exceeds(self, most: float) -> bool | None:
        """Whether it is larger than ``most`` [rad]; None where its error does not show it."""
        size = abs(self.angle)
        return True if size - self.bound > most else False if size <= most and self.bound <= most else None


def travel_direction(wheels: FloatArray, lidar: FloatArray) -> LidarDirection | None:
    """Direction of the LiDAR's travel against the wheels', by their motions (n, 3) in bins; None where it is not known.

    Least squares of lidar_k = alpha wheels_k + beta turn_k, ways as complex numbers: the angle of alpha is the direction, beta what the
    robot slides in turns [m/rad], which is 0 +- `_SLIDE_M_PER_RAD` a priori: along one arc a slide looks like another direction, and so
    do wheels that spin. Where beta is beyond two sigmas, or alpha is no length that a direction has, there is none.
    """
    n, angle, sigma = _mean_direction(wheels, lidar)
    return LidarDirection(angle, float(stdtrit(n - 2, _CONFIDENCE)) * sigma) if n else None


@kernel
def _mean_direction(wheels: FloatArray, lidar: FloatArray) -> tuple[int, float, float]:
    """Number of bins that count, 0 where there is no direction; angle of alpha, and its standard error [rad]."""
    n, ww, wt, tt, wz, tz = 0, 0.0, 0j, (_NOISE_M / _SLIDE_M_PER_RAD) ** 2, 0j, 0j
    w, z, t = np.empty(len(wheels), np.complex128), np.empty(len(wheels), np.complex128), np.empty(len(wheels))
    for i in range(len(wheels)):
        by_wheels, by_lidar = complex(wheels[i, 0], wheels[i, 1]), complex(lidar[i, 0], lidar[i, 1])
        shorter, longer = min(abs(by_wheels), abs(by_lidar)), max(abs(by_wheels), abs(by_lidar))
        if not math.isnan(abs(by_wheels) + abs(by_lidar)) and shorter >= _MIN_TRAVEL_M and longer <= _MAX_LENGTH_RATIO * shorter:
            w[n], z[n], t[n] = by_wheels, by_lidar, wheels[i, 2]
            ww, wt, tt = ww + abs(w[n]) ** 2, wt + w[n].conjugate() * t[n], tt + t[n] ** 2
            wz, tz, n = wz + w[n].conjugate() * z[n], tz + t[n] * z[n], n + 1
    if n < _MIN_TRAVEL_BINS:
        return 0, 0.0, 0.0
    determinant = ww * tt - abs(wt) ** 2
    alpha, beta = (tt * wz - wt * tz) / determinant, (ww * tz - wt.conjugate() * wz) / determinant
    if abs(beta) > 2.0 * _SLIDE_M_PER_RAD or not 1.0 <= _MAX_LENGTH_RATIO * abs(alpha) <= _MAX_LENGTH_RATIO**2:
        return 0, 0.0, 0.0
    square = 0.0
    for k in range(n):
        square += abs(z[k] - alpha * w[k] - beta * t[k]) ** 2
    variance = max(square / (2 * (n - 2)), _NOISE_M**2)
    return n, math.atan2(alpha.imag, alpha.real), math.sqrt(variance * tt / determinant) / abs(alpha)
