"""Fast decoding and encoding of frequent messages (ROS 2 CDR, little endian), without an object for each of their parts.

Decoded are sensor messages at 50 Hz and more, with the values that rosbags gives; encoded are those published with each estimate, by
templates that rosbags has filled once.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.logs.message_templates import Message, MessageLayout, Template
from localization.logs.writer import BODY_FRAME, PARENT_FRAME, FusedEstimate, odom_axes, odometry_message, six_by_six, transform_message
from motion_models.se2 import FloatArray

_CDR, _FIRST = b"\0\1\0\0", 4  # little endian; places are counted from behind these bytes
_UINT, _HEADER, _IMU = struct.Struct("<I"), struct.Struct("<iII"), struct.Struct("<104x3d72x3d72x")
_LASER_SCAN = struct.Struct("<7fI")


class Stamp(NamedTuple):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(NamedTuple):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class Vector(NamedTuple):
    """geometry_msgs/Vector3."""

    x: float
    y: float
    z: float


class ImuMessage(NamedTuple):
    """What is used of sensor_msgs/Imu."""

    header: Header
    angular_velocity: Vector
    linear_acceleration: Vector


class JointStateMessage(NamedTuple):
    """What is used of sensor_msgs/JointState."""

    header: Header
    name: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray


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
    wx, wy, wz, ax, ay, az = _IMU.unpack_from(data, at)
    return ImuMessage(Header(Stamp(sec, nanosec), data[16 : end - 1].decode()), Vector(wx, wy, wz), Vector(ax, ay, az))


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


def _joint_states() -> Callable[[bytes], JointStateMessage | None]:
    """Caches the names of the last message: they rarely change."""
    cached, frame = b"", ""
    names: tuple[str, ...] = ()

    def read(data: bytes) -> JointStateMessage | None:
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
        return JointStateMessage(Header(Stamp(sec, nanosec), frame), names, position, velocity) if len(data) - at < 4 else None

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
        covariance = None if estimate.covariance is None else odom_axes(estimate.covariance, float(estimate.pose[2]))
        parts = (*_place(estimate), six_by_six(covariance), estimate.twist[:2], estimate.twist[2:], six_by_six(estimate.twist_covariance))
        return self._odometry.fill(Message(self._odometry_form, estimate.stamp_ns, estimate.stamp_ns, parts))

    def transform(self, estimate: FusedEstimate) -> bytes:
        """The bytes of `transform_message`."""
        return self._transform.fill(Message(self._transform_form, estimate.stamp_ns, estimate.stamp_ns, _place(estimate)))


def _named(layout: MessageLayout, parent: str, body: str) -> MessageLayout:
    """``layout`` with these frames in its messages."""

    def build(*parts: Any) -> Any:
        made = layout.build(*parts)
        stamped = made.transforms[0] if hasattr(made, "transforms") else made
        stamped.header.frame_id, stamped.child_frame_id = parent, body
        return made

    return replace(layout, build=build)


def _place(estimate: FusedEstimate) -> tuple[FloatArray, FloatArray]:
    half = float(estimate.pose[2]) / 2
    return estimate.pose[:2], np.array([math.sin(half), math.cos(half)])


_NOWHERE = FusedEstimate(0, np.zeros(3), np.zeros(3))


def _build_odometry(
    stamp: Any, place: FloatArray, heading: FloatArray, cov: FloatArray, speed: FloatArray, turn: FloatArray, twist_cov: FloatArray
) -> Any:
    made = odometry_message(_NOWHERE)
    pose, twist = made.pose.pose, made.twist.twist
    made.header.stamp, made.pose.covariance, made.twist.covariance = stamp, cov, twist_cov
    (pose.position.x, pose.position.y), (pose.orientation.z, pose.orientation.w) = place.tolist(), heading.tolist()
    (twist.linear.x, twist.linear.y), twist.angular.z = speed.tolist(), float(turn[0])
    return made


def _build_transform(stamp: Any, place: FloatArray, heading: FloatArray) -> Any:
    made = transform_message(_NOWHERE)
    made.transforms[0].header.stamp, inner = stamp, made.transforms[0].transform
    (inner.translation.x, inner.translation.y), (inner.rotation.z, inner.rotation.w) = place.tolist(), heading.tolist()
    return made


_ODOMETRY = MessageLayout(
    "", "nav_msgs/msg/Odometry", (("f8", 2), ("f8", 2), ("f8", 36), ("f8", 2), ("f8", 1), ("f8", 36)), _build_odometry
)
_TRANSFORM = MessageLayout("", "tf2_msgs/msg/TFMessage", (("f8", 2), ("f8", 2)), _build_transform)
