"""Live wheels whose signs or units are not those of the robot file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from localization.calibration.wheel_wiring import LiveSensors
from localization.logs import open_log
from localization.logs.decode import decode_imu
from localization.logs.event_decoder import TopicDecoder
from localization.logs.topic_roles import TopicOverrides
from localization.logs.wheel_messages import wheel_decoder
from localization.pipeline import Trial
from localization.ros.jit_warm_up import WarmUp
from localization.ros.live_wiring import LiveWiring
from localization.ros.node import Node
from localization.ros.session import Files
from localization.ros.settings import LiveRun, NodeConfig
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers.extended import cases
from tests.helpers.online import LogTransport
from tests.helpers.wiring import CASES, ROBOT_TOML, drive, unchanged

WRONG = {
    "right side reversed": (lambda a, r: (a * [1, 1, -1, -1], r * [1, 1, -1, -1]), 1.0, 'joints.reversed = ["front_right_wheel"'),
    "swapped": (lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]]), 1.0, "left and right wheels are swapped, or the gyro's sign"),
    "rpm": (lambda a, r: (np.zeros(0), 9.5493 * r), 1.0, "joints.rate_unit_rad_s = 0.10472"),
    "degrees": (lambda a, r: (57.2958 * a, 57.2958 * r), 1.0, "joints.angle_unit_rad = 0.0174533"),
    "gyro in deg/s": (unchanged, 57.2958, "imu.rate_unit_rad_s = 0.0174533"),
}


def sentences(path: Path, robot: Robot) -> list[str]:
    log = open_log(path, robot)
    wheels, imu = wheel_decoder((*robot.joints.left, *robot.joints.right), robot.joints), decode_imu
    wiring, found = LiveWiring(LiveSensors(robot, log.sources), log.mounts, (robot.joints.left, robot.joints.right)), []
    for reading in log.readings({"/joint_states": TopicDecoder(0, wheels), "/imu/data": TopicDecoder(1, imu)}):
        if not wiring.is_done:
            found += wiring.add(reading)
    return found


@pytest.mark.parametrize("name", cases(WRONG, usual=["right side reversed", "degrees"]))
def test_live_wiring_that_contradicts_the_file_is_named_with_its_key(name: str, tmp_path: Path) -> None:
    change, gyro, words = WRONG[name]
    found = sentences(drive(tmp_path / "log.mcap", change, gyro), load_robot(ROBOT_TOML))
    assert words in " ".join(found)
    assert "Corrected in this run" not in " ".join(found)


def test_live_wiring_of_a_healthy_robot_has_no_sentence(tmp_path: Path) -> None:
    robot = load_robot(ROBOT_TOML)
    assert sentences(drive(tmp_path / "log.mcap"), robot) == []
    assert sentences(drive(tmp_path / "still.mcap", lambda a, r: (0.0 * a, 0.0 * r)), replace(robot, name="still")) == []


@pytest.mark.extended
@pytest.mark.xdist_group("online")
def test_live_node_with_the_right_side_reversed_has_one_sentence_and_warns() -> None:
    robot, reports = load_robot(ROBOT_TOML), []
    transport = LogTransport(CASES / "H06-right-side-inverted" / "log.mcap")
    run = LiveRun(
        robot,
        lambda has_lidar: Trial(make_model("skid_steer", robot), "odometry"),
        Files(),
        TopicOverrides(),
        node=NodeConfig(wait_s=0.0, predict=False),
    )
    WarmUp(run).wait(with_clouds=False)
    node = Node.start(transport, run, reports.append)
    node.spin(transport.is_empty)
    assert sum("joints.reversed" in report for report in reports) == 1
    assert any("joints.reversed" in warning for warning in node.warnings())
