"""ROS 2 topics through zenoh, by the keys of rmw_zenoh (extra `zenoh`). Experimental: run between sessions of its own only.

Keys, tokens and attachments follow rmw_zenoh's design document and `liveliness_utils` (2025, Jazzy and later):
- data: `<domain>/<topic>/<pkg>::msg::dds_::<Type>_/<type hash>`, CDR as payload;
- attachment: sequence number (int64), time of sending (int64, ns), length 16 (one byte), gid (16 bytes), little endian;
- discovery: liveliness tokens `@ros2_lv/<domain>/<session>/<node>/<entity>/<kind>/<enclave>/<namespace>/<name>`, of endpoints also
  `/<topic>/<type>/<hash>/<QoS>`, with `%` for each `/`, kind NN for nodes, MP for publishers, MS for subscriptions.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import queue
import struct
import threading
import time
from collections.abc import Collection, Mapping
from typing import Any

from localization.errors import TransportError
from localization.logs.serialization import type_hash
from localization.ros.transports.transport import MonotonicTime, Received

try:
    import zenoh
    from zenoh import ext
except ImportError as error:
    raise TransportError(f"the transport 'zenoh' needs the extra 'zenoh': pip install 'skidloc[zenoh]' ({error}).") from error

ROUTER = "tcp/localhost:7447"
"""Where rmw_zenohd listens."""
_TOKENS = "@ros2_lv"
_DEPTH, _LATCHED_DEPTH, _MAX_QUEUE = 10, 100, 2000
_ATTACHMENT = struct.Struct("<qqB16s")
_BEST_EFFORT, _LATCHED, _RELIABLE = "2::,{}:,:,:,,", ":1:,{}:,:,:,,", "::,{}:,:,:,,"
"""QoS in tokens; what is left out is the default (reliable, volatile, keep last)."""


class ZenohTransport(MonotonicTime):
    """See `Transport`. One peer session with one node, ``name`` in ``namespace``, that connects to a router."""

    is_ros1 = False

    def __init__(self, domain: int = 0, endpoint: str | None = None, name: str = "skidloc", namespace: str = "/") -> None:
        """``endpoint`` of the router (`tcp/robot:7447`); by default `ROUTER`. ZENOH_SESSION_CONFIG_URI replaces the configuration, as in
        rmw_zenoh. Raises `TransportError`."""
        endpoint = endpoint or ROUTER
        self.place, self.elsewhere = f"domain {domain} of the zenoh router at {endpoint}", "Is rmw_zenohd running there?"
        try:
            self._session: Any = zenoh.open(_configuration(endpoint))
        except zenoh.ZError as error:
            raise TransportError(f"zenoh cannot be used with the router at '{endpoint}': {error}.") from error
        self._domain, self._owner = domain, f"{_mangle('')}/{_mangle(namespace)}/{name}"
        self._ids = itertools.count()
        self._queue: queue.Queue[tuple[int, Received]] = queue.Queue(_MAX_QUEUE)
        self._has_urgent, self._urgent = threading.Event(), frozenset[str]()
        self._subscribers: dict[str, list[Any]] = {}
        self._writers: dict[str, _Writer] = {}
        self._published: dict[str, tuple[str, str, str]] = {}
        self._lock = threading.Lock()
        self._node_token = self._session.liveliness().declare_token(self._token("NN"))
        tokens = f"{_TOKENS}/{domain}/*/*/*/MP/**"
        self._discovery = self._session.liveliness().declare_subscriber(tokens, self._on_token, history=True)

    def subscribe(self, topic: str, kind: str, *, is_latched: bool, is_command: bool = False) -> None:
        """Receive ``topic``: with the history of late publishers where ``is_latched``; reliable where ``is_command``."""
        key = f"{self._domain}{topic}/{_dds_type(kind)}/*"  # any hash: that of Humble is none

        def on_sample(sample: Any) -> None:
            if self._queue.full():
                self._drop_oldest()
            self._queue.put((_sent_ns(sample), Received(topic, time.monotonic_ns(), bytes(sample.payload))))
            if topic in self._urgent:
                self._has_urgent.set()

        history = ext.HistoryConfig(detect_late_publishers=True)
        subscriber = (
            ext.declare_advanced_subscriber(self._session, key, on_sample, history=history)
            if is_latched
            else self._session.declare_subscriber(key, on_sample)
        )
        quality = _LATCHED.format(_LATCHED_DEPTH) if is_latched else (_RELIABLE if is_command else _BEST_EFFORT).format(_DEPTH)
        self._subscribers[topic] = [subscriber, self._session.liveliness().declare_token(self._token("MS", topic, kind, quality))]

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        """Receive only these of the topics subscribed to, from now on; `take` returns at once for those that are ``urgent``."""
        self._urgent = frozenset(urgent)
        for topic in set(self._subscribers) - set(topics):
            for declared in self._subscribers.pop(topic):
                declared.undeclare()

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        """Open ``topic`` for `publish`: with a cache of one message where ``is_latched``."""
        token = self._token("MP", topic, kind, _LATCHED.format(1) if is_latched else _RELIABLE.format(_DEPTH))
        key = f"{self._domain}{topic}/{_dds_type(kind)}/{type_hash(kind)}"
        cache = ext.CacheConfig(1) if is_latched else None
        publisher = ext.declare_advanced_publisher(self._session, key, cache=cache, publisher_detection=is_latched)
        self._writers[topic] = _Writer(publisher, self._session.liveliness().declare_token(token), token)

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message on a topic that was advertised."""
        self._writers[topic].put(data)

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """In the order of sending: each topic has a callback of its own."""
        if batch_s > 0.0 and self._has_urgent.wait(batch_s):
            timeout_s = 0.0
        self._has_urgent.clear()
        found: list[tuple[int, Received]] = []
        try:
            found.append(self._queue.get(timeout=timeout_s) if timeout_s else self._queue.get_nowait())
            while True:
                found.append(self._queue.get_nowait())
        except queue.Empty:
            return [received for _, received in sorted(found, key=lambda entry: entry[0])]

    def publishers(self) -> Mapping[str, set[str]]:
        """Types that others publish, by topic, by the liveliness tokens of other sessions."""
        found: dict[str, set[str]] = {}
        with self._lock:
            entries = list(self._published.values())
        for session, topic, kind in entries:
            if session != str(self._session.zid()):
                found.setdefault(topic, set()).add(kind)
        return found

    def close(self) -> None:
        """Close the session. No other method may be called afterwards."""
        self._session.close()

    def _drop_oldest(self) -> None:
        try:
            self._queue.get_nowait()
        except queue.Empty:
            return

    def _on_token(self, sample: Any) -> None:
        token = str(sample.key_expr)
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._published.pop(token, None)
            elif (entry := read_publisher_token(token)) is not None:
                self._published[token] = entry

    def _token(self, entity: str, topic: str = "", kind: str = "", quality: str = "") -> str:
        node_id, entity_id = 0, next(self._ids)
        token = f"{_TOKENS}/{self._domain}/{self._session.zid()}/{node_id}/{entity_id}/{entity}/{self._owner}"
        return f"{token}/{_mangle(topic)}/{_dds_type(kind)}/{type_hash(kind)}/{quality}" if topic else token


