"""What a door to a robot must do: bytes of topics in and out. All else is the same for ROS 2 and ROS 1 (`node`)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple, Protocol


class Received(NamedTuple):
    """A message as it came."""

    topic: str
    received_ns: int
    """By a clock that never jumps (`now_ns`)."""
    data: bytes


class Transport(Protocol):
    """Topics are named as in ROS (`/scan`), types as in ROS 2 (`sensor_msgs/msg/LaserScan`)."""

    is_ros1: bool
    """Bytes are ROS 1's, not CDR."""
    place: str
    """Where it is, for a person: `domain 0 on interface lo`."""
    elsewhere: str
    """How to hear what is not heard there: a sentence, or empty."""

    def subscribe(self, topic: str, kind: str, *, is_latched: bool) -> None:
        """Hear ``topic``. ``is_latched``: messages sent before matter too (tf_static); else as sensor data, the newest only."""

    def keep(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        """Hear only these of what was subscribed to, from now on; ``urgent`` of them are not waited with."""

    def advertise(self, topic: str, kind: str) -> None:
        """Will publish on ``topic``."""

    def publish(self, topic: str, data: bytes) -> None: ...

    def take(self, timeout_s: float, patience_s: float = 0.0) -> list[Received]:
        """What has come since the last call; waits for at most ``timeout_s`` if nothing has.

        For ``patience_s`` it may wait in any case, unless something urgent comes: to be woken for each message costs more than to read it.
        """

    def publishers(self) -> Mapping[str, set[str]]:
        """Types that others publish, by topic, as far as it is known."""

    def close(self) -> None: ...
