"""Estimators by name: dead reckoning, LiDAR alone, the extended Kalman filter that fuses both, and the graph above it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from localization.core.motion import FilterConfig
from localization.core.space import SpaceConfig
from localization.errors import EstimatorError
from localization.estimate import Estimate
from localization.estimators.baselines import DeadReckoning, LidarOdometry
from localization.estimators.estimator import Estimator, LearnedParameter, Residuals
from localization.estimators.fusion import EkfFusion
from localization.estimators.graph_fusion import GraphConfig, GraphFusion
from localization.estimators.map_fusion import MapFusion
from localization.estimators.map_merge import merge_maps
from localization.estimators.saved_map_fusion import PriorMap, SavedMapFusion
from localization.estimators.space_choice import SpaceChoice
from localization.estimators.space_fusion import SpaceFusion
from localization.estimators.space_graph_fusion import SpaceGraphFusion, SpaceGraphSettings
from localization.estimators.space_map_fusion import SpaceMapFusion
from localization.lidar import LidarConfig, ScanMatchingSensor
from localization.maps.space_places import SpacePlaces
from motion_models.base import MotionModel
from motion_models.errors import no_such
from motion_models.online_calibration import Form, make_corrections
from motion_models.robot import Mount, Robot
from motion_models.se2 import Pose2

__all__ = [
    "ESTIMATORS",
    "ESTIMATORS_IN_SPACE",
    "ESTIMATORS_WITH_CORRECTIONS",
    "ESTIMATORS_WITH_MAP",
    "LOCALIZER",
    "Estimate",
    "Estimator",
    "EstimatorConfig",
    "GraphFusion",
    "LearnedParameter",
    "MapFusion",
    "Pose2",
    "PriorMap",
    "Residuals",
    "SavedMapFusion",
    "SpaceChoice",
    "SpaceFusion",
    "SpaceGraphFusion",
    "SpaceGraphSettings",
    "SpaceMapFusion",
    "check_estimator",
    "make_estimator",
    "make_localizing",
    "merge_maps",
]


@dataclass(frozen=True)
class EstimatorConfig:
    """Settings of all estimators."""

    ekf: FilterConfig = field(default_factory=FilterConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    space: SpaceConfig = field(default_factory=SpaceConfig)


ESTIMATORS = ("odometry", "lidar", "ekf", "graph")
LOCALIZER = "map"
"""The estimator that needs a saved map: the filter localized in it."""
ESTIMATORS_WITH_CORRECTIONS = ("ekf", "graph", LOCALIZER)
"""Estimators that correct the motion model on the way."""
ESTIMATORS_IN_SPACE = ("ekf", "graph")
"""Estimators whose poses may be in space."""
ESTIMATORS_WITH_MAP = ("graph", LOCALIZER)
"""Estimators whose poses are ``map_T_body``; the others' are ``odom_T_body``."""


def check_estimator(name: str, has_lidar: bool, has_map: bool = False, no_wheels: str = "") -> None:
    """Raises `EstimatorError` for a name that does not exist, or for one that needs a LiDAR, a saved map or wheels without one.

    ``no_wheels``: why the log has none (`Log.no_wheels`).
    """
    if name == LOCALIZER and not has_map:
        raise EstimatorError(f"the estimator '{LOCALIZER}' needs a saved map. Name one by --map, or use graph.")
    if name not in (*ESTIMATORS, LOCALIZER):
        raise EstimatorError(no_such("estimator", name, ESTIMATORS))
    if name in ("lidar", LOCALIZER) and not has_lidar:
        raise EstimatorError(
            f"the estimator '{name}' needs scans, and there are none in this log. Use odometry, ekf or graph, or pass --topic.scan."
        )
    if no_wheels and name != "lidar":
        instead = "Record the wheels, or use --estimator lidar" if has_lidar else "Record the wheels"
        raise EstimatorError(f"the estimator '{name}' needs wheels: {no_wheels} {instead}.")


def make_estimator(
    name: str,
    model: MotionModel,
    form: Form,
    robot: Robot,
    mounts: Mapping[str, Mount],
    has_lidar: bool,
    config: EstimatorConfig | None = None,
    is_smoothing: bool = False,
) -> Estimator:
    """The estimator ``name`` at the origin, with corrections of ``form``; with ``is_smoothing``, `Estimator.finish` is to give the
    smoothed trajectory. Raises what `check_estimator` and `corrections` do."""
    check_estimator(name, has_lidar)
    config = config or EstimatorConfig()
    if name == "odometry":
        return DeadReckoning(make_corrections(model, "constant"), config.ekf.wheel_radius_sigma)
    if name == "lidar":
        return LidarOdometry(mounts, config.lidar)
    corrected, sensor = make_corrections(model, form), ScanMatchingSensor(mounts, config.lidar) if has_lidar else None
    ekf = EkfFusion(model, corrected, robot, sensor, config.ekf)
    return ekf if name == "ekf" else GraphFusion(ekf, config.lidar, config.graph, is_smoothing)


def make_localizing(
    prior: PriorMap, model: MotionModel, form: Form, robot: Robot, mounts: Mapping[str, Mount], config: EstimatorConfig, is_recording: bool
) -> MapFusion | SpaceMapFusion:
    """The filter localized in ``prior``, in the plane or in space as that is; with ``is_recording``, its keyframes are kept."""
    places, initial = prior.places, prior.initial
    if isinstance(places, SpacePlaces):
        in_space = SpaceFusion(robot.gyro_noise, mounts, config.lidar, config.space)
        return SpaceMapFusion(in_space, places, initial, is_recording)
    sensor = ScanMatchingSensor(mounts, config.lidar)
    return MapFusion(EkfFusion(model, make_corrections(model, form), robot, sensor, config.ekf), places, initial, is_recording)
