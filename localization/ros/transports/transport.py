"""What a transport to a robot must do: bytes of topics in and out; their times by the system's clock or a simulated one."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

from localization.errors import TransportError
from localization.logs.decode import UnusableError
from localization.logs.serialization import decoder

LAST_DOMAIN = 230

CLOCK, CLOCK_TYPE = "/clock", "rosgraph_msgs/msg/Clock"


_QUEUE_S = 2.0
"""Time for which messages of sensors wait for the node [s]: a pause of the process that loses nothing."""
_FASTEST_HZ = {"sensor_msgs/msg/LaserScan": 50.0, "sensor_msgs/msg/PointCloud2": 20.0}
_FASTEST_OTHER_HZ = 400.0
"""Rates that are not exceeded by LiDARs, by type, and by wheels and IMUs [Hz]."""


def queue_depth(kind: str) -> int:
    """How many messages of a sensor's type ``kind`` wait at most: those of `_QUEUE_S` at the fastest rate."""
    return round(_QUEUE_S * _FASTEST_HZ.get(kind, _FASTEST_OTHER_HZ))


class Received(NamedTuple):
    """A message as it came."""

    topic: str
    received_ns: int
    """By the transport's clock (`Transport.now_ns`)."""
    data: bytes


class ServiceReply(NamedTuple):
    """Answer to a request; `Empty` has none of it, services of nav2 and slam_toolbox whether it succeeded."""

    is_success: bool
    message: str
    code: int = 255
    """`result` of what failed, where that is a number: as nav2_msgs/LoadMap has them, 255 for all other failures."""
    point: Mapping[str, float] = MappingProxyType({})
    """Fields of the point that was asked for, as robot_localization/FromLL and ToLL do."""


ServiceHandler = Callable[[Any], ServiceReply]
"""Given the `data` of a SetBool request, or the name of a file or the point in others; True for Empty and Trigger."""


class Transport(Protocol):
    """Topics are named as in ROS (`/scan`), types as in ROS 2 (`sensor_msgs/msg/LaserScan`)."""

    is_ros1: bool
    """Bytes are ROS 1's, not CDR."""
    place: str
    """Where it is, for messages: `domain 0 on interface lo`."""
    elsewhere: str
    """What to do where a robot is not discovered there: a sentence, or empty."""

    def subscribe(self, topic: str, kind: str, *, is_latched: bool, is_command: bool = False) -> None:
        """Receive ``topic``. ``is_latched``: earlier messages too (tf_static); ``is_command``: each message of a reliable publisher, also
        one that is sent before both sides know of each other; else as sensor data, the newest only."""

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        """Receive only these of the topics subscribed to, from now on; `take` returns at once for those that are ``urgent``."""

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        """Open ``topic`` for `publish`. ``is_latched``: the last message is kept for those who subscribe later."""

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message on a topic that was advertised; it never waits for those who receive it."""

    def has_readers(self, topic: str) -> bool:
        """Whether somebody receives ``topic``, which was advertised; true where the transport does not know it."""

    def offer_service(self, name: str, kind: str, handler: ServiceHandler) -> bool:
        """Answer requests of ``kind`` (`std_srvs/srv/Trigger`) by ``handler``, inside `take`; False where the transport has no services."""

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """Messages that came since the last call; waits for at most ``timeout_s`` if there are none.

        It may let others wait for ``batch_s`` unless an urgent one comes: to wake up for each costs more than to read it.
        """

    def publishers(self) -> Mapping[str, set[str]]:
        """Types that others publish, by topic, as far as it is known."""

    def now_ns(self) -> int:
        """The clock of `Received.received_ns`."""

    @property
    def epoch_ns(self) -> int:
        """What turns that clock into the time of ROS, which stamps are compared with."""

    def close(self) -> None:
        """Leave the network. No other method may be called afterwards."""


class MonotonicTime:
    """The clock of transports whose time is that of the operating system: it never jumps. No services; who receives is not known."""

    _epoch_ns: int | None = None

    def now_ns(self) -> int:
        """Time of the operating system's monotonic clock [ns]."""
        return time.monotonic_ns()

    @property
    def epoch_ns(self) -> int:
        """What turns the monotonic clock into the wall clock's time [ns], read once: a wall clock that is set meanwhile moves nothing."""
        if self._epoch_ns is None:
            self._epoch_ns = time.time_ns() - time.monotonic_ns()
        return self._epoch_ns

    def offer_service(self, name: str, kind: str, handler: ServiceHandler) -> bool:
        """Never: there are no services."""
        return False

    def has_readers(self, topic: str) -> bool:
        """True."""
        return True


