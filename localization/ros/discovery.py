"""Before the start: who is there. The topics of a robot are heard for a moment, as a log's are looked at before it is read."""

from __future__ import annotations

import contextlib
import difflib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from localization.errors import DoorError
from localization.logs.clock_sync import ClockPlan, plan_clocks
from localization.logs.decode import stamp_ns
from localization.logs.message_stats import UnusableError
from localization.logs.serialization import decoder, live_channel
from localization.logs.topic_roles import TYPES, TopicChooser, TopicOverrides, TopicRoles, choose_roles, short_type
from localization.logs.transforms import FixedTransforms
from localization.ros.topic_names import Names
from localization.ros.transports.base import Received, Transport
from motion_models.robot import Mount, Robot

TF_STATIC, TF_TYPE = "/tf_static", "tf2_msgs/msg/TFMessage"
_POLL_S, _SETTLE_S, _TELL_AGAIN_S = 0.1, 1.0, 30.0
_MOST_KEPT = 20_000
"""What is heard before the start is used, but nobody's memory shall be filled by it."""


class LiveTransforms:
    """What comes on /tf_static."""

    def __init__(self, body: str, *, is_ros1: bool) -> None:
        """``body``: the robot's frame."""
        self._decode, self._fixed, self._body = decoder(TF_TYPE, is_ros1=is_ros1), FixedTransforms(), body

    def hear(self, data: bytes) -> None:
        """Take in a message; bytes that are none say nothing."""
        with contextlib.suppress(UnusableError):
            self._fixed.add(self._decode(data), is_static=True)

    def mounts(self) -> Mapping[str, Mount]:
        """Of all frames so far that are tied to the body's."""
        return self._fixed.mounts(self._body)

    @property
    def problem(self) -> str | None:
        """A sentence where there are transforms, but none of the robot's frame."""
        frames = sorted(self._fixed.frames())
        if not frames or self._body in frames:
            return None
        near = difflib.get_close_matches(self._body, frames, n=1)
        nearest = f" Did you mean '{near[0]}'?" if near else ""
        return f"base_link_frame '{self._body}' is not on /tf_static, which has {', '.join(frames)}.{nearest}"


@dataclass(frozen=True)
class Heard:
    """What there is to run on."""

    parts: TopicRoles
    mounts: Mapping[str, Mount]
    transforms: LiveTransforms
    """What mounts are known by: more may come."""
    plan: ClockPlan
    start_ns: int
    """First stamp of the topics in use."""
    backlog: Sequence[Received]
    """What came meanwhile, in order."""


