"""Rates of the gyro that no slip explains."""

from __future__ import annotations

import pytest

from localization.sensor_checks.gyro_rate import GYRO_RATE
from tests.helpers.checked_drive import CheckedDrive


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
