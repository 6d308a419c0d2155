"""The physics of four skidding wheels as states: the offset of the CG, the ratio of frictions, the warp; in filter and graph alike."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.consistency import mean_band
from localization.estimators.ekf import EkfConfig
from localization.estimators.fusion import EkfFusion
from localization.estimators.graph_fusion import GraphConfig, GraphFusion
from localization.online.core import Core, Pair
from localization.synchronizer import Step
from motion_models.base import Motion
from motion_models.corrections import check_forms, correctable, corrections
from motion_models.errors import CgError, ModelError
from motion_models.friction import FrictionModel
from motion_models.friction_corrected import CorrectedFriction
from motion_models.integrate import preintegrate
from motion_models.registry import make_model
from motion_models.robot import WheelNoise, load_robot
from motion_models.se2 import between, log
from tests.graph_help import BOTH, beliefs
from tests.synthetic_steps import Noise, Seer, World, drive, straight, weave
from tests.test_model_laws import assert_one_agrees, differences, some_drive, some_params

ROBOT = load_robot("vaultbot")
OFFSET = "mu_ratio+cg_offset_x+cg_offset_y"
ALL = "constant+warp+cg_offset_x+cg_offset_y"
CG = (0.03, 0.0)


def corrected_friction():
    return CorrectedFriction.from_robot(ROBOT)


# --- the model


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_its_derivatives_are_those_of_differences(seed):
    rng = np.random.default_rng(seed)
    model = corrected_friction()
    params = some_params(model, rng)
    wheels, cg = some_drive(rng, 5)
    twist = model.twist(wheels, cg, params)
    assert twist.d_params.shape == (5, 3, 14)
    for j in range(2):
        assert_one_agrees(twist.d_cg[..., j], differences(lambda c: model.twist(wheels, c, params).value, cg, j))
    for j in range(params.size):
        assert_one_agrees(twist.d_params[..., j], differences(lambda p: model.twist(wheels, cg, p).value, params, j))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_derivatives_of_a_whole_motion_too(seed):
    """What filter and graph are given: the preintegrated motion, as a right perturbation."""
    rng = np.random.default_rng(seed)
    model = corrected_friction()
    params = some_params(model, rng)
    wheels, cg = some_drive(rng, 4)
    dt = rng.uniform(0.02, 0.1, 4)

    def delta(p):
        return preintegrate(model, dt, wheels, cg, p, WheelNoise()).delta

    motion = preintegrate(model, dt, wheels, cg, params, WheelNoise())
    for j in range(params.size):
        assert_one_agrees(motion.d_params[:, j], differences(lambda p: log(between(motion.delta, delta(p))), params, j))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_an_offset_is_a_cg_that_is_elsewhere(seed):
    rng = np.random.default_rng(seed)
    model, inner = corrected_friction(), make_model("friction", ROBOT)
    wheels, cg = some_drive(rng, 5)
    offset = rng.uniform(-0.05, 0.05, 2)
    found, expected = model.twist(wheels, cg, np.append(inner.nominal, offset)), inner.twist(wheels, cg + offset, inner.nominal)
    np.testing.assert_array_equal(found.value, expected.value)
    np.testing.assert_array_equal(found.d_params[..., -2:], expected.d_cg)
    command = np.array([0.3, 0.4])
    there = model.wheels(command, np.array(CG), np.append(inner.nominal, offset))
    np.testing.assert_array_equal(there, inner.wheels(command, np.array(CG) + offset, inner.nominal))


@pytest.mark.parametrize(("name", "value"), [("mu_ratio", -0.4), ("cg_offset_x", 0.6), ("cg_offset_y", -3.0)])
def test_a_belief_where_no_robot_is_moves_as_one_at_the_edge_and_nothing_there_teaches(name, value):
    model = corrected_friction()
    i = model.param_names.index(name)
    params, further = model.nominal, model.nominal
    params[i], further[i] = value, 1.5 * value
    wheels, cg = np.array([[2.0, 4.0], [-3.0, 3.0]]), np.array(CG)
    twist = model.twist(wheels, cg, params)
    assert np.isfinite(twist.value).all()
    assert not twist.d_params[..., i].any()
    np.testing.assert_array_equal(twist.value, model.twist(wheels, cg, further).value)


def test_a_cg_that_is_said_to_be_outside_is_still_refused():
    model = corrected_friction()
    with pytest.raises(CgError, match="tips over"):
        model.twist(np.array([1.0, 2.0]), np.array([0.4, 0.0]), model.nominal)
    with pytest.raises(CgError):
        model.twist(np.array([1.0, 2.0]), np.array([np.nan, 0.0]), model.nominal)


# --- switched on by name


def test_names_say_what_is_learned_and_in_which_order():
    model = correctable(make_model("friction", ROBOT), ALL)
    assert corrections(model, "constant").names == ("mu_ratio", "tracked_x", "tracked_y")
    assert corrections(model, ALL).names == ("mu_ratio", "tracked_x", "tracked_y", "warp", "cg_offset_x", "cg_offset_y")
    assert corrections(model, "warp+mu_ratio+warp").names == ("warp", "mu_ratio")
    found = corrections(model, "cg_offset_y")
    np.testing.assert_array_equal(found.directions.nonzero()[0], [model.param_names.index("cg_offset_y")])
    assert corrections(make_model("skid_steer", ROBOT), "x_cr_0").names == ("x_cr_0",)
    assert not corrections(model, "none").names
    assert check_forms(["constant", OFFSET, "constant"]) == ["constant", OFFSET]


@pytest.mark.parametrize("form", ["", "+", "cg_offset", "constant+none", "cg_field+warp", "mu_ratio+", "constant+constant+x"])
def test_forms_that_do_not_exist_are_refused(form):
    with pytest.raises(ModelError, match="cg_offset_x"):
        check_forms([form])


def test_what_a_model_does_not_have_is_refused():
    with pytest.raises(ModelError, match="wheel_separation_multiplier"):
        corrections(make_model("diff_drive", ROBOT), "warp")
    with pytest.raises(ModelError, match="correctable"):
        corrections(make_model("friction", ROBOT), "cg_offset_x")
    with pytest.raises(ModelError, match="warp"):
        Core(Pair(make_model("icr", ROBOT), "ekf", "warp"), ROBOT, {}, True)


@pytest.mark.parametrize("kind", BOTH)
def test_a_pair_gives_stepper_and_estimator_the_same_parameters(kind):
    core = Core(Pair(make_model("friction", ROBOT), kind, OFFSET), ROBOT, {}, True)
    assert isinstance(core.stepper._model, CorrectedFriction)
    np.testing.assert_array_equal(core.stepper.params, core.estimator.params)
    assert set(OFFSET.split("+")) <= set(core.estimator.parameters())
    plain = Core(Pair(make_model("friction", ROBOT), kind, "none"), ROBOT, {}, True)
    assert isinstance(plain.stepper._model, FrictionModel)


# --- learned where the motion shows it


def make(kind, seer, form, noise):
    robot = replace(ROBOT, wheel_noise=noise.wheels, gyro_noise=noise.gyro)
    model = correctable(make_model("friction", robot), form)
    corrected = corrections(model, form)
    if kind == "ekf":
        return EkfFusion(model, corrected, robot, {}, True, EkfConfig(), witness=seer)
    return GraphFusion(model, corrected, robot, {}, True, GraphConfig(), EkfConfig(), witness=seer)


def learned(kind, form, hidden, seed, wheels=weave, steps=150):
    """Errors (k,) and covariance (k, k) of the corrections after a drive of a robot whose own are ``hidden`` (k,), and the first sigmas."""
    seer, noise = Seer(), Noise()
    estimator = make(kind, seer, form, noise)
    world = World(estimator._model, estimator._corrected, noise, np.random.default_rng(seed), True, EkfConfig(), wheels, cg=lambda t: CG)
    world.correction = np.array(hidden)
    for _ in drive(world, estimator, seer, steps):
        pass
    slow, P = beliefs(estimator)
    k = len(hidden)
    return world.correction - slow[-k:], P[-k:, -k:], estimator._corrected.sigmas


@pytest.mark.parametrize("kind", BOTH)
def test_a_hidden_offset_of_the_cg_is_found_as_well_as_is_said(kind):
    """Twelve drives, the CG 4 cm ahead and 2 cm to the right of where it is said to be, with a floor of another grip."""
    hidden = np.array([0.15, 0.04, -0.02])
    found = [learned(kind, OFFSET, hidden, seed) for seed in range(12)]
    sigmas = np.array([np.sqrt(np.diag(P)) for _, P, _ in found])
    assert (sigmas < 0.5 * found[0][2]).all()  # it shows
    squared = [float(e @ np.linalg.solve(P, e)) for e, P, _ in found]
    low, high = mean_band(len(found), len(hidden), 0.99)
    assert low < np.mean(squared) < high
    errors = np.array([e for e, _, _ in found])
    within = (np.abs(errors) < sigmas).mean()
    assert 0.5 < within < 0.85  # of 36; an honest sigma holds 68 %
    assert (np.abs(errors.mean(axis=0)) < 3.0 * sigmas.mean(axis=0) / math.sqrt(len(found))).all()
    assert (np.abs(errors.mean(axis=0)) < 0.3 * np.abs(hidden)).all()  # nowhere near the 0 that was believed at first


@pytest.mark.parametrize("kind", BOTH)
def test_straight_ahead_shows_nothing_of_the_physics(kind):
    error, cov, first = learned(kind, ALL, np.zeros(6), 0, straight)
    sigmas = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(sigmas, first, rtol=0.01)  # they walk a little
    assert (sigmas >= first).all()
    assert (np.abs(error) < 0.01 * first + 3.0 * first * math.sqrt(15.0 / 3600.0)).all()  # it is the truth that walked


@pytest.mark.parametrize("kind", BOTH)
def test_wheels_that_differ_by_their_noise_alone_teach_nothing(kind):
    """Nearly straight: derivatives there are of noise. The LiDAR sees a turn that no wheel made, over and over."""
    seer = Seer()
    estimator = make(kind, seer, ALL, Noise())
    world = World(
        estimator._model, estimator._corrected, Noise(), np.random.default_rng(0), True, EkfConfig(), lambda t: (4.0, 4.02), cg=lambda t: CG
    )
    estimator.step(world.first())
    for _ in range(60):
        step, _ = world.step(estimator.params, estimator.clock_offset_s)
        seer.next = Motion(np.array([step.predicted.delta[0], 0.0, 0.02]), np.diag([0.005, 0.005, 0.001]) ** 2)
        estimator.step(step)
    slow, P = beliefs(estimator)
    first = estimator._corrected.sigmas
    assert (np.sqrt(np.diag(P)[-6:]) > 0.99 * first).all()
    assert (np.abs(slow[-6:]) < 0.1 * first).all()


@pytest.mark.parametrize("kind", BOTH)
def test_a_lidar_that_drives_the_beliefs_mad_does_not_end_the_run(kind):
    """Motions that no offset and no grip explains: the beliefs go where no robot is, the estimate goes on."""
    seer = Seer()
    estimator = make(kind, seer, ALL, Noise().scaled(0.1))
    rng, stamp = np.random.default_rng(1), 0
    model = estimator._model
    none = Motion(np.zeros(3), np.zeros((3, 3)), np.zeros((3, 14)))
    estimator.step(Step(0, 0, none, np.zeros(3), np.zeros(3), False, True, None, None))
    for _ in range(80):
        wheels, dt = np.array([[-3.0, 3.0]]), np.array([0.1])
        motion = preintegrate(model, dt, wheels, np.array([CG]), estimator.params, WheelNoise())
        seer.next = Motion(motion.delta * [0.0, 0.0, 3.0] + [0.2, -0.2, 0.0] + 0.01 * rng.normal(size=3), 1e-6 * np.eye(3))
        scan = World(model, estimator._corrected, Noise(), rng)._scan(stamp + 100_000_000)
        estimate = estimator.step(Step(stamp, stamp + 100_000_000, motion, np.zeros(3), np.zeros(3), False, True, None, scan))
        stamp += 100_000_000
        assert np.isfinite(estimate.pose).all()
        assert np.isfinite(model.twist(wheels, np.array([CG]), estimator.params).value).all()
