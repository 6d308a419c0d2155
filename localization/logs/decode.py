"""Messages to events: what a driver wrote, in this project's types. Stateless; what needs the message before is in `wheels`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from localization.events import CgSample, ImuSample, Scan
from localization.logs.chunks import Channel, RawMessage
from localization.logs.message_stats import Oddity
from motion_models.se2 import FloatArray

LONGEST_SWEEP_S = 2.0
_FASTEST_TURN = math.radians(2000.0)  # rad/s, the full scale of gyros on robots
_STRONGEST_FORCE = 1e5  # m/s^2; drivers use other units, in which this may be 100 g (cm/s^2)
_LEAST_SQUARED_NORM = 0.01  # of a rotation, whose quaternion need not be normalised; what is smaller is the noise of one not filled in
_MOST_BEAMS = 1_000_000  # of a planar scan; the finest scanners have 20,000
_WIDEST_RAD = math.tau * 1.1  # from first to last beam; scanners that turn on a little overlap their first beam
_LONGEST_DEFINITION = 1 << 18  # characters; those of ROS's own types have up to 20,000
_LONGEST_FIXED_ARRAY = 10_000  # elements; ROS's longest is a covariance of 36. The reader's code has a line or more for each
_KNOWN_NAMES = 100  # nobody's joints change that often, but the memory must not grow


class UnusableError(Exception):
    """A message that says nothing. Never leaves this package."""

    def __init__(self, oddity: Oddity) -> None:
        super().__init__(oddity.value)
        self.oddity = oddity


@dataclass(frozen=True)
class JointReading:
    """Wheel joints at one instant."""

    stamp_ns: int
    position: FloatArray
    """(n,) [rad], NaN where absent."""
    velocity: FloatArray
    """(n,) [rad/s], NaN where absent."""


@dataclass(frozen=True)
class ArmReading:
    """Joints of the arms at one instant, those of one message."""

    stamp_ns: int
    names: tuple[str, ...]
    position: FloatArray
    """(n,) [rad or m], NaN where absent."""
    wheels: JointReading | None = None
    """What the same message says of the wheels; its stamp may be older than this one, which counts."""


@dataclass(frozen=True)
class OdometryReading:
    """A driver's odometry at one instant."""

    stamp_ns: int
    pose: FloatArray
    """(3,) x, y, yaw."""
    twist: FloatArray
    """(3,) vx, vy, wz in the body frame."""


class Decoder:
    """Raw messages to rosbags' message objects, by the definitions that the log carries, else by those of ROS 2 Humble (ROS 1: Noetic).

    A type is looked at when its first message comes: definitions that make no sense hurt only those who use them.
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
            raise ValueError("a definition with arrays that no robot sends")
        store.register(types)
        if not _has_fields(store.fielddefs, standard.fielddefs, kind):
            raise ValueError("a definition without the fields that the type has")
        store.get_msgdef(kind)
    except Exception:  # no definition, or one that the parser does not understand (it lets out anything): the standard one will do
        store = standard
    deserialize = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    return lambda data: deserialize(data, kind)


def _parse_definition(kind: str, form: MessageDefinitionFormat, text: str) -> dict[str, Any]:
    """Fields by type. Raises anything."""
    if len(text) > _LONGEST_DEFINITION:
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
    """Whether no array is too long to generate a reader for, and none has elements without bytes, whose number has no bound."""
    for _, fields in types.values():
        for _, (node, inside) in fields:
            if node not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                continue
            (element, name), length = inside
            if node == Nodetype.ARRAY and length > _LONGEST_FIXED_ARRAY:
                return False
            if element == Nodetype.NAME and not _has_bytes(types, name, len(types)):
                return False
    return True


def _has_bytes(types: Mapping[str, Any], name: str, depth: int) -> bool:
    """Whether a message of the type takes any. One that is not among ``types`` does, as it is of ROS's own basic ones."""
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


def stamp_ns(message: Any) -> int:
    """Header stamp [ns], 0 where the driver did not set it."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def frame_name(frame_id: str) -> str:
    """A frame's name without the slash that tf (1) put before it."""
    return frame_id.strip().lstrip("/")


def decode_imu(message: Any, stamp: int) -> ImuSample:
    w, a = message.angular_velocity, message.linear_acceleration
    if not math.isfinite(w.x + w.y + w.z + a.x + a.y + a.z):  # quicker than numpy's, on six numbers
        raise UnusableError(Oddity.NOT_FINITE)
    if max(abs(w.x), abs(w.y), abs(w.z)) > _FASTEST_TURN or max(abs(a.x), abs(a.y), abs(a.z)) > _STRONGEST_FORCE:
        raise UnusableError(Oddity.BEYOND)
    return ImuSample(stamp, np.array([w.x, w.y, w.z]), np.array([a.x, a.y, a.z]), frame_name(message.header.frame_id))


def decode_cg(message: Any, stamp: int) -> CgSample:
    x, y = message.point.x, message.point.y
    if not math.isfinite(x + y):
        raise UnusableError(Oddity.NOT_FINITE)
    return CgSample(stamp, np.array([x, y]))


