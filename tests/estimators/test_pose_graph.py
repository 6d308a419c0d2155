"""The pose graph on motions that are drawn, without sensors: Jacobians, loops, outliers, corrections, covariances, checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from localization.errors import EstimatorError
from localization.estimators import pose_graph
from localization.estimators.graph_in_plane import PlanarKeyframes
from localization.estimators.keyframe_motion import PreintegratedMotion
from localization.estimators.pose_graph import GraphUpdate, LivePoseGraph, PoseGraph, PositionMeasurement
from localization.evaluation.consistency import nees
from localization.maps.keyframe_map import MeasuredMotion
from localization.ros.state_serialization import deserialize, serialize
from motion_models import se2

COV = np.diag([0.02, 0.02, 0.01]) ** 2
LOOP_COV = np.diag([0.02, 0.02, 0.005]) ** 2
ARC = np.array([1.0, 0.0, 2.0 * math.pi / 20])
"""Twenty of them are a circle."""
NO_CORRECTIONS, KEYFRAMES = np.zeros((0, 0)), PlanarKeyframes()


def inverse(cov: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.inv(cov))


def circles(n: int, rng: np.random.Generator | None = None, scale: float = 1.0) -> tuple[LivePoseGraph, np.ndarray]:
    """Graph and truth (n, 3) of a drive along ``ARC``, with noise of ``scale`` times that which the graph is given; loops are not closed.
    After 40 keyframes it turns the other way."""
    graph, truth = LivePoseGraph(KEYFRAMES, NO_CORRECTIONS), [np.zeros(3)]
    graph.apply(GraphUpdate(truth[0]))
    for k in range(1, n):
        noise = np.zeros(3) if rng is None else scale * rng.multivariate_normal(np.zeros(3), COV)
        arc = ARC if k <= 40 else ARC * [1.0, 1.0, -1.0]
        measured = se2.compose(arc, se2.exp(noise))
        truth.append(se2.compose(truth[-1], arc))
        graph.apply(GraphUpdate(se2.compose(graph.pose(k - 1), measured), motions=(MeasuredMotion(k - 1, k, measured, inverse(COV)),)))
    return graph, np.array(truth)


def loop(truth: np.ndarray, a: int, b: int, error: np.ndarray) -> MeasuredMotion:
    return MeasuredMotion(a, b, se2.compose(se2.between(truth[a], truth[b]), se2.exp(error)), inverse(LOOP_COV), is_loop=True)


def distances(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.hypot(*(poses - truth)[:, :2].T)


def numeric_jacobians(
    factor: gtsam.CustomFactor, values: gtsam.Values, residual: Callable[[gtsam.Values], np.ndarray]
) -> dict[int, np.ndarray]:
    """By central differences of ``residual`` along each tangent direction of each key."""
    found, step = {}, 1e-6
    for key in list(factor.keys()):
        columns = []
        for unit in np.eye(values.dims()[key]):
            moved = []
            for sign in (step, -step):
                delta = gtsam.VectorValues()
                delta.insert(key, sign * unit)
                moved.append(residual(values.retract(delta)))
            columns.append((moved[0] - moved[1]) / (2.0 * step))
        found[key] = np.array(columns).T
    return found


def assert_jacobians_are_numeric(factor: gtsam.CustomFactor, values: gtsam.Values) -> None:
    """The noise has unit covariance and the residual is within Huber's linear part, so that the linear factor is not weighed."""
    residual = factor.unwhitenedError
    assert 0.01 < np.linalg.norm(residual(values)) < 1.0
    A, b = factor.linearize(values).jacobian()
    np.testing.assert_allclose(b, -residual(values), atol=1e-12)
    numeric = numeric_jacobians(factor, values, residual)
    np.testing.assert_allclose(A, np.hstack([numeric[key] for key in list(factor.keys())]), atol=1e-7)


# --- Jacobians


