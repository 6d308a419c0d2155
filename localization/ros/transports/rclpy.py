"""ROS 2 topics through rclpy, where a ROS 2 installation is sourced, as bytes."""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from localization.errors import TransportError
from localization.ros.transports.transport import MonotonicTime, Received, ServiceHandler, queue_depth

_LATCHED_DEPTH, _DEPTH = 100, 10
_MAX_WAITED_NS = 60_000_000_000
"""Longest wait in the middleware's queue that is taken as one [ns]: its times are of the wall clock, which may be set."""
_MESSAGE_PACKAGES = ("std_msgs", "sensor_msgs", "nav_msgs", "geometry_msgs", "diagnostic_msgs", "tf2_msgs")
_SERVICE_PACKAGES = ("std_srvs",)
_POINT_FIELDS = ("ll_point", "map_point")
_REQUEST_FIELDS = ("data", "filename", "map_url", *_POINT_FIELDS)
"""What a handler is given: of std_srvs/SetBool, slam_toolbox's (De)SerializePoseGraph, nav2_msgs/SaveMap and LoadMap, and
robot_localization's FromLL and ToLL."""


def import_rclpy(*parts: str) -> list[Any]:
    """rclpy's modules ``parts`` (`""` for rclpy itself), where all packages of messages are there too. Raises `TransportError`."""
    try:
        found = [importlib.import_module(f"rclpy.{part}".rstrip(".")) for part in parts]
    except ImportError as error:
        raise TransportError(f"rclpy cannot be imported ({error}): source a ROS 2 installation, or use --door dds.") from error
    missing = [package for package in _MESSAGE_PACKAGES if not _is_importable(f"{package}.msg")]
    missing += [package for package in _SERVICE_PACKAGES if not _is_importable(f"{package}.srv")]
    if missing:
        distro = os.environ.get("ROS_DISTRO", "$ROS_DISTRO")
        names = " ".join(f"ros-{distro}-{package.replace('_', '-')}" for package in missing)
        raise TransportError(f"rclpy is there, but not its {', '.join(missing)}: apt install {names}, or use --door dds.")
    return found


