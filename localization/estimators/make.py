"""The estimators by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from localization.errors import EstimatorError
from localization.estimators.base import Estimator
from localization.estimators.dead_reckoning import DeadReckoning
from localization.estimators.ekf import EkfConfig
from localization.estimators.fusion import EkfFusion
from localization.estimators.lidar_alone import LidarAlone
from localization.lidar import LidarConfig
from motion_models.base import MotionModel
from motion_models.corrections import Form, corrections
from motion_models.robot import Mount, Robot


@dataclass(frozen=True)
class EstimatorConfig:
    """Settings of all estimators."""

    ekf: EkfConfig = field(default_factory=EkfConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    corrections: Form = "constant"
    """What the filter learns of the motion model: nothing, or its k and centre of rotation as slowly changing constants."""


_Maker = Callable[[MotionModel, Robot, Mapping[str, Mount], bool, EstimatorConfig], Estimator]

ESTIMATORS: Mapping[str, _Maker] = {
    "odometry": lambda model, robot, mounts, has_lidar, config: DeadReckoning(),
    "lidar": lambda model, robot, mounts, has_lidar, config: LidarAlone(mounts, config.lidar),
    "ekf": lambda model, robot, mounts, has_lidar, config: EkfFusion(
        model, corrections(model, config.corrections), robot, mounts, has_lidar, config.ekf, config.lidar
    ),
}


def check_estimator(name: str, has_lidar: bool) -> None:
    """Raises `EstimatorError` for a name that does not exist, or for one that needs a LiDAR without one."""
    if name not in ESTIMATORS:
        raise EstimatorError(f"no estimator '{name}'; there are {', '.join(ESTIMATORS)}.")
    if name == "lidar" and not has_lidar:
        raise EstimatorError("the estimator 'lidar' needs scans, and there are none in this log. Use odometry or ekf, or pass --topic.scan.")


def make_estimator(
    name: str, model: MotionModel, robot: Robot, mounts: Mapping[str, Mount], has_lidar: bool, config: EstimatorConfig | None = None
) -> Estimator:
    """The estimator ``name`` at the origin. Raises what `check_estimator` does."""
    check_estimator(name, has_lidar)
    return ESTIMATORS[name](model, robot, mounts, has_lidar, config or EstimatorConfig())
