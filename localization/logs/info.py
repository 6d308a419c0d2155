"""What is in a log, what this robot will use of it, and what is missing or suspect."""

from __future__ import annotations

import dataclasses
import heapq
import statistics
import struct
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from localization.inputs.accelerometer import scale_of_force
from localization.inputs.gyro import GRAVITY_SAMPLES
from localization.logs.decode import imu_decoder
from localization.logs.event_decoder import TopicDecoder
from localization.logs.reader import Log
from localization.logs.topic_roles import REFERENCE_TYPES, TYPES, TopicSource, short_type
from localization.messages import Message, phrase
from motion_models.se2 import FloatArray
from motion_models.slope import GRAVITY

_STAMPED = {*TYPES.values(), *REFERENCE_TYPES}
_MAX_LATCHED, _LATCHED_S = 5, 1.0
"""Old messages with which a topic begins, and least time by which they are older [s], as where clocks are compared (`clock_sync`)."""
_GAP_PERIODS, _MIN_GAP_S, _MAX_GAPS = 5.0, 0.25, 10
_PERIOD_MESSAGES = 200
_MAX_CLOCK_OFFSET_S = 10.0
_MAX_SENSOR_START_DIFFERENCE_S = 2.0


@dataclass(frozen=True)
class Gap:
    """A stretch without messages."""

    at_s: float
    """Its begin, after the log's first message."""
    duration_s: float


@dataclass(frozen=True)
class TopicInfo:
    """One topic. Stamps are those of the headers where the type is supported, else null."""

    topic: str
    type: str
    count: int
    rate_hz: float | None
    used_as: str | None
    """Its role: wheels, lidar, imu, center_of_gravity, arms, reference; or null."""
    frame_id: str | None
    first_stamp_ns: int | None
    last_stamp_ns: int | None
    gaps: list[Gap]
    """The longest ones, in order of time: over five typical periods."""
    zero_stamps: int
    repeated_stamps: int
    backward_stamps: int


