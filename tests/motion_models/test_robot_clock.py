"""[clock] and the wheels' radius multipliers in robot files."""

from __future__ import annotations

import dataclasses

import pytest

from motion_models.errors import RobotError
from motion_models.robot import Clock, load_robot, parse_robot
from motion_models.robot_file import robot_toml


def test_robot_toml_clock_and_multipliers_round_trip() -> None:
    robot = load_robot("husky_a200")
    geometry = dataclasses.replace(robot.geometry, left_wheel_radius_multiplier=1.01, right_wheel_radius_multiplier=0.99)
    changed = dataclasses.replace(robot, geometry=geometry, clock=Clock(wheel_time_offset_s=-0.114))
    assert parse_robot(robot_toml(changed), "test") == changed


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("[clock]\nwheel_time_offset_s = 60.0", "clock.wheel_time_offset_s is 60"),
        ("[clock]\nwheels = 0.1", "unknown entry wheels"),
        ('[clock]\nwheel_time_offset_s = "late"', "clock.wheel_time_offset_s must be a finite number"),
    ],
)
def test_parse_robot_bad_clock_is_refused(line: str, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        parse_robot(robot_toml(load_robot("husky_a200")).split("\n[clock]")[0] + "\n" + line + "\n", "test")


def test_parse_robot_multiplier_far_from_one_is_refused() -> None:
    text = robot_toml(load_robot("husky_a200")).replace("[geometry]\n", "[geometry]\nleft_wheel_radius_multiplier = 0.0\n")
    with pytest.raises(RobotError, match="must be near 1"):
        parse_robot(text, "test")
