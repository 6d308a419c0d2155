"""Claims about the dynamic form: it obeys mechanics, and its resting point is the quasi-static solution."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion_models.errors import CgError
from motion_models.friction import FrictionModel
from motion_models.friction.contact import CREEP, SATURATION
from motion_models.friction.dynamics import FrictionDynamics, Influence
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

ROBOT = load_robot("vaultbot")
MODEL = make_model("friction", ROBOT)
BODY = FrictionDynamics.from_robot(ROBOT)
FLAT = dataclasses.replace(BODY, cg_height=0.0)
STILL = np.zeros(2)


def influence(cg=(0.0, 0.0), velocity=(0.0, 0.0), acceleration=(0.0, 0.0, 0.0), force=(0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0)):
    return Influence(*(np.array(a, dtype=float) for a in (cg, velocity, acceleration, force, at)))


@pytest.mark.parametrize("wheels", [(-1.0, 1.0), (1.0, 2.0), (2.0, 2.0), (0.5, -1.5)])
@pytest.mark.parametrize("cg", [(0.0, 0.0), (0.08, 0.02)])
@pytest.mark.parametrize("saturation", [0.0, 1.0, 0.4])
def test_dynamics_settle_to_the_quasi_static_solution(wheels, cg, saturation):
    """At constant wheel rates the robot settles. What then still differs is the CG's height: it falls with the square of the speed."""
    model = FrictionModel(BODY.params, saturation, centripetal=True)
    off = []
    for scale in (1.0, 0.5):
        q, cg = scale * np.array(wheels), np.array(cg)
        body = dataclasses.replace(BODY, rest_speed=1e-6, saturation=saturation)
        closed = model.twist(q, cg, body.params).value
        speed = 0.164 * math.hypot(*q) / math.sqrt(2)
        state, _ = body.advance(
            np.array([0, 0, 0, *(0.8 * closed)]), 0.3, math.ceil(0.3 / body.longest_step(speed)), q, Influence.of_cg(cg)
        )
        off.append(np.abs(state[3:] - closed).max() / speed)
    assert off[0] < 0.015
    assert off[1] < 0.3 * off[0] + 1e-9


@pytest.mark.parametrize("law", list(SATURATION))
@pytest.mark.parametrize("wheels", [(4.0, 9.0), (-5.0, 8.0), (10.0, 2.0)])
def test_dynamics_at_speed_settle_to_the_centripetal_solution(wheels, law):
    """With the centripetal force the closed solution is that of the dynamics, not its limit."""
    q, cg = np.array(wheels), np.array([0.06, -0.03])
    body = dataclasses.replace(FLAT, rest_speed=1e-6, saturation=SATURATION[law])
    closed = FrictionModel(body.params, body.saturation, centripetal=True).twist(q, cg, body.params).value
    got, _ = body.accelerations(q, closed, Influence.of_cg(cg))
    np.testing.assert_allclose(got, 0.0, atol=1e-6)
    without = FrictionModel(body.params, body.saturation).twist(q, cg, body.params).value
    assert np.abs(without - closed).max() > 0.01


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-0.15, 0.15), st.floats(-0.15, 0.15))
@settings(max_examples=50, deadline=None)
def test_accelerations_of_the_steady_motion_are_zero(q_l, q_r, x, y):
    """Without the centripetal terms (an infinitely heavy gravity, so to say) the balance is the model's."""
    q, cg = np.array([q_l, q_r]), np.array([x, y])
    speed = 0.164 * math.hypot(*q) / math.sqrt(2)
    if speed < 1e-3:
        return
    body = dataclasses.replace(FLAT, rest_speed=1e-9)
    twist = MODEL.twist(q, cg, body.params).value
    got, _ = body.accelerations(q, twist, Influence.of_cg(cg))
    vx, vy, wz = twist
    # Force-free motion: the CG is not accelerated, so the centre accelerates only by the turn about it.
    np.testing.assert_allclose(got, [vy * wz + x * wz**2, -vx * wz + y * wz**2, 0.0], atol=1e-5)


def test_longest_step_is_stable_and_a_longer_one_is_not():
    """Rolling straight on from a disturbance: stable at the named step, and not at ten times it."""
    wheels, cg = np.array([2.0, 2.0]), Influence.of_cg(np.zeros(2))
    for saturation, too_long in ((1.0, 10.0), (0.0, 10.0 / (CREEP * BODY.params[5]))):
        body = dataclasses.replace(BODY, saturation=saturation)
        closed = FrictionModel(body.params, saturation).twist(wheels, np.zeros(2), body.params).value
        start = np.array([0, 0, 0, *(closed + np.array([0, 0, 1e-5]))])
        step = body.longest_step(2.0 * 0.164)
        turns = [abs(body.advance(start, 2000 * h, 2000, wheels, cg)[0][5]) for h in (step, too_long * step)]
        assert turns[0] < 1e-9
        assert not turns[1] < 1e-4


