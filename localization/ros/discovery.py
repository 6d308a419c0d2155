"""Discovery before the start: which of a robot's topics are published, the first messages of each, and transforms of other nodes."""

from __future__ import annotations

import contextlib
import difflib
import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from localization.errors import TopicError, TransportError
from localization.logs.clock_sync import FIRST_MESSAGES, ClockPlan, FirstMessage, plan_clocks
from localization.logs.decode import UnusableError, frame_name, stamp_ns
from localization.logs.driver_messages import is_by_driver
from localization.logs.serialization import decoder, live_channel
from localization.logs.topic_roles import OTHER_TYPES, TYPES, TopicChooser, TopicOverrides, TopicRoles, choose_roles, names_of, short_type
from localization.logs.transforms import FixedTransforms
from localization.logs.wheel_messages import TF_TYPES, TWIST_TYPES, is_measured_twist
from localization.ros.node_config import Names
from localization.ros.transports.transport import Received, Transport
from motion_models.robot import Mount, Robot

_POLL_S, _SETTLE_S, _REPORT_PERIOD_S = 0.1, 1.0, 30.0
MAX_BACKLOG = 20_000
"""Messages that are stored before the start; the oldest are dropped."""

TF, TF_STATIC, TF_TYPE = "/tf", "/tf_static", "tf2_msgs/msg/TFMessage"
ROLE_GROUPS = (("joint_states", "odometry"), ("scan", "points"), ("imu",))
"""Roles whose topics are taken by their type alone, as of logs, each with those that take its place. A centre of gravity is a point like
any other: it is named."""
_LATE_MESSAGES = 5
"""Messages of a topic that appears after the start, before it is used."""
_MAX_JOINT_LISTS = 500
"""Lists of joints of one topic, at most: they bound the memory where joints change with every message."""
_CURRENT_S = 5.0
"""A conflict is reported for this long after the last foreign transform [s]."""


@dataclass(frozen=True)
class DiscoveredTopics:
    """Topics in use, what is known of their clocks and frames, and their first messages."""

    parts: TopicRoles
    mounts: Mapping[str, Mount]
    transforms: LiveTransforms
    """Source of the mounts: more may come."""
    plan: ClockPlan
    start_ns: int
    """First stamp of the topics in use."""
    backlog: Sequence[Received]
    """Messages received meanwhile, in order."""


