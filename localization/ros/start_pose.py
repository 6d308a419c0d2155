"""``odom_T_estimator`` and ``map_T_estimator``: where an estimator's start is in the frames that are published."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from localization.estimate import Estimate
from localization.space_pose import Pose3
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

    def widened(self, sigma_m: float) -> StartPose:
        """With positions that err by ``sigma_m`` [m] more."""
        if not sigma_m:
            return self
        more = np.diag([sigma_m**2, sigma_m**2, 0.0])
        return replace(self, odom_cov=self.odom_cov + more, map_cov=self.map_cov + more)

    def apply(self, estimate: Estimate) -> Estimate:
        """``estimate``, which is relative to the start, in the published frames; the covariances of start and motion are added. Without
        a map frame the odometry that never jumps is published (REP-105)."""
        if estimate.odometry is not None and estimate.map_T_odom is None:
            estimate = replace(estimate, pose=estimate.odometry[0], covariance=estimate.odometry[1], odometry=None)
        if not any(array.any() for array in (self.odom_T_start, self.odom_cov, self.map_T_start, self.map_cov)):
            return estimate
        if estimate.odometry is None or estimate.map_T_odom is None:
            pose, cov = _moved(self.odom_T_start, self.odom_cov, estimate.pose, estimate.covariance)
            return replace(estimate, pose=pose, covariance=cov, in_space=_placed(self.odom_T_start, self.odom_cov, estimate.in_space))
        odometry = _moved(self.odom_T_start, self.odom_cov, *estimate.odometry)
        pose, cov = _moved(self.map_T_start, self.map_cov, estimate.pose, estimate.covariance)
        map_T_odom = se2.compose(se2.compose(self.map_T_start, estimate.map_T_odom), se2.inverse(self.odom_T_start))
        in_space = _placed(self.odom_T_start, self.odom_cov, estimate.in_space)
        in_map = _placed(self.map_T_start, self.map_cov, estimate.in_map)
        moved = replace(estimate, pose=pose, covariance=cov, odometry=odometry, map_T_odom=map_T_odom)
        return replace(moved, in_space=in_space, in_map=in_map)


def _placed(world_T_start: FloatArray, start_cov: FloatArray, pose: Pose3 | None) -> Pose3 | None:
    return None if pose is None else pose.placed(world_T_start, start_cov)


def _moved(
    world_T_start: FloatArray, start_cov: FloatArray, start_T_body: FloatArray, cov: FloatArray | None
) -> tuple[FloatArray, FloatArray | None]:
    """``world_T_body`` and its covariance: an error of the start reaches the body by Ad(start_T_body^-1)."""
    A = se2.adjoint(se2.inverse(start_T_body))
    return se2.compose(world_T_start, start_T_body), None if cov is None else cov + A @ start_cov @ A.T
