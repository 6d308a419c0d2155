"""Small logs for tests, written by rosbags: ROS 1 bags, ROS 2 folders (sqlite3 or mcap) and bare .mcap files.

A log is a list of records (topic, message, time of recording in ns); messages are made by the functions below, once for all formats.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE_ROS1 = get_typestore(Stores.ROS1_NOETIC)
STORE_ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
T = STORE.types
S = 1_000_000_000
START = 1_700_000_000 * S
"""When most test logs begin [ns]."""

Record = tuple[str, Any, int]


def write_ros1_bag(path: Path, records: Iterable[Record], compression: str | None = None, chunk_bytes: int | None = None) -> Path:
    """A ROS 1 bag; ``compression`` is None, "bz2" or "lz4"."""
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
    if chunk_bytes:
        writer.chunk_threshold = chunk_bytes
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, message, log_ns in records:
            if isinstance(message, Unknown):
                kind = message.type
                if (topic, kind) not in connections:
                    connections[topic, kind] = writer.add_connection(topic, message.type, msgdef=message.definition, md5sum="0" * 32)
                writer.write(connections[topic, kind], log_ns, message.data)
                continue
            kind = message.__msgtype__
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=STORE_ROS1)
            writer.write(connections[topic, kind], log_ns, STORE.cdr_to_ros1(STORE.serialize_cdr(message, kind), kind))
    return path


def write_ros2_bag(path: Path, records: Iterable[Record], storage: str = "mcap", compression: str | None = None) -> Path:
    """A ROS 2 folder; ``storage`` is "mcap" or "sqlite3", ``compression`` None, "message", "file" or "storage" (mcap's chunks)."""
    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage.upper()])
    if compression:
        writer.set_compression(rosbag2.CompressionMode[compression.upper()], rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, message, log_ns in records:
            if isinstance(message, Unknown):
                kind = message.type
                if (topic, kind) not in connections:
                    connections[topic, kind] = writer.add_connection(
                        topic, message.type, msgdef=message.definition, rihs01="RIHS01_" + "0" * 64
                    )
                writer.write(connections[topic, kind], log_ns, message.data)
                continue
            kind = message.__msgtype__
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic, kind], log_ns, STORE.serialize_cdr(message, kind))
    return path


def write_mcap(path: Path, records: Iterable[Record], compression: str | None = None) -> Path:
    """A bare .mcap file; ``compression`` is None or "storage"."""
    folder = path.with_suffix(".folder")
    write_ros2_bag(folder, records, "mcap", compression)
    (folder / f"{folder.name}.mcap").rename(path)
    shutil.rmtree(folder)
    return path


FORMATS = {
    "ros1": lambda path, records: write_ros1_bag(path.with_suffix(".bag"), records),
    "ros1-bz2": lambda path, records: write_ros1_bag(path.with_suffix(".bag"), records, "bz2"),
    "ros1-lz4": lambda path, records: write_ros1_bag(path.with_suffix(".bag"), records, "lz4"),
    "sqlite3": lambda path, records: write_ros2_bag(path, records, "sqlite3"),
    "sqlite3-message": lambda path, records: write_ros2_bag(path, records, "sqlite3", "message"),
    "sqlite3-file": lambda path, records: write_ros2_bag(path, records, "sqlite3", "file"),
    "mcap-folder": lambda path, records: write_ros2_bag(path, records, "mcap"),
    "mcap-file": lambda path, records: write_ros2_bag(path, records, "mcap", "file"),
    "mcap": lambda path, records: write_mcap(path.with_suffix(".mcap"), records),
    "mcap-storage": lambda path, records: write_mcap(path.with_suffix(".mcap"), records, "storage"),
}
"""Every format and compression, by name: (path without suffix, records) -> path written."""


class Unknown:
    """A message of an unknown type with arbitrary bytes."""

    def __init__(
        self, type: str = "acme_msgs/msg/Gizmo", definition: str = "uint8 state\nfloat64[] values\n", data: bytes = b"\x00\x01\x02"
    ) -> None:
        self.type, self.definition, self.data = type, definition, data


