"""A LiDAR whose yaw is wrong."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from localization.sensor_checks.travel_direction import LIDAR_DIRECTION, travel_direction
from tests.helpers.checked_drive import CheckedDrive, turned


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


def _bins(rng: np.random.Generator, degrees: float, noise_m: float, count: int = 7, way_m: float = 0.07) -> tuple[np.ndarray, np.ndarray]:
    """Motion in bins by wheels that travel ``way_m`` ahead, and by scans, in the direction ``degrees`` with noise (count, 3)."""
    angle = math.radians(degrees)
    mean = way_m * np.array([math.cos(angle), math.sin(angle)])
    lidar = np.array([np.append(mean + noise_m * rng.normal(size=2), 0.0) for _ in range(count)])
    return np.tile([way_m, 0.0, 0.0], (count, 1)), lidar


@pytest.mark.parametrize("noise_m", [0.005, 0.02, 0.06])
def test_direction_accuses_no_noise_of_its_own(noise_m: float) -> None:
    """Seven short bins with scans as noisy as their way: hardly any window is beyond a limit that the true direction is on."""
    rng, limit = np.random.default_rng(0), math.radians(12.0)
    found = [travel_direction(*_bins(rng, math.degrees(limit), noise_m)) for _ in range(2000)]
    known = [direction for direction in found if direction is not None]
    assert sum(bool(direction.exceeds(limit)) for direction in known) <= 0.002 * len(found)


def test_direction_of_a_turned_lidar_is_certain() -> None:
    direction = travel_direction(*_bins(np.random.default_rng(1), 26.0, 0.005))
    assert direction is not None
    assert direction.exceeds(math.radians(12.0))
    assert math.degrees(direction.angle) == pytest.approx(26.0, abs=math.degrees(direction.bound))
