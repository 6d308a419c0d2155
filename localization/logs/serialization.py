"""Serialization of messages, ROS 2 (CDR) and ROS 1, in logs and on topics; frequent ones fast; and the fields of a type.

Decoded without rosbags are sensor messages at 50 Hz and more, with the values that rosbags gives; encoded are those published with each
estimate, by templates that rosbags has filled once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from localization.logs.chunks import Channel, RawMessage
from localization.logs.decode import Oddity, UnusableError
from localization.logs.driver_messages import WheelJoints, as_joint_states, definitions
from localization.logs.fused_messages import BODY_FRAME, PARENT_FRAME, FusedEstimate, odometry_message, six_by_six, transform_message
from localization.logs.message_templates import STORE, Message, MessageLayout, Template, store_ros1
from motion_models.se2 import FloatArray

_GRAPH_PACKAGE = "rmw_dds_common"
_MAX_DEFINITION_CHARACTERS = 1 << 18  # characters; those of ROS's own types have up to 20,000
_MAX_FIXED_ARRAY_LENGTH = (
    10_000  # elements; ROS's longest is a covariance of 36, and the generated deserializer has a line or more for each
)

Shape = tuple[Any, ...]
"""Shape of a field: ("base", name), ("message", type), ("array", shape, length) or ("sequence", shape)."""

_CDR, _FIRST = b"\0\1\0\0", 4  # little endian; places are counted from behind these bytes
_UINT, _HEADER, _IMU = struct.Struct("<I"), struct.Struct("<iII"), struct.Struct("<5d64x4d64x3d72x")
_LASER_SCAN = struct.Struct("<7fI")


def encode(message: Any, *, is_ros1: bool = False) -> bytes:
    """The bytes of a message object of `make` or of this package."""
    kind = message.__msgtype__
    data = _store(kind).serialize_cdr(message, kind)
    return bytes(STORE.cdr_to_ros1(data, kind) if is_ros1 else data)


def decoder(kind: str, topic: str = "", *, is_ros1: bool = False) -> Callable[[bytes], Any]:
    """Deserializer of messages of type ``kind`` (package/msg/Type); for frequent types it returns the fields in use only (`fast_decoder`),
    for drivers' messages about the wheels on ``topic`` joint states (`driver_messages`). It raises `UnusableError`."""
    deserialize = store_ros1().deserialize_ros1 if is_ros1 else STORE.deserialize_cdr
    fast = None if is_ros1 else fast_decoder(kind)

    def decode(data: bytes) -> Any:
        try:
            message = None if fast is None else fast(data)
            return as_joint_states(deserialize(data, kind), topic, kind) if message is None else message
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
    store: Typestore = store_ros1() if is_ros1 else STORE
    text, digest = store.generate_msgdef(kind, ros_version=1 if is_ros1 else 2)
    return text, digest


def live_channel(topic: str, kind: str, count: int) -> Channel:
    """A topic of a robot on which ``count`` messages were received, as a channel of a log."""
    return Channel(topic, kind, MessageDefinition(MessageDefinitionFormat.NONE, ""), count)


def fields(kind: str) -> list[tuple[str, Shape]]:
    """Fields of ROS 2's type ``kind`` with their shapes, in order."""
    return [(name, _shape(described)) for name, described in _store(kind).fielddefs[kind][1]]


def _store(kind: str) -> Typestore:
    return _store_graph() if kind.startswith(_GRAPH_PACKAGE) else STORE


@cache
def _store_graph() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)  # its entities have 16 bytes since Iron, 24 in Humble


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
    """Deserializes raw messages by the definitions in the log, else by those of ROS 2 Humble (ROS 1: Noetic) and of `driver_messages`, of
    which it makes joint states.

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
            return as_joint_states(deserialize(raw.data), raw.topic, raw.type)
        except Exception as error:  # struct.error, SerdeError, UnicodeDecodeError, ... : the bytes are not such a message
            raise UnusableError(Oddity.UNDECODABLE) from error


@lru_cache(maxsize=64)
def _deserializer(kind: str, form: MessageDefinitionFormat, text: str, is_ros1: bool) -> Callable[[bytes], Any]:
    standard = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    standard.register(definitions())
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


class Stamp(NamedTuple):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class Vector3(NamedTuple):
    """geometry_msgs/Vector3."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class ImuMessage(NamedTuple):
    """What is used of sensor_msgs/Imu; of the covariances the first number."""

    header: Header
    orientation: Quaternion
    orientation_covariance: tuple[float]
    angular_velocity: Vector3
    angular_velocity_covariance: tuple[float]
    linear_acceleration: Vector3


