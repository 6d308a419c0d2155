"""The healthy drive of tests/data/cases/base-log, as robots publish it whose wheels, gyro or drivers are wired or scaled otherwise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from localization.logs.chunks import merge_channels
from localization.logs.decode import yaw_of
from localization.logs.reader import open_source
from localization.logs.serialization import LogDeserializer
from tests.helpers import bags
from tests.helpers.bags import Record

CASES = Path(__file__).parents[1] / "data" / "cases"
ROBOT_TOML = CASES / "H06-right-side-inverted" / "robot.toml"
LEFT, RIGHT = ("front_left_wheel", "rear_left_wheel"), ("front_right_wheel", "rear_right_wheel")

Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Positions and velocities (4,) of `LEFT` and `RIGHT` to what the driver publishes."""


def unchanged(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As they are."""
    return position, velocity


def drive(
    path: Path,
    joints: Change = unchanged,
    gyro: float = 1.0,
    *,
    names: Sequence[str] = (*LEFT, *RIGHT),
    has_odometry: bool = False,
    has_joints: bool = True,
) -> Path:
    """The drive at ``path``: ``joints`` changed, the gyro's rates times ``gyro``, and the driver's (true) odometry on /odom if wanted."""
    source = open_source(CASES / "base-log" / "log.mcap")
    decode = LogDeserializer(merge_channels(source.channels), is_ros1=False)
    records: list[Record] = []
    for raw in source.messages(["/joint_states", "/imu/data", "/ground_truth/odom"]):
        message = decode(raw)
        stamp = message.header.stamp.sec * bags.S + message.header.stamp.nanosec
        if raw.topic == "/joint_states" and has_joints:
            position, velocity = joints(np.array(message.position), np.array(message.velocity))
            records.append((raw.topic, bags.joint_state(stamp, names, position, velocity), raw.log_ns))
        elif raw.topic == "/imu/data":
            w, a = message.angular_velocity, message.linear_acceleration
            records.append((raw.topic, bags.imu(stamp, (gyro * w.x, gyro * w.y, gyro * w.z), (a.x, a.y, a.z), "imu_link"), raw.log_ns))
        elif raw.topic == "/ground_truth/odom" and has_odometry:
            records.append(("/odom", _driver(message, stamp), raw.log_ns))
    return bags.write_mcap(path, records)


def _driver(message: Any, stamp: int) -> Any:
    pose, twist = message.pose.pose, message.twist.twist
    yaw = yaw_of(pose.orientation)
    return bags.odometry(stamp, pose.position.x, pose.position.y, yaw, twist.linear.x, twist.angular.z)
