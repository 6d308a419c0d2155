"""Sensors that contradict each other: which is left out, what is reported, and how the covariance takes it."""

from __future__ import annotations

import dataclasses
import functools
import math
import pickle
import re

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.events import ImuSample, Scan, Step, Turn
from localization.lidar import LidarConfig
from localization.ros.state_serialization import deserialize, serialize
from localization.sensor_checks import Fault, SensorChecks
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.base import Motion
from tests.helpers.rooms import ANGLES, ranges

S = 1_000_000_000
STEP_S = 0.1
SPEED = 0.5


def turn_rate(t: float) -> float:
    return 0.3 * math.sin(0.9 * t)


class Robot:
    """A drive in a room, as steps; ``gyro`` and ``wheels`` change what these measure of the turn rate, ``scan`` the points."""

    def __init__(self, gyro=lambda w: w, wheels=lambda v, w: (v, w), scan=lambda points: points, has_scans: bool = True) -> None:
        self.gyro, self.wheels, self.scan, self.has_scans = gyro, wheels, scan, has_scans
        self.checks = SensorChecks({}, LidarConfig())
        self.applied: list[Step] = []
        self.estimates: list[Estimate] = []

    def drive(self, seconds: float = 12.0) -> SensorChecks:
        rng, pose = np.random.default_rng(0), np.zeros(3)
        for k in range(round(seconds / STEP_S)):
            t = k * STEP_S
            w = turn_rate(t) + 1e-3 * rng.normal()
            pose = se2.compose(pose, se2.exp(np.array([SPEED, 0.0, w]) * STEP_S))
            v_wheels, w_wheels = self.wheels(SPEED, w)
            delta = se2.exp(np.array([v_wheels, 0.0, w_wheels]) * STEP_S)
            turn = None if self.gyro is None else Turn(self.gyro(w) * STEP_S, 1e-8, STEP_S)
            scan = self._scan(tuple(pose), round((t + STEP_S) * S), rng) if self.has_scans else None
            is_standing = not np.any(delta)
            step = Step(
                round(t * S),
                round((t + STEP_S) * S),
                Motion(delta, 1e-6 * np.eye(3)),
                np.zeros(3),
                np.array([v_wheels, 0.0, w_wheels]),
                is_standing,
                True,
                turn,
                scan,
            )
            self.applied.append(self.checks.apply(step))
            self.estimates.append(self.checks.widen(Estimate(step.end_ns, pose, 1e-6 * np.eye(3), np.zeros(3), None)))
        return self.checks

    def _scan(self, pose: tuple[float, float, float], stamp_ns: int, rng: np.random.Generator) -> Scan:
        r = ranges(pose) + 0.01 * rng.normal(size=len(ANGLES))
        points = np.column_stack([r * np.cos(ANGLES), r * np.sin(ANGLES), np.zeros(len(r))])
        return Scan(stamp_ns, self.scan(points))


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    a = math.radians(degrees)
    return points @ np.array([[math.cos(a), math.sin(a), 0.0], [-math.sin(a), math.cos(a), 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("has_scans", [True, False])
def test_sensors_that_agree_are_all_used_and_not_reported(has_scans: bool) -> None:
    """Wheels that slip by half, a gyro with a bias."""
    robot = Robot(gyro=lambda w: w + 0.02, wheels=lambda v, w: (0.9 * v, 1.5 * w), has_scans=has_scans)
    checks = robot.drive()
    assert checks.warnings() == []
    assert all(step.turn is not None and (step.scan is not None) == has_scans for step in robot.applied)
    assert all(np.array_equal(e.covariance, 1e-6 * np.eye(3)) for e in robot.estimates)


@pytest.mark.parametrize(
    ("gyro", "fault"),
    [
        (lambda w: -w, Fault.GYRO_OPPOSITE),
        (lambda w: math.degrees(w), Fault.GYRO_UNIT),
        (lambda w: math.radians(w), Fault.GYRO_UNIT),
        (lambda w: 0.0, Fault.GYRO_STUCK),
        (lambda w: 0.31, Fault.GYRO_STUCK),
    ],
    ids=["flipped", "deg/s", "radians twice", "stuck at zero", "stuck at a turn"],
)
@pytest.mark.parametrize("has_scans", [True, False])
def test_gyro_that_contradicts_wheels_is_left_out(gyro, fault: str, has_scans: bool) -> None:
    robot = Robot(gyro=gyro, has_scans=has_scans)
    checks = robot.drive()
    assert list(checks.found) == [fault]
    assert robot.applied[-1].turn is None
    assert robot.applied[-1].has_wheels
    (warning,) = checks.warnings()
    assert warning.startswith("at t = ")
    assert "gyro" in warning


@pytest.mark.parametrize(("degrees", "correction"), [(20.0, -20.0), (-30.0, 30.0), (170.0, -170.0)])
def test_lidar_whose_mount_is_turned_is_left_out(degrees: float, correction: float) -> None:
    robot = Robot(scan=lambda points: turned(points, degrees))
    checks = robot.drive()
    assert list(checks.found) == [Fault.LIDAR_DIRECTION]
    found = re.search(r"yaw of its frame by ([-+0-9]+) deg", checks.warnings()[0])
    assert found is not None
    assert float(found[1]) == pytest.approx(correction, abs=2.0)
    assert robot.applied[-1].scan is None
    assert robot.applied[-1].turn is not None


@pytest.mark.parametrize("gyro", [lambda w: w, None], ids=["gyro", "no gyro"])
def test_lidar_that_is_upside_down_is_left_out(gyro) -> None:
    robot = Robot(gyro=gyro, scan=lambda points: points * (1.0, -1.0, 1.0))
    checks = robot.drive()
    assert Fault.LIDAR_OPPOSITE in checks.found
    assert "upside down" in " ".join(checks.warnings())
    assert robot.applied[-1].scan is None


def test_wheels_that_are_swapped_are_left_out_where_gyro_and_lidar_agree() -> None:
    robot = Robot(wheels=lambda v, w: (v, -w))
    checks = robot.drive()
    assert list(checks.found) == [Fault.WHEELS_OPPOSITE]
    step = robot.applied[-1]
    assert step.turn is not None
    assert step.scan is not None
    assert not step.has_wheels
    assert step.predicted.cov[2, 2] > 1e-3


def test_wheels_that_read_zero_while_the_lidar_moves_are_unknown() -> None:
    robot = Robot(wheels=lambda v, w: (0.0, 0.0))
    checks = robot.drive(8.0)
    assert Fault.WHEELS_STANDING in checks.found
    last = robot.applied[-1]
    assert not last.is_standing
    total = sum(step.predicted.cov[0, 0] for step in robot.applied)
    assert math.sqrt(total) == pytest.approx(0.5 * 8.0, rel=0.05)  # 0.5 m/s for as long as they read zero


@pytest.mark.parametrize(("shake_m_s2", "is_found"), [(0.7, True), (0.05, False)])
def test_wheels_that_read_zero_while_the_imu_shakes_are_unknown(shake_m_s2: float, is_found: bool) -> None:
    robot = Robot(wheels=lambda v, w: (0.0, 0.0), gyro=lambda w: 0.0, has_scans=False)
    rng = np.random.default_rng(1)
    for k in range(300):
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), np.array([0.0, 0.0, 9.8]) + shake_m_s2 * rng.normal(size=3)))
    checks = robot.drive(6.0)
    assert (Fault.WHEELS_STANDING in checks.found) == is_found


