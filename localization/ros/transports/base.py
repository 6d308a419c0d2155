"""What a transport to a robot must do: bytes of topics in and out. All else is the same for ROS 2 and ROS 1 (`node`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple, Protocol


class Received(NamedTuple):
    """A message as it came."""

    topic: str
    received_ns: int
    """By the transport's clock (`Transport.now_ns`)."""
    data: bytes


class ServiceReply(NamedTuple):
    """Answer to a request of std_srvs; `Empty` has none of it."""

    is_success: bool
    message: str


ServiceHandler = Callable[[bool], ServiceReply]
"""Given the `data` of a SetBool request; True for Empty and Trigger."""


class Transport(Protocol):
    """Topics are named as in ROS (`/scan`), types as in ROS 2 (`sensor_msgs/msg/LaserScan`)."""

    is_ros1: bool
    """Bytes are ROS 1's, not CDR."""
    place: str
    """Where it is, for messages: `domain 0 on interface lo`."""
    elsewhere: str
    """What to do where a robot is not discovered there: a sentence, or empty."""

    def subscribe(self, topic: str, kind: str, *, is_latched: bool) -> None:
        """Receive ``topic``. ``is_latched``: earlier messages too (tf_static); else as sensor data, the newest only."""

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        """Receive only these of the topics subscribed to, from now on; `take` returns at once for those that are ``urgent``."""

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        """Open ``topic`` for `publish`. ``is_latched``: the last message is kept for those who subscribe later."""

    def publish(self, topic: str, data: bytes) -> None: ...

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

    def close(self) -> None: ...


class MonotonicTime:
    """The clock of transports whose time is that of the operating system: it never jumps. No services."""

    _epoch_ns: int | None = None

    def now_ns(self) -> int:
        return time.monotonic_ns()

    @property
    def epoch_ns(self) -> int:
        if self._epoch_ns is None:
            self._epoch_ns = time.time_ns() - time.monotonic_ns()
        return self._epoch_ns

    def offer_service(self, name: str, kind: str, handler: ServiceHandler) -> bool:
        return False
