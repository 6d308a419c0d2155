"""Interface of the estimators: a step in, an estimate out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from localization.core.policies.clock_offset import ClocksApart
from localization.core.policies.standstill import BiasChange
from localization.estimate import Estimate, GyroCalibration, WheelCalibration
from localization.events import PositionSample, Step
from localization.lidar import LostScans
from localization.lifting import Trajectory3
from localization.maps import KeyframeMap
from localization.maps.grid import Grid
from localization.messages import Message
from localization.trajectory import Trajectory
from motion_models.se2 import FloatArray, Points2, Pose2

NO_POINTS = np.empty((0, 2))


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
    """Standard deviation of the gyro's bias [rad/s]: by the filter, and by a prior that no rest has tested."""


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
    def wheel_calibration(self) -> WheelCalibration | None:
        """Parameters of the motion model and radius of the wheels; None where nothing corrects them."""
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

    def warnings(self) -> list[Message]:
        """Problems of the measurements so far."""
        return []

    def keyframe_map(self) -> KeyframeMap | None:
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
