"""ROS 2 topics without a ROS installation: DDS through cyclonedds (extra `ros2`), as ROS 2's own middlewares interoperate with it.

A ROS 2 topic `/scan` is DDS's `rt/scan`, a type `pkg/msg/Type` is `pkg::msg::dds_::Type_`. Messages pass as bytes, which
`logs.serialization` reads and writes as it does those of logs; cyclonedds gets the types' fields only for peers that ask for them.

There are no services: Fast DDS relates a reply to its request by an inline QoS of the sample (related_sample_identity), which cyclonedds's
Python API cannot write. A service that is discovered but never answers would be worse than none.

Every setting of Cyclone DDS was found necessary with Fast DDS 2.14 (Jazzy) or 3.2 (Kilted) as the other side.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import os
import re
import socket
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from localization.errors import TransportError
from localization.logs.serialization import Shape, encode, fields, make, type_hash
from localization.ros.transports.transport import LAST_DOMAIN, MonotonicTime, Received, queue_depth

try:
    import cyclonedds.core as dds
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import make_idl_struct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration
except ImportError as error:
    raise TransportError(
        f"ROS 2 topics without a ROS installation need the extra 'ros2': pip install 'skidloc[ros2]' ({error}). On aarch64, where"
        " cyclonedds has no wheel, that extra is zenoh (--transport zenoh, beside rmw_zenohd); or source ROS 2 and use rclpy."
    ) from error

_DEPTH, _LATCHED_DEPTH = 10, 100
_FASTEST_DRIFT = 1e-4  # of one clock against another
_RARE_NS = 50_000_000
"""Beside urgent messages, those of topics with few are looked for this often [ns]."""
_TYPE = re.compile(r"(\w+)::(?:msg::)dds_::(\w+)_")
_GRAPH_TOPIC, _GRAPH_TYPE = "ros_discovery_info", "rmw_dds_common/msg/ParticipantEntitiesInfo"

LOOPBACK, DEFAULT = "lo", "default"
_LOOPBACK_NAMES = ("lo", "localhost", "127.0.0.1")
_RANGES = ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT", "OFF")

# Fast DDS 3.2 sends type objects that Cyclone 11 cannot parse (`ddsi_xt_type_add_typeobj with invalid type object`): nothing is delivered.
# Topics are matched by type name here, so that they are not needed. 1.15: messages of Fast DDS (vendor 1.15) only.
_COMPATIBILITY = "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
# A cloud of 4 MB is one burst of datagrams. The kernel grants at most net.core.rmem_max; less is no error.
_BUFFER = '<Internal><SocketReceiveBufferSize min="default" max="4MB"/></Internal>'
# Without multicast a participant is found only by asking its port. By default Cyclone stops asking after 30 s: robots that start later, or
# again, were never found (9 of 9 restarts); like this they are within 0.5 s.
_ASKING = (
    "<SPDPInterval>1s</SPDPInterval><InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>"
)


class DdsTransport(MonotonicTime):
    """See `Transport`. One participant with one node, ``name`` in ``namespace``, which ROS 2's node list shows."""

    is_ros1 = False

    def __init__(self, domain: int = 0, interface: str = LOOPBACK, name: str = "skidloc", namespace: str = "/") -> None:
        """``interface`` is one of `choose_interface`; `lo` leaves nothing open to other machines. Raises `TransportError`."""
        if not 0 <= domain <= LAST_DOMAIN:
            raise TransportError(f"the domain is {domain}; ROS 2's domains are 0 to {LAST_DOMAIN}.")
        self.place = f"domain {domain} on interface {interface}"
        self.elsewhere = "Robots on other machines are discovered with --interface default." * (interface == LOOPBACK)
        try:
            with _bind_to(interface):
                self._domain = Domain(domain, configuration(interface))
                self._participant = DomainParticipant(domain, Qos(Policy.Userdata(b"enclave=/;")))
        except dds.DDSException as error:
            raise TransportError(f"DDS cannot be used on interface '{interface}', domain {domain}: {error}.") from error
        self._waiting, self._urgent, self._rare = (dds.WaitSet(self._participant) for _ in range(3))
        self._readers: list[_Reader] = []
        self._writers: dict[str, _Writer] = {}
        self._topics: dict[str, Topic[Any]] = {}
        self._found = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._last_take_ns, self._next_rare_ns = time.monotonic_ns(), 0
        self._clocks: dict[str, SenderClock] = {}
        self._name, self._namespace = name, namespace
        self._graph = None if os.environ.get("ROS_DISTRO") == "humble" else self._writer(_GRAPH_TOPIC, _GRAPH_TYPE, _latched_output())

    def subscribe(self, topic: str, kind: str, *, is_latched: bool, is_command: bool = False) -> None:
        """Receive ``topic``: transient local and reliable where ``is_latched``, reliable where ``is_command``, else best effort."""
        quality = _latched() if is_latched else _command() if is_command else _sensor_data(kind)
        reader = DataReader(self._participant, self._topic(_dds_name(topic), kind), _hashed(quality, kind))
        is_new = dds.ReadCondition(reader, dds.ViewState.Any | dds.InstanceState.Any | dds.SampleState.NotRead)
        self._waiting.attach(is_new)
        if is_rare := is_latched or is_command:
            self._rare.attach(is_new)
        self._readers.append(_Reader(topic, reader, is_new, is_rare))
        self._publish_graph()

    def restrict(self, topics: Collection[str], urgent: Collection[str] = ()) -> None:
        """Receive only these of the topics subscribed to, from now on; `take` returns at once for those that are ``urgent``."""
        for reader in self._readers:
            if reader.topic not in topics:
                self._waiting.detach(reader.is_new)
                self._rare.detach(reader.is_new)
            elif reader.topic in urgent:
                self._urgent.attach(reader.is_new)
        self._readers = [reader for reader in self._readers if reader.topic in topics]
        kept = {_GRAPH_TOPIC, *map(_dds_name, self._writers), *(_dds_name(reader.topic) for reader in self._readers)}
        self._topics = {name: topic for name, topic in self._topics.items() if name in kept}  # another type may follow
        self._publish_graph()

    def advertise(self, topic: str, kind: str, *, is_latched: bool = False) -> None:
        """Open ``topic`` for `publish`: reliable, and transient local where ``is_latched``."""
        self._writers[topic] = self._writer(_dds_name(topic), kind, _latched_output() if is_latched else _reliable())
        self._publish_graph()

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message on a topic that was advertised; a reader that is too slow loses it."""
        _write(self._writers[topic], data)

    def has_readers(self, topic: str) -> bool:
        """Whether somebody receives ``topic``, which was advertised."""
        return bool(self._writers[topic][0].get_matched_subscriptions())

    def take(self, timeout_s: float, batch_s: float = 0.0) -> list[Received]:
        """In the order of sending: after a pause, the messages of one topic must not all come before another's."""
        is_urgent = batch_s > 0.0 and self._urgent.wait(round(batch_s * 1e9))
        is_there = is_urgent or self._waiting.wait(round(timeout_s * 1e9))
        since, self._last_take_ns = self._last_take_ns, time.monotonic_ns()
        if not is_there:
            return []
        found: list[tuple[int, Received]] = []
        has_rare = False
        if not is_urgent or self._last_take_ns >= self._next_rare_ns:
            has_rare, self._next_rare_ns = bool(self._rare.wait(0)), self._last_take_ns + _RARE_NS
        for topic, reader, is_new, is_rare in self._readers:
            if (has_rare or not is_rare) and is_new.triggered:  # `take` costs more, and mostly one of them has messages
                samples = [sample for sample in reader.take(1000) if isinstance(sample, _Bytes)]
                sent = [int(sample.sample_info.source_timestamp) for sample in samples]
                newest = self._clocks.setdefault(topic, SenderClock()).receive_time_ns(max(sent, default=0), since, self._last_take_ns)
                came = receive_times(sent, since, newest)
                found += [(at, Received(topic, ns, sample)) for at, ns, sample in zip(sent, came, samples, strict=True)]
        found.sort(key=lambda entry: entry[0])
        return [received for _, received in found]

    def publishers(self) -> Mapping[str, set[str]]:
        """Types that others publish, by topic, among what came since the last call."""
        found: dict[str, set[str]] = {}
        for publication in self._found.read(1000):
            if publication.sample_info.instance_state != dds.InstanceState.Alive:
                continue  # of a disposed instance only the key is valid
            name, kind = publication.topic_name, _TYPE.fullmatch(publication.type_name)
            if name.startswith("rt/") and name[2:] not in self._writers:
                found.setdefault(name[2:], set()).add(f"{kind[1]}/msg/{kind[2]}" if kind else publication.type_name)
        return found

    def close(self) -> None:
        """Leave the network. No other method may be called afterwards."""
        self._readers.clear()
        self._writers.clear()
        self._topics.clear()
        del self._graph, self._waiting, self._urgent, self._rare, self._found, self._participant, self._domain

    def _topic(self, dds_name: str, kind: str) -> Topic[Any]:
        """One for a reader and a writer, whose qualities differ: a second one with another quality is refused."""
        if dds_name not in self._topics:
            self._topics[dds_name] = Topic(self._participant, dds_name, _bytes_type(kind), Qos(*_COMMON))
        return self._topics[dds_name]

    def _writer(self, dds_name: str, kind: str, quality: Qos) -> _Writer:
        return DataWriter(self._participant, self._topic(dds_name, kind), _hashed(quality, kind)), _bytes_type(kind)

    def _publish_graph(self) -> None:
        """The participant's node and its endpoints: ROS 2 lists nodes by these messages, not by DDS's own discovery."""
        if self._graph is None:
            return
        node = make(
            "rmw_dds_common/msg/NodeEntitiesInfo",
            node_namespace=self._namespace,
            node_name=self._name,
            reader_gid_seq=[_gid(reader.reader) for reader in self._readers],
            writer_gid_seq=[_gid(writer) for writer, _ in self._writers.values()],
        )
        _write(self._graph, encode(make(_GRAPH_TYPE, gid=_gid(self._participant), node_entities_info_seq=[node])))


