"""Turn rates of wheels, gyro and LiDAR: opposite signs, wrong units, a gyro that is stuck, and rates of it that no slip explains.

Of three sensors the one that contradicts the two others is at fault, of two either; the gyro or the LiDAR is left out then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from localization.events import Step
from localization.sensor_checks.faults import MEMORY_S, Evidence, FaultLog, SensorFault
from localization.sensor_checks.sensor_check import SensorCheck, without_scan, without_wheels
from localization.sensor_checks.window import MIN_BINS, WINDOW_BINS, Window
from localization.synchronizer import StepConfig, UnknownVelocity
from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray, Triple

GYRO_RATE = SensorFault(
    "the gyro turns by {rate:.1f} rad/s against the wheels, more than slip explains. It is not used for 3 s after each time. Check"
    " the units of the IMU's driver.",
    reference="wheels",
)
GYRO_OPPOSITE = SensorFault(
    "the gyro turns opposite to {others}. It is not used while that lasts. Correct the IMU's mount, or its driver's sign{or_wheels}.",
    reference="wheels",
)
GYRO_UNIT = SensorFault(
    "the gyro's rates are {ratio:.2g} times those of {others} (deg/s?). It is not used while that lasts. Let its driver publish rad/s.",
    reference="wheels",
    explains=GYRO_RATE,
)
GYRO_STUCK = SensorFault(
    "the gyro repeats one value while {others} turn. It is not used as long as that lasts. Check the IMU and its driver.",
    reference="wheels",
)
WHEELS_OPPOSITE = SensorFault(
    "the wheels turn opposite to {others}. They are not used while that lasts. Swap left and right in the robot file's [joints].",
    reference="wheels and gyro",
)
LIDAR_OPPOSITE = SensorFault(
    "the LiDAR turns opposite to {others}. Its scans are not used while that lasts. It is mounted upside down, or left and right wheels"
    " are swapped: correct the roll of its frame in /tf_static or in the robot file's [mounts], or the robot file's [joints].",
    reference="wheels and gyro",
    is_of_scans=True,
)

_MAX_RATE_OFF_RAD_S, _MAX_RATE_OFF_SHARE = 2.0, 3.0
"""Difference of the gyro's rate from the wheels' that no slip explains, at least so large and so many times the wheels' rate. On the Husky
outdoors it is 0.22 rad/s at most."""
_MAX_BIAS_RAD_S = 0.05
"""Gyro bias that is no contradiction; ten times the prior sigma of the shipped robots."""
_MIN_RATE_RAD_S = 0.001
"""Root mean square of the slower turn rate, from where on signs are compared: none of 65 windows of the Husky outdoors, straight or not,
has a correlation below -0.3."""
_MIN_EXCITED_RAD_S = 0.03
"""Root mean square of the slower turn rate, from where on the scale is compared [rad/s]: above it all windows have correlations of 0.8 and
more (Husky outdoors, 32 windows; simulated laps)."""
_MIN_T = 4.0
"""Student's t of a correlation that is no chance."""
_OPPOSITE_CORRELATION, _EQUAL_CORRELATION = -0.6, 0.6
_MAX_EQUAL_RATIO = 2.5
_MIN_DEG_PER_RAD, _MAX_DEG_PER_RAD = 12.0, 130.0
"""Ratio of the gyro's turn rates to others that only a wrong unit explains: 57.3, with the factor of 0.45 to 2.3 by which wheels may be off
on loose floor, and half of it while half of the window is of before the fault."""
_REPEATED_RAD_S, _MIN_STUCK_WHEELS_RAD_S = 1e-7, 0.002
"""A gyro's mean rates never repeat to the last digit, but for its noise; over a whole window it is stuck if the wheels turn at all."""

_OR_WHEELS = ", or, as nothing else measures turns, the robot file's [joints]: left and right may be swapped, or all wheels count backwards"

Numbers = Mapping[str, float | str]