class TopicDiscovery:
    """Subscribes to all topics that a robot may have; `discover` ends when each that is published has sent a message.

    What is published is a log that grows: where none of the robot file's topics of a role is published, all topics of its type are
    received, and roles are chosen among what has come as in a log (`choose_roles`).
    """

    def __init__(self, transport: Transport, robot: Robot, topics: TopicOverrides, names: Names, body: str) -> None:
        """Topics of ``robot`` and ``topics`` are resolved names; ``body`` is the robot's frame."""
        self._namespace = names.namespace.rstrip("/") + "/"
        self._own = names.resolve("~/").rstrip("/") + "/"
        self._tf_static = names.resolve(TF_STATIC)
        self._transport, self._robot, self._topics = transport, robot, topics
        self.candidates: dict[str, str] = {}
        """Type by topic."""
        for kind, message_type in TYPES.items():
            requested = getattr(topics, kind)
            for topic in names_of(getattr(robot.topics, kind) if requested is None else requested, kind):
                self.candidates.setdefault(topic, message_type)
        for topic, message_type in self.candidates.items():
            transport.subscribe(topic, message_type, is_latched=False)
        transport.subscribe(self._tf_static, TF_TYPE, is_latched=True)
        self._requested = {topic for kind in TYPES for topic in names_of(getattr(topics, kind) or "", kind)}
        self._decoders = {topic: decoder(kind, is_ros1=transport.is_ros1) for topic, kind in self.candidates.items()}
        self._transforms = LiveTransforms(body, is_ros1=transport.is_ros1)
        self.late: set[str] = set()
        """Topics that appeared after the start."""
        self._backlog: list[Received] = []
        self._counts: Counter[str] = Counter()
        self._first: dict[str, list[FirstMessage]] = defaultdict(list)
        self._joint_lists: dict[str, dict[tuple[str, ...], None]] = defaultdict(dict)
        """Lists of joints in the messages of a topic, in order."""

    def discover(
        self,
        wait_s: float,
        needed: Iterable[str],
        report: Callable[[str], None],
        is_over: Callable[[], bool],
        is_ready: Callable[[], bool] = lambda: True,
        patience_s: float = math.inf,
    ) -> DiscoveredTopics:
        """Wait for wheels or a LiDAR, for the topics ``needed``, and for at most ``wait_s`` [s] for others that are published.

        Until ``is_ready``, or ``patience_s`` after the first message of wheels or a LiDAR [s], messages are stored; as many as the store
        holds, then they wait in the transport.

        Silent ones are reported once it is ready, when they change and every half minute. Raises `TransportError` for a topic that
        carries another type, `KeyboardInterrupt` when ``is_over``.
        """
        needed = {*needed, *self._requested}
        begin = reported = time.monotonic()
        last_report, first = "", None
        self.adopt(self._transport.publishers())
        while not is_over():
            if is_ready() or len(self._backlog) < MAX_BACKLOG:
                for received in self._transport.take(_POLL_S, batch_s=_POLL_S):  # to ask who publishes takes longer than ten messages
                    self._receive(received)
            else:
                time.sleep(_POLL_S)
            now = time.monotonic()
            published = self._transport.publishers()
            self._check_types(published)
            self.adopt(published)
            if first is None and any(self.candidates[topic] in _ALL_MOTION_TYPES for topic in self._counts):
                first = now
            heard_s = -math.inf if first is None else now - first
            is_late = heard_s >= wait_s
            waited_for = {*needed, *(() if is_late else published)} & set(self.candidates)
            silent = sorted(waited_for - set(self._counts))
            is_settled = heard_s >= min(wait_s, _SETTLE_S)
            has_mounts = bool(self._transforms.mounts()) or self._tf_static not in published or is_late
            if is_settled and not silent and has_mounts and (is_ready() or heard_s >= patience_s):
                if (discovered := self._choose(published, report)) is not None:
                    return discovered
                first = now
            if (
                is_ready()
                and now - begin > wait_s
                and (first is None or silent)
                and ((text := self._silence(published, silent)) != last_report or now - reported > _REPORT_PERIOD_S)
            ):
                last_report, reported = text, now
                report(text)
        raise KeyboardInterrupt

    @property
    def has_clouds(self) -> bool:
        """Whether a cloud was received."""
        return any(self.candidates[topic] == TYPES["points"] for topic in self._counts)

    def _receive(self, received: Received) -> None:
        if received.topic == self._tf_static:
            self._transforms.insert(received.data)
            return
        if received.topic not in self._decoders:
            return
        try:
            message = self._decoders[received.topic](received.data)
        except UnusableError:
            return
        if hasattr(message, "header") and stamp_ns(message) and len(self._first[received.topic]) < FIRST_MESSAGES:
            wall_ns = received.received_ns + self._transport.epoch_ns
            self._first[received.topic].append(FirstMessage(wall_ns, stamp_ns(message), frame_name(message.header.frame_id)))
        lists = self._joint_lists[received.topic]
        if len(lists) < _MAX_JOINT_LISTS and hasattr(message, "name"):
            lists[tuple(message.name)] = None
        self._counts[received.topic] += 1
        self._backlog.append(received)
        if len(self._backlog) > MAX_BACKLOG:
            del self._backlog[0]

    def adopt(
        self, published: Mapping[str, set[str]], groups: Iterable[tuple[str, ...]] = ROLE_GROUPS, *, is_lacking: bool = False
    ) -> None:
        """Receive the topics that may have one of the roles of ``groups``, where none is published that an option or the robot file
        names, or where those that are have no such sensor (``is_lacking``)."""
        for role in (role for group in groups for role in self._open_roles(group, published, is_lacking=is_lacking)):
            for topic, kind in sorted(self.of_role(role, published).items()):
                if topic not in self.candidates:
                    self._receive_from(topic, kind)

    def _open_roles(self, group: tuple[str, ...], published: Mapping[str, set[str]], *, is_lacking: bool) -> tuple[str, ...]:
        """Roles of ``group`` whose topics are taken by their type."""
        named = {topic for role in group for topic in names_of(getattr(self._robot.topics, role), role)}
        has_option = any(getattr(self._topics, role) is not None for role in group)
        return () if has_option or not (is_lacking or named.isdisjoint(published)) else group

    def _choose(self, published: Mapping[str, set[str]], report: Callable[[str], None]) -> DiscoveredTopics | None:
        """The topics in use; None where joint states have no wheels, and others that are published are received from here on. Raises
        `TopicError`."""
        try:
            discovered = self._discovered()
        except TopicError:
            before = len(self.candidates)
            self.adopt(published, ROLE_GROUPS[:1], is_lacking=True)
            if len(self.candidates) == before:
                raise
            return None
        for topic in sorted(set(published) & set(self.candidates) - set(self._counts)):
            report(f"started without {topic}: it is published, but no message comes.")
        for sentence in self._unused(published, {source.topic for source in discovered.parts.sources.used()}):
            report(sentence)
        return discovered

    def watch_late(self, groups: Sequence[tuple[str, ...]]) -> None:
        """After the start, receive the topics of ``groups`` that are published by now, `insert_late` each message of these."""
        published = self._transport.publishers()
        self.adopt(published, groups, is_lacking=True)
        found = {topic for group in groups for role in group for topic in self.of_role(role, published)}
        for topic in sorted(found & self.candidates.keys() - self.late):
            if self.candidates[topic] in published[topic]:
                self.late.add(topic)
                self._transport.subscribe(topic, self.candidates[topic], is_latched=False)

    def insert_late(self, received: Received) -> DiscoveredTopics | None:
        """Once a late topic has sent some messages, the topics of all roles as they are chosen now; None where they cannot be used."""
        self._receive(received)
        self._backlog.clear()
        if self._counts[received.topic] != _LATE_MESSAGES:
            return None
        with contextlib.suppress(TopicError):  # diagnostics report a topic that is published and not used
            return self._discovered()
        return None

    def is_disabled(self, group: tuple[str, ...]) -> bool:
        """Whether options leave out all roles of ``group``."""
        return all(getattr(self._topics, role) == "" for role in group)

    def published(self) -> Mapping[str, set[str]]:
        """Types that others publish, by topic."""
        return self._transport.publishers()

    def of_role(self, role: str, published: Mapping[str, set[str]]) -> dict[str, str]:
        """Published topics in the namespace that may have ``role``, with the type by which they are read."""
        types = (TYPES[role], *OTHER_TYPES.get(role, ()))
        mine = [topic for topic in published if topic.startswith(self._namespace) and not topic.startswith(self._own)]
        fitting = {topic: [kind for kind in types if kind in published[topic] and _may_be(role, topic, kind)] for topic in mine}
        return {topic: kinds[0] for topic, kinds in fitting.items() if kinds}

    def _check_types(self, published: Mapping[str, set[str]]) -> None:
        for topic, kind in list(self.candidates.items()):
            found = published.get(topic, set())
            if found and kind not in found and topic not in self._counts:
                role = next(role for role, its_type in TYPES.items() if its_type == kind)
                others = sorted(found & {*OTHER_TYPES.get(role, ())} - {*TF_TYPES})
                if others:
                    self._subscribe_anew(topic, others[0])
                    continue
                carried = " and ".join(sorted(short_type(other) for other in found))
                fits = [part for part, its_type in TYPES.items() if its_type in found]
                advice = f" Pass --topic.{fits[0].replace('_', '-')} {topic}." if fits else ""
                raise TransportError(f"'{topic}' carries {carried}, not {short_type(kind)}.{advice}")

    def _subscribe_anew(self, topic: str, kind: str) -> None:
        """Receive ``topic`` as another type than the first one."""
        self._transport.restrict({*self.candidates, self._tf_static} - {topic})
        self._receive_from(topic, kind)

    def _receive_from(self, topic: str, kind: str) -> None:
        self._transport.subscribe(topic, kind, is_latched=False)
        self.candidates[topic], self._decoders[topic] = kind, decoder(kind, topic, is_ros1=self._transport.is_ros1)

    def _unused(self, published: Mapping[str, set[str]], used: set[str]) -> list[str]:
        """Sentences on published LiDARs and IMUs that are not used beside one that is."""
        found = []
        for role in ("scan", "points", "imu"):
            of_type = sorted(topic for topic, kinds in published.items() if TYPES[role] in kinds)
            chosen, others = [topic for topic in of_type if topic in used], [topic for topic in of_type if topic not in used]
            if chosen and others:
                both = f" Both: --topic.scan {','.join([*chosen, *others])}." if role == "scan" else ""
                found.append(f"{chosen[0]} is used and {', '.join(others)} not. Choose it with --topic.{role}.{both}")
        return found

    def _silence(self, published: Mapping[str, set[str]], silent: Sequence[str]) -> str:
        there = sorted(topic for topic in published if topic in self.candidates)
        if silent:
            idle, missing = "published, but no message comes", "no publisher"
            entries = ", ".join(f"{topic} ({idle if topic in published else missing})" for topic in silent)
            return f"waiting for {entries}." + self._others(published, {self.candidates[topic] for topic in silent})
        wanted = ", ".join(f"{topic} ({short_type(kind)})" for topic, kind in self.candidates.items() if kind in _MOTION_TYPES)
        waiting = f"waiting for wheels or a LiDAR: no messages come on {wanted}."
        if not published:
            return f"{waiting} No topic is published in {self._transport.place}. {self._transport.elsewhere}".rstrip()
        return waiting + (f" Published are {', '.join(there)}." if there else "") + self._others(published, _MOTION_TYPES)

    def _others(self, published: Mapping[str, set[str]], kinds: set[str]) -> str:
        """What is published under other names than the robot file's, and how to have it used."""
        found = []
        for topic, there in sorted(published.items()):
            for kind in sorted(there & kinds if topic not in self.candidates else ()):
                part = next(part for part, its_type in TYPES.items() if its_type == kind)
                found.append(f"{topic} is {short_type(kind)} (--topic.{part.replace('_', '-')} {topic})")
        return f" But {', '.join(found)}." if found else ""

    def _discovered(self) -> DiscoveredTopics:
        channels = [live_channel(topic, self.candidates[topic], count) for topic, count in self._counts.items()]
        chooser = TopicChooser("the live topics", channels, self._robot, self._topics)
        parts = choose_roles("the live topics", chooser, self._robot, self._topics, self._joint_names, scan_frame=self._scan_frame)
        if parts.wheels_error is not None:
            raise parts.wheels_error
        used = {source.topic for source in parts.sources.used()}
        first = {topic: stamps for topic, stamps in self._first.items() if topic in used}
        plan = plan_clocks(first)
        start_ns = min(plan.first_stamps(first), default=self._transport.epoch_ns + self._transport.now_ns())
        mounts = self._robot.with_mounts(self._transforms.mounts())
        return DiscoveredTopics(parts, mounts, self._transforms, plan, start_ns, self._backlog)

    def _scan_frame(self, topic: str) -> str:
        return self._first[topic][0].frame if self._first[topic] else ""

    def _joint_names(self, topic: str) -> list[tuple[str, ...]]:
        return list(self._joint_lists[topic])


