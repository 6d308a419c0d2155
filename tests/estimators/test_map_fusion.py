"""The filter localized in a saved map: frames, checkpoints, poses given by a person."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from localization.core.filter import set_marginal
from localization.estimators import MapFusion, PriorMap
from localization.events import PositionSample
from localization.log_replay import replay
from localization.logs import open_log
from localization.logs.reference_topics import merge_positions
from localization.maps.place_search import PlaceMap
from localization.maps.position_plane import PositionPlane
from localization.pipeline import Pipeline, Trial
from localization.ros.state_serialization import deserialize, serialize
from motion_models import se2
from motion_models.registry import make_model
from tests.helpers.online import ROBOT, drive_log

pytestmark = pytest.mark.xdist_group("map_fusion")

MODEL = make_model("diff_drive", ROBOT)


@functools.cache
def drive():
    return list(open_log(drive_log(), ROBOT).events())


@functools.cache
def keyframes():
    found = replay(drive(), [Trial(MODEL, "graph")], ROBOT, ROBOT.mounts, True)[0].keyframes
    assert found is not None
    return found


@functools.cache
def places() -> PlaceMap:
    return PlaceMap(keyframes(), 0.02)


def start(initial=None) -> Pipeline:
    return Pipeline(Trial(MODEL, "map", prior=PriorMap(places(), initial)), ROBOT, ROBOT.mounts, True)


@pytest.mark.extended
def test_map_fusion_odometry_is_the_filters_own():
    ekf = Pipeline(Trial(MODEL, "ekf"), ROBOT, ROBOT.mounts, True)
    located, poses = start(np.array([0.2, -0.2, 0.1])), {}
    for event in drive():
        for one, other in zip(ekf.process(event), located.process(event), strict=True):
            assert other.odometry is not None
            np.testing.assert_array_equal(one.pose, other.odometry[0])
            poses[other.stamp_ns] = other.pose
            np.testing.assert_allclose(se2.compose(other.map_T_odom, one.pose), other.pose, atol=1e-12)
    assert located.estimator.localization()["state"] == "localized"
    errors = [np.hypot(*(poses[stamp][:2] - pose[:2])) for stamp, pose in zip(keyframes().stamps_ns, keyframes().poses, strict=True)]
    assert np.max(errors[len(errors) // 2 :]) < 0.05


def test_map_fusion_before_it_is_localized_has_the_maps_extent_as_sigma():
    """The robot stands: a place needs the agreement of two searches."""
    pipeline, end_ns = start(), drive()[0].stamp_ns + 600_000_000
    estimates = [estimate for event in drive() if event.stamp_ns < end_ns for estimate in pipeline.process(event)]
    assert pipeline.estimator.localization()["state"] == "searching"
    assert np.sqrt(estimates[-1].covariance[0, 0]) > 4.0
    assert any("never localized" in text for text in pipeline.warnings())


@pytest.mark.extended
def test_map_fusion_with_positions_elsewhere_leaves_the_place():
    """The map's plane is turned and moved; positions that are right keep the place, those 30 m away do not."""
    plane = PositionPlane(np.array([300.0, -200.0, 0.9]), 1e-4 * np.eye(3), np.zeros(2), None)
    placed, events = PlaceMap(dataclasses.replace(keyframes(), plane=plane), 0.02), drive()[: len(drive()) // 2]
    states = {}
    for off in (0.0, 30.0):
        pipeline = Pipeline(Trial(MODEL, "map", prior=PriorMap(placed, np.array([0.2, -0.2, 0.1]))), ROBOT, ROBOT.mounts, True)
        fixes = [
            PositionSample(int(stamp), se2.compose(plane.plane_T_map, pose)[:2] + np.array([off, 0.0]), np.eye(2))
            for stamp, pose in zip(keyframes().stamps_ns, keyframes().poses, strict=True)
        ]
        for event in merge_positions(events, fixes):
            pipeline.process(event)
        states[off] = pipeline.estimator.localization()["state"]
    assert states[0.0] == "localized"
    assert states[30.0] != "localized"


def test_map_fusion_with_positions_in_a_map_without_says_so():
    pipeline = start()
    for event in merge_positions(drive()[:50], [PositionSample(drive()[0].stamp_ns, np.zeros(2), np.eye(2))]):
        pipeline.process(event)
    assert any("the map was built without such" in text for text in pipeline.warnings())


@pytest.mark.extended
def test_map_fusion_state_written_and_read_gives_the_same_estimates():
    """The map itself is not in the state."""
    pipeline = start(np.array([0.2, -0.2, 0.1]))
    half = len(drive()) // 2
    for event in drive()[:half]:
        pipeline.process(event)
    shared = {"map": pipeline.estimator.localizer.places}
    text, blob = serialize(pipeline, shared)
    assert len(text) + len(blob) < 1_500_000
    again = deserialize(text, blob, shared)
    for event in drive()[half:]:
        for one, other in zip(pipeline.process(event), again.process(event), strict=True):
            np.testing.assert_array_equal(one.pose, other.pose)
            np.testing.assert_array_equal(one.covariance, other.covariance)


def test_map_fusion_pose_given_between_keyframes_is_of_that_moment():
    pipeline = start()
    for event in drive()[:1000]:
        pipeline.process(event)
    assert isinstance(pipeline.estimator, MapFusion)
    pose = np.array([1.0, 2.0, 0.5])
    pipeline.estimator.set_pose(pose, 0.01 * np.eye(3))
    delta, _ = pipeline.estimator.odometry.state.between("key", "pose")
    assert np.abs(delta).max() > 0.01
    estimates = [estimate for event in drive()[1000:1100] for estimate in pipeline.process(event)]
    assert estimates[0].pose == pytest.approx(pose, abs=0.1)


def test_map_fusion_filter_that_moves_its_pose_leaves_the_place():
    """As when the filter finds its submap again after it was lost: the odometry's pose moves by metres, the keyframe's clone does not."""
    pipeline = start(np.array([0.2, -0.2, 0.1]))
    before = [estimate for event in drive()[:1000] for estimate in pipeline.process(event)][-1]
    filtered = pipeline.estimator.odometry
    elsewhere = filtered.state["pose"] + np.array([3.0, -2.0, 0.0])
    filtered.state = set_marginal(filtered.state, "pose", elsewhere, np.diag([9.0, 9.0, 0.1]))
    after = next(estimate for event in drive()[1000:] for estimate in pipeline.process(event))
    assert np.hypot(*(after.odometry[0] - before.odometry[0])[:2]) > 1.0
    assert after.pose == pytest.approx(before.pose, abs=0.05)
    np.testing.assert_allclose(se2.compose(after.map_T_odom, after.odometry[0]), after.pose, atol=1e-12)


def test_map_fusion_has_the_filters_residuals_and_learned_parameters():
    """Without them, the checks of innovations would not run for it."""
    pipeline = start(np.array([0.2, -0.2, 0.1]))
    for event in drive()[:200]:
        pipeline.process(event)
    estimator = pipeline.estimator
    assert isinstance(estimator, MapFusion)
    assert estimator.residuals is not None
    np.testing.assert_array_equal(estimator.residuals.file_delta, estimator.odometry.residuals.file_delta)
    assert [learned.name for learned in estimator.learned_parameters()] == ["wheel_radius_scale", "wheel_separation_multiplier"]
