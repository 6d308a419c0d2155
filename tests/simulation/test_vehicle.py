"""Claims about the simulated vehicle: it obeys mechanics, agrees with the models it shares its law with, and its steps converge."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from localization.errors import SimulationError
from localization.simulation.injected_faults import TrueRobot, apply_faults
from localization.simulation.vehicle import (
    CG,
    MARGIN,
    POSE,
    TWIST,
    Body,
    MassDistribution,
    VehicleConfig,
    VehicleState,
    accelerations,
    advance,
)
from localization.simulation.vehicle_dynamics import Chassis, DynamicsInput, derivatives, wheel_response
from motion_models.errors import CgError
from motion_models.friction.contact import SATURATION
from motion_models.friction.dynamics import FrictionDynamics, Influence
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot

ROBOT = load_robot("vaultbot")
BODY = Body.from_robot(ROBOT)
ROBOTS = {law: dataclasses.replace(ROBOT, options={"friction": {"contact": law}}) for law in SATURATION}
PLAIN = FrictionDynamics.from_robot(ROBOT)
CONFIG = VehicleConfig()
FLOOR = np.zeros((0, 5))
EMPTY = (0.0, 0.0)


def resting(n, cg=(0.0, 0.0)):
    rows = np.zeros((n, 7))
    rows[:, :2] = cg
    return rows


def rolling(state, wheels):
    """Wheels that already turn at ``wheels``, so that nothing has to speed up."""
    state.numbers[6:8] = state.numbers[10:12] = wheels
    return state


def drive(wheels, seconds, cg=(0.0, 0.0), body=BODY, config=CONFIG, twist=(0, 0, 0), patches=FLOOR, is_rolling=True, pose=(0, 0, 0)):
    state = VehicleState.at(np.array(pose, dtype=float))
    if is_rolling:
        rolling(state, wheels)
    state.numbers[3:6] = twist
    n = round(seconds / config.step_s)
    return advance(state, body, config, np.tile(np.array(wheels, dtype=float), (n, 1)), resting(n, cg), EMPTY, patches)


@given(st.integers(0, 10**6))
@example(64649)  # converges slowly
@settings(max_examples=200, deadline=None)
def test_accelerations_settled_tyres_match_rigid_friction_dynamics(seed):
    rng = np.random.default_rng(seed)
    wheels, twist, cg = rng.uniform(-3, 3, 2), rng.uniform(-0.5, 0.5, 3), rng.uniform(-0.1, 0.1, 2)
    expected, margin = PLAIN.accelerations(wheels, twist, Influence.of_cg(cg))
    if margin < 0.02:
        return  # clipped loads: a rigid robot's are fiction
    tilt = cg / [0.26, 0.28]
    for _ in range(4000):
        found, asked = accelerations(BODY, CONFIG, wheels, twist, cg, tilt)
        tilt = tilt + 0.2 * (asked - tilt)
        if np.abs(asked - tilt).max() < 1e-13:
            break
    assert np.abs(asked - tilt).max() < 1e-12
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert 1 - np.abs(tilt).max() == pytest.approx(margin, abs=1e-9)


@given(st.integers(0, 10**6))
@settings(max_examples=100, deadline=None)
def test_derivatives_match_finite_differences(seed):
    rng = np.random.default_rng(seed)
    chassis = BODY.chassis(CONFIG)
    soft = chassis.tyre._replace(tread=0.2, saturation=float(rng.choice([0.0, 0.3, 1.0])))
    body = chassis._replace(warp=0.1, tyre=soft, creep=0.02, scrub=0.03)
    now = DynamicsInput(*rng.uniform(-0.5, 0.5, 2), *rng.uniform(0.5, 1, 4), 118.0, 2.5, *rng.uniform(-0.05, 0.05, 7), 10.0, 5.0)
    twist, tilt, step = rng.uniform(-0.5, 0.5, 3), rng.uniform(-1.1, 1.1, 2), 1e-7
    found = derivatives(*twist, *tilt, now, body)
    numeric = np.zeros((3, 3))
    for j in range(3):
        up, down = (np.array(derivatives(*(twist + sign * step * np.eye(3)[j]), *tilt, now, body)[:3]) for sign in (1, -1))
        numeric[:, j] = (up - down) / (2 * step)
    np.testing.assert_allclose(np.array(found[5:]).reshape(3, 3), numeric, atol=2e-5 * max(1.0, np.abs(numeric).max()))


@pytest.mark.parametrize("wheels", [(-1.0, 1.0), (1.0, 2.0), (2.0, 2.0), (0.5, -1.5)])
@pytest.mark.parametrize("cg", [(0.0, 0.0), (0.08, 0.02)])
def test_steady_motion_matches_quasi_static_friction_model(wheels, cg):
    """What differs at speed is centripetal, and falls with its square."""
    model, off = make_model("friction", ROBOT), []
    for scale in (1.0, 0.5):
        q = scale * np.array(wheels)
        closed = model.twist(q, np.array(cg), model.nominal).value
        found = drive(q, 3.0, cg)[-1, TWIST]
        off.append(np.abs(found - closed).max() / (0.164 * math.hypot(*q)))
    assert off[0] < 0.02
    assert off[1] < 0.3 * off[0] + 2e-4  # and the rounding of the wheels' rest


SMOOTH = {"wheels": (1.0, 3.0), "seconds": 0.2, "cg": (0.05, 0.01), "twist": (0.2, 0.05, 0.4)}


def test_integrate_smaller_steps_converge_with_second_order():
    """Where nothing switches: a robot with its CG on the floor that slides through its turn on rounded friction."""
    body, plain = dataclasses.replace(BODY, cg_height=0.0), dataclasses.replace(PLAIN, creep=0.2, cg_height=0.0)
    start = np.array([0, 0, 0, *SMOOTH["twist"]])
    exact, _ = plain.advance(start, 0.2, 20_000, np.array(SMOOTH["wheels"]), Influence.of_cg(np.array(SMOOTH["cg"])))
    steps = np.array([2e-3, 1e-3, 5e-4, 2.5e-4])
    errors = [np.abs(drive(**SMOOTH, body=body, config=VehicleConfig(h, creep=0.2))[-1, :6] - exact).max() for h in steps.tolist()]
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2.0, abs=0.15)
    assert errors[-1] < 1e-5


def test_integrate_shifting_loads_converge_with_second_order():
    exact = drive(**SMOOTH, config=VehicleConfig(1e-5, creep=0.2))[-1, :6]
    steps = np.array([4e-3, 2e-3, 1e-3, 5e-4])
    errors = [np.abs(drive(**SMOOTH, config=VehicleConfig(h, creep=0.2))[-1, :6] - exact).max() for h in steps.tolist()]
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2.0, abs=0.2)


def test_integrate_painleve_case_is_solved_with_soft_tyres():
    """Painleve's paradox: a high CG on a floor that grips much more sideways than along, in a turn that the wheels reverse."""
    body = BODY.with_param("mu_ratio", 1.5)
    rows = drive((0.5, 4.4), 3.0, (0.1, 0.0), body, twist=(0.55, -0.1, 0.58))
    assert np.isfinite(rows).all()
    rows = drive((3.0, -3.0), 3.0, (0.1, 0.0), body, twist=(0.55, -0.1, 0.58))
    assert np.isfinite(rows).all()