def yaw_of(q: Any) -> float:
    """Heading of a quaternion [rad]; NaN if it is no rotation, as one that was never filled in."""
    if not q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w >= _LEAST_SQUARED_NORM:
        return math.nan
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def decode_odometry(message: Any, stamp: int) -> OdometryReading:
    pose, twist = message.pose.pose, message.twist.twist
    where = pose.position.x, pose.position.y, yaw_of(pose.orientation)
    rate = twist.linear.x, twist.linear.y, twist.angular.z
    if not (math.isfinite(sum(where)) or math.isfinite(sum(rate))):
        raise UnusableError(Oddity.NOT_FINITE)
    return OdometryReading(stamp, np.array(where), np.array(rate))


def joint_decoder(joints: tuple[str, ...]) -> Callable[[Any, int], JointReading | None]:
    """Decoder of joint states for these joints; None for a message that has none of them (an arm's, say)."""

    @lru_cache(_KNOWN_NAMES)
    def place_of(names: tuple[str, ...]) -> NDArray[np.intp] | None:
        return np.array([names.index(joint) for joint in joints], dtype=np.intp) if set(joints) <= set(names) else None

    def decode(message: Any, stamp: int) -> JointReading | None:
        place = place_of(tuple(message.name))
        if place is None:
            return None
        position, velocity = _at(message.position, place), _at(message.velocity, place)
        if not (_all_finite(position) or _all_finite(velocity)):
            raise UnusableError(Oddity.NOT_FINITE)
        return JointReading(stamp, position, velocity)

    return decode


def arm_decoder(
    joints: frozenset[str], wheels: Callable[[Any, int], JointReading | None] | None
) -> Callable[[Any, int], ArmReading | JointReading | None]:
    """Decoder of joint states for the arms' ``joints``, and by ``wheels`` for those of the wheels where one topic tells both.

    A message without positions, which ROS allows, tells nothing of the arms.
    """

    @lru_cache(_KNOWN_NAMES)
    def columns_of(names: tuple[str, ...]) -> tuple[NDArray[np.intp], tuple[str, ...]]:
        found = [i for i, name in enumerate(names) if name in joints]
        return np.array(found, dtype=np.intp), tuple(names[i] for i in found)

    def decode(message: Any, stamp: int) -> ArmReading | JointReading | None:
        reading = None if wheels is None else wheels(message, stamp)
        names = tuple(message.name)
        columns, told = columns_of(names)
        position = np.asarray(message.position, dtype=float)
        if not told or not len(position):
            return reading
        if len(position) != len(names):
            if reading is None:
                raise UnusableError(Oddity.MALFORMED)
            return reading
        return ArmReading(stamp, told, position[columns], reading)

    return decode


def _at(values: Any, place: NDArray[np.intp]) -> FloatArray:
    array = np.asarray(values, dtype=float)
    try:
        return array[place]
    except IndexError:
        return np.full(len(place), np.nan)


def _all_finite(values: FloatArray) -> bool:
    return all(map(math.isfinite, values.tolist()))  # quicker than numpy's, on a handful


def scan_decoder() -> Callable[[Any, int], Scan]:
    """Decoder of LaserScans; it keeps the beams' directions between scans."""
    directions: dict[tuple[int, float, float], FloatArray] = {}

    def decode(message: Any, stamp: int) -> Scan:
        with np.errstate(invalid="ignore"):  # signalling NaNs
            ranges = np.asarray(message.ranges, dtype=float)
        first, step = float(message.angle_min), float(message.angle_increment)
        if step == 0.0 and len(ranges) > 1:
            step = (float(message.angle_max) - first) / (len(ranges) - 1)
        n = len(ranges)
        if not (math.isfinite(first) and math.isfinite(step)) or n > _MOST_BEAMS:
            raise UnusableError(Oddity.MALFORMED)
        if n > 1 and not 0.0 < abs(step) * (n - 1) <= _WIDEST_RAD:
            raise UnusableError(Oddity.NO_ANGLES)
        key = (len(ranges), first, step)
        direction = directions.get(key)
        if direction is None:
            angle = first + step * np.arange(len(ranges))
            direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(ranges))], axis=1)
            directions.clear()  # a scanner whose beams change with every scan must not fill the memory
            directions[key] = direction
        # A comparison with NaN is false. A range at the maximum is a beam that came back from nowhere.
        shortest, longest = float(message.range_min), float(message.range_max)
        hit = (ranges > 0.0) & ~(ranges < shortest) & (ranges < (longest if longest > 0.0 else np.inf))
        kept = np.flatnonzero(hit)
        points = direction.take(kept, axis=0)
        points *= ranges.take(kept)[:, None]
        beam_s = float(message.time_increment)
        if abs(beam_s) * len(ranges) > LONGEST_SWEEP_S:
            raise UnusableError(Oddity.MALFORMED)
        offsets: FloatArray = np.empty(0)
        if math.isfinite(beam_s) and beam_s != 0.0:
            offsets = np.asarray(kept * beam_s, dtype=float)
        return Scan(stamp, points, offsets, frame_name(message.header.frame_id), is_planar=True)

    return decode
