"""The ground's tilt apart from the mount's error, and the filter steps in place that it is made of."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.inputs.ground_tilt import GroundTilt
from localization.small_filters import propagate_in_place, update_in_place

COV = np.radians(0.5) ** 2 * np.eye(2)


def turn_on_a_plane(degrees, mount_deg=(0.0, 0.0), seed=0, seconds=40, noise=True):
    """Turn at .5 rad/s and .3 m/s on a plane of ``degrees`` with a mount that is off; windows of a second."""
    rng, made, steep = np.random.default_rng(seed), GroundTilt(), math.tan(math.radians(degrees))
    for k in range(1, seconds + 1):
        yaw = 0.5 * k
        ground = steep * np.array([-math.cos(yaw), math.sin(yaw)])
        off = np.radians(0.5) * rng.normal(size=2) if noise else np.zeros(2)
        made.update(ground + np.radians(mount_deg) + off, COV, 0.5, 0.3)
    return made


def test_mount_error_is_separate_from_a_plane():
    made = turn_on_a_plane(8.0, (2.0, -1.0))
    assert made.is_certain
    off = made.mount_error - np.radians([2.0, -1.0])
    assert off @ np.linalg.solve(made.mount_cov, off) < 9.2  # 99 % of chi-square with 2 degrees of freedom
    assert np.degrees(np.hypot(*off)) < 1.0


@pytest.mark.parametrize("degrees", [0.0, 1.0, 2.0])
def test_level_ground_under_a_mount_that_is_off_is_never_tilted(degrees):
    assert not any(turn_on_a_plane(degrees, (1.5, 1.5), seed).is_certain for seed in range(20))


@pytest.mark.parametrize("mount_deg", [(9.0, 0.0), (-4.0, 12.0)])
def test_level_ground_under_an_imu_that_sits_askew_is_level_after_a_turn(mount_deg):
    """Of no file; a file's mount is off by a degree or two. The covariance has the truth, and the mount is found by turning."""
    for seed in range(10):
        made = turn_on_a_plane(0.0, mount_deg, seed)
        off = made.mount_error - np.radians(mount_deg)
        assert not made.is_certain
        assert made.probabilities[1, 0] > 0.9
        assert off @ np.linalg.solve(made.mount_cov, off) < 13.8  # 99.9 % of chi-square with 2 degrees of freedom
        assert np.degrees(np.hypot(*off)) < 1.0


def test_imu_that_sits_askew_is_no_hill_before_it_turns():
    """Straight on over a floor: a hill of 12 deg would change on the way, or be rare."""
    rng, made = np.random.default_rng(1), GroundTilt()
    for _ in range(20):
        made.update(np.radians([9.0, 8.5]) + np.radians(0.5) * rng.normal(size=2), COV, 0.0, 0.3)
        assert not made.is_certain


def test_ground_under_a_robot_that_shakes_is_not_in_question():
    """Three degrees of noise on level ground are neither a hill nor an IMU that sits askew."""
    for seed in range(20):
        rng, made = np.random.default_rng(seed), GroundTilt()
        for _ in range(60):
            made.update(np.radians(3.0) * rng.normal(size=2), 36.0 * COV, 0.1, 0.3)
            assert not made.is_ambiguous
            assert not made.is_certain


def test_tilt_that_may_be_the_mounts_is_in_question():
    rng, made, found = np.random.default_rng(2), GroundTilt(), []
    for _ in range(4):
        made.update(np.radians([9.0, 8.5]) + np.radians(0.5) * rng.normal(size=2), COV, 0.0, 0.3)
        found.append(made.is_ambiguous)
    assert all(found)


def test_hills_after_a_level_floor_are_found_without_a_turn():
    """Straight on over a floor and up a ramp of 9 deg: what begins on the way is no mount."""
    rng, made, found = np.random.default_rng(0), GroundTilt(), []
    for k in range(30):
        steep = math.tan(math.radians(9.0)) if k >= 15 else 0.0
        made.update(np.array([-steep, 0.0]) + np.radians(0.5) * rng.normal(size=2), COV, 0.0, 0.3)
        found.append(made.is_certain)
    assert not any(found[:15])
    assert found[19]


@pytest.mark.parametrize("degrees", [4.0, 6.0])
def test_ground_that_is_found_to_tilt_is_within_its_covariance(degrees):
    """A mount that is off by 2.1 deg, at 1.8 sigma of its prior. The moment at which it is found is the one at which the tilt looks
    largest, and the truth is within 3 sigma (99 % of chi-square) even then."""
    steep, squares = math.tan(math.radians(degrees)), []
    for seed in range(60):
        rng, made = np.random.default_rng(seed), GroundTilt()
        for k in range(1, 41):
            ground = steep * np.array([-math.cos(0.5 * k), math.sin(0.5 * k)])
            made.update(ground + np.radians([1.5, 1.5]) + np.radians(0.5) * rng.normal(size=2), COV, 0.5, 0.3)
            if made.is_certain:
                off = made.ground - ground
                squares.append(off @ np.linalg.solve(made.ground_cov, off))
                break
    assert len(squares) > 15
    assert max(squares) < 9.2


def test_restart_forgets_the_ground_and_keeps_the_mount():
    made = turn_on_a_plane(8.0, (2.0, 0.0), noise=False)
    mount, cov = made.mount_error.copy(), made.mount_cov.copy()
    made.restart()
    np.testing.assert_array_equal(made.mount_error, mount)
    np.testing.assert_array_equal(made.mount_cov, cov)
    made.update(np.radians([2.0, 10.0]), 1e-8 * np.eye(2), 0.0, 0.0)
    assert np.degrees(np.abs(made.mount_error - mount)).max() < 0.3  # the new slope is the ground's


def test_steps_in_place_are_those_of_the_textbook():
    rng = np.random.default_rng(3)
    A, F, x, z, R = rng.normal(size=(4, 4)), rng.normal(size=(4, 4)), np.zeros(4), 0.7, 0.3
    P = A @ A.T
    made = P.copy()
    propagate_in_place(F, made)
    np.testing.assert_allclose(made, F @ P @ F.T, rtol=1e-12)
    made, H = P.copy(), np.array([1.0, 0.5, 0.0])
    update_in_place(x, made, H, z, R, np.empty(4))
    full = np.append(H, 0.0)
    K = P @ full / (full @ P @ full + R)
    np.testing.assert_allclose(x, K * z, rtol=1e-12)
    np.testing.assert_allclose(made, P - np.outer(K, full @ P), atol=1e-12)
