"""What estimators of poses in a map have from the filter that is their odometry, in the plane or in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Generic, TypeVar

from localization.core.policies.clock_offset import ClocksApart
from localization.core.policies.standstill import BiasChange
from localization.estimate import GyroCalibration, WheelCalibration
from localization.estimators.estimator import Estimator, LearnedParameter, Residuals
from localization.lidar import LostScans
from motion_models.se2 import FloatArray

Filter = TypeVar("Filter", bound=Estimator)


class FilteredOdometry(Estimator, Generic[Filter]):
    """An estimator of poses in a map, whose odometry and learned states are those of a filter."""

    odometry: Filter

    @property
    def clock_offset_s(self) -> float:
        """Estimated offset of the wheels' clock [s]."""
        return self.odometry.clock_offset_s

    @property
    def clocks_apart(self) -> ClocksApart | None:
        """See `Estimator.clocks_apart`."""
        return self.odometry.clocks_apart

    @property
    def bias_change(self) -> BiasChange | None:
        """See `Estimator.bias_change`."""
        return self.odometry.bias_change

    @property
    def params(self) -> FloatArray | None:
        """Parameters of the motion model with their corrections."""
        return self.odometry.params

    @property
    def wheel_calibration(self) -> WheelCalibration | None:
        """See `Estimator.wheel_calibration`."""
        return self.odometry.wheel_calibration

    @property
    def gyro_calibration(self) -> GyroCalibration | None:
        """See `Estimator.gyro_calibration`."""
        return self.odometry.gyro_calibration

    @property
    def lost(self) -> LostScans | None:
        """See `Estimator.lost`."""
        return self.odometry.lost

    @property
    def residuals(self) -> Residuals | None:
        """See `Estimator.residuals`."""
        return self.odometry.residuals

    def learned_parameters(self) -> Sequence[LearnedParameter]:
        """See `Estimator.learned_parameters`."""
        return self.odometry.learned_parameters()

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """See `Estimator.parameters`."""
        return self.odometry.parameters()
