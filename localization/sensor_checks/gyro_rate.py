"""Rates of the gyro that no slip explains: it is left out at once."""

from __future__ import annotations

import math
from dataclasses import replace

from localization.events import Step
from localization.sensor_checks.faults import MEMORY_S, FaultLog, SensorFault
from localization.sensor_checks.sensor_check import SensorCheck

GYRO_RATE = SensorFault(
    "the gyro turns by {rate:.1f} rad/s against the wheels, more than slip explains. It is not used for 3 s after each time. Check"
    " the units of the IMU's driver.",
    reference="wheels",
)

_MAX_RATE_OFF_RAD_S, _MAX_RATE_OFF_SHARE = 2.0, 3.0
"""Difference of the gyro's rate from the wheels' that no slip explains, at least so large and so many times the wheels' rate. On the Husky
outdoors it is 0.22 rad/s at most."""


class GyroRate(SensorCheck):
    """Needs the wheels as they were measured: stands before the checks that leave them out."""

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
