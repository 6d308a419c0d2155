"""The filter: every derivative against differences, covariances that stay what they are called, and honesty over many seeds."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.stats import chi2

from localization.consistency import lag1_whiteness, mean_band
from localization.errors import EstimatorError
from localization.estimators.ekf import ANCHOR, BIAS, CLOCK, PARAMS, POSE, START, Ekf, EkfConfig
from localization.events import Scan, WheelSample
from localization.gyro import Turn
from localization.lidar import MapTie, Registration
from localization.residuals import motion_residual, turn_residual
from localization.synchronizer import Step, Synchronizer, steps
from motion_models import se2
from motion_models.base import Motion
from motion_models.corrections import corrections
from motion_models.registry import make_model
from motion_models.robot import load_robot
from tests import bags

S, T0 = bags.S, bags.START
ROBOT = load_robot("vaultbot")
GYRO = ROBOT.gyro_noise
MODEL = make_model("skid_steer", ROBOT)
CORRECTED = corrections(MODEL, "constant")
LIDAR = np.diag([0.004, 0.006, 0.002]) ** 2
POSES = st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3.1, 3.1)).map(np.array)


def scan_at(t):
    return Scan(T0 + round(t * S), np.ones((1, 3)))


def drive(seconds, turned, clock=0.0, params=None, hz=20.0):
    """Steps of 0.1 s from the stepper itself, for wheel angles ``turned(t)``."""
    cutter = Synchronizer(MODEL, ROBOT, {}, True)
    cutter.clock_offset_s = clock
    cutter.params = MODEL.nominal if params is None else params
    wheels = [
        WheelSample(T0 + round(i / hz * S), np.full(2, np.nan), np.array(turned(i / hz), float)) for i in range(round(seconds * hz) + 20)
    ]
    scans = [scan_at(0.525 + 0.1 * i) for i in range(round(10 * seconds))]
    return list(steps(sorted([*wheels, *scans], key=lambda e: e.stamp_ns), cutter))[1 : round(10 * seconds)]


def winding(t):
    """Both ways round, fast and slow: it shows the scaling of rotation and the clocks."""
    return 3.0 * t - 3.0 * math.sin(0.9 * t) + 0.5 * math.sin(2.3 * t), 3.0 * t + 3.0 * math.sin(0.9 * t) + 0.5 * math.sin(2.3 * t)


@functools.cache
def winding_steps(seconds):
    return tuple(drive(seconds, winding))


def standing(seconds):
    return drive(seconds, lambda t: (1.0, 1.0))


def step_of(delta, cov=None, duration=0.1, d_clock=None, is_standing=False):
    n = len(MODEL.param_names)
    motion = Motion(np.asarray(delta, float), np.diag([1e-4, 1e-4, 1e-4]) if cov is None else cov, np.zeros((3, n)))
    return Step(T0, T0 + round(duration * S), motion, np.zeros(3) if d_clock is None else d_clock, np.zeros(3), is_standing, True)


def filter_at(pose=None, config=None):
    return Ekf(GYRO, CORRECTED, config, pose)


# --- derivatives, on the manifold


def differences(f, pose, h=1e-6):
    """(3 or (), 3) central differences of ``f`` by the right perturbation of ``pose``."""
    return np.stack([(f(se2.compose(pose, se2.exp(h * e))) - f(se2.compose(pose, se2.exp(-h * e)))) / (2 * h) for e in np.eye(3)], axis=-1)


@given(POSES, POSES, st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1.5, 1.5)).map(np.array))
@settings(max_examples=60, deadline=None)
def test_motion_residual_has_exact_jacobians(a, b, off):
    measured = se2.compose(se2.between(a, b), se2.exp(off))
    error, d_a, d_b = motion_residual(a, b, measured)
    np.testing.assert_allclose(error, -off, atol=1e-9)
    np.testing.assert_allclose(d_a, differences(lambda p: motion_residual(p, b, measured)[0], a), rtol=1e-5, atol=2e-6)
    np.testing.assert_allclose(d_b, differences(lambda p: motion_residual(a, p, measured)[0], b), rtol=1e-5, atol=2e-6)


@given(POSES, POSES, st.floats(-0.5, 0.5), st.floats(0.01, 2.0))
@settings(max_examples=40, deadline=None)
def test_turn_residual_has_the_derivatives_that_it_says(a, b, bias, duration):
    angle = float(b[2] - a[2]) + bias * duration - 0.1
    f = functools.partial(turn_residual, angle=angle, bias=bias, duration=duration)
    assert f(a, b) == pytest.approx(0.1, abs=1e-9)
    np.testing.assert_allclose(differences(lambda p: np.array(f(a, p)), b), [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(differences(lambda p: np.array(f(p, b)), a), [0, 0, -1], atol=1e-6)
    by_bias = (turn_residual(a, b, angle, bias + 1e-6, duration) - turn_residual(a, b, angle, bias - 1e-6, duration)) / 2e-6
    assert by_bias == pytest.approx(duration, abs=1e-6)


def test_turns_across_the_half_circle_are_small():
    assert turn_residual(np.array([0, 0, 3.1]), np.array([0, 0, -3.1]), 2 * math.pi - 6.2, 0.0, 1.0) == pytest.approx(0.0, abs=1e-12)


def predicted_covariance(ekf, step, P):
    ekf.covariance[:] = P
    ekf.predict(step)
    return ekf.covariance


def test_prediction_moves_the_covariance_along_the_derivatives_of_the_steppers_own_motion():
    """F by differences: the error that a wrong pose, clock or parameter leaves after a step that the stepper cuts with it."""
    size, h = PARAMS + len(CORRECTED.names), 1e-5
    still = EkfConfig(clock_walk_s_per_sqrt_s=0.0)
    rng = np.random.default_rng(0)
    A = rng.normal(size=(size, size))
    P0 = A @ A.T
    for number in (3, 8, 14):
        pose = rng.normal(size=3)
        nominal = drive(2.0, winding)[number]

        def after(e, pose=pose, number=number):
            params = MODEL.nominal + CORRECTED.directions @ e[PARAMS:]
            delta = drive(2.0, winding, e[CLOCK], params)[number].predicted.delta if e[BIAS:].any() else nominal.predicted.delta  # noqa: B023
            return se2.compose(se2.compose(pose, se2.exp(e[POSE])), delta)

        F = np.eye(size)
        for i in [*range(3), CLOCK, *range(PARAMS, size)]:
            e = np.zeros(size)
            e[i] = h
            F[POSE, i] = se2.log(se2.between(after(-e), after(e))) / (2 * h)
        F[START, START], F[START, POSE] = np.zeros((3, 3)), np.eye(3)
        found = predicted_covariance(filter_at(pose, still), nominal, P0.copy())
        expected = F @ P0 @ F.T
        expected[POSE, POSE] += nominal.predicted.cov
        expected[BIAS, BIAS] += GYRO.bias_walk_rad_per_s_sqrt_s**2 * nominal.duration
        expected[PARAMS:, PARAMS:] += CORRECTED.walk_cov * nominal.duration
        np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4)


def least_squares(step, measured, turn, prior_sigma, iterations):
    """The same fusion of one step as least squares over [anchor = start, pose, bias], by differences alone, begun at the prediction."""
    bias_var = GYRO.bias_sigma_rad_per_s**2 + GYRO.bias_walk_rad_per_s_sqrt_s**2 * step.duration
    cov = block_diag(np.diag(prior_sigma**2), step.predicted.cov, measured.cov, turn.variance, bias_var)
    weights = np.linalg.cholesky(np.linalg.inv(cov)).T

    def residual(e, a, b, bias):
        a, b, bias = se2.compose(a, se2.exp(e[:3])), se2.compose(b, se2.exp(e[3:6])), bias + e[6]
        motion = se2.between(a, b)
        return weights @ np.concatenate(
            [
                se2.log(a),
                se2.log(se2.between(step.predicted.delta, motion)),
                se2.log(se2.between(measured.delta, motion)),
                [motion[2] + bias * turn.duration - turn.angle, bias],
            ]
        )

    a, b, bias = np.zeros(3), step.predicted.delta, 0.0
    for _ in range(iterations):
        r = residual(np.zeros(7), a, b, bias)
        J = np.stack([(residual(1e-6 * e, a, b, bias) - residual(-1e-6 * e, a, b, bias)) / 2e-6 for e in np.eye(7)], axis=-1)
        d = -np.linalg.solve(J.T @ J, J.T @ r)
        a, b, bias = se2.compose(a, se2.exp(d[:3])), se2.compose(b, se2.exp(d[3:6])), bias + d[6]
    return a, b, bias, np.linalg.inv(J.T @ J)


def one_step(scale):
    """The filter and both least squares on one step, all sigmas and all contradictions times ``scale``: the filter's distance to the
    optimum [sigmas], and of its covariance to that at the optimum and to that where the wheels' prediction is (relative)."""
    step = step_of([0.1, 0.01, 0.05], scale**2 * np.diag([4e-6, 2e-6, 9e-6]))
    off = se2.exp(scale * np.array([0.002, -0.001, 0.003]))
    measured = Motion(se2.compose(step.predicted.delta, off), scale**2 * np.diag([1e-6, 4e-6, 2e-6]))
    turn, prior = Turn(0.05 + scale * 0.003, scale**2 * 3e-6, 0.1), scale * np.array([0.05, 0.04, 0.03])
    ekf = filter_at()
    ekf.covariance[POSE, POSE] = np.diag(prior**2)
    ekf.set_anchor()
    ekf.predict(step)
    ekf.measure_turn(turn)
    ekf.measure_motion(measured, 1.0)
    a, b, bias, cov = least_squares(step, measured, turn, prior, 8)
    _, _, _, cov_before = least_squares(step, measured, turn, prior, 1)
    np.testing.assert_array_equal(ekf.anchor, ekf.start)
    error = np.concatenate([se2.log(se2.between(a, ekf.anchor)), se2.log(se2.between(b, ekf.pose)), [ekf.bias - bias]])
    found = ekf.covariance[np.ix_(np.r_[ANCHOR, POSE, BIAS], np.r_[ANCHOR, POSE, BIAS])]
    sigmas = np.sqrt(np.diag(cov))
    norm = np.outer(sigmas, sigmas)
    return np.abs(error / sigmas).max(), np.abs((found - cov) / norm).max(), np.abs((found - cov_before) / norm).max()


