"""The graph in space: the covariance of what it smooths, positions, and keyframes that carry the poses between them."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from localization.core.measurements.position import predict_position_in_space
from localization.estimators.graph_in_space import SpaceKeyframes
from localization.estimators.keyframe_motion import PreintegratedMotion
from localization.estimators.pose_graph import GraphUpdate, GravityMeasurement, PoseGraph, PositionMeasurement
from localization.estimators.recorded_path import through_nodes
from localization.maps.keyframe_map import MeasuredMotion
from motion_models import se2, se3
from motion_models.groups import SE3
from motion_models.slope import GRAVITY

_PLANAR = [0, 1, 5]
_BETWEEN_SIGMAS = np.array([0.01, 0.01, 0.02, 0.004, 0.004, 0.003])
_WHEEL_SIGMAS, _GRAVITY_SIGMA, _BIAS_SIGMA = np.array([0.005, 0.005, 0.003]), 0.1, 0.2
_BY_CORRECTIONS = np.array([[0.0, 1.0], [0.1, 0.0], [0.5, 0.0]])
_CORRECTION_SIGMAS = np.array([0.05, 0.02])
_STEP = np.array([0.8, 0.05, 0.0, 0.0, 0.0, 0.6])
_FIRST_SIGMAS = np.array([1e-3, 1e-3, 1e-3, 1e-4])


def _drawn(rng: np.random.Generator) -> tuple[PoseGraph, np.ndarray]:
    """A drive around a hill with all that the graph measures, and its true poses."""
    bias, corrections = _BIAS_SIGMA * rng.normal(size=3), _CORRECTION_SIGMAS * rng.normal(size=2)
    x, y, z, yaw = _FIRST_SIGMAS * rng.normal(size=4)
    true = [se3.exp(np.array([x, y, z, 0.0, 0.0, yaw])) @ se3.exp(np.array([0.0, 0.0, 0.0, *(0.1 * rng.normal(size=2)), 0.0]))]
    graph = PoseGraph(SpaceKeyframes(_BIAS_SIGMA), np.diag(_CORRECTION_SIGMAS**2))
    graph.apply(GraphUpdate(np.eye(4)))
    for k in range(6):
        tangent = _STEP + np.array([0.0, 0.0, 0.02 * rng.normal(), *(0.05 * rng.normal(size=2)), 0.0])
        true.append(true[-1] @ se3.exp(tangent))
        delta = se3.exp(tangent)
        noise = _BETWEEN_SIGMAS * rng.normal(size=6)
        motion = MeasuredMotion.by_cov(k, k + 1, delta @ se3.exp(noise), np.diag(_BETWEEN_SIGMAS**2))
        planar = se2.exp(se3.log(delta)[_PLANAR])
        error = _BY_CORRECTIONS @ corrections + _WHEEL_SIGMAS * rng.normal(size=3)
        predicted = se2.compose(planar, se2.inverse(se2.exp(error)))
        wheels = PreintegratedMotion(predicted, np.diag(_WHEEL_SIGMAS**2), _BY_CORRECTIONS, np.zeros(2))
        force = GRAVITY * true[k][2, :3] + bias + _GRAVITY_SIGMA * rng.normal(size=3)
        gravity = GravityMeasurement(k, force, np.eye(3), _GRAVITY_SIGMA**2)
        graph.apply(GraphUpdate(graph.pose(k) @ motion.delta, wheels, motions=(motion,), gravities=(gravity,)))
    return graph, np.array(true)


_ENU_T_MAP, _POSITION_SIGMA, _LEVER_SIGMAS = np.array([300.0, -200.0, 40.0, 2.0]), 0.03, np.array([0.5, 0.5, 1.0])


def _with_positions(graph: PoseGraph, true: np.ndarray, rng: np.random.Generator) -> None:
    """Positions near each keyframe, of every second one without the height."""
    lever, positions = _LEVER_SIGMAS * rng.normal(size=3), []
    for k, pose in enumerate(true):
        offset, n = se3.exp(0.1 * rng.normal(size=6)), 3 - k % 2
        at = predict_position_in_space(_ENU_T_MAP, pose, offset, lever)[0] + _POSITION_SIGMA * rng.normal(size=3)
        positions.append(PositionMeasurement(k, offset, at[:n], _POSITION_SIGMA**2 * np.eye(n)))
    graph.apply(GraphUpdate(positions=tuple(positions), alignment=_ENU_T_MAP + np.array([0.5, -0.5, 0.5, 0.1])))


@pytest.mark.parametrize("has_positions", [False, True])
def test_smoothed_poses_in_space_err_as_their_covariances_have_it(has_positions):
    """Mean NEES of 15 drives: chi-square with 90 degrees of freedom is within 3.9 to 8.3 times 15 in 99 %."""
    rng, nees, sigmas = np.random.default_rng(4), [], []
    for _ in range(15):
        graph, true = _drawn(rng)
        if has_positions:
            _with_positions(graph, true, rng)
        found = graph.smooth()
        error = se3.local(found.poses[-1], true[-1])
        nees.append(error @ np.linalg.solve(found.covs[-1], error))
        sigmas.append(np.sqrt(found.covs[-1][2, 2]))
    assert 3.9 < np.mean(nees) < 8.3
    assert (np.mean(sigmas) < 0.05) == has_positions  # of the height: 0.04 for 0.06 m


@pytest.mark.extended
def test_loop_in_space_takes_off_drift_as_its_covariance_has_it():
    """Mean NEES of 15 drives as above; a keyframe that drift has moved by 2 m is back within millimetres."""
    rng, sigmas, nees = np.random.default_rng(7), np.array([2e-3, 2e-3, 2e-3, 3e-4, 3e-4, 3e-4]), []
    for _ in range(15):
        graph, true = _drawn(rng)
        before, delta = graph.smooth().relative_cov(0, 6), se3.inverse(true[0]) @ true[6]
        closed = MeasuredMotion.by_cov(0, 6, delta @ se3.exp(sigmas * rng.normal(size=6)), np.diag(sigmas**2), is_loop=True)
        graph.apply(GraphUpdate(motions=(closed,)))
        found = graph.smooth()
        error = se3.local(found.poses[-1], true[-1])
        nees.append(error @ np.linalg.solve(found.covs[-1], error))
        assert np.trace(found.relative_cov(0, 6)) < 0.1 * np.trace(before)
    assert 3.0 < np.mean(nees) < 8.3
    k, update = 3, graph.updates[3]
    off = MeasuredMotion(2, 3, update.motions[0].delta @ se3.exp(np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0])), np.eye(6))
    updates = [replace(update, motions=(off,)) if i == k else each for i, each in enumerate(graph.updates)]
    poses = PoseGraph(graph.keyframes, graph.prior_cov, updates=updates).smooth().poses
    assert np.linalg.norm(se3.local(poses[0], poses[6])[:3] - se3.log(delta)[:3]) < 0.02


def test_position_in_space_has_the_derivatives_of_differences():
    rng = np.random.default_rng(2)
    pose, offset, lever = se3.exp(rng.normal(size=6)), se3.exp(rng.normal(size=6)), rng.normal(size=3)
    _, *jacobians = predict_position_in_space(_ENU_T_MAP, pose, offset, lever)
    moves = (
        lambda d: predict_position_in_space(_ENU_T_MAP + d, pose, offset, lever)[0],
        lambda d: predict_position_in_space(_ENU_T_MAP, se3.retract(pose, d), offset, lever)[0],
        lambda d: predict_position_in_space(_ENU_T_MAP, pose, offset, lever + d)[0],
    )
    for move, jacobian in zip(moves, jacobians, strict=True):
        differences = [(move(1e-5 * row) - move(-1e-5 * row)) / 2e-5 for row in np.eye(jacobian.shape[1])]
        np.testing.assert_allclose(jacobian, np.transpose(differences), atol=1e-6)


def test_smoothed_poses_in_space_go_through_the_keyframes():
    odometry = [np.eye(4)]
    for _ in range(6):
        odometry.append(odometry[-1] @ se3.exp(0.2 * _STEP))
    shift = se3.exp(np.array([0.1, -0.2, 0.3, 0.02, 0.01, -0.05]))
    nodes = np.array([0, 3, 5])
    keys = np.array([odometry[0], odometry[3] @ shift, odometry[5] @ shift])
    covs = np.array([np.eye(6), 2.0 * np.eye(6), 3.0 * np.eye(6)])
    poses, spread = through_nodes(SE3, np.array(odometry), 0.1 * np.tile(np.eye(6), (7, 1, 1)), nodes, keys, covs)
    np.testing.assert_allclose(poses[nodes], keys, atol=1e-12)
    np.testing.assert_allclose(spread[nodes], covs, atol=1e-12)
    np.testing.assert_allclose(poses[6], keys[2] @ se3.exp(0.2 * _STEP), atol=1e-12)  # beyond the last one the odometry goes on
    ways = [np.linalg.norm(se3.local(a, b)) for a, b in itertools.pairwise(poses)]
    assert max(ways) < 0.2 * np.linalg.norm(_STEP) + 0.2