def energy(body, state, cg):
    vx, vy, wz = state[3:]
    return 0.5 * body.mass * ((vx - wz * cg[1]) ** 2 + (vy + wz * cg[0]) ** 2) + 0.5 * body.inertia * wz**2


@pytest.mark.parametrize("seed", range(6))
def test_dynamics_of_locked_wheels_only_take_energy(seed):
    rng = np.random.default_rng(seed)
    cg = rng.uniform(-0.1, 0.1, 2)
    params = BODY.params + np.eye(13)[8] * 0.2 + np.eye(13)[9] * 0.3
    body = dataclasses.replace(BODY, cg_height=0.1, params=params, creep=0.01, rest_speed=0.1)
    steps = math.ceil(2e-3 / body.longest_step(0.0))
    state = np.array([0, 0, 0, *rng.uniform(-1, 1, 2), rng.uniform(-2, 2)])
    before, start = energy(body, state, cg), energy(body, state, cg)
    for _ in range(400):
        state, margin = body.advance(state, 2e-3, steps, STILL, Influence.of_cg(cg))
        assert margin > 0
        now = energy(body, state, cg)
        assert now <= before + 1e-12
        before = now
    assert before < 1e-6 * start  # and it stops


def test_advance_converges_with_the_fourth_order():
    """Where nothing switches: a robot that slides through its turn, on rounded friction, and with a CG that moves."""
    body = dataclasses.replace(BODY, creep=0.2, cg_height=0.1)
    start = np.array([0.1, -0.2, 0.3, 0.2, 0.05, 0.4])
    wheels, move = np.array([1.0, 3.0]), influence((0.05, 0.01), (0.02, -0.01), (0.01, 0.02, 0.0))
    exact, _ = body.advance(start, 0.1, 20_000, wheels, move)
    steps = np.array([100, 200, 400, 800])
    errors = [np.abs(body.advance(start, 0.1, int(n), wheels, move)[0] - exact).max() for n in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(-4.0, abs=0.3)


def test_dynamics_of_a_locked_robot_follow_coulomb():
    """Second way: v^2 / (2 mu (1 - exp(-K)) g), the distance of a block."""
    v = 0.6
    state, _ = FLAT.advance(np.array([0, 0, 0, 0, v, 0.0]), 0.2, 40_000, STILL, Influence.of_cg(np.zeros(2)))
    assert state[1] == pytest.approx(v**2 / (2 * 0.9 * (1 - math.exp(-13.333)) * 9.81), rel=2e-3)
    np.testing.assert_allclose(state[[0, 2, 3, 5]], 0.0, atol=1e-12)


def test_dynamics_of_a_force_at_the_gripper_follow_newton():
    """With wheels that have no grip: F = m a at the CG, and a moment about it."""
    params = BODY.params.copy()
    params[3], params[6] = 1e-9, 0.0
    body = dataclasses.replace(BODY, params=params)
    push = influence(cg=(0.1, 0.02), force=(10.0, -4.0, 0.0), at=(0.6, 0.1, 0.5))
    got, _ = body.accelerations(STILL, np.zeros(3), push)
    alpha = ((0.6 - 0.1) * -4.0 - (0.1 - 0.02) * 10.0) / body.inertia
    np.testing.assert_allclose(got, [10.0 / body.mass + 0.02 * alpha, -4.0 / body.mass - 0.1 * alpha, alpha], rtol=1e-6)


def test_dynamics_of_moving_arms_move_the_base_back():
    """Momentum of a frictionless robot is kept while its CG moves ahead in its body."""
    params = BODY.params.copy()
    params[3], params[6] = 1e-9, 0.0
    body = dataclasses.replace(BODY, params=params)
    state, _ = body.advance(np.array([0, 0, 0.4, 0, 0, 0.0]), 0.5, 200, STILL, influence(acceleration=(0.1, 0.0, 0.0)))
    base = np.array([math.cos(0.4), math.sin(0.4)]) * -0.5 * 0.1 * 0.5**2
    np.testing.assert_allclose(state[:2], base, atol=1e-8)


def test_dynamics_without_grip_keep_the_momentum():
    """3.18 and 3.19 with all their Coriolis terms, against the plain statement that the CG of a free body goes straight on."""
    params = BODY.params.copy()
    params[3], params[6] = 1e-9, 0.0
    body = dataclasses.replace(BODY, params=params)
    start = np.array([0, 0, 0.4, 0.3, -0.2, 0.7])
    cg, velocity, acceleration = np.array([0.05, -0.02]), np.array([0.04, 0.06]), np.array([-0.03, 0.05])
    move = influence(cg, velocity, (*acceleration, 0.0))

    def world_cg(state, t):
        c, s = math.cos(state[2]), math.sin(state[2])
        x, y = cg + velocity * t + 0.5 * acceleration * t**2
        return state[:2] + np.array([c * x - s * y, s * x + c * y])

    at = [world_cg(body.advance(start, t, 400, STILL, move)[0] if t else start, t) for t in (0.0, 0.4, 0.8)]
    np.testing.assert_allclose(at[2] - at[1], at[1] - at[0], atol=1e-7)
    assert np.linalg.norm(at[1] - at[0]) > 0.05


def test_dynamics_of_braking_load_the_front_and_tip():
    """Locked wheels at speed: deceleration mu g moves the load by mu z_G, beyond the wheelbase once z_G > W / (2 mu)."""
    v = np.array([1.0, 0.0, 0.0])
    for height, tips in ((0.1, False), (0.25, False), (0.32, True)):
        _, margin = dataclasses.replace(BODY, cg_height=height).accelerations(STILL, v, Influence.of_cg(np.zeros(2)))
        assert (margin < 0) == tips
        if not tips:
            assert margin == pytest.approx(1 - 0.9 * height / 0.26, abs=1e-4)


def test_dynamics_of_a_robot_held_upright_are_continuous():
    """All load on one axle or side: forces that jump with a rounding of the twist leave an implicit step without a solution."""
    rng, jumps = np.random.default_rng(1), []
    while len(jumps) < 400:
        wheels, twist, cg = rng.uniform(-4, 4, 2), rng.uniform(-1, 1, 3) * (0.6, 0.3, 0.8), rng.uniform((-0.05, -0.03), (0.08, 0.03))
        a, margin = BODY.accelerations(wheels, twist, Influence.of_cg(cg))
        if margin < 0.0:
            jumps.append(np.abs(BODY.accelerations(wheels, twist + 1e-7, Influence.of_cg(cg))[0] - a).max())
    assert max(jumps) < 1e-2


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_dynamics_loads_agree_with_accelerations(x, y, seed):
    """3.21 to 3.26 written out for the accelerations that came out: a lower CG gives the same forces from loads moved by hand."""
    rng = np.random.default_rng(seed)
    wheels, twist = rng.uniform(-2, 2, 2), rng.uniform(-0.5, 0.5, 3)
    body = dataclasses.replace(BODY, cg_height=0.08)
    got, margin = body.accelerations(wheels, twist, Influence.of_cg(np.array([x, y])))
    if margin <= 0.01:
        return
    vx, vy, wz = twist
    ax, ay, alpha = got[0] - vy * wz, got[1] + vx * wz, got[2]
    a_x, a_y = ax - y * alpha - x * wz**2, ay + x * alpha - y * wz**2  # 3.18, 3.19
    # The same loads from a CG on the floor at the shifted place; the yaw moment is then about that place, not about the CG.
    shifted = np.array([x, y]) - 0.08 * np.array([a_x, a_y]) / 9.81
    flat, _ = FLAT.accelerations(wheels, twist, Influence.of_cg(shifted))
    fx, fy, falpha = flat[0] - vy * wz, flat[1] + vx * wz, flat[2]
    f_x, f_y = fx - shifted[1] * falpha - shifted[0] * wz**2, fy + shifted[0] * falpha - shifted[1] * wz**2
    np.testing.assert_allclose([f_x, f_y], [a_x, a_y], atol=1e-9)
    arm = shifted - [x, y]
    moment = body.inertia * falpha + body.mass * (arm[0] * f_y - arm[1] * f_x)
    assert body.inertia * alpha == pytest.approx(moment, abs=1e-8)


def test_dynamics_of_bad_input_are_refused():
    with pytest.raises(CgError, match="tips over"):
        BODY.accelerations(STILL, np.zeros(3), Influence.of_cg(np.array([0.3, 0.0])))
    assert BODY.creep == CREEP
