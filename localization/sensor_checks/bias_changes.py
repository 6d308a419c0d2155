"""A gyro's bias that has changed between two rests (`localization.core.policies.standstill`)."""

from __future__ import annotations

import math

from localization.estimators import Estimator
from localization.sensor_checks.faults import FaultLog, SensorFault, is_certain

BIAS_CHANGED = SensorFault(
    "the gyro's bias has changed by {degrees:+.1f} deg/s between this rest and the one before. The covariance of what was driven between"
    " them has that. Let the robot stand for a second now and then, and check the IMU's temperature and supply."
)


class BiasChangeCheck:
    """`add` the estimator after steps: changes are declared."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._reported_ns = 0

    def add(self, estimator: Estimator) -> None:
        """Take the last change."""
        change = estimator.bias_change
        if change is None or change.end_ns == self._reported_ns:
            return
        self._reported_ns = change.end_ns
        if is_certain(change.log_evidence):
            self._faults.update(BIAS_CHANGED, 1e-9 * change.end_ns - self._faults.start_s, {"degrees": math.degrees(change.rate)})
