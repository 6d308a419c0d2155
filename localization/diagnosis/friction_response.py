"""Twists of the friction model from sample to sample, without derivatives: quasi-static, or with inertia and on a slope.

`quasi_static_twists` solves the balance of `motion_models.friction.model` by the same Newton's method; it starts from the sample before
where the wheels roll at nearly the same proportion. In `dynamic_twists` each wheel sample is one implicit (backward Euler) step of
`motion_models.friction.dynamics`: stiff contact forces cannot make it unstable, and a long step ends at the quasi-static motion.

By the friction model forces depend on slip over rolling speed, as of tyres whose tread is sheared by the way that it travels. Contacts that
creep by rate, as rubber and MuJoCo's do, depend on the speed of the slip. In between, the slip stiffness K grows with the wheels' speed v:

    K(v) = K (v / v_0)^n,   n = 0 by the friction model, n = 1 for forces that depend on the speed of the slip alone
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motion_models.calibration.maneuvers import IntArray
from motion_models.compiled import kernel, subroutine
from motion_models.errors import ModelError
from motion_models.friction.contact import CREEP, rolling, tyre
from motion_models.friction.dynamics import FrictionDynamics, _accelerations, _Body
from motion_models.friction.equilibrium import Floor, motion, newton
from motion_models.friction.model import FrictionModel, check_parameters, gripped, loads_at, pull_of, unit_rolls
from motion_models.linear_equations import assign, solve
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_CREEP = 3e-3
_NEWTON = 12
_MAX_RESIDUAL = 1e-6  # m/s and rad/s; steps of numeric differences change twists by 1e-4 and more
_MIN_REDUCTION = 0.2  # slopes are good for as long as a step leaves no more than this
_SOLVED = 1e-3  # m/s and rad/s; a step that is left farther off is the quasi-static one
_DIFFERENCE = 1e-5
_MAX_ROLL_CHANGE = 0.02  # of unit rolls between samples, for which the last solution starts the next
_RATED_SPEED_M_PER_S = 0.3  # v_0, at which stiffnesses are given: a common speed of wheels
_MIN_SPEED_M_PER_S = 0.005  # below it stiffness falls no further


def quasi_static_twists(
    model: FrictionModel, params: FloatArray, wheels: FloatArray, cg: FloatArray, stiffness_exponent: float = 0.0
) -> FloatArray:
    """Body twists (N, 3) of the tracked point for wheel rates (N, 2), CG (N, 2) and ``params`` (13,), by the contact law of ``model``; the
    slip stiffness grows with this power of the wheels' speed.

    Raises `CgError` and `ModelError` as `FrictionModel.twist` does.
    """
    check_parameters(cg, params)
    out = np.empty((len(wheels), 3))
    _solve_quasi_static(wheels, cg, params, model.floor(params), stiffness_exponent, float(model.centripetal), out)
    lost = np.isnan(out[:, 2]) & np.isfinite(wheels).all(axis=1)
    if np.any(lost):
        raise ModelError(f"no balance of forces found for {np.count_nonzero(lost)} of {lost.size} samples.")
    return out


@subroutine
def _floor_at(speed: float, floor: Floor, exponent: float) -> Floor:
    """``floor`` for wheels of this ``speed`` [m/s]."""
    if exponent == 0.0:
        return floor
    on = floor.tyre
    stiffness = on.stiffness * (max(speed, _MIN_SPEED_M_PER_S) / _RATED_SPEED_M_PER_S) ** exponent
    rated = tyre(stiffness, on.mu_ratio, on.tread, on.saturation)
    return Floor(floor.half_track, floor.half_wheelbase, rated, floor.drag, floor.scrub)


@kernel
def _solve_quasi_static(
    wheels: FloatArray, cg: FloatArray, params: FloatArray, rated: Floor, exponent: float, centripetal: float, out: FloatArray
) -> None:
    radius, mu, warp, tracked_x, tracked_y = params[0], params[3], params[8], params[10], params[11]
    vx = vy = wz = previous_l = previous_r = 0.0
    for i in range(wheels.shape[0]):
        speed, roll_l, roll_r = unit_rolls(radius, wheels[i, 0], wheels[i, 1])
        if speed == 0.0:
            out[i] = 0.0
            continue
        floor = _floor_at(speed, rated, exponent)
        x, y, t = gripped(cg[i, 0], cg[i, 1], warp, params[12], floor)
        load, _ = loads_at(x, y, t, floor, pull_of(speed, mu, centripetal))
        found = False
        if abs(roll_l - previous_l) < _MAX_ROLL_CHANGE and abs(roll_r - previous_r) < _MAX_ROLL_CHANGE:
            vx, vy, wz, found = newton(vx, vy, wz, roll_l, roll_r, load, floor, CREEP)
        if not found:
            vx, vy, wz, found = motion(roll_l, roll_r, load, floor)
        if not found:  # contacts that creep so much hardly balance rolling resistance
            vx, vy, wz, found = motion(roll_l, roll_r, load, rated)
        if not found:
            out[i] = math.nan
            previous_l = previous_r = 0.0
            continue
        previous_l, previous_r = roll_l, roll_r
        out[i, 0], out[i, 1], out[i, 2] = (vx - wz * tracked_y) * speed, (vy + wz * tracked_x) * speed, wz * speed


class ManeuverSamples(NamedTuple):
    """Samples of maneuvers."""

    dt: FloatArray
    """(N,) [s]."""
    wheels: FloatArray
    """(N, 2) wheel rates [rad/s]."""
    cg: FloatArray
    """(N, 2) [m]."""
    grip_center: FloatArray
    """(N, 2) the centre of gravity at which the loads would be as the contact forces are; ``cg`` where all wheels grip alike [m]."""
    first: IntArray
    """(W + 1,) first sample of each maneuver."""
    last: IntArray
    """(W,) index after the last sample of each maneuver whose motion is wanted."""
    headings: FloatArray
    """(W,) at the begin of each maneuver [rad]."""
    slope: FloatArray
    """(2,) direction in which the floor rises, in the axes in which headings count, times its angle [rad]."""
    stiffness_exponent: float
    """Power of the wheels' speed with which the slip stiffness grows."""


