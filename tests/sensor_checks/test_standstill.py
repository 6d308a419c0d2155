"""Wheels that read zero on a robot that moves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.events import ImuSample
from localization.sensor_checks.moving_report import MOVING_OBJECTS
from localization.sensor_checks.standstill import WHEELS_STANDING
from localization.simulation import world
from tests.helpers import rooms
from tests.helpers.checked_drive import CheckedDrive, S


def test_wheels_that_read_zero_while_the_lidar_moves_are_unknown() -> None:
    robot = CheckedDrive(wheels=lambda v, w: (0.0, 0.0))
    checks = robot.drive(8.0)
    assert WHEELS_STANDING in checks.found
    last = robot.applied[-1]
    assert not last.is_standing
    total = sum(step.predicted.cov[0, 0] for step in robot.applied)
    assert math.sqrt(total) == pytest.approx(0.5 * 8.0, rel=0.05)  # 0.5 m/s for as long as they read zero


@pytest.mark.parametrize(("rate_noise", "shake_m_s2"), [(0.003, None), (0.003, 0.05), (None, 0.05)], ids=["gyro", "gyro and IMU", "IMU"])
def test_lidar_alone_is_outvoted_by_wheels_and_another_sensor(rate_noise: float | None, shake_m_s2: float | None) -> None:
    """People walk around a standing robot: its scans look like motion. Wheels, gyro and IMU together show that the scene moves."""
    rng = np.random.default_rng(1)
    gyro = None if rate_noise is None else lambda w: 0.01 + rate_noise * rng.normal()
    robot = CheckedDrive(wheels=lambda v, w: (0.0, 0.0), gyro=gyro, nis=3.0)
    for k in range(0 if shake_m_s2 is None else 400):
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), np.array([0.0, 0.0, 9.8]) + shake_m_s2 * rng.normal(size=3)))
    are_all_at_rest = rate_noise is not None and shake_m_s2 is not None
    assert robot.drive(8.0).found.keys() == ({MOVING_OBJECTS} if are_all_at_rest else set())
    assert all(step.is_standing for step in robot.applied)


def test_lidar_is_confirmed_by_a_shaking_imu_beside_a_still_gyro() -> None:
    """The robot drives straight on."""
    rng = np.random.default_rng(1)
    robot = CheckedDrive(wheels=lambda v, w: (0.0, 0.0), gyro=lambda w: 0.003 * rng.normal())
    for k in range(400):
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), 0.7 * rng.normal(size=3)))
    checks = robot.drive(8.0)
    assert "while the LiDAR moved" in checks.warnings()[0]
    assert "other explanation" not in checks.warnings()[0]


def test_lidar_stays_confirmed_until_the_wheels_turn() -> None:
    """The robot turns, then drives straight on; its encoders are dead."""
    rng = np.random.default_rng(1)
    robot = CheckedDrive(wheels=lambda v, w: (0.0, 0.0), gyro=lambda w: w + 0.003 * rng.normal())
    robot.drive(5.0)
    robot.gyro = lambda w: 0.003 * rng.normal()
    robot.drive(5.0)
    assert not any(step.has_wheels for step in robot.applied[-40:])


@pytest.mark.parametrize("moved_s", [0.0, 1.0])
def test_wheels_that_never_turned_show_no_standstill(moved_s: float) -> None:
    """The robot turns, then the gyro is still. Those that have turned before do."""
    robot = CheckedDrive(has_scans=False, gyro=lambda w: w)
    robot.drive(moved_s)
    robot.wheels, robot.gyro = lambda v, w: (0.0, 0.0), lambda w: 0.3
    robot.drive(2.0)
    robot.gyro = lambda w: 0.0
    robot.drive(2.0)
    assert WHEELS_STANDING in robot.checks.found
    assert robot.applied[-1].has_wheels == bool(moved_s)


@pytest.mark.parametrize("gyro", [None, lambda w: 0.0], ids=["no gyro", "a gyro that repeats zero"])
def test_lidar_without_another_sensor_has_both_explanations(gyro) -> None:
    checks = CheckedDrive(wheels=lambda v, w: (0.0, 0.0), gyro=gyro).drive(8.0)
    (warning,) = checks.warnings()
    assert "the wheels read zero while the LiDAR moved." in warning
    assert "objects that move in the scans around a standing robot" in warning


@pytest.mark.parametrize(("at_rest_m_s2", "shake_m_s2", "is_found"), [(0.05, 0.7, True), (0.05, 0.05, False), (0.7, 0.7, False)])
def test_wheels_that_read_zero_while_the_imu_shakes_are_unknown(at_rest_m_s2: float, shake_m_s2: float, is_found: bool) -> None:
    """More than in its calmest second."""
    robot = CheckedDrive(wheels=lambda v, w: (0.0, 0.0), gyro=lambda w: 0.0, has_scans=False)
    rng = np.random.default_rng(1)
    for k in range(400):
        shake = at_rest_m_s2 if k < 100 else shake_m_s2
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), np.array([0.0, 0.0, 9.8]) + shake * rng.normal(size=3)))
    checks = robot.drive(6.0)
    assert (WHEELS_STANDING in checks.found) == is_found


def test_knocks_at_rest_are_not_taken_for_shaking() -> None:
    """One in each second, of 40 ms: the robot is loaded."""
    robot = CheckedDrive(wheels=lambda v, w: (0.0, 0.0), gyro=lambda w: 0.0, has_scans=False)
    rng = np.random.default_rng(1)
    for k in range(300):
        knock = 8.0 if k % 50 in (17, 18) else 0.05
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), np.array([0.0, 0.0, 9.8]) + knock * rng.normal(size=3)))
    assert robot.drive(6.0).found == {}
    assert robot.applied[-1].is_standing


@pytest.mark.parametrize(("rate", "is_found"), [(0.3, True), (0.06, False)])
def test_wheels_that_read_zero_while_the_gyro_turns_are_unknown(rate: float, is_found: bool) -> None:
    """A robot that is turned by hand, or a gyro with a large bias."""
    robot = CheckedDrive(wheels=lambda v, w: (0.0, 0.0), gyro=lambda w: rate, has_scans=False)
    checks = robot.drive(3.0)
    assert (WHEELS_STANDING in checks.found) == is_found
    total = sum(step.predicted.cov[0, 0] for step in robot.applied)
    assert (math.sqrt(total) == pytest.approx(0.5 * 3.0, rel=0.05)) == is_found
    if is_found:  # the gyro measures the turn of each step
        np.testing.assert_allclose([math.sqrt(step.predicted.cov[2, 2]) for step in robot.applied[1:]], 0.5 * 0.1, rtol=1e-3)
        np.testing.assert_allclose([step.twist for step in robot.applied[1:]], [[0.0, 0.0, rate]] * 29, atol=1e-9)


def test_gyro_that_turns_on_for_a_moment_is_not_reported() -> None:
    """The wheels' stamps are early: they read zero while the robot turns on."""
    robot = CheckedDrive(has_scans=False)
    robot.drive(3.0)
    robot.wheels, robot.gyro = lambda v, w: (0.0, 0.0), lambda w: 0.5
    robot.drive(0.3)
    assert not robot.applied[-1].has_wheels  # unknown meanwhile
    robot.gyro = lambda w: 0.0
    robot.drive(2.0)
    assert robot.checks.found == {}
    assert robot.applied[-1].is_standing