_MOTION_ROLES = ("joint_states", "odometry", "scan", "points")
_MOTION_TYPES = {TYPES[role] for role in _MOTION_ROLES}
_ALL_MOTION_TYPES = {*_MOTION_TYPES, *(kind for role in _MOTION_ROLES for kind in OTHER_TYPES.get(role, ()))}


def _may_be(role: str, topic: str, kind: str) -> bool:
    """Whether messages of type ``kind`` on ``topic`` may have ``role`` by its name, where the type is not the role's own."""
    if kind == TYPES[role]:
        return True
    return is_by_driver(topic, kind) if role == "joint_states" else kind in TWIST_TYPES and is_measured_twist(topic)


class LiveTransforms:
    """Fixed transforms received on /tf_static."""

    def __init__(self, body: str, *, is_ros1: bool) -> None:
        """``body``: the robot's frame."""
        self._decode, self._fixed, self._body = decoder(TF_TYPE, is_ros1=is_ros1), FixedTransforms(), body

    def insert(self, data: bytes) -> None:
        """Add the transforms of a message; bytes that are no message are ignored."""
        with contextlib.suppress(UnusableError):
            self._fixed.add(self._decode(data), is_static=True)

    def mounts(self) -> Mapping[str, Mount]:
        """Mounts by frame, of all frames that are connected to the body's."""
        return self._fixed.mounts(self._body)

    @property
    def problem(self) -> str | None:
        """A message where there are transforms, but none of the robot's frame."""
        frames = sorted(self._fixed.frames())
        if not frames or self._body in frames:
            return None
        near = difflib.get_close_matches(self._body, frames, n=1)
        nearest = f" Did you mean '{near[0]}'?" if near else ""
        return f"base_link_frame '{self._body}' is not on /tf_static, which has {', '.join(frames)}.{nearest}"


