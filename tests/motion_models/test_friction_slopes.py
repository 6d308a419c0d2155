"""The friction model on slopes: the closed form, the same forces by the dynamic model, exact derivatives, and the limits."""

import dataclasses
import math
import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from motion_models.errors import CgError, ModelError
from motion_models.friction import FrictionModel
from motion_models.friction.dynamics import FrictionDynamics, Influence
from motion_models.robot_file import load_robot
from motion_models.slope import Slope

ROBOT = load_robot("husky_a200")
MODEL = FrictionModel.from_robot(ROBOT)
WHEELBASE, TRACK, HEIGHT = 0.512, 0.57, 0.4
NAMES = FrictionModel.param_names


def with_params(**changes):
    params = MODEL.nominal.copy()
    for name, value in ({"wheelbase": WHEELBASE, "track_width": TRACK, "mu": 0.8} | changes).items():
        params[NAMES.index(name)] = value
    return params


def tangent(degrees):
    return math.tan(math.radians(degrees))


@pytest.mark.parametrize("mu", [0.5, 0.8])
def test_slope_closed_form_of_turning_in_place(mu):
    """u_x = |w| (W/2) k^(-3/2) a_x / mu and u_y = |w| (W/2) k^(-1/2) / (1 - k) a_y / mu: first order, contacts that slide everywhere."""
    params = with_params(mu=mu, slip_stiffness=1e4, rolling_resistance=0.0)
    found = MODEL.twist_on_slope(np.array([-1.0, 1.0]), np.zeros(2), params, Slope(np.zeros(2), 0.0))
    wz = found.twist.value[2]
    k = 1.0 / (1.0 + (WHEELBASE / TRACK) ** 2)
    expected = abs(wz) * WHEELBASE / 2 / mu * np.array([k**-1.5, k**-0.5 / (1.0 - k)])
    np.testing.assert_allclose(np.diagonal(found.d_downhill[:2]), expected, rtol=2e-3)
    assert wz * TRACK / (2.0 * params[0]) == pytest.approx(k, rel=1e-3)
    assert abs(found.d_downhill[0, 1]) + abs(found.d_downhill[1, 0]) + np.abs(found.d_downhill[2]).max() < 1e-6


def test_slope_of_zero_is_flat_to_the_last_bit():
    rng = np.random.default_rng(3)
    wheels, cg = rng.normal(size=(200, 2)), rng.uniform(-0.1, 0.1, (200, 2))
    flat = MODEL.twist(wheels, cg, MODEL.nominal)
    level = MODEL.twist_on_slope(wheels, cg, MODEL.nominal, Slope(np.zeros(2), 0.4)).twist
    for name in ("value", "d_wheels", "d_cg", "d_params"):
        np.testing.assert_array_equal(getattr(level, name), getattr(flat, name))
    command = np.array([0.4, 0.3])
    on_slope = MODEL.wheels_on_slope(command, cg, MODEL.nominal, Slope(np.zeros(2), 0.4))
    np.testing.assert_array_equal(on_slope, MODEL.wheels(command, cg, MODEL.nominal))


@pytest.mark.parametrize("wheels", [(-3.0, 3.0), (1.0, 4.0), (2.0, 2.0), (3.0, 0.5)])
@pytest.mark.parametrize("downhill", [(0.1, 0.05), (-0.2, 0.1), (0.0, -0.25)])
def test_slope_twist_is_steady_in_the_dynamic_model(wheels, downhill):
    """Second way: gravity along the ground as an external force on the CG; the dynamic form shifts the loads by the forces' moments."""
    cg, params = np.array([0.04, -0.02]), with_params()
    twist = MODEL.twist_on_slope(np.array(wheels), cg, params, Slope(np.array(downhill), HEIGHT)).twist.value
    slow = 1e-4  # no inertia
    plant = FrictionDynamics(params, 50.0, 2.0, HEIGHT, rest_speed=1e-12)
    force = np.array([*downhill, 0.0]) * plant.mass * plant.gravity
    push = dataclasses.replace(Influence.of_cg(cg), force=force, at=np.array([*cg, HEIGHT]))
    found, margin = plant.accelerations(slow * np.array(wheels), slow * twist, push)
    assert margin > 0.0
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


@pytest.mark.parametrize("centripetal", [False, True])
@pytest.mark.parametrize("wheels", [(-3.0, 3.0), (1.0, 4.0), (2.0, 2.1)])
def test_slope_derivatives_equal_differences(wheels, centripetal):
    model = dataclasses.replace(MODEL, centripetal=centripetal)
    wheels, cg, params, h = np.array(wheels), np.array([0.05, 0.02]), with_params(warp=0.1, tread=0.1, scrub=0.01), 1e-6
    down = np.array([0.12, -0.07])

    def value(dw=(0, 0), dg=(0, 0), dp=None, da=(0, 0), dh=0.0):
        changed = params if dp is None else params + dp
        return model.twist_on_slope(wheels + dw, cg + dg, changed, Slope(down + da, HEIGHT + dh)).twist.value

    def difference(**step):
        return (value(**step) - value(**{name: -np.asarray(size) for name, size in step.items()})) / (2 * h)

    found = model.twist_on_slope(wheels, cg, params, Slope(down, HEIGHT))
    for j, step in enumerate(h * np.eye(2)):
        np.testing.assert_allclose(found.d_downhill[:, j], difference(da=step), atol=1e-6)
        np.testing.assert_allclose(found.twist.d_wheels[:, j], difference(dw=step), atol=1e-6)
        np.testing.assert_allclose(found.twist.d_cg[:, j], difference(dg=step), atol=1e-6)
    np.testing.assert_allclose(found.d_cg_height, difference(dh=h), atol=1e-6)
    for j, step in enumerate(h * np.eye(len(params))):
        np.testing.assert_allclose(found.twist.d_params[:, j], difference(dp=step), atol=1e-6, err_msg=NAMES[j])


