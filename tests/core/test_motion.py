"""The filter on wheels, gyro and scans: prediction and updates against differences, textbook formulas and Monte Carlo, over many seeds."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from localization.core.filter import clone, inflate, propagate, update
from localization.core.measurements.scan import key_scan_transition, measure_scan
from localization.core.measurements.turn import measure_turn
from localization.core.motion import FilterConfig, NoiseModel, initial_state, wheel_transition
from localization.core.policies import wheel_noise
from localization.core.policies.excitation import Excitation
from localization.core.policies.wheel_noise import WheelNoiseScale
from localization.errors import EstimatorError
from localization.evaluation.consistency import mean_band
from localization.events import Scan, Step, Turn, WheelSample
from localization.inputs.synchronizer import Synchronizer
from localization.lidar import KeyScanError
from motion_models import se2
from motion_models.motion import Motion
from motion_models.online_calibration import make_corrections
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.steps import steps

S, T0 = bags.S, bags.START
ROBOT = load_robot("vaultbot")
GYRO = ROBOT.gyro_noise
MODEL = make_model("skid_steer", ROBOT)
CORRECTED = make_corrections(MODEL, "constant")
LIDAR = np.diag([0.004, 0.006, 0.002]) ** 2
ROWS = initial_state(NoiseModel(WheelNoise(), GYRO, CORRECTED, FilterConfig())).layout.rows
POSE, START, MAP, KEY = (ROWS[name] for name in ("pose", "start", "map", "key"))
BIAS, SCALE, CLOCK, RADIUS, PARAMS = (ROWS[name].start for name in ("gyro_bias", "gyro_scale", "clock", "radius", "corrections"))


class Chain:
    """The equations of a step one by one, as `EkfFusion` chains them."""

    def __init__(self, config):
        self.config = config
        self.state = initial_state(NoiseModel(WheelNoise(), GYRO, CORRECTED, config))
        self.noise, self.excitation = WheelNoiseScale(), Excitation(ROBOT.geometry.track_width_m, CORRECTED.min_track_over_radius)
        at_rest = Step(0, 1, Motion(np.zeros(3), NOTHING), np.zeros(3), np.zeros(3), True, True)
        self.noise.start_step(self.state, at_rest)

    def predict(self, step, is_turning=True):
        motion = dataclasses.replace(step.predicted, cov=self.noise.start_step(self.state, step))
        self.excitation.is_turning = is_turning
        state = clone(self.state, "pose", "start")
        self.state = propagate(state, wheel_transition(state, step, motion, NoiseModel(WheelNoise(), GYRO, CORRECTED, self.config)))

    def _update(self, measurement, considered):
        self.state, innovation = update(self.state, measurement, considered)
        self.noise.learn(innovation)
        return innovation.nis

    def update_turn(self, turn):
        return self._update(measure_turn(self.state, turn), self.excitation.considered())

    def update_scan(self, measured, R, outlier_cov):
        state = inflate(self.state, "pose", outlier_cov)
        before, self.state = self.state, state
        try:
            return self._update(measure_scan(state, measured, R), self.excitation.considered_by_scan(state, R))
        except EstimatorError:
            self.state = before
            raise

    def insert_key_scan(self, error):
        self.state = propagate(self.state, key_scan_transition(self.state, error))

    def start_key(self):
        self.state = clone(self.state, "pose", "key")

    @property
    def P(self):
        return self.state.P

    @P.setter
    def P(self, value):
        self.state = dataclasses.replace(self.state, P=value)

    def set(self, **means):
        self.state = dataclasses.replace(self.state, means={**self.state.means, **means})

    def __getitem__(self, name):
        return self.state[name]


def scan_at(t):
    return Scan(T0 + round(t * S), np.ones((1, 3)))


def drive(seconds, turned, clock=0.0, params=None, hz=20.0):
    """Steps of 0.1 s from the stepper itself, for wheel angles ``turned(t)``."""
    cutter = Synchronizer(MODEL, ROBOT, {}, True)
    cutter.feed_back(MODEL.nominal if params is None else params, clock)
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
    """A filter whose pose is known exactly, at ``pose`` (3,)."""
    found = Chain(config or FilterConfig())
    if pose is not None:
        found.set(pose=np.asarray(pose, float))
    return found


NOTHING = np.zeros((3, 3))
SIZE = PARAMS + len(CORRECTED.names)


def random_covariance(rng, scale=1e-3):
    A = rng.normal(size=(SIZE, SIZE))
    return scale**2 * A @ A.T


# --- prediction


def test_predict_propagates_covariance_by_motion_derivatives():
    """F by differences: the error that a wrong pose, clock or parameter leaves after a step that the synchronizer cuts with it."""
    h, config = 1e-5, FilterConfig(clock_walk_s_per_sqrt_s=0.0)
    rng = np.random.default_rng(0)
    P0 = random_covariance(rng, 1.0)
    for number in (3, 8, 14):
        pose = rng.normal(size=3)
        nominal = drive(2.0, winding)[number]
        back = se2.inverse(nominal.predicted.delta)

        def after(e, pose=pose, number=number, nominal=nominal):
            params = MODEL.nominal + CORRECTED.directions @ e[PARAMS:]
            delta = drive(2.0, winding, e[CLOCK], params)[number].predicted.delta if e[BIAS:].any() else nominal.predicted.delta
            return se2.compose(se2.compose(pose, se2.exp(e[POSE])), delta * [1.0 + e[RADIUS], 1.0 + e[RADIUS], 1.0])

        F = np.eye(SIZE)
        for i in [*range(3), CLOCK, RADIUS, *range(PARAMS, SIZE)]:
            e = np.zeros(SIZE)
            e[i] = h
            F[POSE, i] = se2.log(se2.between(after(-e), after(e))) / (2 * h)
        for i in range(3):  # the submap's error, carried along with the body
            moved = [se2.log(se2.compose(se2.compose(back, se2.exp(s * h * np.eye(3)[i])), se2.inverse(back))) for s in (1.0, -1.0)]
            F[MAP, MAP.start + i] = (moved[0] - moved[1]) / (2 * h)
        F[START, START], F[START, POSE] = np.zeros((3, 3)), np.eye(3)
        ekf = filter_at(pose, config)
        ekf.P = P0.copy()
        ekf.predict(nominal)
        expected = F @ P0 @ F.T
        expected[POSE, POSE] += nominal.predicted.cov
        expected[BIAS, BIAS] += GYRO.bias_walk_rad_per_s_sqrt_s**2 * nominal.duration
        expected[RADIUS, RADIUS] += config.wheel_radius_sigma**2 / 3600.0 * nominal.duration
        expected[PARAMS:, PARAMS:] += CORRECTED.process_noise * nominal.duration
        np.testing.assert_allclose(ekf.P, expected, rtol=2e-4, atol=2e-4)
        np.testing.assert_allclose(ekf["pose"], se2.compose(pose, nominal.predicted.delta))
        np.testing.assert_array_equal(ekf["start"], pose)


def test_predict_without_updates_equals_dead_reckoning():
    ekf, cov = filter_at(config=FilterConfig(clock_sigma_s=0.0, wheel_radius_sigma=0.0)), np.zeros((3, 3))
    ekf.P[PARAMS:, PARAMS:] = 0.0
    for step in winding_steps(10.0):
        quiet = dataclasses.replace(step, predicted=Motion(step.predicted.delta, step.predicted.cov, np.zeros((3, 11))))
        A = se2.adjoint(se2.inverse(step.predicted.delta))
        cov = A @ cov @ A.T + step.predicted.cov
        ekf.predict(quiet)
    np.testing.assert_allclose(ekf.P[POSE, POSE], cov, rtol=1e-9)


def test_motions_since_keys_add_up_to_the_trajectory():
    """Scans after a keyframe do not move the clone: a chain of these motions is where the filter was."""
    rng = np.random.default_rng(4)
    ekf, chain = filter_at(rng.normal(size=3)), None
    for i, step in enumerate(winding_steps(20.0)):
        ekf.predict(step)
        ekf.update_scan(se2.compose(ekf["pose"], se2.exp(rng.normal(0.0, 0.01, 3))), LIDAR, NOTHING)
        if i % 10 == 0:
            chain = ekf["pose"] if chain is None else se2.compose(chain, ekf.state.between("key", "pose")[0])
            np.testing.assert_allclose(se2.between(chain, ekf["pose"]), 0.0, atol=1e-9)
            ekf.start_key()


# --- updates


def prepared(seed):
    """A filter with a full covariance, and a measured pose near its own."""
    rng = np.random.default_rng(seed)
    ekf = filter_at(rng.normal(size=3))
    ekf.set(start=rng.normal(size=3), key=rng.normal(size=3))
    ekf.P = random_covariance(rng)
    return ekf, se2.compose(ekf["pose"], se2.exp(1e-3 * rng.normal(size=3)))


CONSIDERED = np.r_[MAP, KEY]


@pytest.mark.parametrize("is_turning", [True, False])
def test_update_without_turning_leaves_corrections(is_turning):
    ekf, _ = prepared(2)
    ekf.predict(step_of([0.1, 0.0, 0.01]), is_turning)
    before, P = ekf["corrections"].copy(), ekf.P[PARAMS:, PARAMS:].copy()
    ekf.update_turn(Turn(0.05, 1e-6, 0.1))
    ekf.update_scan(se2.compose(ekf["pose"], np.array([1e-3, 1e-3, 1e-3])), LIDAR, NOTHING)
    assert np.array_equal(ekf["corrections"], before) == (not is_turning)
    assert np.allclose(ekf.P[PARAMS:, PARAMS:], P, rtol=1e-9) == (not is_turning)


def test_update_turn_equals_scalar_kalman_filter():
    ekf, _ = prepared(3)
    ekf.set(start=se2.compose(ekf["pose"], np.array([-0.1, 0.0, -0.3])))
    P, turn = ekf.P.copy(), Turn(0.301, 1e-6, 0.1)
    H = np.zeros((1, SIZE))
    H[0, 2], H[0, 5], H[0, BIAS], H[0, SCALE] = 1.0, -1.0, 0.1, 0.3
    S = float((H @ P @ H.T)[0, 0]) + 1e-6
    K = (P @ H.T)[:, 0] / S
    K[CONSIDERED] = 0.0
    A = np.eye(SIZE) - np.outer(K, H)
    turned, nis = np.array(ekf["pose"]), ekf.update_turn(turn)
    turned, G = se2.between(ekf["pose"], turned), np.eye(SIZE)
    G[MAP, MAP], G[POSE, MAP] = se2.adjoint(turned), se2.adjoint(turned) - np.eye(3)  # the submap's error stays where it is in the world
    np.testing.assert_allclose(ekf.P, G @ (A @ P @ A.T + 1e-6 * np.outer(K, K)) @ G.T, rtol=1e-7, atol=1e-14)
    assert ekf.state.number("gyro_bias") == pytest.approx(K[BIAS] * 0.001)
    assert ekf.state.number("gyro_scale") == pytest.approx(K[SCALE] * 0.001)
    assert nis == pytest.approx(0.001**2 / S)


def test_update_scan_with_outlier_cov_widens_pose_first():
    wide, (plain, measured) = prepared(4)[0], prepared(4)
    outlier = np.diag([0.1, 0.1, 0.05]) ** 2
    wide.P[POSE, POSE] += outlier
    wide.update_scan(measured, LIDAR, NOTHING)
    plain.update_scan(measured, LIDAR, outlier)
    np.testing.assert_allclose(plain.P, wide.P)
    np.testing.assert_allclose(plain["pose"], wide["pose"])


KEY_SCAN = KeyScanError(0.35, np.diag([1e-6, 2e-6, 1e-7]))
SAMPLES = 40_000


def assert_scatter(errors, P):
    """The covariance of (SAMPLES, n) errors is ``P``, within 5 sigma of what so many samples give."""
    scatter = errors.T @ errors / len(errors)
    sigma = np.sqrt((np.outer(np.diag(P), np.diag(P)) + P**2) / len(errors))
    assert (np.abs(scatter - P) <= 5.0 * sigma + 1e-18).all()


def test_covariance_equals_monte_carlo_scatter():
    """Errors drawn, updated with the gain and put into the submap, e_map' = (1 - s) e_map + s e_pose + m, one by one."""
    ekf, measured = prepared(5)
    rng = np.random.default_rng(0)
    e = rng.multivariate_normal(np.zeros(SIZE), ekf.P, SAMPLES, method="cholesky")
    n = rng.multivariate_normal(np.zeros(3), LIDAR, SAMPLES)
    H = np.zeros((3, SIZE))
    H[:, POSE], H[:, MAP] = np.eye(3), -np.eye(3)
    K = np.linalg.solve(H @ ekf.P @ H.T + LIDAR, H @ ekf.P).T
    K[POSE] -= K[MAP]
    K[CONSIDERED] = 0.0
    e = e - (e @ H.T - n) @ K.T
    ekf.update_scan(measured, LIDAR, NOTHING)
    assert_scatter(e, ekf.P)
    ekf.insert_key_scan(KEY_SCAN)
    s, m = KEY_SCAN.share, rng.multivariate_normal(np.zeros(3), KEY_SCAN.new_cov, SAMPLES)
    e[:, MAP] = (1.0 - s) * e[:, MAP] + s * e[:, POSE] + m
    assert_scatter(e, ekf.P)


