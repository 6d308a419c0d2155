"""Topic roles of a log: wheels, LiDAR, IMU and centre of gravity."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from localization.errors import TopicError
from localization.logs.cg_topic import MeanPoint, choose_cg_topic
from localization.logs.chunks import Channel
from localization.logs.driver_messages import DRIVER_MESSAGES, LEFT, RIGHT, is_by_driver
from localization.logs.topic_names import find_in_namespace, is_by_wheels, is_filter, is_other_estimate, is_without_gyro, match_joints
from localization.logs.wheel_messages import TF_TYPES, TWIST_TYPES, is_measured_twist
from localization.messages import Message, message, phrase
from motion_models.center_of_gravity.cg_model import CgModel
from motion_models.center_of_gravity.files import arms_model
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
OTHER_TYPES: Mapping[str, tuple[str, ...]] = {"joint_states": tuple(DRIVER_MESSAGES), "odometry": (*TWIST_TYPES, *TF_TYPES)}
"""Types that are read in a role besides its own."""
_WHEEL_WORDS = re.compile(r"wheel|motor|encoder|tick|joint|odom")
"""Names of topics that may be the wheels', of whatever type."""
_MAX_LISTED = 4

BODY_FRAMES = ("base_link", "base_footprint")
"""Frames of the body, in which no LiDAR is (REP-105, REP-120)."""


@dataclass(frozen=True)
class TopicOverrides:
    """Topics to use instead of the robot file's. An empty name disables the role."""

    joint_states: str | None = None
    """sensor_msgs/JointState with the wheels' joints."""
    odometry: str | None = None
    """nav_msgs/Odometry of the robot's own driver, used where no joint states are."""
    scan: str | None = None
    """sensor_msgs/LaserScan; several planar scanners with commas (/front/scan,/rear/scan)."""
    points: str | None = None
    """sensor_msgs/PointCloud2, used where no planar scan is."""
    imu: str | None = None
    """sensor_msgs/Imu."""
    center_of_gravity: str | None = None
    """geometry_msgs/PointStamped in the body frame."""
    reference: str | None = None
    """What the result is scored against: a pose, odometry or GPS topic."""

    def scored_against(self, reference: str | None) -> TopicOverrides:
        """These with the ``reference`` of a command, if none is set: no sensor is taken from that topic by its type alone."""
        return self if not reference or self.reference is not None else replace(self, reference=reference)


CHOSEN_BY = {
    "option": "given as an option",
    "robot": "named in the robot file",
    "only": "the only one of its type",
    "names": "of several by its name",
    "joints": "of several by its joints",
    "points": "of several by name and place of its points",
    "arms": "the arms' joints",
}
"""Why a topic has its role, by `TopicSource.chosen_by`."""


@dataclass(frozen=True)
class TopicSource:
    """A topic in a role."""

    topic: str
    kind: str
    """Its entry in [topics] of the robot file, which sets the message type (`TYPES`)."""
    chosen_by: str
    """Key of `CHOSEN_BY`."""
    type: str = ""
    """Message type, where it is another than that of ``kind``."""


