"""Settings of a live run: the options of the command `online` and the parameters of the ROS 2 node."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from localization.errors import SettingError
from localization.estimators import check_estimator
from localization.logs.topic_roles import TopicOverrides
from localization.pipeline import ReplayConfig, Trial
from localization.ros.session_files import Files
from localization.ros.topic_names import Names
from localization.settings import Positive, Settings
from motion_models.online_calibration import check_forms
from motion_models.registry import make_model
from motion_models.robot import Robot, load_robot


@dataclass(frozen=True)
class Frames(Settings):
    """Frames of what is published (REP-105)."""

    map_frame: str = "map"
    """Frame of a graph's localization, parent of `odom_frame`; other estimators have none."""
    odom_frame: str = "odom"
    """Parent frame of the published odometry and transform, without jumps."""
    base_link_frame: str = "base_link"
    """Frame of the robot's body, child of `odom_frame`; the point about which the robot file's geometry is given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        frames = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for name, frame in frames.items():
            if not frame or frame.startswith("/") or frame != frame.strip():
                raise SettingError(f"setting {name} is '{frame}'; it must not be empty, begin with '/', or have blanks around it.")
        for (name, frame), (other, same) in itertools.combinations(frames.items(), 2):
            if frame == same:
                raise SettingError(f"{name} and {other} are both '{frame}'; they must be two frames.")


@dataclass(frozen=True)
class NodeConfig(Settings):
    """How a node waits, predicts and publishes."""

    wait_s: float = 5.0
    """How long topics that are published are waited for before a start without them, and how often silence is reported [s]."""
    tf: bool = True
    """Publish the transforms `odom_frame` -> `base_link_frame` and, of a graph, `map_frame` -> `odom_frame`; false where others do."""
    predict: bool = True
    """Publish transforms and `~/odometry_predicted` with every wheel message, predicted from the last estimate by the motion model; false:
    transforms with each estimate alone."""
    max_latency_s: Positive = 0.1
    """Diagnostics warn where estimates come later than this after their scan [s], and report an error at ten times as much."""
    path_period_s: float = 5.0
    """Time between two messages on `~/path` [s]; 0: none."""
    map_period_s: float = 10.0
    """Time between two messages on `~/map` [s]; 0: none."""
    diagnose_every_min: Annotated[float, tyro.conf.arg(aliases=["--diagnose-every"])] = 5.0
    """Minutes between two diagnoses of the last two minutes, which a process of lowest priority makes and diagnostics report; 0: none."""
    use_sim_time: bool = False
    """Take the time from /clock, as of a simulator or `ros2 bag play --clock`."""
    frames: Frames = field(default_factory=Frames)
    names: Names = field(default_factory=Names)


@dataclass(frozen=True)
class LiveRun:
    """What a node runs: robot, estimator, files and topics."""

    robot: Robot
    make_trial: Callable[[bool], Trial]
    """Motion model and estimator, given whether there is a LiDAR."""
    files: Files = field(default_factory=Files)
    topics: TopicOverrides = field(default_factory=TopicOverrides)
    config: ReplayConfig = field(default_factory=ReplayConfig)
    node: NodeConfig = field(default_factory=NodeConfig)

    def resolve_topics(self) -> LiveRun:
        """The same with all topics as namespace and remapping rules name them."""
        names = self.node.names
        return dataclasses.replace(self, robot=names.apply_to_robot(self.robot), topics=names.apply_to_overrides(self.topics))


@dataclass(frozen=True)
class OnlineSettings:
    """Robot, estimator, files and topics."""

    robot: str
    """Name of a shipped robot, or path of a robot TOML file."""
    model: str = "skid_steer"
    """Motion model."""
    estimator: str = "ekf"
    """Estimator."""
    corrections: str = "constant"
    """What ekf and graph learn of the motion model: none, constant or cg_field."""
    out: Path | None = None
    """New trajectory file, .tum, or .mcap with Odometry, TF and covariances. It gets its name at the end."""
    state: Path | None = None
    """File of the estimator's state, at most a second old; resumed at the start if it is there. Removed at the end of a log."""
    node: NodeConfig = field(default_factory=NodeConfig)
    topic: TopicOverrides = field(default_factory=TopicOverrides)
    config: ReplayConfig = field(default_factory=ReplayConfig)

    def files(self) -> Files:
        """Raises `OutputError` for names that cannot be used."""
        return Files(self.out, self.state)

    def make_trial(self, has_lidar: bool) -> Trial:
        """Motion model and estimator. Raises `EstimatorError`, `ModelError` and `RobotError`."""
        check_estimator(self.estimator, has_lidar)
        (form,) = check_forms([self.corrections])
        return Trial(make_model(self.model, load_robot(self.robot)), self.estimator, form)

    def live_run(self) -> LiveRun:
        """Raises `OutputError`, `RobotError`."""
        return LiveRun(load_robot(self.robot), self.make_trial, self.files(), self.topic, self.config, self.node)


@dataclass(frozen=True)
class ManagedNodeSettings(OnlineSettings):
    """What the ROS 2 lifecycle node has besides."""

    autostart: bool = True
    """Configure and activate at the start; false where a lifecycle manager does so."""
