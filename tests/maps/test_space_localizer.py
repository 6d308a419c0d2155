"""Place in a map in space: searched about a pose and everywhere, tracked, lost, outside; and the covariance of what is published."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from localization.maps.space_localizer import SpaceLocalizer, SpaceMotion
from localization.maps.space_places import SpacePlaces
from motion_models import se3
from tests.helpers import hill_map

pytestmark = pytest.mark.xdist_group("hill_map")

_EVERY = 4
"""Of the points of a cloud, one of so many is used, to save time."""
_NEAR_COV = np.diag([0.2, 0.2, 0.1]) ** 2
_MORE = pytest.mark.extended
_WAY = np.array(hill_map.WAY)
_DRIVE = _WAY[1:-1] + np.array([0.3, 0.4, 0.1])
_ODOMETRY_COV = np.diag([2e-3, 2e-3, 2e-3, 1e-3, 1e-3, 1e-3]) ** 2


@pytest.fixture(scope="module")
def scene():
    return hill_map.scene_around(_WAY[:, :2])


@pytest.fixture(scope="module")
def hills(scene):
    return hill_map.make_map(scene)


@pytest.fixture(scope="module")
def places(hills):
    return SpacePlaces(hills, 0.02)


@pytest.fixture(scope="module")
def poses():
    return np.array([hill_map.on_hills(*place) for place in _DRIVE])


@pytest.fixture(scope="module")
def clouds(scene, poses):
    return [hill_map.cloud_at(pose, scene, 100 + i)[::_EVERY] for i, pose in enumerate(poses)]


def drive(localizer: SpaceLocalizer, poses: np.ndarray, clouds: list[np.ndarray], rng: np.random.Generator | None = None) -> list[str]:
    """Keyframes at ``poses`` (K, 4, 4) with odometry that errs as `_ODOMETRY_COV` has it; the state after each."""
    states = []
    for i, (pose, cloud) in enumerate(zip(poses, clouds, strict=True)):
        delta = np.eye(4) if i == 0 else se3.inverse(poses[i - 1]) @ pose
        noise = np.zeros(6) if rng is None else rng.multivariate_normal(np.zeros(6), _ODOMETRY_COV)
        localizer.add(cloud, SpaceMotion(delta @ se3.exp(noise), _ODOMETRY_COV), pose[:3, :3])
        states.append(localizer.state)
    return states


def error(localizer: SpaceLocalizer, pose: np.ndarray) -> np.ndarray:
    return se3.local(localizer.pose, pose)


@pytest.mark.parametrize(
    "off",
    [np.array([0.6, -0.5, 0.3]), pytest.param(np.array([-1.0, 0.8, -0.5]), marks=_MORE), pytest.param(None, marks=_MORE)],
    ids=["near", "farther", "anywhere"],
)
def test_robot_on_hills_is_found_after_a_metre_from_a_pose_that_is_off_or_without_one(places, poses, clouds, off):
    initial = None if off is None else _DRIVE[0] + off
    localizer = SpaceLocalizer(places, initial)
    states = drive(localizer, poses[:4], clouds[:4])
    assert states[0] == "searching"
    assert states[-1] == "localized"
    assert np.abs(error(localizer, poses[3])[:3]).max() < 0.02
    assert np.abs(error(localizer, poses[3])[3:]).max() < 3e-3
    assert localizer.probability > 0.9


def carried(places: SpacePlaces, poses: np.ndarray, clouds: list[np.ndarray]) -> SpaceLocalizer:
    """A robot that was localized, stands six keyframes ahead, and goes straight on by its odometry, until it is lost."""
    localizer = SpaceLocalizer(places, _DRIVE[0], _NEAR_COV)
    assert drive(localizer, poses[:3], clouds[:3])[-1] == "localized"
    still = SpaceMotion(se3.exp(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])), _ODOMETRY_COV)
    for _ in range(4):
        if localizer.state == "localized":
            localizer.add(clouds[-1], still, poses[-1][:3, :3])
    return localizer


def test_robot_that_was_carried_is_lost(places, poses, clouds):
    localizer = carried(places, poses, clouds)
    assert localizer.state == "lost"
    assert localizer.probability < 0.5
    assert np.sqrt(localizer.covariance[0, 0]) > 10.0


@pytest.mark.extended
def test_robot_that_was_carried_is_found_elsewhere(places, poses, clouds):
    localizer = carried(places, poses, clouds)
    assert drive(localizer, poses[:4], clouds[:4])[-1] == "localized"
    assert np.abs(error(localizer, poses[3])[:3]).max() < 0.02


@pytest.mark.parametrize("initial", [np.zeros(3), pytest.param(None, marks=_MORE)], ids=["near", "anywhere"])
def test_robot_on_other_ground_is_never_localized(places, scene, initial):
    """The same trees and walls, turned by a right angle: the ground below differs."""
    turned = dataclasses.replace(scene, heights=np.ascontiguousarray(np.rot90(scene.heights)))
    way = np.array([np.eye(4) @ se3.exp(np.array([0.6 * i, 0.0, 0.0, 0.0, 0.0, 0.0])) for i in range(3)])
    way[:, 2, 3] = 0.3
    localizer = SpaceLocalizer(places, initial)
    states = drive(localizer, way, [hill_map.cloud_at(pose, turned, i)[::_EVERY] for i, pose in enumerate(way)])
    assert "localized" not in states
    assert localizer.probability <= 0.9


def test_robot_outside_of_the_map_goes_on_by_odometry(places, poses, clouds):
    localizer = SpaceLocalizer(places, _DRIVE[0], _NEAR_COV)
    drive(localizer, poses[:3], clouds[:3])
    before = localizer.covariance[0, 0]
    nothing = np.random.default_rng(0).uniform(-5.0, 5.0, (500, 3)) + np.array([0.0, 0.0, 30.0])
    localizer.add(nothing, SpaceMotion(np.eye(4), 4.0 * _ODOMETRY_COV), poses[2][:3, :3])
    assert localizer.is_outside
    assert localizer.state == "localized"
    assert localizer.covariance[0, 0] > before


@pytest.mark.extended
def test_pose_in_a_map_that_errs_does_so_as_its_covariance_has_it(hills, poses, clouds):
    """The map is moved as its own covariance has it, by centimetres and milliradians: no cloud of the drive shows that.

    NEES of 12 draws: chi-square with 72 degrees of freedom is between 43 and 107 in 99 %; below that the covariance is too wide, as
    the floor for maps that bend is.
    """
    rng, sigmas, total = np.random.default_rng(3), np.array([0.03, 0.03, 0.03, 3e-3, 3e-3, 3e-3]), 0.0
    adjoints = [se3.adjoint(se3.inverse(pose)) for pose in hills.poses]
    covs = np.array([A @ np.diag(sigmas**2) @ A.T for A in adjoints])
    for _ in range(12):
        moved = se3.exp(sigmas * rng.normal(size=6))
        wrong = dataclasses.replace(hills, poses=moved @ hills.poses, covariances=covs)
        localizer = SpaceLocalizer(SpacePlaces(wrong, 0.02), _DRIVE[0], _NEAR_COV)
        assert drive(localizer, poses[:4], clouds[:4], rng)[-1] == "localized"
        off = error(localizer, poses[3])
        total += off @ np.linalg.solve(localizer.covariance, off)
    assert 36.0 < total < 107.0
