"""Faults of sensors that are decided while a log is read: each is survived, or reported with its topic and what to do."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.evaluation.references import reference_track
from localization.events import Scan, WheelSample
from localization.logs import Log, open_log
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.logs import warnings_of
from tests.helpers.rooms import RADIUS, SPEED, TRACK, TURN, drive

ROBOT = load_robot("vaultbot")


def opened(folder: Path, records: list[Record]) -> Log:
    return open_log(bags.write_mcap(folder / "run.mcap", records), ROBOT)


# LaserScan's angles


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.0, 1.0), (0.5, -1.0)], ids=["no step", "step from the ends", "degrees"])
def test_scan_with_impossible_angles_is_dropped_and_reported(tmp_path: Path, angles: tuple[float, float]) -> None:
    step, last = angles

    def spoil(number, scan, log_ns):
        scan.angle_increment, scan.angle_max = step, scan.angle_min + last if last >= 0 else scan.angle_max
        return scan, log_ns

    log = opened(tmp_path, drive(3.0, spoil=spoil))
    scans = [e for e in log.events() if isinstance(e, Scan)]
    if last == 1.0:  # the ends give the step
        assert len(scans) == 30
    else:
        assert scans == []
        assert "/scan: 30 messages dropped (angle_increment is zero, or makes more than a full turn" in warnings_of(log)


# /tf_static


def turned(x: float, y: float, z: float, w: float):
    return bags.T["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def with_tf(*edges: tuple) -> list[Record]:
    records = drive(1.0)
    return [*(("/tf_static", bags.tf(START, [edge]), START) for edge in edges), *records]


HERE, THERE = (0.3, 0.0, 0.2), (-0.3, 0.0, 0.2)


@pytest.mark.parametrize(
    ("edges", "expected"),
    [
        ([("base_link", "laser", HERE, bags.quaternion()), ("base_link", "laser", THERE, bags.quaternion())], "two different poses"),
        ([("base_link", "laser", HERE, bags.quaternion()), ("base_link", "laser", HERE, bags.quaternion(math.pi))], "two different poses"),
        (
            [
                ("base_link", "laser", HERE, bags.quaternion()),
                ("base_link", "mast", (0.0, 0.0, 1.0), bags.quaternion()),
                ("mast", "laser", HERE, bags.quaternion()),
            ],
            "by way of 'mast' leads to another pose of 'laser'",
        ),
        (
            [("base_link", "laser", HERE, bags.quaternion()), ("laser", "base_link", HERE, bags.quaternion())],
            "by way of 'laser' leads to another pose of 'base_link'",
        ),
        ([("base_link", "laser", HERE, turned(0.0, 0.0, 0.0, 0.0))], "'base_link' to 'laser' has a quaternion of four zeros"),
        ([("base_link", "laser", HERE, turned(0.0, 0.0, 1e-6, 0.0))], "'base_link' to 'laser' was left out: its rotation is no unit"),
        ([("base_link", "laser", HERE, bags.quaternion()), ("laser", "laser", HERE, bags.quaternion())], "cannot be its own parent"),
    ],
    ids=["two poses", "two headings", "two parents", "cycle", "zero quaternion", "tiny quaternion", "own parent"],
)
def test_static_transforms_that_contradict_are_reported(tmp_path: Path, edges: list, expected: str) -> None:
    log = opened(tmp_path, with_tf(*edges))
    assert isinstance(log.mounts, dict)
    assert expected in warnings_of(log)


def test_static_transforms_that_agree_are_not_reported(tmp_path: Path) -> None:
    """The same mount twice, rounded differently; and by two ways, as a robot's model and its own launch file publish it."""
    edges = [
        ("base_link", "laser", HERE, bags.quaternion(0.5)),
        ("base_link", "laser", (0.3001, 0.0, 0.2), bags.quaternion(0.5004)),
        ("base_link", "mast", (0.0, 0.0, 0.1), bags.quaternion()),
        ("mast", "laser", (0.3, 0.0, 0.1), bags.quaternion(0.5)),
    ]
    log = opened(tmp_path, with_tf(*edges))
    assert log.mounts["laser"].yaw == pytest.approx(0.5004)
    assert log.warnings() == []


