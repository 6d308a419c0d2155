"""Scenes that move: people who walk off about a standing robot, who walk along, and wheels that slip in a still world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localization.ros.state_serialization import deserialize, serialize
from localization.sensor_checks.moving_report import MOVING_OBJECTS
from localization.sensor_checks.scan_motion import make_profile
from localization.sensor_checks.scene_motion import MOVED, STILL, align_rest, explain
from localization.simulation import world
from motion_models import se2
from tests.helpers import rooms
from tests.helpers.corridors import KINDS, in_corridor
from tests.helpers.event_faults import EventFault, multiply_wheels, named_faults, turn_scans, without_gyro
from tests.helpers.extended import cases
from tests.helpers.fault_drives import in_room, run
from tests.helpers.moving_scenes import SCENES

S = 1_000_000_000
MOTION = np.array([0.4, 0.05, 0.1])


def _scans(people: list[np.ndarray]) -> list[np.ndarray]:
    """Scans of a room from the origin and after `MOTION`, with ``people`` (k, 2) about the robot."""
    walls = np.concatenate([world.box(-4, -3, 5, 4), world.pillar(2, 2, 0.3)])
    rng, found = np.random.default_rng(0), []
    for pose, places in zip((np.zeros(3), MOTION), people, strict=True):
        bodies = [world.pillar(*se2.transform(pose, place), 0.25) for place in places]
        found.append(rooms.scan_from(np.concatenate([walls, *bodies]), pose, rng, 0.01))
    return found


def test_still_scene_has_one_motion() -> None:
    before, now = _scans([np.zeros((0, 2))] * 2)
    reference, profile = make_profile(before, np.zeros(2)), make_profile(now, np.zeros(2))
    assert reference is not None
    assert profile is not None
    scene = explain(reference, profile, now, MOTION + np.array([0.06, -0.05, 0.02]))
    assert scene.motion == pytest.approx(MOTION, abs=0.02)
    assert np.mean(scene.labels == STILL) > 0.9
    assert scene.moved_share < 0.03


def test_people_who_walk_along_have_another_motion_than_the_room() -> None:
    places = np.array([[1.2, 0.8], [-1.0, 1.0], [-1.2, -0.9], [0.3, -1.3], [1.3, -0.6], [0.2, 1.4]])
    before, now = _scans([places, places])
    reference, profile = make_profile(before, np.zeros(2)), make_profile(now, np.zeros(2))
    assert reference is not None
    assert profile is not None
    scene = explain(reference, profile, now, MOTION)
    is_person = np.hypot(now[:, 0], now[:, 1]) < 1.9
    assert (scene.labels[~is_person] == STILL).mean() > 0.6  # some walls were hidden by people before
    assert (scene.labels[~is_person] == MOVED).mean() < 0.03
    assert scene.moved_share > 0.12
    rest = align_rest(reference, now, scene)
    assert rest is not None
    assert np.hypot(*rest[:2]) < 0.15  # as if the robot stood


_USUAL = ("12 people walk off", "lift")
_SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in SCENES if name not in _USUAL]


@pytest.mark.parametrize("name", [*cases(_USUAL, usual=_USUAL[:1]), *_SLOW])
def test_scene_that_moves_is_in_the_covariance(name: str) -> None:
    drive = SCENES[name](0)
    if name == "12 people walk off":  # within the first seconds
        drive = replace(drive, events=[e for e in drive.events if e.stamp_ns < drive.events[0].stamp_ns + 9_000_000_000])
    outcome = run(drive)
    assert not outcome.is_wrong, (outcome.least_consistent, outcome.warnings)
    if "people walk off" in name:
        assert MOVING_OBJECTS in outcome.pipeline.checks.found
        assert outcome.worst[0] < 0.1
        assert outcome.pipeline.checks.counts()["scans_with_moving_objects"] > 10
        assert deserialize(*serialize(outcome.pipeline.checks)).counts() == outcome.pipeline.checks.counts()


@pytest.mark.extended
def test_no_objects_are_reported_of_an_estimate_that_is_by_no_scans() -> None:
    """By wheels that nobody has calibrated, all of a still world moves."""
    outcome = run(in_room(2), without_gyro(multiply_wheels(0.5, 0.3, 0.6)), estimator="odometry")
    assert MOVING_OBJECTS not in outcome.pipeline.checks.found


@pytest.mark.extended
def test_pose_that_people_at_rest_have_moved_is_in_the_covariance() -> None:
    """The first scan after a rest fits .1 m elsewhere, before the wheels have moved by a centimetre: that is no slip."""
    outcome = run(SCENES["20 people edge away"](2))
    assert outcome.worst[0] > 0.1
    assert not outcome.is_wrong, outcome.least_consistent


@pytest.mark.extended
@pytest.mark.parametrize("has_gyro", cases([True, False], usual=["False"]))
def test_distance_from_the_wheels_stays_in_the_covariance_in_turns(has_gyro: bool) -> None:
    """A LiDAR with a wrong yaw agrees with wheels that turn in place; it is found later, on a straight way."""
    fault = turn_scans(90.0)
    outcome = run(in_room(2, seed=3), fault if has_gyro else without_gyro(fault))
    assert not outcome.is_wrong, outcome.least_consistent


@pytest.mark.extended
def test_crowd_that_overtakes_leaves_neither_error_nor_covariance() -> None:
    """The estimate is led back to the motion by the wheels, from where scans of the still world show the pose."""
    error, sigma = run(SCENES["crowd of 12 overtakes"](1)).last
    assert error < 0.05
    assert error < 3.0 * sigma
    assert sigma < 0.4


@pytest.mark.parametrize("kind", cases(KINDS[2:4], usual=[]) + cases([*KINDS[:2], KINDS[4]], usual=[], others=pytest.mark.slow))
def test_bare_corridor_has_slip_and_pushes_in_the_covariance(kind: str) -> None:
    outcome = run(in_corridor(kind, 1))
    is_large = outcome.errors > 0.1
    assert (outcome.errors < 3.0 * outcome.sigmas + 0.1)[is_large].all(), outcome.least_consistent
    assert any("m along a corridor by wheels alone, from t = 0 s" in warning for warning in outcome.warnings)
    assert outcome.last[1] < max(0.15 * 83.0, outcome.last[0])  # no more than a factor on the way by the wheels, and pushes


@pytest.mark.extended
@pytest.mark.parametrize(
    ("name", "fault", "most_m"),
    [
        ("half", multiply_wheels(0.5, 0.3, 0.6), 0.05),
        ("twice", multiply_wheels(2.0, 0.3, 0.6), 0.05),
        ("one side spins", without_gyro(named_faults()["right side spins 20 times"]), 0.3),
    ],
)
def test_wheels_that_slip_in_a_still_world_are_no_moving_objects(name: str, fault: EventFault, most_m: float) -> None:
    """Neither with a gyro nor without: the scans show where the robot goes on as it did."""
    outcome = run(in_room("side" in name), fault)
    assert MOVING_OBJECTS not in outcome.pipeline.checks.found
    assert outcome.worst[0] < most_m
    assert outcome.last[0] < 0.03
