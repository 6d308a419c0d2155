"""Open any log (ROS 1 bags, ROS 2 folders, bare files, whole or cut off), and read its events, references, sensor mounts and warnings."""

from __future__ import annotations

import math
import re
import struct
import tempfile
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import cached_property, partial
from itertools import islice
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from localization.errors import LogError, TopicError
from localization.events import Event, Reference, Scan
from localization.logs import mcap, ros1, sqlite
from localization.logs.chunks import DamagedError, RawMessage, Source, decompress_file, merge_channels
from localization.logs.clock_sync import FIRST_MESSAGES, ClockPlan, FirstMessage, Item, merge, odd_rates, plan_clocks
from localization.logs.decode import MessageStats, UnusableError, frame_name, stamp_ns
from localization.logs.event_decoder import EventDecoder, FrozenWheel, TopicDecoder, decode_item, late_ns, rate_error
from localization.logs.reference_topics import reference_decoder
from localization.logs.serialization import LogDeserializer
from localization.logs.split import SplitSource
from localization.logs.topic_names import find_in_namespace, is_measured_outside
from localization.logs.topic_roles import REFERENCE_TYPES, Sides, TopicChooser, TopicOverrides, choose_roles
from localization.logs.transforms import FixedTransforms
from localization.logs.wheel_messages import TF_TYPES, odometry_edge
from localization.messages import Message, message
from motion_models.input_files import check_file, open_input, read_text
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_GPS = "/fix"
_TF_READ_NS = 10_000_000_000  # in ROS 1, and from simulators, fixed transforms are repeated every 0.1 to 1 s on /tf
_TRANSFORMS_READ = 2000  # first messages of /tf that are searched for the odometry's
_FIRST_READ_NS = 20_000_000_000  # of a topic, for its latency; a long log is not read to its end for one that is slow
_RATES_READ_NS, _RATES_READ_BYTES = 120_000_000_000, 300_000_000  # from the start, for the rates of clocks: .2 % is .24 s then
_POINTS_READ = 100  # first messages of a point that may be the centre of gravity
_JOINT_STATES_READ = 500  # first messages that are searched for joint names