def test_update_scan_keeps_a_pose_that_is_better_known_than_the_submap_on_it():
    """By the gain of least variance it would stay off the submap by 0.3 m, and the next scan would be matched from there."""
    ekf = filter_at()
    ekf.P[POSE, POSE], ekf.P[MAP, MAP] = np.diag([0.1, 0.1, 0.01]) ** 2, np.diag([0.3, 0.3, 0.03]) ** 2
    measured = np.array([0.3, 0.0, 0.0])
    ekf.update_scan(measured, LIDAR, NOTHING)
    assert np.abs(se2.between(measured, ekf["pose"])).max() < 0.01
    assert (np.diag(ekf.state.difference_cov("pose", "map")) <= np.diag(LIDAR)).all()
    np.testing.assert_allclose(np.sqrt(np.diag(ekf.P))[POSE], [0.3, 0.3, 0.03], rtol=0.01)  # that of the submap, which it is now on


def test_update_scan_is_optimal_for_the_pose_relative_to_the_submap():
    """What a scan measures is that pose: its information adds up, as in a filter of it alone."""
    ekf, _ = prepared(2)
    before = ekf.state.difference_cov("pose", "map")
    ekf.update_scan(ekf["pose"], LIDAR, NOTHING)
    expected = np.linalg.inv(np.linalg.inv(before) + np.linalg.inv(LIDAR))
    np.testing.assert_allclose(ekf.state.difference_cov("pose", "map"), expected, rtol=1e-6, atol=1e-14)


