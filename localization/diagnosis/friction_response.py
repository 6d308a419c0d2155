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

from motion_models.calibration.maneuvers import IntArray
from motion_models.compiled import kernel, subroutine
from motion_models.errors import ModelError
from motion_models.friction.contact import CREEP, rolling, tyre
from motion_models.friction.dynamics import FrictionDynamics, Inputs, _Body, accelerations
from motion_models.friction.equilibrium import Floor, motion, newton
from motion_models.friction.model import FrictionModel, check_parameters, gripped, loads_at, pull_of, unit_rolls
from motion_models.linear_equations import Matrix3, assign, solve_3x3
from motion_models.robot import Robot
from motion_models.se2 import FloatArray, Triple

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


class _Step(NamedTuple):
    """One backward Euler step; of numbers alone, as compiled loops count the references to each array that is passed on."""

    before: Triple
    """Twist at its start."""
    h: float
    """Duration [s]."""
    wheels: tuple[float, float]
    """Left and right rate [rad/s]."""
    inputs: Inputs
    shift: tuple[float, float]
    """From the centre of gravity to that of the grip [m]."""
    floor: Floor
    body: _Body


class _Off(NamedTuple):
    """How far a twist is off a backward Euler step [m/s, m/s, rad/s], and the length of that."""

    x: float
    y: float
    w: float
    size: float


class _Solution(NamedTuple):
    """Twist at the end of a step, and the Jacobian for the next one."""

    twist: Triple
    is_found: bool
    jacobian: Matrix3
    is_stale: bool
    """The Jacobian is of another drive, or of none."""


@kernel
def _integrate(drive: ManeuverSamples, quasi_static: FloatArray, rated: Floor, body: _Body, out: FloatArray) -> None:
    weight, slope = body.mass * body.gravity, drive.slope
    jacobian = Matrix3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for w in range(drive.first.shape[0] - 1):
        heading, is_stale = drive.headings[w], True
        before = _row(quasi_static, drive.first[w])
        for i in range(drive.last[w], drive.first[w + 1]):
            assign(out[i], quasi_static[i])
        for i in range(drive.first[w], drive.last[w]):
            q_l, q_r, h = drive.wheels[i, 0], drive.wheels[i, 1], drive.dt[i]
            if q_l == 0.0 and q_r == 0.0:
                before = 0.0, 0.0, 0.0
                out[i] = 0.0
                continue
            floor = _floor_at(body.radius * math.hypot(q_l, q_r) * math.sqrt(0.5), rated, drive.stiffness_exponent)
            c, s = math.cos(heading), math.sin(heading)
            x, y = drive.grip_center[i, 0], drive.grip_center[i, 1]
            f_x, f_y = -weight * (c * slope[0] + s * slope[1]), -weight * (-s * slope[0] + c * slope[1])
            inputs = Inputs(x, y, 0.0, 0.0, 0.0, 0.0, 0.0, f_x, f_y, 0.0, x, y, body.height)
            step = _Step(before, h, (q_l, q_r), inputs, (x - drive.cg[i, 0], y - drive.cg[i, 1]), floor, body)
            # start as far from the quasi-static motion as the sample before was
            settled, last = _row(quasi_static, i), _row(quasi_static, max(i - 1, drive.first[w]))
            start = settled[0] + (before[0] - last[0]), settled[1] + (before[1] - last[1]), settled[2] + (before[2] - last[2])
            found = _solve_step(start, step, jacobian, is_stale)
            if not found.is_found:
                found = _solve_step(settled, step, found.jacobian, found.is_stale)
            jacobian, is_stale = found.jacobian, found.is_stale
            before = found.twist if found.is_found else settled
            out[i, 0], out[i, 1], out[i, 2] = before
            heading += before[2] * h


@subroutine
def _row(rows: FloatArray, i: int) -> Triple:
    return rows[i, 0], rows[i, 1], rows[i, 2]


@subroutine
def _solve_step(start: Triple, step: _Step, jacobian: Matrix3, is_stale: bool) -> _Solution:
    """Twist at the end of a step by Newton's method from ``start``; the ``jacobian`` before is used while it helps."""
    now, off = start, _off_step(start, step)
    for _ in range(_NEWTON):
        if off.size < _MAX_RESIDUAL:
            break
        tried, left = (now, _Off(0.0, 0.0, 0.0, math.inf)) if is_stale else _try(now, off, jacobian, 1.0, step)
        if not left.size < _MIN_REDUCTION * off.size:
            jacobian, is_stale = _differentiate(now, off, step), False
            tried, left = _search(now, off, jacobian, step)
            if not left.size < off.size:
                break
        now, off = tried, left
    is_found = off.size < _SOLVED
    return _Solution(now, is_found, jacobian, is_stale or not is_found)