@dataclass(frozen=True)
class LogInfo:
    """Content of `skidloc info`."""

    log: str
    robot: str
    start_ns: int
    end_ns: int
    """Time of recording of the first and the last message."""
    duration_s: float
    messages: int
    topics: list[TopicInfo]
    parts: dict[str, dict[str, str] | None]
    """By role (wheels, lidar, imu, center_of_gravity): topic, kind, and what chose it; null where no topic has it. A centre of gravity
    that is computed from the arms has their joint states' topics, and is chosen by "arms"."""
    references: list[str]
    """Topics that a result can be scored against."""
    mounts: dict[str, dict[str, float]]
    """Frame to pose in the body frame [m, rad]."""
    problems: list[str]
    """What is missing or suspect, as sentences."""
    warnings: list[Message]
    """What was chosen, corrected or lost, as sentences."""
    tilt: str
    """Whether the ground's tilt can be measured, and what that brings."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dataclasses.asdict(self)


class _StampStats:
    """Stamps of one topic, in constant memory."""

    def __init__(self) -> None:
        self.count = self.zero = self.repeated = self.backward = 0
        self.first: int | None = None
        self.last = 0
        self._newest = self._first_log = self._last_log = 0
        self._periods: list[int] = []
        self._longest: list[tuple[int, int]] = []

    def add(self, log_ns: int, stamp: int) -> None:
        if self.count == 0:
            self._first_log = log_ns
        self.count += 1
        self._last_log = log_ns
        if stamp == 0:
            self.zero += 1
            return
        if self.first is None:
            self.first = self.last = self._newest = stamp
            return
        self.repeated += stamp == self.last
        self.backward += stamp < self.last
        self.last = stamp
        step = stamp - self._newest
        if self.count <= _MAX_LATCHED + 1 and step - (log_ns - self._first_log) > _LATCHED_S * 1e9:
            self.first, self._longest, self._periods = stamp, [], []  # what came before was latched, and is dropped
            self._newest = stamp
        elif step > 0:
            if len(self._periods) < _PERIOD_MESSAGES:
                self._periods.append(step)
            (heapq.heappush if len(self._longest) < _MAX_GAPS else heapq.heappushpop)(self._longest, (step, self._newest))
            self._newest = stamp

    def rate_hz(self) -> float | None:
        """By the time of recording, which runs even where stamps jump."""
        return (self.count - 1) / ((self._last_log - self._first_log) * 1e-9) if self._last_log > self._first_log else None

    def gaps(self, start_ns: int) -> list[Gap]:
        if not self._periods:
            return []
        limit = max(_GAP_PERIODS * statistics.median(self._periods), _MIN_GAP_S * 1e9)
        found = sorted((begin, step) for step, begin in self._longest if step > limit)
        return [Gap((begin - start_ns) * 1e-9, step * 1e-9) for begin, step in found]


def inspect_log(log: Log) -> LogInfo:
    """Inspect a log: one pass, which reads the headers of messages only, and the first samples of the IMU."""
    stamped = [channel.topic for channel in log.channels if channel.type in _STAMPED]
    stats_of = {topic: _StampStats() for topic in stamped}
    for raw in log.source.messages(stamped) if stamped else ():
        if raw.type not in _STAMPED:
            continue
        stats_of[raw.topic].add(raw.log_ns, header_stamp_ns(raw.data, is_ros1=log.source.is_ros1))
    parts = {
        "wheels": log.sources.wheels,
        "lidar": log.sources.lidar,
        "imu": log.sources.imu,
        "center_of_gravity": log.sources.center_of_gravity,
    }
    role_of = {source.topic: part for part, source in parts.items() if source is not None}
    role_of.update((source.topic, "wheels") for source in log.sources.more_wheels)
    role_of.update((source.topic, "lidar") for source in log.sources.more_lidars)
    for source in log.sources.arms:
        role_of.setdefault(source.topic, "arms")
    if log.sources.arms:
        topics_of_arms = ", ".join(source.topic for source in log.sources.arms)
        parts["center_of_gravity"] = TopicSource(topics_of_arms, "joint_states", "arms")
    if log.reference_topic is not None:
        role_of.setdefault(log.reference_topic, "reference")
    topics = []
    for channel in sorted(log.channels, key=lambda c: c.topic):
        known = stats_of.get(channel.topic, _StampStats())
        rate = known.rate_hz() if known.count else (channel.count / log.duration_s if log.duration_s > 0 else None)
        topics.append(
            TopicInfo(
                channel.topic,
                short_type(channel.type),
                channel.count,
                rate,
                role_of.get(channel.topic) if log.types[channel.topic] == channel.type else None,
                log.frames.get(channel.topic),
                known.first,
                known.last if known.first is not None else None,
                known.gaps(known.first if known.first is not None else 0),
                known.zero,
                known.repeated,
                known.backward,
            )
        )
    mounts = log.mounts
    return LogInfo(
        log.path.name,
        log.robot.name,
        log.start_ns,
        log.end_ns,
        log.duration_s,
        sum(channel.count for channel in log.channels),
        topics,
        {part: None if source is None else _description(source) for part, source in parts.items()},
        sorted(c.topic for c in log.channels if c.type in REFERENCE_TYPES and c.count and role_of.get(c.topic) != "wheels"),
        {frame: dataclasses.asdict(mount) for frame, mount in sorted(mounts.items())},
        _find_problems(log, topics),
        log.warnings(),
        _describe_tilt(log),
    )


def _describe_tilt(log: Log) -> str:
    """Whether an IMU can measure how the ground tilts, and what that brings."""
    imu, lidar = log.sources.imu, log.sources.lidar
    frame = None if imu is None else log.frames.get(imu.topic)
    if imu is None or frame not in log.mounts:
        missing = "no IMU" if imu is None else f"no mount of the IMU's frame '{frame}'"
        return f"not available: there is {missing}, and the ground is taken as level."
    force = first_force(log, imu.topic)
    scale, problem = scale_of_force(
        0.0 if force is None else float(np.linalg.norm(force)), phrase("accelerometer.of_topic", topic=imu.topic)
    )
    if not scale:
        return f"not available, and the ground is taken as level: {problem or f'{imu.topic} has no accelerometer.'}"
    in_g = ", which is in g and is scaled to m/s^2" if scale == GRAVITY else ""
    in_3d = f" `ekf` then registers the clouds of {lidar.topic} in 3D." if lidar is not None and lidar.kind == "points" else ""
    return (
        f"by the accelerometer of {imu.topic}{in_g}. Where the ground tilts by over 3 deg, models take gravity on the slope into account, "
        f"and poses have height, roll and pitch.{in_3d}"
    )


def first_force(log: Log, topic: str) -> FloatArray | None:
    """Mean specific force (3,) of an IMU's first samples, as it is published; None where there are none."""
    samples = islice(log.readings({topic: TopicDecoder(0, imu_decoder())}), GRAVITY_SAMPLES)
    forces = [sample.linear_acceleration for sample in samples]
    return np.asarray(np.mean(forces, axis=0)) if forces else None