def test_update_scan_that_leaves_the_way_open_leaves_the_wheel_radius():
    ekf, _ = prepared(3)
    before, P = ekf.state.number("radius"), ekf.P[RADIUS, RADIUS]
    wide = np.diag([30.0, 1e-3, 1e-3]) ** 2
    ekf.update_scan(se2.compose(ekf["pose"], np.array([0.1, 1e-3, 1e-3])), wide, NOTHING)
    assert ekf.state.number("radius") == before
    assert ekf.P[RADIUS, RADIUS] == pytest.approx(P)
    ekf.update_scan(se2.compose(ekf["pose"], np.array([0.01, 1e-3, 1e-3])), 1e-6 * np.eye(3), NOTHING)
    assert ekf.P[RADIUS, RADIUS] < 0.99 * P


def test_map_relative_cov_equals_cov_of_difference():
    ekf, _ = prepared(6)
    J = np.zeros((3, SIZE))
    J[:, POSE], J[:, MAP] = np.eye(3), -np.eye(3)
    np.testing.assert_allclose(ekf.state.difference_cov("pose", "map"), J @ ekf.P @ J.T, rtol=1e-9)


def test_insert_key_scan_of_first_gives_map_the_pose_error():
    """Drawn where the robot is, an error of the pose is one of the submap: against it, the pose is known."""
    ekf, _ = prepared(7)
    ekf.P[MAP], ekf.P[:, MAP] = 0.0, 0.0
    ekf.insert_key_scan(KeyScanError(1.0, NOTHING))
    np.testing.assert_allclose(ekf.state.difference_cov("pose", "map"), 0.0, atol=1e-13)  # a floor of 1e-14 keeps it positive