@pytest.mark.parametrize("seed", range(2))
def test_wheel_factor_has_numeric_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wheels = PreintegratedMotion(rng.normal(size=3), np.eye(3), rng.normal(size=(3, 2)), 0.1 * rng.normal(size=2))
    factor = KEYFRAMES.wheels(gtsam.symbol("x", 0), gtsam.symbol("x", 1), gtsam.symbol("c", 0), wheels)
    start, values = 5.0 * rng.normal(size=3), gtsam.Values()
    values.insert(gtsam.symbol("x", 0), gtsam.Pose2(*start))
    values.insert(gtsam.symbol("x", 1), gtsam.Pose2(*se2.compose(start, se2.compose(wheels.delta, 0.1 * rng.normal(size=3)))))
    values.insert(gtsam.symbol("c", 0), wheels.at + 0.1 * rng.normal(size=2))
    assert_jacobians_are_numeric(factor, values)


@pytest.mark.parametrize("seed", range(2))
def test_position_factor_has_numeric_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    enu_T_map, pose, offset, lever = 5.0 * rng.normal(size=3), 5.0 * rng.normal(size=3), rng.normal(size=3), rng.normal(size=2)
    antenna = se2.transform(se2.compose(enu_T_map, se2.compose(pose, offset)), lever)
    factor = KEYFRAMES.position(PositionMeasurement(3, offset, antenna + np.array([0.2, -0.3]), np.eye(2)))
    values = gtsam.Values()
    values.insert(gtsam.symbol("t", 0), gtsam.Pose2(*enu_T_map))
    values.insert(gtsam.symbol("x", 3), gtsam.Pose2(*pose))
    values.insert(gtsam.symbol("l", 0), lever)
    assert_jacobians_are_numeric(factor, values)


# --- solutions


def test_levenberg_marquardt_where_gauss_newton_diverges_converges() -> None:
    """atan(x): undamped steps from beyond 1.39 lead ever farther away."""
    key, factors, values = gtsam.symbol("c", 0), gtsam.NonlinearFactorGraph(), gtsam.Values()

    def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[np.ndarray] | None) -> np.ndarray:
        x = values.atVector(key)
        if H is not None:
            H[0] = np.asfortranarray([1.0 / (1.0 + x**2)])
        return np.arctan(x)

    factors.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [key], error))
    values.insert(key, np.array([2.0]))
    undamped = values.retract(factors.linearize(values).optimize())
    assert factors.error(undamped) > factors.error(values)
    found = pose_graph.levenberg_marquardt(factors, values)
    assert abs(found.atVector(key)[0]) < 1e-3


def test_smooth_of_motions_that_leave_the_way_open_has_the_propagated_covariance() -> None:
    """Sigmas of 30 m along a corridor and of 1 mm across it: of the factors' condition number, 4e6, Cholesky's have the square."""
    graph, cov = PoseGraph(KEYFRAMES, NO_CORRECTIONS), np.zeros((3, 3))
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(0.3)
    open_way = turn @ np.diag([1e-3, 1e6, 1e6]) @ turn.T
    A = se2.adjoint(se2.inverse(ARC))
    graph.apply(GraphUpdate(np.zeros(3)))
    for k in range(1, 30):
        graph.apply(GraphUpdate(se2.compose(graph.pose(k - 1), ARC), motions=(MeasuredMotion(k - 1, k, ARC, open_way),)))
        cov = A @ cov @ A.T + turn @ np.diag([1e3, 1e-6, 1e-6]) @ turn.T
    found, scale = graph.smooth().covs[-1], np.sqrt(np.diag(cov))
    np.testing.assert_allclose(found / np.outer(scale, scale), cov / np.outer(scale, scale), atol=1e-3)


