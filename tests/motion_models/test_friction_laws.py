"""Laws of the contact: what any combined slip obeys, what the thesis's law does not, and the options of a robot file."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion_models.errors import ModelError, RobotError
from motion_models.friction import FrictionModel
from motion_models.friction.contact import CREEP, SATURATION, contact, tyre
from motion_models.friction.model import STIFFNESS
from motion_models.registry import make_model
from motion_models.robot_file import load_robot, parse_robot, robot_toml

VAULTBOT, HUSKY = load_robot("vaultbot"), load_robot("husky_a200")
MODEL = FrictionModel.from_robot(HUSKY)
LAWS = pytest.mark.parametrize("saturation", [*SATURATION.values(), 0.4])
SIZES = {"vaultbot": (0.56, 0.52), "husky": (0.5708, 0.512), "warthog": (1.08, 0.8), "jackal": (0.3756, 0.262), "long": (0.4, 0.9)}
speeds = st.floats(-2.0, 2.0)


def with_params(model=MODEL, **changes):
    params = model.nominal.copy()
    for name, value in changes.items():
        params[model.param_names.index(name)] = value
    return params


def wheels_at(angles):
    """(n, 2) rates from straight on (0) to a turn in place (pi / 2)."""
    return np.stack([np.cos(angles) - np.sin(angles), np.cos(angles) + np.sin(angles)], axis=-1)


def rotation_scaling(model, params, angles, cg=(0.0, 0.0)):
    """(n,) k at wheel rates of ``angles`` (n,)."""
    wheels = wheels_at(angles)
    wz = model.twist(wheels, np.array(cg), params).value[:, 2]
    return wz * params[1] / (params[0] * (wheels[:, 1] - wheels[:, 0]))


@pytest.mark.parametrize("size", list(SIZES))
@pytest.mark.parametrize("stiffness", [1.0, 10.0, 1000.0])
def test_isotropic_k_in_place_is_that_of_the_geometry(size, stiffness):
    """Proportional tyres and sliding ones have the same k = 1 / (1 + (wheelbase / track)^2), if the contact is isotropic."""
    track, wheelbase = SIZES[size]
    params = with_params(track_width=track, wheelbase=wheelbase, slip_stiffness=stiffness, rolling_resistance=0.0)
    assert rotation_scaling(MODEL, params, np.array([math.pi / 2]))[0] == pytest.approx(1 / (1 + (wheelbase / track) ** 2), rel=1e-6)


@pytest.mark.parametrize("size", list(SIZES))
def test_isotropic_k_of_gentle_arcs_is_that_of_the_geometry(size):
    track, wheelbase = SIZES[size]
    params = with_params(track_width=track, wheelbase=wheelbase, rolling_resistance=0.0)
    assert rotation_scaling(MODEL, params, np.array([1e-4]))[0] == pytest.approx(1 / (1 + (wheelbase / track) ** 2), rel=1e-3)
    k = rotation_scaling(MODEL, params, np.linspace(1e-4, math.pi / 2, 200))
    np.testing.assert_allclose(k / k[-1], 1.0, atol=0.02)


@LAWS
def test_isotropic_k_from_turns_to_arcs_falls_steadily(saturation):
    """With a CG ahead; and by the thesis's law with a centred one, too."""
    model = FrictionModel(MODEL.nominal, saturation)
    params = with_params(rolling_resistance=0.0)
    for cg in [(0.08, 0.0), *([(0.0, 0.0)] if saturation == 1.0 else [])]:
        k = rotation_scaling(model, params, np.linspace(1e-3, math.pi / 2, 200), cg)
        assert np.all(np.diff(k) > -1e-9)
        assert k[0] < 0.9 * k[-1]


def test_thesis_law_on_gentle_arcs_loses_the_turn():
    thesis = FrictionModel(MODEL.nominal, SATURATION["thesis"])
    k = rotation_scaling(thesis, with_params(rolling_resistance=0.0), np.array([0.02, 0.05, 0.1, math.pi / 2]))
    assert k[0] < 0.4 * k[-1]
    assert k[2] < 0.85 * k[-1]


def test_x_cr_in_place_moves_twice_as_far_as_the_cg():
    params = with_params(rolling_resistance=0.0)
    for angle, low, high in ((math.pi / 2, 1.9, 2.3), (1e-3, 0.95, 1.1)):
        _, vy, wz = MODEL.twist(wheels_at(np.array(angle)), np.array([0.02, 0.0]), params).value
        assert low < -vy / wz / 0.02 < high