def test_one_step_of_all_witnesses_is_least_squares_to_first_order():
    """A filter linearises where the wheels predict, least squares at its optimum: what is left between them must vanish with the noise.

    The covariance is that of least squares linearised at the prediction; to that at the optimum its distance is of first order.
    """
    scales = np.array([1.0, 0.5, 0.25, 0.125])
    mean, at_optimum, at_prediction = np.array([one_step(scale) for scale in scales]).T
    assert mean.max() < 1e-3
    assert at_prediction.max() < 1e-5
    slope = np.polyfit(np.log(scales), np.log(at_optimum), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.1)
    assert at_optimum[0] < 0.01


# --- a covariance stays a covariance


def check_covariance(P):
    np.testing.assert_allclose(P, P.T, atol=1e-12 * np.abs(P).max())
    scale = np.sqrt(np.maximum(np.diag(P), 1e-300))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-9


def test_covariance_stays_one_over_thousands_of_random_steps():
    rng = np.random.default_rng(3)
    ekf, drives = filter_at(), winding_steps(20.0)
    for i in range(4000):
        kind = rng.integers(6)
        step = drives[i % len(drives)] if kind else step_of(np.zeros(3), np.zeros((3, 3)), is_standing=True)
        ekf.predict(step)
        if kind != 1:
            ekf.measure_turn(Turn(step.predicted.delta[2] + 0.01 * rng.normal(), 10.0 ** rng.uniform(-10, -2), step.duration))
        if step.is_standing:
            ekf.measure_standing()
        if kind > 2:
            noise = 10.0 ** rng.uniform(-4, 1, 3)
            measured = se2.compose(
                se2.between(ekf.anchor, ekf.pose), se2.exp(noise * rng.normal(size=3) * (1 if rng.random() < 0.95 else 30))
            )
            ekf.measure_motion(Motion(measured, np.diag(noise**2)), rng.random())
            ekf.set_anchor()
        if i % 20 == 0:
            check_covariance(ekf.covariance)
    assert np.isfinite(ekf.pose).all()
    check_covariance(ekf.covariance)