# --- a covariance stays a covariance


def check_covariance(P):
    np.testing.assert_allclose(P, P.T, atol=1e-12 * np.abs(P).max())
    scale = np.sqrt(np.maximum(np.diag(P), 1e-300))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-9


def test_covariance_over_random_steps_stays_positive():
    rng = np.random.default_rng(3)
    ekf, drives = filter_at(), winding_steps(20.0)
    for i in range(4000):
        kind = rng.integers(6)
        step = drives[i % len(drives)] if kind else step_of(np.zeros(3), np.zeros((3, 3)), is_standing=True)
        ekf.predict(step, bool(kind))
        if kind != 1:
            ekf.update_turn(Turn(step.predicted.delta[2] + 0.01 * rng.normal(), 10.0 ** rng.uniform(-10, -2), step.duration))
        if kind > 2:
            noise = 10.0 ** rng.uniform(-4, 1, 3)
            off = noise * rng.normal(size=3) * (1 if rng.random() < 0.95 else 30)
            ekf.update_scan(se2.compose(ekf["pose"], se2.exp(off)), np.diag(noise**2), NOTHING)
        if kind == 4:
            ekf.insert_key_scan(KEY_SCAN)
            ekf.start_key()
        if i % 20 == 0:
            check_covariance(ekf.P)
    assert np.isfinite(ekf["pose"]).all()
    check_covariance(ekf.P)


