"""The laws that every motion model obeys. They run for each model in the registry by themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion_models.errors import SkidlocError
from motion_models.preintegration import preintegrate
from motion_models.registry import MODELS, make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot, parse_robot, robot_toml
from tests.helpers.extended import cases
from tests.helpers.motion_models import assert_one_agrees, differences, some_drive, some_params

ROBOT = load_robot("vaultbot")
TERMS = """
[models.{}.terms]
vx = {{"v*abs(v)" = 0.03, "wz*cg_y" = [0.2, 0.1]}}
vy = {{"wz*abs(wz)" = [-0.12, 0.01, "m s"], "v*abs(wz)" = 0.01}}
wz = {{"abs(v)*wz" = 0.05, "sign(wz)*wz^2*cg_x" = 0.02}}
"""
EXTENDED = " with terms"
MIRROR = np.array([1.0, -1.0, -1.0])  # vx, vy, wz of a robot seen in a mirror along its x axis

WITH_TERMS = [f"{name}{EXTENDED}" for name in ("diff_drive", "skid_steer", "friction")]
pytestmark = pytest.mark.parametrize("name", cases([*MODELS, *WITH_TERMS], [*MODELS, WITH_TERMS[0]]))
# Numbers come from a generator and not from hypothesis, whose round ones sit on kinks (a wheel that just lifts off).
drawn = given(seed=st.integers(0, 2**32 - 1))
few = settings(max_examples=25, deadline=None)


def some_model(name):
    """A model by its name, with learned terms where it ends so."""
    plain = name.removesuffix(EXTENDED)
    text = robot_toml(ROBOT) + (TERMS.format(plain) if plain != name else "")
    return make_model(plain, parse_robot(text, "test"))


def mirrored(wheels, cg):
    return wheels[..., ::-1], cg * [1, -1]


def identify(model, wheels, cg, value, start):
    """Parameters with which the model moves as ``value`` (n, 3), from ``start``: Levenberg-Marquardt on the model's own derivatives."""
    p, damping = start, 1e-3
    twist = model.twist(wheels, cg, p)
    for _ in range(200):
        residual = (value - twist.value).ravel()
        jacobian = twist.d_params.reshape(residual.size, -1)
        size = np.linalg.norm(jacobian, axis=0)
        rows = np.vstack([jacobian / size, np.sqrt(damping) * np.eye(p.size)])
        step = np.linalg.lstsq(rows, np.append(residual, np.zeros(p.size)), rcond=None)[0] / size
        try:
            trial = model.twist(wheels, cg, p + step)
        except SkidlocError:  # a step to where no robot is
            damping *= 10.0
            continue
        if np.linalg.norm(value - trial.value) <= np.linalg.norm(residual):
            p, twist, damping = p + step, trial, max(damping / 10.0, 1e-15)
            if np.all(np.abs(step) < 1e-14 * (1 + np.abs(p))):
                break
        else:
            damping *= 10.0
            if damping > 1e9:
                break
    return p


@drawn
@few
def test_twist_derivatives_of_every_model_are_differences(name, seed):
    rng = np.random.default_rng(seed)
    model = some_model(name)
    params = some_params(model, rng)
    wheels, cg = some_drive(rng, 5)
    twist = model.twist(wheels, cg, params)
    for j in range(2):
        assert_one_agrees(twist.d_wheels[..., j], differences(lambda q: model.twist(q, cg, params).value, wheels, j))
        assert_one_agrees(twist.d_cg[..., j], differences(lambda c: model.twist(wheels, c, params).value, cg, j))
    for j in range(params.size):
        assert_one_agrees(twist.d_params[..., j], differences(lambda p: model.twist(wheels, cg, p).value, params, j))


@drawn
@few
def test_twist_of_still_wheels_is_zero(name, seed):
    rng = np.random.default_rng(seed)
    model = some_model(name)
    twist = model.twist(np.zeros((4, 2)), some_drive(rng, 4)[1], some_params(model, rng))
    assert not twist.value.any()
    assert not twist.d_cg.any()
    assert not twist.d_params.any()
    assert np.isfinite(twist.d_wheels).all()


