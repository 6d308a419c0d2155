"""KISS-ICP in the plane: as it comes, from a prior, and saved."""

from __future__ import annotations

import math

import numpy as np
import pytest
from kiss_icp.threshold import get_threshold_estimator

from localization.lidar import KissIcp, choose_voxel_size
from localization.lidar.kiss_icp import AdaptiveThreshold
from localization.ros.state_serialization import deserialize, serialize
from localization.simulation import world
from motion_models import se2
from tests.helpers import rooms

HALL = world.hall().walls
POSES = np.array([[0.05 * k, 0.02 * k, 0.03 * k] for k in range(20)])


def frames() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [np.column_stack([p, np.zeros(len(p))]) for pose in POSES for p in [rooms.scan_from(HALL, pose, rng)]]


def test_register_frame_follows_the_robot() -> None:
    kiss, scans = KissIcp(0.3, 50.0), frames()
    found = np.array([kiss.register_frame(scan) for scan in scans])
    assert np.abs(se2.log(se2.between(POSES, found))).max() < 0.03


def test_align_from_prior_reaches_the_pose() -> None:
    kiss, scans = KissIcp(0.3, 50.0), frames()
    for scan, pose in zip(scans[:10], POSES, strict=False):
        kiss.insert(scan, pose)
    off = np.array([0.1, -0.08, 0.05])
    found = kiss.align(scans[10], se2.compose(POSES[10], off), 0.3)
    error = np.abs(se2.log(se2.between(POSES[10], found)))
    assert error[:2].max() < 0.02
    assert error[2] < 0.005


def test_kiss_icp_deserialized_equals_original_bitwise() -> None:
    kiss, scans = KissIcp(0.3, 50.0), frames()
    for scan in scans[:12]:
        kiss.register_frame(scan)
    again = deserialize(*serialize(kiss))
    for scan in scans[12:]:
        np.testing.assert_array_equal(kiss.register_frame(scan), again.register_frame(scan))


def test_adaptive_threshold_equals_kiss_icps() -> None:
    from kiss_icp.config import load_config

    config = load_config(None)
    config.data.max_range = 40.0
    config.adaptive_threshold.initial_threshold, config.adaptive_threshold.min_motion_th = 0.5, 0.01
    theirs, ours, rng = get_threshold_estimator(config), AdaptiveThreshold(0.5, 0.01, 40.0), np.random.default_rng(0)
    for scale in (1e-4, 0.01, 0.1, 0.003, 1.0):
        yaw, x, y = scale * rng.normal(size=3)
        off = np.eye(4)
        off[:2] = [[math.cos(yaw), -math.sin(yaw), 0.0, x], [math.sin(yaw), math.cos(yaw), 0.0, y]]
        theirs.update_model_deviation(off)
        ours.update_model_deviation(off)
        assert ours.get_threshold() == pytest.approx(theirs.get_threshold(), rel=1e-9)


def test_kiss_icp_ignores_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    scans = frames()
    plain = KissIcp(0.3, 50.0)
    monkeypatch.setenv("KISS_ICP_MAPPING", '{"voxel_size": 3.0}')
    monkeypatch.setenv("kiss_icp_data", "nonsense")
    stray = KissIcp(0.3, 50.0)
    for scan in scans[:8]:
        np.testing.assert_array_equal(plain.register_frame(scan), stray.register_frame(scan))


@pytest.mark.parametrize(("median_m", "voxel_m"), [(1.0, 0.1), (4.0, 0.2), (100.0, 1.0)])
def test_choose_voxel_size_is_share_of_median_range(median_m: float, voxel_m: float) -> None:
    angles = np.linspace(0.0, 6.0, 101)
    ranges = median_m * np.linspace(0.5, 1.5, 101)
    assert choose_voxel_size(np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])) == pytest.approx(voxel_m)