def test_integrate_default_step_is_exact_to_a_millimetre():
    """With all switching that a real drive has: starts, a change of direction, stops."""
    ends = []
    for h in (0.005, 0.0005):
        config, state = VehicleConfig(step_s=h), VehicleState.at(np.zeros(3))
        per = round(0.02 / h)
        plan = [(4.0, (1.5, 3.0)), (2.0, (-1.0, 1.0)), (3.0, (3.0, 2.0)), (1.0, (0.0, 0.0))]
        wheels = np.repeat(np.concatenate([np.tile(q, (round(t / 0.02), 1)) for t, q in plan]), per, axis=0)
        ends.append(advance(state, BODY, config, wheels, resting(len(wheels), (0.05, 0.01)), EMPTY, FLOOR)[-1, POSE])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-3)


def test_wheel_response_to_ramp_is_exact():
    """Against small Euler steps of q' = (target - q) / lag."""
    q, angle, lag, h = 0.7, 0.0, 0.08, 1e-5
    for i in range(10_000):
        target = 1.0 + 3.0 * (i + 0.5) * h
        q, angle = q + h * (target - q) / lag, angle + h * q
    rate, turned = wheel_response(0.7, 1.0, 3.0, lag, 0.1)
    assert rate == pytest.approx(q, abs=1e-4)
    assert turned == pytest.approx(angle, abs=1e-4)