@dataclass(frozen=True)
class Sources:
    """Topic of each role; None where there is none."""

    wheels: TopicSource | None
    lidar: TopicSource | None
    imu: TopicSource | None
    center_of_gravity: TopicSource | None
    arms: tuple[TopicSource, ...] = ()
    """Joint states of the arms, from which the centre of gravity is computed where no topic has it; one may be the wheels' too."""
    more_wheels: tuple[TopicSource, ...] = ()
    """Joint states of the other wheels, where ``wheels`` has some of them only."""
    more_lidars: tuple[TopicSource, ...] = ()
    """Other planar scanners, each in a frame of its own."""

    @property
    def all_wheels(self) -> tuple[TopicSource, ...]:
        """Topics of the wheels."""
        return (*(() if self.wheels is None else (self.wheels,)), *self.more_wheels)

    @property
    def lidars(self) -> tuple[TopicSource, ...]:
        """Topics of all LiDARs."""
        return (*(() if self.lidar is None else (self.lidar,)), *self.more_lidars)

    @property
    def has_clouds(self) -> bool:
        """Whether the LiDAR is a 3D one."""
        return self.lidar is not None and self.lidar.kind == "points"

    def used(self) -> list[TopicSource]:
        """Each topic once."""
        others = [*self.all_wheels, *(s for s in (self.center_of_gravity, self.imu, *self.lidars) if s is not None)]
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
        self.warnings: list[Message] = []

    def of_type(self, *types: str) -> list[str]:
        """Topics of one of these types, sorted."""
        return sorted(topic for topic, kind in self._types.items() if kind in types)

    def by_drivers(self) -> list[str]:
        """Topics of drivers' messages about the wheels; those with angles, where some have them."""
        found = sorted(topic for topic, kind in self._types.items() if is_by_driver(topic, kind))
        return [topic for topic in found if DRIVER_MESSAGES[self._types[topic]].has_angles] or found

    def type_of(self, topic: str) -> str:
        """Type of a topic's messages; "" where the log has none of it."""
        return self._types.get(topic, "")

    def find_named(self, kind: str) -> TopicSource | None:
        """The topic that an option or the robot file names. Raises `TopicError` if an option names one that does not fit."""
        return next(iter(self.find_all_named(kind)), None)

    def find_all_named(self, kind: str) -> list[TopicSource]:
        """The topics that an option or the robot file names, several of planar scanners. Raises `TopicError` as `find_named`."""
        wanted, others = getattr(self._overrides, kind), OTHER_TYPES.get(kind, ())
        if wanted is None:
            named = names_of(getattr(self._robot.topics, kind), kind)
            return [TopicSource(topic, kind, "robot") for topic in named if self._types.get(topic) == TYPES[kind]]
        for topic in names_of(wanted, kind):
            self.require(topic, (TYPES[kind], *others), f"--topic.{kind.replace('_', '-')}")
        types = {topic: self.type_of(topic) for topic in names_of(wanted, kind)}
        return [TopicSource(topic, kind, "option", its_type if its_type in others else "") for topic, its_type in types.items()]

    def find_only(self, kind: str) -> TopicSource | None:
        """The only topic of the matching type, if no option sets the role."""
        if getattr(self._overrides, kind) is not None:
            return None
        topics = self.candidates(kind)
        wanted = getattr(self._robot.topics, kind)
        topic = find_in_namespace(wanted, topics)
        role = kind.replace("_", " ")
        if topic is not None and len(topics) > 1:
            self.warnings.append(message("topics.in_namespace", topic=topic, role=role, wanted=wanted))
            return TopicSource(topic, kind, "robot")
        without_gyro = [other for other in self.of_type(TYPES[kind]) if is_without_gyro(other) and other not in topics]
        if kind == "imu" and len(topics) == 1 and without_gyro:
            self.warnings.append(message("topics.without_gyro", topic=topics[0], others=", ".join(without_gyro)))
            return TopicSource(topics[0], kind, "names")
        by_wheels = [topic for topic in topics if is_by_wheels(topic)] if kind == "odometry" else []
        if len(by_wheels) == 1 and len(topics) > 1:
            others = ", ".join(other for other in topics if other != by_wheels[0])
            self.warnings.append(message("topics.by_wheels", topic=by_wheels[0], others=others))
            return TopicSource(by_wheels[0], kind, "names")
        if len(topics) > 1:
            option = f"--topic.{kind.replace('_', '-')}"
            self.warnings.append(message("topics.several", topics=", ".join(topics), role=role, option=option))
        return TopicSource(topics[0], kind, "only") if len(topics) == 1 else None

    def candidates(self, kind: str) -> list[str]:
        """Topics of the matching type that no option names. What the run is scored against must not be what it is estimated from."""
        kept_out = {self._robot.topics.reference, self._overrides.reference}
        found = [topic for topic in self.of_type(TYPES[kind]) if topic not in kept_out]
        if kind == "imu":
            return [topic for topic in found if not is_without_gyro(topic)] or found
        return [topic for topic in found if kind != "odometry" or not is_other_estimate(topic)]

    def no_wheels(self) -> str:
        """That the log has no wheels; "" where options leave them out."""
        wanted, topics = self._overrides, self._robot.topics
        if wanted.joint_states == "" or wanted.odometry == "":
            return ""
        found = f"no wheels: neither joint states ({topics.joint_states}) nor the driver's odometry ({topics.odometry}) are in {self._log}."
        several = self.candidates("odometry") if wanted.odometry is None else []
        if len(several) > 1:
            return f"{found} {', '.join(several)} could each be it: name the wheels' with --topic.odometry."
        return f"{found}{self.describe_other_odometry()}{self._describe_other_types()}"

    def _describe_other_types(self) -> str:
        """Topics of other types that are the wheels' by name, and what to do: a sentence after a blank, "" where there are none."""
        read = {*TYPES.values(), *TWIST_TYPES, *TF_TYPES, *REFERENCE_TYPES, *DRIVER_MESSAGES}
        named = {topic: kind for topic, kind in self._types.items() if kind not in read and _WHEEL_WORDS.search(topic.lower())}
        if not named:
            return ""
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(named.items())[:_MAX_LISTED])
        it, types = ("it", "its type is") if len(named) == 1 else ("they", "their types are")
        return (
            f" {listed}: by name {it} may be the wheels', but {types} not read: let a node publish them as sensor_msgs/JointState, with the"
            " names of the wheels' joints and their angles or rates."
        )

    def describe_other_odometry(self) -> str:
        """Which Odometry is by its name none of wheels, and what it is for: a sentence after a blank, "" where there is none."""
        others = sorted(set(self.of_type(TYPES["odometry"])) - set(self.candidates("odometry")))
        if not others:
            return ""
        are = "is a reference or another estimate by its name" if len(others) == 1 else "are references or other estimates by name"
        return f" {', '.join(others)} {are}: score against it by --reference, or pass --topic.odometry if wheels make it."

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
        choice = f"{option} {others[0]}" if len(others) == 1 else f"one of them by {option}"
        fitting = f"topics of type {short} in it: {', '.join(others)}. Pass {choice}."
        if not others:
            fitting = f"it has no topic of type {short}. `skidloc info` lists its topics; {option} names the one to take."
        raise TopicError(f"{found}; {fitting}")