def dynamic_twists(robot: Robot, model: FrictionModel, params: FloatArray, drive: ManeuverSamples, quasi_static: FloatArray) -> FloatArray:
    """Body twists (N, 3) of the wheelbase's centre, with inertia, for ``params`` (13,) and the contact law of ``model``.

    ``quasi_static`` (N, 3) are the twists without inertia: where each maneuver starts, and the result where no step is found. Raises
    `CgError` and `ModelError` as `FrictionModel` does.
    """
    check_parameters(drive.cg, params)
    dynamics = FrictionDynamics.from_robot(robot)
    steep = math.hypot(*drive.slope.tolist())
    if steep:  # gravity along the floor over that normal to it
        drive = drive._replace(slope=drive.slope * (math.tan(steep) / steep))
    body = _Body(
        float(params[3]),
        float(params[8]),
        float(params[0]),
        dynamics.mass,
        dynamics.inertia,
        dynamics.cg_height,
        dynamics.gravity * math.cos(steep),
        _CREEP,
        dynamics.rest_speed,
    )
    out = np.empty((len(drive.dt), 3))
    _integrate(drive, quasi_static, model.floor(params), body, out)
    return out


TRACKED = tuple(FrictionModel.param_names.index(name) for name in ("tracked_x", "tracked_y"))


class _Problem(NamedTuple):
    """One backward Euler step."""

    before: FloatArray
    """(3,) twist at its start."""
    h: float
    """Duration [s]."""
    q_l: float
    q_r: float
    state: FloatArray
    influence: FloatArray
    shift: FloatArray
    """(2,) from the centre of gravity to that of the grip [m]."""
    floor: Floor
    body: _Body


class _Work(NamedTuple):
    """Arrays of Newton's method, made once."""

    jacobian: FloatArray
    off: FloatArray
    tried: FloatArray
    off_tried: FloatArray
    is_stale: NDArray[np.bool_]
    """(1,) the Jacobian is of another drive, or of none."""


@kernel
def _integrate(drive: ManeuverSamples, quasi_static: FloatArray, rated: Floor, body: _Body, out: FloatArray) -> None:
    state, influence, shift, now = np.zeros(6), np.zeros(13), np.zeros(2), np.empty(3)
    influence[12] = body.height
    work = _Work(np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.ones(1, dtype=np.bool_))
    weight, slope = body.mass * body.gravity, drive.slope
    for w in range(drive.first.shape[0] - 1):
        heading = drive.headings[w]
        before = quasi_static[drive.first[w]].copy()
        work.is_stale[0] = True
        for i in range(drive.last[w], drive.first[w + 1]):
            assign(out[i], quasi_static[i])
        for i in range(drive.first[w], drive.last[w]):
            q_l, q_r, h = drive.wheels[i, 0], drive.wheels[i, 1], drive.dt[i]
            if q_l == 0.0 and q_r == 0.0:
                before[:] = 0.0
                out[i] = 0.0
                continue
            floor = _floor_at(body.radius * math.hypot(q_l, q_r) * math.sqrt(0.5), rated, drive.stiffness_exponent)
            c, s = math.cos(heading), math.sin(heading)
            influence[0], influence[1] = drive.grip_center[i, 0], drive.grip_center[i, 1]
            shift[0], shift[1] = influence[0] - drive.cg[i, 0], influence[1] - drive.cg[i, 1]
            influence[7] = -weight * (c * slope[0] + s * slope[1])
            influence[8] = -weight * (-s * slope[0] + c * slope[1])
            influence[10], influence[11] = influence[0], influence[1]
            problem = _Problem(before, h, q_l, q_r, state, influence, shift, floor, body)
            # start as far from the quasi-static motion as the sample before was
            last = max(i - 1, drive.first[w])
            for j in range(3):
                now[j] = quasi_static[i, j] + (before[j] - quasi_static[last, j])
            found = _solve_step(now, problem, work)
            if not found:
                assign(now, quasi_static[i])
                found = _solve_step(now, problem, work)
            assign(out[i], now if found else quasi_static[i])
            assign(before, out[i])
            heading += out[i, 2] * h


