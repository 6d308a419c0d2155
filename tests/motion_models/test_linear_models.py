"""What sets the ICR model and the full linear model apart; the laws that all models share are tested elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion_models.errors import ModelError
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

ROBOT = load_robot("husky_a200")
CG = np.zeros(2)
RATE = st.floats(-8.0, 8.0)
SLIP = np.array([0.04, 0.1, 0.2, 0.03, 0.05, 0.15])


@pytest.mark.extended
@settings(deadline=None)  # the first example compiles
@given(RATE, RATE, st.floats(0.3, 1.5), st.floats(-1.5, -0.3), st.floats(-0.2, 0.2), st.floats(0.8, 1.2), st.floats(0.8, 1.2))
def test_icr_tread_at_its_icr_does_not_slip_lengthwise(
    left: float, right: float, y_l: float, y_r: float, x: float, a_l: float, a_r: float
) -> None:
    """The definition of the ICRs, checked on the twist: the body at (x_icr, y_s) moves as the tread does, and not sideways."""
    model = make_model("icr", ROBOT)
    vx, vy, wz = model.twist(np.array([left, right]), CG, np.array([y_l, y_r, x, a_l, a_r])).value
    r = ROBOT.geometry.wheel_radius_m
    for y, alpha, rate in ((y_l, a_l, left), (y_r, a_r, right)):
        assert vx - wz * y == pytest.approx(alpha * r * rate, abs=1e-9)
    assert vy + wz * x == pytest.approx(0.0, abs=1e-12)


def test_linear_models_without_slip_are_the_diff_drive() -> None:
    rng = np.random.default_rng(0)
    wheels = rng.uniform(-8.0, 8.0, (50, 2))
    base = make_model("diff_drive", ROBOT)
    expected = base.twist(wheels, CG, base.nominal).value
    for name in ("icr", "full_linear"):
        model = make_model(name, ROBOT)
        np.testing.assert_allclose(model.twist(wheels, CG, model.nominal).value, expected, atol=1e-12)


def test_full_linear_holds_the_icr_model() -> None:
    icr, linear = make_model("icr", ROBOT), make_model("full_linear", ROBOT)
    params = np.array([0.7, -0.6, -0.05, 0.95, 1.02])
    matrix = icr.twist(np.zeros(2), CG, params).d_wheels
    wheels = np.random.default_rng(1).uniform(-8.0, 8.0, (50, 2))
    full = np.concatenate([matrix.reshape(6), np.zeros(6)])
    np.testing.assert_allclose(linear.twist(wheels, CG, full).value, icr.twist(wheels, CG, params).value, atol=1e-12)


@given(RATE, RATE, st.floats(0.1, 10.0))
def test_full_linear_curvature_losses_are_independent_of_speed(left: float, right: float, factor: float) -> None:
    model = make_model("full_linear", ROBOT)
    curvature, speed = model.nominal.copy(), model.nominal.copy()
    curvature[[8, 11]] = 0.3, 0.2
    speed[[6, 7, 9, 10]] = SLIP[[0, 1, 3, 4]]
    wheels = np.array([left, right])
    once, more = (model.twist(f * wheels, CG, curvature).value for f in (1.0, factor))
    np.testing.assert_allclose(more, factor * once, atol=1e-9)
    linear = model.twist(wheels, CG, model.nominal).value
    once, more = (model.twist(f * wheels, CG, speed).value - f * linear for f in (1.0, factor))
    np.testing.assert_allclose(more, factor**2 * once, atol=1e-9)


def test_full_linear_losses_are_those_of_the_formulas() -> None:
    """At one side standing, by hand: T = 1/2."""
    model = make_model("full_linear", ROBOT)
    params = model.nominal.copy()
    params[6:] = SLIP
    r, track = 0.1651, 1.875 * 0.5708
    u, w = r * 4.0 / 2.0, r * 4.0 / track
    vx, vy, wz = model.twist(np.array([0.0, 4.0]), CG, params).value
    assert vx == pytest.approx(u * (1.0 - 0.1 * w - 0.2 / 2.0))
    assert vy == pytest.approx(0.04 * u * w)
    assert wz == pytest.approx(w * (1.0 - 0.03 * u - 0.05 * w - 0.15 / 2.0))


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_full_linear_wheels_with_all_terms_give_the_command(vx: float, wz: float) -> None:
    model = make_model("full_linear", ROBOT)
    params = model.nominal.copy()
    params[6:] = SLIP
    wheels = model.wheels(np.array([vx, wz]), CG, params)
    np.testing.assert_allclose(model.twist(wheels, CG, params).value[[0, 2]], [vx, wz], atol=1e-9)


def test_full_linear_wheels_of_impossible_commands_are_refused() -> None:
    model = make_model("full_linear", ROBOT)
    params = model.nominal.copy()
    params[7] = 2.0  # all forward motion is lost at half a radian per second
    with pytest.raises(ModelError, match=r"no wheel rates give vx = 0\.5 m/s with wz = 0\.6"):
        model.wheels(np.array([[0.1, 0.0], [0.5, 0.6]]), CG, params)
    params[[4, 5]] = params[[0, 1]]
    with pytest.raises(ModelError, match="no wheel rates steer"):
        model.wheels(np.array([0.1, 0.0]), CG, params)
