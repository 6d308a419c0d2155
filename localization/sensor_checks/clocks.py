"""Clocks of two sensors that are apart, where no third one shows which is off.

The filter learns by how much the wheels' stamps are late against the LiDAR's, or the gyro's, whose clock the poses have. If that clock is
the one that is off, what is published for t is the pose at t - late: an error of the body by its twist times that time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from localization.estimators import Estimator
from localization.messages import Message, Value
from localization.sensor_checks.faults import FaultLog, SensorFault

CLOCKS_APART = SensorFault(
    "clocks_of_two.apart",
)


def apart(other: Literal["gyro", "LiDAR"], late_s: float, wheels_s: float, other_s: float) -> Message:
    """That the wheels' stamps are later than the ``other`` sensor's by ``late_s`` [s]; ``wheels_s`` and ``other_s`` are the offsets that
    correct either [s]."""
    return CLOCKS_APART.describe(_numbers(other, late_s, wheels_s, other_s))


def _numbers(other: Literal["gyro", "LiDAR"], late_s: float, wheels_s: float, other_s: float) -> dict[str, Value]:
    direction = "later" if late_s > 0.0 else "earlier"
    return {"other": other, "role": other.lower(), "seconds": abs(late_s), "direction": direction, "late": wheels_s, "early": other_s}


class ClockCheck:
    """`add` the estimator after steps: clocks that are apart inflate the covariance while the robot moves, and are declared where that is
    no latency."""

    def __init__(self, faults: FaultLog, sigma_s: float) -> None:
        """``sigma_s``: by how much the clock of the poses may be off, whatever the drive shows [s]."""
        self._faults, self._sigma_s = faults, sigma_s
        faults.path = replace(faults.path, late_s=sigma_s)
        self._reported_s = 0.0

    def add(self, estimator: Estimator) -> None:
        """Take the clock offset after a step."""
        apart = estimator.clocks_apart
        late_s = 0.0 if apart is None else round(apart.late_s, 2)
        unsure_s = max(self._sigma_s, abs(late_s))
        if unsure_s != self._faults.path.late_s:
            self._faults.path = replace(self._faults.path, late_s=unsure_s)
        if apart is None or apart.is_latency or late_s == self._reported_s:
            return
        self._reported_s = late_s
        self._faults.update(CLOCKS_APART, 0.0, _numbers(apart.other, late_s, late_s, -late_s))