@subroutine
def _try(now: Triple, off: _Off, jacobian: Matrix3, share: float, step: _Step) -> tuple[Triple, _Off]:
    """Twist after a ``share`` of Newton's step, and how far it is off; inf where the Jacobian is singular."""
    d0, d1, d2 = solve_3x3(jacobian, off.x, off.y, off.w)
    if not math.isfinite(d0 + d1 + d2):
        return now, _Off(0.0, 0.0, 0.0, math.inf)
    tried = now[0] - share * d0, now[1] - share * d1, now[2] - share * d2
    return tried, _off_step(tried, step)


@subroutine
def _search(now: Triple, off: _Off, jacobian: Matrix3, step: _Step) -> tuple[Triple, _Off]:
    """The first of shrinking steps that is less far off than ``off``; inf where none is."""
    share = 1.0
    for _ in range(8):
        tried, left = _try(now, off, jacobian, share, step)
        if left.size < off.size:
            return tried, left
        share *= 0.4
    return now, _Off(0.0, 0.0, 0.0, math.inf)


@subroutine
def _differentiate(now: Triple, off: _Off, step: _Step) -> Matrix3:
    """Derivatives of how far a twist is off, by differences from ``now``, which is ``off``."""
    x = _off_step((now[0] + _DIFFERENCE, now[1], now[2]), step)
    y = _off_step((now[0], now[1] + _DIFFERENCE, now[2]), step)
    w = _off_step((now[0], now[1], now[2] + _DIFFERENCE), step)
    return Matrix3(
        *((x.x - off.x) / _DIFFERENCE, (y.x - off.x) / _DIFFERENCE, (w.x - off.x) / _DIFFERENCE),
        *((x.y - off.y) / _DIFFERENCE, (y.y - off.y) / _DIFFERENCE, (w.y - off.y) / _DIFFERENCE),
        *((x.w - off.w) / _DIFFERENCE, (y.w - off.w) / _DIFFERENCE, (w.w - off.w) / _DIFFERENCE),
    )


@subroutine
def _off_step(twist: Triple, step: _Step) -> _Off:
    """How far ``twist`` is off a backward Euler step."""
    before, h = step.before, step.h
    a_x, a_y, a_w, _ = accelerations(twist, step.wheels, step.inputs, step.floor, step.body)
    if step.shift[0] != 0.0 or step.shift[1] != 0.0:
        a_x, a_y, a_w = _about_cg(twist, a_x, a_y, a_w, step)
    x, y, w = twist[0] - before[0] - h * a_x, twist[1] - before[1] - h * a_y, twist[2] - before[2] - h * a_w
    return _Off(x, y, w, math.sqrt(x * x + y * y + w * w))


@subroutine
def _about_cg(twist: Triple, a_x: float, a_y: float, a_w: float, step: _Step) -> Triple:
    """Accelerations of the wheelbase's centre, which were worked out as if mass and inertia sat at the grip's centre, with these at the
    centre of gravity: contact forces are the same, their moment is taken about it, and rolling resistance goes with the load alone."""
    inputs, shift, floor, body, w = step.inputs, step.shift, step.floor, step.body, twist[2]
    x, y = inputs.x, inputs.y
    force_x = body.mass * (a_x - twist[1] * w - y * a_w - x * w * w) - inputs.f_x
    force_y = body.mass * (a_y + twist[0] * w + x * a_w - y * w * w) - inputs.f_y
    moment = body.inertia * a_w + shift[0] * force_y - shift[1] * force_x
    q_l, q_r = step.wheels
    speed = body.radius * math.sqrt(0.5 * (q_l * q_l + q_r * q_r))
    ahead_l, ahead_r = rolling(body.radius * q_l / speed)[0], rolling(body.radius * q_r / speed)[0]
    drag = 0.5 * shift[1] * floor.drag * body.mu * body.mass * body.gravity  # too much on the left, times the half track
    force_x += drag / floor.half_track * (ahead_l - ahead_r)
    moment -= drag * (ahead_l + ahead_r)
    cg_x, cg_y, alpha = (force_x + inputs.f_x) / body.mass, (force_y + inputs.f_y) / body.mass, moment / body.inertia
    x, y = x - shift[0], y - shift[1]
    return cg_x + y * alpha + x * w * w + twist[1] * w, cg_y - x * alpha + y * w * w - twist[0] * w, alpha
