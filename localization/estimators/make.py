"""The estimators by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from localization.errors import EstimatorError
from localization.estimators.base import Estimator
from localization.estimators.dead_reckoning import DeadReckoning
from localization.estimators.filter import FilterConfig
from localization.estimators.fusion import EkfFusion, make_sensor
from localization.estimators.lidar_odometry import LidarOdometry
from localization.lidar import LidarConfig
from motion_models.base import MotionModel
from motion_models.corrections import Corrections, Form, corrections
from motion_models.robot import Mount, Robot


@dataclass(frozen=True)
class EstimatorConfig:
    """Settings of all estimators."""

    ekf: FilterConfig = field(default_factory=FilterConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)


_Maker = Callable[[MotionModel, Corrections, Robot, Mapping[str, Mount], bool, EstimatorConfig, bool], Estimator]

ESTIMATORS: Mapping[str, _Maker] = {
    "odometry": lambda model, corrected, robot, mounts, has_lidar, config, hindsight: DeadReckoning(),
    "lidar": lambda model, corrected, robot, mounts, has_lidar, config, hindsight: LidarOdometry(mounts, config.lidar),
    "ekf": lambda model, corrected, robot, mounts, has_lidar, config, hindsight: EkfFusion(
        model, corrected, robot, make_sensor(mounts, config.lidar, has_lidar), config.ekf
    ),
}

CORRECTING = ("ekf", "graph")
"""Those that correct the motion model on the way."""


def check_estimator(name: str, has_lidar: bool) -> None:
    """Raises `EstimatorError` for a name that does not exist, or for one that needs a LiDAR without one."""
    if name not in ESTIMATORS:
        raise EstimatorError(f"no estimator '{name}'; there are {', '.join(ESTIMATORS)}.")
    if name == "lidar" and not has_lidar:
        raise EstimatorError(
            "the estimator 'lidar' needs scans, and there are none in this log. Use odometry, ekf or graph, or pass --topic.scan."
        )


def make_estimator(
    name: str,
    model: MotionModel,
    form: Form,
    robot: Robot,
    mounts: Mapping[str, Mount],
    has_lidar: bool,
    config: EstimatorConfig | None = None,
    hindsight: bool = False,
) -> Estimator:
    """The estimator ``name`` at the origin, with corrections of ``form``; with ``hindsight``, it will be asked for what the whole log
    tells of each moment (`Estimator.finish`). Raises what `check_estimator` and `corrections` do."""
    check_estimator(name, has_lidar)
    return ESTIMATORS[name](model, corrections(model, form), robot, mounts, has_lidar, config or EstimatorConfig(), hindsight)
