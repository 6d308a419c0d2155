"""Predicted measurements and their Jacobians, against differences on the manifold."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.core.measurements.position import transform_point
from localization.core.measurements.relative_pose import motion_residual
from localization.core.measurements.scan import measure_scan
from localization.core.measurements.turn import measure_turn
from localization.core.state import Layout, State, Vector
from localization.events import Turn
from motion_models import se2
from motion_models.groups import SE2

POSES = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3.1, 3.1)).map(np.array)


def predict_turn(start, pose, turn, bias, scale):
    """What the gyro measures [rad], and its derivatives by pose (3,), start (3,), bias and scale."""
    groups = {"pose": SE2, "start": SE2, "gyro_bias": Vector(1), "gyro_scale": Vector(1)}
    means = dict(zip(groups, (pose, start, np.array([bias]), np.array([scale])), strict=True))
    found = measure_turn(State(Layout(groups), means, np.eye(8)), turn)
    by = found.jacobians
    return turn.angle - found.residual[0], by["pose"][0], by["start"][0], by["gyro_bias"][0, 0], by["gyro_scale"][0, 0]


def submap_residual(pose, measured):
    """Residual (3,) and its derivatives (3, 3) by the errors of pose and submap."""
    state = State(Layout({"pose": SE2, "map": Vector(3)}), {"pose": pose, "map": np.zeros(3)}, np.eye(6))
    found = measure_scan(state, measured, np.eye(3))
    return found.residual, found.jacobians["pose"], found.jacobians["map"]


def differences(f: Callable, pose: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Central differences of ``f`` by the right perturbation of ``pose``, last axis."""
    return np.stack([(f(se2.compose(pose, se2.exp(h * e))) - f(se2.compose(pose, se2.exp(-h * e)))) / (2 * h) for e in np.eye(3)], axis=-1)


@given(POSES, POSES, st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1.5, 1.5)).map(np.array))
@settings(max_examples=60, deadline=None)
def test_motion_residual_has_exact_jacobians(a, b, off):
    measured = se2.compose(se2.between(a, b), se2.exp(off))
    error, by_a, by_b = motion_residual(a, b, measured)
    np.testing.assert_allclose(error, -off, atol=1e-9)
    np.testing.assert_allclose(by_a, differences(lambda p: motion_residual(p, b, measured)[0], a), rtol=1e-5, atol=2e-6)
    np.testing.assert_allclose(by_b, differences(lambda p: motion_residual(a, p, measured)[0], b), rtol=1e-5, atol=2e-6)


def test_predict_turn_in_gap_counts_whole_turns():
    """Poses tell the turn but for whole circles."""
    value, _, _, _, by_scale = predict_turn(np.zeros(3), np.array([0.0, 0.0, 5.0 - 2.0 * math.pi]), Turn(5.12, 1.0, 10.0), 0.002, 0.02)
    assert value == pytest.approx(5.1 + 0.02)
    assert by_scale == pytest.approx(5.0)


@given(POSES, st.floats(-1.5, 1.5), st.floats(-0.5, 0.5), st.floats(-0.1, 0.1), st.floats(0.01, 2.0))
@settings(max_examples=60, deadline=None)
def test_predict_turn_has_exact_jacobians(a, angle, bias, scale, duration):
    b, turn = se2.compose(a, np.array([0.3, 0.1, angle])), Turn(0.0, 1.0, duration)
    value, by_now, by_start, by_bias, by_scale = predict_turn(a, b, turn, bias, scale)
    assert value == pytest.approx((1.0 + scale) * angle + bias * duration, abs=1e-9)
    np.testing.assert_allclose(by_now, differences(lambda p: np.array(predict_turn(a, p, turn, bias, scale)[0]), b), atol=1e-6)
    np.testing.assert_allclose(by_start, differences(lambda p: np.array(predict_turn(p, b, turn, bias, scale)[0]), a), atol=1e-6)
    h = 1e-6
    for by, less, more in ((by_bias, (bias - h, scale), (bias + h, scale)), (by_scale, (bias, scale - h), (bias, scale + h))):
        assert by == pytest.approx((predict_turn(a, b, turn, *more)[0] - predict_turn(a, b, turn, *less)[0]) / (2 * h), abs=1e-6)


def test_predict_turn_across_half_circle_is_small():
    turn = Turn(0.0, 1.0, 1.0)
    assert predict_turn(np.array([0, 0, 3.1]), np.array([0, 0, -3.1]), turn, 0.0, 0.0)[0] == pytest.approx(2 * math.pi - 6.2, abs=1e-12)


@given(POSES, st.tuples(st.floats(-3, 3), st.floats(-3, 3)).map(np.array))
@settings(max_examples=40, deadline=None)
def test_transform_point_has_exact_jacobians(pose, point):
    moved, by_pose, by_point = transform_point(pose, point)
    np.testing.assert_allclose(moved, se2.transform(pose, point), atol=1e-12)
    np.testing.assert_allclose(by_pose, differences(lambda p: transform_point(p, point)[0], pose), rtol=1e-5, atol=1e-5)
    ends = [[transform_point(pose, point + s * e)[0] for s in (1e-6, -1e-6)] for e in np.eye(2)]
    found = [(more - less) / 2e-6 for more, less in ends]
    np.testing.assert_allclose(by_point, np.array(found).T, atol=1e-6)


@given(POSES, *[st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).map(lambda e: 1e-4 * np.array(e))] * 3)
@settings(max_examples=40, deadline=None)
def test_submap_residual_equals_pose_less_map_less_noise(true, e_pose, e_map, noise):
    """An estimate that is off by e_pose, in a submap whose errors put the scan at e_map: true pose = estimate exp(e)."""
    estimate = se2.compose(true, se2.inverse(se2.exp(e_pose)))
    measured = se2.compose(true, se2.exp(-e_map - noise))
    innovation, by_pose, by_map = submap_residual(estimate, measured)
    np.testing.assert_allclose(innovation, by_pose @ e_pose + by_map @ e_map - noise, atol=1e-6)
