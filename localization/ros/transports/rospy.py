"""ROS 1 topics through rospy (`apt install python3-rospy`), as bytes."""

from __future__ import annotations

import functools
import importlib
import os
import queue
import sys
import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

from localization.errors import TransportError
from localization.logs.serialization import definition
from localization.ros.transports.transport import MonotonicTime, Received, queue_depth

_DEBIAN = Path("/usr/lib/python3/dist-packages")


def _import(name: str) -> Any:
    """A module of ROS 1, which Debian and Ubuntu install for the system's Python; it is not on the path of a virtual environment."""
    try:
        return importlib.import_module(name)
    except ImportError:
        if (_DEBIAN / "rospy").is_dir() and str(_DEBIAN) not in sys.path:
            sys.path.append(str(_DEBIAN))  # last: what is installed here comes first
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise TransportError(
            f"ROS 1 needs rospy, which cannot be imported ({error}): apt install python3-rospy, or source /opt/ros/.../setup.bash."
        ) from error


class RospyTransport(MonotonicTime):
    """See `Transport`."""

    is_ros1 = True
    elsewhere = "Is ROS_MASTER_URI the robot's?"

    def __init__(self, node: str = "skidloc") -> None:
        """Raises `TransportError` where rospy or the master is not there."""
        self._rospy, graph = _import("rospy"), _import("rosgraph")
        uri = os.environ.setdefault("ROS_MASTER_URI", "http://127.0.0.1:11311")
        if not graph.is_master_online():
            raise TransportError(f"no ROS 1 master answers at {uri}. Start roscore, or set ROS_MASTER_URI.")
        if urlparse(uri).hostname in ("localhost", "127.0.0.1"):
            os.environ.setdefault("ROS_IP", "127.0.0.1")  # listen there only
        self.place = f"the graph of {uri}"
        self._master = graph.Master(f"/{node}")
        self._rospy.init_node(node, disable_signals=True, anonymous=True)
        self._received: queue.SimpleQueue[Received] = queue.SimpleQueue()
        self._subscribers: dict[str, Any] = {}
        self._writers: dict[str, tuple[Any, type[Any]]] = {}

    def subscribe(self, topic: str, kind: str, *, is_latched: bool, is_command: bool = False) -> None:
        """Receive ``topic``; a latched message comes to whoever subscribes."""

        def on_message(message: Any) -> None:
            self._received.put(Received(topic, time.monotonic_ns(), message._buff))

        self._subscribers[topic] = self._rospy.Subscriber(
            topic, self._bytes_type(kind), on_message, queue_size=queue_depth(kind), tcp_nodelay=True
        )

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        """Receive only these of the topics subscribed to, from now on; none is urgent, for `take` waits for no batch."""
        for topic in set(self._subscribers) - set(topics):
            self._subscribers.pop(topic).unregister()

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        """Open ``topic`` for `publish`; the last message is kept for later subscribers where ``is_latched``."""
        made = self._bytes_type(kind)
        self._writers[topic] = self._rospy.Publisher(topic, made, queue_size=10, tcp_nodelay=True, latch=is_latched), made

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message on a topic that was advertised."""
        writer, made = self._writers[topic]
        message = made()
        message._buff = data
        writer.publish(message)

    def has_readers(self, topic: str) -> bool:
        """Whether somebody receives ``topic``, which was advertised."""
        return bool(self._writers[topic][0].get_num_connections())

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """In the order of arrival; ``batch_s`` is not used."""
        found = []
        try:
            found.append(self._received.get(timeout=timeout_s))
            while True:
                found.append(self._received.get_nowait())
        except queue.Empty:
            return found

    def publishers(self) -> Mapping[str, set[str]]:
        """Types that others publish, by topic, as the master lists them; they are named as in ROS 2."""
        return {topic: {_ros2_name(kind)} for topic, kind in self._master.getPublishedTopics("/") if topic not in self._writers}

    def close(self) -> None:
        """Shut the ROS node down. No other method may be called afterwards."""
        self._rospy.signal_shutdown("done")

    def _bytes_type(self, kind: str) -> type[Any]:
        return _bytes_type(self._rospy.AnyMsg, kind)


@functools.cache
def _bytes_type(base: type[Any], kind: str) -> type[Any]:
    """A message class of rospy for ``kind`` whose only content are its bytes."""
    text, digest = definition(kind, is_ros1=True)
    package, _, name = kind.split("/")

    def init(self: Any, *args: Any) -> None:
        self._buff = None

    made = {"_md5sum": digest, "_type": f"{package}/{name}", "_full_text": text, "_has_header": False, "__init__": init}
    return type(name, (base,), made)


def _ros2_name(kind: str) -> str:
    package, _, name = kind.rpartition("/")
    return f"{package}/msg/{name}"