def test_drift_without_any_measurement_grows_as_dead_reckoning_says():
    ekf, cov = filter_at(config=EkfConfig(clock_sigma_s=0.0)), np.zeros((3, 3))
    ekf.covariance[PARAMS:, PARAMS:] = 0.0
    for step in winding_steps(10.0):
        quiet = dataclasses.replace(step, predicted=Motion(step.predicted.delta, step.predicted.cov, np.zeros((3, 11))))
        A = se2.adjoint(se2.inverse(step.predicted.delta))
        cov = A @ cov @ A.T + step.predicted.cov
        ekf.predict(quiet)
    np.testing.assert_allclose(ekf.covariance[POSE, POSE], cov, rtol=1e-9)


# --- standing still


def test_standing_freezes_the_pose_and_shows_the_gyros_bias():
    rng, bias = np.random.default_rng(5), 8e-4
    ekf = filter_at()
    for step in winding_steps(5.0):
        ekf.predict(step)
    before, wide = ekf.pose, ekf.covariance[POSE, POSE].copy()
    for step in standing(60.0):
        assert step.is_standing
        ekf.predict(step)
        ekf.measure_turn(
            Turn(
                bias * step.duration + GYRO.white_rad_per_sqrt_s * math.sqrt(step.duration) * rng.normal(),
                4e-6 * step.duration,
                step.duration,
            )
        )
        ekf.measure_standing()
    sigma = math.sqrt(ekf.covariance[BIAS, BIAS])
    assert abs(ekf.bias - bias) < 3.0 * sigma
    # 60 s of white noise leave 2e-3 / sqrt(60) = 2.6e-4 rad/s, the prior and the walk a little either way
    assert 1.5e-4 < sigma < 4e-4
    np.testing.assert_allclose(ekf.pose, before, atol=1e-3)
    # a robot that stands learns nothing of where it is, and forgets little
    assert np.linalg.eigvalsh(ekf.covariance[POSE, POSE] - 0.999 * wide).min() > -1e-6
    assert np.trace(ekf.covariance[POSE, POSE]) < 1.05 * np.trace(wide)