# --- standing still


def test_predict_standing_keeps_pose_and_shows_gyro_bias():
    rng, bias = np.random.default_rng(5), 8e-4
    ekf = filter_at()
    for step in winding_steps(5.0):
        ekf.predict(step)
    before, wide = ekf["pose"], ekf.P[POSE, POSE].copy()
    for step in standing(60.0):
        assert step.is_standing
        ekf.predict(step)
        noise = GYRO.white_rad_per_sqrt_s * math.sqrt(step.duration) * rng.normal()
        ekf.update_turn(Turn(bias * step.duration + noise, GYRO.white_rad_per_sqrt_s**2 * step.duration, step.duration))
    sigma = math.sqrt(ekf.P[BIAS, BIAS])
    assert abs(ekf.state.number("gyro_bias") - bias) < 3.0 * sigma
    # 60 s of white noise leave 2e-3 / sqrt(60) = 2.6e-4 rad/s, the prior and the walks a little either way
    assert 1.5e-4 < sigma < 4e-4
    np.testing.assert_allclose(ekf["pose"], before, atol=1e-3)
    # a robot that stands measures nothing of where it is, and loses little
    assert np.linalg.eigvalsh(ekf.P[POSE, POSE] - 0.999 * wide).min() > -1e-6
    assert np.trace(ekf.P[POSE, POSE]) < 1.05 * np.trace(wide)