def names_of(text: str, kind: str) -> tuple[str, ...]:
    """Topics of an entry: several, with commas, of planar scanners alone; none of an empty one."""
    return tuple(name for part in (text.split(",") if kind == "scan" else [text]) if (name := part.strip()))


def short_type(name: str) -> str:
    """Type name without the "/msg/" in the middle."""
    return name.replace("/msg/", "/")


JointNames = Callable[[str], Iterable[Iterable[str]]]
"""Names of the joints in each of the first messages of a topic."""

ScanFrame = Callable[[str], str]
"""Frame of a topic's first message."""

OdometryEdge = Callable[[str], tuple[str, str] | None]
"""Parent and child of the odometry's transform on a topic of /tf."""

Sides = tuple[tuple[str, ...], tuple[str, ...]]
"""Joints of the left and of the right wheels."""


@dataclass(frozen=True)
class TopicRoles:
    """Topic of each role, and warnings about the choice."""

    sources: Sources
    joints: Sides
    """Wheel joints that the log has; empty where the wheels are not joint states."""
    wheels_error: TopicError | None
    """Why the wheels cannot be used, where the log has joint states."""
    arms: CgModel | None
    """CG model for the joint states of `Sources.arms`."""
    robot: Robot
    """The robot, its wheel joints by the log's names where these have another prefix."""
    warnings: list[Message]


def choose_roles(
    log: str,
    chooser: TopicChooser,
    robot: Robot,
    overrides: TopicOverrides,
    joint_names: JointNames,
    odometry_edge: OdometryEdge = lambda topic: None,
    mean_point: MeanPoint = lambda topic: None,
    scan_frame: ScanFrame = lambda topic: "",
) -> TopicRoles:
    """Choose a topic for each role. Raises `TopicError` if an option names a topic that does not fit, and what `arms_model` does."""
    return _RoleChooser(log, chooser, robot, overrides, joint_names, odometry_edge, mean_point, scan_frame).choose()


