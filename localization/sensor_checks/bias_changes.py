"""A gyro's bias that has changed between two rests (`localization.core.policies.standstill`)."""

from __future__ import annotations

import math

from localization.estimators import Estimator
from localization.sensor_checks.faults import FaultLog, SensorFault, is_certain

BIAS_CHANGED = SensorFault(
    "bias_change.between_rests",
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