class SenderClock:
    """Offset between the clock of a topic's sender and ours, by its messages with the shortest latency."""

    def __init__(self) -> None:
        self._offset_ns, self._known_ns = 1 << 80, 0

    def receive_time_ns(self, sent_ns: int, since_ns: int, now_ns: int) -> int:
        """When a message came that is found at ``now_ns`` and was not there at ``since_ns``: what had to wait for us came when it was
        sent. One that was sent before ``since_ns`` was late, or the sender's clock was set: it came now.
        """
        drift_ns = round((now_ns - self._known_ns) * _FASTEST_DRIFT)
        self._offset_ns, self._known_ns = min(now_ns - sent_ns, self._offset_ns + drift_ns), now_ns
        receive_time_ns = sent_ns + self._offset_ns
        return receive_time_ns if receive_time_ns > since_ns else now_ns


def receive_times(sent_ns: Sequence[int], since_ns: int, newest_ns: int) -> list[int]:
    """When messages came that were not there at ``since_ns``: the newest at ``newest_ns``, the others as long before as they were sent
    before it. ``sent_ns`` is by the sender's clock; a longer time than there was is scaled down to it.
    """
    last_sent_ns = max(sent_ns, default=0)
    # The first came after its predecessor, which was received in the last call: by the mean period.
    span_ns = (last_sent_ns - min(sent_ns, default=0)) * len(sent_ns) / max(len(sent_ns) - 1, 1)
    share = min((newest_ns - since_ns) / span_ns, 1.0) if span_ns > 0.0 else 0.0
    return [newest_ns - round((last_sent_ns - sent) * share) for sent in sent_ns]