def test_wheels_accelerate_no_faster_than_the_ramp():
    rows = drive((5.0, 5.0), 1.0, is_rolling=False)
    rates = np.diff(rows[:, 6], prepend=0.0) / CONFIG.step_s
    assert rates.max() * 0.164 <= CONFIG.acceleration_m_s2 * (1 + 1e-9)
    assert rates.max() * 0.164 > 0.95 * CONFIG.acceleration_m_s2


def test_contact_law_follows_robot_file_and_fault():
    reality = {law: TrueRobot(Body.from_robot(robot), Mount()) for law, robot in ROBOTS.items()}
    for law, other in (("isotropic", "thesis"), ("thesis", "isotropic")):
        assert reality[law].body.chassis(CONFIG).tyre.saturation == SATURATION[law]
        assert apply_faults(reality[law], {"lateral_force_law": 1.0}).body.chassis(CONFIG).tyre == reality[other].body.chassis(CONFIG).tyre
    # on a gentle arc the thesis's robot turns less
    turns = [drive((3.0, 3.3), 2.0, body=of.body)[-1, TWIST][2] for of in reality.values()]
    assert turns[1] < 0.9 * turns[0]


def energy(rows, body, cg):
    vx, vy, wz = rows[:, TWIST].T
    return 0.5 * body.mass * ((vx - wz * cg[1]) ** 2 + (vy + wz * cg[0]) ** 2) + 0.5 * body.inertia * wz**2


@pytest.mark.parametrize("seed", range(8))
def test_locked_wheels_never_add_energy(seed):
    """Whatever patches of floor are under them."""
    rng = np.random.default_rng(seed)
    cg, twist = rng.uniform(-0.1, 0.1, 2), np.array([*rng.uniform(-1, 1, 2), rng.uniform(-2, 2)])
    body = dataclasses.replace(BODY, cg_height=0.1).with_param("warp", 0.2).with_param("tread", 0.3)
    patches = np.array([[-1, -1, 0.1, 0, 0.3], [0, 0, 1, 1, 0.6]])
    rows = drive((0.0, 0.0), 1.5, cg, body, twist=twist, patches=patches)
    found = energy(rows, body, cg)
    assert np.all(np.diff(found) <= 1e-9)
    assert found[-1] < 1e-6 * found[0]


def wheel_forces(body: Chassis, row, cg, share, law):
    """(4, 2) forces by 3.15-3.17 as they are printed, or by the isotropic law, wheel by wheel, unrounded."""
    vx, vy, wz = row[TWIST]
    out = []
    for (sx, sy), n in zip([(1, 1), (1, -1), (-1, 1), (-1, -1)], share, strict=True):
        x, y = sx * body.half_wheelbase, sy * body.half_track
        q = row[6] * body.radius_left if sy > 0 else row[7] * body.radius_right
        s_x, s_y = vx - y * wz - q, vy + x * wz
        whole, fastest, stiffness = math.hypot(s_x, s_y), max(abs(s_x + q), abs(q)), body.tyre.stiffness
        along = 1 - math.exp(-stiffness * (abs(s_x) if law == "thesis" else whole) / fastest)
        across = 1 - math.exp(-stiffness) if law == "thesis" else along
        fx = -body.mu * n * along * s_x / whole - body.rolling_resistance * n * np.sign(q)
        out.append((fx, -body.mu * n * across * s_y / whole))
    return np.array(out)