@given(st.floats(0.0, 2 * math.pi), st.floats(1e-6, 0.9), st.floats(1.0, 30.0))
@settings(deadline=None)
def test_isotropic_force_opposes_the_slip_in_all_directions(direction, size, stiffness):
    on = tyre(stiffness, 1.0, 0.0, 0.0)
    slip, drift = -abs(size * math.cos(direction)), size * math.sin(direction)  # a braking wheel: V is its own speed
    f = contact(slip, drift, 1.0, on, CREEP)
    along = contact(-size, 0.0, 1.0, on, CREEP)
    assert f.x * drift - f.y * slip == pytest.approx(0.0, abs=1e-15)
    assert math.hypot(f.x, f.y) == pytest.approx(abs(along.x), rel=1e-9)


def test_isotropic_force_at_zero_slip_is_continuous():
    for direction in np.linspace(0, 2 * math.pi, 9):
        c, s = 1e-5 * math.cos(direction), 1e-5 * math.sin(direction)
        f = contact(c, s, 1.0, tyre(10.0, 1.0, 0.0, 0.0), CREEP)
        np.testing.assert_allclose([f.x, f.y], [-10.0 * c, -10.0 * s], rtol=0.01, atol=1e-12)  # proportional, with slope K
        g = contact(c, s, 1.0, tyre(10.0, 1.0, 0.0, 1.0), 1e-9)
        assert abs(g.y) == pytest.approx(abs(math.sin(direction)), rel=1e-4, abs=1e-4)  # all of mu N at once
    assert contact(0.0, 0.0, 1.0, tyre(10.0, 1.0, 0.0, 0.0), CREEP)[:2] == (0.0, 0.0)


@LAWS
@given(speeds, speeds, speeds, st.floats(0.1, 50.0), st.floats(0.3, 2.0), st.floats(-0.9, 0.9))
@settings(deadline=None)
def test_contact_force_never_creates_power(saturation, slip, drift, roll, stiffness, mu_ratio, tread):
    f = contact(slip, drift, roll, tyre(stiffness, mu_ratio, tread, saturation), CREEP)
    assert f.x * slip + f.y * drift <= 0.0
    assert math.hypot(f.x, f.y) <= max(1.0, mu_ratio) * (1.0 + abs(tread)) + 1e-12


@LAWS
@given(speeds, speeds, speeds, st.floats(1.0, 20.0))
@settings(deadline=None)
def test_contact_force_derivatives_are_differences(saturation, slip, drift, roll, stiffness):
    if min(abs(slip), abs(slip + 2 * roll), abs(roll)) < 1e-3:  # V has kinks there
        return
    h, creep = 1e-6, 0.02

    def force(slip, drift, roll, stiffness, tread=0.2):
        return contact(slip, drift, roll, tyre(stiffness, 1.1, tread, saturation), creep)

    f, at = force(slip, drift, roll, stiffness), np.array([slip, drift, roll, stiffness, 0.2])
    found = np.array([[f.x_slip, f.x_drift, f.x_roll, f.x_stiffness, 0.0], [f.y_slip, f.y_drift, f.y_roll, f.y_stiffness, f.y_tread]])
    steps = h * np.eye(5)
    numeric = np.array([np.subtract(force(*(at + e))[:2], force(*(at - e))[:2]) / (2 * h) for e in steps]).T
    np.testing.assert_allclose(found, numeric, atol=1e-5 * max(1.0, np.abs(numeric).max()))


@LAWS
@pytest.mark.parametrize("centripetal", [False, True])
def test_friction_twist_derivatives_are_differences(saturation, centripetal):
    rng = np.random.default_rng(3)
    model = FrictionModel(MODEL.nominal, saturation, centripetal)
    params = with_params(warp=0.1, tread=0.1, scrub=0.01, mu_ratio=1.1, tracked_x=0.1, tracked_y=-0.05)
    wheels, cg = rng.uniform(-6, 6, (300, 2)), rng.uniform(-0.08, 0.08, (300, 2))
    twist = model.twist(wheels, cg, params)
    # wheels that slip across with little speed of their own bend sharply: differences there need more digits than there are
    plain = np.abs(wheels).min(axis=1) > 0.5

    def differences(vary, n, h):
        found = [(model.twist(*vary(h * e)).value - model.twist(*vary(-h * e)).value) / (2 * h) for e in np.eye(n)]
        return np.stack(found, axis=-1)[plain]

    for got, numeric in (
        (twist.d_wheels, differences(lambda e: (wheels + e, cg, params), 2, 1e-6)),
        (twist.d_cg, differences(lambda e: (wheels, cg + e, params), 2, 1e-7)),
        (twist.d_params, differences(lambda e: (wheels, cg, params + e), len(params), 1e-6)),
    ):
        error = np.abs(got[plain] - numeric).max(axis=(1, 2))
        assert np.quantile(error, 0.97) < 1e-5 * (1 + np.abs(numeric).max())  # the rest has a kink within the step