class _Writer:
    """A publisher, its token, and the sequence number of its messages."""

    def __init__(self, publisher: Any, token: Any, key: str) -> None:
        self._publisher, self._token = publisher, token
        self._gid = hashlib.blake2b(key.encode(), digest_size=16).digest()  # rmw_zenoh: XXH3 of the same; it need only be unique
        self._count = 0

    def put(self, data: bytes) -> None:
        self._count += 1
        self._publisher.put(data, attachment=_ATTACHMENT.pack(self._count, time.time_ns(), len(self._gid), self._gid))


def _sent_ns(sample: Any) -> int:
    """Time of sending by the attachment [ns]; 0 without one."""
    attachment = b"" if sample.attachment is None else bytes(sample.attachment)
    return int(_ATTACHMENT.unpack(attachment)[1]) if len(attachment) == _ATTACHMENT.size else 0


def read_publisher_token(token: str) -> tuple[str, str, str] | None:
    """Session, topic and type (pkg/msg/Type) of a publisher's token; None for other tokens."""
    parts = token.split("/")
    if len(parts) != 13 or parts[0] != _TOKENS or parts[5] != "MP":
        return None
    session, topic, dds_type = parts[2], parts[9].replace("%", "/"), parts[10]
    package, group, _, name = dds_type.split("::") if dds_type.count("::") == 3 else ("", "", "", "")
    return (session, topic, f"{package}/{group}/{name.removesuffix('_')}") if package else None


def _mangle(name: str) -> str:
    """`%` for each `/`; an empty enclave and the root namespace are `%` too."""
    return (name or "/").replace("/", "%")


def _dds_type(kind: str) -> str:
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


def _configuration(endpoint: str) -> Any:
    """Configuration as of rmw_zenoh's default session: a peer without multicast that discovers others through the router."""
    if path := os.environ.get("ZENOH_SESSION_CONFIG_URI"):
        return zenoh.Config.from_file(path)
    config = zenoh.Config()
    settings = {
        "mode": '"peer"',
        "connect/endpoints": f'["{endpoint}"]',
        "listen/endpoints": '["tcp/localhost:0"]',
        "scouting/multicast/enabled": "false",
        "timestamping/enabled": "true",  # advanced publishers order their caches by it
    }
    for key, value in settings.items():
        config.insert_json5(key, value)
    return config
