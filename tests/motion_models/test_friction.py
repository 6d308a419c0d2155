"""Claims about the friction model that are its own: equations, loads, limits where the answer is known, and that every case converges."""

import dataclasses
import math
import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, root

from motion_models.errors import CgError, ModelError
from motion_models.friction import FrictionModel
from motion_models.friction.contact import CREEP, SATURATION, loads, rolling
from motion_models.friction.equilibrium import Loads, newton
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

VAULTBOT = load_robot("vaultbot")
MODEL = make_model("friction", VAULTBOT)
LAWS = {law: FrictionModel.from_robot(dataclasses.replace(VAULTBOT, options={"friction": {"contact": law}})) for law in SATURATION}
NOMINAL = MODEL.nominal
HALF = np.array([0.26, 0.28])
inside = st.floats(-0.999, 0.999)


def with_params(**changes):
    params = NOMINAL.copy()
    for name, value in changes.items():
        params[FrictionModel.param_names.index(name)] = value
    return params


def move(wheels, cg=(0.0, 0.0), model=MODEL, **changes):
    return model.twist(np.array(wheels, dtype=float), np.array(cg, dtype=float), with_params(**changes)).value


def thesis_residual(unknowns, wheels, cg, p=NOMINAL):
    """Eqs. 3.21-3.26 at rest of all accelerations, wheel by wheel as printed (rolling resistance with its sign), plus equal stiffness.

    ``unknowns``: vx, vy, wz and the four loads over m g, front left, front right, back left, back right.
    """
    r, d, w, mu, ratio, K, f_r = p[:7]
    vx, vy, wz = unknowns[:3]
    n = unknowns[3:]
    x, y = np.array([1, 1, -1, -1]) * w / 2, np.array([1, -1, 1, -1]) * d / 2
    q = np.array(wheels)[[0, 1, 0, 1]]
    s_x, s_y = vx - wz * y - r * q, vy + wz * x
    speed = np.hypot(s_x, s_y)
    f_x = -mu * n * (1 - np.exp(-K * np.abs(s_x) / np.maximum(np.abs(s_x + r * q), np.abs(r * q)))) * s_x / speed
    f_y = -mu * ratio * n * (1 - np.exp(-K)) * s_y / speed
    resist = f_r * n * np.sign(q)
    return np.array(
        [
            n.sum() - 1,  # 3.21
            d * (n[1] + n[3]) - (d / 2 - cg[1]),  # 3.22
            w * (n[2] + n[3]) - (w / 2 - cg[0]),  # 3.23
            n[0] + n[3] - n[1] - n[2],  # equal stiffness: no load on the diagonal
            f_x.sum() - resist.sum(),  # 3.24
            f_y.sum(),  # 3.25
            (f_y * (x - cg[0]) - (f_x - resist) * (y - cg[1])).sum(),  # 3.26, about the CG
        ]
    )


@pytest.mark.parametrize("wheels", [(-3.0, 3.0), (-1.0, 4.0), (0.5, 2.0), (2.0, -5.0)])
@pytest.mark.parametrize("cg", [(0.0, 0.0), (0.1, 0.02), (-0.06, -0.03)])
def test_friction_twist_solves_the_equations_of_the_thesis(wheels, cg):
    """Second way to the number: all seven unknowns at once by scipy, on unrounded friction."""
    value = move(wheels, cg, LAWS["thesis"])
    start = np.concatenate([value * 1.05 + 0.01, [0.25] * 4])
    answer = root(thesis_residual, start, args=(wheels, cg), tol=1e-12)
    assert np.abs(answer.fun).max() < 1e-10
    # What is left is the rounding: CREEP squared where wheels slide, ROLLING squared / 2 of the rolling resistance.
    np.testing.assert_allclose(value, answer.x[:3], atol=2e-4)


@given(inside, inside, st.floats(-0.9, 0.9))
@settings(deadline=None)
def test_loads_of_any_cg_balance_and_never_pull(xi, eta, warp):
    n = np.array(loads(xi, eta, warp)[:4])
    sx, sy = np.array([1, 1, -1, -1]), np.array([1, -1, 1, -1])
    assert n.min() >= 0
    np.testing.assert_allclose([n.sum(), n @ sx, n @ sy], [1, xi, eta], atol=1e-14)