@pytest.mark.parametrize("law", list(SATURATION))
def test_momentum_change_equals_impulse_of_contact_forces(law):
    """A sliding robot with a CG on the floor, whose loads are then those of standing: m dv of the CG in the world = sum of F dt."""
    body = dataclasses.replace(BODY, cg_height=0.0, saturation=SATURATION[law])
    cg, config = np.array([0.06, 0.02]), VehicleConfig(step_s=0.001)
    rows = drive((1.0, 3.0), 0.4, cg, body, config, twist=(0.6, 0.2, -0.8))
    chassis = body.chassis(config)
    signs = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])
    share = body.mass * 9.81 / 4 * (1 + signs[:, 0] * cg[0] / chassis.half_wheelbase + signs[:, 1] * cg[1] / chassis.half_track)
    impulse, momentum = np.zeros((len(rows), 2)), np.zeros((len(rows), 2))
    for i, row in enumerate(rows):
        c, s = math.cos(row[2]), math.sin(row[2])
        turn = np.array([[c, -s], [s, c]])
        vx, vy, wz = row[TWIST]
        momentum[i] = body.mass * turn @ [vx - wz * cg[1], vy + wz * cg[0]]
        impulse[i] = turn @ wheel_forces(chassis, row, cg, share, law).sum(axis=0)
    summed = np.cumsum(0.5 * (impulse[1:] + impulse[:-1]) * config.step_s, axis=0)
    changed = momentum[1:] - momentum[0]
    assert np.abs(changed).max() > 20.0  # kg m/s: something happened
    np.testing.assert_allclose(summed, changed, atol=0.01 * np.abs(changed).max())


def test_slope_without_grip_accelerates_by_gravity():
    slick = dataclasses.replace(BODY.with_param("mu", 1e-9).with_param("rolling_resistance", 0.0), slope=0.1)
    rows = drive((0.0, 0.0), 1.0, (0.05, 0.0), slick, pose=(0, 0, 0.7))
    down = -0.5 * 9.81 * math.sin(0.1)
    np.testing.assert_allclose(rows[-1, POSE], [down, 0.0, 0.7], atol=1e-6)


def test_slope_parked_robot_stays_and_loads_lower_wheels():
    rows = drive((0.0, 0.0), 2.0, body=dataclasses.replace(BODY, slope=0.1))
    assert np.abs(rows[-1, POSE]).max() < 1e-4
    # uphill is ahead: the load of the front falls by z_G tan(slope) / (W/2)
    assert rows[-1, MARGIN] == pytest.approx(1 - 0.35 * math.tan(0.1) / 0.26, abs=1e-3)


def test_slippery_patch_under_one_side_turns_braking_robot():
    half = np.array([[-10.0, 0.0, 10.0, 10.0, 0.2]])  # the left is slippery
    even = drive((0.0, 0.0), 1.0, twist=(1.0, 0.0, 0.0), body=dataclasses.replace(BODY, cg_height=0.1))
    split = drive((0.0, 0.0), 1.0, twist=(1.0, 0.0, 0.0), body=dataclasses.replace(BODY, cg_height=0.1), patches=half)
    assert abs(even[-1, 2]) < 1e-9
    assert split[-1, 2] < -0.05
    assert split[-1, 0] > even[-1, 0]


def test_slope_or_payload_beyond_wheels_is_refused():
    with pytest.raises(CgError, match="tips over"):
        drive((1.0, 1.0), 0.1, (0.3, 0.0))
    high = dataclasses.replace(BODY, cg_height=0.5)
    with pytest.raises(SimulationError, match=r"tips over .* s into the drive: its CG, at x = 0.000"):
        drive((0.0, 0.0), 0.5, body=high, twist=(2.0, 0.0, 0.0))


def test_tipping_brief_lift_is_tolerated():
    rows = drive((0.0, 0.0), 0.3, body=dataclasses.replace(BODY, cg_height=0.33), twist=(0.4, 0.0, 0.0))
    assert rows[:, MARGIN].min() < 0.0
    assert np.abs(rows[-1, TWIST]).max() < 1e-3


def test_wheel_radii_act_on_their_own_side():
    wide = dataclasses.replace(BODY, radius_left=0.170, radius_right=0.158)
    assert drive((2.0, 2.0), 2.0, body=wide)[-1, 5] < -1e-3
    np.testing.assert_allclose(drive((2.0, 2.0 * 0.17 / 0.158), 2.0, body=wide)[-1, TWIST][2], 0.0, atol=1e-9)