def test_predict_standing_keeps_corrections():
    ekf = filter_at()
    before = ekf.P[PARAMS:, PARAMS:].copy()
    for step in standing(20.0):
        ekf.predict(step, False)
        ekf.update_scan(se2.compose(ekf["pose"], np.array([1e-3, -1e-3, 1e-3])), LIDAR, NOTHING)
    np.testing.assert_allclose(ekf.P[PARAMS:, PARAMS:], before, rtol=1e-12)
    assert not ekf["corrections"].any()


# --- over many seeds


@dataclasses.dataclass
class World:
    """What the filter assumes, drawn: slip, clock, bias, scale and corrections, all with their walks; a submap that is exact."""

    rng: np.random.Generator
    seconds: float = 15.0
    slip_variance: float = 1.0
    """True variance of the wheels' slip, in units of the assumed one."""

    def run(self):
        rng, config = self.rng, FilterConfig()
        ekf, pose = filter_at(config=config), np.zeros(3)
        bias, scale = GYRO.bias_sigma_rad_per_s * rng.normal(), GYRO.scale_sigma * rng.normal()
        clock, radius = config.clock_sigma_s * rng.normal(), config.wheel_radius_sigma * rng.normal()
        params = CORRECTED.sigmas * rng.normal(size=len(CORRECTED.names))
        nis, turns, innovations = [], [], []
        for step in winding_steps(self.seconds):
            dt = step.duration
            off = step.d_clock * (clock - ekf.state.number("clock")) + step.predicted.d_params @ CORRECTED.directions @ (
                params - ekf["corrections"]
            )
            slip = rng.multivariate_normal(np.zeros(3), self.slip_variance * step.predicted.cov, method="cholesky")
            before, pose = (
                pose,
                se2.compose(pose, se2.compose(step.predicted.delta * [1.0 + radius, 1.0 + radius, 1.0], se2.exp(off + slip))),
            )
            bias += GYRO.bias_walk_rad_per_s_sqrt_s * math.sqrt(dt) * rng.normal()
            clock += config.clock_walk_s_per_sqrt_s * math.sqrt(dt) * rng.normal()
            params = params + np.sqrt(np.diag(CORRECTED.process_noise) * dt) * rng.normal(size=len(params))
            ekf.predict(step)
            angle = float(se2.between(before, pose)[2])
            variance = GYRO.white_rad_per_sqrt_s**2 * dt
            turns.append(ekf.update_turn(Turn((1.0 + scale) * angle + bias * dt + math.sqrt(variance) * rng.normal(), variance, dt)))
            measured = se2.compose(pose, se2.exp(np.sqrt(np.diag(LIDAR)) * rng.normal(size=3)))
            innovations.append(se2.log(se2.between(ekf["pose"], measured)))
            nis.append(ekf.update_scan(measured, LIDAR, NOTHING))
        off = [
            bias - ekf.state.number("gyro_bias"),
            scale - ekf.state.number("gyro_scale"),
            clock - ekf.state.number("clock"),
            radius - ekf.state.number("radius"),
        ]
        self.wheel_noise_scale = ekf.noise.value
        return np.concatenate([se2.log(se2.between(ekf["pose"], pose)), off, params - ekf["corrections"]]), ekf.P, nis, turns, innovations


SEEDS = 80


@pytest.fixture(scope="module")
def worlds():
    """With the wheel noise at its prior, which is the true one: NIS and NEES are then those of the equations alone."""
    with mock.patch.object(wheel_noise, "_MAX_NOISE_SCALE", 1.0):
        return [tuple(map(np.array, World(np.random.default_rng(100 + seed)).run())) for seed in range(SEEDS)]


PARTS = {
    "pose": [0, 1, 2],
    "gyro bias": [BIAS],
    "gyro scale": [SCALE],
    "clock": [CLOCK],
    "wheel radius": [RADIUS],
    "k": [PARAMS],
    "centre of rotation": [PARAMS + 1, PARAMS + 2],
    "all": [0, 1, 2, *range(BIAS, PARAMS + 3)],
}


