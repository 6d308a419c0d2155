"""Which scans enter the submap."""

from __future__ import annotations

import numpy as np
import pytest

from localization.events import Scan, Step
from localization.lidar import LidarConfig, ScanMatchingSensor
from localization.simulation import world
from motion_models.motion import Motion
from motion_models.robot import Mount
from tests.helpers import rooms

LAB, HALL = world.lab().walls, world.hall().walls
NARROW, WIDE = np.diag([0.03, 0.03, 0.02]) ** 2, np.diag([1.0, 1.0, 0.3]) ** 2
AHEAD = np.array([0.6, 0.0, 0.0])
"""Farther than key scans are apart."""


def step_at(seconds: float, walls: np.ndarray, pose: np.ndarray, delta: tuple[float, float, float] = (0.6, 0.0, 0.0)) -> Step:
    """A scan of ``walls`` from ``pose`` (3,), after the wheels moved by ``delta``."""
    points = rooms.scan_from(walls, pose, np.random.default_rng(round(10 * seconds)))
    stamp_ns = round(seconds * 1e9)
    scan = Scan(stamp_ns, np.column_stack([points, np.zeros(len(points))]))
    motion = Motion(np.array(delta), 1e-6 * np.eye(3))
    return Step(stamp_ns - 100_000_000, stamp_ns, motion, np.zeros(3), np.zeros(3), False, True, None, scan)


@pytest.fixture
def sensor() -> ScanMatchingSensor:
    """With a submap of the lab from its origin."""
    made = ScanMatchingSensor({}, LidarConfig())
    assert made.measure(step_at(0.1, LAB, np.zeros(3)), np.zeros(3), NARROW, np.zeros(3)) is None
    assert made.is_key(np.zeros(3))
    made.insert_key_scan(np.zeros(3), np.zeros((3, 3)))
    return made


def measure(sensor: ScanMatchingSensor, seconds: float, walls: np.ndarray, cov: np.ndarray) -> bool:
    """Whether a scan of ``walls`` from a little ahead is matched by a prior of ``cov`` (3, 3) there."""
    return sensor.measure(step_at(seconds, walls, AHEAD), AHEAD, cov, np.zeros(3)) is not None


@pytest.mark.parametrize("cov", [NARROW, WIDE])
def test_scan_that_is_lost_is_a_key_scan(sensor: ScanMatchingSensor, cov: np.ndarray) -> None:
    assert not measure(sensor, 1.0, HALL, cov)
    assert sensor.is_key(AHEAD)


def test_scan_that_is_found_again_is_a_key_scan(sensor: ScanMatchingSensor) -> None:
    assert not measure(sensor, 1.0, HALL, WIDE)
    assert measure(sensor, 1.1, LAB, WIDE)
    assert sensor.is_key(AHEAD)


def test_submap_begins_anew_where_the_mount_comes_while_a_place_is_searched() -> None:
    mounts: dict[str, Mount] = {}
    sensor = ScanMatchingSensor(mounts, LidarConfig())
    sensor.measure(step_at(0.1, LAB, np.zeros(3)), np.zeros(3), NARROW, np.zeros(3))
    sensor.insert_key_scan(np.zeros(3), np.zeros((3, 3)))
    assert not measure(sensor, 1.0, HALL, WIDE)
    mounts[""] = Mount()
    assert not measure(sensor, 1.1, LAB, WIDE)
    assert sensor.is_key(AHEAD)
    sensor.insert_key_scan(AHEAD, np.zeros((3, 3)))
    assert measure(sensor, 1.2, LAB, NARROW)


def test_scene_that_changes_at_once_is_no_new_place(sensor: ScanMatchingSensor) -> None:
    """The robot is carried to another room while its wheels stand: the scan is lost, and no key scan."""
    step = step_at(1.0, HALL, AHEAD, (0.0, 0.0, 0.0))
    assert sensor.measure(step, AHEAD, NARROW, np.zeros(3)) is None
    assert sensor.moved.cov(step_at(1.0, HALL, AHEAD)) is not None
    assert sensor.moved.cov(step_at(1.1, HALL, AHEAD)) is None
    assert sensor.lost.causes == {"moved": 1}
    assert not sensor.is_key(AHEAD)