def test_robot_that_brakes_is_not_taken_for_one_that_shakes() -> None:
    """The seconds before were driven."""
    robot = Robot(has_scans=False)
    rng = np.random.default_rng(1)
    for k in range(300):
        robot.checks.insert_imu(ImuSample(k * S // 50, np.zeros(3), 0.7 * rng.normal(size=3)))
    robot.drive(5.0)
    robot.wheels, robot.gyro = lambda v, w: (0.0, 0.0), lambda w: 0.0
    robot.drive(1.5)
    assert robot.checks.found == {}


def test_fault_widens_the_covariance_by_what_it_has_done() -> None:
    """The estimate followed a LiDAR that is turned by 30 deg; wheels and gyro lead elsewhere."""
    robot = Robot(scan=lambda points: turned(points, 30.0))
    world_T_drive = np.array([0.0, 0.0, math.radians(30.0)])
    own = robot.checks.widen
    robot.checks.widen = lambda e: own(  # type: ignore[method-assign]
        Estimate(e.stamp_ns, se2.compose(se2.compose(world_T_drive, e.pose), se2.inverse(world_T_drive)), e.covariance, e.twist, None)
    )
    robot.drive()
    found = next(iter(robot.checks.found.values()))
    assert found.fault == Fault.LIDAR_DIRECTION
    sigma = np.sqrt([np.linalg.eigvalsh(e.covariance[:2, :2])[-1] for e in robot.estimates])  # type: ignore[index]
    assert sigma[0] == pytest.approx(1e-3)
    assert sigma[-1] > 0.3 * 2.0 * math.sin(math.radians(15.0)) * SPEED * 3.0  # declared after 3.5 s or later
    end = robot.estimates[-1]
    smooth = Trajectory(
        np.array([e.stamp_ns for e in robot.estimates]),
        np.array([e.pose for e in robot.estimates]),
        np.tile(1e-6 * np.eye(3), (len(robot.estimates), 1, 1)),
    )
    widened = robot.checks.widen_trajectory(smooth)
    assert widened.covariances is not None
    np.testing.assert_allclose(widened.covariances[-1], end.covariance, atol=1e-9)
    np.testing.assert_allclose(widened.covariances[0], 1e-6 * np.eye(3))


def test_beams_on_the_robot_are_left_out_and_reported() -> None:
    def cover(points: np.ndarray) -> np.ndarray:
        points = points.copy()
        points[:100] = 0.3 * np.column_stack([np.cos(ANGLES[:100]), np.sin(ANGLES[:100]), np.zeros(100)])
        return points

    robot = Robot(scan=cover)
    checks = robot.drive()
    assert list(checks.found) == [Fault.LIDAR_OWN_BODY]
    assert "28 % of the LiDAR's points are the robot itself" in checks.warnings()[0]
    last = robot.applied[-1].scan
    assert last is not None
    assert np.hypot(last.points[:, 0], last.points[:, 1]).min() > 0.5


def test_lidar_one_contradicting_window_among_many_leaves_it_in() -> None:
    """A robot that slides sideways for a few seconds after a minute of straight driving."""
    checks = SensorChecks({}, LidarConfig())
    here, nothing = {Fault.LIDAR_DIRECTION}, set[str]()
    for i in range(400):
        checks._compare(0.25 * i, *((here, nothing) if 300 <= i < 330 else (nothing, here)))
        assert not checks._is_contradicted(Fault.LIDAR_DIRECTION)
    for i in range(400, 2000):
        checks._compare(0.25 * i, here, nothing)
    assert checks._is_contradicted(Fault.LIDAR_DIRECTION)


def test_wheels_far_from_the_estimate_are_reported_and_widen_it() -> None:
    """Wheels that count three times too far, by a metre a second: the covariance has the whole difference."""
    robot = Robot(wheels=lambda v, w: (3.0 * v, w))
    checks = robot.drive()
    assert list(checks.found) == [Fault.DISAGREEMENT]
    by_wheels = functools.reduce(se2.compose, (step.predicted.delta for step in robot.applied[1:]))
    by_scans = se2.between(robot.estimates[0].pose, robot.estimates[-1].pose)
    difference_m = np.linalg.norm(se2.log(se2.between(by_scans, by_wheels))[:2])
    assert difference_m > 10.0
    found = re.search(r"for (\d+) s .* ([0-9.]+) m and", checks.warnings()[0])
    assert found is not None
    assert int(found[1]) == 12
    assert float(found[2]) == pytest.approx(difference_m, abs=0.01)
    cov = robot.estimates[-1].covariance
    assert cov is not None
    assert math.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]) == pytest.approx(difference_m, rel=0.01)


