"""Slip stiffness and mu of the tyres by how a robot turns on slopes: the friction model with other tyres as the truth."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from localization.events import Turn
from localization.inputs.attitude import Tilt
from localization.inputs.motion_on_slopes import MotionOnSlopes
from motion_models.friction import FrictionModel
from motion_models.friction.slope_effect import SlopeEffect
from motion_models.preintegration import noise_vector
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.slope import Slope

pytestmark = pytest.mark.xdist_group("tyre_friction")
ROBOT, STEP_S, CG = load_robot("husky_a200"), 0.05, np.zeros((2, 2))
SKID = make_model("skid_steer", ROBOT)
DOWNHILL = math.tan(math.radians(10.0))


def with_tyres(stiffness, mu):
    nominal = dict(zip(FrictionModel.param_names, FrictionModel.from_robot(ROBOT).nominal.tolist(), strict=True))
    tyres = {"slip_stiffness": stiffness * nominal["slip_stiffness"], "mu": mu * nominal["mu"]}
    return replace(ROBOT, models={**ROBOT.models, "friction": {**ROBOT.models.get("friction", {}), **tyres}})


@functools.cache
def drive_on_slope(stiffness, mu, seconds=90.0, seed=1):
    """Arcs and turns in place on 10 degrees, by wheels and a gyro with bias, of a robot whose k is 5 % larger than by its geometry."""
    rng, friction = np.random.default_rng(seed), FrictionModel.from_robot(with_tyres(stiffness, mu))
    filtered = MotionOnSlopes(ROBOT, noise_vector(ROBOT.wheel_noise), np.array([1.0, 1.0, 1.0]))
    yaw, wheels = 0.0, np.zeros(2)
    for i in range(round(seconds / STEP_S)):
        if i % 60 == 0:
            wheels = np.array([[-2.0, 2.0], [1.0, 3.0], [3.0, 1.0], [2.0, 4.0]])[rng.integers(4)] * rng.uniform(0.5, 1.5)
        down = DOWNHILL * np.array([math.cos(yaw), -math.sin(yaw)])
        slope = Slope(down, ROBOT.geometry.cg_height_m)
        level = friction.twist(wheels, np.zeros(2), friction.nominal).value[2]
        by_slope = friction.twist_on_slope(wheels, np.zeros(2), friction.nominal, slope).twist.value[2] - level
        turn_rate = 1.05 * SKID.twist(wheels, np.zeros(2), SKID.nominal).value[2] + by_slope
        yaw += turn_rate * STEP_S
        turn = Turn((turn_rate + 0.001) * STEP_S + 1e-4 * rng.normal(), 1e-8, STEP_S)
        tilt = Tilt(down, down, np.radians(0.5) ** 2 * np.eye(2), (0.0, 0.001), turn)
        filtered.integrate(SKID, SKID.nominal, np.array([STEP_S]), np.tile(wheels, (2, 1)), CG, tilt)
    return filtered.tyres


@pytest.mark.parametrize(
    ("stiffness", "mu"),
    [(3.0, 1.4), *(pytest.param(*each, marks=pytest.mark.extended) for each in ((1.0, 1.0), (0.5, 1.0), (3.0, 1.0), (1.0, 0.7)))],
)
def test_tyre_friction_is_that_of_the_turns_on_slopes(stiffness, mu):
    found = drive_on_slope(stiffness, mu)
    error = np.array(found.logs) - np.log([stiffness, mu])
    assert error @ np.linalg.solve(found.cov, error) < 9.2  # 99 % of chi-square, 2 degrees of freedom
    assert (np.sqrt(np.diagonal(found.cov)) < [0.8, 0.17]).all()


@pytest.mark.extended
def test_tyre_friction_tells_hard_from_soft_and_dry_from_wet():
    assert drive_on_slope(3.0, 1.0).logs[0] - drive_on_slope(0.5, 1.0).logs[0] > 0.8
    assert drive_on_slope(1.0, 1.3).logs[1] - drive_on_slope(1.0, 0.7).logs[1] > 0.3


def test_slope_effect_by_tyres_equals_differences():
    effect, wheels = SlopeEffect.from_robot(ROBOT), np.array([[-2.0, 2.0], [1.0, 3.0]])
    downhill, step = np.array([[0.1, 0.05], [0.0, 0.1]]), 1e-5

    def motion(stiffness=0.3, mu=-0.2):
        return effect.twist(SKID, wheels, CG, SKID.nominal, downhill, (0.2, 0.1), (stiffness, mu))

    by_stiffness = motion(stiffness=0.3 + step).twist.value - motion(stiffness=0.3 - step).twist.value
    by_mu = motion(mu=-0.2 + step).twist.value - motion(mu=-0.2 - step).twist.value
    np.testing.assert_allclose(motion().by_tyres, np.stack([by_stiffness, by_mu], axis=-1) / (2.0 * step), atol=1e-6)


def test_motion_on_slopes_beyond_the_limits_measures_no_tyres():
    """A robot that slides by itself turns as no wheel shows."""
    found = MotionOnSlopes(ROBOT, noise_vector(ROBOT.wheel_noise), np.array([1.0, 1.0, 1.0]))
    down, prior = np.array([3.0, 0.0]), found.tyres.cov.copy()
    tilt = Tilt(down, down, 1e-4 * np.eye(2), turn=Turn(1.0, 1e-6, STEP_S))
    _, motion = found.integrate(SKID, SKID.nominal, np.array([STEP_S]), np.array([[-2.0, 2.0]] * 2), CG, tilt)
    assert np.isfinite(motion.cov).all()
    assert found.tyres.logs == (0.0, 0.0)
    np.testing.assert_array_equal(found.tyres.cov, prior)


def test_tyre_friction_of_absurd_turns_stays_within_its_limits():
    found = drive_on_slope(1.0, 1.0, seconds=5.0)
    for _ in range(1000):
        found.update(10.0, np.array([0.01, -0.02, 0.1, STEP_S]), 1e-8)
    stiffness, mu = found.logs
    assert abs(stiffness) <= math.log(10.0) + 1e-12
    assert abs(mu) <= math.log(2.5) + 1e-12
    assert (np.diagonal(found.cov) > 0.0).all()