@given(inside, inside, st.floats(-2, 2))
@example(0.0, 5.960464477539063e-08, 1.0)
@settings(max_examples=50, deadline=None)
def test_loads_of_a_lifted_wheel_stay_closest_to_the_warp(xi, eta, warp):
    """Second way: the diagonal term nearest to the warp among all loads that balance and do not pull, by linear programming."""
    sx, sy = np.array([1.0, 1, -1, -1]), np.array([1.0, -1, 1, -1])
    # Unknowns: four loads and the distance of the diagonal term from the warp.
    diagonal = np.append(sx * sy, 0)
    away = np.array([0.0, 0, 0, 0, 1])
    best = linprog(
        away,
        A_ub=[diagonal - away, -diagonal - away],
        b_ub=[warp, -warp],
        A_eq=[[1, 1, 1, 1, 0], [*sx, 0], [*sy, 0]],
        b_eq=[1, xi, eta],
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},  # by default loads are right to 1e-7 only
    )
    np.testing.assert_allclose(loads(xi, eta, warp)[:4], best.x[:4], atol=1e-8)


def test_friction_twist_of_equal_wheels_is_straight():
    for cg in [(0, 0), (0.1, 0.05), (-0.2, 0.2)]:
        vx, vy, wz = move([2, 2], cg)
        assert abs(vy) < 1e-9
        assert abs(wz) < 1e-9
        # Traction balances rolling resistance: mu (1 - exp(-K slip)) = f_r. Rounding at zero slip costs a little more.
        slip = -math.log(1 - 0.0263 / 0.9) / 13.333
        assert vx == pytest.approx(2 * 0.164 * (1 - slip), rel=3e-4)


def test_friction_twist_without_rolling_resistance_has_no_slip():
    np.testing.assert_allclose(move([2, 2], rolling_resistance=0.0), [2 * 0.164, 0, 0], atol=1e-12)


def test_friction_twist_of_a_cg_over_an_axle_is_a_diff_drive():
    """The limit that the thesis names (Sec. 4.3): all load on one axle, whose wheels roll, while the other axle is dragged along."""
    for end in (1, -1):
        vx, vy, wz = move([-1, 2], (end * 0.2599999, 0), rolling_resistance=0.0)
        assert wz == pytest.approx(3 * 0.164 / 0.56, rel=5e-3)
        assert -vy / wz == pytest.approx(end * 0.26, rel=5e-3)
        assert vx == pytest.approx(0.5 * 0.164, rel=5e-3)


def test_friction_twist_of_a_cg_over_a_side_follows_it():
    """The bicycle of the thesis's fig. 4-16: all load on the left wheels, which roll straight on."""
    vx, vy, wz = move([1, -3], (0, 0.2799999), rolling_resistance=0.0)
    np.testing.assert_allclose([vx, vy, wz], [0.164, 0, 0], atol=2e-3)


def test_friction_twist_without_grip_across_is_a_diff_drive():
    assert move([-1, 1], mu_ratio=1e-9, rolling_resistance=0.0)[2] == pytest.approx(2 * 0.164 / 0.56, rel=1e-3)


