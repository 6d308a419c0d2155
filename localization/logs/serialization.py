"""Serialization of messages, ROS 2 (CDR) and ROS 1, in logs and on topics; and the fields of a type."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from typing import Any

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from localization.logs.chunks import Channel, RawMessage
from localization.logs.decode import Oddity, UnusableError
from localization.logs.fast_cdr import fast_decoder
from localization.logs.message_templates import STORE, STORE_ROS1

_GRAPH_PACKAGE = "rmw_dds_common"
_STORE_GRAPH = get_typestore(Stores.ROS2_JAZZY)  # its entities have 16 bytes since Iron, 24 in Humble
_MAX_DEFINITION_CHARACTERS = 1 << 18  # characters; those of ROS's own types have up to 20,000
_MAX_FIXED_ARRAY_LENGTH = (
    10_000  # elements; ROS's longest is a covariance of 36, and the generated deserializer has a line or more for each
)

Shape = tuple[Any, ...]
"""Of a field: ("base", name), ("message", type), ("array", shape, length) or ("sequence", shape)."""


def encode(message: Any, *, is_ros1: bool = False) -> bytes:
    """The bytes of a message object of `make` or of this package."""
    kind = message.__msgtype__
    data = _store(kind).serialize_cdr(message, kind)
    return bytes(STORE.cdr_to_ros1(data, kind) if is_ros1 else data)


def decoder(kind: str, *, is_ros1: bool = False) -> Callable[[bytes], Any]:
    """Deserializer of messages of type ``kind`` (package/msg/Type); for frequent types it returns the fields in use only (`fast_cdr`).
    It raises `UnusableError`."""
    deserialize = STORE_ROS1.deserialize_ros1 if is_ros1 else STORE.deserialize_cdr
    fast = None if is_ros1 else fast_decoder(kind)

    def decode(data: bytes) -> Any:
        try:
            message = None if fast is None else fast(data)
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
    """A topic of a robot on which ``count`` messages were received, as a channel of a log."""
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


class LogDeserializer:
    """Deserializes raw messages by the definitions in the log, else by those of ROS 2 Humble (ROS 1: Noetic).

    A type's definition is parsed at its first message: a damaged definition affects that type only.
    """

    def __init__(self, channels: Iterable[Channel], *, is_ros1: bool) -> None:
        self._definitions = {channel.type: channel.definition for channel in channels}
        self._is_ros1 = is_ros1
        self._deserializers: dict[str, Callable[[bytes], Any]] = {}

    def __call__(self, raw: RawMessage) -> Any:
        """The message. Raises `UnusableError`."""
        deserialize = self._deserializers.get(raw.type)
        if deserialize is None:
            definition = self._definitions[raw.type]
            deserialize = _deserializer(raw.type, definition.format, definition.data, self._is_ros1)
            self._deserializers[raw.type] = deserialize
        try:
            return deserialize(raw.data)
        except Exception as error:  # struct.error, SerdeError, UnicodeDecodeError, ... : the bytes are not such a message
            raise UnusableError(Oddity.UNDECODABLE) from error


@lru_cache(maxsize=64)
def _deserializer(kind: str, form: MessageDefinitionFormat, text: str, is_ros1: bool) -> Callable[[bytes], Any]:
    standard = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.EMPTY)
    try:
        types = _parse_definition(kind, form, text)
        if not _is_bounded(types):
            raise ValueError("a definition with arrays longer than any of ROS")
        store.register(types)
        if not _has_fields(store.fielddefs, standard.fielddefs, kind):
            raise ValueError("a definition without the fields that the type has")
        store.get_msgdef(kind)
    except Exception:  # no definition, or an invalid one (the parser raises errors of any type): use the standard one
        store = standard
    deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    return lambda data: deserialize(data, kind)


def _parse_definition(kind: str, form: MessageDefinitionFormat, text: str) -> dict[str, Any]:
    """Fields by type. Raises anything."""
    if len(text) > _MAX_DEFINITION_CHARACTERS:
        raise ValueError("a definition that is too long")
    if form == MessageDefinitionFormat.MSG:
        return dict(get_types_from_msg(text, kind))
    if "<<" in text:  # a constant may be 1 << 10**9, and the parser computes it; no message of ROS shifts
        raise ValueError("a definition that computes")
    types: dict[str, Any] = {}
    for part in text.split("=" * 80 + "\n"):
        idl = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        types.update(get_types_from_idl(idl) if idl.strip() else {})
    return types


def _is_bounded(types: Mapping[str, Any]) -> bool:
    """Whether no array is too long to generate a reader for, and none has elements of no bytes, of which there could be any number."""
    for _, fields in types.values():
        for _, (node, inside) in fields:
            if node not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                continue
            (element, name), length = inside
            if node == Nodetype.ARRAY and length > _MAX_FIXED_ARRAY_LENGTH:
                return False
            if element == Nodetype.NAME and not _has_bytes(types, name, len(types)):
                return False
    return True


def _has_bytes(types: Mapping[str, Any], name: str, depth: int) -> bool:
    """Whether messages of the type have at least one byte. Types that are not among ``types`` are basic ones of ROS, which have."""
    if name not in types:
        return True
    return depth > 0 and any(
        (node != Nodetype.NAME or _has_bytes(types, inside, depth - 1))
        and (node != Nodetype.ARRAY or (inside[1] > 0 and (inside[0][0] != Nodetype.NAME or _has_bytes(types, inside[0][1], depth - 1))))
        for _, (node, inside) in types[name][1]
    )


def _has_fields(found: Mapping[str, Any], standard: Mapping[str, Any], kind: str) -> bool:
    """Whether the definition ``found`` of a type has all fields of the standard one, of the same types; it may have more."""
    if kind not in standard:
        return True
    if kind not in found:
        return False
    have = dict(found[kind][1])
    for name, described in standard[kind][1]:
        if have.get(name) != described:
            return False
        node, inside = described
        inner = inside if node == Nodetype.NAME else inside[0][1] if node != Nodetype.BASE and inside[0][0] == Nodetype.NAME else None
        if inner is not None and not _has_fields(found, standard, inner):
            return False
    return True