@pytest.mark.xdist_group("filter_worlds")
@pytest.mark.parametrize("part", PARTS)
def test_filter_nees_is_in_band(worlds, part):
    """Every part of the state, at the end of 15 s, over independent seeds; 99.8 % band, so that seven of them hold together."""
    of = np.array(PARTS[part])
    at = [i if i < 3 else 3 + i - BIAS for i in of]  # where the part stands in the vector of errors
    values = [error[at] @ np.linalg.solve(P[np.ix_(of, of)], error[at]) for error, P, *_ in worlds]
    low, high = mean_band(SEEDS, len(of), 0.998)
    assert low < np.mean(values) < high
    assert np.mean(np.array(values) < chi2.ppf(0.95, len(of))) > 0.85


@pytest.mark.xdist_group("filter_worlds")
def test_filter_nis_is_in_band(worlds):
    lidar, gyro = (np.concatenate([w[i] for w in worlds]) for i in (2, 3))
    for values, dof in ((lidar, 3), (gyro, 1)):
        low, high = mean_band(len(values), dof, 0.998)
        assert low < values.mean() < high
    assert np.mean(lidar > chi2.ppf(0.95, 3)) == pytest.approx(0.05, abs=0.012)


@pytest.mark.xdist_group("filter_worlds")
def test_filter_estimates_calibration_states(worlds):
    """What began at sigma is known several times better; the clock's sign is part of its error above."""
    for index, sigma, share in (
        (CLOCK, FilterConfig().clock_sigma_s, 0.3),
        (PARAMS, CORRECTED.sigmas[0], 0.5),
        (PARAMS + 1, CORRECTED.sigmas[1], 0.5),
        (BIAS, GYRO.bias_sigma_rad_per_s, 0.5),
        (SCALE, GYRO.scale_sigma, 0.8),
    ):
        assert np.mean([math.sqrt(P[index, index]) for _, P, *_ in worlds]) < share * sigma


@pytest.mark.xdist_group("filter_worlds")
def test_filter_innovations_are_white(worlds):
    """Time-average autocorrelation at lag 1 (Bar-Shalom et al. 2001, sec. 5.4.2): of white ones normal with variance 1 / (3 n)."""
    squares = [w[4] @ np.linalg.solve(np.cov(w[4].T), w[4].T) for w in worlds]  # y_k^T S^-1 y_l
    rhos = [np.trace(square, offset=1) / np.trace(square) for square in squares]
    n = len(worlds[0][4])
    assert abs(np.mean(rhos)) < 4.0 / math.sqrt(3 * n * SEEDS) + 2.0 / n


# --- any input


HOSTILE = st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 1e150, 0.0, 1e-300, -1.0, 0.1])


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_filter_with_any_input_stays_finite(data):
    def draw(*shape):
        return np.array(data.draw(st.lists(HOSTILE, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))).reshape(shape)

    ekf = filter_at()
    for step in winding_steps(5.0)[:4]:
        ekf.predict(step)
    calls = {
        "motion": lambda: ekf.predict(step_of(draw(3))),
        "covariance": lambda: ekf.predict(step_of([0.1, 0, 0], np.diag(np.abs(draw(3))))),
        "clock": lambda: ekf.predict(step_of([0.1, 0, 0], d_clock=draw(3))),
        "turn": lambda: ekf.update_turn(Turn(*np.abs(draw(3)).tolist())),
        "scan": lambda: ekf.update_scan(draw(3), np.diag(np.abs(draw(3))), NOTHING),
    }
    for name in data.draw(st.lists(st.sampled_from(sorted(calls)), min_size=1, max_size=4)):
        with contextlib.suppress(EstimatorError), np.errstate(all="ignore"):
            calls[name]()
        for part in (
            ekf["pose"],
            ekf["start"],
            ekf["key"],
            ekf.P,
            ekf["corrections"],
            ekf.state.number("gyro_bias"),
            ekf.state.number("gyro_scale"),
            ekf.state.number("clock"),
        ):
            assert np.isfinite(part).all()