_MAX_METADATA_BYTES = 4 << 20
"""Largest size of metadata.yaml [B]. It has some kB for a hundred topics and 200 B for each file that a recording was split into."""


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
        self.path, self.source = path, source
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
        self._decoder: EventDecoder | None = None  # of the last `events`
        self._overrides = topics
        self._chooser = TopicChooser(path.name, self.channels, robot, topics)
        roles = choose_roles(
            path.name, self._chooser, robot, topics, self._joint_names, self._odometry_edge, self._mean_point, self._scan_frame
        )
        self.robot = roles.robot
        """The robot, its wheel joints by the log's names."""
        self.sources = roles.sources
        """Topic of each role."""
        self.wheels_error = roles.wheels_error
        """Why `events` will refuse, if it will."""
        self._joints, self._arms, self._choice_notes = roles.joints, roles.arms, roles.warnings
        self._mount_notes: list[Message] = []
        self.frames: dict[str, str] = {}
        """Frame of the first message of each topic that is used."""
        self._clocks = self._plan_event_clocks()

    @property
    def duration_s(self) -> float:
        """From the first to the last message, by the time of recording [s]."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def period_s(self) -> Mapping[str, float]:
        """Median time from message to message, by stamp, of each topic that is used [s], where its first messages show it."""
        return self._clocks.period_s

    @property
    def behind_s(self) -> Mapping[str, float]:
        """Time of recording less stamp of each stamped topic that is used [s], by its first messages: the latency, where clocks agree."""
        return {topic: (self._clocks.offset_ns - offset) * 1e-9 for topic, offset in self._clocks.latency_ns.items()}

    @property
    def shifted_s(self) -> Mapping[str, float]:
        """Shift of the stamps of each topic whose clock is far from the others' [s]: they are moved to the time of recording."""
        return {topic: shift * 1e-9 for topic, shift in self._clocks.shifts_ns.items()}

    def rate_errors(self) -> dict[str, float]:
        """By how much faster than the recorder's the clock of a topic in use runs [s/s], where it is another than the other topics', by the
        headers of the first minutes."""
        return odd_rates(self._stamp_offsets())

    def _stamp_offsets(self) -> Iterator[tuple[str, int, int]]:
        """Topic, time of recording, and stamp less that [ns], of messages that begin with a header."""
        topics, form = set(self.behind_s), "<xxxxII" if self.source.is_ros1 else "<xxxxiI"
        size = 0
        for raw in self.source.messages(topics):
            size += len(raw.data)
            if raw.log_ns > self.start_ns + _RATES_READ_NS or size > _RATES_READ_BYTES:
                return
            is_known = self.source.is_ros1 or raw.data[1:2] == b"\x01"  # little-endian
            if is_known and len(raw.data) >= struct.calcsize(form) and raw.type == self.types[raw.topic]:
                seconds, rest = struct.unpack_from(form, raw.data)
                yield raw.topic, raw.log_ns, seconds * 1_000_000_000 + rest - raw.log_ns

    @property
    def reference_topic(self) -> str | None:
        """The option's reference, else the robot file's, else GPS by its usual name, else the only topic that by its name is measured from
        outside; if the log has it and if it can be one."""
        asked = self._overrides.reference
        names = (self.robot.topics.reference, _GPS) if asked is None else (asked,)
        there = self._chooser.of_type(*REFERENCE_TYPES)
        named = next((name for name in names if name in there), None)
        if named is not None or asked is not None:
            return named
        outside = [topic for topic in there if is_measured_outside(topic)]
        return find_in_namespace(self.robot.topics.reference, there) or (outside[0] if len(outside) == 1 else None)

    @property
    def no_wheels(self) -> str:
        """Why nothing can be estimated from wheels; "" where the log has some, or where options leave them out."""
        if self.sources.wheels is not None:
            return ""
        return str(self.wheels_error) if self.wheels_error is not None else self._chooser.no_wheels()

    def events(self) -> Iterator[Event]:
        """Wheel, CG, IMU samples and scans by header stamp, never decreasing; within a topic always increasing.

        Raises `TopicError` if the joint states, the only source of wheels, have no wheel joint of the robot.
        """
        if self.wheels_error is not None:
            raise TopicError(" ".join([str(self.wheels_error), *self.damage()]))  # what was lost may be why
        stats = self._stats_by_topic["events"] = MessageStats()
        return self._events(stats)

    @property
    def overrides(self) -> TopicOverrides:
        """Topics that were asked for."""
        return self._overrides

    @property
    def joints(self) -> Sides:
        """Wheel joints of the left and of the right side that the log has; empty where the wheels are no joint states."""
        return self._joints

    def readings(self, decoders: Mapping[str, TopicDecoder]) -> Iterator[Any]:
        """Payloads of ``decoders`` (by topic) as they are, in order of stamps, by the same clocks as `events`."""
        stats = MessageStats()
        return merge(self._items(decoders, stats), self._clocks_with(decoders), stats)

    def scans(self) -> Iterator[Scan]:
        """Scans or clouds of the LiDARs alone, with the ranges of their drivers; none without a LiDAR."""
        topics = [lidar.topic for lidar in self.sources.lidars]
        if topics:
            decoder = EventDecoder(self.sources, self._joints, self._arms, self.robot, MessageStats(), self.period_s)
            yield from self.readings({topic: decoder.decoders[topic] for topic in topics})

    def references(self, topic: str) -> Iterator[Reference]:
        """Reference poses of a pose, odometry, transform or GPS topic, by header stamp. GPS: east and north of the first fix.

        Raises `TopicError` if the log has no such topic or if it carries something else.
        """
        self._chooser.require(topic, REFERENCE_TYPES, "--reference")
        stats = self._stats_by_topic[topic] = MessageStats()
        decode = reference_decoder(self.types[topic])
        return merge(self._items({topic: TopicDecoder(0, decode)}, stats), self._clocks_with([topic]), stats)

    @cached_property
    def mounts(self) -> Mapping[str, Mount]:
        """Pose of each sensor's frame in the body frame: the log's, and the robot file's for frames that are missing in the log."""
        transforms = FixedTransforms()
        tf = [channel for channel in self.channels if channel.type in TF_TYPES]
        static = [channel for channel in tf if channel.topic.endswith("tf_static")]
        decode = LogDeserializer(tf, is_ros1=self.source.is_ros1)
        left = sum(channel.count for channel in static)
        for raw in self.source.messages([channel.topic for channel in static]) if left else ():
            left -= 1
            _try(lambda raw=raw: transforms.add(decode(raw), is_static=True))  # type: ignore[misc]
            if left == 0:
                break
        if self.source.is_ros1 or self._unmounted(transforms):
            moving = [channel.topic for channel in tf if not channel.topic.endswith("tf_static")]
            for raw in self.source.messages(moving) if moving else ():
                if raw.log_ns > self.start_ns + _TF_READ_NS:
                    break
                _try(lambda raw=raw: transforms.add(decode(raw), is_static=False))  # type: ignore[misc]
        found = transforms.mounts()
        self._mount_notes = [*transforms.warnings(), *transforms.describe_moving(self._unmounted(transforms))]
        for frame in transforms.contradictions().keys() & self.robot.mounts.keys():
            del found[frame]  # the robot file decides
        return self.robot.with_mounts(found)

    def _unmounted(self, transforms: FixedTransforms) -> set[str]:
        """Frames of sensors in use whose mounts neither the log's ``transforms`` so far nor the robot file have."""
        used = {s.topic for s in (*self.sources.lidars, self.sources.imu) if s is not None}
        frames = {frame for topic, frame in self.frames.items() if topic in used and frame}
        return frames - transforms.mounts().keys() - self.robot.mounts.keys()

    def damage(self) -> list[Message]:
        """Warnings about which of its files could not be read, and how much could, so far."""
        return list(dict.fromkeys(self.source.warnings))

    def warnings(self) -> list[Message]:
        """Warnings about everything that was lost, corrected or chosen by default so far: `damage` first."""
        found = [*self.damage(), *self._mount_notes, *self._choice_notes]
        for stats in self._stats_by_topic.values():
            found += stats.describe()
        return list(dict.fromkeys(found))

    def frozen_wheels(self) -> tuple[FrozenWheel, ...]:
        """Wheel joints whose encoders failed in the `events` that were read last, so far; what they lost is replaced there."""
        return () if self._decoder is None else self._decoder.from_joints.frozen_wheels()

    def add_notes(self, notes: Iterable[Message]) -> None:
        """Add sentences to `warnings`, before those about topics."""
        self._choice_notes = [*notes, *self._choice_notes]

    def _events(self, stats: MessageStats) -> Iterator[Event]:
        decoder = self._decoder = EventDecoder(self.sources, self._joints, self._arms, self.robot, stats, self.period_s)
        for payload in merge(self._items(decoder.decoders, stats), self._clocks, stats):
            yield from decoder.events(payload)

    def _items(self, decoders: Mapping[str, TopicDecoder], stats: MessageStats) -> Iterator[Item]:
        decode = LogDeserializer([c for c in self.channels if c.topic in decoders], is_ros1=self.source.is_ros1)
        rates = {s.topic: error for s in self.sources.used() if (error := rate_error(s.kind, self.robot.clock))}
        for raw in self.source.messages(decoders.keys()):
            if raw.type == self.types[raw.topic]:
                decoder = decoders[raw.topic]
                if raw.topic in rates:
                    drift_ns = round(rates[raw.topic] * (raw.log_ns - self.start_ns))
                    decoder = decoder._replace(late_ns=decoder.late_ns + drift_ns)
                item = decode_item(raw.topic, raw.log_ns, partial(decode, raw), decoder, stats)
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

    def _scan_frame(self, topic: str) -> str:
        return next((frame_name(message.header.frame_id) for _, message in self._first_messages(topic, 1)), "")

    def _mean_point(self, topic: str) -> FloatArray | None:
        points = [(message.point.x, message.point.y) for _, message in self._first_messages(topic, _POINTS_READ)]
        points = [point for point in points if math.isfinite(sum(point))]
        return np.median(points, axis=0) if points else None

    def _odometry_edge(self, topic: str) -> tuple[str, str] | None:
        decode = LogDeserializer([c for c in self.channels if c.topic == topic], is_ros1=self.source.is_ros1)
        return odometry_edge(
            message for raw in islice(self.source.messages([topic]), _TRANSFORMS_READ) if (message := _or_none(decode, raw))
        )

    def _plan_event_clocks(self) -> ClockPlan:
        return self._clock_plan([source.topic for source in self.sources.used()])

    def _clocks_with(self, topics: Iterable[str]) -> ClockPlan:
        """Clocks of the topics in use and of ``topics``: alone, one would be the common clock whatever its epoch."""
        used = [source.topic for source in self.sources.used()]
        return self._clocks if {*topics} <= {*used} else self._clock_plan([*used, *topics])

    def _clock_plan(self, topics: list[str]) -> ClockPlan:
        first: dict[str, list[FirstMessage]] = {}
        late = {source.topic: late_ns(source.kind, self.robot.clock) for source in self.sources.used()}
        for topic in topics:
            found = first[topic] = []
            for log_ns, found_message in self._first_messages(topic, 2 * FIRST_MESSAGES):
                frame = frame_name(found_message.header.frame_id)
                self.frames.setdefault(topic, frame)
                if stamp_ns(found_message):
                    found.append(FirstMessage(log_ns, stamp_ns(found_message) - late.get(topic, 0), frame))
                if len(found) >= FIRST_MESSAGES or (len(found) > 2 and log_ns - found[0].log_ns > _FIRST_READ_NS):
                    break
        return plan_clocks(first)