def test_robot_that_brakes_is_not_taken_for_one_that_shakes() -> None:
    """The seconds before were driven."""
    robot = CheckedDrive(has_scans=False)
    rng = np.random.default_rng(1)
    for k in range(300):
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), 0.7 * rng.normal(size=3)))
    robot.drive(5.0)
    robot.wheels, robot.gyro = lambda v, w: (0.0, 0.0), lambda w: 0.0
    robot.drive(1.5)
    assert robot.checks.found == {}


def test_two_imus_with_other_axes_are_not_taken_for_shaking() -> None:
    """On one topic: gravity is along z of the one and along x of the other."""
    robot = CheckedDrive(wheels=lambda v, w: (0.0, 0.0), gyro=lambda w: 0.0, has_scans=False)
    for k in range(300):
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), np.array([0.0, 0.0, 9.8]), "a"))
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), np.array([9.8, 0.0, 0.0]), "b"))
    assert robot.drive(6.0).found == {}


def test_unknown_wheels_of_a_fast_robot_are_as_fast() -> None:
    """1.5 m/s until the encoders fail: the unknown velocity may be as large."""
    robot = CheckedDrive(wheels=lambda v, w: (3.0 * v, w), gyro=lambda w: w)
    robot.drive(2.0)
    robot.wheels, robot.gyro = lambda v, w: (0.0, 0.0), lambda w: 0.3
    robot.drive(2.0)
    total = sum(step.predicted.cov[0, 0] for step in robot.applied[20:])
    assert math.sqrt(total) == pytest.approx(1.5 * 2.0, rel=0.05)


@pytest.mark.parametrize("parked_s", [0.0, pytest.param(30.0, marks=pytest.mark.extended)])
def test_dead_encoders_lose_no_scan(parked_s: float) -> None:
    """Wheels read zero from 5 s on, with or without a time in which the robot is parked: matched scans measure the pose all the while."""
    walls = np.vstack([world.box(-4, -3, 6, 5), world.box(1.0, 1.5, 2.0, 2.2)])
    twists = rooms.path((5, 0.4, 0.2), *[(parked_s, 0.0, 0.0)] * bool(parked_s), (25, 0.4, 0.2))
    drive = rooms.drive_through(
        walls, twists, 1, (0.0, -1.5, 0.0), rooms.Beams(360, 6.28, 10.0, fill=0.0), wheels=lambda t, w: np.where(t[:, None] < 5.0, w, 0.0)
    )
    run = rooms.results(drive, "ekf")["ekf"]
    assert run.counts["matched"] == run.counts["scans"] - 1  # the first begins the submap
    assert "the wheels read zero while the LiDAR moved" in run.warnings[0]
    assert rooms.ate(drive, rooms.at_scans(drive, run)[0]) < 0.05
