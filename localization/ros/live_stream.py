"""Live messages to events: late, lost, doubled and reordered ones, clocks that jump, sensors that leave and return.

Decoding, trusted stamps and dropped messages are those of logs (`logs.event_decoder`, `logs.clock_sync`), but nothing waits for messages
that may still come: an event goes to the pipeline when it is here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from localization.errors import CheckpointError
from localization.events import CgSample, Event
from localization.logs.clock_sync import Merger
from localization.logs.decode import ArmReading, MessageStats, Oddity
from localization.logs.event_decoder import CLOCKS, EventDecoder, JointsToWheels, OdometryToWheels, decode_item
from localization.logs.serialization import decoder
from localization.logs.topic_roles import TYPES, Sources
from localization.messages import Message, message
from localization.ros.discovery import DiscoveredTopics
from localization.ros.payloads import Payloads
from localization.ros.transports.transport import Received
from motion_models.robot import Robot

_NS = 1e-9
_OLDEST_S, _NEWEST_S = 3600.0, 1.0
_SILENT_S, _PERIODS = 1.0, 5.0
_NEAR, _PAST, _LONGEST_S = 0.95, 1.1, 0.12
_MIN_BEHIND_S, _MAX_LATENCY_S, _MIN_MESSAGES = 0.3, 0.1, 50
"""Time of receiving less stamp [s] of a clock that may be off, and the largest of one that is not; messages before they are compared."""


@dataclass(frozen=True)
class WheelAngles:
    """Accumulated angles of the wheels by each source: what a checkpoint holds besides the pipeline."""

    joints: JointsToWheels
    odometry: OdometryToWheels


class LiveStream:
    """Messages in, events out."""

    def __init__(self, discovered: DiscoveredTopics, robot: Robot, stats: MessageStats, epoch_ns: int, *, is_ros1: bool) -> None:
        """``epoch_ns``: what turns times of receiving into the time of ROS."""
        parts, self._stats, self._epoch_ns = discovered.parts, stats, epoch_ns
        self.sources: Sources = parts.sources
        self._event_decoder = EventDecoder(parts.sources, parts.joints, parts.arms, robot, stats, discovered.plan.period_s)
        late = {topic: decoder.late_ns for topic, decoder in self._event_decoder.decoders.items()}
        self._merger = Merger(discovered.plan.corrected(late), stats, is_live=True)
        self._decoders = {source.topic: decoder(source.type or TYPES[source.kind], is_ros1=is_ros1) for source in parts.sources.used()}
        self.topic_rates = {source.topic: TopicRate() for source in parts.sources.used()}
        """Rate of each topic in use."""
        self.payloads = Payloads(robot, parts.arms, discovered.mounts)
        self.on_reading: Callable[[Any], None] | None = None
        """Called with each reading as its driver published it, before anything is left out."""

    @property
    def wheel_angles(self) -> WheelAngles:
        """Angles of the wheels up to now, which a checkpoint stores."""
        return WheelAngles(self._event_decoder.from_joints, self._event_decoder.from_odometry)

    def restore(self, angles: WheelAngles) -> None:
        """Continue from the angles of another stream."""
        self._event_decoder.from_joints, self._event_decoder.from_odometry = angles.joints, angles.odometry

    def events(self, received: Received) -> Iterator[Event]:
        """The events that ``received`` makes, none or several."""
        decode = self._decoders.get(received.topic)
        if decode is None:
            return
        self.topic_rates[received.topic].count(received.received_ns)
        wall_ns = received.received_ns + self._epoch_ns
        item = decode_item(
            received.topic, wall_ns, partial(decode, received.data), self._event_decoder.decoders[received.topic], self._stats
        )
        if item is None:
            return
        for reading in self._merger.insert(item):
            if self.on_reading is not None:
                self.on_reading(reading)
            if isinstance(reading, ArmReading):
                self.payloads.insert_joints(reading)
            for event in self._event_decoder.events(reading):
                loaded = self.payloads.apply(event) if isinstance(event, CgSample) else event
                if loaded is not None:
                    yield loaded

    def sender_stamp_ns(self, stamp_ns: int, *, by_lidar: bool) -> int:
        """A stamp of an event in the present clock of its sender, which may have been set since the start."""
        source = self.sources.lidar if by_lidar and self.sources.lidar is not None else self.sources.wheels or self.sources.lidar
        return stamp_ns if source is None else stamp_ns - self._merger.shift_ns(source.topic)

    def silent(self, now_ns: int) -> dict[str, float]:
        """Seconds since the last message, of topics in use whose next one is overdue."""
        found = {topic: watch.silence(now_ns) for topic, watch in self.topic_rates.items()}
        return {topic: seconds for topic, seconds in found.items() if seconds is not None}

    def rates(self) -> dict[str, float]:
        """Messages per second of the topics in use, by their last dozen [Hz]; 0 of one that never came twice."""
        return {topic: watch.rate_hz for topic, watch in self.topic_rates.items()}

    def batch_s(self, now_ns: int) -> float:
        """How long messages that are not urgent may wait for others [s]: until shortly before the next scan. 0 without a LiDAR.

        To wake up for each takes longer than to read a few.
        """
        lidar = self.sources.lidar
        return 0.0 if lidar is None else self.topic_rates[lidar.topic].rest(now_ns, (_NEAR, _PAST))

    def behind(self) -> list[Message]:
        """Topics whose stamps are off the times of receiving, while those of the other sensors are not, as sentences."""
        sensors = {source.topic: CLOCKS[source.kind] for source in self.sources.used() if source.kind in CLOCKS}
        behind = {topic: late_s for topic, late_s in self._merger.behind_s(_MIN_MESSAGES).items() if topic in sensors}
        found = []
        for topic, late_s in behind.items():
            others = [abs(other) for name, other in behind.items() if sensors[name] != sensors[topic]]
            if others and abs(late_s) >= _MIN_BEHIND_S and max(others) <= _MAX_LATENCY_S:
                seconds, others_s = abs(late_s), max(others)
                if late_s > 0.0:
                    found.append(message("live_stream.behind", topic=topic, seconds=seconds, others_s=others_s))
                else:
                    found.append(message("live_stream.ahead", topic=topic, seconds=seconds, others_s=others_s))
        return found

    def dropped(self) -> list[Message]:
        """Messages that were corrected or dropped, as sentences."""
        found = []
        for name in (name for topic in self.topic_rates for name in self._stats.parts(topic)):
            for oddity in Oddity:
                if (count := self._stats.of(name, oddity)) and oddity is not Oddity.OUT_OF_ORDER:
                    kind = Oddity.LATE_LIVE if oddity is Oddity.LATE else oddity
                    found.append(kind.describe(name, count))
        return found


class TopicRate:
    """Time of the last message of a topic, and its mean period."""

    def __init__(self) -> None:
        self.last_ns: int | None = None
        """Time of the last message; None before the first [ns]."""
        self.period_s = 0.0
        """Mean period of the last dozen of messages [s]."""

    def count(self, now_ns: int) -> None:
        """Count a message that is received now."""
        if self.last_ns is not None:
            gap = (now_ns - self.last_ns) * _NS
            self.period_s += (min(gap, 10.0 * self.period_s + 0.01) - self.period_s) * 0.1
        self.last_ns = now_ns

    @property
    def rate_hz(self) -> float:
        """Messages per second [Hz]; 0 of a topic that never came twice."""
        return 1.0 / self.period_s if self.period_s > 0.0 else 0.0

    def rest(self, now_ns: int, parts: Sequence[float]) -> float:
        """Until the next of ``parts`` of the time to the next message is over [s]; 0 when all are."""
        since = self.period_s if self.last_ns is None else (now_ns - self.last_ns) * _NS
        return next((min(part * self.period_s - since, _LONGEST_S) for part in parts if since < part * self.period_s), 0.0)

    def silence(self, now_ns: int) -> float | None:
        """Seconds since the last message, where the next one is overdue; else None."""
        if self.last_ns is None:
            return None
        seconds = (now_ns - self.last_ns) * _NS
        return seconds if seconds > max(_SILENT_S, _PERIODS * self.period_s) else None


def check_age(head: Mapping[str, Any], stamp_ns: int, where: str) -> float:
    """Seconds from a state's last event to one of ``stamp_ns``. Raises `CheckpointError` where that is too long to continue."""
    age = (stamp_ns - int(head.get("stamp_ns", stamp_ns))) * _NS
    if not -_NEWEST_S <= age <= _OLDEST_S:
        what = f"{age / 3600.0:.1f} h old" if age > 0 else f"{-age:.1f} s ahead of the robot's clock"
        raise CheckpointError(f"the state in '{where}' is {what}: the robot may be anywhere. Remove it to start anew.")
    return age
