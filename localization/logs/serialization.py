"""Messages as bytes on the wire, ROS 2's (CDR) and ROS 1's, read and written as those of logs are; and what fields a type has."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from localization.logs.chunks import Channel
from localization.logs.decode import UnusableError
from localization.logs.fast_cdr import quick_reader
from localization.logs.message_stats import Oddity
from localization.logs.message_templates import STORE, STORE_ROS1

_GRAPH_PACKAGE = "rmw_dds_common"
_STORE_GRAPH = get_typestore(Stores.ROS2_JAZZY)  # its entities have 16 bytes since Iron, 24 in Humble

Shape = tuple[Any, ...]
"""Of a field: ("base", name), ("message", type), ("array", shape, length) or ("sequence", shape)."""


def encode(message: Any, *, is_ros1: bool = False) -> bytes:
    """The bytes of a message object of `make` or of this package."""
    kind = message.__msgtype__
    data = _store(kind).serialize_cdr(message, kind)
    return bytes(STORE.cdr_to_ros1(data, kind) if is_ros1 else data)


def decoder(kind: str, *, is_ros1: bool = False) -> Callable[[bytes], Any]:
    """What makes message objects of type ``kind`` (package/msg/Type) of bytes, or, of some types, what is used of them (`quick`); it raises
    `UnusableError`."""
    deserialize = STORE_ROS1.deserialize_ros1 if is_ros1 else STORE.deserialize_cdr
    quick = None if is_ros1 else quick_reader(kind)

    def decode(data: bytes) -> Any:
        try:
            message = None if quick is None else quick(data)
            return deserialize(data, kind) if message is None else message
        except Exception as error:  # struct.error, SerdeError, UnicodeDecodeError, ... : the bytes are not such a message
            raise UnusableError(Oddity.UNDECODABLE) from error

    return decode


def make(kind: str, **fields: Any) -> Any:
    """A message object of ROS 2's type ``kind`` (package/msg/Type)."""
    return _store(kind).types[kind](**fields)


def type_hash(kind: str) -> str:
    """Hash of ROS 2's type ``kind`` (`RIHS01_...`, REP-2016), which peers since Iron compare."""
    return str(_store(kind).hash_rihs01(kind))


def definition(kind: str, *, is_ros1: bool = False) -> tuple[str, str]:
    """Text of a type's definition and, in ROS 1, its MD5 sum."""
    store: Typestore = STORE_ROS1 if is_ros1 else STORE
    text, digest = store.generate_msgdef(kind, ros_version=1 if is_ros1 else 2)
    return text, digest


def live_channel(topic: str, kind: str, count: int) -> Channel:
    """A topic of a robot on which ``count`` messages were heard, as if it were a log's."""
    return Channel(topic, kind, MessageDefinition(MessageDefinitionFormat.NONE, ""), count)


def fields(kind: str) -> list[tuple[str, Shape]]:
    """Fields of ROS 2's type ``kind`` with their shapes, in order."""
    return [(name, _shape(described)) for name, described in _store(kind).fielddefs[kind][1]]


def _store(kind: str) -> Typestore:
    return _STORE_GRAPH if kind.startswith(_GRAPH_PACKAGE) else STORE


def _shape(described: Any) -> Shape:
    node, inside = described
    if node.name == "BASE":
        return "base", inside[0]
    if node.name == "NAME":
        return "message", inside
    if node.name == "ARRAY":
        return "array", _shape(inside[0]), inside[1]
    return "sequence", _shape(inside[0])
