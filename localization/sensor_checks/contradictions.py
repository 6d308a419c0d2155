"""Sensors that contradict the others: which comparison shows which fault, and for how long it must.

Of three sensors the one that contradicts the two others is at fault, of wheels and another one that other. Gyro or scans are left out then,
wheels count as unknown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from localization.sensor_checks.comparison import MAX_RATIO, OPPOSITE_RAD, SLIDE_RAD, TURN, UNKNOWN, WAY, Comparison, Gain, Quantity, Sensor
from localization.sensor_checks.faults import MEMORY_S, Evidence, FaultLog, SensorFault
from localization.sensor_checks.gyro_rate import GYRO_RATE
from localization.sensor_checks.window import WINDOW_BINS, Bins, Window

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
    "the gyro repeats one value while the wheels turn. It is not used as long as that lasts. Check the IMU and its driver.",
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
LIDAR_DIRECTION = SensorFault(
    "by the LiDAR the robot travels {degrees:.0f} deg to the {side} of where the wheels drive. Its scans are not used while that lasts."
    " Correct the yaw of its frame by {correction:+.0f} deg in /tf_static or in the robot file's [mounts].",
    reference="wheels and gyro",
    is_of_scans=True,
)
_OR_WHEELS = ", or, as nothing else measures turns, the robot file's [joints]: left and right may be swapped, or all wheels count backwards"

_WHEELS_GYRO, _WHEELS_LIDAR = Comparison(TURN, "wheels", "gyro"), Comparison(TURN, "wheels", "LiDAR")
_LIDAR_GYRO, _WAYS = Comparison(TURN, "LiDAR", "gyro"), Comparison(WAY, "wheels", "LiDAR")

_MAX_SLIDE_RAD = math.radians(20.0)
"""Directions that no slide explains are compared over seconds: 99.9 % of the windows of CSAIL, fr079 and ACES are below 17 deg. Windows
of 3 s would take a time for a turned LiDAR in which the wheels of fr079 count backwards as forwards (6 s, ATE .13 -> .18 m)."""
_SLIDE_S = 120.0
"""A robot that slides has a direction of travel that is wrong (fr079: 14 deg for 7 s); it is compared over two minutes."""
_DEG_PER_RAD = 12.0, 130.0
"""Ratio of the gyro's turn rates to others that only a wrong unit explains: 57.3, with the factor of 0.45 to 2.3 by which wheels may be off
on loose floor, and half of it while half of the window is of before the fault."""


_REPEATED_RAD_S = 1e-7
"""A gyro's mean rates never repeat to the last digit, but for its noise [rad/s]."""
_MIN_STUCK_OFF_RAD_S, _MIN_STUCK_WHEELS_RAD_S = 0.05, 0.002
"""A gyro that repeats is stuck where the wheels turn by something else, which its bias (ten prior sigmas of the shipped robots) does not
explain; over a whole window, where the wheels turn at all [rad/s]."""


class Symptom(NamedTuple):
    """What shows a fault: two sensors whose directions differ, or whose scales do."""

    fault: SensorFault
    sensor: Sensor
    """Which is at fault, and is not used."""
    comparison: Comparison
    beyond: float = OPPOSITE_RAD
    """Direction that shows it [rad]."""
    least: float = 0.5 / MAX_RATIO
    """Scale below which no direction shows it: a gyro that turns the other way by a tenth of the wheels is no reversed one. Half of the
    window may be of before the fault."""
    ratios: tuple[float, float] | None = None
    """Scale that shows it, in place of the direction."""
    are_wheels_outvoted: bool | None = None
    """Whether LiDAR and gyro agree; None where that does not matter."""
    memory_s: float = MEMORY_S
    """Time of which most comparisons show it [s]."""

    def is_shown(self, gains: Mapping[Comparison, Gain]) -> bool:
        """Whether ``gains`` show it."""
        gain, outvoted = gains[self.comparison], gains[_LIDAR_GYRO].is_equal
        if self.are_wheels_outvoted is not None and self.are_wheels_outvoted != outvoted:
            return False
        if self.ratios is not None:
            return gain.bound <= math.pi - OPPOSITE_RAD and self.ratios[0] <= gain.scale <= self.ratios[1]
        return abs(gain.angle) - gain.bound > self.beyond and gain.scale > self.least


