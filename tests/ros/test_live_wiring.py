"""Live wheels whose signs or units are not those of the robot file."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.calibration.wheel_wiring import LiveSensors
from localization.logs import open_log
from localization.logs.decode import decode_imu
from localization.logs.event_decoder import TopicDecoder
from localization.logs.reader import open_source
from localization.logs.topic_roles import TopicOverrides
from localization.logs.wheel_messages import wheel_decoder
from localization.pipeline import Trial
from localization.ros.jit_warm_up import WarmUp
from localization.ros.live_wiring import LiveWiring
from localization.ros.node import Node
from localization.ros.session import Files
from localization.ros.settings import LiveRun, NodeConfig
from localization.ros.transports.transport import Received
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle, records_of, write
from tests.helpers.entrance_drives import drive as robot_drive
from tests.helpers.extended import cases
from tests.helpers.online import LogTransport, track
from tests.helpers.wiring import ROBOT_TOML, drive, unchanged

WRONG = {
    "right side reversed": (lambda a, r: (a * [1, 1, -1, -1], r * [1, 1, -1, -1]), 1.0, 'joints.reversed = ["front_right_wheel"'),
    "swapped": (lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]]), 1.0, "left and right wheels are swapped, or the gyro's sign"),
    "rpm": (lambda a, r: (np.zeros(0), 9.5493 * r), 1.0, "joints.rate_unit_rad_s = 0.10472"),
    "degrees": (lambda a, r: (57.2958 * a, 57.2958 * r), 1.0, "joints.angle_unit_rad = 0.0174533"),
    "speeds without a sign": (lambda a, r: (np.zeros(0), np.abs(r)), 1.0, "speeds without a sign"),
    "gyro in deg/s": (unchanged, 57.2958, "imu.rate_unit_rad_s = 0.0174533"),
}


def sentences(path: Path, robot: Robot) -> list[str]:
    log = open_log(path, robot)
    wheels, imu = wheel_decoder((*robot.joints.left, *robot.joints.right), robot.joints), decode_imu
    wiring = LiveWiring(LiveSensors(robot, log.sources, log.mounts), (robot.joints.left, robot.joints.right))
    for reading in log.readings({"/joint_states": TopicDecoder(0, wheels), "/imu/data": TopicDecoder(1, imu)}):
        wiring.add(reading)
    return [] if wiring.found is None else [*wiring.found.findings]


@pytest.mark.parametrize("name", cases(WRONG, usual=["right side reversed", "degrees"]))
def test_live_wiring_that_contradicts_the_file_is_named_with_its_key(name: str, tmp_path: Path) -> None:
    change, gyro, words = WRONG[name]
    found = sentences(drive(tmp_path / "log.mcap", change, gyro), load_robot(ROBOT_TOML))
    assert words in " ".join(found)


def test_live_wiring_of_a_healthy_robot_has_no_sentence(tmp_path: Path) -> None:
    robot = load_robot(ROBOT_TOML)
    assert sentences(drive(tmp_path / "log.mcap"), robot) == []
    assert sentences(drive(tmp_path / "still.mcap", lambda a, r: (0.0 * a, 0.0 * r)), replace(robot, name="still")) == []


SCANNING = Vehicle(scan_hz=8.0, seed=5)
LIVE = {
    "right side reversed": (Vehicle(seed=5), Publishing(lambda a, r: (a * [1, 1, -1, -1], r * [1, 1, -1, -1])), "joints.reversed", 1.0),
    "swapped by gyro and LiDAR": (SCANNING, Publishing(lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]])), "joints.left", 0.03),
    "rpm and right side reversed": (
        SCANNING,
        Publishing(lambda a, r: (a * [1, 1, -1, -1], 9.5493 * r * [1, 1, -1, -1])),
        "joints.rate_unit_rad_s = 0.10472",
        0.03,
    ),
    "driver that corrects for skidding": (
        Vehicle(seed=5),
        Publishing(forms="odometry", odometry_k=0.6),
        "driver.wheel_separation_multiplier",
        1.0,
    ),
    "driver that turns the other way": (SCANNING, Publishing(forms="odometry", gyro=-1.0), "imu.rate_unit_rad_s = -1", 0.03),
    "LiDAR upside down": (SCANNING, Publishing(lidar_flip=True), "'laser' is mounted upside down", 0.03),
    "LiDAR 0.35 s late": (SCANNING, Publishing(offsets_s={"/scan": 0.35}), "clock.lidar_time_offset_s = 0.3", 0.03),
    "LiDAR 0.4 s late, no gyro": (
        Vehicle(scan_hz=8.0, imu_hz=0.0, seed=5),
        Publishing(offsets_s={"/scan": 0.4}),
        "no third sensor shows which",
        0.4,
    ),
    "all wheels backwards": (SCANNING, Publishing(lambda a, r: (-a, -r)), "all wheels count backwards", 0.03),
    "swapped, LiDAR backwards": (
        SCANNING,
        Publishing(lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]]), lidar_yaw=math.pi),
        "joints.left",
        0.03,
    ),
    "swapped by the gyro alone": (Vehicle(seed=5), Publishing(lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]])), "swapped, or", math.inf),
}


PREFIXED = replace(
    SCANNING, left=tuple(f"robot1/{name}" for name in SCANNING.left), right=tuple(f"robot1/{name}" for name in SCANNING.right)
)


def centimetres(message: Any) -> Any:
    """A driver's odometry in centimetres."""
    for part in (message.pose.pose.position, message.twist.twist.linear):
        part.x, part.y = 100.0 * part.x, 100.0 * part.y
    return message