def test_disagreements_that_end_stay_in_the_covariance() -> None:
    """Wheels that count three times too far from 4 to 8 s and from 20 to 22.5 s: 4 and 2.5 m, and no more after it."""
    robot = Robot()
    factors = ((4.0, 8.0), (20.0, 22.5))
    robot.wheels = lambda v, w: ((3.0 if any(a <= 0.1 * len(robot.applied) < b for a, b in factors) else 1.0) * v, w)
    checks = robot.drive(30.0)
    assert list(checks.found) == [Fault.DISAGREEMENT]
    assert checks.found[Fault.DISAGREEMENT].at_s == pytest.approx(4.0, abs=0.2)
    assert "the largest of 2 such times" in checks.warnings()[0]
    cov = robot.estimates[-1].covariance
    assert cov is not None
    assert math.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]) == pytest.approx(math.hypot(4.0, 2.5), rel=0.05)


def test_gyro_rate_that_no_slip_explains_is_left_out_at_once() -> None:
    """Rates of 3 rad/s for half a second while the wheels drive straight on."""
    robot = Robot(wheels=lambda v, w: (v, 0.0))
    robot.gyro = lambda w: 3.0 if 40 <= len(robot.applied) < 45 else 0.0
    checks = robot.drive(9.0)
    assert Fault.GYRO_RATE in checks.found
    assert checks.found[Fault.GYRO_RATE].at_s == pytest.approx(4.1, abs=0.11)
    assert [k for k, step in enumerate(robot.applied) if step.turn is None] == list(range(40, 74))  # and for 3 s more


