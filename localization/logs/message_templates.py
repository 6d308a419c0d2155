"""Templates of messages with a fixed layout: rosbags serializes one message, and for all others only the numbers are written in place.

rosbags takes some 50 us to serialise a message object; a simulator writes hundreds of them for each second that it may take 10 ms for.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from localization.logs.driver_messages import definitions

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(definitions())
_T = STORE.types
_STAMP = (0x5A5A1234, 0x3A3A4321)
_NS = 1_000_000_000
UNKNOWN_VARIANCE = 1e6

Array = NDArray[Any]


@cache
def store_ros1() -> Typestore:
    """Types of ROS 1, made when they are first asked for."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register({**definitions(), **get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")})
    return store


class Message(NamedTuple):
    """One message: its layout, time of sending, header stamp, and numbers in the order of the layout's parts."""

    layout: MessageLayout
    log_ns: int
    stamp_ns: int
    parts: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class MessageLayout:
    """Common layout of all messages of a topic."""

    topic: str
    type: str
    shapes: tuple[tuple[str, int], ...]
    """Type (numpy's) and number of elements of each part."""
    build: Callable[..., Any]
    """The message object of a header stamp and the parts."""


class Template:
    """The bytes of a form's messages, in the encoding of ROS 2 (CDR) or of ROS 1."""

    def __init__(self, layout: MessageLayout, *, is_ros1: bool) -> None:
        marks = [_marks(kind, count, number) for number, (kind, count) in enumerate(layout.shapes)]
        data = STORE.serialize_cdr(layout.build(_T["builtin_interfaces/msg/Time"](*_STAMP), *marks), layout.type)
        data = STORE.cdr_to_ros1(data, layout.type) if is_ros1 else data
        self._bytes = bytes(data)
        stamp = struct.pack("<II", *_STAMP)
        self._stamps = [i for i in range(len(self._bytes) - 7) if self._bytes[i : i + 8] == stamp]
        self._places = [(self._bytes.index(mark.tobytes()), mark.nbytes, mark.dtype) for mark in marks if mark.size]

    def fill(self, message: Message) -> bytes:
        """The bytes of ``message``."""
        data = bytearray(self._bytes)
        stamp = struct.pack("<iI", message.stamp_ns // _NS, message.stamp_ns % _NS)
        for at in self._stamps:
            data[at : at + 8] = stamp
        for (at, size, kind), part in zip(self._places, message.parts, strict=True):
            filled = part.astype(kind, copy=False).tobytes()
            assert len(filled) == size
            data[at : at + size] = filled
        return bytes(data)


def _marks(kind: str, count: int, number: int) -> Array:
    """Values that occur nowhere else in a message, so that their place can be found in its bytes."""
    size = np.dtype(kind).itemsize * count
    noise = np.random.default_rng(1000 + number).integers(1, 120, size, dtype=np.uint8)
    return noise.view(kind)


def _header(stamp: Any, frame: str) -> Any:
    return _T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _vector(values: Sequence[float] | Array) -> Any:
    x, y, z = (float(v) for v in values)
    return _T["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def _point(values: Sequence[float] | Array) -> Any:
    x, y, z = (float(v) for v in values)
    return _T["geometry_msgs/msg/Point"](x=x, y=y, z=z)


def _quaternion(values: Sequence[float] | Array) -> Any:
    x, y, z, w = (float(v) for v in values)
    return _T["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def joint_states(topic: str, names: Sequence[str]) -> MessageLayout:
    """Parts: positions [rad] and velocities [rad/s] of ``names``."""

    def build(stamp: Any, position: Array, velocity: Array) -> Any:
        kind = _T["sensor_msgs/msg/JointState"]
        return kind(header=_header(stamp, ""), name=list(names), position=position, velocity=velocity, effort=np.zeros(0))

    n = len(names)
    return MessageLayout(topic, "sensor_msgs/msg/JointState", (("f8", n), ("f8", n)), build)


def laser_scan(
    topic: str, frame: str, beams: int, angles: tuple[float, float], times: tuple[float, float], ranges: tuple[float, float]
) -> MessageLayout:
    """Part: ranges [m]. ``angles``: of the first beam and from beam to beam [rad]; ``times``: from beam to beam and from scan to scan [s];
    ``ranges``: least and greatest [m]."""

    def build(stamp: Any, values: Array) -> Any:
        return _T["sensor_msgs/msg/LaserScan"](
            header=_header(stamp, frame),
            angle_min=angles[0],
            angle_max=angles[0] + angles[1] * (beams - 1),
            angle_increment=angles[1],
            time_increment=times[0],
            scan_time=times[1],
            range_min=ranges[0],
            range_max=ranges[1],
            ranges=values,
            intensities=np.zeros(0, dtype=np.float32),
        )

    return MessageLayout(topic, "sensor_msgs/msg/LaserScan", (("f4", beams),), build)


def point_cloud(topic: str, frame: str, height: int, width: int, fields: Mapping[str, str]) -> MessageLayout:
    """Part: the points' bytes, packed as ``fields`` (numpy's type by name)."""
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    layout, step = [], 0
    for name, kind in fields.items():
        layout.append(_T["sensor_msgs/msg/PointField"](name=name, offset=step, datatype=codes[kind], count=1))
        step += np.dtype(kind).itemsize

    def build(stamp: Any, data: Array) -> Any:
        return _T["sensor_msgs/msg/PointCloud2"](
            header=_header(stamp, frame),
            height=height,
            width=width,
            fields=layout,
            is_bigendian=False,
            point_step=step,
            row_step=step * width,
            data=data,
            is_dense=False,
        )

    return MessageLayout(topic, "sensor_msgs/msg/PointCloud2", (("u1", step * height * width),), build)


def imu(topic: str, frame: str, rate_variance: float, force_variance: float) -> MessageLayout:
    """Parts: angular velocity (3) [rad/s], specific force (3) [m/s^2]. It has no orientation (REP-145: -1)."""

    def build(stamp: Any, rate: Array, force: Array) -> Any:
        return _T["sensor_msgs/msg/Imu"](
            header=_header(stamp, frame),
            orientation=_quaternion((0, 0, 0, 1)),
            orientation_covariance=np.array([-1.0] + [0.0] * 8),
            angular_velocity=_vector(rate),
            angular_velocity_covariance=np.diag(np.full(3, rate_variance)).ravel(),
            linear_acceleration=_vector(force),
            linear_acceleration_covariance=np.diag(np.full(3, force_variance)).ravel(),
        )

    return MessageLayout(topic, "sensor_msgs/msg/Imu", (("f8", 3), ("f8", 3)), build)


def fix(topic: str, frame: str, variances: Sequence[float]) -> MessageLayout:
    """Part: latitude, longitude [degrees], altitude [m]. ``variances`` east, north, up [m^2]."""

    def build(stamp: Any, place: Array) -> Any:
        return _T["sensor_msgs/msg/NavSatFix"](
            header=_header(stamp, frame),
            status=_T["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
            latitude=float(place[0]),
            longitude=float(place[1]),
            altitude=float(place[2]),
            position_covariance=np.diag(np.asarray(variances, dtype=float)).ravel(),
            position_covariance_type=2,
        )

    return MessageLayout(topic, "sensor_msgs/msg/NavSatFix", (("f8", 3),), build)


def odometry(topic: str, frame: str, child: str) -> MessageLayout:
    """Parts: x, y; z and w of the heading's quaternion; vx, vy and wz of the body. Covariances are zero: they are exact."""

    def build(stamp: Any, place: Array, heading: Array, speed: Array, turn: Array) -> Any:
        return _exact_odometry(_header(stamp, frame), child, ((*place, 0), (0, 0, *heading)), (speed, turn))

    return MessageLayout(topic, "nav_msgs/msg/Odometry", (("f8", 2), ("f8", 2), ("f8", 2), ("f8", 1)), build)


def odometry_in_space(topic: str, frame: str, child: str) -> MessageLayout:
    """Parts: x, y, z; x, y, z and w of the quaternion; vx, vy and wz of the body. Covariances are zero: they are exact."""

    def build(stamp: Any, place: Array, turned: Array, speed: Array, turn: Array) -> Any:
        return _exact_odometry(_header(stamp, frame), child, (place, turned), (speed, turn))

    return MessageLayout(topic, "nav_msgs/msg/Odometry", (("f8", 3), ("f8", 4), ("f8", 2), ("f8", 1)), build)


def _exact_odometry(header: Any, child: str, at: tuple[Sequence[float] | Array, ...], moving: tuple[Array, Array]) -> Any:
    """Odometry without covariance: ``at`` position (3,) and quaternion (4,), ``moving`` by vx, vy and wz of the body."""
    pose = _T["geometry_msgs/msg/Pose"](position=_point(at[0]), orientation=_quaternion(at[1]))
    twist = _T["geometry_msgs/msg/Twist"](linear=_vector((*moving[0], 0)), angular=_vector((0, 0, *moving[1])))
    return _T["nav_msgs/msg/Odometry"](
        header=header,
        child_frame_id=child,
        pose=_T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=_T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )


def point(topic: str, frame: str) -> MessageLayout:
    """Part: x, y, z [m]."""

    def build(stamp: Any, place: Array) -> Any:
        return _T["geometry_msgs/msg/PointStamped"](header=_header(stamp, frame), point=_point(place))

    return MessageLayout(topic, "geometry_msgs/msg/PointStamped", (("f8", 3),), build)


def transforms(topic: str, edges: Sequence[tuple[str, str, Sequence[float], Sequence[float]]]) -> MessageLayout:
    """No parts. ``edges``: parent, child, translation [m], quaternion x, y, z, w."""

    def build(stamp: Any) -> Any:
        kind, inner = _T["geometry_msgs/msg/TransformStamped"], _T["geometry_msgs/msg/Transform"]
        found = [kind(_header(stamp, a), b, inner(translation=_vector(t), rotation=_quaternion(q))) for a, b, t, q in edges]
        return _T["tf2_msgs/msg/TFMessage"](transforms=found)

    return MessageLayout(topic, "tf2_msgs/msg/TFMessage", (), build)


def text(topic: str, length: int) -> MessageLayout:
    """Part: the bytes (UTF-8) of a text of ``length``."""
    return MessageLayout(
        topic, "std_msgs/msg/String", (("u1", length),), lambda stamp, data: _T["std_msgs/msg/String"](data=data.tobytes().decode())
    )