def started(vehicle: Vehicle, transport: LogTransport, reports: list[str], state: Path | None = None) -> Node:
    """A live node; the EKF where there is a LiDAR."""
    robot = vehicle.robot()
    run = LiveRun(
        robot,
        lambda has_lidar: Trial(make_model("skid_steer", robot), "ekf" if has_lidar else "odometry"),
        Files(state=state),
        TopicOverrides(),
        node=NodeConfig(wait_s=0.0, predict=False),
    )
    WarmUp(run).wait(with_clouds=False)
    return Node.start(transport, run, reports.append)


@pytest.mark.parametrize("name", cases(LIVE, usual=["right side reversed"]))
@pytest.mark.xdist_group("online")
def test_live_node_with_wrong_wiring_goes_back_to_the_start_of_the_drive(name: str, tmp_path: Path) -> None:
    """The last published pose is the true one, within ``error_m`` and within its covariance."""
    vehicle, how, words, error_m = LIVE[name]
    motion, reports = robot_drive(vehicle), []
    transport = LogTransport(write(tmp_path / "log.mcap", vehicle, motion, how))
    node = started(vehicle, transport, reports)
    node.spin(transport.is_empty)
    named = [
        report
        for report in reports
        if "write to the robot file" in report or "in the log decides" in report or "upside" in report or "third" in report
    ]
    assert words in " ".join(named)
    assert set(named) <= set(node.warnings())
    live = track(transport)
    pose, sigmas = live[max(live)]
    errors = pose - motion.trajectory().at(np.array([min(max(live), motion.trajectory().stamps_ns[-1])]))[0]
    errors[2] = math.remainder(errors[2], math.tau)
    assert math.hypot(*errors[:2]) < error_m
    assert (np.abs(errors) < 4.0 * sigmas).all()


@pytest.mark.extended
@pytest.mark.parametrize("backwards", [(), (2, 3)], ids=["as in the file", "right side reversed"])
@pytest.mark.xdist_group("online")
def test_live_node_finds_joints_of_another_prefix(backwards: tuple[int, ...], tmp_path: Path) -> None:
    signs = np.array([-1.0 if i in backwards else 1.0 for i in range(4)])
    motion, reports = robot_drive(PREFIXED), []
    transport = LogTransport(write(tmp_path / "log.mcap", PREFIXED, motion, Publishing(lambda a, r: (a * signs, r * signs))))
    node = started(SCANNING, transport, reports)
    node.spin(transport.is_empty)
    assert "its joints have other names than the robot file's" in " ".join([*reports, *node.warnings()])
    assert ("joints.reversed" in " ".join(reports)) == bool(backwards)
    assert end_error(transport, motion) < 0.03


@pytest.mark.extended
@pytest.mark.xdist_group("online")
def test_live_node_reads_odometry_in_centimetres_by_the_lidar(tmp_path: Path) -> None:
    motion, reports = robot_drive(SCANNING), []
    records = records_of(SCANNING, motion, Publishing(forms="odometry"))
    changed = [(topic, centimetres(message) if topic == "/odom" else message, log_ns) for topic, message, log_ns in records]
    transport = LogTransport(bags.write_mcap(tmp_path / "log.mcap", changed))
    node = started(SCANNING, transport, reports)
    node.spin(transport.is_empty)
    assert "driver.length_unit_m = 0.01" in " ".join(reports)
    assert end_error(transport, motion) < 0.03


def end_error(transport: LogTransport, motion: Motion) -> float:
    """Error of the last published position [m]."""
    live = track(transport)
    pose, _ = live[max(live)]
    true = motion.trajectory().at(np.array([min(max(live), motion.trajectory().stamps_ns[-1])]))[0]
    return math.hypot(*(pose - true)[:2])


@pytest.mark.extended
@pytest.mark.xdist_group("online")
def test_live_node_that_resumes_reads_its_wheels_as_they_were_found(tmp_path: Path) -> None:
    vehicle, how, _, _ = LIVE["right side reversed"]
    log = write(tmp_path / "log.mcap", vehicle, robot_drive(vehicle), how)
    source = open_source(log)
    middle_ns = source.start_ns + (source.end_ns - source.start_ns) // 2
    found = []
    for is_first in (True, False):
        begin, end = (source.start_ns, middle_ns) if is_first else (middle_ns, source.end_ns)
        reports: list[str] = []
        transport = LogTransport(log, lambda messages, b=begin, e=end: part_of(messages, b - source.start_ns, e - source.start_ns))
        node = started(vehicle, transport, reports, tmp_path / "state")
        node.spin(transport.is_empty)
        node.finish()
        found.append((node, reports, track(transport)))
    assert sum("joints.reversed" in report for report in found[0][1]) == 1
    assert not any("joints.reversed" in report for report in found[1][1])
    whole = LogTransport(log)
    started(vehicle, whole, []).spin(whole.is_empty)
    live, split = track(whole), found[1][2]
    np.testing.assert_allclose(split[max(split)][0], live[max(live)][0], atol=0.02)


def part_of(messages: list[Received], begin_ns: int, end_ns: int) -> list[Received]:
    """Those that came between two times since the first."""
    first = messages[0].received_ns
    return [m for m in messages if m.topic == "/tf_static" or begin_ns <= m.received_ns - first < end_ns]