def default_domain(environment: Mapping[str, str] = os.environ) -> int:
    """ROS 2's domain by ROS_DOMAIN_ID, 0 without it. Raises `TransportError`."""
    value = environment.get("ROS_DOMAIN_ID") or "0"
    if not (value.isdecimal() and int(value) <= LAST_DOMAIN):
        raise TransportError(
            f"ROS_DOMAIN_ID is '{value}'; ROS 2's domains are the numbers 0 to {LAST_DOMAIN}. Correct it, or pass --domain."
        )
    return int(value)


class SimTimeTransport:
    """See `Transport`. Messages before the first of /clock are dropped, for their time is not known (use_sim_time of ROS 2)."""

    def __init__(self, transport: Transport) -> None:
        self._transport, self._now_ns = transport, 0
        self._decode = decoder(CLOCK_TYPE, is_ros1=transport.is_ros1)
        self.is_ros1, self.place, self.elsewhere = transport.is_ros1, transport.place, transport.elsewhere
        transport.subscribe(CLOCK, CLOCK_TYPE, is_latched=False)

    def subscribe(self, topic: str, kind: str, *, is_latched: bool, is_command: bool = False) -> None:
        """Receive ``topic`` by the wrapped transport."""
        self._transport.subscribe(topic, kind, is_latched=is_latched, is_command=is_command)

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        """Receive only these of the topics subscribed to, by the wrapped transport; /clock stays."""
        self._transport.restrict([*topics, CLOCK], urgent)

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        """Open ``topic`` for `publish`, by the wrapped transport."""
        self._transport.advertise(topic, kind, is_latched=is_latched)

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message by the wrapped transport."""
        self._transport.publish(topic, data)

    def has_readers(self, topic: str) -> bool:
        """Whether somebody receives ``topic`` on the wrapped transport."""
        return self._transport.has_readers(topic)

    def offer_service(self, name: str, kind: str, handler: ServiceHandler) -> bool:
        """Answer requests of ``kind`` by ``handler``, by the wrapped transport; False where it has no services."""
        return self._transport.offer_service(name, kind, handler)

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """At once: times of batches would be those of the wall."""
        found = []
        for received in self._transport.take(timeout_s):
            if received.topic == CLOCK:
                self._set_clock(received.data)
            elif self._now_ns or received.topic.endswith("tf_static"):
                found.append(received._replace(received_ns=self._now_ns))
        return found

    def _set_clock(self, data: bytes) -> None:
        try:
            clock = self._decode(data).clock
        except UnusableError:
            return
        self._now_ns = clock.sec * 10**9 + clock.nanosec

    def publishers(self) -> Mapping[str, set[str]]:
        """Types that others publish on the wrapped transport, by topic, without /clock."""
        return {topic: kinds for topic, kinds in self._transport.publishers().items() if topic != CLOCK}

    def now_ns(self) -> int:
        """The newest time of /clock; 0 before the first."""
        return self._now_ns

    @property
    def epoch_ns(self) -> int:
        """0: /clock is the time of ROS."""
        return 0

    def close(self) -> None:
        """Leave the wrapped transport's network."""
        self._transport.close()