class LaserScanMessage(NamedTuple):
    """What is used of sensor_msgs/LaserScan."""

    header: Header
    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]


_DECODERS: dict[str, Callable[[], Callable[[bytes], Any]]] = {
    "sensor_msgs/msg/Imu": lambda: _imu,
    "sensor_msgs/msg/JointState": lambda: _joint_states(),
    "sensor_msgs/msg/LaserScan": lambda: _laser_scan,
}


def fast_decoder(kind: str) -> Callable[[bytes], Any] | None:
    """Decoder of messages of type ``kind``, or None. It returns the fields in use, or None for an unusual encoding, which is left to
    rosbags. It raises (`struct.error`, `ValueError`) where rosbags would."""
    return _DECODERS[kind]() if kind in _DECODERS else None


def _imu(data: bytes) -> ImuMessage | None:
    sec, nanosec, length = _HEADER.unpack_from(data, _FIRST)
    end = 16 + length
    at = _aligned(end, 8)
    if not data.startswith(_CDR) or not 0 <= len(data) - at - _IMU.size < 4 or not length or data[end - 1]:
        return None
    qx, qy, qz, qw, of_q, wx, wy, wz, of_w, ax, ay, az = _IMU.unpack_from(data, at)
    header, orientation = Header(Stamp(sec, nanosec), data[16 : end - 1].decode()), Quaternion(qx, qy, qz, qw)
    return ImuMessage(header, orientation, (of_q,), Vector3(wx, wy, wz), (of_w,), Vector3(ax, ay, az))


def _laser_scan(data: bytes) -> LaserScanMessage | None:
    if not data.startswith(_CDR):
        return None
    sec, nanosec, length = _HEADER.unpack_from(data, _FIRST)
    end = 16 + length
    at = _aligned(end, 4)
    first, last, step, beam_s, _, shortest, longest, count = _LASER_SCAN.unpack_from(data, at)
    at += _LASER_SCAN.size
    intensities = at + 4 * count
    left = len(data) - intensities - 4 - 4 * _UINT.unpack_from(data, intensities)[0]
    if not 0 <= left < 4 or not length or data[end - 1]:
        return None
    header, ranges = Header(Stamp(sec, nanosec), data[16 : end - 1].decode()), np.frombuffer(data, "<f4", count, at)
    return LaserScanMessage(header, first, last, step, beam_s, shortest, longest, ranges)


def _joint_states() -> Callable[[bytes], WheelJoints | None]:
    """Caches the names of the last message: they rarely change."""
    cached, frame = b"", ""
    names: tuple[str, ...] = ()

    def read(data: bytes) -> WheelJoints | None:
        nonlocal cached, frame, names
        if not data.startswith(_CDR):
            return None
        if not cached or not data.startswith(cached, 12):
            frame, at = _string(data, 12)
            at = _aligned(at, 4)
            (count,) = _UINT.unpack_from(data, at)
            at, found = at + 4, []
            for _ in range(count):
                name, at = _string(data, _aligned(at, 4))
                found.append(name)
            cached, names = data[12 : _aligned(at, 4)], tuple(found)
        position, at = _doubles(data, 12 + len(cached))
        velocity, at = _doubles(data, at)
        _, at = _doubles(data, at)
        sec, nanosec, _ = _HEADER.unpack_from(data, _FIRST)
        return WheelJoints(Header(Stamp(sec, nanosec), frame), names, position, velocity) if len(data) - at < 4 else None

    return read


def _aligned(at: int, size: int) -> int:
    return _FIRST + (at - _FIRST + size - 1 & -size)


def _string(data: bytes, at: int) -> tuple[str, int]:
    """And where it ends. Raises `ValueError` and `struct.error`."""
    end = at + 4 + _UINT.unpack_from(data, at)[0]
    if end == at + 4 or data[end - 1 : end] != b"\0":
        raise ValueError("a string that does not end")
    return data[at + 4 : end - 1].decode(), end


