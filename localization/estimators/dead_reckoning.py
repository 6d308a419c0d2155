"""Dead reckoning: the motion model on the wheels and nothing else. The yardstick of everything that claims to help."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from localization.estimators.base import NO_POINTS, Estimate, mean_twist
from localization.events import PositionSample
from localization.step import Step
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.se2 import FloatArray


class DeadReckoning:
    """Composes the predicted motions; the covariance follows P' = Ad(delta^-1) P Ad(delta^-1)^T + Q."""

    clock_offset_s = 0.0
    params = None
    lost = None

    def __init__(self) -> None:
        self._pose, self._cov = np.zeros(3), np.zeros((3, 3))

    def step(self, step: Step) -> Estimate:
        motion = step.predicted
        A = se2.adjoint(se2.inverse(motion.delta))
        self._pose = se2.compose(self._pose, motion.delta)
        self._cov = A @ self._cov @ A.T + motion.cov
        twist, twist_cov = mean_twist(motion.delta, motion.cov, step.duration) if step.duration > 0 else (step.twist, None)
        return Estimate(step.end_ns, self._pose, self._cov, twist, twist_cov)

    def run_deferred(self) -> None:
        return None

    def add_position(self, sample: PositionSample) -> None:
        return None

    def finish(self, moments: Trajectory | None = None) -> None:
        return None

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        return {}

    def counts(self) -> Mapping[str, int]:
        return {}

    def map_points(self) -> FloatArray:
        return NO_POINTS