class TransformConflicts:
    """Transforms of other nodes that end in the body's frame: a frame has one parent, published by one node (tf2)."""

    def __init__(self, body: str, *, is_ros1: bool) -> None:
        self._body = body
        self._decode = decoder(TF_TYPE, is_ros1=is_ros1)
        self._message: str | None = None
        self._until = 0.0

    def check(self, data: bytes, own: Iterable[bytes]) -> str | None:
        """A message where ``data`` of /tf holds such a transform for the first time.

        ``own``: what this node published in the last seconds, which some transports return.
        """
        if self._body.encode() not in data or any(data.startswith(mine) for mine in own):
            return None
        try:
            transforms = self._decode(data).transforms
        except UnusableError:
            return None
        parents = [frame_name(t.header.frame_id) for t in transforms if frame_name(t.child_frame_id) == self._body]
        if not parents:
            return None
        before, self._until = self._message, time.monotonic() + _CURRENT_S
        self._message = (
            f"another node publishes '{parents[0]}' -> '{self._body}' on /tf as well: the robot jumps between the two. Pass --node.no-tf "
            "(publish_tf: false), or switch it off there (diff_drive_controller: enable_odom_tf: false)."
        )
        return None if before == self._message else self._message

    def current(self) -> str | None:
        """The message, while such transforms arrive."""
        return self._message if time.monotonic() < self._until else None
