"""Where an estimator began: a pose that a user or a map gave, applied to all that is estimated from there."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from localization.estimators import Estimate
from motion_models import se2
from motion_models.se2 import FloatArray


def _origin() -> FloatArray:
    return np.zeros(3)


def _no_cov() -> FloatArray:
    return np.zeros((3, 3))


@dataclass(frozen=True)
class StartPose:
    """Start frame of an estimator in the frames that are published. Estimators begin at zero, with zero covariance."""

    odom_T_start: FloatArray = field(default_factory=_origin)
    """(3,)"""
    odom_cov: FloatArray = field(default_factory=_no_cov)
    """(3, 3) of its right perturbation."""
    map_T_start: FloatArray = field(default_factory=_origin)
    """(3,) of estimators that localize in a map."""
    map_cov: FloatArray = field(default_factory=_no_cov)
    """(3, 3) of its right perturbation."""

    def apply(self, estimate: Estimate) -> Estimate:
        """``estimate``, which is relative to the start, in the published frames; the covariances of start and motion are added."""
        if not any(array.any() for array in (self.odom_T_start, self.odom_cov, self.map_T_start, self.map_cov)):
            return estimate
        if estimate.odometry is None or estimate.map_T_odom is None:
            pose, cov = _moved(self.odom_T_start, self.odom_cov, estimate.pose, estimate.covariance)
            return replace(estimate, pose=pose, covariance=cov)
        odometry = _moved(self.odom_T_start, self.odom_cov, *estimate.odometry)
        pose, cov = _moved(self.map_T_start, self.map_cov, estimate.pose, estimate.covariance)
        map_T_odom = se2.compose(se2.compose(self.map_T_start, estimate.map_T_odom), se2.inverse(self.odom_T_start))
        return replace(estimate, pose=pose, covariance=cov, odometry=odometry, map_T_odom=map_T_odom)


def _moved(
    world_T_start: FloatArray, start_cov: FloatArray, start_T_body: FloatArray, cov: FloatArray | None
) -> tuple[FloatArray, FloatArray | None]:
    """``world_T_body`` and its covariance: an error of the start reaches the body by Ad(start_T_body^-1)."""
    A = se2.adjoint(se2.inverse(start_T_body))
    return se2.compose(world_T_start, start_T_body), None if cov is None else cov + A @ start_cov @ A.T
