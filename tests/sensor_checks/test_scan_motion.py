"""Motion from scan to scan against a room of formulas."""

from __future__ import annotations

import numpy as np
import pytest

from localization.sensor_checks.scan_motion import Profile, ScanOdometry, make_profile
from motion_models import se2
from tests.helpers.rooms import ANGLES, ranges


def scan(pose: np.ndarray, sensor: np.ndarray, rng: np.random.Generator, count: int = 360) -> Profile | None:
    """The first ``count`` points of a scan from the body's ``pose`` (3,), by a sensor at ``sensor`` (3,) on it."""
    r = ranges(tuple(se2.compose(pose, sensor))) + 0.01 * rng.normal(size=len(ANGLES))
    points = se2.transform(sensor, np.column_stack([r * np.cos(ANGLES), r * np.sin(ANGLES)]))
    return make_profile(points[:count] - sensor[:2], sensor[:2])


@pytest.mark.parametrize("motion", [(0.1, 0.0, 0.0), (0.2, 0.0, 0.2), (0.0, 0.0, -0.6), (-0.3, 0.1, 0.05), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("sensor", [(0.0, 0.0, 0.0), (0.4, -0.1, 0.7)])
def test_register_between_scans_gives_body_motion(motion: tuple, sensor: tuple) -> None:
    rng, odometry, mount = np.random.default_rng(0), ScanOdometry(), np.array(sensor)
    assert odometry.register(scan(np.zeros(3), mount, rng)) is None
    found = odometry.register(scan(np.array(motion), mount, rng))
    assert found is not None
    assert found.has_translation
    np.testing.assert_allclose(found.delta, motion, atol=0.02)


def test_register_in_corridor_has_no_translation() -> None:
    rng, odometry = np.random.default_rng(0), ScanOdometry()
    with np.errstate(divide="ignore"):
        r = np.minimum(1.2 / np.abs(np.sin(ANGLES)), 200.0)
    is_wall = r < 30.0
    found = None
    for _ in range(2):
        noisy = (r + 0.01 * rng.normal(size=len(r)))[is_wall]
        found = odometry.register(
            make_profile(np.column_stack([noisy * np.cos(ANGLES[is_wall]), noisy * np.sin(ANGLES[is_wall])]), np.zeros(2))
        )
    assert found is not None
    assert not found.has_translation
    assert abs(found.delta[2]) < 0.01
    assert abs(found.normal[0]) < 0.01  # across the walls, along which nothing shows the way
    assert abs(found.delta[:2] @ found.normal) < 0.01


@pytest.mark.parametrize("n", [0, 1, 50])
def test_register_with_few_points_gives_none(n: int) -> None:
    rng, odometry = np.random.default_rng(0), ScanOdometry()
    odometry.register(scan(np.zeros(3), np.zeros(3), rng))
    assert odometry.register(scan(np.zeros(3), np.zeros(3), rng, n)) is None
    assert odometry.register(scan(np.zeros(3), np.zeros(3), rng)) is None


def test_register_of_another_place_gives_none() -> None:
    rng, odometry = np.random.default_rng(0), ScanOdometry()
    odometry.register(scan(np.zeros(3), np.zeros(3), rng))
    assert odometry.register(make_profile(rng.uniform(-8.0, 8.0, (360, 2)), np.zeros(2))) is None


@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (0.05, 0.0, 0.05), (0.0, 0.0, -0.2)])
def test_register_of_two_lidars_gives_body_motion(motion: tuple) -> None:
    """One ahead, one behind, in turn."""
    rng, odometry, pose = np.random.default_rng(0), ScanOdometry(), np.zeros(3)
    for k in range(6):
        mount = np.array([0.3 if k % 2 else -0.3, 0.0, 0.0])
        found = odometry.register(scan(pose, mount, rng))
        pose = se2.compose(pose, np.array(motion))
        if k:
            assert found is not None
            np.testing.assert_allclose(found.delta, motion, atol=0.02)