_Writer = tuple["DataWriter[Any]", type[Any]]


class _Reader(NamedTuple):
    topic: str
    reader: DataReader[Any]
    is_new: dds.ReadCondition
    """Triggered while there are messages that were not taken."""
    is_rare: bool
    """The topic has few messages: it is only asked when one of these has some."""


def _write(writer: _Writer, data: bytes) -> None:
    sample = object.__new__(writer[1])
    vars(sample)["data_"] = data
    with contextlib.suppress(dds.DDSException):  # a reader that is too slow must not stop the robot
        writer[0].write(sample)


def _gid(entity: Any) -> Any:
    return make("rmw_dds_common/msg/Gid", data=np.frombuffer(entity.guid.bytes, np.uint8))


def _hashed(quality: Qos, kind: str) -> Qos:
    """``quality`` of an endpoint, with the hash of its type as ROS 2 puts it beside."""
    return Qos(Policy.Userdata(f"typehash={type_hash(kind)};".encode()), base=quality)


def _sensor_data(kind: str) -> Qos:
    latest = Policy.History.KeepLast(queue_depth(kind))
    return Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, latest, Policy.IgnoreLocal.Participant, *_COMMON)


def _command() -> Qos:
    reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
    return Qos(reliable, Policy.Durability.Volatile, Policy.History.KeepLast(_DEPTH), Policy.IgnoreLocal.Participant, *_COMMON)


