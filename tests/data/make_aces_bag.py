"""Convert the ACES log (CARMEN text) into a ROS 2 bag: one bare .mcap, zstd-compressed, the same bytes for the same input.

Run once, to make the log that is shipped beside this file:

    python tests/data/make_aces_bag.py PATH/TO/aces.clf.bz2 tests/data/aces/aces.mcap

Columns of the source (CARMEN; n = 180 beams):

    ODOM x y theta tv rv accel ipc_time host logger_time
    FLASER n r1 .. rn  laser_x laser_y laser_theta  odom_x odom_y odom_theta  ipc_time host logger_time

The pose that a FLASER line repeats is stale and is not converted; the ODOM lines are, by their own stamps. `SOURCE.txt` in the
folder of the log says what each topic holds and where the data come from.
"""

from __future__ import annotations

import bz2
import math
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
BEAMS = 180
RANGE_MAX = 50.0
"""A reading of 50.00 m is no hit."""
_FOREVER = QosTime(0, 0)
# What a late subscriber needs to get /tf_static at all.
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.SYSTEM_DEFAULT,
    _FOREVER,
    False,
)


def stamp_of(ipc_time: str) -> int:
    """Nanoseconds of a stamp [s] that is written to the microsecond."""
    return round(float(ipc_time) * 1e6) * 1000


def header(stamp_ns: int, frame_id: str) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:
    return TYPES["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def planar_rotation(yaw: float) -> Any:
    return TYPES["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def scan_message(fields: list[str]) -> tuple[int, Any]:
    """Stamp and LaserScan of a FLASER line."""
    if int(fields[1]) != BEAMS or len(fields) != BEAMS + 11:
        raise SystemExit(f"FLASER line with {fields[1]} beams and {len(fields)} fields; expected {BEAMS} and {BEAMS + 11}.")
    stamp_ns = stamp_of(fields[-3])
    ranges = np.array(fields[2 : 2 + BEAMS], dtype=np.float64).astype(np.float32)
    step = math.radians(1.0)
    message = TYPES["sensor_msgs/msg/LaserScan"](
        header=header(stamp_ns, "laser"),
        angle_min=-math.pi / 2,
        angle_max=-math.pi / 2 + (BEAMS - 1) * step,
        angle_increment=step,
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.05,
        range_max=RANGE_MAX,
        ranges=ranges,
        intensities=np.empty(0, dtype=np.float32),
    )
    return stamp_ns, message


def odometry_message(fields: list[str]) -> tuple[int, Any]:
    """Stamp and Odometry of an ODOM line. Its covariances are zero: the log knows none."""
    if len(fields) != 10:
        raise SystemExit(f"ODOM line with {len(fields)} fields; expected 10.")
    x, y, theta, tv, rv = (float(f) for f in fields[1:6])
    stamp_ns = stamp_of(fields[-3])
    pose = TYPES["geometry_msgs/msg/Pose"](
        position=TYPES["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
        orientation=planar_rotation(theta),
    )
    twist = TYPES["geometry_msgs/msg/Twist"](linear=vector(tv), angular=vector(z=rv))
    message = TYPES["nav_msgs/msg/Odometry"](
        header=header(stamp_ns, "odom"),
        child_frame_id="base_link",
        pose=TYPES["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=TYPES["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )
    return stamp_ns, message


def mount_message(stamp_ns: int) -> Any:
    """base_link -> laser: the identity, as PARAM robot_frontlaser_offset 0.0 says."""
    transform = TYPES["geometry_msgs/msg/Transform"](translation=vector(), rotation=planar_rotation(0.0))
    stamped = TYPES["geometry_msgs/msg/TransformStamped"](header=header(stamp_ns, "base_link"), child_frame_id="laser", transform=transform)
    return TYPES["tf2_msgs/msg/TFMessage"](transforms=[stamped])


def messages(lines: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
    """Topic, log time and message, in the order of the file.

    The log time is the stamp, raised where the file's order goes back in time, so that reading by log time keeps that order.
    """
    convert = {"FLASER": ("/scan", scan_message), "ODOM": ("/odom", odometry_message)}
    log_time = -1
    for line in lines:
        fields = line.split()
        if not fields or fields[0] not in convert:
            continue
        topic, message_of = convert[fields[0]]
        stamp_ns, message = message_of(fields)
        if log_time < 0:
            yield "/tf_static", stamp_ns, mount_message(stamp_ns)
        log_time = max(log_time, stamp_ns)
        yield topic, log_time, message


def write_bag(lines: Iterable[str], out: Path) -> None:
    """Write the bare .mcap ``out``, which must not exist."""
    if out.exists():
        raise SystemExit(f"'{out}' exists already; remove it first.")
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        bag = Path(folder) / out.stem
        writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connections = {
                topic: writer.add_connection(topic, msgtype, typestore=STORE, offered_qos_profiles=qos)
                for topic, msgtype, qos in (
                    ("/tf_static", "tf2_msgs/msg/TFMessage", [LATCHED]),
                    ("/scan", "sensor_msgs/msg/LaserScan", []),
                    ("/odom", "nav_msgs/msg/Odometry", []),
                )
            }
            for topic, log_time, message in messages(lines):
                connection = connections[topic]
                writer.write(connection, log_time, STORE.serialize_cdr(message, connection.msgtype))
        shutil.move(bag / f"{out.stem}.mcap", out)


def main() -> None:
    if len(sys.argv) != 3:
        raise SystemExit("usage: python make_aces_bag.py PATH/TO/aces.clf.bz2 OUT.mcap")
    source, out = Path(sys.argv[1]), Path(sys.argv[2])
    opener = bz2.open if source.suffix == ".bz2" else open
    with opener(source, "rt", encoding="ascii") as lines:
        write_bag(lines, out)


if __name__ == "__main__":
    main()
