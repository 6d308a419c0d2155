"""A gyro that turns against the wheels by more than slip explains: spikes, or another unit."""

from __future__ import annotations

import math
from dataclasses import replace

from localization.events import Step
from localization.sensor_checks.faults import MEMORY_S, FaultLog, SensorFault

GYRO_RATE = SensorFault(
    "impossible_rates.against_wheels",
    reference="wheels",
)
_MAX_RATE_OFF_RAD_S, _MAX_RATE_OFF_SHARE = 2.0, 3.0
"""Difference of the gyro's rate from the wheels' that no slip explains, at least so large and so many times the wheels' rate. On the Husky
outdoors it is 0.22 rad/s at most."""


class GyroRate:
    """Leaves out a gyro whose rates no slip explains, at once, and for the next seconds."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._last_s = -math.inf  # when the rate was last one that no slip explains

    @property
    def is_acting(self) -> bool:
        """The gyro is left out."""
        return self._faults.now_s - self._last_s < MEMORY_S

    def apply(self, step: Step) -> Step:
        """``step`` without the gyro, now and for the next seconds."""
        if step.turn is None:
            return step
        if off := rate_off(step):
            self._last_s = self._faults.now_s
            self._faults.declare(GYRO_RATE, self._last_s, {"rate": off})
        return replace(step, turn=None) if self.is_acting else step


def rate_off(step: Step) -> float:
    """By how much the gyro's rate in ``step`` differs from the wheels', where no slip explains it [rad/s]; else 0."""
    if step.turn is None or not step.has_wheels or step.duration == 0.0 or step.is_standing:
        return 0.0
    by_wheels = float(step.predicted.delta[2]) / step.duration
    off = abs(step.turn.angle / step.duration - by_wheels)
    return off if off > max(_MAX_RATE_OFF_RAD_S, _MAX_RATE_OFF_SHARE * abs(by_wheels)) else 0.0
