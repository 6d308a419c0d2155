"""A log: its events, references, sensor mounts, and warnings about its messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from localization.errors import LogError, TopicError
from localization.events import Event, Reference
from localization.logs.chunks import Source, merge_channels
from localization.logs.clock_sync import ClockPlan, Item, merge, plan_clocks
from localization.logs.decode import MessageStats, UnusableError, frame_name, stamp_ns
from localization.logs.event_decoder import EventDecoder, TopicDecoder, decode_item
from localization.logs.references import reference_decoder
from localization.logs.serialization import LogDeserializer
from localization.logs.sources import open_source
from localization.logs.topic_roles import REFERENCE_TYPES, TopicChooser, TopicOverrides, choose_roles
from localization.logs.transforms import FixedTransforms
from motion_models.robot import Mount, Robot

_GPS = "/fix"
_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_TF_READ_NS = 10_000_000_000  # of ROS 1, where static transforms are repeated every 0.1 to 1 s on /tf
_JOINT_STATES_READ = 500  # first messages that are searched for joint names


def open_log(path: Path | str, robot: Robot, topics: TopicOverrides = TopicOverrides()) -> Log:  # noqa: B008 (frozen)
    """Open a ROS 1 bag, a ROS 2 bag folder or a bare .mcap of ``robot``.

    Nothing but the index and a few messages is read. Raises `LogError` if it cannot be used at all, `TopicError` if ``topics``
    names one that is not there or carries something else.

    >>> from motion_models import load_robot
    >>> log = open_log("tests/data/aces/aces.mcap", load_robot("aces"))
    >>> f"{log.duration_s:.0f} s, wheels {log.sources.wheels.topic}, LiDAR {log.sources.lidar.topic}"
    '1366 s, wheels /odom, LiDAR /scan'
    """
    path = Path(path)
    return Log(path, open_source(path), robot, topics)


class Log:
    """A log of a robot; made by `open_log`. Its iterators read the file anew each time and hold about a second of it."""

    def __init__(self, path: Path, source: Source, robot: Robot, topics: TopicOverrides) -> None:
        self.path, self.robot = path, robot
        self.source = source
        """The file itself, with its raw messages."""
        self.channels = merge_channels(source.channels)
        """Topics and types in the log."""
        count = sum(channel.count for channel in self.channels)
        if count < 2:
            found = "no message" if count == 0 else "only one message"
            raise LogError(" ".join([f"log '{path}' holds {found}; motion needs more.", *source.warnings]))
        self.start_ns, self.end_ns = source.start_ns, source.end_ns
        """Time of recording of the first and the last message."""
        self.types: dict[str, str] = {}
        """Type of each topic."""
        for channel in sorted(self.channels, key=lambda c: -c.count):  # of a topic with two types, the more frequent one counts
            self.types.setdefault(channel.topic, channel.type)
        self._stats_by_topic: dict[str, MessageStats] = {}
        self._overrides = topics
        self._chooser = TopicChooser(path.name, self.channels, robot, topics)
        roles = choose_roles(path.name, self._chooser, robot, topics, self._joint_names)
        self.sources = roles.sources
        """Topic of each role."""
        self.wheels_error = roles.wheels_error
        """Why `events` will refuse, if it will."""
        self._joints, self._arms, self._choice_notes = roles.joints, roles.arms, roles.warnings
        self._mount_notes: list[str] = []
        self.frames: dict[str, str] = {}
        """Frame of the first message of each topic that is used."""
        self._clocks = self._plan_event_clocks()

    @property
    def duration_s(self) -> float:
        """From the first to the last message, by the time of recording [s]."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def reference_topic(self) -> str | None:
        """The option's reference, else the robot file's, else GPS by its usual name; if the log has it and if it can be one."""
        asked = self._overrides.reference
        names = (self.robot.topics.reference, _GPS) if asked is None else (asked,)
        there = self._chooser.of_type(*REFERENCE_TYPES)
        return next((name for name in names if name in there), None)

    def events(self) -> Iterator[Event]:
        """Wheel, CG, IMU samples and scans by header stamp, never decreasing; within a topic always increasing.

        Raises `TopicError` if the joint states, the only source of wheels, have no wheel joint of the robot.
        """
        if self.wheels_error is not None:
            raise TopicError(" ".join([str(self.wheels_error), *self.damage()]))  # what was lost may be why
        stats = self._stats_by_topic["events"] = MessageStats()
        return self._events(stats)

    def references(self, topic: str) -> Iterator[Reference]:
        """Reference poses of a pose, odometry, transform or GPS topic, by header stamp. GPS: east and north of the first fix.

        Raises `TopicError` if the log has no such topic or if it carries something else.
        """
        self._chooser.require(topic, REFERENCE_TYPES, "--reference")
        stats = self._stats_by_topic[topic] = MessageStats()
        decode = reference_decoder(self.types[topic])
        clocks = self._clock_plan([*(s.topic for s in self.sources.used()), topic])
        return merge(self._items({topic: TopicDecoder(0, decode)}, stats), clocks, stats)

    @cached_property
    def mounts(self) -> Mapping[str, Mount]:
        """Pose of each sensor's frame in the body frame: the log's, and the robot file's for frames that are missing in the log."""
        transforms = FixedTransforms()
        tf = [channel for channel in self.channels if channel.type in _TF_TYPES]
        static = [channel for channel in tf if channel.topic.endswith("tf_static")]
        decode = LogDeserializer(tf, is_ros1=self.source.is_ros1)
        left = sum(channel.count for channel in static)
        for raw in self.source.messages([channel.topic for channel in static]) if left else ():
            left -= 1
            _try(lambda raw=raw: transforms.add(decode(raw), is_static=True))  # type: ignore[misc]
            if left == 0:
                break
        if self.source.is_ros1:
            moving = [channel.topic for channel in tf if not channel.topic.endswith("tf_static")]
            for raw in self.source.messages(moving) if moving else ():
                if raw.log_ns > self.start_ns + _TF_READ_NS:
                    break
                _try(lambda raw=raw: transforms.add(decode(raw), is_static=False))  # type: ignore[misc]
        found = transforms.mounts()
        self._mount_notes = transforms.warnings()
        for frame in transforms.contradictions().keys() & self.robot.mounts.keys():
            del found[frame]  # the robot file decides
        return {"base_link": Mount(), **self.robot.mounts, **found}

    def damage(self) -> list[str]:
        """Warnings about which of its files could not be read, and how much could, so far."""
        return list(dict.fromkeys(self.source.warnings))

    def warnings(self) -> list[str]:
        """Warnings about everything that was lost, corrected or chosen by default so far: `damage` first."""
        found = [*self.damage(), *self._mount_notes, *self._choice_notes]
        for stats in self._stats_by_topic.values():
            found += stats.describe()
        return list(dict.fromkeys(found))

    def _events(self, stats: MessageStats) -> Iterator[Event]:
        decoder = EventDecoder(self.sources, self._joints, self._arms, self.robot, stats)
        for payload in merge(self._items(decoder.decoders, stats), self._clocks, stats):
            yield from decoder.events(payload)

    def _items(self, decoders: Mapping[str, TopicDecoder], stats: MessageStats) -> Iterator[Item]:
        decode = LogDeserializer([c for c in self.channels if c.topic in decoders], is_ros1=self.source.is_ros1)
        for raw in self.source.messages(decoders.keys()):
            if raw.type == self.types[raw.topic]:
                item = decode_item(raw.topic, raw.log_ns, partial(decode, raw), decoders[raw.topic], stats)
                if item is not None:
                    yield item

    def _first_messages(self, topic: str, most: int) -> Iterator[tuple[int, Any]]:
        """The first decodable messages of a topic, with their time of recording."""
        decode = LogDeserializer([c for c in self.channels if c.topic == topic], is_ros1=self.source.is_ros1)
        for number, raw in enumerate(self.source.messages([topic])):
            if number >= most:
                return
            try:
                message = decode(raw)
            except UnusableError:
                continue
            if raw.type == self.types[topic] and hasattr(message, "header"):
                yield raw.log_ns, message

    def _joint_names(self, topic: str) -> Iterator[list[str]]:
        return (message.name for _, message in self._first_messages(topic, _JOINT_STATES_READ))

    def _plan_event_clocks(self) -> ClockPlan:
        return self._clock_plan([source.topic for source in self.sources.used()])

    def _clock_plan(self, topics: list[str]) -> ClockPlan:
        first: dict[str, tuple[int, int]] = {}
        for topic in topics:
            for log_ns, message in self._first_messages(topic, 10):
                self.frames.setdefault(topic, frame_name(message.header.frame_id))
                if stamp_ns(message):
                    first[topic] = log_ns, stamp_ns(message)
                    break
        return plan_clocks(first)


def _try(action: Callable[[], None]) -> None:
    try:
        action()
    except UnusableError:
        return
