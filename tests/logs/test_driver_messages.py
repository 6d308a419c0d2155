"""Wheels in messages of drivers' own types: real serialized messages, in logs of both kinds and live."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from localization.events import WheelSample
from localization.logs import Log, TopicOverrides, open_log
from localization.logs.driver_messages import DRIVER_MESSAGES, definitions
from localization.logs.message_templates import STORE
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, S

ROBOT = load_robot("vaultbot")
RATE = 2.0
"""Of all wheels [rad/s]; the right ones turn half as fast."""
COUNT_RAD = math.tau / 1000.0
T = STORE.types


def drivers(kind: str, angles: tuple[float, float], header: Any) -> Any:
    """Fields of a message ``kind`` for wheels at ``angles`` [rad], left and right, of speeds `RATE` and half of it."""
    rates, package = (RATE, 0.5 * RATE), kind.split("/", 1)[0]
    if kind.endswith("/Feedback"):
        of = T[f"{package}/msg/DriveFeedback"]
        parts = [of(0.0, 0.0, 0.0, 0.0, rate, angle, False) for angle, rate in zip(angles, rates, strict=True)]
        return T[kind](header, parts, 0.0, 0.0, 0, 0)
    if kind.endswith("/LynxMultiFeedback"):
        of, names = T[f"{package}/msg/LynxFeedback"], (ROBOT.joints.left, ROBOT.joints.right)
        parts = [of(0, name, 0.0, 0.0, rates[i], angles[i]) for i in (0, 1) for name in names[i]]
        return T[kind](header, parts)
    if kind.endswith("/SensorState"):
        counts = [round(angle / 0.002436916871363930187454) % 65536 for angle in angles]
        empty = [np.zeros(0, np.uint16), np.zeros(0, np.uint8)]
        return T[kind](header, 0, 0, 0, 0, *counts, 0, 0, 0, 0, 0, *empty, 0, 0, empty[0])
    if kind.endswith("/WheelTicks"):
        return T[kind](header, *(round(angle / math.tau * 508.8) for angle in angles))
    if kind.endswith("/WheelVels"):
        return T[kind](header, *rates)
    return T[kind](0, *(round(angle / COUNT_RAD) for angle in angles))


def stamps() -> list[int]:
    return [START + i * S // 20 for i in range(100)]


def angles_at(stamp: int) -> tuple[float, float]:
    """Begins just below where a counter of 16 bits wraps, 159.7 rad."""
    angle = 158.0 + RATE * (stamp - START) / S
    return angle, 0.5 * angle


def messages(kind: str) -> list[tuple[str, Any, int]]:
    return [("/driver/feedback", drivers(kind, angles_at(t), bags.header(t)), t) for t in stamps()]


def write(path: Path, records: list[tuple[str, Any, int]], *, is_ros1: bool = False) -> Path:
    """With the definitions of the types, as recorders write them."""
    known = get_typestore(Stores.ROS1_NOETIC) if is_ros1 else STORE
    if is_ros1:
        known.register(definitions())
    raw = []
    for topic, message, at in records:
        kind = message.__msgtype__
        data = bytes(STORE.serialize_cdr(message, kind))
        text, _ = known.generate_msgdef(kind, ros_version=1 if is_ros1 else 2)
        raw.append((topic, bags.Unknown(kind, text, bytes(STORE.cdr_to_ros1(data, kind)) if is_ros1 else data), at))
    return bags.write_ros1_bag(path.with_suffix(".bag"), raw) if is_ros1 else bags.write_mcap(path.with_suffix(".mcap"), raw)


def wheels(log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    found = [event for event in log.events() if isinstance(event, WheelSample)]
    return np.array([(e.stamp_ns - START) / S for e in found]), np.array([e.position for e in found]), np.array([e.velocity for e in found])


def counting(robot: Robot) -> Robot:
    from dataclasses import replace

    return replace(robot, joints=replace(robot.joints, angle_unit_rad=COUNT_RAD))


OF_ONE_TOPIC = sorted(kind for kind in DRIVER_MESSAGES if not kind.startswith("std_msgs"))


@pytest.mark.parametrize("is_ros1", [False, pytest.param(True, marks=pytest.mark.extended)], ids=["ros2", "ros1"])
@pytest.mark.parametrize("kind", OF_ONE_TOPIC)
def test_wheels_of_a_drivers_own_message_are_read(kind: str, is_ros1: bool, tmp_path: Path) -> None:
    robot = counting(ROBOT) if "oboclaw" in kind else ROBOT
    log = open_log(write(tmp_path / "run", messages(kind), is_ros1=is_ros1), robot)
    t, angles, rates = wheels(log)
    assert log.wheels_error is None
    assert len(t) >= 95
    if kind.endswith("/WheelVels"):
        np.testing.assert_allclose(rates, [[RATE, 0.5 * RATE]] * len(t), rtol=1e-6)
    else:
        np.testing.assert_allclose(angles - angles[0], (t - t[0])[:, None] * [RATE, 0.5 * RATE], atol=0.015)
    assert "/driver/feedback" in " ".join(log.warnings())


@pytest.mark.parametrize("kind", ["Int16", "Int32", "Int64"])
def test_counts_on_a_topic_for_each_side_are_put_together(kind: str, tmp_path: Path) -> None:
    of, records = T[f"std_msgs/msg/{kind}"], []
    for t in stamps():
        counts = [round(angle / COUNT_RAD) for angle in angles_at(t)]
        counts = [(count + 32768) % 65536 - 32768 for count in counts] if kind == "Int16" else counts
        records += [("/left_ticks", of(counts[0]), t), ("/right_ticks", of(counts[1]), t + 1000), ("/battery", of(1), t)]
    log = open_log(write(tmp_path / "run", records), counting(ROBOT))
    t, angles, _ = wheels(log)
    assert sorted(source.topic for source in log.sources.all_wheels) == ["/left_ticks", "/right_ticks"]
    np.testing.assert_allclose(angles[-1] - angles[0], (t[-1] - t[0]) * np.array([RATE, 0.5 * RATE]), atol=0.15)


def test_joint_states_with_the_wheels_are_preferred(tmp_path: Path) -> None:
    names = (*ROBOT.joints.left, *ROBOT.joints.right)
    joints = [("/joint_states", bags.joint_state(t, names, [0.0] * 4, [0.0] * 4), t) for t in stamps()]
    records = sorted([*messages("jackal_msgs/msg/Feedback"), *joints], key=lambda record: record[2])
    log = open_log(write(tmp_path / "run", records), ROBOT)
    assert log.sources.wheels is not None
    assert log.sources.wheels.topic == "/joint_states"


def test_counts_are_preferred_to_speeds_and_either_may_be_named(tmp_path: Path) -> None:
    kinds = {"/ticks": "irobot_create_msgs/msg/WheelTicks", "/speeds": "irobot_create_msgs/msg/WheelVels"}
    records = [(topic, drivers(kind, angles_at(t), bags.header(t)), t) for t in stamps() for topic, kind in kinds.items()]
    path = write(tmp_path / "run", records)
    for topics, expected in ((TopicOverrides(), "/ticks"), (TopicOverrides(joint_states="/speeds"), "/speeds")):
        log = open_log(path, ROBOT, topics)
        assert log.sources.wheels is not None
        assert log.sources.wheels.topic == expected
        assert len(wheels(log)[0]) > 90


def imu(stamp: int, yaw: float, *, has_orientation: bool = True) -> Any:
    message = bags.imu(stamp, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    message.angular_velocity_covariance[0] = -1.0
    message.orientation_covariance[0] = 0.0 if has_orientation else -1.0
    message.orientation = bags.quaternion(yaw)
    return message


def test_imu_without_a_gyro_turns_by_its_orientation(tmp_path: Path) -> None:
    turn = 0.7
    records = [("/ahrs", imu(t, 3.0 + turn * (t - START) / S), t) for t in stamps()]
    records += [("/odom", bags.odometry(t), t) for t in stamps()]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", sorted(records, key=lambda record: record[2])), ROBOT)
    rates = np.array([event.angular_velocity for event in log.events() if hasattr(event, "angular_velocity")])
    np.testing.assert_allclose(rates, [[0.0, 0.0, turn]] * (len(records) // 2 - 1), atol=1e-6)
    assert any("its rates are those of the orientation" in warning for warning in log.warnings())


def test_imu_with_neither_gyro_nor_orientation_is_left_out(tmp_path: Path) -> None:
    records = [("/imu", imu(t, 0.0, has_orientation=False), t) for t in stamps()]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", records), ROBOT)
    assert not [event for event in log.events() if hasattr(event, "angular_velocity")]
    assert any("this IMU has no gyro" in warning for warning in log.warnings())
