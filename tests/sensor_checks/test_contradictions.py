"""Turn rates that contradict each other: which sensor is left out."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from localization.sensor_checks.contradictions import GYRO_STUCK, LIDAR_DIRECTION
from localization.sensor_checks.faults import SensorFault
from localization.sensor_checks.gyro_rate import GYRO_RATE
from localization.sensor_checks.turn_votes import GYRO_OPPOSITE, GYRO_UNIT, LIDAR_OPPOSITE, WHEELS_OPPOSITE
from tests.helpers import corridors
from tests.helpers.checked_drive import CheckedDrive, turned
from tests.helpers.event_faults import bump_lidar, named_faults, turn_scans, without_gyro
from tests.helpers.fault_drives import in_room, run


@pytest.mark.parametrize(
    ("gyro", "fault"),
    [
        (lambda w: -w, GYRO_OPPOSITE),
        (lambda w: math.degrees(w), GYRO_UNIT),
        (lambda w: 0.0, GYRO_STUCK),
        (lambda w: 0.31, GYRO_STUCK),
    ],
    ids=["flipped", "deg/s", "stuck at zero", "stuck at a turn"],
)
@pytest.mark.parametrize("has_scans", [True, False])
def test_gyro_that_contradicts_wheels_is_left_out(gyro, fault: SensorFault, has_scans: bool) -> None:
    robot = CheckedDrive(gyro=gyro, has_scans=has_scans)
    checks = robot.drive()
    assert list(checks.found) == [fault]
    assert robot.applied[-1].turn is None
    assert robot.applied[-1].has_wheels
    (warning,) = checks.warnings()
    assert warning.startswith("at t = ")
    assert "gyro" in warning


def test_gyro_that_turns_a_tenth_the_other_way_is_no_reversed_one() -> None:
    """It is wrong, as something else: reversed it would turn as much. Wheels whose turns jitter on a straight way look like that."""
    assert GYRO_OPPOSITE not in CheckedDrive(gyro=lambda w: -0.1 * w).drive().found


@pytest.mark.parametrize("gyro", [lambda w: w, None], ids=["gyro", "no gyro"])
def test_lidar_that_is_upside_down_is_left_out(gyro) -> None:
    robot = CheckedDrive(gyro=gyro, scan=lambda points: points * (1.0, -1.0, 1.0))
    checks = robot.drive()
    assert LIDAR_OPPOSITE in checks.found
    assert "upside down" in " ".join(checks.warnings())
    assert robot.applied[-1].scan is None
    assert robot.applied[-1].is_scan_excluded


def test_wheels_that_are_swapped_are_left_out_where_gyro_and_lidar_agree() -> None:
    robot = CheckedDrive(wheels=lambda v, w: (v, -w))
    checks = robot.drive()
    assert list(checks.found) == [WHEELS_OPPOSITE]
    step = robot.applied[-1]
    assert step.turn is not None
    assert step.scan is not None
    assert not step.has_wheels
    assert step.predicted.cov[2, 2] > 1e-3
    np.testing.assert_allclose(step.twist, [0.0, 0.0, step.turn.angle / step.turn.duration])


@pytest.mark.parametrize(("nis", "sigma_m"), [(None, 0.5 * 10.0), (3.0, math.sqrt(100) * 0.5 * 0.1)])
def test_unknown_motion_of_swapped_wheels_lasts_until_a_scan_is_matched(nis: float | None, sigma_m: float) -> None:
    robot = CheckedDrive(wheels=lambda v, w: (v, -w), nis=nis)
    robot.drive(16.0)
    unknown = [step.predicted.cov[0, 0] for step in robot.applied if not step.has_wheels]
    assert len(unknown) > 100
    assert math.sqrt(sum(unknown[:100])) == pytest.approx(sigma_m, rel=1e-3)


def test_gyro_in_degrees_from_half_way_on_is_left_out_within_five_seconds() -> None:
    gyro_of = iter([*[1.0] * 120, *[math.degrees(1.0)] * 120])
    robot = CheckedDrive(gyro=lambda w: next(gyro_of) * w)
    checks = robot.drive(24.0)
    assert GYRO_UNIT in checks.found
    assert all(step.turn is None for step in robot.applied[-70:])


def test_gyro_in_degrees_from_half_way_on_is_found_beside_wheels_that_turn_twice_as_far() -> None:
    gyro_of = iter([*[1.0] * 120, *[math.degrees(1.0)] * 120])
    robot = CheckedDrive(gyro=lambda w: next(gyro_of) * w, wheels=lambda v, w: (v, 2.0 * w))
    checks = robot.drive(24.0)
    assert GYRO_UNIT in checks.found
    assert all(step.turn is None for step in robot.applied[-70:])


def test_gyro_rate_that_no_slip_explains_is_left_out_at_once() -> None:
    """Rates of 3 rad/s for half a second while the wheels drive straight on."""
    robot = CheckedDrive(wheels=lambda v, w: (v, 0.0))
    robot.gyro = lambda w: 3.0 if 40 <= len(robot.applied) < 45 else 0.0
    checks = robot.drive(9.0)
    assert GYRO_RATE in checks.found
    assert checks.found[GYRO_RATE].at_s == pytest.approx(4.1, abs=0.11)
    assert [k for k, step in enumerate(robot.applied) if step.turn is None] == list(range(40, 74))  # and for 3 s more


def test_gyro_is_used_while_the_wheels_read_zero_and_the_robot_spins() -> None:
    """Encoders that are dead at 2.5 rad/s: the gyro is right."""
    robot = CheckedDrive(gyro=lambda w: 2.5 + w, wheels=lambda v, w: (0.0, 0.0), has_scans=False)
    checks = robot.drive(5.0)
    assert GYRO_RATE not in checks.found
    assert all(step.turn is not None for step in robot.applied)


@pytest.mark.parametrize(("degrees", "correction"), [(20.0, -20.0), (-30.0, 30.0), (170.0, -170.0)])
def test_lidar_whose_mount_is_turned_is_left_out(degrees: float, correction: float) -> None:
    robot = CheckedDrive(scan=lambda points: turned(points, degrees))
    checks = robot.drive()
    assert list(checks.found) == [LIDAR_DIRECTION]
    found = re.search(r"yaw of its frame by ([-+0-9]+) deg", checks.warnings()[0])
    assert found is not None
    assert float(found[1]) == pytest.approx(correction, abs=2.0)
    assert robot.applied[-1].scan is None
    assert robot.applied[-1].is_scan_excluded
    assert robot.applied[-1].turn is not None


@pytest.mark.extended
def test_lidar_whose_mount_is_turned_is_found_on_a_drive_of_curves() -> None:
    """From where on it is, the covariance has what it was off by."""
    outcome = run(in_room(1), without_gyro(turn_scans(25.0)))
    assert any("the robot travels 2" in warning and "to the left" in warning for warning in outcome.warnings)
    error, sigma = outcome.last
    assert error < 3.0 * sigma


@pytest.mark.extended
@pytest.mark.parametrize("has_gyro", [True, False])
def test_lidar_bumped_at_rest_is_in_the_covariance_of_the_place_it_jumps_to(has_gyro: bool) -> None:
    """By 90 deg in a room where scans fit .57 and 1.95 m away, too."""
    fault = bump_lidar(90.0)
    outcome = run(in_room(0 if has_gyro else 1, 1), fault if has_gyro else without_gyro(fault))
    assert outcome.worst[0] > 0.5
    assert not outcome.is_wrong, outcome.least_consistent


@pytest.mark.extended
def test_gyro_that_repeats_zero_is_no_scene_that_moves() -> None:
    outcome = run(in_room(), named_faults()["gyro stuck at 0"])
    assert outcome.worst[0] < 0.05


@pytest.mark.extended
def test_turned_lidar_in_a_bare_corridor_is_found_before_it_leads_the_estimate_away() -> None:
    """Scans show no way along the walls, and that across them shows the direction."""
    outcome = run(corridors.in_corridor("healthy", 0), turn_scans(20.0))
    assert outcome.is_wrong_at.sum() == 0
    assert outcome.worst[0] < 1.0
    assert "by the LiDAR the robot travels 20 deg to the left" in outcome.warnings[0]