@subroutine
def _solve_step(now: FloatArray, problem: _Problem, work: _Work) -> bool:
    """Twist at the end of a step by Newton's method from ``now`` (3,), which is overwritten; the Jacobian before is used while it helps."""
    size = _misfit(now, problem, work.off)
    for _ in range(_NEWTON):
        if size < _MAX_RESIDUAL:
            break
        new = math.inf if work.is_stale[0] else _try(now, problem, work, 1.0)
        if not new < _MIN_REDUCTION * size:
            _differentiate(now, problem, work)
            new = _search(now, problem, work, size)
            if not new < size:
                break
        assign(now, work.tried)
        assign(work.off, work.off_tried)
        size = new
    if not size < _SOLVED:
        work.is_stale[0] = True
    return bool(size < _SOLVED)


@subroutine
def _try(now: FloatArray, problem: _Problem, work: _Work, share: float) -> float:
    """Misfit after a ``share`` of Newton's step; inf where the Jacobian is singular."""
    d0, d1, d2 = solve(work.jacobian, work.off)
    if not math.isfinite(d0 + d1 + d2):
        return math.inf
    work.tried[0], work.tried[1], work.tried[2] = now[0] - share * d0, now[1] - share * d1, now[2] - share * d2
    return _misfit(work.tried, problem, work.off_tried)


@subroutine
def _search(now: FloatArray, problem: _Problem, work: _Work, size: float) -> float:
    """Misfit of the first of shrinking steps that is below ``size``; inf where none is."""
    share = 1.0
    for _ in range(8):
        new = _try(now, problem, work, share)
        if new < size:
            return new
        share *= 0.4
    return math.inf


@subroutine
def _differentiate(now: FloatArray, problem: _Problem, work: _Work) -> None:
    for j in range(3):
        assign(work.tried, now)
        work.tried[j] += _DIFFERENCE
        _misfit(work.tried, problem, work.off_tried)
        for k in range(3):
            work.jacobian[k, j] = (work.off_tried[k] - work.off[k]) / _DIFFERENCE
    work.is_stale[0] = False


@subroutine
def _misfit(twist: FloatArray, problem: _Problem, off: FloatArray) -> float:
    """Fill ``off`` (3,) with how far ``twist`` is off a backward Euler step [m/s, m/s, rad/s]; its length."""
    state, before, h = problem.state, problem.before, problem.h
    state[3], state[4], state[5] = twist[0], twist[1], twist[2]
    a_x, a_y, a_w, _ = _accelerations(state, problem.q_l, problem.q_r, problem.influence, problem.floor, problem.body)
    if problem.shift[0] != 0.0 or problem.shift[1] != 0.0:
        a_x, a_y, a_w = _about_cg(twist, a_x, a_y, a_w, problem)
    off[0], off[1], off[2] = twist[0] - before[0] - h * a_x, twist[1] - before[1] - h * a_y, twist[2] - before[2] - h * a_w
    return math.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])


@subroutine
def _about_cg(twist: FloatArray, a_x: float, a_y: float, a_w: float, problem: _Problem) -> tuple[float, float, float]:
    """Accelerations of the wheelbase's centre, which were worked out as if mass and inertia sat at the grip's centre, with these at the
    centre of gravity: contact forces are the same, their moment is taken about it, and rolling resistance goes with the load alone."""
    influence, shift, floor, body, w = problem.influence, problem.shift, problem.floor, problem.body, twist[2]
    x, y = influence[0], influence[1]
    force_x = body.mass * (a_x - twist[1] * w - y * a_w - x * w * w) - influence[7]
    force_y = body.mass * (a_y + twist[0] * w + x * a_w - y * w * w) - influence[8]
    moment = body.inertia * a_w + shift[0] * force_y - shift[1] * force_x
    speed = body.radius * math.sqrt(0.5 * (problem.q_l * problem.q_l + problem.q_r * problem.q_r))
    ahead_l, ahead_r = rolling(body.radius * problem.q_l / speed)[0], rolling(body.radius * problem.q_r / speed)[0]
    drag = 0.5 * shift[1] * floor.drag * body.mu * body.mass * body.gravity  # too much on the left, times the half track
    force_x += drag / floor.half_track * (ahead_l - ahead_r)
    moment -= drag * (ahead_l + ahead_r)
    cg_x, cg_y, alpha = (force_x + influence[7]) / body.mass, (force_y + influence[8]) / body.mass, moment / body.inertia
    x, y = x - shift[0], y - shift[1]
    return cg_x + y * alpha + x * w * w + twist[1] * w, cg_y - x * alpha + y * w * w - twist[0] * w, alpha