@LAWS
def test_friction_twist_scales_with_speed_unless_centripetal(saturation):
    wheels, cg = np.array([[2.0, 5.0], [-1.0, 3.0], [4.0, 4.5]]), np.array([0.03, -0.01])
    model = FrictionModel(MODEL.nominal, saturation)
    slow = model.twist(wheels, cg, MODEL.nominal).value
    np.testing.assert_allclose(model.twist(1e3 * wheels, cg, MODEL.nominal).value, 1e3 * slow, rtol=1e-7)
    pulled = dataclasses.replace(model, centripetal=True)
    np.testing.assert_allclose(pulled.twist(1e-3 * wheels, cg, MODEL.nominal).value, 1e-3 * slow, rtol=1e-4, atol=1e-9)
    at_speed = pulled.twist(4.0 * wheels, cg, MODEL.nominal).value
    assert np.abs(at_speed - 4.0 * slow).max() > 0.01


def test_centripetal_force_moves_the_centre_of_rotation_forward():
    """m v w pushes outwards, so the contacts have to slip outwards."""
    pulled = dataclasses.replace(MODEL, centripetal=True)
    for wheels in ([10.0, 14.0], [14.0, 10.0]):
        plain, at_speed = (m.twist(np.array(wheels), np.zeros(2), MODEL.nominal).value for m in (MODEL, pulled))
        assert -at_speed[1] / at_speed[2] > -plain[1] / plain[2] + 0.02


@pytest.mark.parametrize(("saturation", "centripetal"), [(0.0, False), (0.4, False), (1.0, False), (0.0, True)])
def test_friction_wheels_at_any_speed_give_the_command(saturation, centripetal):
    rng = np.random.default_rng(8)
    model = FrictionModel(MODEL.nominal, saturation, centripetal)
    command, cg = rng.uniform([-2, -1.5], [2, 1.5], (500, 2)), rng.uniform(-0.1, 0.1, (500, 2))
    wheels = model.wheels(command, cg, MODEL.nominal)
    np.testing.assert_allclose(model.twist(wheels, cg, MODEL.nominal).value[:, [0, 2]], command, atol=1e-7)


def test_friction_model_takes_the_law_of_the_robot_file():
    text = robot_toml(HUSKY)
    thesis = parse_robot(text + '[models.friction]\ncontact = "thesis"\ncentripetal = true\nwarp = 0.1\n', "test.toml")
    model = FrictionModel.from_robot(thesis)
    assert (model.saturation, model.centripetal) == (SATURATION["thesis"], True)
    assert model.nominal[5] == STIFFNESS["thesis"]
    assert MODEL.saturation == SATURATION["isotropic"]
    assert MODEL.nominal[5] == STIFFNESS["isotropic"]
    assert parse_robot(robot_toml(thesis), "again.toml") == thesis


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('contact = "brush"', "models.friction.contact is 'brush'; there are isotropic, thesis"),
        ("contact = true", "models.friction.contact is True; there are isotropic, thesis"),
        ("contact = 1", "models.friction.contact must be text or true or false, found 1"),
        ('centripetal = "yes"', "models.friction.centripetal is 'yes'; it must be true or false"),
        ('slip_stiffness = "soft"', "models.friction.slip_stiffness must be a finite number of at most 1e.09, found 'soft'"),
    ],
)
def test_friction_model_of_an_unknown_law_is_refused(entry, message):
    with pytest.raises(RobotError, match=message):
        make_model("friction", parse_robot(f"{robot_toml(HUSKY)}[models.friction]\n{entry}\n", "test.toml"))


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_friction_twist_without_positive_stiffness_is_refused(value):
    robot = parse_robot(f"{robot_toml(HUSKY)}[models.friction]\nslip_stiffness = {value}\n", "test.toml")
    model = make_model("friction", robot)
    with pytest.raises(ModelError, match=f"must be positive .* slip_stiffness = {value:g}"):
        model.twist(np.ones(2), np.zeros(2), model.nominal)