def open_source(path: Path) -> Source:
    """Open the log at ``path``. Raises `LogError` if it does not exist, is no log, or nothing in it can be read."""
    if not path.exists():
        raise LogError(f"no log '{path}': there is no such file or folder.")
    try:
        return _open_folder(path) if path.is_dir() else _open_file(path)
    except OSError as error:
        raise LogError(f"log '{path}' cannot be read: {error.strerror}.") from error


def require_file(path: Path) -> None:
    """Raises `LogError` for a path that is no regular file (reading a FIFO may never end)."""
    try:
        check_file(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise LogError(f"log '{path}' cannot be read: {error.strerror}.") from error


class DecompressedSource:
    """A storage file that the recorder compressed as a whole, as far as it decompresses."""

    def __init__(self, path: Path) -> None:
        self._folder = tempfile.TemporaryDirectory()  # removed when this object is
        target = Path(self._folder.name) / path.stem
        require_file(path)
        try:
            stopped = decompress_file(path, target)
        except OSError as error:
            where = f"'{path}' cannot be decompressed into '{self._folder.name}': {error.strerror}"
            raise LogError(f"{where}. Set TMPDIR to a folder with more room.") from error
        self._inner = _open_file(target)
        self.is_ros1, self.channels = self._inner.is_ros1, self._inner.channels
        self.start_ns, self.end_ns = self._inner.start_ns, self._inner.end_ns
        self._warnings = [message("damaged_files.compressed", file=path.name, reason=stopped)] if stopped else []

    @property
    def warnings(self) -> list[Message]:
        """Warnings about what was lost so far."""
        return [*self._warnings, *self._inner.warnings]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """The messages of these topics in order of log time."""
        return self._inner.messages(topics)


def _or_none(decode: Callable[[RawMessage], Any], raw: RawMessage) -> Any:
    try:
        return decode(raw)
    except UnusableError:
        return None


def _try(action: Callable[[], None]) -> None:
    try:
        action()
    except UnusableError:
        return


def _open_folder(path: Path) -> Source:
    """A ROS 2 folder: the files that metadata.yaml names, in its order, or, where that is damaged, all storage files, by name."""
    try:
        names, listed = _read_metadata(path / "metadata.yaml")
        missing = [name for name in names if not (path / name).exists()]
        if missing:
            raise DamagedError(f"its files {', '.join(missing)} are missing")
        parts: list[Source] = [_open_part(path / name) for name in names]
    except FileNotFoundError:
        return _recover_folder(path, "metadata.yaml is missing")
    except (DamagedError, LogError) as error:
        return _recover_folder(path, str(error).rstrip("."))
    count = sum(channel.count for part in parts for channel in part.channels)
    lost = message("damaged_files.fewer", folder=path.name, listed=listed, count=count)
    return SplitSource(parts, [lost] if count < listed else [])


def _read_metadata(path: Path) -> tuple[list[str], int]:
    """Names of the storage files, and how many messages they hold. Raises `DamagedError` and `FileNotFoundError`."""
    require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the parser, about names that come twice
            content = YAML(typ="safe").load(read_text(path, _MAX_METADATA_BYTES))["rosbag2_bagfile_information"]
        names, listed = content["relative_file_paths"], content["message_count"]
    except FileNotFoundError:
        raise
    except Exception as error:  # the parser raises its own errors, type errors and recursion errors
        raise DamagedError("metadata.yaml is damaged") from error
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names) or type(listed) is not int:
        raise DamagedError("metadata.yaml is damaged")
    # as rosbag2 wrote them before its version 4, with the folder's name before them
    return [PurePath(name).name for name in names], listed