def test_standing_teaches_nothing_of_the_model():
    ekf = filter_at()
    before = ekf.covariance[PARAMS:, PARAMS:].copy()
    for step in standing(20.0):
        ekf.predict(step)
        ekf.measure_standing()
        ekf.measure_motion(Motion(np.array([1e-3, -1e-3, 1e-3]), LIDAR), 1.0)
        ekf.set_anchor()
    np.testing.assert_array_equal(ekf.covariance[PARAMS:, PARAMS:], before)
    assert not ekf.correction.any()


# --- witnesses that contradict each other


def test_a_wheel_that_slips_gives_way_to_a_lidar_that_is_sure():
    ekf = filter_at()
    ekf.set_anchor()
    ekf.predict(step_of([0.3, 0.0, 0.2], np.diag([1e-4, 1e-4, 1e-4])))
    seen = np.array([0.02, 0.0, 0.0])
    nis = ekf.measure_motion(Motion(seen, LIDAR), 1.0)
    assert nis > ekf.gate
    off = se2.log(se2.between(seen, ekf.pose))
    assert (np.abs(off) < 3.0 * np.sqrt(np.diag(LIDAR))).all()
    check_covariance(ekf.covariance)
    assert math.sqrt(ekf.covariance[0, 0]) < 0.01  # sure again, by the LiDAR