def _description(source: TopicSource) -> dict[str, str]:
    return {"topic": source.topic, "kind": source.kind, "chosen_by": source.chosen_by}


def header_stamp_ns(data: bytes, *, is_ros1: bool) -> int:
    """Stamp of a message that begins with a header, without decoding the rest; 0 if it is too short.

    Four bytes come before it in both: the sequence number in ROS 1, the encapsulation, which has the byte order, in ROS 2.
    """
    if len(data) < 12:
        return 0
    order = "<" if is_ros1 or data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(order + "iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _find_problems(log: Log, topics: list[TopicInfo]) -> list[str]:
    found: list[str] = []
    wanted = log.robot.topics
    if log.no_wheels:
        found.append(log.no_wheels)
    elif log.sources.wheels is None:
        found.append("no wheels: options leave them out.")
    if log.sources.lidar is None:
        found.append(f"no LiDAR: neither a planar scan ({wanted.scan}) nor a point cloud ({wanted.points}) is in the log.")
    if log.sources.imu is None:
        others = "the wheels alone" if log.sources.lidar is None else "the wheels and the LiDAR alone"
        found.append(f"no IMU ({wanted.imu}) is in the log: the yaw rate comes from {others}.")
    for source in (log.sources.lidar, log.sources.imu):
        frame = log.frames.get(source.topic) if source is not None else None
        if source is not None and frame is not None and frame not in log.mounts:
            found.append(
                f"{source.topic} is measured in frame '{frame}', whose pose on the robot is neither in the log's /tf_static nor in the"
                f" robot file; add [mounts.{frame}] to the robot file."
            )
    if log.robot.arms is not None and log.sources.center_of_gravity is None and not log.sources.arms:
        found.append(
            f"robot '{log.robot.name}' has arms, but no joint states have their angles: the centre of gravity stays at"
            f" ({log.robot.geometry.cg_x_m:g}, {log.robot.geometry.cg_y_m:g}) m."
        )
    found += _find_uneven_spans(log, topics)
    used = [topic for topic in topics if topic.used_as in ("wheels", "lidar", "imu", "center_of_gravity", "arms")]
    first_ns = [topic.first_stamp_ns for topic in used if topic.first_stamp_ns is not None]
    is_one_clock = len(first_ns) > 1 and max(first_ns) - min(first_ns) < _MAX_CLOCK_OFFSET_S * 1e9  # played and recorded anew, or simulated
    for topic in used:
        for count, what in (
            (topic.zero_stamps, "have no stamp"),
            (topic.backward_stamps, "are stamped before the one before them"),
            (topic.repeated_stamps, "repeat the stamp of the one before"),
        ):
            if count:
                found.append(f"{topic.topic}: {count} of {topic.count} messages {what}.")
        apart = 0.0 if topic.first_stamp_ns is None else (topic.first_stamp_ns - log.start_ns) * 1e-9
        if abs(apart) > log.duration_s + _MAX_CLOCK_OFFSET_S and not is_one_clock:
            found.append(f"{topic.topic}: its stamps are {abs(apart):.0f} s {'after' if apart > 0 else 'before'} the time of recording.")
        if topic.gaps:
            longest = max(topic.gaps, key=lambda gap: gap.duration_s)
            found.append(
                f"{topic.topic}: {len(topic.gaps)} gap{'s' if len(topic.gaps) > 1 else ''}, the longest {longest.duration_s:.2f} s long,"
                f" {longest.at_s:.1f} s after its first message."
            )
    return found


def _find_uneven_spans(log: Log, topics: list[TopicInfo]) -> list[str]:
    """Sensors that begin after or end before the others."""
    spans = [(t, t.first_stamp_ns, t.last_stamp_ns) for t in topics if t.used_as in ("wheels", "lidar", "imu")]
    known = [(t, first, last) for t, first, last in spans if first is not None and last is not None]
    if len(known) < 2:
        return []
    begin, end = min(first for _, first, _ in known), max(last for _, _, last in known)
    if end - begin > (log.end_ns - log.start_ns) + _MAX_CLOCK_OFFSET_S * 1e9:
        return []  # their clocks differ, reported elsewhere
    found = []
    for topic, first, last in known:
        for apart_s, what in (((first - begin) * 1e-9, "begins {:.1f} s after"), ((end - last) * 1e-9, "ends {:.1f} s before")):
            if apart_s > _MAX_SENSOR_START_DIFFERENCE_S:
                found.append(f"{topic.topic} {what.format(apart_s)} the other sensors.")
    return found