def test_pose_graph_with_loop_spreads_the_drift() -> None:
    graph, truth = circles(41, np.random.default_rng(1))
    before = distances(graph.poses(), truth)
    sigma = np.sqrt(np.trace(graph.marginal(40)[:2, :2]))
    graph.apply(GraphUpdate(motions=(loop(truth, 0, 40, np.zeros(3)), loop(truth, 1, 39, np.zeros(3)))))
    live = distances(graph.poses(), truth)
    assert before[-1] > 0.1
    assert live[-1] < 0.3 * before[-1]
    live_sigma = np.sqrt(np.trace(graph.marginal(40)[:2, :2]))
    smoothed = graph.smooth()
    poses, covs = smoothed.poses, smoothed.covs
    assert live_sigma == pytest.approx(np.sqrt(np.trace(covs[40][:2, :2])), rel=0.25)  # loops' weights are those of closed loops
    assert live_sigma < 0.3 * sigma
    assert poses.shape == (41, 3)
    assert covs.shape == (41, 3, 3)
    assert distances(poses, truth)[-1] < 0.3 * before[-1]


def test_pose_graph_with_wrong_loop_keeps_poses() -> None:
    graph, truth = circles(41, np.random.default_rng(2))
    right = tuple(loop(truth, k, k + 20, np.zeros(3)) for k in range(10, 20))
    graph.apply(GraphUpdate(motions=right))
    alone = graph.smooth().poses
    graph.apply(GraphUpdate(motions=(loop(truth, 5, 30, np.array([4.0, -2.0, 0.5])),)))
    assert distances(graph.smooth().poses, alone).max() < 0.02


def test_pose_graph_on_turns_estimates_corrections() -> None:
    """Wheels turn by a tenth more than they say; k is a factor of turns, known to a tenth at first."""
    graph, pose = LivePoseGraph(KEYFRAMES, np.diag([0.1, 0.02]) ** 2), np.zeros(3)
    graph.apply(GraphUpdate(pose))
    by = np.column_stack([[0.0, 0.0, ARC[2]], [1.0, 0.0, 0.0]])
    said = ARC * [1.0, 1.0, 1.0 / 1.1]
    rng, wheel_cov = np.random.default_rng(3), np.diag([0.01, 0.01, 0.01]) ** 2
    for k in range(1, 61):
        measured = se2.compose(ARC, se2.exp(rng.multivariate_normal(np.zeros(3), COV)))
        wheels = PreintegratedMotion(said, wheel_cov, by / 1.1, np.zeros(2))
        walk = 1e-8 * np.eye(2) if k in (20, 40) else None
        pose = se2.compose(graph.pose(k - 1), measured)
        graph.apply(GraphUpdate(pose, wheels, walk, (MeasuredMotion(k - 1, k, measured, inverse(COV)),)))
    mean, cov = graph.corrections()
    sigma = np.sqrt(np.diag(cov))
    assert sigma[0] < 0.02
    assert abs(mean[0] - 0.1) < 3.0 * sigma[0]
    assert abs(mean[1]) < 3.0 * sigma[1]
    graph.smooth()
    assert graph.corrections()[0] == pytest.approx(mean, abs=0.2 * sigma.min())


@pytest.mark.extended
@pytest.mark.parametrize("is_smoothed", [False, True])
def test_pose_graph_over_fifty_drives_has_consistent_nees(is_smoothed: bool) -> None:
    """Of one pose of each drive, after loops: independent, so that their sum has 3 x 50 degrees of freedom. Cauchy's loss counts right
    loops as less than they are, so that covariances may be too wide: by half at most."""
    found = []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        graph, truth = circles(31, rng)
        ends = [(a, a + 20, rng.multivariate_normal(np.zeros(3), LOOP_COV)) for a in (2, 5, 8)]
        graph.apply(GraphUpdate(motions=tuple(loop(truth, *end) for end in ends)))
        smoothed = graph.smooth() if is_smoothed else None
        pose, cov = (graph.pose(30), graph.marginal(30)) if smoothed is None else (smoothed.poses[30], smoothed.covs[30])
        found.append(nees(se2.log(se2.between(truth[30], pose))[None], cov[None])[0])
    assert 1.5 < np.mean(found) < chi2.ppf(0.995, 150) / 50


# --- positions