@given(st.floats(1e-12, 1e12), st.floats(0.1, 6.2), inside, inside)
@settings(deadline=None)
def test_friction_twist_of_faster_wheels_is_in_proportion(scale, direction, xi, eta):
    wheels, cg = np.array([math.cos(direction), math.sin(direction)]), np.array([xi, eta]) * HALF
    one, other = MODEL.twist(wheels, cg, NOMINAL), MODEL.twist(scale * wheels, cg, NOMINAL)
    np.testing.assert_allclose(other.value / scale, one.value, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(other.d_wheels, one.d_wheels, rtol=1e-3, atol=1e-4 * (1 + np.abs(one.d_wheels).max()))


@given(st.floats(-6, 6), st.floats(-6, 6), inside, inside)
@settings(deadline=None)
def test_friction_twist_backwards_is_mirrored(q_l, q_r, xi, eta):
    """A robot has no front and no rear."""
    here = move([q_l, q_r], np.array([xi, eta]) * HALF)
    there = move([-q_l, -q_r], np.array([-xi, eta]) * HALF)
    np.testing.assert_allclose(there, here * [-1, 1, -1], atol=1e-8)


def test_friction_twist_of_a_tracked_point_is_of_the_same_body():
    vx, vy, wz = move([-1, 3], (0.05, 0.01))
    np.testing.assert_allclose(move([-1, 3], (0.05, 0.01), tracked_x=0.3, tracked_y=-0.2), [vx + 0.2 * wz, vy + 0.3 * wz, wz], atol=1e-14)


def test_friction_twist_with_scrub_slows_and_with_warp_skews():
    plain = move([-3, 3])
    assert move([-3, 3], scrub=0.01)[2] < plain[2]
    assert move([-3, 3], mu_ratio=1.1)[2] < plain[2]
    # A warp is the same after half a turn, so it skews nothing about the centre; a CG ahead of it breaks that. A tread skews always.
    np.testing.assert_allclose(plain[:2], 0.0, atol=1e-12)
    np.testing.assert_allclose(move([-3, 3], warp=0.2)[:2], 0.0, atol=1e-12)
    assert abs(move([-3, 3], (0.1, 0))[0]) < 1e-12
    assert abs(move([-3, 3], (0.1, 0), warp=0.2)[0]) > 1e-3
    assert abs(move([-3, 3], tread=0.2)[1]) > 1e-3


def every_kind_of_case(rng, n):
    """Wheel rates and CGs that include the awkward: standstill, straight, one side stopped, turning on the spot, edges and corners."""
    angle = rng.uniform(-math.pi, math.pi, n)
    kind = rng.integers(0, 9, n)
    for i, special in enumerate([math.pi / 4, -3 * math.pi / 4, 0.0, math.pi / 2, 3 * math.pi / 4]):
        angle[kind == i] = special
    angle[kind == 5] = math.pi / 4 + rng.normal(size=np.count_nonzero(kind == 5)) * 10.0 ** rng.uniform(-9, -1, np.count_nonzero(kind == 5))
    wheels = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * 10.0 ** rng.uniform(-9, 6, (n, 1))
    wheels[kind == 6] = 0.0
    cg = rng.uniform(-1, 1, (n, 2))
    edge = rng.random((n, 2)) < 0.15
    cg[edge] = np.sign(cg[edge]) * (1 - 10.0 ** rng.uniform(-8, -1, np.count_nonzero(edge)))
    cg[rng.random((n, 2)) < 0.1] = 0.0
    return wheels, cg * HALF


@pytest.mark.parametrize("law", list(LAWS))
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"rolling_resistance": 0.0},
        {"warp": 0.3, "tread": 0.2, "scrub": 0.02},
        {"slip_stiffness": 100.0, "mu_ratio": 1.4},
        {"slip_stiffness": 3.0, "rolling_resistance": 0.2},
        {"mu": 0.2, "mu_ratio": 0.6, "tread": -0.3},
    ],
    ids=str,
)
def test_friction_twist_of_every_case_converges(changes, law):
    rng = np.random.default_rng(11)
    wheels, cg = every_kind_of_case(rng, 20_000)
    params = with_params(**changes)
    twist = LAWS[law].twist(wheels, cg, params)  # raises where it fails
    for field in (twist.value, twist.d_wheels, twist.d_cg, twist.d_params):
        assert np.isfinite(field).all()
    # The balance, written down anew with the rounding, must hold: sums of forces and of moments over m g.
    speed = 0.164 * np.hypot(wheels[:, 0], wheels[:, 1]) / math.sqrt(2)
    going = speed > 0
    left = rounded_balance(twist.value[going] / speed[going, None], 0.164 * wheels[going] / speed[going, None], cg[going], params, law)
    assert np.abs(left).max() < 1e-8
    assert not twist.value[~going].any()


def rounded_balance(twist, roll, cg, p, law):
    _, d, w, mu, ratio, K, f_r, scrub, warp, tread = p[:10]
    n = np.array([loads(x / (w / 2), y / (d / 2), warp)[:4] for x, y in cg])
    x, y = np.array([1, 1, -1, -1]) * w / 2, np.array([1, -1, 1, -1]) * d / 2
    roll = roll[:, [0, 1, 0, 1]]
    vx, vy, wz = (twist[:, [i]] for i in range(3))
    s_x, s_y = vx - wz * y - roll, vy + wz * x
    speed = np.sqrt(s_x**2 + s_y**2 + CREEP**2)
    fastest = np.maximum(np.maximum(np.abs(s_x + roll), np.abs(roll)), CREEP)
    along = 1 - np.exp(-K * (np.hypot(s_x, CREEP) if law == "thesis" else speed) / fastest)
    across = 1 - math.exp(-K) if law == "thesis" else along
    f_x = n * (-mu * along * s_x / speed - f_r * np.vectorize(lambda u: rolling(u)[0])(roll))
    f_y = -n * mu * ratio * across * s_y / speed * (1 + tread * s_y / speed)
    spin = wz[:, 0] * d / 2
    moment = (x * f_y - y * f_x).sum(axis=1) - mu * scrub * spin / np.hypot(spin, CREEP)
    return np.stack([f_x.sum(axis=1), f_y.sum(axis=1), moment], axis=-1)


