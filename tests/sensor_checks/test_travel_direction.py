"""A LiDAR whose yaw is wrong."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from localization.sensor_checks.travel_direction import LIDAR_DIRECTION, travel_direction
from tests.helpers.checked_drive import CheckedDrive, turned
from tests.helpers.event_faults import turn_scans, without_gyro
from tests.helpers.fault_drives import in_room, run


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


_TURNS = [[0.0] * 7, [0.07] * 24, [0.07] * 12 + [-0.05] * 12]
"""Ahead; an arc of 1 m, in which slides look like another direction; and an S [rad]."""


def _bins(
    rng: np.random.Generator, degrees: float, noise_m: float, turns: list[float], slide_m_per_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Motion (n, 3) by wheels that travel 7 cm ahead and turn by ``turns`` [rad] in each bin, and by scans with noise, in the direction
    ``degrees``, of a robot that slides in turns."""
    turn, noise = np.array(turns), noise_m * rng.normal(size=(2, len(turns)))
    ways = (0.07 + 1j * slide_m_per_rad * turn) * np.exp(1j * math.radians(degrees)) + noise[0] + 1j * noise[1]
    return np.column_stack([np.full(len(turn), 0.07), np.zeros(len(turn)), turn]), np.column_stack([ways.real, ways.imag, turn])


@pytest.mark.parametrize("noise_m", [0.005, 0.02, 0.06])
def test_direction_accuses_no_noise_of_its_own(noise_m: float) -> None:
    """Short bins with scans as noisy as their way: hardly any window is beyond a limit that the true direction is on."""
    rng, limit = np.random.default_rng(0), math.radians(12.0)
    found = [
        travel_direction(*_bins(rng, math.degrees(limit), noise_m, turns, 0.5 * rng.normal())) for _ in range(1000) for turns in _TURNS
    ]
    known = [direction for direction in found if direction is not None]
    assert sum(bool(direction.exceeds(limit)) for direction in known) <= 0.002 * len(found)


@pytest.mark.parametrize("turns", [_TURNS[0], _TURNS[2]], ids=["straight", "curves"])
def test_direction_of_a_turned_lidar_is_certain(turns: list[float]) -> None:
    direction = travel_direction(*_bins(np.random.default_rng(1), 26.0, 0.005, turns, 0.5))
    assert direction is not None
    assert direction.exceeds(math.radians(12.0))
    assert math.degrees(direction.angle) == pytest.approx(26.0, abs=math.degrees(direction.bound))


@pytest.mark.extended
def test_lidar_whose_mount_is_turned_is_found_on_a_drive_of_curves() -> None:
    """From where on it is, the covariance has what it was off by."""
    outcome = run(in_room(1), without_gyro(turn_scans(25.0)))
    assert any("the robot travels 2" in warning and "to the left" in warning for warning in outcome.warnings)
    error, sigma = outcome.last
    assert error < 3.0 * sigma