def with_positions(
    outlier_m: float = 0.0, lever: np.ndarray | None = None, given: np.ndarray | None = None
) -> tuple[LivePoseGraph, np.ndarray, np.ndarray]:
    """Drifting odometry with a fix at each keyframe, turned and moved against the map. Returns graph, truth, and the alignment."""
    rng, enu_T_map = np.random.default_rng(4), np.array([100.0, -50.0, 0.7])
    lever = np.zeros(2) if lever is None else lever
    graph, truth = circles(61, rng, scale=3.0)
    graph = LivePoseGraph(KEYFRAMES, NO_CORRECTIONS, np.zeros(3) if given is None else np.append(given, 0.0), graph.updates)
    fixes = se2.transform(se2.compose(enu_T_map, truth), lever) + rng.normal(0.0, 0.1, (61, 2))
    fixes[30, 0] += outlier_m
    found = tuple(PositionMeasurement(k, np.zeros(3), fixes[k], 0.01 * np.eye(2)) for k in range(61))
    graph.apply(GraphUpdate(positions=found, alignment=enu_T_map + np.array([0.5, -0.5, 0.05])))
    return graph, truth, enu_T_map


def test_pose_graph_with_positions_reduces_drift() -> None:
    alone, truth = circles(61, np.random.default_rng(4), scale=3.0)
    graph = with_positions()[0]
    before, after = distances(alone.poses(), truth).max(), distances(graph.smooth().poses, truth).max()
    assert before > 0.5
    assert after < 0.5 * before


def test_graph_with_outlier_position_keeps_poses() -> None:
    poses, spoilt = (with_positions(outlier)[0].smooth().poses for outlier in (0.0, 50.0))
    assert distances(poses, spoilt).max() < 0.1


def test_position_errors_are_in_sigmas_without_robust_weight() -> None:
    """Fixes have a sigma of 0.1 m."""
    errors = with_positions(50.0)[0].position_errors()
    assert errors[30] == pytest.approx(500.0, rel=0.01)
    assert np.delete(errors, 30).max() < 5.0


@pytest.mark.parametrize("given", [np.zeros(2), np.array([0.4, -0.3])])
def test_pose_graph_with_positions_estimates_lever_arm(given: np.ndarray) -> None:
    """Turning tells it from the alignment."""
    lever = np.array([0.4, -0.3])
    graph = with_positions(lever=lever, given=given)[0]
    graph.smooth()
    mean, cov = graph.lever_arm()
    assert mean == pytest.approx(lever, abs=0.1)
    assert (np.abs(mean - lever) < 4.0 * np.sqrt(np.diag(cov))).all()
    assert np.sqrt(np.diag(cov)).max() < 0.1


def test_pose_graph_with_a_way_that_nothing_measures_raises_estimator_error() -> None:
    graph, no_way = circles(5)[0], MeasuredMotion(4, 5, ARC, np.diag([0.0, 1.0, 1.0]))
    updates = [*graph.updates, GraphUpdate(np.array([1.0, 2.0, 0.0]), motions=(no_way,))]
    with pytest.raises(EstimatorError, match="cannot be solved"):
        graph.apply(updates[-1])
    with pytest.raises(EstimatorError, match="cannot be solved"):
        PoseGraph(KEYFRAMES, NO_CORRECTIONS, updates=updates).smooth()


# --- checkpoints


def test_pose_graph_deserialized_equals_original_bitwise() -> None:
    graph, truth = circles(30, np.random.default_rng(5))
    graph.apply(GraphUpdate(motions=(loop(truth, 2, 22, np.zeros(3)),)))
    resumed = deserialize(*serialize(graph))
    for one in (graph, resumed):
        one.apply(GraphUpdate(se2.compose(one.pose(29), ARC), motions=(MeasuredMotion(29, 30, ARC, inverse(COV)),)))
        one.apply(GraphUpdate(motions=(loop(truth, 5, 25, np.zeros(3)),)))
    assert np.array_equal(graph.poses(), resumed.poses())
    assert np.array_equal(graph.marginal(30), resumed.marginal(30))
    one, other = graph.smooth(), resumed.smooth()
    assert np.array_equal(one.poses, other.poses)
    assert np.array_equal(one.covs, other.covs)
