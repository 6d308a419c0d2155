"""Interface of the estimators: a step in, an estimate out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from localization.core.policies.clock_offset import ClocksApart
from localization.core.policies.standstill import BiasChange
from localization.events import PositionSample, Step, Turn
from localization.lidar import LostScans
from localization.lifting import Pose3, Trajectory3
from localization.maps import KeyframeMap, SpaceMap
from localization.maps.grid import Grid
from localization.trajectory import Trajectory
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2, Twist2

NO_POINTS = np.empty((0, 2))


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


class LearnedParameter(NamedTuple):
    """A parameter of the motion model that an estimator has learned, and the robot file's value of it."""

    name: str
    value: float
    sigma: float
    file_value: float
    prior_sigma: float
    """Standard deviation of the true value from the robot file's."""
    owner: str = "the robot"
    """The motion model that has the parameter, where it is no property of the robot."""


class Residuals(NamedTuple):
    """Disagreement of the measurements of the last step, for the sensor checks."""

    turn: tuple[float, float] | None
    """Innovation of the gyro by what wheels and all measurements so far predict, and its variance [rad, rad^2]; None without a gyro."""
    file_delta: Pose2
    """(3,) motion by the wheels with the robot file's parameters."""
    scan_turn: tuple[float, float] | None = None
    """Innovation of the matched scan's yaw by what all other measurements predict, and its variance [rad, rad^2]; None without a scan."""
    scan_way: tuple[float, float] | None = None
    """Innovation of the matched scan's way ahead, and its variance [m, m^2]."""
    bias_sigma: float = 0.0
    """Standard deviation of the gyro's bias by a prior that no rest has tested [rad/s]; 0 once one has."""


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


class Estimator(ABC):
    """State inside; one `step` after the other, then `finish`. The defaults are those of an estimator without map and corrections."""

    @abstractmethod
    def step(self, step: Step) -> Estimate:
        """Return the estimate at the end of ``step``. Work that can wait until it is published waits for `run_deferred`."""

    def run_deferred(self) -> bool:
        """Do the work that waits; otherwise `step` and `finish` do it first. Its results are in the next estimate. Whether it has changed
        `params`."""
        return False

    def add_position(self, sample: PositionSample) -> None:
        """Add a measured position; estimators without a map frame leave it out."""
        return

    def finish(self, filtered: Trajectory | None = None) -> Trajectory | None:
        """Return the smoothed trajectory, or None where the estimator does not smooth.

        ``filtered``: the estimates as they were published, which the estimator does not store. Raises `EstimatorError`."""
        self.run_deferred()
        return None

    @property
    def smoothed_in_space(self) -> Trajectory3 | None:
        """Smoothed poses in space, after `finish`; None where the estimator has none."""
        return None

    @property
    def clock_offset_s(self) -> float:
        """Estimated offset of the wheels' stamps [s]: what happened at t is stamped t + offset."""
        return 0.0

    @property
    def clocks_apart(self) -> ClocksApart | None:
        """Clocks of two sensors alone that are certainly apart; None where they are not, or a third sensor shows whose is off."""
        return None

    @property
    def bias_change(self) -> BiasChange | None:
        """The last change of the gyro's bias between two rests that is a fault; None where there was none."""
        return None

    @property
    def params(self) -> FloatArray | None:
        """(k,) estimated parameters of the motion model, or None where nothing corrects them."""
        return None

    @property
    def lost(self) -> LostScans | None:
        """Scans that could not be matched to a map; None where the estimator matches none."""
        return None

    @property
    def gyro_calibration(self) -> GyroCalibration | None:
        """Bias and scale of the gyro; None where it was not used in the last step."""
        return None

    @property
    def residuals(self) -> Residuals | None:
        """Residuals of the last step; None where measurements are not fused."""
        return None

    def learned_parameters(self) -> Sequence[LearnedParameter]:
        """The motion model's parameters that are corrected, against the robot file."""
        return ()

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Mean and sigma of what was estimated besides the pose, by name."""
        return {}

    def counts(self) -> Mapping[str, int]:
        """Number of occurrences by name: scans, matched, searched, loops."""
        return {}

    def warnings(self) -> list[str]:
        """Problems of the measurements so far."""
        return []

    def keyframe_map(self) -> KeyframeMap | SpaceMap | None:
        """Keyframes as they can be saved; None where the estimator has no map frame. Poses are smoothed after `finish`."""
        return None

    def localization(self) -> Mapping[str, Any] | None:
        """State, probability and places in a saved map so far, as JSON holds them; None where there is none."""
        return None

    def occupancy(self) -> Grid | None:
        """The map as a grid with free space, in the frame of the poses; None where there are points alone."""
        return None

    def map_points(self) -> Points2:
        """(M, 2) points of the map in the world [m]."""
        return NO_POINTS
