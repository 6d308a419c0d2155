"""The filter on any group: its laws on SE(2), SE(3) and vectors, against differences, filterpy and Monte Carlo."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from scipy.stats import chi2

from localization.core.filter import (
    Measurement,
    Transition,
    augment,
    clone,
    inflate,
    inflate_both,
    propagate,
    set_marginal,
    update,
)
from localization.core.measurements.scan import key_scan_transition, measure_scan
from localization.core.state import Layout, Perturbation, State, Vector
from localization.errors import EstimatorError
from localization.lidar import KeyScanError
from motion_models import se2
from motion_models.groups import SE2


def hat(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def series(angle):
    """sin(t) / t, (1 - cos(t)) / t^2, (t - sin(t)) / t^3."""
    if angle < 1e-4:
        return 1.0 - angle**2 / 6.0, 0.5 - angle**2 / 24.0, 1.0 / 6.0 - angle**2 / 120.0
    return math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3


@dataclass(frozen=True)
class SpatialPose:
    """SE(3) as matrices (4, 4); tangent vectors are [translation, rotation] (Barfoot 2017, ch. 7)."""

    dim = 6

    def compose(self, a, b):
        return a @ b

    def inverse(self, a):
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = a[:3, :3].T, -a[:3, :3].T @ a[:3, 3]
        return found

    def exp(self, tangent):
        W, (a, b, c) = hat(tangent[3:]), series(float(np.linalg.norm(tangent[3:])))
        found = np.eye(4)
        found[:3, :3] += a * W + b * W @ W
        found[:3, 3] = (np.eye(3) + b * W + c * W @ W) @ tangent[:3]
        return found

    def log(self, p):
        angle = math.acos(min(max(0.5 * (np.trace(p[:3, :3]) - 1.0), -1.0), 1.0))
        a, b, c = series(angle)
        skew = (p[:3, :3] - p[:3, :3].T) / (2.0 * a)
        V = np.eye(3) + b * skew + c * skew @ skew
        return np.concatenate([np.linalg.solve(V, p[:3, 3]), [skew[2, 1], skew[0, 2], skew[1, 0]]])

    def retract(self, a, tangent):
        return a @ self.exp(tangent)

    def local(self, a, b):
        return self.log(self.inverse(a) @ b)

    def adjoint(self, p):
        R, t = p[:3, :3], p[:3, 3]
        return np.block([[R, hat(t) @ R], [np.zeros((3, 3)), R]])


SE3 = SpatialPose()
GROUPS = [SE2, SE3, Vector(4)]
IDS = ["SE(2)", "SE(3)", "vector"]


def exp(group, tangent):
    return group.retract(np.eye(4) if group is SE3 else np.zeros(group.dim), tangent)


def random_element(group, rng, scale=1.0):
    return exp(group, scale * rng.normal(size=group.dim))


def random_cov(n, rng, scale=1e-3):
    A = rng.normal(size=(n, n))
    return scale**2 * (A @ A.T + 0.1 * np.eye(n))


def cross_cov(state, one, other):
    """Covariance of the errors of two variables."""
    return state.P[state.layout.rows[one], state.layout.rows[other]]


def random_state(group, rng, scale=1e-3):
    """A pose, its clone, and two numbers, with a full covariance."""
    groups = {"pose": group, "start": group, "bias": Vector(2)}
    means = {name: random_element(one, rng) for name, one in groups.items()}
    return State(Layout(groups), means, random_cov(2 * group.dim + 2, rng, scale))


def differences(group, function, at, h=1e-6):
    """(k, dim) derivative of the right perturbation of ``function`` (an element) by that of ``at``."""
    columns = []
    for i in range(group.dim):
        e = h * np.eye(group.dim)[i]
        ends = [function(group.retract(at, s * e)) for s in (-1.0, 1.0)]
        columns.append(group.local(ends[0], ends[1]) / (2.0 * h))
    return np.array(columns).T


@pytest.mark.parametrize("group", GROUPS, ids=IDS)
def test_group_laws_hold(group):
    rng = np.random.default_rng(0)
    a, b, t = random_element(group, rng), random_element(group, rng), 0.5 * rng.normal(size=group.dim)
    np.testing.assert_allclose(group.local(a, group.retract(a, t)), t, atol=1e-9)
    np.testing.assert_allclose(group.compose(group.inverse(a), group.compose(a, b)), b, atol=1e-9)
    left, right = group.retract(a, t), group.compose(exp(group, group.adjoint(a) @ t), a)
    np.testing.assert_allclose(left, right, atol=1e-9)


@pytest.mark.parametrize("group", GROUPS, ids=IDS)
def test_between_has_first_order_covariance(group):
    state = random_state(group, np.random.default_rng(1))
    delta, cov = state.between("start", "pose")

    def motion(start, end):
        return group.compose(group.inverse(start), end)

    np.testing.assert_allclose(delta, motion(state["start"], state["pose"]))
    by_end = differences(group, lambda end: motion(state["start"], end), state["pose"])
    by_start = differences(group, lambda start: motion(start, state["pose"]), state["start"])
    J = np.hstack([by_end, by_start])
    np.testing.assert_allclose(cov, J @ state.cov("pose", "start") @ J.T, rtol=1e-5, atol=1e-11)


@pytest.mark.parametrize("group", GROUPS, ids=IDS)
def test_propagate_by_motion_has_first_order_covariance(group):
    """e_pose' = Ad(delta^-1) e_pose for pose' = pose * delta."""
    rng = np.random.default_rng(2)
    state, delta, Q = random_state(group, rng), random_element(group, rng, 0.3), random_cov(group.dim, rng)
    A = group.adjoint(group.inverse(delta))
    moved = propagate(state, Transition({"pose": group.compose(state["pose"], delta)}, {("pose", "pose"): A}, {"pose": Q}))
    J = differences(group, lambda pose: group.compose(pose, delta), state["pose"])
    np.testing.assert_allclose(moved.cov("pose"), J @ state.cov("pose") @ J.T + Q, rtol=1e-5, atol=1e-11)
    np.testing.assert_allclose(cross_cov(moved, "pose", "bias"), J @ cross_cov(state, "pose", "bias"), rtol=1e-5, atol=1e-11)
    np.testing.assert_array_equal(moved.cov("start", "bias"), state.cov("start", "bias"))
    np.testing.assert_array_equal(moved["start"], state["start"])


@pytest.mark.parametrize("group", GROUPS, ids=IDS)
def test_update_equals_filterpy(group):
    rng = np.random.default_rng(3)
    state, R, n = random_state(group, rng), random_cov(2, rng), 2 * group.dim + 2
    H, residual = rng.normal(size=(2, n)), 1e-3 * rng.normal(size=2)
    other = KalmanFilter(n, 2)
    other.P, other.H, other.R = state.P.copy(), H, R
    other.update(residual)
    blocks = {name: H[:, rows] for name, rows in state.layout.rows.items()}
    after, innovation = update(state, Measurement(residual, blocks, R))
    np.testing.assert_allclose(after.P, other.P, rtol=1e-8, atol=1e-15)
    assert innovation.nis == pytest.approx(other.mahalanobis**2)
    for name, one in state.layout.groups.items():
        expected = one.retract(state[name], other.x.ravel()[state.layout.rows[name]])
        np.testing.assert_allclose(after[name], expected, atol=1e-12)


def test_update_with_considered_variable_equals_schmidt():
    """By his partitioned formulas (Schmidt 1966), and only for the call that asks for it."""
    rng = np.random.default_rng(4)
    state, R = random_state(SE3, rng), random_cov(3, rng)
    blocks = {"pose": rng.normal(size=(3, 6)), "bias": rng.normal(size=(3, 2))}
    measurement = Measurement(1e-3 * rng.normal(size=3), blocks, R)
    after, innovation = update(state, measurement, considered={"bias"})
    Hx, Hc = np.hstack([blocks["pose"], np.zeros((3, 6))]), blocks["bias"]
    P = state.cov("pose", "start", "bias")
    Pxx, Pxc, Pcc = P[:12, :12], P[:12, 12:], P[12:, 12:]
    S = Hx @ Pxx @ Hx.T + Hx @ Pxc @ Hc.T + Hc @ Pxc.T @ Hx.T + Hc @ Pcc @ Hc.T + R
    K = (Pxx @ Hx.T + Pxc @ Hc.T) @ np.linalg.inv(S)
    np.testing.assert_allclose(innovation.S, S, rtol=1e-9)
    np.testing.assert_allclose(after.cov("pose", "start"), Pxx - K @ (Hx @ Pxx + Hc @ Pxc.T), rtol=1e-7, atol=1e-14)
    np.testing.assert_allclose(after.P[:12, 12:], Pxc - K @ (Hx @ Pxc + Hc @ Pcc), rtol=1e-7, atol=1e-14)
    np.testing.assert_allclose(after.cov("bias"), Pcc, rtol=1e-12)
    np.testing.assert_array_equal(after["bias"], state["bias"])
    assert np.abs(update(after, measurement)[0]["bias"] - after["bias"]).max() > 0.0


@pytest.mark.parametrize("group", [SE2, SE3], ids=IDS[:2])
def test_update_relative_is_optimal_for_the_difference(group):
    """The information of the measurement adds up with that of pose less reference, as in a filter of the difference alone."""
    rng = np.random.default_rng(5)
    state, R, one = random_state(group, rng), random_cov(group.dim, rng), np.eye(group.dim)
    before = state.difference_cov("pose", "start")
    measurement = Measurement(np.zeros(group.dim), {"pose": one, "start": -one}, R, relative=("pose", "start"))
    after, _ = update(state, measurement, considered={"start", "bias"})
    expected = np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(R))
    np.testing.assert_allclose(after.difference_cov("pose", "start"), expected, rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize("group", [SE2, SE3], ids=IDS[:2])
def test_update_that_turns_a_pose_keeps_the_submaps_error_in_the_world(group):
    """exp(e_map) w = w exp(e_map') for an update that moves the mean by w; the error against the submap and that of "key" stay."""
    rng, one = np.random.default_rng(13), np.eye(group.dim)
    groups = {"pose": group, "map": Perturbation(group.dim, "pose"), "key": group}
    means = {**{name: random_element(group, rng) for name in groups}, "map": np.zeros(group.dim)}
    state = State(Layout(groups), means, random_cov(3 * group.dim, rng, 0.1))
    measurement = Measurement(0.2 * rng.normal(size=group.dim), {"pose": one, "map": -one}, 1e-4 * one, ("pose", "map"))
    still, _ = update(state, replace(measurement, residual=np.zeros(group.dim)), {"map", "key"})
    after, _ = update(state, measurement, {"map", "key"})
    w = group.compose(group.inverse(state["pose"]), after["pose"])
    identity = exp(group, np.zeros(group.dim))
    J = differences(group, lambda error: group.compose(group.inverse(w), group.compose(error, w)), identity)
    np.testing.assert_allclose(after.cov("map"), J @ still.cov("map") @ J.T, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(cross_cov(after, "map", "key"), J @ cross_cov(still, "map", "key"), rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(after.difference_cov("pose", "map"), still.difference_cov("pose", "map"), rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(after.cov("key"), still.cov("key"))


def bare_corridor(seed):
    """NEES of the pose after 40 steps of 1 m, 3 expected. The robot turns by noise that scans show; the way is the wheels' alone, and an
    error along it is that of the submap, too."""
    rng = np.random.default_rng(seed)
    state = State(Layout({"pose": SE2, "map": Perturbation(3, "pose")}), {"pose": np.zeros(3), "map": np.zeros(3)}, np.zeros((6, 6)))
    pose, drawn, delta = np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0])  # where it is, and how far the submap is off
    sigmas = ([0.01, 0.01, 0.02], [0.3, 0.0, 0.0], [10.0, 0.01, 0.002], [0.001, 0.001, 1e-4])
    wheels, way, scan, surfaces = (np.diag(each) ** 2 for each in sigmas)
    A = se2.adjoint(se2.inverse(delta))
    for _ in range(40):
        pose = se2.compose(pose, se2.retract(delta, np.sqrt(np.diag(wheels + way)) * rng.normal(size=3)))
        jacobians = {("pose", "pose"): A, ("map", "map"): A}
        state = propagate(state, Transition({"pose": se2.compose(state["pose"], delta)}, jacobians, {"pose": wheels}))
        state = inflate_both(state, ("pose", "map"), way)
        true = se2.compose(drawn, pose)
        along = se2.adjoint([0.0, 0.0, -true[2]])  # from the corridor's axes to the robot's
        measured = se2.retract(true, along @ (np.sqrt(np.diag(scan)) * rng.normal(size=3)))
        state, _ = update(state, measure_scan(state, measured, along @ scan @ along.T), {"map"})
        off = 0.1 * se2.local(drawn, se2.compose(state["pose"], se2.inverse(pose)))
        drawn = se2.compose(se2.retract(drawn, off), se2.exp(-se2.adjoint(pose) @ (np.sqrt(np.diag(surfaces)) * rng.normal(size=3))))
        state = propagate(state, key_scan_transition(state, KeyScanError(0.1, surfaces)))
    error = se2.local(state["pose"], pose)
    return float(error @ np.linalg.solve(state.cov("pose"), error))


def test_update_along_a_bare_corridor_has_consistent_covariance():
    """NEES of 25 drives, 3 expected; 47 where corrections of the heading turn the error along the corridor with the robot."""
    assert 2.0 < np.mean([bare_corridor(seed) for seed in range(25)]) < 6.0


def test_clone_is_the_variable_as_it_is():
    state = random_state(SE3, np.random.default_rng(6))
    for name in ("start", "key"):  # in place of an older one, and a new one
        cloned = clone(state, "pose", name)
        delta, cov = cloned.between(name, "pose")
        np.testing.assert_allclose(delta, np.eye(4), atol=1e-12)
        np.testing.assert_allclose(cov, 0.0, atol=1e-13)
        np.testing.assert_array_equal(cloned.cov("pose", "bias"), state.cov("pose", "bias"))
        np.testing.assert_array_equal(cross_cov(cloned, name, "bias"), cross_cov(state, "pose", "bias"))
    assert list(clone(state, "pose", "start").layout.groups) == ["pose", "start", "bias"]


def test_augment_inflate_and_set_marginal_change_their_own_rows():
    rng = np.random.default_rng(8)
    state, cov = random_state(SE2, rng), random_cov(2, rng)
    added = augment(state, "clock", Vector(2), np.ones(2), cov)
    np.testing.assert_array_equal(added.P[:8, :8], state.P)
    np.testing.assert_array_equal(added.cov("clock"), cov)
    np.testing.assert_array_equal(cross_cov(added, "clock", "pose"), np.zeros((2, 3)))
    np.testing.assert_allclose(inflate(state, "bias", cov).P - state.P, np.pad(cov, (6, 0)), atol=1e-15)
    both = inflate_both(state, ("pose", "start"), np.eye(3)).P - state.P
    np.testing.assert_allclose(both[:6, :6], np.tile(np.eye(3), (2, 2)), atol=1e-15)
    assert not both[6:].any()
    given = set_marginal(state, "bias", np.array([1.0, 2.0]), cov)
    np.testing.assert_array_equal(given["bias"], [1.0, 2.0])
    np.testing.assert_array_equal(given.cov("bias"), cov)
    np.testing.assert_array_equal(cross_cov(given, "pose", "bias"), np.zeros((3, 2)))
    np.testing.assert_array_equal(given.cov("pose", "start"), state.cov("pose", "start"))


def test_functions_leave_their_argument_unchanged():
    rng = np.random.default_rng(9)
    state = random_state(SE2, rng)
    P, means = state.P.copy(), {name: value.copy() for name, value in state.means.items()}
    propagate(state, Transition(noise={"pose": np.eye(3)}))
    update(state, Measurement(np.ones(3), {"pose": np.eye(3)}, np.eye(3)))
    clone(state, "pose", "start")
    inflate(state, "pose", np.eye(3))
    set_marginal(state, "pose", np.zeros(3), np.eye(3))
    np.testing.assert_array_equal(state.P, P)
    for name, value in means.items():
        np.testing.assert_array_equal(state[name], value)


def test_numbers_that_are_not_finite_are_refused_by_name():
    state = random_state(SE2, np.random.default_rng(10))
    with pytest.raises(EstimatorError, match="the wheels' motion has numbers"):
        propagate(state, Transition({"pose": np.full(3, np.nan)}, what="the wheels' motion"))
    with pytest.raises(EstimatorError, match="a fix has numbers"):
        update(state, Measurement(np.array([np.inf]), {"pose": np.ones((1, 3))}, np.eye(1), what="a fix"))


def drive(group, rng, steps=9):
    """NEES of pose and bias after a drive whose odometry adds an unknown bias, with poses relative to a clone and whole ones measured."""
    dim, ahead = group.dim, np.eye(group.dim)[:, :1]
    sigma_start, sigma_slip, sigma_relative, sigma_pose, sigma_bias = 0.03, 0.01, 0.007, 0.05, 0.02
    one = np.eye(dim)

    def moved(pose, *tangents):
        for tangent in tangents:
            pose = group.retract(pose, tangent)
        return pose

    def off(a, b):
        return group.local(a, b)

    truth, bias = random_element(group, rng), rng.normal(0.0, sigma_bias, 1)
    P = np.diag([*np.full(dim, sigma_start**2), sigma_bias**2])
    means = {"pose": moved(truth, sigma_start * rng.normal(size=dim)), "bias": np.zeros(1)}
    state, start = clone(State(Layout({"pose": group, "bias": Vector(1)}), means, P), "pose", "start"), truth
    for i in range(steps):
        way = np.concatenate([[0.3], 0.1 * np.sin(0.3 * i + np.arange(1, dim))])
        truth = moved(truth, way, ahead @ bias, sigma_slip * rng.normal(size=dim))
        pose = moved(state["pose"], way, ahead @ state["bias"])
        A = group.adjoint(group.compose(group.inverse(pose), state["pose"]))
        jacobians = {("pose", "pose"): A, ("pose", "bias"): ahead}
        state = propagate(state, Transition({"pose": pose}, jacobians, {"pose": sigma_slip**2 * one}))
        delta, _ = state.between("start", "pose")
        measured = moved(group.compose(group.inverse(start), truth), sigma_relative * rng.normal(size=dim))
        blocks = {"pose": one, "start": -group.adjoint(group.inverse(delta))}
        state, _ = update(state, Measurement(off(delta, measured), blocks, sigma_relative**2 * one))
        if i % 3 == 0:
            measured = moved(truth, sigma_pose * rng.normal(size=dim))
            state, _ = update(state, Measurement(off(state["pose"], measured), {"pose": one}, sigma_pose**2 * one))
            state, start = clone(state, "pose", "start"), truth
    error = np.concatenate([off(state["pose"], truth), bias - state["bias"]])
    return float(error @ np.linalg.solve(state.cov("pose", "bias"), error))


@pytest.mark.parametrize("group", [SE2, SE3], ids=IDS[:2])
def test_filter_is_consistent_over_many_drives(group):
    """Mean NEES of pose and bias, within the 99 % band of as many independent drives."""
    runs, n = 60, group.dim + 1
    found = [drive(group, np.random.default_rng(seed)) for seed in range(runs)]
    low, high = chi2.ppf([0.005, 0.995], runs * n) / runs
    assert low < np.mean(found) < high