def _doubles(data: bytes, at: int) -> tuple[FloatArray, int]:
    """A sequence, and where it ends. Raises `ValueError` and `struct.error`."""
    (count,) = _UINT.unpack_from(data, at)
    at = _aligned(at + 4, 8) if count else at + 4
    return np.frombuffer(data, "<f8", count, at), at + 8 * count


class FusedWriter:
    """Estimates as the bytes of `odometry_message` and `transform_message`."""

    def __init__(self, *, is_ros1: bool, parent: str = PARENT_FRAME, body: str = BODY_FRAME) -> None:
        """``parent`` and ``body``: the frames between which the estimates are."""
        self._odometry_form, self._transform_form = _named(_ODOMETRY, parent, body), _named(_TRANSFORM, parent, body)
        self._odometry, self._transform = (Template(form, is_ros1=is_ros1) for form in (self._odometry_form, self._transform_form))

    def odometry(self, estimate: FusedEstimate) -> bytes:
        """The bytes of `odometry_message`."""
        numbers = np.zeros(_ODOMETRY_NUMBERS)
        numbers[_PLACE], numbers[_TURNED] = estimate.place()
        numbers[_POSE_COV], numbers[_TWIST_COV] = estimate.pose_covariance(), six_by_six(estimate.twist_covariance)
        numbers[_PLANAR_TWIST] = estimate.twist
        return self._odometry.fill(Message(self._odometry_form, estimate.stamp_ns, estimate.stamp_ns, (numbers,)))

    def transform(self, estimate: FusedEstimate) -> bytes:
        """The bytes of `transform_message`."""
        return self._transform.fill(Message(self._transform_form, estimate.stamp_ns, estimate.stamp_ns, estimate.place()))


def _named(layout: MessageLayout, parent: str, body: str) -> MessageLayout:
    """``layout`` with these frames in its messages."""

    def build(*parts: Any) -> Any:
        made = layout.build(*parts)
        stamped = made.transforms[0] if hasattr(made, "transforms") else made
        stamped.header.frame_id, stamped.child_frame_id = parent, body
        return made

    return replace(layout, build=build)


_NOWHERE = FusedEstimate(0, np.zeros(3), np.zeros(3))


_ODOMETRY_NUMBERS = 85
"""nav_msgs/Odometry ends with so many doubles: pose, its covariance, twist, its covariance."""
_PLACE, _TURNED, _POSE_COV, _TWIST, _TWIST_COV = slice(0, 3), slice(3, 7), slice(7, 43), slice(43, 49), slice(49, 85)
_PLANAR_TWIST = [43, 44, 48]
"""vx, vy and wz among them."""


def _build_odometry(stamp: Any, numbers: FloatArray) -> Any:
    made = odometry_message(_NOWHERE)
    pose, twist = made.pose.pose, made.twist.twist
    made.header.stamp, made.pose.covariance, made.twist.covariance = stamp, numbers[_POSE_COV], numbers[_TWIST_COV]
    _set_place(pose.position, pose.orientation, numbers[_PLACE], numbers[_TURNED])
    linear, angular = np.split(numbers[_TWIST], 2)
    twist.linear.x, twist.linear.y, twist.linear.z = linear.tolist()
    twist.angular.x, twist.angular.y, twist.angular.z = angular.tolist()
    return made


def _set_place(position: Any, orientation: Any, place: FloatArray, turned: FloatArray) -> None:
    position.x, position.y, position.z = place.tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = turned.tolist()


def _build_transform(stamp: Any, place: FloatArray, turned: FloatArray) -> Any:
    made = transform_message(_NOWHERE)
    made.transforms[0].header.stamp, inner = stamp, made.transforms[0].transform
    _set_place(inner.translation, inner.rotation, place, turned)
    return made


_ODOMETRY = MessageLayout("", "nav_msgs/msg/Odometry", (("f8", _ODOMETRY_NUMBERS),), _build_odometry)
_TRANSFORM = MessageLayout("", "tf2_msgs/msg/TFMessage", (("f8", 3), ("f8", 4)), _build_transform)
