"""A gyro at rest: two seconds know its bias to its own noise; a robot that rolls, is carried or turned with its wheels at rest is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.core.motion import FilterConfig
from localization.core.policies.standstill import _BIAS_PRIORS
from localization.estimators.fusion import EkfFusion
from localization.events import Step
from localization.inputs.rate_series import RateSeries
from motion_models import se2
from motion_models.motion import Motion
from motion_models.online_calibration import make_corrections
from motion_models.registry import make_model
from motion_models.robot import GyroNoise
from motion_models.robot_file import load_robot
from tests.helpers.extended import cases

ROBOT = load_robot("vaultbot")
RATE_HZ, STEP_S, WHITE = 100.0, 0.05, 5e-4
MEMS_RAD_S = math.radians(0.4)


def drive(
    rates: np.ndarray,
    white: float = WHITE,
    rest_s: float = math.inf,
    seed: int = 0,
    stop_s: float = math.inf,
    every_s: float = math.inf,
) -> tuple[EkfFusion, np.ndarray]:
    """The filter after ``rates`` (n,) of the gyro [rad/s] at `RATE_HZ`, with wheels at rest for the first ``rest_s`` of ``every_s``,
    straight on after that, at rest from ``stop_s`` on; and the published yaw after each step."""
    model = make_model("diff_drive", ROBOT)
    ekf = EkfFusion(model, make_corrections(model, "constant"), ROBOT, None, FilterConfig())
    series, yaws = RateSeries(ROBOT.gyro_noise.white_rad_per_sqrt_s, 10.0), []
    noise = np.random.default_rng(seed).normal(0.0, white * math.sqrt(RATE_HZ), len(rates))
    per_step = round(STEP_S * RATE_HZ)
    for i, rate in enumerate(rates + noise):
        series.insert(round(i / RATE_HZ * 1e9), rate)
        if i % per_step or not i:
            continue
        start_ns, end_ns = round((i - per_step) / RATE_HZ * 1e9), round(i / RATE_HZ * 1e9)
        is_standing = i / RATE_HZ % every_s <= rest_s or i / RATE_HZ > stop_s
        way = 0.0 if is_standing else 0.4 * STEP_S
        cov = np.zeros((3, 3)) if is_standing else np.diag([4e-4, 1e-4, 1e-3]) * way
        motion = Motion(np.array([way, 0.0, 0.0]), cov, np.zeros((3, len(model.nominal))), np.zeros((3, 2)))
        step = Step(
            start_ns, end_ns, motion, np.zeros(3), np.array([way / STEP_S, 0.0, 0.0]), is_standing, True, series.turn(start_ns, end_ns)
        )
        yaws.append(ekf.step(step).pose[2])
    return ekf, np.array(yaws)


def constant_rate(rate: float, seconds: float) -> np.ndarray:
    return np.full(round(seconds * RATE_HZ), rate)


@pytest.mark.extended
def test_two_seconds_of_rest_know_a_mems_bias_to_the_noise_of_the_gyro():
    """NEES of the bias over draws, of the published yaw after a minute that is driven straight on, and its error."""
    bias_nees, yaw_nees, yaw_errors = [], [], []
    for seed in range(30):
        ekf, yaws = drive(constant_rate(MEMS_RAD_S, 12.0), rest_s=2.0, seed=seed)
        error, variance = ekf.state.number("gyro_bias") - MEMS_RAD_S, ekf.state.variance("gyro_bias")
        assert math.sqrt(variance) < 1.5 * WHITE / math.sqrt(2.0)
        bias_nees.append(error**2 / variance)
        yaw_nees.append(yaws[-1] ** 2 / ekf.state.cov("pose")[2, 2])
        yaw_errors.append(yaws[-1] * 6.0)
    assert 0.5 < np.mean(bias_nees) < 2.0
    assert np.mean(yaw_nees) < 2.0
    assert math.degrees(float(np.sqrt(np.mean(np.square(yaw_errors))))) < 3.0


@pytest.mark.extended
def test_bias_by_a_rest_that_leaves_its_prior_open_is_consistent():
    """Half a second of a noisy gyro does not show whether the driver has zeroed it: NEES over biases drawn from all priors."""
    nees = []
    for seed in range(150):
        rng = np.random.default_rng([seed, 9])
        _, factor, own = _BIAS_PRIORS[rng.choice(len(_BIAS_PRIORS), p=[share for share, _, _ in _BIAS_PRIORS])]
        bias = rng.normal(0.0, factor * GyroNoise.bias_sigma_rad_per_s + own)
        ekf, _ = drive(constant_rate(bias, 1.0), white=10.0 * WHITE, seed=seed)
        if ekf._policies.standstill.is_at_rest:
            nees.append((ekf.state.number("gyro_bias") - bias) ** 2 / ekf.state.variance("gyro_bias"))
    assert len(nees) > 130
    assert 0.5 < np.mean(nees) < 2.0


@pytest.mark.parametrize("sigma", [0.0, 1.0, 3.0])
def test_rest_of_a_gyro_as_the_robot_file_has_it_is_consistent(sigma):
    bias = sigma * GyroNoise.bias_sigma_rad_per_s
    ekf, _ = drive(constant_rate(bias, 2.0))
    assert abs(ekf.state.number("gyro_bias") - bias) < 3.5 * math.sqrt(ekf.state.variance("gyro_bias"))
    assert math.sqrt(ekf.state.variance("gyro_bias")) < 1.5 * WHITE / math.sqrt(2.0)


def turning(rate: float) -> np.ndarray:
    return np.concatenate([constant_rate(0.001, 0.3), constant_rate(rate, 4.0)])


MOVED = {
    "turntable": turning(0.3),
    "slow turntable": turning(0.1),
    "turntable from the start": constant_rate(0.2, 4.0),
    "carried": 0.2 * np.sin(2.0 * np.arange(400) / RATE_HZ) + 0.05,
    "rolls on a bend": 0.04 * np.arange(400) / RATE_HZ,
}


@pytest.mark.parametrize("name", cases(MOVED, usual=["turntable", "carried", "rolls on a bend"]))
def test_robot_that_is_moved_with_its_wheels_at_rest_is_not_at_rest(name):
    """It turns as the gyro has it, and none of that is taken for the bias."""
    rates = MOVED[name]
    ekf, yaws = drive(rates)
    assert not ekf._policies.standstill.is_at_rest
    assert abs(ekf.state.number("gyro_bias")) < 5.0 * GyroNoise.bias_sigma_rad_per_s
    assert abs(yaws[-1] - rates.sum() / RATE_HZ) < 4.0 * math.sqrt(ekf.state.cov("pose")[2, 2])


def change_of_bias(kind: str, seed: int) -> tuple[np.ndarray, float]:
    """Rates of a gyro whose bias steps at a uniform time of the 20 s between two rests, or rises through all of them; and the change."""
    rng, seconds = np.random.default_rng(seed), np.arange(round(23.0 * RATE_HZ)) / RATE_HZ
    rate, at_s = rng.normal(0.0, math.radians(1.0)), rng.uniform(1.5, 21.5)
    return rate * (seconds > at_s if kind == "step" else np.clip((seconds - 1.5) / 20.0, 0.0, 1.0)), rate


def consistency_after(kind: str, draws: int) -> tuple[float, float, float]:
    """Mean NEES of the heading and, per degree of freedom, of the pose after the second rest, and the root mean square of the heading's
    error over that of the change times 20 s."""
    yaw, pose, errors, changes = [], [], [], []
    for seed in range(draws):
        rates, change = change_of_bias(kind, seed)
        ekf, _ = drive(rates, rest_s=1.5, stop_s=21.5, seed=seed)
        P, error = ekf.state.cov("pose"), se2.local(ekf.state["pose"], np.array([0.4 * 20.0, 0.0, 0.0]))
        yaw.append(error[2] ** 2 / P[2, 2])
        pose.append(error @ np.linalg.solve(P, error) / 3.0)
        errors.append(error[2])
        changes.append(20.0 * change)
        found = ekf.bias_change
        assert found is None or found.rate == pytest.approx(change, abs=2e-3)
        assert (found is not None) == (abs(change) > 3.0 * GyroNoise.bias_sigma_rad_per_s) or abs(change) < 5e-3
    return float(np.mean(yaw)), float(np.mean(pose)), float(np.linalg.norm(errors) / np.linalg.norm(changes))


@pytest.mark.extended
def test_bias_that_rises_between_two_rests_is_corrected():
    yaw, pose, share = consistency_after("ramp", 4)
    assert yaw < 1.0
    assert pose < 2.0
    assert share < 0.1


@pytest.mark.extended
def test_bias_of_the_cheapest_gyros_is_known_after_two_seconds_of_rest():
    """Drawn as their data sheet has it: 9 of 10 rests are found, and the others leave the filter as it was."""
    rng, found = np.random.default_rng(5), []
    for seed in range(40):
        bias = rng.normal(0.0, math.radians(2.5))
        ekf, _ = drive(constant_rate(bias, 2.0), seed=seed)
        error, sigma = ekf.state.number("gyro_bias") - bias, math.sqrt(ekf.state.variance("gyro_bias"))
        found.append(abs(error) < 4.0 * sigma < 4e-3)
        assert found[-1] or abs(ekf.state.number("gyro_bias")) < 5.0 * GyroNoise.bias_sigma_rad_per_s
    assert np.mean(found) >= 0.9


def test_robot_that_sets_off_before_its_wheels_count_keeps_its_bias():
    """Encoders of few counts begin late: in the last 0.15 s of each rest the gyro turns already."""
    every_s, rest_s, bias = 5.5, 1.5, 4e-3
    phase = np.arange(round(3.0 * every_s * RATE_HZ)) / RATE_HZ % every_s
    ekf, _ = drive(bias - 0.2 * ((phase > rest_s - 0.15) & (phase <= rest_s)), rest_s=rest_s, every_s=every_s)
    assert abs(ekf.state.number("gyro_bias") - bias) < 4.0 * math.sqrt(ekf.state.variance("gyro_bias")) < 3e-3
    assert ekf.bias_change is None


@pytest.mark.parametrize("rates", [[0.11, 0.11, 0.11], [0.11, 0.002, 0.002], [0.002, 0.11, 0.002]], ids=["bias", "turntable", "turned"])
def test_rate_that_comes_back_in_the_next_standstill_is_the_bias(rates):
    """One standstill at 6 deg/s may be a turntable; two are the gyro's own."""
    every_s, rest_s = 5.5, 1.5
    seconds = np.arange(round(every_s * len(rates) * RATE_HZ)) / RATE_HZ
    at_rest = np.array(rates)[(seconds // every_s).astype(int)]
    ekf, yaws = drive(np.where(seconds % every_s <= rest_s, at_rest, rates[-1]), rest_s=rest_s, every_s=every_s)
    assert abs(ekf.state.number("gyro_bias") - rates[-1]) < 2e-3
    assert rates[0] != rates[-1] or abs(yaws[-1]) < 4.0 * math.sqrt(ekf.state.cov("pose")[2, 2]) < 1.0


def test_vibration_at_rest_is_noise_and_no_motion():
    """Of an engine at 30 Hz, forty times the gyro's own."""
    seconds = np.arange(400) / RATE_HZ
    ekf, yaws = drive(MEMS_RAD_S + 0.2 * np.sin(math.tau * 30.3 * seconds), rest_s=math.inf)
    assert ekf._policies.standstill.is_at_rest
    assert abs(ekf.state.number("gyro_bias") - MEMS_RAD_S) < 1.2 * MEMS_RAD_S
    assert abs(yaws[-1]) < math.radians(0.5)
