"""Odometry in space: a robot that rolls over waves among trees, over open ground and without a LiDAR."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from localization.core.measurements.position import predict_position_in_space
from localization.events import PositionSample, WheelSample
from localization.inputs.step_config import StepConfig
from localization.log_replay import replay
from localization.logs.reference_topics import merge_positions
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.ros.state_serialization import deserialize, serialize
from motion_models.registry import make_model
from tests.helpers.hill_scans import MOUNT, make_scene, scans
from tests.helpers.hills import rolling_drive, with_accelerometer_bias, with_gyro_bias
from tests.helpers.in_space import IN_SPACE, aligned_rms, in_order, run_in_space, true_poses

pytestmark = pytest.mark.xdist_group("among_trees")


@pytest.fixture(scope="module")
def rolled():
    return rolling_drive(5.5)


@pytest.fixture(scope="module")
def among_trees(rolled):
    return list(scans(rolled, make_scene(rolled, 3)))


@pytest.mark.extended
def test_space_fusion_among_trees_is_within_centimetres(rolled, among_trees):
    found, pipeline = run_in_space(rolled, among_trees, "diff_drive")
    assert np.degrees(np.arccos(found.true[:, 2, 2])).max() > 5.0
    assert found.ate < 0.02
    assert np.abs(found.errors[20:, :3]).max() < 0.05
    assert np.abs(found.errors[20:, 3:]).max() < math.radians(0.5)
    counts = pipeline.estimator.counts()
    assert counts["matched"] == counts["scans"] - 1


def test_space_fusion_without_matches_is_by_wheels_gyro_and_gravity(rolled, among_trees):
    """Two points a cloud: nothing to match."""
    bare = [dataclasses.replace(scan, points=scan.points[:2], offsets=scan.offsets[:2]) for scan in among_trees]
    found, pipeline = run_in_space(rolled, bare, "diff_drive")
    assert np.abs(found.errors[-1, :3]).max() < 0.15
    assert np.sqrt(found.covariances[-1, 0, 0]) > 0.02
    assert (found.nees[30:] < 30.0).all()
    assert pipeline.lidar.share == pytest.approx(1.0)


@pytest.mark.slow
def test_space_fusion_over_seeds_has_the_nees_of_its_six_dimensions():
    """Biases of accelerometer and gyro drawn from their priors; noise, scene and way differ. At the end of 16 drives: chi-square with 48
    degrees of freedom, of positions and of rotations, is between 26 and 77 in 99 %. Rotations have 33. Positions have 20, for sigmas that
    are 1.5 times too wide on robots that roll without slip; the lower bound keeps them from twice."""
    sums = np.zeros(2)
    for seed in (*range(11, 19), *range(31, 39)):
        rolled = rolling_drive(6.0, turn_rate=0.5 - 0.1 * (seed % 10 - 1), seed=seed)
        drive = with_gyro_bias(with_accelerometer_bias(rolled, seed), seed)
        found, _ = run_in_space(drive, list(scans(drive, make_scene(drive, seed), seed=seed)), "diff_drive")
        error, cov = found.errors[-1], found.covariances[-1]
        sums += [error[part] @ np.linalg.solve(cov[part, part], error[part]) for part in (slice(0, 3), slice(3, 6))]
    assert 12.0 < sums[0] < 77.0
    assert 26.0 < sums[1] < 77.0


@pytest.mark.extended
def test_space_fusion_survives_a_cloud_of_200000_points_and_nan_rings(rolled, among_trees):
    last = among_trees[-1]
    rng = np.random.default_rng(0)
    many = rng.integers(0, len(last.points), 200_000)
    huge = dataclasses.replace(last, points=last.points[many] + 0.01 * rng.normal(size=(200_000, 3)), offsets=last.offsets[many])
    rings = [
        dataclasses.replace(s, points=np.where(np.arange(len(s.points))[:, None] % 4 == 0, np.nan, s.points)) for s in among_trees[:-1]
    ]
    found, pipeline = run_in_space(rolled, [*rings, huge], "diff_drive")
    counts = pipeline.estimator.counts()
    assert counts["matched"] == counts["scans"] - 1
    assert found.ate < 0.02


@pytest.mark.extended
def test_replay_in_space_gives_its_poses_with_six_by_six_covariances(rolled, among_trees):
    trials = [Trial(make_model("skid_steer", rolled.robot), name) for name in ("ekf", "graph")]
    mounts = {**rolled.mounts, "lidar_link": MOUNT}
    runs = replay(in_order(rolled, among_trees), trials, rolled.robot, mounts, True, IN_SPACE)
    for run in runs:
        assert run.in_space is not None
        later = run.in_space.stamps_ns[len(run.in_space.stamps_ns) // 2 :]
        np.testing.assert_allclose(run.in_space.positions[-len(later) :, :2], run.trajectory.poses[-len(later) :, :2], atol=1e-12)
        assert run.in_space.covariances.shape == (len(run.trajectory), 6, 6)
        assert (np.linalg.eigvalsh(run.in_space.covariances) > -1e-9).all()
    ekf, smoothed = (aligned_rms(run.in_space.positions, true_poses(rolled, run.in_space.stamps_ns)[:, :3, 3]) for run in runs)
    assert smoothed < 1.2 * ekf
    np.testing.assert_allclose(runs[1].live.poses, runs[0].trajectory.poses, atol=1e-6)


def test_space_fusion_without_an_imus_mount_is_named(rolled, among_trees):
    """Gravity cannot be measured: wheels alone, and no cloud is matched."""
    unknown = dataclasses.replace(rolled, mounts={"base_link": rolled.mounts["base_link"]})
    _, pipeline = run_in_space(unknown, among_trees[:8], "diff_drive")
    assert pipeline.estimator.counts()["matched"] == 0
    assert any("no IMU with an accelerometer and a known mount" in warning for warning in pipeline.warnings())


@pytest.mark.extended
def test_replay_where_the_ground_tilts_goes_on_in_space_by_itself(rolled, among_trees):
    """In the plane until the IMU shows the slope, then within centimetres of the truth in height, roll and pitch, too."""
    mounts = {**rolled.mounts, "lidar_link": MOUNT}
    trial = Trial(make_model("diff_drive", rolled.robot), "ekf")
    (run,) = replay(in_order(rolled, among_trees), [trial], rolled.robot, mounts, True)
    (flat,) = replay(in_order(rolled, among_trees), [trial], rolled.robot, mounts, True, ReplayConfig(step=StepConfig(planar=True)))
    is_before = run.trajectory.stamps_ns <= run.left_plane_ns
    np.testing.assert_array_equal(run.trajectory.poses[is_before], flat.trajectory.poses[is_before])
    assert 0.0 < run.in_space_from_s < 4.5  # a start on a slope may be an IMU that sits askew: the way decides
    assert not run.in_space.is_lifted
    assert run.in_space.stamps_ns[-1] == run.trajectory.stamps_ns[-1]
    assert (np.diff(run.in_space.stamps_ns) > 0).all()
    assert np.linalg.norm(np.diff(run.in_space.positions, axis=0), axis=1).max() < 0.12  # at .7 m/s, 10 Hz: no jump
    found, _ = run_in_space(rolled, among_trees, "diff_drive", ReplayConfig())
    assert found.ate < 0.02


@pytest.mark.extended
def test_replay_of_clouds_on_level_ground_stays_in_the_plane_to_the_last_bit():
    level = rolling_drive(4.0, is_flat=True)
    clouds, trial = list(scans(level, make_scene(level, 3, is_flat=True))), Trial(make_model("diff_drive", level.robot), "ekf")
    args = in_order(level, clouds), [trial], level.robot, {**level.mounts, "lidar_link": MOUNT}, True
    (run,), (flat,) = replay(*args), replay(*args, ReplayConfig(step=StepConfig(planar=True)))
    np.testing.assert_array_equal(run.trajectory.poses, flat.trajectory.poses)
    np.testing.assert_array_equal(run.trajectory.covariances, flat.trajectory.covariances)
    assert run.left_plane_ns is None
    assert run.in_space is None


@pytest.mark.extended
def test_graph_in_space_with_positions_corrects_wrong_wheels():
    """Wheels 4 % too large, without a LiDAR: positions of 1 cm with their heights, in a plane of their own, at 2 Hz."""
    drive = rolling_drive(12.0, turn_rate=0.0, seed=5)  # on an arc the antenna may be farther aside instead
    enu_T_map, rng, lever = np.array([50.0, 20.0, 9.0, 1.0]), np.random.default_rng(6), np.array([0.1, 0.0, 0.5])
    wheels = [
        dataclasses.replace(e, velocity=0.96 * e.velocity, position=0.96 * e.position) if isinstance(e, WheelSample) else e
        for e in drive.events
    ]
    fixes = []
    for stamp, pose in zip(drive.stamps_ns[50::50], true_poses(drive, drive.stamps_ns[50::50]), strict=True):
        at = predict_position_in_space(enu_T_map, pose, np.eye(4), lever)[0] + 0.01 * rng.normal(size=3)
        fixes.append(PositionSample(int(stamp), at[:2], 1e-4 * np.eye(2), None, (float(at[2]), 1e-4)))
    trial, errors = Trial(make_model("diff_drive", drive.robot), "graph"), []
    for events in (wheels, list(merge_positions(wheels, fixes))):
        (run,) = replay(events, [trial], drive.robot, drive.mounts, True, IN_SPACE)
        errors.append(aligned_rms(run.in_space.positions, true_poses(drive, run.in_space.stamps_ns)[:, :3, 3]))
    assert run.counts["positions"] > 18
    assert errors[0] > 0.04
    assert errors[1] < 0.4 * errors[0]


def test_space_fusion_of_planar_scans_is_named(rolled, among_trees):
    flat = [dataclasses.replace(scan, is_planar=True) for scan in among_trees]
    _, pipeline = run_in_space(rolled, flat, "diff_drive")
    assert any("planar scans were not matched" in warning for warning in pipeline.warnings())


@pytest.mark.extended
def test_graph_in_space_cut_and_resumed_gives_the_same_bits(rolled, among_trees):
    """From a checkpoint with keyframes, wheels and gravity in it."""
    events = in_order(rolled, among_trees[:32])
    trial = Trial(make_model("diff_drive", rolled.robot), "graph")
    whole = Pipeline(trial, rolled.robot, {**rolled.mounts, "lidar_link": MOUNT}, True, IN_SPACE)
    for event in events[:-120]:
        whole.process(event)
    resumed = deserialize(*serialize(whole))
    assert resumed.estimator.graph.count > 1
    pairs = [(a, b) for event in events[-120:] for a, b in zip(whole.process(event), resumed.process(event), strict=True)]
    assert len(pairs) > 2
    for one, other in pairs:
        np.testing.assert_array_equal(one.in_space.position, other.in_space.position)
        np.testing.assert_array_equal(one.in_space.covariance, other.in_space.covariance)