class GyroRate(SensorCheck):
    """Leaves out a gyro whose rates no slip explains, at once. Stands before the checks that leave out the wheels, which it needs."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._last_s = -math.inf  # when the rate was last one that no slip explains

    def apply(self, step: Step) -> Step:
        """``step`` without the gyro, now and for the next seconds."""
        now_s = self._faults.now_s
        if step.turn is not None and step.has_wheels and step.duration > 0.0 and not step.is_standing:
            by_wheels = float(step.predicted.delta[2]) / step.duration
            off = abs(step.turn.angle / step.duration - by_wheels)
            if off > max(_MAX_RATE_OFF_RAD_S, _MAX_RATE_OFF_SHARE * abs(by_wheels)):
                self._last_s = now_s
                self._faults.declare(GYRO_RATE, now_s, {"rate": off})
        return replace(step, turn=None) if now_s - self._last_s < MEMORY_S else step


class TurnRates(SensorCheck):
    """Leaves out what contradicts the other sensors in most comparisons of the last seconds."""

    is_of_declared_faults = True

    def __init__(self, faults: FaultLog, config: StepConfig) -> None:
        self._faults, self._velocity = faults, UnknownVelocity(config)
        self._evidence = {fault: Evidence() for fault in (GYRO_OPPOSITE, GYRO_UNIT, GYRO_STUCK, WHEELS_OPPOSITE, LIDAR_OPPOSITE)}
        self._is_gyro_stuck = False

    def compare(self, window: Window) -> bool:
        """Declare faults that last; whether some turn rates are equal and none contradicts another."""
        wheels, gyro, lidar = window.bins.turn_rates
        relations = _Relation(*_relate(wheels, gyro)), _Relation(*_relate(wheels, lidar)), _Relation(*_relate(lidar, gyro))
        found, excluded = _find_faults(*relations), _excluded_faults(*relations)
        self._is_gyro_stuck = _is_constant(gyro, wheels)
        if self._is_gyro_stuck:
            found[GYRO_STUCK] = {"others": "the wheels"}
        for fault, evidence in self._evidence.items():
            is_there = True if fault in found else False if fault in excluded else None
            evidence.add(is_there, window.end_s, window.begin_s)
        for fault, numbers in found.items():
            evidence = self._evidence[fault]
            if evidence.is_lasting and evidence.is_majority:
                self._faults.declare(fault, evidence.since_s, numbers)
        return not found and any(relation.is_equal for relation in relations)

    def apply(self, step: Step) -> Step:
        """``step`` without gyro or scan, or with unknown wheels."""
        faults = {fault for fault in self._faults.declared if fault in self._evidence and self._evidence[fault].is_majority}
        if faults & {GYRO_OPPOSITE, GYRO_UNIT} or (self._is_gyro_stuck and GYRO_STUCK in faults):
            step = replace(step, turn=None)
        if LIDAR_OPPOSITE in faults:
            step = without_scan(step)
        if WHEELS_OPPOSITE in faults and step.has_wheels and not step.is_standing:
            return without_wheels(step, self._velocity.increment(step.duration, has_turn=step.turn is not None))
        self._velocity.lasted_s = 0.0
        return step

    def compare_estimate(self, step: Step, delta: FloatArray, nis: float | None) -> None:
        """A matched scan measured the pose."""
        if nis is not None:
            self._velocity.lasted_s = 0.0


class _Relation(NamedTuple):
    """How the turn rates of two sensors relate."""

    is_equal: bool
    """Both turn enough for a scale, and alike."""
    is_opposite: bool
    unit_ratio: float
    """Ratio of the second to the first that only a wrong unit explains; 0 where there is none."""


@kernel
def _relate(a: FloatArray, b: FloatArray) -> tuple[bool, bool, float]:
    """Whether two turn rates (n,) [rad/s] are equal up to a bias of the second, whether opposite, and the ratio that only a wrong unit
    explains (see `_Relation`)."""
    n, sum_a, sum_b, aa, ab, bb = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(a)):
        if not math.isnan(a[i] + b[i]):
            n, sum_a, sum_b = n + 1, sum_a + a[i], sum_b + b[i]
            aa, ab, bb = aa + a[i] * a[i], ab + a[i] * b[i], bb + b[i] * b[i]
    if n < MIN_BINS:
        return False, False, 0.0
    bias = (sum_b - sum_a) / n
    c = min(max(bias, -_MAX_BIAS_RAD_S), _MAX_BIAS_RAD_S)
    free = (aa, ab - c * sum_a, bb - 2.0 * c * sum_b + n * c * c)
    if min(free[0], free[2]) < n * _MIN_RATE_RAD_S**2:
        return False, False, 0.0
    centred = (aa - sum_a * sum_a / n, ab - sum_a * sum_b / n, bb - sum_b * sum_b / n)
    is_opposite = _is_opposite(n, free if abs(bias) > _MAX_BIAS_RAD_S else centred)
    unit_ratio = _unit_ratio(n, free)
    if unit_ratio == 0.0:
        unit_ratio = _unit_ratio(n, centred)
    ratio = math.sqrt(free[2] / free[0])
    is_excited = min(free[0], free[2]) >= n * _MIN_EXCITED_RAD_S**2
    is_equal = is_excited and _correlation(free) >= _EQUAL_CORRELATION and 1.0 / _MAX_EQUAL_RATIO <= ratio <= _MAX_EQUAL_RATIO
    return is_equal, is_opposite, unit_ratio


@subroutine
def _correlation(products: Triple) -> float:
    """-1 to 1, by the sums of a^2, a b and b^2; 0 where one of them is 0."""
    return min(max(products[1] / math.sqrt(max(products[0] * products[2], 1e-24)), -1.0), 1.0)


@subroutine
def _unit_ratio(n: int, products: Triple) -> float:
    """Ratio of b to a where they agree but for a factor as between degrees and radians; else 0."""
    if min(products[0], products[2]) < n * _MIN_RATE_RAD_S**2 or _correlation(products) < _EQUAL_CORRELATION:
        return 0.0
    ratio = math.sqrt(products[2] / products[0])
    return ratio if _MIN_DEG_PER_RAD <= max(ratio, 1.0 / ratio) <= _MAX_DEG_PER_RAD else 0.0


@subroutine
def _is_opposite(n: int, products: Triple) -> bool:
    """Whether a and b have opposite signs, and not by chance. Means that a bias explains must be taken out before."""
    r = _correlation(products)
    return r <= _OPPOSITE_CORRELATION and r * math.sqrt((n - 2) / max(1.0 - r * r, 1e-9)) <= -_MIN_T


def _find_faults(wheels_gyro: _Relation, wheels_lidar: _Relation, lidar_gyro: _Relation) -> dict[SensorFault, Numbers]:
    """Faults by the relations of the turn rates: the sensor that contradicts the two others, or one of two."""
    found: dict[SensorFault, Numbers] = {}
    if wheels_gyro.is_opposite and lidar_gyro.is_equal:
        found[WHEELS_OPPOSITE] = {"others": "gyro and LiDAR"}
    elif wheels_gyro.is_opposite:
        is_proven = wheels_lidar.is_equal
        others = {"others": "wheels and LiDAR" if is_proven else "the wheels", "or_wheels": "" if is_proven else _OR_WHEELS}
        found[GYRO_OPPOSITE] = others
    elif wheels_lidar.is_opposite:
        found[LIDAR_OPPOSITE] = {"others": "wheels and gyro" if wheels_gyro.is_equal else "the wheels"}
    if wheels_gyro.unit_ratio > 1.0:
        found[GYRO_UNIT] = {"others": "the wheels", "ratio": wheels_gyro.unit_ratio}
    elif lidar_gyro.unit_ratio:
        found[GYRO_UNIT] = {"others": "the LiDAR", "ratio": lidar_gyro.unit_ratio}
    return found


def _excluded_faults(wheels_gyro: _Relation, wheels_lidar: _Relation, lidar_gyro: _Relation) -> set[SensorFault]:
    """Faults of installation that a window excludes."""
    found: set[SensorFault] = set()
    if wheels_gyro.is_equal or lidar_gyro.is_equal:
        found |= {GYRO_OPPOSITE, GYRO_UNIT}
    if wheels_gyro.is_equal or wheels_lidar.is_equal:
        found.add(WHEELS_OPPOSITE)
    if wheels_lidar.is_equal:
        found.add(LIDAR_OPPOSITE)
    return found


def _is_constant(gyro: FloatArray, wheels: FloatArray) -> bool:
    """Whether the gyro's rates (n,) are one and the same value while the wheels' (n,) turn by something else."""
    both = np.isfinite(gyro) & np.isfinite(wheels)
    n = int(both.sum())
    if n < MIN_BINS or float(np.ptp(gyro[both])) > _REPEATED_RAD_S:
        return False
    off = wheels[both] - gyro[both]
    is_turning = math.sqrt(float(off @ off) / n) > _MAX_BIAS_RAD_S or float(wheels[both].std()) > _MIN_EXCITED_RAD_S
    return is_turning or (n == WINDOW_BINS and float(wheels[both].std()) > _MIN_STUCK_WHEELS_RAD_S)