def test_gyro_in_degrees_from_half_way_on_is_left_out_within_five_seconds() -> None:
    gyro_of = iter([*[1.0] * 120, *[math.degrees(1.0)] * 120])
    robot = Robot(gyro=lambda w: next(gyro_of) * w)
    checks = robot.drive(24.0)
    assert Fault.GYRO_UNIT in checks.found
    assert all(step.turn is None for step in robot.applied[-70:])


def test_gyro_is_used_while_the_wheels_read_zero_and_the_robot_spins() -> None:
    """Encoders that are dead at 2.5 rad/s: the gyro is right."""
    robot = Robot(gyro=lambda w: 2.5 + w, wheels=lambda v, w: (0.0, 0.0), has_scans=False)
    checks = robot.drive(5.0)
    assert Fault.GYRO_RATE not in checks.found
    assert all(step.turn is not None for step in robot.applied)


def test_gyro_in_degrees_from_half_way_on_is_found_beside_wheels_that_turn_twice_as_far() -> None:
    gyro_of = iter([*[1.0] * 120, *[math.degrees(1.0)] * 120])
    robot = Robot(gyro=lambda w: next(gyro_of) * w, wheels=lambda v, w: (v, 2.0 * w))
    checks = robot.drive(24.0)
    assert Fault.GYRO_UNIT in checks.found
    assert all(step.turn is None for step in robot.applied[-70:])


def test_memory_stays_flat_over_many_disagreements() -> None:
    """Wheels that count three times too far for 3 of every 9 s."""
    sizes = []
    for times in (2, 3):
        robot = Robot()
        robot.wheels = lambda v, w, robot=robot: ((3.0 if 40 <= len(robot.applied) % 90 < 70 else 1.0) * v, w)
        checks = robot.drive(9.0 * times)
        assert f"the largest of {times} such times" in checks.warnings()[0]
        sizes.append(len(pickle.dumps(checks._episodes)))
    assert sizes[0] == sizes[1]


def test_checks_are_restored_from_a_checkpoint_during_and_after_a_disagreement() -> None:
    for seconds in (8.0, 20.0):
        robot = Robot()
        robot.wheels = lambda v, w, robot=robot: ((3.0 if len(robot.applied) < 90 else 1.0) * v, w)
        checks = robot.drive(seconds)
        restored = deserialize(*serialize(checks))
        assert "the motion by the scans and that by the wheels differ" in checks.warnings()[0]
        assert restored.warnings() == checks.warnings()
        last = robot.estimates[-1]
        ahead = Estimate(last.stamp_ns + S, se2.compose(last.pose, np.array([0.1, 0.0, 0.0])), last.covariance, np.zeros(3), None)
        assert np.array_equal(restored.widen(ahead).covariance, checks.widen(ahead).covariance)


def test_estimate_without_covariance_is_not_compared_with_the_wheels() -> None:
    """LiDAR alone, which may be lost."""
    robot = Robot(wheels=lambda v, w: (3.0 * v, w))
    robot.checks.widen = functools.partial(_without_covariance, robot.checks.widen)  # type: ignore[method-assign]
    assert robot.drive().found == {}


def _without_covariance(widen, estimate: Estimate) -> Estimate:
    return widen(dataclasses.replace(estimate, covariance=None))