@given(st.floats(-1, 1), st.floats(-2, 2), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
@example(-0.375, -1.25, 0.0, 0.21875)  # the left wheels all but stand, and friction turns round
@example(0.5625, 1.8125, 0.0, 0.21875)
@example(0.11219578, 0.21908915, 0.24748486, 0.02540118)
@settings(max_examples=200, deadline=None)
def test_slope_wheels_give_the_command(vx, wz, a_x, a_y):
    command, slope = np.array([vx, wz]), Slope(np.array([a_x, a_y]), HEIGHT)
    wheels = MODEL.wheels_on_slope(command, np.zeros(2), with_params(), slope)
    got = MODEL.twist_on_slope(wheels, np.zeros(2), with_params(), slope).twist.value[[0, 2]]
    np.testing.assert_allclose(got, command, atol=1e-6)


def test_slope_twist_converges_up_to_what_friction_holds():
    """Any wheel rates, CGs and slopes up to 95 % of friction and of the wheels' edge; still wheels hold still."""
    rng = np.random.default_rng(4)
    n, params = 20_000, with_params()
    angle, steep = rng.uniform(-math.pi, math.pi, (2, n)), rng.uniform(0.0, 0.95 * 0.8, n)
    down = steep[:, None] * np.stack([np.cos(angle[0]), np.sin(angle[0])], axis=-1)
    wheels = np.stack([np.cos(angle[1]), np.sin(angle[1])], axis=-1) * 10.0 ** rng.uniform(-3, 2, (n, 1))
    wheels[:100] = 0.0
    cg = rng.uniform(-0.5, 0.5, (n, 2)) * [WHEELBASE / 2, TRACK / 2]
    down[(np.abs(cg + 0.25 * down) > 0.95 * np.array([WHEELBASE / 2, TRACK / 2])).any(axis=-1)] *= 0.3
    found = MODEL.twist_on_slope(wheels, cg, params, Slope(down, 0.25))
    for field in (found.twist.value, found.twist.d_wheels, found.twist.d_params, found.d_downhill, found.d_cg_height):
        assert np.isfinite(field).all()
    assert not found.twist.value[:100].any()


@pytest.mark.parametrize("downhill", [(0.9, 0.0), (0.0, -0.81), (0.6, 0.6)])
def test_slope_beyond_friction_is_refused(downhill):
    with pytest.raises(ModelError, match=r"steeper than friction holds \(mu 0.80: 38.7 deg\): this robot slides down"):
        MODEL.twist_on_slope(np.ones(2), np.zeros(2), with_params(), Slope(np.array(downhill), 0.1))


@pytest.mark.parametrize("downhill", [(0.65, 0.0), (0.0, -0.72)])
def test_slope_beyond_the_wheels_tips_the_robot_over(downhill):
    for call in (MODEL.twist_on_slope, MODEL.wheels_on_slope):
        with pytest.raises(CgError, match=r"slope of .* deg .* CG 0.40 m high beyond the wheels: this robot tips over"):
            call(np.ones(2), np.zeros(2), with_params(), Slope(np.array(downhill), HEIGHT))


def test_slope_that_is_not_finite_is_refused():
    with pytest.raises(ModelError, match=r"the slope is .*nan.*; it must be finite"):
        MODEL.twist_on_slope(np.ones(2), np.zeros(2), with_params(), Slope(np.array([math.nan, 0.0]), HEIGHT))


def test_slope_follows_the_ros_signs():
    """Nose down (pitch > 0) is downhill ahead; left side up (roll > 0) is downhill to the right."""
    s, c = math.sin(math.radians(5)), math.cos(math.radians(5))
    np.testing.assert_allclose(Slope.from_up(np.array([-s, 0.0, c]), 0.4).downhill, [tangent(5), 0.0], atol=1e-12)
    np.testing.assert_allclose(Slope.from_up(np.array([0.0, s, c]), 0.4).downhill, [0.0, -tangent(5)], atol=1e-12)


def test_slope_twist_takes_microseconds():
    """Value and all derivatives: 1.0 us on an idle core; the best of many rounds, as other processes may run."""
    rng = np.random.default_rng(0)
    wheels, cg = rng.uniform(-6, 6, (1000, 2)), rng.uniform(-0.05, 0.05, (1000, 2))
    slope = Slope(rng.uniform(-0.15, 0.15, (1000, 2)), HEIGHT)
    MODEL.twist_on_slope(wheels, cg, with_params(), slope)
    seconds = []
    for _ in range(30):
        start = time.thread_time()
        MODEL.twist_on_slope(wheels, cg, with_params(), slope)
        seconds.append(time.thread_time() - start)
    assert min(seconds) / 1000 < 10e-6
