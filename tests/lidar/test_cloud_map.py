"""Clouds registered to a 3D submap: the pose, its covariance, and directions that the scene leaves open."""

from __future__ import annotations

import numpy as np
import pytest

from localization.lidar.cloud_map import CloudMap, thin
from motion_models import se3

NOISE_M, CELL_M = 0.015, 0.4
WIDE = np.diag([0.2**2] * 3 + [0.05**2] * 3)


def yard(rng, n=4000):
    """(n, 3) points of a floor, two walls and four trunks."""
    floor = np.column_stack([rng.uniform(-8.0, 8.0, (n // 2, 2)), np.zeros(n // 2)])
    k = n // 6
    wall = np.column_stack([rng.uniform(-8.0, 8.0, k), np.full(k, 7.0), rng.uniform(0.0, 3.0, k)])
    side = np.column_stack([np.full(k, -6.0), rng.uniform(-8.0, 8.0, k), rng.uniform(0.0, 3.0, k)])
    places = np.array([[3.0, 2.0], [5.0, -4.0], [-2.0, -5.0], [1.0, -3.0]])[rng.integers(0, 4, k)]
    angle = rng.uniform(0.0, 2.0 * np.pi, k)
    trunks = np.column_stack([places + 0.15 * np.column_stack([np.cos(angle), np.sin(angle)]), rng.uniform(0.0, 3.0, k)])
    return np.concatenate([floor, wall, side, trunks])


def seen(points, pose, rng):
    return se3.transform(se3.inverse(pose), points) + NOISE_M * rng.normal(size=points.shape)


def mapped(scene, seed=0, clouds=4):
    rng, made = np.random.default_rng(seed), CloudMap(CELL_M, NOISE_M)
    for _ in range(clouds):
        made.insert(np.eye(4), seen(scene(rng), np.eye(4), rng))
    return made


@pytest.fixture(scope="module")
def yard_map():
    return mapped(yard)


def test_cloud_match_finds_the_pose_and_its_covariance_holds(yard_map):
    """Over 60 clouds from poses off their priors by 20 cm and 3 deg. 6 is expected, of which the submap, its points noisy too, has a fifth
    more variance; the mean of 60 scatters by 0.45."""
    rng, squares = np.random.default_rng(1), []
    for _ in range(60):
        true = se3.exp(rng.normal(size=6) * np.sqrt(np.diagonal(WIDE)))
        match = yard_map.match(thin(seen(yard(rng), true, rng), CELL_M), np.eye(4), WIDE)
        error = se3.log(se3.inverse(match.measured) @ true)
        assert np.abs(error[:3]).max() < 0.01
        assert match.overlap > 0.9
        squares.append(error @ np.linalg.solve(match.cov, error))
    assert 4.5 < np.mean(squares) < 9.0


def test_cloud_match_on_open_ground_keeps_the_prior_and_is_wide():
    """A plane gives height, roll and pitch; along it and about its normal the cloud says nothing."""

    def ground(rng):
        return np.column_stack([rng.uniform(-8.0, 8.0, (3000, 2)), np.zeros(3000)])

    rng = np.random.default_rng(2)
    true = se3.exp(np.array([0.1, -0.1, 0.05, 0.02, -0.02, 0.03]))
    match = mapped(ground).match(seen(ground(rng), true, rng), np.eye(4), WIDE)
    error, sigmas = se3.log(se3.inverse(match.pose) @ true), np.sqrt(np.diagonal(match.cov))
    assert np.abs(error[[2, 3, 4]]).max() < 0.005
    assert sigmas[[0, 1]].min() > 3.0
    assert sigmas[5] > 0.5
    np.testing.assert_allclose(se3.log(match.pose)[[0, 1]], 0.0, atol=0.02)


def test_cloud_match_to_single_rings_on_the_ground_says_nothing_along_it():
    """A standing scanner draws rings, which move with it: they must not hold the robot where it was."""

    def rings(rng):
        angle, radius = rng.uniform(0.0, 2.0 * np.pi, 3000), rng.choice([3.0, 4.5, 7.0], 3000)
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(3000)])

    match = mapped(rings).match(seen(rings(np.random.default_rng(3)), np.eye(4), np.random.default_rng(4)), np.eye(4), WIDE)
    assert np.sqrt(np.diagonal(match.cov))[[0, 1]].min() > 3.0


def test_cloud_map_share_falls_with_the_clouds_before():
    cloud, made = yard(np.random.default_rng(5)), CloudMap(CELL_M, NOISE_M)
    found = [made.insert(np.eye(4), cloud) for _ in range(3)]
    np.testing.assert_allclose(found, [(1.0, 1.0), (0.5, 0.0), (1.0 / 3.0, 0.0)], atol=1e-9)


def test_cloud_map_grows_beyond_its_first_size():
    made = CloudMap(0.1, NOISE_M)
    points = np.random.default_rng(6).uniform(-20.0, 20.0, (30_000, 3))
    made.insert(np.eye(4), points)
    np.testing.assert_allclose(np.sort(made.points()[:, 0])[[0, -1]], [-20.0, 20.0], atol=0.01)
    share, new = made.insert(np.eye(4), points)
    assert share == pytest.approx(0.5, abs=0.01)
    assert new == 0.0


def test_thin_keeps_one_point_per_cube():
    points = np.array([[0.01, 0.0, 0.0], [0.02, 0.0, 0.0], [1.0, 0.0, 0.0], [-0.01, 0.0, 0.0]])
    np.testing.assert_array_equal(thin(points, CELL_M), points[[0, 2, 3]])


def test_cloud_match_to_rings_that_drift_says_nothing():
    """A scanner that drives off draws rings on a wall ahead, each 5 cm higher, from poses that drift by 1 cm. A plane through them leans,
    and the next ring on it would move the pose by 1 cm more."""

    def ring(k, drift):
        y = np.random.default_rng(k).uniform(-6.0, 6.0, 400)
        points = np.column_stack([np.full(400, 20.0 + drift), y, np.full(400, 1.0 + 0.05 * k)])
        return seen(points, np.eye(4), np.random.default_rng(100 + k))

    made = CloudMap(CELL_M, NOISE_M)
    for k in range(4):
        made.insert(np.eye(4), ring(k, 0.01 * k))
    match = made.match(ring(4, 0.0), np.eye(4), np.diag([0.01**2] * 3 + [0.001**2] * 3))
    np.testing.assert_allclose(se3.log(match.pose), 0.0, atol=1e-9)
    assert np.sqrt(match.cov[0, 0]) > 3.0


def test_cloud_match_counts_no_point_beyond_the_end_of_a_surface():
    """Where ground bends, the plane at the map's edge does not go on: points that are beyond it by half a voxel and more pull nowhere."""

    def valley(rng, low, high, n):
        x, y = rng.uniform([low, -8.0], [high, 8.0], (n, 2)).T
        return np.column_stack([x, y, 0.04 * (x * x + y * y)])

    def within(rng):
        return np.concatenate([valley(rng, -8.0, 3.2, 4000), yard(rng)[-600:]])

    rng, surfaces = np.random.default_rng(7), mapped(within)
    inside, beyond = seen(within(rng), np.eye(4), rng), seen(valley(rng, 3.4, 3.6, 300), np.eye(4), rng)
    alone, both = (surfaces.match(points, np.eye(4), WIDE) for points in (inside, np.concatenate([inside, beyond])))
    assert both.mapped > alone.mapped + 200  # surfaces narrower than a voxel at the very edge are none
    np.testing.assert_allclose(both.measured, alone.measured, atol=1e-12)