def _latched() -> Qos:
    reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
    return Qos(reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(_LATCHED_DEPTH), *_COMMON)


def _reliable() -> Qos:
    reliable = Policy.Reliability.Reliable(duration(milliseconds=1))  # never wait for a slow reader
    return Qos(reliable, Policy.Durability.Volatile, Policy.History.KeepLast(_DEPTH), *_COMMON)


def _latched_output() -> Qos:
    """The last message, kept for late subscribers: the graph's quality in rmw_dds_common too."""
    reliable = Policy.Reliability.Reliable(duration(milliseconds=1))
    return Qos(reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(1), *_COMMON)


_COMMON = (Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),)


def _dds_name(topic: str) -> str:
    return "rt/" + topic.lstrip("/")


class _Bytes(bytes):
    """What a reader gives out; cyclonedds sets the attribute on it."""

    sample_info: Any


@functools.cache
def _struct(kind: str) -> type[Any]:
    package, _, name = kind.split("/")
    described = {field: _idl(shape) for field, shape in fields(kind)}
    made: type[Any] = make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", described)
    return made


def _idl(shape: Shape) -> Any:
    what, inside, *rest = shape
    if what == "message":
        return _struct(inside)
    if what == "array":
        return types.array[_idl(inside), rest[0]]
    if what == "sequence":
        return types.sequence[_idl(inside)]
    return {"string": str, "bool": bool, "byte": types.uint8, "char": types.uint8}.get(inside) or getattr(types, inside)


@functools.cache
def _bytes_type(kind: str) -> type[Any]:
    """The DDS type ``kind``, whose samples are bytes as they are on the wire."""
    made = _struct(kind)
    made.deserialize = classmethod(lambda cls, data, has_header=True, use_version_2=None: _Bytes(data))
    made.serialize = lambda self, buffer=None, endianness=None, use_version_2=None: self.data_
    return made


@contextlib.contextmanager
def _bind_to(interface: str) -> Any:
    """Cyclone sends from the chosen interface, but receives on all of them: bind the sockets that it opens to the loopback device.

    Raises `TransportError` where that cannot be done.
    """
    before = _sockets()
    yield
    if interface != LOOPBACK:
        return
    for number in _sockets() - before:
        _bind_socket(number)


def _bind_socket(number: int) -> None:
    with socket.socket(fileno=number) as opened:
        try:
            if opened.type == socket.SOCK_DGRAM:
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, LOOPBACK.encode() + b"\0")
        except (AttributeError, OSError) as error:
            raise TransportError(
                f"DDS cannot be restricted to this machine ({error}). If packets of others do no harm: --interface default."
            ) from error
        finally:
            opened.detach()  # it stays Cyclone's


