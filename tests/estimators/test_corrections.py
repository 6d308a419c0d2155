"""Corrections to the motion model as states of the filter: forms, physics of four skidding wheels, and what drives teach of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.core.filter import set_marginal
from localization.core.motion import FilterConfig
from localization.evaluation.consistency import mean_band
from localization.events import Step
from localization.pipeline import Pipeline, Trial
from motion_models import se2
from motion_models.errors import CgError, ModelError
from motion_models.friction import CorrectedFriction, FrictionModel
from motion_models.motion import Motion
from motion_models.online_calibration import add_correction_parameters, check_forms, make_corrections
from motion_models.preintegration import preintegrate
from motion_models.registry import MODELS, make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot
from motion_models.se2 import between, log
from tests.helpers.extended import cases
from tests.helpers.motion_models import assert_one_agrees, differences, some_drive, some_params
from tests.helpers.synthetic_steps import (
    DT,
    Noise,
    PoseSensor,
    World,
    drive,
    make_filter,
    make_world,
    match_at,
    run,
    slow_states,
    squared_errors,
    straight,
    weave,
)

ROBOT = load_robot("vaultbot")
OFFSET = "mu_ratio+cg_offset_x+cg_offset_y"
ALL = "constant+warp+cg_offset_x+cg_offset_y"
CG = (0.03, 0.0)
LEVELS = (0.3, 1.0, 2.0, 4.0)


def corrected_friction():
    return CorrectedFriction(FrictionModel.from_robot(ROBOT))


# --- the model


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_friction_correction_derivatives_equal_differences(seed):
    rng = np.random.default_rng(seed)
    model = corrected_friction()
    params = some_params(model, rng)
    wheels, cg = some_drive(rng, 5)
    twist = model.twist(wheels, cg, params)
    assert twist.d_params.shape == (5, 3, 15)
    for j in range(2):
        assert_one_agrees(twist.d_cg[..., j], differences(lambda c: model.twist(wheels, c, params).value, cg, j))
    for j in range(params.size):
        assert_one_agrees(twist.d_params[..., j], differences(lambda p: model.twist(wheels, cg, p).value, params, j))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_friction_motion_derivatives_equal_differences(seed):
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
def test_cg_offset_equals_cg_moved_by_it(seed):
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
def test_cg_offset_beyond_wheels_is_clamped_without_derivative(name, value):
    model = corrected_friction()
    i = model.param_names.index(name)
    params, further = model.nominal, model.nominal
    params[i], further[i] = value, 1.5 * value
    wheels, cg = np.array([[2.0, 4.0], [-3.0, 3.0]]), np.array(CG)
    twist = model.twist(wheels, cg, params)
    assert np.isfinite(twist.value).all()
    assert not twist.d_params[..., i].any()
    np.testing.assert_array_equal(twist.value, model.twist(wheels, cg, further).value)


def test_measured_cg_outside_wheels_is_refused():
    model = corrected_friction()
    with pytest.raises(CgError, match="tips over"):
        model.twist(np.array([1.0, 2.0]), np.array([0.4, 0.0]), model.nominal)
    with pytest.raises(CgError):
        model.twist(np.array([1.0, 2.0]), np.array([np.nan, 0.0]), model.nominal)


# --- switched on by name


def test_corrections_by_name_keep_their_order():
    model = add_correction_parameters(make_model("friction", ROBOT), ALL)
    assert make_corrections(model, "constant").names == ("mu_ratio", "tracked_x", "tracked_y")
    assert make_corrections(model, ALL).names == ("mu_ratio", "tracked_x", "tracked_y", "warp", "cg_offset_x", "cg_offset_y")
    assert make_corrections(model, "warp+mu_ratio+warp").names == ("warp", "mu_ratio")
    found = make_corrections(model, "cg_offset_y")
    np.testing.assert_array_equal(found.directions.nonzero()[0], [model.param_names.index("cg_offset_y")])
    assert make_corrections(make_model("skid_steer", ROBOT), "x_cr_0").names == ("x_cr_0",)
    assert not make_corrections(model, "none").names
    assert check_forms(["constant", OFFSET, "constant"]) == ["constant", OFFSET]


@pytest.mark.parametrize("form", ["", "+", "cg_offset", "constant+none", "cg_field+warp", "mu_ratio+", "constant+constant+x"])
def test_corrections_of_unknown_form_are_refused(form):
    with pytest.raises(ModelError, match="cg_offset_x"):
        check_forms([form])


def test_corrections_of_missing_parameter_are_refused():
    with pytest.raises(ModelError, match="wheel_separation_multiplier"):
        make_corrections(make_model("diff_drive", ROBOT), "warp")
    with pytest.raises(ModelError, match="add_correction_parameters"):
        make_corrections(make_model("friction", ROBOT), "cg_offset_x")
    with pytest.raises(ModelError, match="warp"):
        Pipeline(Trial(make_model("icr", ROBOT), "ekf", "warp"), ROBOT, {}, True)


def test_pipeline_gives_synchronizer_the_filters_parameters():
    pipeline = Pipeline(Trial(make_model("friction", ROBOT), "ekf", OFFSET), ROBOT, {}, True)
    assert isinstance(pipeline.synchronizer.wheels.model, CorrectedFriction)
    np.testing.assert_array_equal(pipeline.synchronizer.wheels.params, pipeline.estimator.params)
    assert set(OFFSET.split("+")) <= set(pipeline.estimator.parameters())
    plain = Pipeline(Trial(make_model("friction", ROBOT), "ekf", "none"), ROBOT, {}, True)
    assert isinstance(plain.synchronizer.wheels.model, FrictionModel)


# --- learned where the motion shows it


def make_physical(sensor, form, noise):
    return make_filter(sensor, add_correction_parameters(make_model("friction", ROBOT), form), form, noise, robot=ROBOT)


def learned(form, hidden, seed, wheels=weave, steps=150):
    """Errors (k,) and covariance (k, k) of the corrections after a drive of a robot whose own are ``hidden`` (k,), and the first sigmas."""
    sensor = PoseSensor()
    estimator = make_physical(sensor, form, Noise())
    world = make_world(estimator, seed, wheels=wheels, cg=lambda t: CG)
    world.correction = np.array(hidden)
    for _ in drive(world, estimator, sensor, steps):
        pass
    slow, P = slow_states(estimator)
    k = len(hidden)
    return world.correction - slow[-k:], P[-k:, -k:], estimator.noise.corrections.sigmas


@pytest.mark.extended
def test_cg_offset_of_hidden_load_is_estimated_within_sigma():
    """Twelve drives, the CG 4 cm ahead and 2 cm to the right of where its message has it, with a floor of another grip."""
    hidden = np.array([0.15, 0.04, -0.02])
    found = [learned(OFFSET, hidden, seed) for seed in range(12)]
    sigmas = np.array([np.sqrt(np.diag(P)) for _, P, _ in found])
    assert (sigmas < 0.5 * found[0][2]).all()  # it shows
    squared = [float(e @ np.linalg.solve(P, e)) for e, P, _ in found]
    low, high = mean_band(len(found), len(hidden), 0.99)
    assert low < np.mean(squared) < high
    errors = np.array([e for e, _, _ in found])
    within = (np.abs(errors) < sigmas).mean()
    assert 0.5 < within < 0.85  # of 36; a consistent sigma holds 68 %
    assert (np.abs(errors.mean(axis=0)) < 3.0 * sigmas.mean(axis=0) / math.sqrt(len(found))).all()
    assert (np.abs(errors.mean(axis=0)) < 0.3 * np.abs(hidden)).all()  # nowhere near the prior's 0


def test_corrections_on_straight_motion_keep_their_prior():
    error, cov, first = learned(ALL, np.zeros(6), 0, straight)
    sigmas = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(sigmas, first, rtol=0.01)  # they walk a little
    assert (sigmas >= first * (1.0 - 1e-9)).all()
    assert (np.abs(error) < 0.01 * first + 3.0 * first * math.sqrt(15.0 / 3600.0)).all()  # it is the truth that walked


def test_corrections_with_wheel_noise_alone_keep_their_prior():
    """Nearly straight: derivatives there are of noise. The LiDAR measures a turn that no wheel made, over and over."""
    sensor = PoseSensor()
    estimator = make_physical(sensor, ALL, Noise())
    world, pose = make_world(estimator, 0, wheels=lambda t: (4.0, 4.02), cg=lambda t: CG), np.zeros(3)
    estimator.step(world.first())
    for _ in range(60):
        step, _ = world.step(estimator.params, estimator.clock_offset_s)
        pose = se2.compose(pose, np.array([step.predicted.delta[0], 0.0, 0.02]))
        sensor.next = match_at(pose, np.diag([0.005, 0.005, 0.001]) ** 2)
        estimator.step(step)
    slow, P = slow_states(estimator)
    first = estimator.noise.corrections.sigmas
    assert (np.sqrt(np.diag(P)[-6:]) > 0.99 * first).all()
    assert (np.abs(slow[-6:]) < 0.1 * first).all()


def test_corrections_with_unexplained_lidar_finish_the_run():
    """Motions that no offset and no grip explains: the parameters go where no robot is, the estimate goes on."""
    sensor = PoseSensor()
    estimator = make_physical(sensor, ALL, Noise().scaled(0.1))
    world, rng, stamp, pose = make_world(estimator, 0), np.random.default_rng(1), 0, np.zeros(3)
    model = estimator.model
    none = Motion(np.zeros(3), np.zeros((3, 3)), np.zeros((3, len(model.param_names))))
    estimator.step(Step(0, 0, none, np.zeros(3), np.zeros(3), False, True, None, None))
    for _ in range(80):
        wheels, dt = np.array([[-3.0, 3.0]]), np.array([0.1])
        motion = preintegrate(model, dt, wheels, np.array([CG]), estimator.params, WheelNoise())
        pose = se2.compose(pose, motion.delta * [0.0, 0.0, 3.0] + [0.2, -0.2, 0.0] + 0.01 * rng.normal(size=3))
        sensor.next = match_at(pose, 1e-6 * np.eye(3))
        scan = world.scan_at(stamp + 100_000_000)
        estimate = estimator.step(Step(stamp, stamp + 100_000_000, motion, np.zeros(3), np.zeros(3), False, True, None, scan))
        stamp += 100_000_000
        assert np.isfinite(estimate.pose).all()
        assert np.isfinite(model.twist(wheels, np.array([CG]), estimator.params).value).all()


# --- every model, every form


@pytest.mark.parametrize("form", cases(["constant", "cg_field"], ("cg_field",)))
@pytest.mark.parametrize("name", MODELS)
def test_corrections_of_every_model_and_form_reduce_error(name, form):
    """What a drive both ways shows is known better than at first, and is where the truth is."""
    sensor = PoseSensor()
    estimator = make_filter(sensor, name, form)
    names, sigmas = estimator.noise.corrections.names, estimator.noise.corrections.sigmas
    assert names
    run(estimator, sensor, 3, 100)
    found = estimator.parameters()
    after = np.array([found[n][1] for n in names])
    assert (after <= 1.02 * sigmas).all()
    assert (after < 0.8 * sigmas).any()
    assert np.isfinite(estimator.params).all()


def test_corrections_on_gentle_arcs_keep_what_turns_gave():
    sigmas = {}
    for turning in (0.2, 2.5):
        sensor = PoseSensor()
        estimator = make_filter(sensor)
        run(estimator, sensor, 2, 60, wheels=lambda t: (5.0 - turning, 5.0 + turning))  # noqa: B023
        sigmas[turning] = estimator.parameters()["k_0"][1] / estimator.noise.corrections.sigmas[0]
    assert sigmas[0.2] > 0.99
    assert sigmas[2.5] < 0.7


# --- consistent at four levels of noise


SEEDS = 12


@pytest.fixture(scope="module")
def consistency():
    """Squared errors (levels, seeds, 3) of pose, slow states and all, insides (levels, seeds, m), and degrees of freedom, after 10 s."""
    found = [[squared_errors(1000 * i + s, 100, Noise().scaled(f)) for s in range(SEEDS)] for i, f in enumerate(LEVELS)]
    return np.array([[r[0] for r in level] for level in found]), np.array([[r[1] for r in level] for level in found]), found[0][0][2]


@pytest.mark.extended
@pytest.mark.xdist_group("corrections_nees")
@pytest.mark.parametrize("level", range(len(LEVELS)))
def test_corrections_nees_at_each_noise_level_is_in_band(consistency, level):
    """Twelve means of pose, parameters and all: the band holds all of them together with 95 %."""
    values, _, dof = consistency
    for part, d in enumerate(dof):
        low, high = mean_band(SEEDS, d, 1.0 - 0.05 / 12)
        assert low < values[level, :, part].mean() < high


@pytest.mark.extended
@pytest.mark.xdist_group("corrections_nees")
def test_corrections_nees_over_all_levels_is_in_band(consistency):
    values, inside, dof = consistency
    for part, d in enumerate(dof):
        low, high = mean_band(SEEDS * len(LEVELS), d, 1.0 - 0.05 / 3)
        assert low < values[..., part].mean() < high
    # 90 % intervals, of 4 x 12 runs: all but a few
    assert 0.8 < inside[..., 3:].mean() < 0.98


# --- what is learned at one posture of the arms is stored


POSTURES = ((0.09, 0.0), (-0.05, 0.02), (0.02, -0.02))
ON_EACH = 60  # steps


def posture(t):
    return POSTURES[int(t / (ON_EACH * DT)) % len(POSTURES)]


def round_trip(form, seed):
    """A robot whose regressions are not those of its file, its arms twice in each of three postures.

    Error of the odometry on each posture (6, 3), and of the rotation scaling at the first and the last three steps of each (6, 2).
    """
    sensor, quiet = PoseSensor(), Noise().scaled(0.3)
    estimator = make_filter(sensor, "skid_steer", form, quiet)
    # dead reckoning is by the file's radius, which is right
    estimator.state = set_marginal(estimator.state, "radius", np.zeros(1), np.zeros((1, 1)))
    model, field = estimator.model, make_corrections(estimator.model, "cg_field")
    belief = FilterConfig(wheel_radius_sigma=0.0)
    world = World(model, field, quiet, np.random.default_rng(seed), True, belief, cg=posture)
    odometry, start, drifts, scalings = np.zeros(3), np.zeros(3), [], []
    estimator.step(world.first())
    for i in range(2 * len(POSTURES) * ON_EACH):
        step, sensor.next = world.step(estimator.params, estimator.clock_offset_s)
        odometry = se2.compose(odometry, step.predicted.delta)
        wheels, cg = np.array([[2.0, 4.0]]), np.array([posture(world.t - 0.5 * DT)])
        true, estimated = (
            model.twist(wheels, cg, p).value[0, 2] for p in (model.nominal + field.directions @ world.correction, estimator.params)
        )
        scalings.append(abs(estimated / true - 1.0))
        estimator.step(step)
        if (i + 1) % ON_EACH == 0:
            drifts.append(se2.log(se2.between(se2.between(start, world.pose), odometry)))
            odometry, start = np.zeros(3), world.pose
    each = np.array(scalings).reshape(-1, ON_EACH)
    return np.array(drifts), np.stack([each[:, :3].mean(axis=1), each[:, -3:].mean(axis=1)], axis=1)


@pytest.mark.slow
def test_cg_field_of_a_posture_returns_with_the_posture():
    found = {form: [round_trip(form, seed) for seed in range(10)] for form in ("constant", "cg_field")}
    drift = {form: np.array([d for d, _ in runs])[:, 3:] for form, runs in found.items()}
    metres = {form: np.hypot(d[..., 0], d[..., 1]).mean() for form, d in drift.items()}
    turns = {form: np.abs(d[..., 2]).mean() for form, d in drift.items()}
    assert metres["cg_field"] < 0.75 * metres["constant"]
    assert turns["cg_field"] < 0.75 * turns["constant"]
    k = np.array([k for _, k in found["cg_field"]]).mean(axis=0)
    # back at a posture it is at once as good as when it left it, give or take half a percent: nothing converges anew
    assert (k[3:, 0] < k[:3, 1] + 0.005).all()
    again = np.array([k for _, k in found["constant"]]).mean(axis=0)[3:, 0]
    assert (k[3:, 0] < 0.75 * again).all()
