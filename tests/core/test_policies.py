"""Policies of the filter: what a step does not excite, and the slip within a sweep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from localization.core.filter import inflate, set_marginal
from localization.core.motion import FilterConfig, NoiseModel, initial_state
from localization.core.policies.clock_offset import clock_warnings, find_clocks_apart
from localization.core.policies.excitation import Excitation
from localization.core.policies.open_way import OpenWay
from localization.core.policies.outlier import PriorOutlier
from localization.core.policies.wheel_noise import WheelNoiseScale
from localization.events import Step
from localization.lidar import ScanMatch
from motion_models import se2
from motion_models.motion import Motion
from motion_models.online_calibration import make_corrections
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers import fault_drives
from tests.helpers.event_faults import jitter_scan_stamps

ROBOT = load_robot("vaultbot")
NOISE = NoiseModel(ROBOT.wheel_noise, ROBOT.gyro_noise, make_corrections(make_model("skid_steer", ROBOT), "constant"), FilterConfig())
STATE = initial_state(NOISE)


def step_of(delta, is_standing=False, has_wheels=True):
    """A step of 0.1 s."""
    delta = np.asarray(delta, float)
    return Step(0, 100_000_000, Motion(delta, 1e-4 * np.eye(3)), np.zeros(3), se2.log(delta) / 0.1, is_standing, has_wheels)


@pytest.mark.parametrize(("delta", "considers"), [([0.1, 0.0, 0.001], True), ([0.1, 0.0, 0.1], False), ([0.0, 0.0, 0.1], False)])
def test_excitation_of_nearly_straight_motion_considers_corrections(delta, considers):
    excitation = Excitation(0.4, 0.25)
    excitation.start_step(step_of(delta).predicted)
    assert ("corrections" in excitation.considered()) == considers
    assert {"map", "key"} <= excitation.considered()


def test_excitation_by_scan_that_leaves_the_way_open_considers_radius():
    excitation = Excitation(0.4, 0.25)
    state = inflate(STATE, "pose", np.diag([1e-4, 1e-4, 1e-4]))
    for way, is_considered in ((100.0, True), (1e-6, False)):
        assert ("radius" in excitation.considered_by_scan(state, np.diag([way, 1e-6, 1e-6]))) == is_considered
        assert ("radius" in excitation.considered()) == is_considered  # until the next scan


def test_wheel_noise_scale_is_of_driving_wheels_alone():
    noise = WheelNoiseScale()
    noise.value = 4.0
    np.testing.assert_allclose(noise.start_step(STATE, step_of([0.1, 0.0, 0.0])), 4e-4 * np.eye(3))
    for step in (step_of([0.0, 0.0, 0.0], is_standing=True), step_of([0.1, 0.0, 0.0], has_wheels=False)):
        np.testing.assert_allclose(noise.start_step(STATE, step), 1e-4 * np.eye(3))


@pytest.mark.extended
def test_sweep_slip_of_scans_whose_stamps_jitter_leads_nowhere():
    """Stamps 7 ms apart, of sweeps of 42 ms, give twists of 10 m/s, with which 250 of 512 poses were up to 0.38 m off at 0.03 m."""
    outcome = fault_drives.run(fault_drives.in_room(0, 1), jitter_scan_stamps(0.03, 7))
    assert not outcome.is_wrong
    assert outcome.worst[0] < 0.15


def test_prior_outlier_at_rest_takes_no_match_that_needs_it():
    """Wheels that stand count nothing wrongly; while they turn, the step is off by as much as the search was wide."""
    cov, outlier = np.diag([0.1, 0.1, 0.01]), PriorOutlier()
    match = ScanMatch(np.zeros(3), np.zeros(3), 1e-4 * np.eye(3), 1.0, cov)
    driven, resting = step_of([0.1, 0.0, 0.0]), replace(step_of([0.0, 0.0, 0.0], is_standing=True), rested_s=1.0)
    assert outlier.apply(resting, match, None)[0] is None
    assert outlier.has_scene_moved
    assert outlier.apply(resting, replace(match, outlier_cov=np.zeros((3, 3))), None)[0] is not None
    assert not outlier.has_scene_moved
    used, missed = outlier.apply(driven, match, None)
    assert used is match
    assert outlier.count == 1
    np.testing.assert_array_equal(missed, cov)


def test_prior_outlier_of_a_moved_robot_is_as_wide_as_its_motion():
    outlier, moved = PriorOutlier(), np.diag([9.0, 9.0, 2.0])
    np.testing.assert_array_equal(outlier.apply(step_of([0.0, 0.0, 0.0]), None, moved)[1], moved)
    assert not outlier.apply(step_of([0.0, 0.0, 0.0]), None, None)[1].any()


def test_open_way_covers_a_factor_that_lasts_and_pushes_in_simulated_drives():
    """The variance that the policy adds, summed over a stretch of 40 m, is that of the way's error over many drives with a factor and a
    push drawn for each; a scan that shows the way ends the stretch."""
    rng, n, policy = np.random.default_rng(0), 4000, OpenWay()
    driven = step_of([0.1, 0.0, 0.0])
    policy.cov(driven)
    policy.add_scan(np.diag([100.0, 1e-4, 1e-4]), driven)
    variance = sum(policy.cov(driven)[0, 0] for _ in range(400))
    errors = 40.0 * rng.normal(0.0, 1.0 / 9.0, n) + rng.normal(0.0, 4.0 / 3.0, n)
    assert variance == pytest.approx(np.mean(errors**2), rel=0.1)
    (warning,) = policy.warnings()
    assert "40 m along a corridor by wheels alone" in warning
    policy.add_scan(np.diag([1e-4, 1e-4, 1e-4]), driven)
    assert not policy.cov(driven).any()


def test_open_way_of_a_robot_at_rest_or_of_short_stretches_adds_nothing():
    policy, resting = OpenWay(), replace(step_of([0.0, 0.0, 0.0], is_standing=True), rested_s=1.0)
    policy.cov(resting)
    policy.add_scan(np.diag([100.0, 1e-4, 1e-4]), resting)
    assert not policy.cov(resting).any()
    policy.cov(step_of([0.1, 0.0, 0.0]))
    assert policy.warnings() == []


@pytest.mark.parametrize(
    ("offset_s", "sigma_s", "has_gyro", "has_lidar", "apart"),
    [
        (0.04, 1e-3, True, True, None),  # small
        (0.10, 3e-2, True, True, None),  # uncertain
        (-0.30, 1e-3, True, True, ("LiDAR", True)),  # of three sensors nothing shows whose clock it is
        (0.10, 1e-3, False, True, ("LiDAR", True)),  # a driver's latency
        (0.30, 1e-3, False, True, ("LiDAR", False)),
        (0.30, 1e-3, True, False, ("gyro", False)),
    ],
)
def test_clocks_apart_are_large_and_certain_and_latency_is_no_fault(offset_s, sigma_s, has_gyro, has_lidar, apart):
    state = set_marginal(STATE, "clock", np.array([offset_s]), np.array([[sigma_s**2]]))
    found = find_clocks_apart(state, has_gyro, has_lidar)
    assert (None if found is None else found[1:]) == apart
    warned = clock_warnings(found, has_gyro, has_lidar)
    assert len(warned) == (apart is not None and apart[1] and abs(offset_s) > 0.2)
    assert all(f"{abs(offset_s):.2f} s {'later' if offset_s > 0.0 else 'earlier'}" in warning for warning in warned)