def _sockets() -> set[int]:
    found = set()
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if str(entry.readlink()).startswith("socket:"):
                found.add(int(entry.name))
    return found


def choose_interface(interface: str | None, environment: Mapping[str, str] = os.environ) -> str:
    """`lo`, `default`, or the name or address of one network interface.

    ``interface``: `lo` or `localhost`, `default` (what ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE demand, the subnet without
    them), a device or an address; None as `default`, but `lo` where neither variable is set. Raises `TransportError`.
    """
    if interface in _LOOPBACK_NAMES:
        return LOOPBACK
    if interface is None or interface == DEFAULT:
        return _interface_of_environment(environment, unset=LOOPBACK if interface is None else DEFAULT)
    devices = [name for _, name in socket.if_nameindex()]
    if interface not in devices and not _is_address(interface):
        near = difflib.get_close_matches(interface, [*devices, *_LOOPBACK_NAMES, DEFAULT], n=1)
        nearest = f" Did you mean '{near[0]}'?" if near else ""
        raise TransportError(
            f"DDS cannot be used on interface '{interface}': there are {', '.join(devices)}.{nearest} "
            "--interface also takes localhost, default, or an address of this machine."
        )
    return interface


def _interface_of_environment(environment: Mapping[str, str], unset: str) -> str:
    """ROS_LOCALHOST_ONLY goes before ROS_AUTOMATIC_DISCOVERY_RANGE, as in rcl."""
    if environment.get("ROS_LOCALHOST_ONLY") == "1":
        return LOOPBACK
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    if not reach:
        return unset
    if reach not in _RANGES:
        near = difflib.get_close_matches(reach, _RANGES, n=1)
        nearest = f" Did you mean {near[0]}?" if near else ""
        raise TransportError(f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{reach}'; it may be {', '.join(_RANGES)}.{nearest}")
    if reach == "OFF":
        raise TransportError(
            "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF: no topic can be discovered. Set it to LOCALHOST or SUBNET, or pass --interface."
        )
    return LOOPBACK if reach == "LOCALHOST" else DEFAULT


def configuration(interface: str, environment: Mapping[str, str] = os.environ) -> str:
    """Configuration of a domain for Cyclone DDS: XML fragments, of which later ones overrule earlier ones.

    ``interface`` is one of `choose_interface`. For `default` the user's CYCLONEDDS_URI comes last; the others leave it out, for it may name
    another interface.
    """
    peers = _static_peers(environment)
    if interface == LOOPBACK:
        return _xml("<Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces><AllowMulticast>false</AllowMulticast>", ["127.0.0.1"])
    # A participant with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST on this machine is reached at the loopback address only.
    if interface == DEFAULT:
        uri = environment.get("CYCLONEDDS_URI", "")
        return _xml("", ["localhost", *peers]) + ("," + uri if uri else "")
    chosen = f"address={quoteattr(interface)}" if _is_address(interface) else f"name={quoteattr(interface)}"
    return _xml(f"<Interfaces><NetworkInterface {chosen}/></Interfaces>", peers)


def _xml(general: str, peers: Sequence[str]) -> str:
    listed = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in peers)
    discovery = _ASKING + (f"<Peers>{listed}</Peers>" if listed else "")
    parts = f"{_COMPATIBILITY}<General>{general}</General><Discovery>{discovery}</Discovery>{_BUFFER}"
    return f"<CycloneDDS><Domain>{parts}</Domain></CycloneDDS>"


def _static_peers(environment: Mapping[str, str]) -> list[str]:
    """Addresses in ROS_STATIC_PEERS, where semicolons separate them."""
    return [peer.strip() for peer in environment.get("ROS_STATIC_PEERS", "").split(";") if peer.strip()]


def _is_address(text: str) -> bool:
    for family in (socket.AF_INET, socket.AF_INET6):
        try:
            socket.inet_pton(family, text)
        except OSError:
            continue
        return True
    return False