class Listener:
    """Subscribes to all that a robot may have. `listen` ends when all of it that is published was heard."""

    def __init__(self, transport: Transport, robot: Robot, topics: TopicOverrides, names: Names, body: str) -> None:
        """Topics of ``robot`` and ``topics`` are resolved names; ``body`` is the robot's frame."""
        self._tf_static = names.resolve(TF_STATIC)
        self._transport, self._robot, self._topics = transport, robot, topics
        self.candidates: dict[str, str] = {}
        """Type by topic."""
        for kind, message_type in TYPES.items():
            asked = getattr(topics, kind)
            topic = getattr(robot.topics, kind) if asked is None else asked
            if topic:
                self.candidates.setdefault(topic, message_type)
        for topic, message_type in self.candidates.items():
            transport.subscribe(topic, message_type, is_latched=False)
        transport.subscribe(self._tf_static, TF_TYPE, is_latched=True)
        self._asked = {topic for kind in TYPES if (topic := getattr(topics, kind))}
        self._decoders = {topic: decoder(kind, is_ros1=transport.is_ros1) for topic, kind in self.candidates.items()}
        self._transforms = LiveTransforms(body, is_ros1=transport.is_ros1)
        self._backlog: list[Received] = []
        self._counts: Counter[str] = Counter()
        self._first: dict[str, tuple[int, int]] = {}

    def listen(
        self, wait_s: float, needed: Iterable[str], tell: Callable[[str], None], epoch_ns: int, is_over: Callable[[], bool]
    ) -> Heard:
        """Wait for wheels or a LiDAR, for the topics ``needed``, and for at most ``wait_s`` [s] for others that somebody publishes.

        Those that are silent are told, again and again. ``epoch_ns`` makes times of the wall of times of receiving. Raises `DoorError`
        for a topic that carries another type.
        """
        needed = {*needed, *self._asked}
        begin = told = time.monotonic()
        said, first = "", None
        while not is_over():
            for received in self._transport.take(_POLL_S):
                self._hear(received, epoch_ns)
            now = time.monotonic()
            published = self._transport.publishers()
            self._check_types(published)
            if first is None and any(self.candidates[topic] in _MOVING for topic in self._counts):
                first = now
            late = first is not None and now - first >= wait_s
            waited_for = {*needed, *(() if late else published)} & set(self.candidates)
            silent = sorted(waited_for - set(self._counts))
            settled = first is not None and now - first >= min(wait_s, _SETTLE_S)
            has_mounts = bool(self._transforms.mounts()) or self._tf_static not in published or late
            if settled and not silent and has_mounts:
                for topic in sorted(set(published) & set(self.candidates) - set(self._counts)):
                    tell(f"begun without {topic}: it is published, but nothing comes.")
                return self._heard(epoch_ns)
            if now - begin > wait_s and ((now_said := self._silence(published, silent)) != said or now - told > _TELL_AGAIN_S):
                said, told = now_said, now
                tell(said)
        raise KeyboardInterrupt

    def _hear(self, received: Received, epoch_ns: int) -> None:
        if received.topic == self._tf_static:
            self._transforms.hear(received.data)
            return
        try:
            message = self._decoders[received.topic](received.data)
        except UnusableError:
            return
        if stamp_ns(message):
            self._first.setdefault(received.topic, (received.received_ns + epoch_ns, stamp_ns(message)))
        self._counts[received.topic] += 1
        self._backlog.append(received)
        if len(self._backlog) > _MOST_KEPT:
            del self._backlog[0]

    def _check_types(self, published: Mapping[str, set[str]]) -> None:
        for topic, kind in self.candidates.items():
            found = published.get(topic, set())
            if found and kind not in found and topic not in self._counts:
                others = " and ".join(sorted(short_type(other) for other in found))
                fits = [part for part, its_type in TYPES.items() if its_type in found]
                advice = f" Pass --topic.{fits[0].replace('_', '-')} {topic}." if fits else ""
                raise DoorError(f"'{topic}' carries {others}, not {short_type(kind)}.{advice}")

    def _silence(self, published: Mapping[str, set[str]], silent: Sequence[str]) -> str:
        there = sorted(topic for topic in published if topic in self.candidates)
        if silent:
            said = [f"{topic} ({'published, but nothing comes' if topic in published else 'nobody publishes it'})" for topic in silent]
            return f"waiting for {', '.join(said)}." + self._others(published, {self.candidates[topic] for topic in silent})
        wanted = ", ".join(f"{topic} ({short_type(kind)})" for topic, kind in self.candidates.items() if kind in _MOVING)
        waiting = f"waiting for wheels or a LiDAR: nothing comes on {wanted}."
        if not published:
            return f"{waiting} Nobody publishes anything in {self._transport.place}. {self._transport.elsewhere}".rstrip()
        return waiting + (f" Published are {', '.join(there)}." if there else "") + self._others(published, _MOVING)

    def _others(self, published: Mapping[str, set[str]], kinds: set[str]) -> str:
        """What is published under other names than the robot file's, and how to have it used."""
        found = []
        for topic, there in sorted(published.items()):
            for kind in sorted(there & kinds if topic not in self.candidates else ()):
                part = next(part for part, its_type in TYPES.items() if its_type == kind)
                found.append(f"{topic} is {short_type(kind)} (--topic.{part.replace('_', '-')} {topic})")
        return f" But {', '.join(found)}." if found else ""

    def _heard(self, epoch_ns: int) -> Heard:
        channels = [live_channel(topic, self.candidates[topic], count) for topic, count in self._counts.items()]
        chooser = TopicChooser("the live topics", channels, self._robot, self._topics)
        parts = choose_roles("the live topics", chooser, self._robot, self._topics, self._joint_names)
        if parts.wheels_error is not None:
            raise parts.wheels_error
        used = {source.topic for source in parts.sources.used()}
        first = {topic: stamps for topic, stamps in self._first.items() if topic in used}
        plan = plan_clocks(first)
        start_ns = min(
            (stamp + plan.shifts_ns.get(topic, 0) for topic, (_, stamp) in first.items()), default=epoch_ns + time.monotonic_ns()
        )
        mounts = {"base_link": Mount(), **self._robot.mounts, **self._transforms.mounts()}
        return Heard(parts, mounts, self._transforms, plan, start_ns, self._backlog)

    def _joint_names(self, topic: str) -> list[list[str]]:
        decode = self._decoders[topic]
        return [decode(received.data).name for received in self._backlog if received.topic == topic][:500]


_MOVING = {TYPES[kind] for kind in ("joint_states", "odometry", "scan", "points")}