def test_a_lidar_that_is_lost_gives_way_to_wheels():
    ekf = filter_at()
    ekf.set_anchor()
    told, cov = np.array([0.1, 0.0, 0.02]), np.diag([1e-4, 1e-4, 1e-4])
    ekf.predict(step_of(told, cov))
    before = ekf.covariance[POSE, POSE].copy()
    nis = ekf.measure_motion(Motion(np.array([2.5, -1.0, 0.8]), LIDAR), 0.0)
    assert nis > ekf.gate
    off = se2.log(se2.between(told, ekf.pose))
    assert (np.abs(off) < 3.0 * np.sqrt(np.diag(before))).all()
    assert np.abs(off[:2]).max() < 0.02
    # and it has not become sure by it: the nonsense was given next to no weight
    assert np.trace(ekf.covariance[POSE, POSE]) > 0.9 * np.trace(before)


def test_inside_the_gate_both_count_alike():
    def run(trust):
        ekf = filter_at()
        ekf.set_anchor()
        ekf.predict(step_of([0.1, 0.0, 0.02]))
        nis = ekf.measure_motion(Motion(np.array([0.11, 0.005, 0.01]), LIDAR), trust)
        return nis, ekf

    nis, ekf = run(1.0)
    assert nis < ekf.gate
    _, other = run(0.0)
    np.testing.assert_array_equal(ekf.pose, other.pose)
    np.testing.assert_array_equal(ekf.covariance, other.covariance)


def contradicted(metres, trust):
    """A filter whose LiDAR says ``metres`` [m] more to the left than its wheels."""
    ekf = filter_at()
    ekf.set_anchor()
    ekf.predict(step_of([0.1, 0.0, 0.02], np.diag([4e-5, 4e-5, 4e-6])))
    told = ekf.pose
    nis = ekf.measure_motion(Motion(se2.compose(told, np.array([0.0, metres, 0.0])), LIDAR), trust)
    return nis, se2.between(told, ekf.pose), ekf.covariance[POSE, POSE]


@pytest.mark.parametrize("trust", [0.05, 0.3, 0.5, 0.9])
def test_who_contradicts_is_believed_by_as_much_as_is_known(trust):
    """Half a metre apart, which of both is right is all there is to know."""
    nis, off, cov = contradicted(0.5, trust)
    assert nis > 1000.0
    np.testing.assert_allclose(off, [0.0, 0.5 * trust, 0.0], atol=0.01)
    assert math.sqrt(cov[1, 1]) == pytest.approx(0.5 * math.sqrt(trust * (1.0 - trust)), rel=0.03)


@pytest.mark.parametrize("trust", [0.0, 0.3, 0.7, 1.0])
def test_no_edge_decides_between_two_places(trust):
    """Wherever the LiDAR says that the robot is, and whatever it is trusted, a hair's breadth changes little."""
    apart = np.linspace(0.01, 0.2, 400)
    found = np.array([contradicted(metres, trust)[1][1] for metres in apart])
    nis = contradicted(apart[0], trust)[0], contradicted(apart[-1], trust)[0]
    assert nis[0] < chi2.ppf(EkfConfig().gate_probability, 3) < nis[1]
    assert np.abs(np.diff(found)).max() < 4.0 * (apart[1] - apart[0])
    trusts = np.linspace(0.0, 1.0, 400)
    found = np.array([contradicted(0.1, t)[1][1] for t in trusts])
    assert np.abs(np.diff(found)).max() < 0.01
    assert (np.diff(found) > 0.0).all()


def test_how_far_a_scan_is_trusted_has_no_edge():
    def trust(n_matched, n_points):
        nothing = np.zeros((3, 3))
        return Registration(np.zeros(3), np.eye(3), n_points, n_matched, 0.0, MapTie(nothing, nothing, nothing), nothing).trust

    found = [trust(n, 1000) for n in range(1001)]
    assert (np.diff(found) > 0.0).all()
    assert np.max(np.diff(found)) < 0.01
    assert found[0] < 0.1 < 0.9 < found[500] < 0.99 < found[1000]
    assert trust(9, 9) < 0.5  # all of next to nothing


# --- what the motion does not show is not learned