def header(stamp_ns: int, frame_id: str = "") -> Any:
    time = T["builtin_interfaces/msg/Time"](sec=stamp_ns // S, nanosec=stamp_ns % S)
    return T["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    return T["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=float(z))


def point(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    return T["geometry_msgs/msg/Point"](x=float(x), y=float(y), z=float(z))


def quaternion(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Any:
    """Of fixed-axis roll, pitch, yaw, as in URDF."""
    cr, sr, cp, sp, cy, sy = (f(a / 2) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return T["geometry_msgs/msg/Quaternion"](
        x=sr * cp * cy - cr * sp * sy, y=cr * sp * cy + sr * cp * sy, z=cr * cp * sy - sr * sp * cy, w=cr * cp * cy + sr * sp * sy
    )


def pose(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Any:
    return T["geometry_msgs/msg/Pose"](position=point(x, y), orientation=quaternion(yaw))


def odometry(
    stamp_ns: int, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, vx: float = 0.0, wz: float = 0.0, covariance: Any = None
) -> Any:
    cov = np.zeros(36) if covariance is None else np.asarray(covariance, dtype=float).ravel()
    return T["nav_msgs/msg/Odometry"](
        header=header(stamp_ns, "odom"),
        child_frame_id="base_link",
        pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=pose(x, y, yaw), covariance=cov),
        twist=T["geometry_msgs/msg/TwistWithCovariance"](
            twist=T["geometry_msgs/msg/Twist"](linear=vector(vx), angular=vector(z=wz)), covariance=np.zeros(36)
        ),
    )


def pose_stamped(stamp_ns: int, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Any:
    return T["geometry_msgs/msg/PoseStamped"](header=header(stamp_ns, "map"), pose=pose(x, y, yaw))


def pose_with_covariance(stamp_ns: int, x: float, y: float, yaw: float, covariance: Any) -> Any:
    cov = np.asarray(covariance, dtype=float).ravel()
    return T["geometry_msgs/msg/PoseWithCovarianceStamped"](
        header=header(stamp_ns, "map"), pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=pose(x, y, yaw), covariance=cov)
    )


WHEELS = ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")


def joint_state(stamp_ns: int, names: Sequence[str] = WHEELS, position: Sequence[float] = (), velocity: Sequence[float] = ()) -> Any:
    return T["sensor_msgs/msg/JointState"](
        header=header(stamp_ns),
        name=list(names),
        position=np.array(position, dtype=float),
        velocity=np.array(velocity, dtype=float),
        effort=np.zeros(0),
    )


def laser_scan(
    stamp_ns: int,
    ranges: Any = (1.0, 2.0, 3.0),
    *,
    angle_min: float = -1.0,
    angle_increment: float = 1.0,
    time_increment: float = 0.0,
    range_min: float = 0.1,
    range_max: float = 30.0,
    frame_id: str = "laser",
) -> Any:
    values = np.asarray(ranges, dtype=np.float32)
    return T["sensor_msgs/msg/LaserScan"](
        header=header(stamp_ns, frame_id),
        angle_min=angle_min,
        angle_max=angle_min + angle_increment * max(len(values) - 1, 0),
        angle_increment=angle_increment,
        time_increment=time_increment,
        scan_time=0.1,
        range_min=range_min,
        range_max=range_max,
        ranges=values,
        intensities=np.zeros(0, dtype=np.float32),
    )


_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud(stamp_ns: int, table: Any, frame_id: str = "lidar", row_padding: int = 0) -> Any:
    """PointCloud2 of a structured array (n,) or (height, width), in its own layout and byte order."""
    array = np.atleast_2d(table)
    big = {array.dtype[name].byteorder for name in array.dtype.names if array.dtype[name].itemsize > 1} == {">"}
    fields = [
        T["sensor_msgs/msg/PointField"](name=name, offset=offset, datatype=_DATATYPES[kind.newbyteorder("=").str[1:]], count=1)
        for name, (kind, offset) in ((n, f[:2]) for n, f in array.dtype.fields.items())
    ]
    rows = [row.tobytes() + bytes(row_padding) for row in array]
    return T["sensor_msgs/msg/PointCloud2"](
        header=header(stamp_ns, frame_id),
        height=array.shape[0],
        width=array.shape[1],
        fields=fields,
        is_bigendian=big,
        point_step=array.dtype.itemsize,
        row_step=array.dtype.itemsize * array.shape[1] + row_padding,
        data=np.frombuffer(b"".join(rows), dtype=np.uint8),
        is_dense=False,
    )


def imu(
    stamp_ns: int, rate: Sequence[float] = (0.0, 0.0, 0.0), force: Sequence[float] = (0.0, 0.0, 9.81), frame_id: str = "imu_link"
) -> Any:
    return T["sensor_msgs/msg/Imu"](
        header=header(stamp_ns, frame_id),
        orientation=quaternion(),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector(*rate),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(*force),
        linear_acceleration_covariance=np.zeros(9),
    )


def point_stamped(stamp_ns: int, x: float, y: float, z: float = 0.0) -> Any:
    return T["geometry_msgs/msg/PointStamped"](header=header(stamp_ns, "base_link"), point=point(x, y, z))


def fix(stamp_ns: int, latitude: float, longitude: float, altitude: float = 0.0, status: int = 0, covariance: Any = None) -> Any:
    return T["sensor_msgs/msg/NavSatFix"](
        header=header(stamp_ns, "gps"),
        status=T["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=float(latitude),
        longitude=float(longitude),
        altitude=float(altitude),
        position_covariance=np.zeros(9) if covariance is None else np.asarray(covariance, dtype=float).ravel(),
        position_covariance_type=0 if covariance is None else 3,
    )


def tf(stamp_ns: int, edges: Iterable[tuple[str, str, tuple[float, float, float], Any]]) -> Any:
    """TFMessage of (parent, child, translation, quaternion)."""
    transforms = [
        T["geometry_msgs/msg/TransformStamped"](
            header=header(stamp_ns, parent),
            child_frame_id=child,
            transform=T["geometry_msgs/msg/Transform"](translation=vector(*where), rotation=rotation),
        )
        for parent, child, where, rotation in edges
    ]
    return T["tf2_msgs/msg/TFMessage"](transforms=transforms)