@drawn
@settings(max_examples=5, deadline=None)
def test_twist_of_a_mirrored_robot_is_mirrored(name, seed):
    """Whatever is deliberately lopsided in a model (a warp, unlike sides) must be in its parameters: so a mirrored robot has some too."""
    rng = np.random.default_rng(seed)
    model = some_model(name)
    params = some_params(model, rng)
    wheels, cg = some_drive(rng, 200)
    image = model.twist(wheels, cg, params).value * MIRROR
    there = mirrored(wheels, cg)
    reflected = identify(model, *there, image, params)
    np.testing.assert_allclose(model.twist(*there, reflected).value, image, atol=1e-9)

    symmetric = (params + reflected) / 2
    here, there = model.twist(wheels, cg, symmetric).value, model.twist(*there, symmetric).value
    np.testing.assert_allclose(there, here * MIRROR, atol=1e-9)


@drawn
@few
def test_preintegrate_of_cut_intervals_is_that_of_whole_ones(name, seed):
    rng = np.random.default_rng(seed)
    model = some_model(name)
    params = some_params(model, rng)
    wheels, cg = some_drive(rng, 6)
    dt = rng.uniform(0.01, 0.3, 6)
    whole = preintegrate(model, dt, wheels, cg, params, WheelNoise())
    pieces = rng.uniform(0.1, 0.9, (6, 1)) * dt[:, None]
    cut = np.concatenate([pieces, dt[:, None] - pieces], axis=1).ravel()
    both = preintegrate(model, cut, wheels.repeat(2, axis=0), cg.repeat(2, axis=0), params, WheelNoise())
    np.testing.assert_allclose(both.delta, whole.delta, atol=1e-12)
    np.testing.assert_allclose(both.d_params, whole.d_params, atol=1e-9 * (1 + np.abs(whole.d_params).max()))
    np.testing.assert_allclose(both.d_cg, whole.d_cg, atol=1e-9 * (1 + np.abs(whole.d_cg).max()))


@drawn
@few
def test_wheels_of_a_command_give_the_command(name, seed):
    rng = np.random.default_rng(seed)
    model = some_model(name)
    params = some_params(model, rng)
    cg = rng.uniform(-1, 1, (20, 2)) * [0.12, 0.05]
    command = rng.uniform(-1, 1, (20, 2)) * [1.0, 1.0]
    command[:4] = [[0, 0], [0.5, 0], [0, 0.5], [-0.5, 0.1]]
    wheels = model.wheels(command, cg, params)
    np.testing.assert_allclose(model.twist(wheels, cg, params).value[:, [0, 2]], command, atol=1e-9)


@drawn
@few
def test_twist_of_a_batch_is_a_loop(name, seed):
    rng = np.random.default_rng(seed)
    model = some_model(name)
    params = some_params(model, rng)
    wheels, cg = some_drive(rng, 6)
    wheels = wheels.reshape(2, 3, 2)
    batch = model.twist(wheels, cg[:3], params)  # (2, 3, 2) against (3, 2)
    inverse = model.wheels(batch.value[..., [0, 2]], cg[:3], params)
    for i in range(2):
        for j in range(3):
            one = model.twist(wheels[i, j], cg[j], params)
            for field in ("value", "d_wheels", "d_cg", "d_params"):
                np.testing.assert_array_equal(getattr(batch, field)[i, j], getattr(one, field))
            alone = model.wheels(batch.value[i, j, [0, 2]], cg[j], params)
            np.testing.assert_allclose(inverse[i, j], alone, rtol=1e-9, atol=1e-9)


@drawn
@settings(max_examples=5, deadline=None)
def test_fit_of_clean_data_recovers_the_parameters(name, seed):
    rng = np.random.default_rng(seed)
    model = some_model(name)
    truth = some_params(model, rng)
    wheels, cg = some_drive(rng, 200)
    twist = model.twist(wheels, cg, truth)
    found = identify(model, wheels, cg, twist.value, some_params(model, rng))
    np.testing.assert_allclose(model.twist(wheels, cg, found).value, twist.value, atol=1e-9)

    # Only what shows can be recovered, but every parameter must show, alone at least.
    columns = twist.d_params.reshape(-1, truth.size)
    size = np.linalg.norm(columns, axis=0)
    assert (size > 1e-6 * size.max()).all()
    _, values, directions = np.linalg.svd(columns / size, full_matrices=False)
    seen = directions[values > 1e-7 * values[0]]
    np.testing.assert_allclose(seen @ (size * (found - truth)), 0.0, atol=1e-6 * np.linalg.norm(columns @ truth))
    assert len(seen) >= truth.size - 1
