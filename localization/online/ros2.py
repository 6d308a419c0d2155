"""ROS 2 topics through rclpy, where a ROS 2 installation is sourced, as bytes."""

from __future__ import annotations

import importlib
import time
from collections.abc import Collection, Mapping
from typing import Any

from localization.errors import DoorError
from localization.online.transport import Received

_LATEST, _LATCHED_DEPTH, _DEPTH = 50, 100, 10


class RclpyTransport:
    """See `Transport`. Domain, interfaces and middleware are those of the ROS environment."""

    is_ros1 = False
    place, elsewhere = "the ROS environment's domain", "Is ROS_DOMAIN_ID the robot's?"

    def __init__(self, node: str = "skidloc") -> None:
        """Raises `DoorError` where no ROS 2 is sourced."""
        try:
            self._rclpy: Any = importlib.import_module("rclpy")
            self._qos: Any = importlib.import_module("rclpy.qos")
        except ImportError as error:
            raise DoorError(f"rclpy cannot be imported ({error}): source a ROS 2 installation, or use --door dds.") from error
        self._rclpy.init(args=[])
        self._node = self._rclpy.create_node(node)
        self._heard: list[Received] = []
        self._subscriptions: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}

    def subscribe(self, topic: str, kind: str, *, is_latched: bool) -> None:
        q = self._qos
        quality = q.QoSProfile(
            depth=_LATCHED_DEPTH if is_latched else _LATEST,
            reliability=q.ReliabilityPolicy.RELIABLE if is_latched else q.ReliabilityPolicy.BEST_EFFORT,
            durability=q.DurabilityPolicy.TRANSIENT_LOCAL if is_latched else q.DurabilityPolicy.VOLATILE,
        )

        def on_message(data: bytes) -> None:
            self._heard.append(Received(topic, time.monotonic_ns(), bytes(data)))

        self._subscriptions[topic] = self._node.create_subscription(_message_class(kind), topic, on_message, quality, raw=True)

    def keep(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        for topic in set(self._subscriptions) - set(topics):
            self._node.destroy_subscription(self._subscriptions.pop(topic))

    def advertise(self, topic: str, kind: str) -> None:
        self._writers[topic] = self._node.create_publisher(_message_class(kind), topic, _DEPTH)

    def publish(self, topic: str, data: bytes) -> None:
        self._writers[topic].publish(data)

    def take(self, timeout_s: float, patience_s: float = 0.0) -> list[Received]:
        self._rclpy.spin_once(self._node, timeout_sec=timeout_s)
        while self._heard:
            before = len(self._heard)
            self._rclpy.spin_once(self._node, timeout_sec=0.0)
            if len(self._heard) == before:
                break
        found, self._heard = self._heard, []
        return found

    def publishers(self) -> Mapping[str, set[str]]:
        return {topic: {info.topic_type for info in self._node.get_publishers_info_by_topic(topic)} for topic in self._subscriptions}

    def close(self) -> None:
        self._node.destroy_node()
        self._rclpy.try_shutdown()


def _message_class(kind: str) -> Any:
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)
