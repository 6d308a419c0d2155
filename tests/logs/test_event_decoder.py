"""Clock offsets and wheel radii of the robot file act on events when messages are decoded."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from localization.events import Event, ImuSample, Scan, WheelSample
from localization.logs import open_log
from motion_models.robot import Clock, Robot
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import bag, drive


def first_events(path: Path, robot: Robot) -> dict[type[Event], list[Event]]:
    found: dict[type[Event], list[Event]] = {WheelSample: [], ImuSample: [], Scan: []}
    for event in open_log(path, robot).events():
        if type(event) in found:
            found[type(event)].append(event)
        if all(len(events) > 40 for events in found.values()):
            break
    return found


def test_events_clock_offsets_shift_stamps_of_their_sensor(tmp_path: Path) -> None:
    robot = load_robot("husky_a200")
    path = bag(tmp_path / "drive.mcap", {}, 1, "husky_a200", drive("20s"))
    clock = Clock(wheel_time_offset_s=0.05, lidar_time_offset_s=-0.02, gyro_time_offset_s=0.03)
    before, after = first_events(path, robot), first_events(path, dataclasses.replace(robot, clock=clock))
    for kind, offset_s in ((WheelSample, 0.05), (Scan, -0.02), (ImuSample, 0.03)):
        shifts = [(a.stamp_ns - b.stamp_ns) * 1e-9 for a, b in zip(before[kind][:30], after[kind][:30], strict=True)]
        assert shifts == pytest.approx([offset_s] * 30)


def test_events_radius_multipliers_scale_rates_and_angles(tmp_path: Path) -> None:
    robot = load_robot("husky_a200")
    geometry = dataclasses.replace(robot.geometry, left_wheel_radius_multiplier=1.02, right_wheel_radius_multiplier=0.98)
    path = bag(tmp_path / "drive.mcap", {}, 1, "husky_a200", drive("20s"))
    before, after = (list(open_log(path, r).events()) for r in (robot, dataclasses.replace(robot, geometry=geometry)))
    pairs = [(a, b) for a, b in zip(before, after, strict=True) if isinstance(a, WheelSample) and isinstance(b, WheelSample)]
    rates, scaled = (np.array([s.velocity for s in samples]) for samples in zip(*pairs, strict=True))
    np.testing.assert_allclose(scaled, rates * [1.02, 0.98])
    assert np.abs(rates).max() > 1.0
    np.testing.assert_allclose(pairs[-1][1].position, pairs[-1][0].position * [1.02, 0.98])