class RclpyTransport(MonotonicTime):
    """See `Transport`. Domain, interfaces and middleware are those of the ROS environment."""

    is_ros1 = False
    place, elsewhere = "the ROS environment's domain", "Is ROS_DOMAIN_ID the robot's?"

    def __init__(self, name: str = "skidloc", namespace: str = "/") -> None:
        """A node of its own. Raises `TransportError` where no ROS 2 is sourced."""
        rclpy, signals = import_rclpy("", "signals")
        # Signals are the command's: with rclpy's handlers, Ctrl-C raises out of whatever waits.
        rclpy.init(args=[], signal_handler_options=signals.SignalHandlerOptions.NO)
        self._attach(rclpy.create_node(name, namespace=namespace))
        self._rclpy: Any = rclpy

    @classmethod
    def on_node(cls, node: Any) -> RclpyTransport:
        """On a node that exists, which `close` leaves alone."""
        made = cls.__new__(cls)
        made._attach(node)
        made._rclpy = None
        return made

    def _attach(self, node: Any) -> None:
        self._qos, executors = import_rclpy("qos", "executors")
        self._node, self._executor = node, executors.SingleThreadedExecutor()
        self._executor.add_node(node)
        self._received: list[Received] = []
        self._subscriptions: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}
        self._services: list[Any] = []

    def subscribe(self, topic: str, kind: str, *, is_latched: bool, is_command: bool = False) -> None:
        """Receive ``topic``: transient local and reliable where ``is_latched``, reliable where ``is_command``, else best effort."""
        q = self._qos
        quality = q.QoSProfile(
            depth=_LATCHED_DEPTH if is_latched else queue_depth(kind),
            reliability=q.ReliabilityPolicy.RELIABLE if is_latched or is_command else q.ReliabilityPolicy.BEST_EFFORT,
            durability=q.DurabilityPolicy.TRANSIENT_LOCAL if is_latched else q.DurabilityPolicy.VOLATILE,
        )

        def on_message(data: bytes, info: Mapping[str, int]) -> None:
            waited_ns = time.time_ns() - info.get("received_timestamp", 0)  # in the middleware's queue
            received_ns = time.monotonic_ns() - (waited_ns if 0 < waited_ns < _MAX_WAITED_NS else 0)
            self._received.append(Received(topic, received_ns, bytes(data)))

        self._subscriptions[topic] = self._node.create_subscription(_interface_class(kind), topic, on_message, quality, raw=True)

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        """Receive only these of the topics subscribed to, from now on; none is urgent, for `take` waits for no batch."""
        for topic in set(self._subscriptions) - set(topics):
            self._node.destroy_subscription(self._subscriptions.pop(topic))

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        """Open ``topic`` for `publish`: reliable, and transient local where ``is_latched``."""
        q = self._qos
        latched = q.QoSProfile(depth=1, reliability=q.ReliabilityPolicy.RELIABLE, durability=q.DurabilityPolicy.TRANSIENT_LOCAL)
        self._writers[topic] = self._node.create_publisher(_interface_class(kind), topic, latched if is_latched else _DEPTH)

    def offer_service(self, name: str, kind: str, handler: ServiceHandler) -> bool:
        """Answer requests of ``kind`` (`std_srvs/srv/Trigger`) by ``handler``, inside `take`; False where its package is not installed."""
        if not _is_importable(kind.rpartition("/")[0].replace("/", ".")):
            return False

        def answer(request: Any, response: Any) -> Any:
            reply = handler(next((getattr(request, name) for name in _REQUEST_FIELDS if hasattr(request, name)), True))
            if hasattr(response, "success"):
                response.success, response.message = reply.is_success, reply.message
            elif hasattr(response, "result"):
                is_flag = isinstance(response.result, bool)
                response.result = reply.is_success if is_flag else (0 if reply.is_success else reply.code)
            for point in (getattr(response, name) for name in _POINT_FIELDS if hasattr(response, name)):
                for name, value in reply.point.items():
                    setattr(point, name, value)
            return response

        self._services.append(self._node.create_service(_interface_class(kind), name, answer))
        return True

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message on a topic that was advertised."""
        self._writers[topic].publish(data)

    def has_readers(self, topic: str) -> bool:
        """Whether somebody receives ``topic``, which was advertised."""
        return bool(self._writers[topic].get_subscription_count())

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """In the order in which the middleware received them; ``batch_s`` is not used."""
        self._executor.spin_once(timeout_sec=timeout_s)
        while self._received:
            before = len(self._received)
            self._executor.spin_once(timeout_sec=0.0)
            if len(self._received) == before:
                break
        found, self._received = sorted(self._received, key=lambda received: received.received_ns), []
        return found

    def publishers(self) -> Mapping[str, set[str]]:
        """Types of others' publishers alone: to ROS 2 a topic exists by its subscribers too."""
        topics = {topic for topic, _ in self._node.get_topic_names_and_types()} | set(self._subscriptions)
        found = {topic: {info.topic_type for info in self._infos(topic)} for topic in topics - set(self._writers)}
        return {topic: kinds for topic, kinds in found.items() if kinds}

    def close(self) -> None:
        """Leave the network; a node that was given lives on."""
        self.release()
        self._executor.remove_node(self._node)
        self._executor.shutdown()
        if self._rclpy is not None:
            self._node.destroy_node()
            self._rclpy.try_shutdown()

    def release(self) -> None:
        """End all subscriptions, publishers and services; others may follow."""
        for topic in list(self._subscriptions):
            self._node.destroy_subscription(self._subscriptions.pop(topic))
        for topic in list(self._writers):
            self._node.destroy_publisher(self._writers.pop(topic))
        while self._services:
            self._node.destroy_service(self._services.pop())

    def _infos(self, topic: str) -> Sequence[Any]:
        own = self._node.get_name(), self._node.get_namespace()
        return [info for info in self._node.get_publishers_info_by_topic(topic) if (info.node_name, info.node_namespace) != own]


def _interface_class(kind: str) -> Any:
    """The class of a message or service, `pkg/msg/Type` or `pkg/srv/Type`."""
    package, group, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{group}"), name)


def _is_importable(module: str) -> bool:
    try:
        importlib.import_module(module)
    except ImportError:
        return False
    return True