def test_predict_of_infinite_motion_is_refused_with_stamp():
    ekf = filter_at()
    with pytest.raises(EstimatorError, match=f"the motion of the wheels until stamp {T0 + S // 10} ns"):
        ekf.predict(step_of([np.nan, 0.0, 0.0]))
    with pytest.raises(EstimatorError, match="the pose by a scan"):
        ekf.update_scan(np.array([0.0, np.nan, 0.0]), LIDAR, NOTHING)
    with pytest.raises(EstimatorError, match="a turn by the gyro"):
        ekf.update_turn(Turn(np.nan, 1e-6, 0.1))


# --- scale of the wheel noise


def scale_and_nis(slip_variance):
    """Scale at the end of 30 s, and mean NIS of the scans of the second half, over six seeds."""
    found = [World(np.random.default_rng(seed), 30.0, slip_variance) for seed in range(6)]
    nis = [np.array(world.run()[2]) for world in found]
    return np.mean([world.wheel_noise_scale for world in found]), np.mean([values[len(values) // 2 :] for values in nis])


@pytest.mark.extended
def test_wheel_noise_scale_with_slip_of_six_times_variance_is_estimated():
    scale, nis = scale_and_nis(6.0)
    assert scale == pytest.approx(6.0, rel=0.2)
    assert 2.5 < nis < 3.5


@pytest.mark.extended
def test_wheel_noise_scale_with_less_slip_than_assumed_stays_one():
    """Slip that lasts is small in one step and large over many: the robot file's variance is the least."""
    scale, nis = scale_and_nis(0.2)
    assert 1.0 <= scale < 1.01
    assert nis < 3.0


def one_scan(off, R=LIDAR, outlier_cov=NOTHING):
    """Scale after 20 steps of 0.1 m whose scans are ``off`` (3,) the prediction."""
    ekf = filter_at(config=FilterConfig(clock_sigma_s=0.0))
    for _ in range(20):
        ekf.predict(step_of([0.1, 0.0, 0.0]))
        ekf.update_scan(se2.compose(ekf["pose"], se2.exp(np.asarray(off))), R, outlier_cov)
    return ekf.noise.value


def test_wheel_noise_scale_is_learned_from_informative_innovations_alone():
    off = np.array([0.03, 0.0, 0.0])  # three sigma of the slip
    assert one_scan(off) > 1.5
    assert one_scan(off, R=np.diag([10.0, 10.0, 1.0]) ** 2) == pytest.approx(1.0, abs=1e-3)  # the scene is open
    assert one_scan(off, outlier_cov=np.eye(3)) == pytest.approx(1.0, abs=1e-3)  # the search has found an outlier of the wheels


def test_wheel_noise_scale_after_outlier_is_bounded():
    assert one_scan(np.array([5.0, 0.0, 0.0])) == wheel_noise._MAX_NOISE_SCALE
    ekf = filter_at(config=FilterConfig(clock_sigma_s=0.0))
    ekf.predict(step_of([0.1, 0.0, 0.0]))
    ekf.update_scan(np.array([5.1, 0.0, 0.0]), LIDAR, NOTHING)  # once: 500 sigma count as five
    assert ekf.noise.value < 1.0 + 25.0 * 3.0 / 30.0 * 5.0


def test_wheel_noise_scale_does_not_change_steps_without_wheels():
    ekf = filter_at()
    ekf.noise.value = 4.0
    driven = step_of([0.1, 0.0, 0.0])
    np.testing.assert_allclose(ekf.noise.start_step(ekf.state, driven), 4.0 * driven.predicted.cov)
    for step in (dataclasses.replace(driven, has_wheels=False), dataclasses.replace(driven, is_standing=True)):
        np.testing.assert_array_equal(ekf.noise.start_step(ekf.state, step), step.predicted.cov)
        ekf.predict(step)
        ekf.update_scan(se2.compose(ekf["pose"], np.array([0.5, 0.0, 0.0])), LIDAR, NOTHING)
        assert ekf.noise.value == 4.0