def test_rotation_scaling_is_not_learned_by_driving_straight():
    rng = np.random.default_rng(2)
    ekf = filter_at()
    before = np.diag(ekf.covariance)[PARAMS:].copy()
    for step in drive(30.0, lambda t: (3.0 * t + math.sin(t), 3.0 * t + math.sin(t))):
        ekf.predict(step)
        ekf.measure_motion(Motion(se2.compose(step.predicted.delta, se2.exp(np.sqrt(np.diag(LIDAR)) * rng.normal(size=3))), LIDAR), 1.0)
        ekf.set_anchor()
        ekf.measure_turn(Turn(0.001 * rng.normal(), 4e-7, 0.1))
    assert not ekf.correction.any()
    assert (np.diag(ekf.covariance)[PARAMS:] >= before).all()


def test_what_was_learned_in_a_bend_does_not_drift_on_the_straight():
    rng = np.random.default_rng(4)
    ekf = filter_at()

    def go(found):
        for step in found:
            ekf.predict(step)
            ekf.measure_motion(Motion(se2.compose(step.predicted.delta, se2.exp(np.sqrt(np.diag(LIDAR)) * rng.normal(size=3))), LIDAR), 1.0)
            ekf.set_anchor()

    go(winding_steps(20.0))
    learned, sigma = ekf.correction.copy(), np.sqrt(np.diag(ekf.covariance)[PARAMS:])
    assert sigma[0] < 0.3 * CORRECTED.sigmas[0]
    go(drive(30.0, lambda t: (3.0 * t + math.sin(t), 3.0 * t + math.sin(t))))
    after = np.sqrt(np.diag(ekf.covariance)[PARAMS:])
    assert (after >= 0.98 * sigma).all()
    assert (np.abs(ekf.correction - learned) <= 0.25 * sigma).all()


# --- honest over many seeds


@dataclasses.dataclass
class World:
    """What the filter assumes, drawn: slip, clock, bias and corrections, all with their walks."""

    rng: np.random.Generator
    seconds: float = 15.0
    stand_s: float = 0.0

    def run(self):
        rng, ekf = self.rng, filter_at()
        pose = anchor = np.zeros(3)
        bias = GYRO.bias_sigma_rad_per_s * rng.normal()
        clock = ekf.config.clock_sigma_s * rng.normal()
        params = CORRECTED.sigmas * rng.normal(size=len(CORRECTED.names))
        nis, turns, innovations = [], [], []
        for step in winding_steps(self.seconds):
            dt = step.duration
            off = step.d_clock * (clock - ekf.clock_offset) + step.predicted.d_params @ CORRECTED.directions @ (params - ekf.correction)
            slip = rng.multivariate_normal(np.zeros(3), step.predicted.cov, method="cholesky")
            before, pose = pose, se2.compose(pose, se2.compose(step.predicted.delta, se2.exp(off + slip)))
            bias += GYRO.bias_walk_rad_per_s_sqrt_s * math.sqrt(dt) * rng.normal()
            clock += ekf.config.clock_walk_s_per_sqrt_s * math.sqrt(dt) * rng.normal()
            params = params + np.sqrt(np.diag(CORRECTED.walk_cov) * dt) * rng.normal(size=len(params))
            ekf.predict(step)
            angle = float(se2.between(before, pose)[2])
            variance = GYRO.white_rad_per_sqrt_s**2 * dt
            turns.append(ekf.measure_turn(Turn(angle + bias * dt + math.sqrt(variance) * rng.normal(), variance, dt)))
            seen = se2.compose(se2.between(anchor, pose), se2.exp(np.sqrt(np.diag(LIDAR)) * rng.normal(size=3)))
            innovations.append(se2.log(se2.between(se2.between(ekf.anchor, ekf.pose), seen)))
            nis.append(ekf.measure_motion(Motion(seen, LIDAR), 1.0))
            ekf.set_anchor()
            anchor = pose
        error = np.concatenate([se2.log(se2.between(ekf.pose, pose)), [bias - ekf.bias, clock - ekf.clock_offset], params - ekf.correction])
        return error, ekf.covariance, np.array(nis), np.array(turns), np.array(innovations)


SEEDS = 80


@pytest.fixture(scope="module")
def worlds():
    return [World(np.random.default_rng(100 + seed)).run() for seed in range(SEEDS)]


