"""Configuration of the node, and options that its first odometry needs: nothing here imports an estimator."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from localization.bounded_settings import Positive, Settings
from localization.errors import SettingError
from localization.logs.topic_roles import TopicOverrides
from motion_models.robot import Robot
from motion_models.robot_file import load_robot

_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_NAMESPACE = re.compile(r"/|(/[A-Za-z_][A-Za-z0-9_]*)+")
_TOPIC = re.compile(r"(~?/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_GLOBAL = ("/tf", "/tf_static", "/diagnostics")
_CLEARPATH_TOPICS = {
    "joint_states": "/platform/joint_states",
    "odometry": "/platform/odom",
    "imu": "/sensors/imu_0/data",
    "scan": "/sensors/lidar2d_0/scan,/sensors/lidar2d_1/scan",
    "points": "/sensors/lidar3d_0/points",
}
"""Topics of Clearpath's robots inside their namespace (docs.clearpathrobotics.com, ROS 2 Jazzy, platform and sensors API)."""


@dataclass(frozen=True)
class Names(Settings):
    """The node's name, and how topics are named by it. Raises `SettingError` for names that ROS 2 does not allow."""

    name: str = "skidloc"
    """Node name; estimates are published on `~/odometry`, that is /NAMESPACE/NAME/odometry."""
    namespace: str = "/"
    """Namespace of the node. The robot file's topics are in it, those of --topic where they begin without `/`."""
    remap: tuple[str, ...] = ()
    """Rules FROM:=TO as of ROS 2, for topics of both directions: `scan:=front/scan`, `~/odometry:=odom`, `/tf:=tf`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NODE.fullmatch(self.name):
            raise SettingError(f"the node's name is '{self.name}'; it may hold letters, digits and '_', and no digit first.")
        if not _NAMESPACE.fullmatch(self.namespace):
            raise SettingError(f"the namespace is '{self.namespace}'; it must begin with '/', as in '/robot1', and not end with it.")
        for rule in self.remap:
            ends = rule.split(":=")
            if len(ends) != 2 or not all(_TOPIC.fullmatch(end) for end in ends):
                raise SettingError(f"the remapping rule is '{rule}'; it must be FROM:=TO with two names of topics, as in scan:=front/scan.")

    def resolve(self, topic: str) -> str:
        """The absolute name of ``topic`` after remapping; the first rule that fits counts. Of several topics with commas, each."""
        if "," in topic:
            return _each(topic, self.resolve)
        full = self._expand(topic)
        return next((self._expand(after) for before, after in self._rules() if self._expand(before) == full), full)

    def in_namespace(self, topic: str) -> str:
        """``topic`` of a robot file, where namespaces are not known: absolute there, inside the namespace here."""
        if "," in topic:
            return _each(topic, self.in_namespace)
        return self.resolve(topic if topic in _GLOBAL else topic.lstrip("/")) if topic else topic

    def apply_to_robot(self, robot: Robot) -> Robot:
        """``robot`` with its topics as they are resolved here."""
        topics = {field.name: self.in_namespace(getattr(robot.topics, field.name)) for field in dataclasses.fields(robot.topics)}
        return dataclasses.replace(robot, topics=dataclasses.replace(robot.topics, **topics))

    def apply_to_overrides(self, topics: TopicOverrides) -> TopicOverrides:
        """``topics`` as they are resolved here; parts that are left out or not named stay so."""
        values = {field.name: getattr(topics, field.name) for field in dataclasses.fields(topics)}
        return dataclasses.replace(topics, **{name: self.resolve(topic) for name, topic in values.items() if topic})

    def of_clearpath(self, namespace: str) -> Names:
        """Names in the ``namespace`` of a Clearpath robot, where transforms and diagnostics are inside it as well."""
        inside = tuple(f"{topic}:={topic.lstrip('/')}" for topic in _GLOBAL)
        return dataclasses.replace(self, namespace=f"/{namespace.strip('/')}", remap=(*self.remap, *inside))

    def _rules(self) -> list[tuple[str, str]]:
        return [(before, after) for before, after in (rule.split(":=") for rule in self.remap)]

    def _expand(self, topic: str) -> str:
        if topic.startswith("/"):
            return topic
        prefix = self.namespace.rstrip("/")
        return f"{prefix}/{self.name}{topic[1:]}" if topic.startswith("~") else f"{prefix}/{topic}"


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
    """Publish transforms and `~/odometry_predicted` with the wheels' messages, predicted from the last estimate by the motion model; false:
    transforms with each estimate alone."""
    predict_hz: Positive = 50.0
    """Largest rate of predictions [Hz]: of wheels that come more often, messages in between are left out."""
    max_latency_s: Positive = 0.1
    """Diagnostics warn where estimates come later than this after their scan [s], and report an error at ten times as much."""
    path_period_s: float = 5.0
    """Time between two messages on `~/path` [s]; 0: none."""
    map_period_s: float = 10.0
    """Time between two messages on `~/map` [s]; 0: none."""
    map_topic: str = "~/map"
    """Topic of the map; `/map` where nav2 and RViz take it from there."""
    transform_tolerance: float = 0.0
    """By how much the transform `map_frame` -> `odom_frame` is stamped later [s], as by AMCL: others find one for stamps up to now."""
    diagnose_every_min: Annotated[float, tyro.conf.arg(aliases=["--diagnose-every"])] = 5.0
    """Minutes between two diagnoses of the last two minutes, which a process of lowest priority makes and diagnostics report; 0: none."""
    clearpath: str = ""
    """Namespace of a Clearpath robot (a200_0000): topics are named as its ROS 2 API has them, /tf and diagnostics are inside it."""
    positions: str = ""
    """Topic of a GNSS receiver (sensor_msgs/NavSatFix, as fix), whose positions `graph` fuses; empty: none."""
    datum: str = ""
    """LATITUDE,LONGITUDE [deg] from where positions are counted east and north; empty: the first fix."""
    utm_frame: str = ""
    """Frame of UTM, of which `map_frame` is published as a child once positions have given its heading (extra `gnss`); empty: none."""
    use_sim_time: bool = False
    """Take the time from /clock, as of a simulator or `ros2 bag play --clock`."""
    frames: Frames = field(default_factory=Frames)
    names: Names = field(default_factory=Names)


@dataclass(frozen=True)
class LiveOptions:
    """Robot, estimator, files and topics, without the settings of the estimator."""

    robot: str
    """Name of a shipped robot, or path of a robot TOML file."""
    model: str = "skid_steer"
    """Motion model."""
    estimator: str = "ekf"
    """Estimator."""
    corrections: str = "constant"
    """What ekf and graph learn of the motion model: none, constant or cg_field."""
    map: Path | None = None
    """Map of an earlier drive, by `skidloc replay --save-map`: the estimator is then `map`, whose poses are in that map's frame."""
    out: Path | None = None
    """New trajectory file, .tum, or .mcap with Odometry, TF and covariances. It gets its name at the end."""
    state: Path | None = None
    """File of the estimator's state, at most a second old; resumed at the start if it is there. Removed at the end of a log."""
    node: NodeConfig = field(default_factory=NodeConfig)
    topic: TopicOverrides = field(default_factory=TopicOverrides)

    def robot_and_node(self) -> tuple[Robot, NodeConfig]:
        """Both, with the topics of a Clearpath robot where they are wanted. Raises `RobotError`."""
        robot, node = load_robot(self.robot), self.node
        if node.clearpath:
            robot = dataclasses.replace(robot, topics=dataclasses.replace(robot.topics, **_CLEARPATH_TOPICS))
            node = dataclasses.replace(node, names=node.names.of_clearpath(node.clearpath))
        return robot, node


def _each(topics: str, name: Callable[[str], str]) -> str:
    """``topics`` with commas, each by ``name``."""
    return ",".join(name(part.strip()) for part in topics.split(",") if part.strip())