def test_mount_contradicting_the_log_is_that_of_the_robot_file(tmp_path: Path) -> None:
    frame = "laser"
    robot = load_robot("vaultbot")
    robot = type(robot)(**{**{f: getattr(robot, f) for f in robot.__dataclass_fields__}, "mounts": {frame: Mount(x=0.7)}})
    edges = [("base_link", frame, HERE, bags.quaternion()), ("base_link", frame, THERE, bags.quaternion())]
    log = open_log(bags.write_mcap(tmp_path / "run.mcap", with_tf(*edges)), robot)
    assert log.mounts[frame] == Mount(x=0.7)
    assert "contradicts itself" in warnings_of(log)


@pytest.mark.parametrize("norm", [0.0, 1e-6])
def test_reference_with_quaternions_of_no_length_is_reported(tmp_path: Path, norm: float) -> None:
    records = []
    for i in range(20):
        message = bags.pose_stamped(START + i * S // 10, x=0.1 * i, yaw=0.5)
        if i % 2:
            message.pose.orientation = turned(0.0, 0.0, norm * math.sin(1.0), norm * math.cos(1.0))
        records.append(("/pose", message, START + i * S // 10))
    log = opened(tmp_path, records)
    track = reference_track(log.references("/pose"), "/pose")
    assert track.yaws == pytest.approx(np.full(10, 0.5))
    assert "/pose: 10 messages dropped" in warnings_of(log)


# two publishers of one topic


def wheels_of(log: Log) -> list[WheelSample]:
    return [e for e in log.events() if isinstance(e, WheelSample)]


@pytest.mark.extended
@pytest.mark.parametrize("offset_ms", [3, 10, 17])
@pytest.mark.parametrize("rate", [10, 50])
def test_second_publisher_of_zeros_loses_no_distance(tmp_path: Path, offset_ms: int, rate: int) -> None:
    """As `joint_state_publisher` does. The drive is 8 m long."""

    def records() -> Iterator[Record]:
        for topic, message, stamp in drive(20.0):
            yield topic, message, stamp
            if topic == "/joint_states" and (stamp - START) * rate // S != (stamp - START - S // 50) * rate // S:
                later = stamp + offset_ms * 1_000_000
                yield topic, bags.joint_state(later, position=(0.0,) * 4, velocity=(0.0,) * 4), later

    single = wheels_of(opened(tmp_path, drive(20.0)))
    (tmp_path / "run.mcap").unlink()
    log = opened(tmp_path, sorted(records(), key=lambda record: record[2]))
    found = wheels_of(log)
    np.testing.assert_allclose(found[-1].position, single[-1].position, atol=2.0)  # of 40 to 60 rad; the first 0.25 m cannot be separated
    assert "of a second publisher whose wheels turn no more, left out" in warnings_of(log)


def test_encoder_reset_is_no_second_publisher(tmp_path: Path) -> None:
    records = drive(20.0)
    for i, (topic, message, _) in enumerate(records):
        if topic == "/joint_states" and i > len(records) // 2:
            message.position = message.position - 30.0
    log = opened(tmp_path, records)
    assert len(wheels_of(log)) == 1000
    assert "second publisher" not in warnings_of(log)
    assert "/joint_states: 1 message with a wheel angle that wheels cannot reach" in warnings_of(log)


def test_encoder_angles_that_never_change_give_way_to_rates(tmp_path: Path) -> None:
    records = drive(10.0)
    messages = [message for topic, message, _ in records if topic == "/joint_states"]
    angles = np.array([message.position for message in messages])
    for message, rates in zip(messages, np.gradient(angles, 0.02, axis=0), strict=True):
        message.position, message.velocity = np.zeros(4), rates
    log = opened(tmp_path, records)
    found = wheels_of(log)
    unknown = np.array([not np.isfinite(sample.position).any() for sample in found])
    assert not unknown[0]
    assert unknown[-1]
    turned = sum(0.02 * sample.velocity.mean() for sample, is_unknown in zip(found, unknown, strict=True) if is_unknown)
    assert turned == pytest.approx((angles[-1] - angles[0]).mean(), abs=0.3)
    assert "wheel angles that never change while the rates do" in warnings_of(log)


# LiDAR stamps that jump by less than the second that latencies may have


@pytest.mark.parametrize("jump_s", [0.9, -0.9, 0.5, -0.5])
def test_lidar_clock_jump_below_a_second_is_corrected(tmp_path: Path, jump_s: float) -> None:
    shift = round(jump_s * S)

    def spoil(number, scan, log_ns):
        if number >= 100:
            stamp = log_ns + shift
            scan.header.stamp.sec, scan.header.stamp.nanosec = stamp // S, stamp % S
        return scan, log_ns + 20_000_000 + (number % 3) * 4_000_000

    log = opened(tmp_path, sorted(drive(20.0, spoil=spoil), key=lambda record: record[2]))
    stamps = [e.stamp_ns for e in log.events() if isinstance(e, Scan)]
    assert len(stamps) >= 198
    wrong = [abs(stamp - START - round((stamp - START) / (S / 10)) * S // 10) for stamp in stamps]
    assert max(wrong) <= 0.02 * S
    assert stamps[-1] == pytest.approx(START + 19.9 * S, abs=0.02 * S)
    assert "stamped after a jump of the clock, moved back by it" in warnings_of(log)


@pytest.mark.parametrize("jump_s", [0.9, -0.9])
def test_scans_with_outlier_stamps_below_a_second_are_dropped(tmp_path: Path, jump_s: float) -> None:
    def spoil(number, scan, log_ns):
        if number > 30 and number % 10 == 0:
            stamp = log_ns + round(jump_s * S)
            scan.header.stamp.sec, scan.header.stamp.nanosec = stamp // S, stamp % S + 1
        return scan, log_ns + 20_000_000

    log = opened(tmp_path, sorted(drive(20.0, spoil=spoil), key=lambda record: record[2]))
    stamps = [e.stamp_ns for e in log.events() if isinstance(e, Scan)]
    assert all((stamp - START) % (S // 10) == 0 for stamp in stamps)
    assert len(stamps) == 200 - 16
    assert "/scan: 16 messages dropped (stamp that fits neither" in warnings_of(log)


def doubled(
    later_ms: int, second: Callable[[Any, int], Any], topic: str = "/joint_states", first: Callable[[Any], Any] = lambda m: m
) -> list:
    """A drive whose ``topic`` has another message ``later_ms`` after each of its own."""
    found = []
    for name, message, stamp in drive(20.0):
        found.append((name, first(message) if name == topic else message, stamp))
        if name == topic:
            later = stamp + later_ms * 1_000_000
            found.append((name, second(message, later), later))
    return sorted(found, key=lambda record: record[2])


def rates_only(message):
    """The drive's wheel rates, or zeros."""
    stamp = message.header.stamp.sec * S + message.header.stamp.nanosec
    half = 0.5 * TRACK * 1.5
    rates = np.repeat([SPEED - TURN * half, SPEED + TURN * half], 2) / RADIUS if message.position.any() else np.zeros(4)
    rates *= 1.0 + 0.01 * math.sin(1e-7 * stamp)  # no wheel keeps its rate to the last digit; one that jumps between two counts slowly
    return bags.joint_state(stamp, message.name, velocity=tuple(rates))


def zeros(message, later: int):
    return bags.joint_state(later, position=(0.0,) * 4, velocity=(0.0,) * 4)


@pytest.mark.extended
@pytest.mark.parametrize("first", [lambda m: m, rates_only], ids=["angles and rates", "rates"])
def test_second_publisher_of_rates_only_loses_no_distance(tmp_path: Path, first: Callable) -> None:
    single = wheels_of(opened(tmp_path, [(t, first(m) if t == "/joint_states" else m, s) for t, m, s in drive(20.0)]))
    (tmp_path / "run.mcap").unlink()
    log = opened(tmp_path, doubled(9, lambda m, later: rates_only(zeros(m, later)), first=first))
    found = wheels_of(log)
    if np.isfinite(single[-1].position).all():
        np.testing.assert_allclose(found[-1].position, single[-1].position, rtol=0.02)
    else:
        np.testing.assert_allclose(np.mean([s.velocity for s in found], axis=0), single[-1].velocity, rtol=0.03)
    assert "of a second publisher whose wheels turn no more, left out" in warnings_of(log)


def test_second_publisher_of_odometry_loses_no_distance(tmp_path: Path) -> None:
    records = []
    for i in range(500):
        stamp = START + i * S // 50
        x = 0.5 * i / 50
        records.append(("/odom", bags.odometry(stamp, x=x, vx=0.5), stamp))
        records.append(("/odom", bags.odometry(stamp + 8_000_000, x=0.0, vx=0.0), stamp + 8_000_000))
    log = opened(tmp_path, records)
    found = wheels_of(log)
    driven = (found[-1].position - found[0].position) * ROBOT.driver.wheel_radius_m
    np.testing.assert_allclose(driven, 0.5 * 499 / 50, rtol=0.03)
    assert "/odom: " in warnings_of(log)
    assert "of a second publisher" in warnings_of(log)


def test_second_publisher_of_odometry_of_equal_ways_is_left_out(tmp_path: Path) -> None:
    """A simulator's odometry of another frame beside that of the wheels, with the same speeds."""
    records = []
    for i in range(500):
        stamp = START + i * S // 50
        x = 0.5 * i / 50
        records.append(("/odom", bags.odometry(stamp, x=x, vx=0.5), stamp))
        records.append(("/odom", bags.odometry(stamp + 8_000_000, x=x + 6.0, y=-3.0, vx=0.5), stamp + 8_000_000))
    log = opened(tmp_path, records)
    found = wheels_of(log)
    driven = (found[-1].position - found[0].position) * ROBOT.driver.wheel_radius_m
    np.testing.assert_allclose(driven, 0.5 * 499 / 50, rtol=0.03)
    assert len(found) < 520
    assert "of a second publisher whose wheels turn no more, left out" in warnings_of(log)


def test_odometry_whose_speed_alternates_and_whose_pose_goes_on_is_one_publisher(tmp_path: Path) -> None:
    """fr079's robot in feet: its speeds differ by 1.4 m/s from one message to the next, and its ways as much."""
    records, x = [], 0.0
    for i in range(400):
        speed = 2.8 if i % 4 == 3 else 1.4
        x += 0.12 * speed
        records.append(("/odom", bags.odometry(START + i * 120_000_000, x=x, vx=speed), START + i * 120_000_000))
    log = opened(tmp_path, records)
    assert len(wheels_of(log)) == 400
    assert log.warnings() == []


def test_odometry_that_stops_at_once_is_no_second_publisher(tmp_path: Path) -> None:
    records = [
        ("/odom", bags.odometry(START + i * S // 50, x=0.5 * min(i, 250) / 50, vx=0.5 if i < 250 else 0.0), START + i * S // 50)
        for i in range(500)
    ]
    log = opened(tmp_path, records)
    assert len(wheels_of(log)) == 500
    assert log.warnings() == []


def test_frozen_wheel_is_excluded_and_named(tmp_path: Path) -> None:
    single = wheels_of(opened(tmp_path, drive(20.0)))
    (tmp_path / "run.mcap").unlink()
    records = drive(20.0)
    for topic, message, _ in records:
        if topic == "/joint_states":
            message.position = message.position * (np.arange(len(message.position)) > 0)
    log = opened(tmp_path, records)
    found = wheels_of(log)
    np.testing.assert_allclose(found[-1].position, single[-1].position, atol=0.05)
    assert f"/joint_states, joint '{ROBOT.joints.left[0]}': " in warnings_of(log)
    assert "its side turns; it was left out" in warnings_of(log)


def test_frozen_wheels_are_counted_by_joint(tmp_path: Path) -> None:
    """A joint that does not count from 5 to 8 s, nor from 12 to 14 s: 250 of the messages, but for where the wheels turn too slowly."""
    records, held = drive(20.0), 0.0
    for topic, message, at_ns in records:
        if topic == "/joint_states":
            t_s = (at_ns - START) / S
            angles = np.array(message.position)
            held = held if 5.0 <= t_s < 8.0 or 12.0 <= t_s < 14.0 else float(angles[0])
            message.position = np.r_[held, angles[1:]]
    log = opened(tmp_path, records)
    assert log.frozen_wheels() == ()
    list(log.events())
    (frozen,) = log.frozen_wheels()
    assert (frozen.joint, frozen.spells) == (ROBOT.joints.left[0], 2)
    assert frozen.messages == pytest.approx(250, abs=3)