PARTS = {
    "pose": [0, 1, 2],
    "gyro bias": [BIAS],
    "clock": [CLOCK],
    "k": [PARAMS],
    "centre of rotation": [PARAMS + 1, PARAMS + 2],
    "all": [0, 1, 2, *range(BIAS, PARAMS + 3)],
}


@pytest.mark.parametrize("part", PARTS)
def test_nees_is_inside_its_band(worlds, part):
    """Every part of the state, at the end of 15 s, over independent seeds; 99.8 % band, so that six of them hold together."""
    of = np.array(PARTS[part])
    at = [i if i < 3 else 3 + i - BIAS for i in of]  # where the part stands in the vector of errors
    values = [error[at] @ np.linalg.solve(P[np.ix_(of, of)], error[at]) for error, P, *_ in worlds]
    low, high = mean_band(SEEDS, len(of), 0.998)
    assert low < np.mean(values) < high
    assert np.mean(np.array(values) < chi2.ppf(0.95, len(of))) > 0.85


def test_nis_is_inside_its_band(worlds):
    lidar, gyro = (np.concatenate([w[i] for w in worlds]) for i in (2, 3))
    for values, dof in ((lidar, 3), (gyro, 1)):
        low, high = mean_band(len(values), dof, 0.998)
        assert low < values.mean() < high
    assert np.mean(lidar > chi2.ppf(0.95, 3)) == pytest.approx(0.05, abs=0.012)


def test_what_is_learned_is_learned(worlds):
    """The covariance shrinks for a reason: what began at sigma is known several times better."""
    for index, sigma in ((CLOCK, 0.05), (PARAMS, CORRECTED.sigmas[0]), (PARAMS + 1, CORRECTED.sigmas[1])):
        assert np.mean([math.sqrt(P[index, index]) for _, P, *_ in worlds]) < 0.5 * sigma


def test_innovations_are_white(worlds):
    rhos = [lag1_whiteness(w[4], np.broadcast_to(np.cov(w[4].T), (len(w[4]), 3, 3))).lag1 for w in worlds]
    n = len(worlds[0][4])
    assert abs(np.mean(rhos)) < 4.0 / math.sqrt(3 * n * SEEDS) + 2.0 / n


# --- whatever comes


HOSTILE = st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 1e150, 0.0, 1e-300, -1.0, 0.1])


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_no_input_makes_the_state_non_finite(data):
    def draw(*shape):
        return np.array(data.draw(st.lists(HOSTILE, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))).reshape(shape)

    ekf = filter_at()
    for step in winding_steps(5.0)[:3]:
        ekf.predict(step)
    ekf.set_anchor()
    ekf.predict(winding_steps(5.0)[3])
    calls = {
        "motion": lambda: ekf.predict(step_of(draw(3))),
        "covariance": lambda: ekf.predict(step_of([0.1, 0, 0], np.diag(np.abs(draw(3))))),
        "clock": lambda: ekf.predict(step_of([0.1, 0, 0], d_clock=draw(3))),
        "turn": lambda: ekf.measure_turn(Turn(*np.abs(draw(3)).tolist())),
        "lidar": lambda: ekf.measure_motion(Motion(draw(3), np.diag(np.abs(draw(3)))), data.draw(st.floats(0.0, 1.0))),
    }
    for name in data.draw(st.lists(st.sampled_from(sorted(calls)), min_size=1, max_size=4)):
        with contextlib.suppress(EstimatorError):
            calls[name]()
        for part in (ekf.pose, ekf.start, ekf.anchor, ekf.covariance, ekf.correction, ekf.bias, ekf.clock_offset):
            assert np.isfinite(part).all()


def test_nan_is_told_with_its_moment():
    ekf = filter_at()
    with pytest.raises(EstimatorError, match=str(T0 + S // 10)):
        ekf.predict(step_of([np.nan, 0.0, 0.0]))
    with pytest.raises(EstimatorError, match="LiDAR"):
        ekf.measure_motion(Motion(np.array([0.0, np.nan, 0.0]), LIDAR), 1.0)
    with pytest.raises(EstimatorError, match="noise"):
        filter_at().measure_motion(Motion(np.zeros(3), np.zeros((3, 3))), 1.0)
