"""Dead reckoning: the motion model on the wheels and nothing else. The baseline of all others."""

from __future__ import annotations

import numpy as np

from localization.estimators.base import Estimate, Estimator, mean_twist
from localization.step import Step
from motion_models import se2


class DeadReckoning(Estimator):
    """Composes the predicted motions; the covariance follows P' = Ad(delta^-1) P Ad(delta^-1)^T + Q."""

    def __init__(self) -> None:
        self._pose, self._cov = np.zeros(3), np.zeros((3, 3))

    def step(self, step: Step) -> Estimate:
        """As `Estimator.step`."""
        motion = step.predicted
        A = se2.adjoint(se2.inverse(motion.delta))
        self._pose = se2.compose(self._pose, motion.delta)
        self._cov = A @ self._cov @ A.T + motion.cov
        twist, twist_cov = mean_twist(motion.delta, motion.cov, step.duration) if step.duration > 0 else (step.twist, None)
        return Estimate(step.end_ns, self._pose, self._cov, twist, twist_cov)