def test_loose_floor_shears_by_its_coefficients():
    plain = drive((1.0, 2.0), 2.0)[-1, TWIST]
    for index, expected in enumerate(
        [
            (plain[0], plain[1] + 0.2 * plain[0] * plain[2], plain[2]),
            (plain[0], plain[1], plain[2] * (1 - 0.2 * plain[0])),
            (plain[0] * (1 - 0.2 * plain[2]), plain[1], plain[2]),
        ]
    ):
        yields = tuple(0.2 if i == index else 0.0 for i in range(3))
        rows = drive((1.0, 2.0), 2.0, body=dataclasses.replace(BODY, yields=yields))
        np.testing.assert_allclose(rows[-1, TWIST], expected, atol=1e-9)
        # and the path is that of the sheared motion: its speed in the world
        speed = np.diff(rows[-3:, :2], axis=0) / CONFIG.step_s
        assert np.hypot(*speed[-1]) == pytest.approx(np.hypot(*rows[-1, 3:5]), rel=1e-4)


def test_cg_moving_arms_velocity_and_acceleration_match_differences():
    masses = MassDistribution(ROBOT)
    masses.move(masses.posture("ready"), 1.0, 2.0)
    t = np.linspace(0.5, 3.5, 3001)
    rows = masses.cg(t)
    assert np.ptp(rows[:, 0]) > 0.03
    np.testing.assert_allclose(rows[0], [*masses.cg(np.array([0.0]))[0, :2], 0, 0, 0, 0, 0], atol=1e-12)
    for k in range(2):
        x, v, a = rows[:, k], rows[:, 2 + k], rows[:, 4 + k]
        np.testing.assert_allclose(x[0] + 1e-3 * np.cumsum(0.5 * (v[1:] + v[:-1])), x[1:], atol=1e-6)  # a micrometre
        np.testing.assert_allclose(1e-3 * np.cumsum(a[:-1]), v[1:], atol=1e-9)
    np.testing.assert_allclose(rows[-1, :2], masses.nominal_cg(t[-1:])[0], atol=1e-12)


def test_moving_arms_without_grip_keep_the_cg_in_place():
    slick = BODY.with_param("mu", 1e-9).with_param("rolling_resistance", 0.0)
    masses = MassDistribution(ROBOT)
    masses.move(masses.posture("ready"), 0.2, 2.0)
    t = CONFIG.step_s * np.arange(500)
    state = VehicleState.at(np.zeros(3))
    rows = advance(state, slick, CONFIG, np.zeros((500, 2)), masses.cg(t, CONFIG.step_s), EMPTY, FLOOR)
    world_cg = rows[:, :2] + rows[:, CG]
    assert abs(rows[-1, 0]) > 0.02
    np.testing.assert_allclose(world_cg, world_cg[0] * np.ones((500, 1)), atol=2e-5)


def test_payload_shifts_cg_and_adds_inertia():
    masses = MassDistribution(ROBOT)
    masses.move(masses.posture("ready"), 0.0, 1.0)
    at = np.array([5.0])
    empty = masses.cg(at)[0, :2]
    masses.pick_up(10.0)
    loaded = masses.cg(at)[0, :2]
    np.testing.assert_allclose(masses.nominal_cg(at)[0], empty)
    assert loaded[0] > empty[0] + 0.01
    # the gripper is where the moments say: m p = (M + m) g - M n
    p = ((118.84 + 10) * loaded - 118.84 * empty) / 10
    assert masses.payload_distance(5.0) == pytest.approx(np.hypot(*(p - loaded)), rel=1e-9)
    assert 0.3 < p[0] < 1.2
    masses.pick_up(0.0)
    np.testing.assert_allclose(masses.cg(at)[0, :2], empty)


def test_ballast_of_robot_without_arms_moves_and_has_no_postures():
    masses = MassDistribution(load_robot("husky_a200"))
    masses.move(masses.reach(np.array([0.05, 0.0])), 0.0, 1.0)
    np.testing.assert_allclose(masses.cg(np.array([2.0]))[0, :2], [0.05, 0.0])
    with pytest.raises(SimulationError, match="'husky_a200' has no arm posture 'ready'; its postures: none"):
        masses.posture("ready")
    with pytest.raises(SimulationError, match="its postures: ready, stow_back"):
        MassDistribution(ROBOT).posture("folded")
