"""The 3D LiDAR as a sensor: which clouds are matched, which enter the submap, and what moves it."""

from __future__ import annotations

import numpy as np
import pytest

from localization.events import Scan, Step
from localization.lidar import LidarConfig
from localization.lidar.cloud_sensor import CloudMatchingSensor
from motion_models import se3
from motion_models.motion import Motion
from motion_models.robot import Mount
from tests.helpers.hill_map import cloud_at, on_hills, scene_around

MOUNT = Mount(0.1, 0.0, 0.3)
COV = np.diag([0.1**2] * 3 + [0.03**2] * 3)
START, AHEAD = on_hills(0.0, 0.0, 0.0), on_hills(1.2, 0.1, 0.1)
NO_BIAS = np.zeros(3)


@pytest.fixture(scope="module")
def scene():
    return scene_around(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))


def step_at(seconds, points):
    """A step of .1 s, at whose end the ``points`` (N, 3) of the body are measured."""
    stamp_ns = round(seconds * 1e9)
    scan = Scan(stamp_ns, points - [MOUNT.x, MOUNT.y, MOUNT.z], frame_id="lidar", is_planar=False)
    return Step(stamp_ns - 100_000_000, stamp_ns, Motion(np.zeros(3), np.eye(3)), np.zeros(3), np.zeros(3), False, True, None, scan)


@pytest.fixture
def sensor(scene):
    """With a submap of one cloud."""
    made = CloudMatchingSensor({"lidar": MOUNT}, LidarConfig())
    assert made.measure(step_at(1.0, cloud_at(START, scene)), NO_BIAS, START, COV) is None
    error = made.insert_key_cloud(START)
    assert error is not None
    np.testing.assert_array_equal(error.new_cov, np.zeros((6, 6)))  # unknown before the first match
    return made


def measure(sensor, scene, pose, seed=2, seconds=2.0):
    """A cloud from ``pose``, matched by a prior that is 5 cm off."""
    prior = pose @ se3.exp(np.array([0.05, -0.03, 0.0, 0.0, 0.0, 0.01]))
    return sensor.measure(step_at(seconds, cloud_at(pose, scene, seed)), NO_BIAS, prior, COV)


def test_cloud_sensor_measures_the_pose_against_the_submap(sensor, scene):
    found = measure(sensor, scene, AHEAD)
    error = se3.log(se3.inverse(found.measured) @ AHEAD)
    assert np.abs(error[:3]).max() < 0.03
    assert np.abs(error[3:]).max() < 0.01
    assert sensor.lost.causes == {}
    np.testing.assert_array_equal(sensor.position, [0.1, 0.0, 0.3])


def test_cloud_sensor_has_the_error_of_the_first_cloud_with_the_first_match(sensor, scene):
    first = measure(sensor, scene, AHEAD).first
    assert first.share == 0.0
    assert (np.linalg.eigvalsh(first.new_cov) >= 0.0).all()
    assert first.new_cov.any()
    assert measure(sensor, scene, AHEAD, 3, 2.1).first is None


def test_cloud_is_a_key_cloud_after_a_way_only(sensor, scene):
    assert measure(sensor, scene, START @ se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))) is not None
    assert sensor.insert_key_cloud(START) is None
    assert measure(sensor, scene, AHEAD, 3, 2.1) is not None
    error = sensor.insert_key_cloud(AHEAD)
    assert 0.0 < error.share < 1.0
    assert sensor.cloud is None
    assert sensor.insert_key_cloud(AHEAD) is None  # no cloud is at hand


def test_cloud_that_is_sparse_or_elsewhere_is_lost(sensor, scene):
    assert sensor.measure(step_at(2.0, np.ones((3, 3))), NO_BIAS, START, COV) is None
    elsewhere = se3.exp(np.array([300.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert sensor.measure(step_at(2.1, cloud_at(START, scene)), NO_BIAS, elsewhere, COV) is None
    assert sensor.lost.causes == {"sparse": 1, "lost": 1}
    sensor.add_no_cloud(2_200_000_000, is_excluded=True)
    assert sensor.lost.causes["excluded"] == 1


def test_cloud_in_a_submap_that_was_moved_is_measured_there(sensor, scene):
    error = np.array([0.0, 0.0, 0.0, 0.02, -0.01, 0.0])
    before = measure(sensor, scene, START).measured
    sensor.move_map(START, error)
    after = measure(sensor, scene, START, 2, 2.1).measured
    np.testing.assert_allclose(se3.log(se3.inverse(before) @ after), error, atol=0.01)