@pytest.mark.extended
@pytest.mark.parametrize("law", list(LAWS))
def test_newton_from_any_start_finds_the_same_motion(law):
    """With Appendix A's constants the balance has one solution: searches from eight other twists end at the same."""
    rng = np.random.default_rng(5)
    wheels, cg = every_kind_of_case(rng, 300)
    wheels = wheels[np.any(wheels != 0, axis=1)]
    cg = cg[: len(wheels)]
    speed = np.hypot(wheels[:, 0], wheels[:, 1])[:, None] * 0.164 / math.sqrt(2)
    value = LAWS[law].twist(wheels, cg, NOMINAL).value / speed
    floor = LAWS[law].floor(NOMINAL)
    reached = 0
    for u, c, v in zip(0.164 * wheels / speed, cg, value, strict=True):
        load = Loads(*loads(c[0] / HALF[0], c[1] / HALF[1], 0.0)[:4])
        for _ in range(8):
            *found, ok = newton(*rng.uniform(-2, 2, 3), *u, load, floor, CREEP)
            if ok:
                reached += 1
                np.testing.assert_allclose(found, v, atol=1e-7)
    assert reached > 400  # single starts often fail; that is what the other ways are for


@given(st.floats(-2, 2), st.floats(-3, 3), st.floats(-0.9, 0.9), st.floats(-0.9, 0.9))
@settings(max_examples=300, deadline=None)
def test_friction_wheels_of_any_command_give_the_command(vx, wz, xi, eta):
    command, cg = np.array([vx, wz]), np.array([xi, eta]) * HALF
    wheels = MODEL.wheels(command, cg, NOMINAL)
    got = MODEL.twist(wheels, cg, NOMINAL).value[[0, 2]]
    np.testing.assert_allclose(got, command, atol=1e-7 * (1 + np.abs(command).max()))


def test_friction_wheels_of_a_robot_that_cannot_roll_are_refused():
    with pytest.raises(ModelError, match=r"no wheel rates found for vx = 0\.5 m/s, wz = 0\.1 rad/s .* rolling_resistance above mu"):
        MODEL.wheels(np.array([0.5, 0.1]), np.zeros(2), with_params(rolling_resistance=1.5))


@pytest.mark.parametrize("law", SATURATION)
def test_friction_interpreted_twist_equals_the_compiled(law):
    """To the last digit, since priors of robots are interpreted; also with the CG almost over a wheel, and with soft and hard tyres."""
    cgs = np.array([(x, y) for x in np.linspace(-0.999, 0.999, 7) for y in np.linspace(-0.999, 0.999, 7)]) * HALF
    for stiffness in (3.0, 10.0, 100.0):
        params = with_params(slip_stiffness=stiffness)
        compiled = LAWS[law].twist(np.array([-1.0, 1.0]), cgs, params)
        interpreted = LAWS[law].interpret_twist(np.array([-1.0, 1.0]), cgs, params)
        np.testing.assert_array_equal(interpreted.value, compiled.value)


def test_friction_twist_takes_microseconds():
    """The thesis's solver took 70 s. About 2 us on an idle core; the best of many rounds, as other processes may run."""
    rng = np.random.default_rng(0)
    wheels, cg = rng.uniform(-6, 6, (1000, 2)), rng.uniform(-0.1, 0.1, (1000, 2))
    MODEL.twist(wheels, cg, NOMINAL)
    seconds = []
    for _ in range(30):
        start = time.thread_time()
        MODEL.twist(wheels, cg, NOMINAL)
        seconds.append(time.thread_time() - start)
    assert min(seconds) / 1000 < 10e-6


@pytest.mark.parametrize("cg", [(0.26, 0), (0, -0.28), (0.3, 0.3), (math.nan, 0), (math.inf, 0)])
def test_friction_twist_of_a_cg_outside_the_wheels_is_refused(cg):
    with pytest.raises(CgError, match="tips over"):
        move([1, 1], cg)
    with pytest.raises(CgError, match="tips over"):
        MODEL.wheels(np.array([0.1, 0.1]), np.array(cg), NOMINAL)


@pytest.mark.parametrize(
    "changes", [{"mu": 0.0}, {"slip_stiffness": 0.0}, {"slip_stiffness": -1.0}, {"tread": 1.0}, {"scrub": math.nan}, {"wheel_radius": -0.1}]
)
def test_friction_twist_of_impossible_parameters_is_refused(changes):
    (name, value), *_ = changes.items()
    with pytest.raises(ModelError, match=f"{name} = {value:.6g}"):
        move([1, 1], **changes)


def test_friction_twist_of_nan_rates_is_nan():
    twist = MODEL.twist(np.array([[1.0, math.nan], [1.0, 1.0]]), np.zeros(2), NOMINAL)
    assert np.isnan(twist.value[0]).all()
    assert np.isfinite(twist.value[1]).all()
