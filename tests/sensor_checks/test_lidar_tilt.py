"""The tilt of a LiDAR by the ground in its clouds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.estimators.baselines import DeadReckoning
from localization.events import Scan, Step
from localization.inputs.step_config import StepConfig
from localization.lidar import LidarConfig
from localization.sensor_checks import SensorChecks
from localization.sensor_checks.lidar_tilt import LidarTilt, fit_ground
from localization.simulation import world
from motion_models.motion import Motion
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers import rooms

LAB = world.lab().walls


def tilted(pitch, scans: int = 24) -> LidarTilt:
    """What clouds on a bend tell, whose scan k is pitched by ``pitch`` (k) [rad]."""
    found = LidarTilt({"laser": Mount(z=0.8)})
    for k in range(scans):
        points = rooms.cloud(LAB, np.array([0.05 * k, 0.02 * k, 0.03 * k]), k, pitch(k)) - np.array([0.0, 0.0, 0.8])
        found.add(Scan(k * 500_000_000, points, frame_id="laser", is_planar=False))
    return found


@pytest.mark.extended
def test_lidar_tilt_of_tilted_clouds_is_reported() -> None:
    assert tilted(lambda k: math.radians(0.4)).warnings() == []
    (note,) = tilted(lambda k: math.radians(3.0)).warnings()
    assert "by 3.0 deg (roll +0.0, pitch +3.0)" in note
    assert "mount of 'laser'" in note
    (note,) = tilted(lambda k: math.radians(4.0) * math.sin(0.7 * k)).warnings()
    assert float(note.split("sway by ")[1].split()[0]) == pytest.approx(4.0 / math.sqrt(2.0), abs=0.2)
    assert "mount" not in note
    assert tilted(lambda k: math.radians(3.0), scans=9).warnings() == []  # a glimpse is not enough


def test_lidar_tilt_with_tilted_mount_is_silent() -> None:
    points = rooms.cloud(LAB, np.zeros(3), 0, math.radians(5.0)) - np.array([0.0, 0.0, 0.8])
    found = LidarTilt({"laser": Mount(z=0.8, pitch=math.radians(5.0))})
    for k in range(12):
        found.add(Scan(k * 500_000_000, points, frame_id="laser", is_planar=False))
    assert found.warnings() == []


def test_tilted_clouds_of_steps_are_reported_by_the_checks() -> None:
    checks = SensorChecks({"laser": Mount(z=0.8)}, LidarConfig(), StepConfig(), load_robot("husky_a200"))
    points = rooms.cloud(LAB, np.zeros(3), 0, math.radians(5.0)) - np.array([0.0, 0.0, 0.8])
    for k in range(12):
        scan = Scan(k * 500_000_000, points, frame_id="laser", is_planar=False)
        motion = Motion(np.zeros(3), np.eye(3))
        step = Step(scan.stamp_ns, scan.stamp_ns + 500_000_000, motion, np.zeros(3), np.zeros(3), True, True, None, scan)
        assert checks.apply(step, DeadReckoning()).scan is scan
    (warning,) = checks.warnings()
    assert "by 5.0 deg" in warning


def test_fit_ground_of_no_ground_is_none() -> None:
    rng = np.random.default_rng(0)
    across = rng.uniform(-8.0, 8.0, (2000, 2))
    level = np.array([-0.8, 0.05, -0.1])
    flat = np.column_stack([across, level[0] + across @ level[1:] + 0.01 * rng.normal(size=2000)])
    np.testing.assert_allclose(fit_ground(flat), level, atol=0.01)
    steep = np.column_stack([across, 0.5 * across[:, 0]])
    heap = np.column_stack([across, rng.uniform(-2.0, 2.0, 2000)])
    strip = flat[np.abs(across[:, 1]) < 0.5]
    shelf = np.concatenate([flat, flat[np.abs(across).max(axis=1) < 3.5] - [20.0, 0.0, 3.0]])  # there is more below
    for none in (np.empty((0, 3)), flat[:5], steep, heap, strip, shelf):
        assert fit_ground(none) is None
