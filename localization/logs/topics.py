"""Which topic plays which part: what the user says, else what the robot file says, else the only one that fits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from localization.errors import TopicError
from localization.logs.chunks import Channel
from motion_models.robot import Robot

TYPES: Mapping[str, str] = {
    "joint_states": "sensor_msgs/msg/JointState",
    "odometry": "nav_msgs/msg/Odometry",
    "scan": "sensor_msgs/msg/LaserScan",
    "points": "sensor_msgs/msg/PointCloud2",
    "imu": "sensor_msgs/msg/Imu",
    "center_of_gravity": "geometry_msgs/msg/PointStamped",
}
REFERENCE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "sensor_msgs/msg/NavSatFix",
)


@dataclass(frozen=True)
class TopicOverrides:
    """Topics to use instead of the robot file's. An empty name leaves the part out."""

    joint_states: str | None = None
    """sensor_msgs/JointState with the wheels' joints."""
    odometry: str | None = None
    """nav_msgs/Odometry of the robot's own driver, used where no joint states are."""
    scan: str | None = None
    """sensor_msgs/LaserScan."""
    points: str | None = None
    """sensor_msgs/PointCloud2, used where no planar scan is."""
    imu: str | None = None
    """sensor_msgs/Imu."""
    center_of_gravity: str | None = None
    """geometry_msgs/PointStamped in the body frame."""
    reference: str | None = None
    """What the result is scored against: a pose, odometry or GPS topic."""


@dataclass(frozen=True)
class TopicSource:
    """A topic that plays a part."""

    topic: str
    kind: str
    """The entry of the robot file's [topics] that it stands for, which says its message type (`TYPES`)."""
    chosen_by: str
    """"option", "robot" or "only" (the only one of its type in the log)."""


@dataclass(frozen=True)
class Sources:
    """The parts, and who plays them; None where nobody does."""

    wheels: TopicSource | None
    lidar: TopicSource | None
    imu: TopicSource | None
    center_of_gravity: TopicSource | None
    arms: tuple[TopicSource, ...] = ()
    """Joint states of the arms, from which the centre of gravity is computed where no topic tells it; one may be the wheels' too."""

    def used(self) -> list[TopicSource]:
        """Each topic once."""
        others = [s for s in (self.wheels, self.center_of_gravity, self.imu, self.lidar) if s is not None]
        return others + [arm for arm in self.arms if all(arm.topic != other.topic for other in others)]


class TopicChooser:
    """The topics of one log, and the choice among them."""

    def __init__(self, log: str, channels: Iterable[Channel], robot: Robot, overrides: TopicOverrides) -> None:
        self._log, self._robot, self._overrides = log, robot, overrides
        self._types: dict[str, str] = {}
        self._empty: set[str] = set()
        for channel in sorted(channels, key=lambda c: -c.count):
            if channel.count:
                self._types.setdefault(channel.topic, channel.type)
            elif channel.topic not in self._types:
                self._empty.add(channel.topic)
        self.warnings: list[str] = []

    def of_type(self, *types: str) -> list[str]:
        return sorted(topic for topic, kind in self._types.items() if kind in types)

    def named(self, kind: str) -> TopicSource | None:
        """The topic that an option or the robot file names. Raises `TopicError` if an option names one that does not fit."""
        wanted = getattr(self._overrides, kind)
        if wanted:
            self.require(wanted, (TYPES[kind],), f"--topic.{kind.replace('_', '-')}")
            return TopicSource(wanted, kind, "option")
        topic = getattr(self._robot.topics, kind)
        if wanted is None and self._types.get(topic) == TYPES[kind]:
            return TopicSource(topic, kind, "robot")
        return None

    def only(self, kind: str) -> TopicSource | None:
        """The only topic of the fitting type, if nothing was said about the part."""
        if getattr(self._overrides, kind) is not None:
            return None
        # What the run is scored against must not be what it is estimated from.
        kept_out = {self._robot.topics.reference, self._overrides.reference}
        topics = [topic for topic in self.of_type(TYPES[kind]) if topic not in kept_out]
        if len(topics) > 1:
            option = f"--topic.{kind.replace('_', '-')}"
            self.warnings.append(f"{', '.join(topics)} could each be the {kind.replace('_', ' ')}; name one with {option}.")
        return TopicSource(topics[0], kind, "only") if len(topics) == 1 else None

    def require(self, topic: str, types: tuple[str, ...], option: str) -> None:
        """Raises `TopicError` unless the log has ``topic`` with one of these types."""
        have = self._types.get(topic)
        if have in types:
            return
        short = " or ".join(short_type(t) for t in types)
        found = f"topic '{topic}' of {self._log} has no messages" if topic in self._empty else f"no topic '{topic}' in {self._log}"
        if have is not None:
            found = f"'{topic}' in {self._log} carries {short_type(have)}, not {short}"
        others = self.of_type(*types)
        fitting = f"topics of type {short} in it: {', '.join(others)}" if others else f"it has no topic of type {short}"
        raise TopicError(f"{found}; {fitting}. Pass {option}.")


def short_type(name: str) -> str:
    """Type name as people write it: without the "/msg/" in the middle."""
    return name.replace("/msg/", "/")
