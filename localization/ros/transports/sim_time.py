"""Simulated time: another transport's messages with times of receiving by /clock."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from localization.logs.decode import UnusableError
from localization.logs.serialization import decoder
from localization.ros.transports.base import Received, ServiceHandler, Transport

CLOCK, CLOCK_TYPE = "/clock", "rosgraph_msgs/msg/Clock"


class SimTimeTransport:
    """See `Transport`. Messages before the first of /clock are dropped, for their time is not known (use_sim_time of ROS 2)."""

    def __init__(self, transport: Transport) -> None:
        self._transport, self._now_ns = transport, 0
        self._decode = decoder(CLOCK_TYPE, is_ros1=transport.is_ros1)
        self.is_ros1, self.place, self.elsewhere = transport.is_ros1, transport.place, transport.elsewhere
        transport.subscribe(CLOCK, CLOCK_TYPE, is_latched=False)

    def subscribe(self, topic: str, kind: str, *, is_latched: bool) -> None:
        self._transport.subscribe(topic, kind, is_latched=is_latched)

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        self._transport.restrict([*topics, CLOCK], urgent)

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        self._transport.advertise(topic, kind, is_latched=is_latched)

    def publish(self, topic: str, data: bytes) -> None:
        self._transport.publish(topic, data)

    def offer_service(self, name: str, kind: str, handler: ServiceHandler) -> bool:
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
        return {topic: kinds for topic, kinds in self._transport.publishers().items() if topic != CLOCK}

    def now_ns(self) -> int:
        return self._now_ns

    @property
    def epoch_ns(self) -> int:
        return 0

    def close(self) -> None:
        self._transport.close()