SYMPTOMS = (
    Symptom(WHEELS_OPPOSITE, "wheels", _WHEELS_GYRO, are_wheels_outvoted=True),
    Symptom(GYRO_OPPOSITE, "gyro", _WHEELS_GYRO, are_wheels_outvoted=False),
    Symptom(LIDAR_OPPOSITE, "LiDAR", _WHEELS_LIDAR, are_wheels_outvoted=False),
    Symptom(GYRO_UNIT, "gyro", _WHEELS_GYRO, ratios=_DEG_PER_RAD, are_wheels_outvoted=False),
    Symptom(GYRO_UNIT, "gyro", _LIDAR_GYRO, ratios=_DEG_PER_RAD),
    Symptom(GYRO_UNIT, "gyro", _LIDAR_GYRO, ratios=(1.0 / _DEG_PER_RAD[1], 1.0 / _DEG_PER_RAD[0])),
    Symptom(LIDAR_DIRECTION, "LiDAR", _WAYS, beyond=SLIDE_RAD, memory_s=_SLIDE_S),
    Symptom(LIDAR_DIRECTION, "LiDAR", _WAYS, beyond=_MAX_SLIDE_RAD),
)
_COMPARISONS = (_WHEELS_GYRO, _WHEELS_LIDAR, _LIDAR_GYRO, _WAYS)


class Contradictions:
    """`compare` at each bin of the window; `excluded` are the sensors that contradict the others in most comparisons of late."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults, self._stuck = faults, Evidence()
        self._evidence = [Evidence(symptom.memory_s) for symptom in SYMPTOMS]
        self._is_any_shown = False  # by the last comparison

    def compare(self, window: Window) -> bool:
        """Declare faults that last; whether turns of two sensors are equal, ways are where there are scans, and nothing contradicts."""
        gains = {each: each.gain(window.bins) if window.has_gyro or "gyro" not in each else UNKNOWN for each in _COMPARISONS}
        equal: dict[Quantity, set[Sensor]] = {TURN: set(), WAY: set()}  # sensors that agree with another one
        for comparison, gain in gains.items():
            if gain.is_equal:
                equal[comparison.quantity] |= {comparison.first, comparison.second}
        agree = bool(equal[TURN]) and (bool(equal[WAY]) or not window.has_scans)
        self._is_any_shown = window.has_gyro and is_repeating(window.bins)
        self._stuck.add(self._is_any_shown, window.end_s, window.begin_s)
        for symptom, evidence in zip(SYMPTOMS, self._evidence, strict=True):
            is_shown = symptom.is_shown(gains)
            is_refuted = symptom.sensor in equal[symptom.comparison.quantity]
            evidence.add(True if is_shown else False if is_refuted else None, window.end_s, window.begin_s)
            if is_shown and evidence.is_lasting and evidence.is_majority:
                self._faults.declare(symptom.fault, evidence.since_s, _numbers(symptom, gains))
            self._is_any_shown |= is_shown
        if self._stuck.is_lasting and self._stuck.is_majority:
            self._faults.declare(GYRO_STUCK, self._stuck.since_s, {})
        return agree and not self._is_any_shown

    @property
    def is_acting(self) -> bool:
        """Sensors are left out, or may have to be soon."""
        return self._is_any_shown or bool(self._faults.declared and self.excluded)

    @property
    def excluded(self) -> set[Sensor]:
        """Sensors that are not to be used now."""
        declared, pairs = self._faults.declared, zip(SYMPTOMS, self._evidence, strict=True)
        found = {symptom.sensor for symptom, evidence in pairs if symptom.fault in declared and evidence.is_majority}
        return found | {"gyro"} if GYRO_STUCK in declared and self._stuck.is_majority else found


def _numbers(symptom: Symptom, gains: Mapping[Comparison, Gain]) -> dict[str, float | str]:
    """Numbers of the fault's message."""
    gain = gains[symptom.comparison]
    others = next(each for each in _COMPARISONS if each.quantity is TURN and symptom.sensor not in each)
    is_proven, degrees = gains[others].is_equal, math.degrees(gain.angle)
    alone = next(each for each in symptom.comparison[1:] if each != symptom.sensor)
    return {
        "others": f"{others.first} and {others.second}" if is_proven else f"the {alone}",
        "or_wheels": "" if is_proven else _OR_WHEELS,
        "ratio": gain.scale,
        "degrees": abs(degrees),
        "side": "left" if degrees > 0.0 else "right",
        "correction": -degrees,
    }


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
