"""Pose in space: Jacobians of its measurements against differences, and the wheels' motion lifted into the body's plane."""

from __future__ import annotations

import numpy as np
import pytest

from localization.core.filter import propagate
from localization.core.measurements.scan import measure_scan
from localization.core.space import (
    SpaceConfig,
    initial_space_state,
    lifted_transition,
    measure_body_turn,
    measure_gravity,
    start_at,
)
from localization.core.state import State
from localization.events import BodyTurn, Gravity, Step
from motion_models import se3
from motion_models.motion import Motion
from motion_models.robot import GyroNoise
from motion_models.slope import GRAVITY

POSE = se3.exp(np.array([1.0, 2.0, 0.3, 0.1, -0.15, 2.0]))
DELTA = np.array([0.08, 0.01, 0.12])


def state_at(pose=POSE):
    made = initial_space_state(GyroNoise(), 0.01, SpaceConfig())
    start = pose @ se3.inverse(se3.lift(DELTA) @ se3.exp(np.array([0.0, 0.0, 0.0, 0.01, -0.02, 0.0])))
    return State(made.layout, {**made.means, "pose": pose, "start": start, "gyro_scale": np.array([0.01])}, made.P)


def moved(state, name, error):
    group = state.layout.groups[name]
    return State(state.layout, {**state.means, name: group.retract(state[name], error)}, state.P)


@pytest.mark.parametrize(
    ("measure", "atol"),
    [
        (lambda s: measure_body_turn(s, BodyTurn(np.array([0.01, -0.02, 0.12]), 1e-6, 0.1, np.zeros((1, 4)))), 2e-3),
        (lambda s: measure_gravity(s, Gravity(np.array([0.5, 1.0, 9.7]), 0.01)), 1e-5),
        (lambda s: measure_scan(s, POSE, np.eye(6)), 1e-5),
    ],
    ids=["turn", "gravity", "cloud"],
)
def test_measurement_in_space_has_the_jacobians_of_differences(measure, atol):
    """Of the turn to first order in the step's 0.12 rad. The mean of `map` is zero: its Jacobian is that of the pose, negative."""
    state = state_at()
    made, h = measure(state), 1e-5
    for name, H in made.jacobians.items():
        if name == "map":
            np.testing.assert_array_equal(H, -made.jacobians["pose"])
            continue
        for i, unit in enumerate(np.eye(H.shape[1])):
            change = measure(moved(state, name, h * unit)).residual - measure(moved(state, name, -h * unit)).residual
            np.testing.assert_allclose(-change / (2.0 * h), H[:, i], atol=atol)


def step_of(delta, cov=0.0, seconds=0.1, is_standing=False):
    motion = Motion(np.asarray(delta), cov * np.eye(3))
    return Step(0, round(seconds * 1e9), motion, np.zeros(3), np.zeros(3), is_standing, True)


def test_lifted_motion_goes_along_the_body():
    state = state_at()
    after = propagate(state, lifted_transition(state, step_of([0.5, 0.0, 0.0]), GyroNoise(), SpaceConfig()))
    np.testing.assert_allclose(after["pose"][:3, 3] - POSE[:3, 3], 0.5 * POSE[:3, 0], atol=1e-12)


def test_lifted_motion_whose_turn_is_measured_knows_its_arc():
    """A body that pitches by a over a way d ends a d / 2 higher or lower: the gyro's pitch shows the height, too."""
    state = state_at(np.eye(4))
    transition = lifted_transition(state, step_of([0.2, 0.0, 0.0]), GyroNoise(), SpaceConfig(terrain_m_per_sqrt_s=1e-4))
    Q, pitch = transition.noise["pose"], 0.05
    height = Q[2, 4] / Q[4, 4] * pitch
    arc = se3.exp(np.array([0.2, 0.0, 0.0, 0.0, pitch, 0.0]))
    error = se3.log(se3.inverse(transition.means["pose"]) @ arc)
    assert height == pytest.approx(error[2], abs=1e-4)
    assert abs(height) > 0.004


def test_gravity_that_the_pose_predicts_has_no_residual():
    state = state_at()
    np.testing.assert_allclose(measure_gravity(state, Gravity(GRAVITY * POSE[2, :3], 0.01)).residual, 0.0, atol=1e-12)


def test_start_in_space_has_the_planar_covariance_and_the_first_tilt():
    state = initial_space_state(GyroNoise(), 0.01, SpaceConfig())
    world = np.diag([1e-4, 4e-4, 9e-4, 1e-6, 1e-6, 1e-4])
    after = start_at(state, POSE[:3, 3], POSE[:3, :3], world)
    P, R = after.cov("pose"), POSE[:3, :3]
    np.testing.assert_allclose(R @ P[:3, :3] @ R.T, world[:3, :3], atol=1e-12)
    np.testing.assert_allclose(P[3:5, 3:5], state.cov("pose")[3:5, 3:5], atol=1e-12)
    np.testing.assert_array_equal(after["pose"], POSE)