def _open_part(path: Path) -> Source:
    return DecompressedSource(path) if path.suffix == ".zstd" else _open_file(path)


def _recover_folder(path: Path, reason: str) -> Source:
    files = sorted((f for f in path.iterdir() if f.name.removesuffix(".zstd").endswith((".mcap", ".db3")) and f.is_file()), key=_natural)
    if not files:
        bags = sorted(f.name for f in path.iterdir() if f.suffix == ".bag")
        inside = f" ROS 1 bags in it: {', '.join(bags)}; name one of them." if bags else ""
        raise LogError(f"folder '{path}' is not a ROS 2 bag: {reason}, and it holds no .mcap or .db3 file.{inside}")
    parts: list[Source] = []
    names = ", ".join(f.name for f in files)
    notes = [message("damaged_files.not_whole", folder=path.name, reason=reason, files=names)]
    for file in files:
        try:
            parts.append(_open_part(file))
        except LogError as error:
            notes.append(message("damaged_files.unread_file", reason=str(error)))
    if not parts:
        raise LogError(" ".join(notes))
    return SplitSource(parts, notes)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sorts run_2 before run_10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", path.name)]


def _open_file(path: Path) -> Source:
    require_file(path)
    with open_input(path) as file:
        head = file.read(16)
    if not head:
        raise LogError(f"log '{path}' is empty.")
    if head.startswith(b"version https://"):
        raise LogError(f"'{path}' is a pointer of Git LFS, not the log itself: `git lfs pull` downloads it.")
    if head.startswith(ros1.MAGIC):
        return ros1.Ros1Bag(path)
    if head.startswith(mcap.MAGIC):
        return mcap.McapFile(path)
    if not head.startswith(sqlite.MAGIC) and path.suffix == ".db3":
        return sqlite.RecoveredSqlite(path, "its first page is not that of a database")
    if not head.startswith(sqlite.MAGIC):
        raise LogError(f"'{path}' is not a log: it is neither a ROS 1 bag (.bag), nor an MCAP file (.mcap), nor a ROS 2 bag folder.")
    try:
        return sqlite.SqliteFile(path)
    except DamagedError as reason:
        return sqlite.RecoveredSqlite(path, str(reason))
