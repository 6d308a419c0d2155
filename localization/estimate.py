"""What an estimator gives: pose and twist of the body at one moment; and what it has learned of wheels and gyro."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.events import Turn
from localization.space_pose import Pose3
from motion_models.se2 import Cov3, FloatArray, Pose2, Twist2


@dataclass(frozen=True)
class Estimate:
    """Pose and twist of the body at one moment."""

    stamp_ns: int
    pose: Pose2
    """(3,) ``world_T_body`` [m, m, rad]."""
    covariance: Cov3 | None
    """(3, 3) of its right perturbation; None where the estimator has none."""
    twist: Twist2
    """(3,) vx, vy, wz in the body frame."""
    twist_covariance: Cov3 | None
    """(3, 3)"""
    nis: float | None = None
    """Normalised innovation squared of this step's LiDAR measurement, 3 degrees of freedom; None where there was none."""
    odometry: tuple[Pose2, Cov3 | None] | None = None
    """``odom_T_body`` (3,) and its covariance (3, 3), where ``pose`` jumps: it is ``map_T_body``, or nothing holds it without a LiDAR."""
    map_T_odom: Pose2 | None = None
    """(3,) what loop closures and positions have corrected; None where ``pose`` is in the odometry frame."""
    in_space: Pose3 | None = None
    """``odom_T_body`` of an estimator of poses in space, of which ``pose`` or ``odometry`` is the one seen from above."""
    in_map: Pose3 | None = None
    """``map_T_body`` in a saved map in space, of which ``pose`` is the one seen from above."""

    def widened(self, spread: Cov3) -> Estimate:
        """With the covariance ``spread`` (3, 3) of the pose besides."""
        odometry = self.odometry
        if odometry is not None and odometry[1] is not None:
            odometry = odometry[0], odometry[1] + spread
        return replace(self, covariance=None if self.covariance is None else self.covariance + spread, odometry=odometry)


class WheelCalibration(NamedTuple):
    """Estimated parameters of the motion model and radius of the wheels."""

    params: FloatArray
    """(k,)"""
    params_cov: FloatArray
    """(k, k)"""
    radius: float = 1.0
    """Factor on all ways."""
    radius_variance: float = 0.0

    def correct(self, twists: FloatArray) -> FloatArray:
        """Twists (..., 3) by the motion model with the radius that the wheels have."""
        return np.asarray(twists * np.array([self.radius, self.radius, 1.0]))

    def cov_of(self, moved: FloatArray, by_params: FloatArray) -> FloatArray:
        """(3, 3) of a twist or motion ``moved`` (3,) by the errors of both; ``by_params`` (3, k): its derivative by the parameters."""
        cov: FloatArray = by_params @ self.params_cov @ by_params.T
        way = moved[:2]
        cov[:2, :2] += self.radius_variance * way[:, None] * way
        return cov


class GyroCalibration(NamedTuple):
    """Estimated bias and scale of the gyro."""

    bias: float
    """[rad/s]"""
    scale: float
    bias_variance: float
    """[rad^2/s^2]"""
    scale_variance: float

    def correct_rate(self, turn: Turn) -> tuple[float, float] | None:
        """Turn rate at the end of ``turn`` and its variance [rad/s, rad^2/s^2]; None where it has none."""
        if turn.rate is None:
            return None
        rate = (turn.rate - self.bias) / (1.0 + self.scale)
        return rate, turn.rate_variance + self.bias_variance + rate**2 * self.scale_variance

    def correct_angle(self, turn: Turn) -> tuple[float, float]:
        """Angle of ``turn`` and its variance [rad, rad^2]."""
        angle, dt = (turn.angle - self.bias * turn.duration) / (1.0 + self.scale), turn.duration
        return angle, turn.variance + dt**2 * self.bias_variance + angle**2 * self.scale_variance