class _RoleChooser:
    def __init__(
        self,
        log: str,
        chooser: TopicChooser,
        robot: Robot,
        overrides: TopicOverrides,
        joint_names: JointNames,
        odometry_edge: OdometryEdge,
        mean_point: MeanPoint,
        scan_frame: ScanFrame,
    ) -> None:
        self._odometry_edge, self._mean_point, self._scan_frame = odometry_edge, mean_point, scan_frame
        self._log, self._chooser, self._robot = log, chooser, robot
        self._overrides, self._joint_names = overrides, joint_names
        self._joints: Sides = ((), ())
        self._more_wheels: tuple[TopicSource, ...] = ()
        self._error: TopicError | None = None
        self._joint_note = ""
        self._warnings: list[Message] = []

    def choose(self) -> TopicRoles:
        wheels, lidars, imu, center_of_gravity = self._wheels(), self._lidars(), self._choose("imu"), self._center_of_gravity()
        arms, model = self._arms() if center_of_gravity is None else ((), None)
        lidar = lidars[0] if lidars else None
        sources = Sources(wheels, lidar, imu, center_of_gravity, arms, self._more_wheels, tuple(lidars[1:]))
        return TopicRoles(sources, self._joints, self._error, model, self._robot, [*self._chooser.warnings, *self._warnings])

    def _arms(self) -> tuple[tuple[TopicSource, ...], CgModel | None]:
        """Joint states of the arms. An empty option for the centre of gravity leaves it at the robot file's value."""
        robot = self._robot
        if robot.arms is None or self._overrides.center_of_gravity is not None:
            return (), None
        model = arms_model(robot.arms, robot.folder)
        joints = model.chain.joint_names
        received: dict[str, set[str]] = {}
        for topic in self._chooser.of_type(TYPES["joint_states"]):
            names = {name for message_names in self._joint_names(topic) for name in message_names}
            received[topic] = names
        topics, missing = cover_joints(joints, received)
        strange = sorted(set().union(*received.values()) - set(joints) - {*robot.joints.left, *robot.joints.right})
        if missing and (topics or strange):
            unknown = phrase("topics.unknown_joints", joints=", ".join(strange)) if strange else ""
            found = ", ".join(topics or received)
            self._warnings.append(message("topics.missing_arms", topics=found, joints=", ".join(missing), unknown=unknown))
        if not topics:
            return (), None
        return tuple(TopicSource(topic, "joint_states", "robot") for topic in topics), model

    def _center_of_gravity(self) -> TopicSource | None:
        kind = "center_of_gravity"
        topics = self._chooser.candidates(kind)
        if not topics or self._overrides.center_of_gravity is not None or self._chooser.find_named(kind) is not None:
            return self._choose(kind)
        choice = choose_cg_topic(topics, self._robot, self._mean_point)
        if choice is None:
            return self._choose(kind)
        self._warnings.append(choice.text)
        return None if choice.topic is None else TopicSource(choice.topic, kind, "points")

    def _choose(self, kind: str) -> TopicSource | None:
        named = self._chooser.find_named(kind)
        return named if named is not None else self._warn_default(self._chooser.find_only(kind))

    def _warn_default(self, source: TopicSource | None) -> TopicSource | None:
        if source is not None and source.chosen_by == "only":
            wanted = getattr(self._robot.topics, source.kind)
            part = source.kind.replace("_", " ")
            self._warnings.append(message("topics.only", topic=source.topic, role=part, wanted=wanted))
        return source

    def _lidars(self) -> list[TopicSource]:
        """A planar scanner, or several, else clouds."""
        chooser = self._chooser
        if self._overrides.points and not self._overrides.scan:
            return chooser.find_all_named("points")
        named = self._without_repeated(chooser.find_all_named("scan")) or chooser.find_all_named("points") or self._scanners()
        return named or [source for source in (self._choose("scan") or self._choose("points"),) if source is not None]

    def _without_repeated(self, named: list[TopicSource]) -> list[TopicSource]:
        """``named`` without topics whose scans are in the frame of another's: those of one LiDAR count once."""
        used: dict[str, TopicSource] = {}
        for source in named:
            frame = (self._scan_frame(source.topic) if len(named) > 1 else "") or source.topic
            if frame in used:
                self._warnings.append(message("topics.same_frame", topic=source.topic, frame=frame, other=used[frame].topic))
            used.setdefault(frame, source)
        return list(used.values())

    def _scanners(self) -> list[TopicSource]:
        """Several planar scanners that nothing names, each in a frame of its own. Scans in the body's frame are made of others."""
        topics = [] if self._overrides.scan is not None else self._chooser.candidates("scan")
        if find_in_namespace(self._robot.topics.scan, topics) is not None:
            return []
        frames = {topic: self._scan_frame(topic) for topic in topics}
        own = [topic for topic in topics if frames[topic] not in BODY_FRAMES]
        if len(own) < 2 or len({frames[topic] for topic in own}) < len(own) or "" in frames.values():
            return []
        listed = " and ".join(own)
        self._warnings.append(message("topics.scanners", topics=listed, first=own[0]))
        return [TopicSource(topic, "scan", "only") for topic in own]

    def _wheels(self) -> TopicSource | None:
        """Joint states with wheels in them, else the driver's odometry."""
        if self._overrides.odometry and not self._overrides.joint_states:
            return self._chooser.find_named("odometry")
        named = self._chooser.find_named("joint_states")
        if named is not None:
            candidates = [named.topic]
        else:
            candidates = self._chooser.of_type(TYPES["joint_states"]) if self._overrides.joint_states is None else []
        fitting, known = self._fitting(candidates)
        if not fitting and self._rename_joints(candidates, known):
            fitting, known = self._fitting(candidates)
        if not fitting and named is not None and named.chosen_by != "option" and not self._has_joint(known):
            candidates = self._chooser.of_type(TYPES["joint_states"])
            fitting, known = self._fitting(candidates)
            if fitting:
                self._warnings.append(message("topics.other_joint_states", topic=fitting[0][0], named=named.topic))
                named = TopicSource(fitting[0][0], "joint_states", "joints")
        if len(fitting) == 1:
            topic, self._joints = fitting[0]
            wanted = (*self._robot.joints.left, *self._robot.joints.right)
            absent = [joint for joint in wanted if joint not in (*self._joints[0], *self._joints[1])]
            if absent:
                self._warnings.append(message("topics.missing_joints", topic=topic, joints=", ".join(absent)))
            return named if named is not None else self._warn_default(TopicSource(topic, "joint_states", "only"))
        parts = None if self._has_all_wheels(fitting) else self._wheels_in_parts(candidates)
        if parts is not None:
            return parts
        if len(fitting) > 1:
            topics = ", ".join(topic for topic, _ in fitting)
            self._warnings.append(message("topics.several_joint_states", topics=topics))
        driver = self._by_driver() if not fitting and self._overrides.joint_states is None else None
        return driver or self._odometry(named, known, bool(candidates) and not fitting)

    def _by_driver(self) -> TopicSource | None:
        """Wheels in messages of a driver's own type, where no joint states have them; None where there are none, or several."""
        topics = self._chooser.by_drivers()
        if self._overrides.odometry:
            return None
        fitting, known = self._fitting(topics)
        if not fitting and self._rename_joints(topics, known):
            fitting, known = self._fitting(topics)
        if len(fitting) > 1:
            listed = ", ".join(topic for topic, _ in fitting)
            self._warnings.append(message("topics.several_drivers", topics=listed))
            return None
        if not fitting:
            return self._wheels_in_parts(topics)
        ((topic, self._joints),) = fitting
        source = self._source_of_joints(topic)
        self._warnings.append(message("topics.driver_message", topic=topic, type=short_type(source.type), log=self._log))
        return source

    def _fitting(self, topics: list[str]) -> tuple[list[tuple[str, Sides]], set[str]]:
        """Topics whose messages have wheels of both sides, with their joints, and all joints of ``topics``."""
        self._names: dict[str, set[str]] = {}
        fitting = []
        for topic in topics:
            self._names[topic], joints = self._wheel_joints(topic)
            if joints is not None:
                fitting.append((topic, joints))
        return fitting, set().union(*self._names.values())

    def _has_joint(self, names: set[str]) -> bool:
        """Whether one of the wheels is among joints ``names``."""
        return not names.isdisjoint((*self._robot.joints.left, *self._robot.joints.right))

    def _has_all_wheels(self, fitting: list[tuple[str, Sides]]) -> bool:
        """Whether one topic has all wheels; else several have an axle each, or a side."""
        joints = self._robot.joints
        return any(len(left) + len(right) == len(joints.left) + len(joints.right) for _, (left, right) in fitting)

    def _rename_joints(self, topics: list[str], names: set[str]) -> bool:
        """Give the robot's wheel joints the ``names`` that ``topics`` have for them, where these have another prefix."""
        joints = self._robot.joints
        if names and names <= {LEFT, RIGHT}:
            self._robot = replace(self._robot, joints=joints.of_sides(LEFT, RIGHT))
            return True
        ways = match_joints((*joints.left, *joints.right), sorted(names))
        if len(ways) == 1:
            (way,) = ways
            self._robot = replace(self._robot, joints=joints.renamed(way))
            ours, theirs = next(iter(way.items()))
            self._warnings.append(message("topics.renamed_joints", topics=", ".join(topics), theirs=theirs, ours=ours))
        elif ways:
            ours = joints.left[0]
            self._joint_note = phrase("topics.several_ways", joint=ours, joints=" or ".join(way[ours] for way in ways))
        return len(ways) == 1

    def _wheels_in_parts(self, candidates: list[str]) -> TopicSource | None:
        """Joint states of single wheels or sides, in messages or topics of their own; None where a side has none."""
        wanted = self._robot.joints
        topics, _ = cover_joints((*wanted.left, *wanted.right), {topic: self._names[topic] for topic in candidates})
        names = set().union(*(self._names[topic] for topic in topics))
        left, right = (tuple(joint for joint in side if joint in names) for side in (wanted.left, wanted.right))
        if not left or not right:
            return None
        self._joints = left, right
        named = self._chooser.find_named("joint_states")
        first = named if named is not None and named.topic in topics else self._source_of_joints(topics[0])
        self._more_wheels = tuple(self._source_of_joints(topic) for topic in topics if topic != first.topic)
        absent = [joint for joint in (*wanted.left, *wanted.right) if joint not in names]
        rest = phrase("topics.absent", joints=", ".join(absent)) if absent else ""
        joints = ", ".join((*left, *right))
        self._warnings.append(message("topics.parts", topics=", ".join(topics), joints=joints, rest=rest))
        return first

    def _source_of_joints(self, topic: str) -> TopicSource:
        kind = self._chooser.type_of(topic)
        return TopicSource(topic, "joint_states", "joints", kind if kind != TYPES["joint_states"] else "")

    def _odometry(self, joint_states: TopicSource | None, known: set[str], is_missing_joints: bool) -> TopicSource | None:
        """The odometry, where no joint states have the wheels."""
        missing_joints = phrase(
            "topics.no_wheel_joints",
            log=self._log,
            robot=self._robot.name,
            joints=", ".join((*self._robot.joints.left, *self._robot.joints.right)),
            known=", ".join(sorted(known)) or phrase("topics.no_joints"),
            note=self._joint_note,
        )
        if joint_states is not None and joint_states.chosen_by == "option":
            raise TopicError(f"{missing_joints}. Name them in the robot file's [joints].")
        odometry = self._choose("odometry") or self._other_odometry()
        if is_missing_joints and odometry is not None:
            self._warnings.append(message("topics.by_odometry", missing=missing_joints, topic=odometry.topic))
        elif is_missing_joints:
            self._error = TopicError(
                f"{missing_joints}.{self._chooser.describe_other_odometry()} Name them in the robot file's [joints], or go without wheels"
                " by an empty --topic.joint-states."
            )
        return odometry

    def _other_odometry(self) -> TopicSource | None:
        """A measured velocity, else the odometry frame on /tf, where the log has neither joint states nor an Odometry of the driver."""
        if self._overrides.odometry is not None or self._overrides.joint_states:
            return None
        twists = [topic for topic in self._chooser.of_type(*TWIST_TYPES) if is_measured_twist(topic) and not is_other_estimate(topic)]
        if len(twists) > 1:
            self._warnings.append(message("topics.several_twists", topics=", ".join(twists)))
        is_filtered = any(map(is_filter, self._chooser.of_type(TYPES["odometry"])))  # which publishes the odometry's transform, too
        transforms = [topic for topic in self._chooser.of_type(*TF_TYPES) if not topic.endswith("_static") and not is_filtered]
        topics = twists or transforms
        if len(topics) != 1:
            return None
        topic = topics[0]
        source = TopicSource(topic, "odometry", "only", self._chooser.type_of(topic))
        if source.type not in TF_TYPES:
            self._warnings.append(message("topics.velocity", topic=topic))
            return source
        edge = self._odometry_edge(topic)
        if edge is None:
            return None
        self._warnings.append(message("topics.transform", topic=topic, parent=edge[0], frame=edge[1]))
        return source

    def _wheel_joints(self, topic: str) -> tuple[set[str], Sides | None]:
        """All joint names of a topic's first messages, and the left and right wheels' among them if both sides have some."""
        names_found: set[str] = set()
        best: Sides | None = None
        wanted = self._robot.joints
        for message_names in self._joint_names(topic):
            names = set(message_names)
            names_found |= names
            left, right = tuple(j for j in wanted.left if j in names), tuple(j for j in wanted.right if j in names)
            if left and right and (best is None or len(left) + len(right) > len(best[0]) + len(best[1])):
                best = left, right
                if len(left) + len(right) == len(wanted.left) + len(wanted.right):
                    break
        return names_found, best


def cover_joints(wanted: Iterable[str], available: Mapping[str, set[str]]) -> tuple[list[str], list[str]]:
    """The fewest topics that have all joints ``wanted``, and the joints that none has. ``available``: topic -> its joints.

    Greedy set cover: the topic with most joints comes first; one that adds none is left out.
    """
    left = list(wanted)
    topics: list[str] = []
    while left:
        best = max(available, key=lambda topic: (len(available[topic].intersection(left)), topic), default="")
        if not best or not available[best].intersection(left):
            break
        topics.append(best)
        left = [joint for joint in left if joint not in available[best]]
    return topics, left
