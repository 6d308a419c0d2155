"""What a live run is made of, apart from where its messages come from: the options of the command and the parameters of the ROS 2 node."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from localization.estimators import check_estimator
from localization.logs.topic_roles import TopicOverrides
from localization.pipeline import ReplayConfig, Trial
from localization.ros.node import NodeConfig
from localization.ros.session_files import Files
from motion_models.online_calibration import check_forms
from motion_models.registry import make_model
from motion_models.robot import load_robot


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
        """Raises `OutputError` for names that cannot be."""
        return Files(self.out, self.state)

    def make_pair(self, has_lidar: bool) -> Trial:
        """Motion model and estimator. Raises `EstimatorError`, `ModelError` and `RobotError`."""
        check_estimator(self.estimator, has_lidar)
        (form,) = check_forms([self.corrections])
        return Trial(make_model(self.model, load_robot(self.robot)), self.estimator, form)
