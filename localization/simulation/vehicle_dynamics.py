"""The dynamic friction model with a floor under each wheel and a radius for each side, and with its exact derivatives.

The physics are those of `motion_models.friction.dynamics` (Ebersole 2016, 3.15-3.26), with one thing added: tyres are springs. On a
rigid robot the loads hang on the forces and the forces on the loads at the same instant, and for a high CG on a grippy floor there may
be no loads that agree (Painleve's paradox, 1895). Here the loads follow their quasi-static values within a tyre's time; at rest and in
steady motion they are the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from localization.simulation.terrain import axes, ground, over_ground
from motion_models.compiled import kernel, subroutine
from motion_models.friction.contact import Tyre, contact, loads, rolling
from motion_models.se2 import FloatArray


class Chassis(NamedTuple):
    """What of the robot and its floor does not change from step to step. Fields as in `FrictionModel` and `FrictionDynamics`."""

    half_track: float
    half_wheelbase: float
    radius_left: float
    radius_right: float
    mu: float
    tyre: Tyre
    rolling_resistance: float
    scrub: float
    warp: float
    height: float
    """Height of the CG above the floor [m]."""
    gravity: float
    """Normal to the floor [m/s^2]."""
    creep: float
    rest_speed: float
    tyre_lag: float
    """Time in which the loads follow the forces [s]."""
    grip_split: float = 0.0
    """The left wheels grip more by half of this share, the right ones less."""


class DynamicsInput(NamedTuple):
    """What acts on the robot at one moment."""

    roll_left: float
    """Speed at which the left wheels' rims move [m/s]."""
    roll_right: float
    grip_fl: float
    """Friction under the front left wheel, as a factor of the chassis' mu."""
    grip_fr: float
    grip_rl: float
    grip_rr: float
    mass: float
    inertia: float
    cg_x: float
    cg_y: float
    cg_vx: float
    cg_vy: float
    cg_ax: float
    cg_ay: float
    cg_az: float
    force_x: float
    """On the CG, in the body frame [N]: gravity along a tilted floor."""
    force_y: float


class Derivatives(NamedTuple):
    """Rates of vx, vy, wz, the quasi-static tilts, and the rates' derivatives by vx, vy, wz at fixed loads."""

    x: float
    y: float
    w: float
    xi: float
    eta: float
    x_vx: float
    x_vy: float
    x_wz: float
    y_vx: float
    y_vy: float
    y_wz: float
    w_vx: float
    w_vy: float
    w_wz: float


@kernel
def derivatives(vx: float, vy: float, wz: float, xi: float, eta: float, now: DynamicsInput, body: Chassis) -> Derivatives:
    """Accelerations of the wheelbase's centre in the body frame at the twist ``vx, vy, wz`` and the tilt ``xi, eta``.

    The tilt is where the loads' centre lies, as a fraction of the half wheelbase and the half track (see `contact.loads`);
    beyond +-1 the wheels of an axle or a side are in the air, and the others carry all.
    """
    speed = math.sqrt(0.5 * (now.roll_left * now.roll_left + now.roll_right * now.roll_right) + body.rest_speed * body.rest_speed)
    per = 1.0 / speed
    fl, fr, rl, rr, _, _, _ = loads(min(1.0, max(-1.0, xi)), min(1.0, max(-1.0, eta)), body.warp)

    # Forces and yaw moment about the CG per load, and their derivatives by the velocities
    x = y = m = x_vx = x_vy = x_wz = y_vx = y_vy = y_wz = m_vx = m_vy = m_wz = mean_mu = 0.0
    for left in (True, False):
        at_y, roll = (body.half_track, now.roll_left * per) if left else (-body.half_track, now.roll_right * per)
        slip = (vx - at_y * wz) * per - roll
        drag = body.rolling_resistance * rolling(roll)[0]  # 3.17
        for ahead in (True, False):
            at_x = body.half_wheelbase if ahead else -body.half_wheelbase
            if left:
                share, grip = (fl, now.grip_fl) if ahead else (rl, now.grip_rl)
            else:
                share, grip = (fr, now.grip_fr) if ahead else (rr, now.grip_rr)
            n = share * body.mu * grip
            f = contact(slip, (vy + at_x * wz) * per, roll, body.tyre, body.creep)
            fx, fy = n * f.x - share * drag, n * f.y
            xs, xd, ys, yd = n * per * f.x_slip, n * per * f.x_drift, n * per * f.y_slip, n * per * f.y_drift
            xw, yw = at_x * xd - at_y * xs, at_x * yd - at_y * ys
            arm_x, arm_y = at_x - now.cg_x, at_y - now.cg_y
            x, y, m, mean_mu = x + fx, y + fy, m + arm_x * fy - arm_y * fx, mean_mu + n
            x_vx, x_vy, x_wz = x_vx + xs, x_vy + xd, x_wz + xw
            y_vx, y_vy, y_wz = y_vx + ys, y_vy + yd, y_wz + yw
            m_vx, m_vy, m_wz = m_vx + arm_x * ys - arm_y * xs, m_vy + arm_x * yd - arm_y * xd, m_wz + arm_x * yw - arm_y * xw
    spin = wz * body.half_track * per
    whole = 1.0 / math.sqrt(spin * spin + body.creep * body.creep)
    m -= mean_mu * body.scrub * spin * whole
    m_wz -= mean_mu * body.scrub * body.half_track * per * body.creep * body.creep * whole * whole * whole

    # 3.21-3.23: quasi-static loads. 3.24-3.26, then 3.18 and 3.19 solved for the base.
    load = now.mass * (body.gravity + now.cg_az)
    p, i = load / now.mass, load / now.inertia
    alpha = i * m
    x_g, y_g = now.cg_x, now.cg_y
    base_x = p * x + now.force_x / now.mass - now.cg_ax + y_g * alpha + 2.0 * now.cg_vy * wz + x_g * wz * wz + vy * wz
    base_y = p * y + now.force_y / now.mass - now.cg_ay - x_g * alpha - 2.0 * now.cg_vx * wz + y_g * wz * wz - vx * wz
    return Derivatives(
        base_x,
        base_y,
        alpha,
        (x_g - body.height * x) / body.half_wheelbase,
        (y_g - body.height * y) / body.half_track,
        p * x_vx + y_g * i * m_vx,
        p * x_vy + y_g * i * m_vy + wz,
        p * x_wz + y_g * i * m_wz + 2.0 * now.cg_vy + 2.0 * x_g * wz + vy,
        p * y_vx - x_g * i * m_vx - wz,
        p * y_vy - x_g * i * m_vy,
        p * y_wz - x_g * i * m_wz - 2.0 * now.cg_vx + 2.0 * y_g * wz - vx,
        i * m_vx,
        i * m_vy,
        i * m_wz,
    )


GAMMA = 1.0 - math.sqrt(0.5)
"""The method's coefficient: its stages are at GAMMA h and at h."""
_NEWTON_STEPS = 25
_NEWTON_TOLERANCE_M_S = 1e-9  # m/s; the last step of Newton squares it
_HALVINGS = 10


@subroutine
def implicit_stage(
    guess: tuple[float, float, float], base: tuple[float, float, float], h: float, xi: float, eta: float, now: DynamicsInput, body: Chassis
) -> tuple[float, float, float, float, float, bool]:
    """The twist V = ``base`` + ``h`` derivatives(V), searched from ``guess``; its quasi-static tilts, and whether it was found."""
    arm2 = body.half_track * body.half_track
    vx, vy, wz = guess
    dx = dy = dw = 0.0
    fraction, left, to_xi, to_eta = 1.0, math.inf, xi, eta
    for _ in range(_NEWTON_STEPS):
        x, y, w = vx + fraction * dx, vy + fraction * dy, wz + fraction * dw
        k = derivatives(x, y, w, xi, eta, now, body)
        rx, ry, rw = base[0] + h * k.x - x, base[1] + h * k.y - y, base[2] + h * k.w - w
        error = rx * rx + ry * ry + rw * rw * arm2
        if error < (1.0 - 1e-4 * fraction) * left or error < 1e-26:
            vx, vy, wz, left, to_xi, to_eta = x, y, w, error, k.xi, k.eta
            a00, a01, a02 = 1.0 - h * k.x_vx, -h * k.x_vy, -h * k.x_wz
            a10, a11, a12 = -h * k.y_vx, 1.0 - h * k.y_vy, -h * k.y_wz
            a20, a21, a22 = -h * k.w_vx, -h * k.w_vy, 1.0 - h * k.w_wz
            c00, c10, c20 = a11 * a22 - a12 * a21, a12 * a20 - a10 * a22, a10 * a21 - a11 * a20
            over = 1.0 / (a00 * c00 + a01 * c10 + a02 * c20)
            dx = over * (c00 * rx + (a02 * a21 - a01 * a22) * ry + (a01 * a12 - a02 * a11) * rw)
            dy = over * (c10 * rx + (a00 * a22 - a02 * a20) * ry + (a02 * a10 - a00 * a12) * rw)
            dw = over * (c20 * rx + (a01 * a20 - a00 * a21) * ry + (a00 * a11 - a01 * a10) * rw)
            if max(abs(dx), abs(dy), abs(dw) * body.half_track) < _NEWTON_TOLERANCE_M_S:
                return vx + dx, vy + dy, wz + dw, to_xi, to_eta, True
            fraction = 1.0
        else:
            fraction *= 0.4
            if fraction < 1e-4:
                break
    return vx, vy, wz, to_xi, to_eta, False


@subroutine
def wheel_response(q: float, target: float, slope: float, lag: float, t: float) -> tuple[float, float]:
    """A wheel's rate after ``t`` seconds, and the angle it turned, where its speed loop follows ``target`` + ``slope`` t with a ``lag``."""
    behind = q - target + slope * lag
    left = math.exp(-t / lag)
    rate = target + slope * t - slope * lag + behind * left
    return rate, target * t + 0.5 * slope * t * t - slope * lag * t + behind * lag * (1.0 - left)


@subroutine
def _grip(x: float, y: float, patches: FloatArray) -> float:
    for i in range(patches.shape[0] - 1, -1, -1):
        if patches[i, 0] <= x <= patches[i, 2] and patches[i, 1] <= y <= patches[i, 3]:
            return float(patches[i, 4])
    return 1.0


class Plant(NamedTuple):
    """Robot, floor and motor control of one call of `integrate`."""

    body: Chassis
    mass: float
    """With payload [kg]."""
    inertia: float
    """With payload, about the CG [kg m^2]."""
    slope_gravity: float
    """Gravity along the floor, down its slope, which rises towards the world's +x [m/s^2]."""
    yields: FloatArray
    """(3,) shear of a loose floor layer, as `Body.yields`."""
    patches: FloatArray
    """(k, 5) floor rectangles x0, y0, x1, y1 with a factor of the friction."""
    motor_lag_s: float
    ramp: float
    """Largest change of the wheel rates' set points [rad/s^2]."""
    waves: FloatArray
    """(n, 4) hills (`simulation.terrain`); none on a plane."""


@kernel
def integrate(state: FloatArray, wheels: FloatArray, cg: FloatArray, out: FloatArray, h: float, plant: Plant) -> int:
    """Advance ``state`` (16,) by steps of ``h`` [s], fill ``out`` (n, 13); the index of the step that failed, or -1."""
    body, targets, slopes = plant.body, np.empty(2), np.empty(2)
    if math.isnan(state[12]):  # at first the loads are those of standing
        state[12], state[13] = cg[0, 0] / body.half_wheelbase, cg[0, 1] / body.half_track
    for k in range(wheels.shape[0]):
        for j in range(2):
            targets[j] = state[10 + j]
            slopes[j] = min(plant.ramp, max(-plant.ramp, (wheels[k, j] - targets[j]) / h))
        grips = _wheel_grips(state, body, plant.patches)
        # Where Newton's method does not converge, the step is cut in pieces.
        pieces, found = 1, False
        for _ in range(_HALVINGS):
            found = _step(state, targets, slopes, cg[k], (h, pieces), grips, plant)
            if found:
                break
            pieces *= 2
        if not found:
            return k
        for j in range(2):
            state[10 + j] = targets[j] + slopes[j] * h
        for j in range(10):
            out[k, j] = state[j]
        vx, vy, wz = state[3], state[4], state[5]
        out[k, 3], out[k, 4], out[k, 5] = _sheared(vx, vy, wz, plant.yields)
        out[k, 10] = cg[k, 0] + h * (cg[k, 2] + 0.5 * h * cg[k, 4])
        out[k, 11] = cg[k, 1] + h * (cg[k, 3] + 0.5 * h * cg[k, 5])
        out[k, 12] = 1.0 - max(abs(state[12]), abs(state[13]))
    return -1


@subroutine
def _wheel_grips(state: FloatArray, body: Chassis, patches: FloatArray) -> tuple[float, float, float, float]:
    """Factors of the friction under front left, front right, rear left and rear right wheel."""
    left, right = 1.0 + 0.5 * body.grip_split, 1.0 - 0.5 * body.grip_split
    if patches.shape[0] == 0:
        return left, right, left, right
    c, s = math.cos(state[2]), math.sin(state[2])
    fx, fy, lx, ly = c * body.half_wheelbase, s * body.half_wheelbase, -s * body.half_track, c * body.half_track
    return (
        left * _grip(state[0] + fx + lx, state[1] + fy + ly, patches),
        right * _grip(state[0] + fx - lx, state[1] + fy - ly, patches),
        left * _grip(state[0] - fx + lx, state[1] - fy + ly, patches),
        right * _grip(state[0] - fx - lx, state[1] - fy - ly, patches),
    )


@subroutine
def _sheared(vx: float, vy: float, wz: float, yields: FloatArray) -> tuple[float, float, float]:
    return vx - yields[2] * vx * abs(wz), vy + yields[0] * vx * wz, wz * (1.0 - yields[1] * abs(vx))


@subroutine
def _inputs_at(
    t: float,
    rolls: tuple[float, float],
    pose: tuple[float, float, float],
    cg: FloatArray,
    grips: tuple[float, float, float, float],
    plant: Plant,
) -> DynamicsInput:
    """What acts on the robot ``t`` seconds after the start of the step, at wheel rates ``rolls`` [rad/s]."""
    heading, gravity = pose[2], plant.body.gravity
    force_x, force_y = -plant.slope_gravity * plant.mass * math.cos(heading), plant.slope_gravity * plant.mass * math.sin(heading)
    lighter = 0.0  # normal to the ground: its curvature is left out
    if plant.waves.shape[0]:
        _, z_x, z_y, _, _, _ = ground(pose[0], pose[1], plant.waves)
        e1, e2, n_z = axes(heading, z_x, z_y)
        force_x, force_y = -plant.mass * gravity * e1[2], -plant.mass * gravity * e2[2]
        lighter = gravity * (n_z - 1.0)
    return DynamicsInput(
        plant.body.radius_left * rolls[0],
        plant.body.radius_right * rolls[1],
        grips[0],
        grips[1],
        grips[2],
        grips[3],
        plant.mass,
        plant.inertia,
        cg[0] + t * (cg[2] + 0.5 * t * cg[4]),
        cg[1] + t * (cg[3] + 0.5 * t * cg[5]),
        cg[2] + t * cg[4],
        cg[3] + t * cg[5],
        cg[4],
        cg[5],
        cg[6] + lighter,
        force_x,
        force_y,
    )


@subroutine
def _step(
    state: FloatArray,
    targets: FloatArray,
    slopes: FloatArray,
    cg: FloatArray,
    duration: tuple[float, int],
    grips: tuple[float, float, float, float],
    plant: Plant,
) -> bool:
    """One step of ``duration`` [s] in that many pieces: changes ``state`` but for the set points; or leaves it unchanged, False.

    The tilt follows explicitly (a Runge-Kutta method of second order with the same stages), which its time constant allows.
    """
    body, lag = plant.body, plant.motor_lag_s
    h = duration[0] / duration[1]
    xi, eta, rate_xi, rate_eta = state[12], state[13], state[14], state[15]
    late, more = 0.5 / GAMMA, (1.0 - GAMMA) * h
    x, y, theta, vx, vy, wz = state[0], state[1], state[2], state[3], state[4], state[5]
    for i in range(duration[1]):
        v_0 = (vx, vy, wz)
        base, guess = v_0, v_0
        rate_x = rate_y = rate_w = 0.0
        xi_0, eta_0, first_xi, first_eta = xi, eta, rate_xi, rate_eta
        from_x, from_y, from_theta = x, y, theta
        by_x = by_y = by_theta = 0.0
        for stage in range(2):
            share = GAMMA if stage == 0 else 1.0
            t = i * h + share * h
            roll_l = wheel_response(state[6], targets[0], slopes[0], lag, t)[0]
            roll_r = wheel_response(state[7], targets[1], slopes[1], lag, t)[0]
            now = _inputs_at(t, (roll_l, roll_r), (x, y, theta + share * h * guess[2]), cg, grips, plant)
            if math.isnan(first_xi):  # only at the very start: afterwards the rate is known from the step before
                quasi_static = derivatives(vx, vy, wz, xi, eta, now, body)
                first_xi, first_eta = (quasi_static.xi - xi) / body.tyre_lag, (quasi_static.eta - eta) / body.tyre_lag
            if stage == 0:
                xi, eta = xi_0 + GAMMA * h * first_xi, eta_0 + GAMMA * h * first_eta
            else:
                base = v_0[0] + more * rate_x, v_0[1] + more * rate_y, v_0[2] + more * rate_w
                xi = xi_0 + h * ((1.0 - late) * first_xi + late * rate_xi)
                eta = eta_0 + h * ((1.0 - late) * first_eta + late * rate_eta)
                from_x, from_y, from_theta = x + more * by_x, y + more * by_y, theta + more * by_theta
            u, v, w, to_xi, to_eta, found = implicit_stage(guess, base, GAMMA * h, xi, eta, now, body)
            if not found:
                return False
            rate_xi, rate_eta = (to_xi - xi) / body.tyre_lag, (to_eta - eta) / body.tyre_lag
            rate_x, rate_y, rate_w = (u - base[0]) / (GAMMA * h), (v - base[1]) / (GAMMA * h), (w - base[2]) / (GAMMA * h)
            su, sv, by_theta = _sheared(u, v, w, plant.yields)
            heading = from_theta + GAMMA * h * by_theta
            c, s = math.cos(heading), math.sin(heading)
            by_x, by_y = c * su - s * sv, s * su + c * sv
            if plant.waves.shape[0]:
                by_x, by_y, by_theta = over_ground(su, sv, by_theta, x, y, heading, plant.waves)
            guess = (u, v, w)
        vx, vy, wz = guess
        x, y, theta = from_x + GAMMA * h * by_x, from_y + GAMMA * h * by_y, from_theta + GAMMA * h * by_theta
    state[0], state[1], state[2], state[3], state[4], state[5] = x, y, theta, vx, vy, wz
    state[12], state[13], state[14], state[15] = xi, eta, rate_xi, rate_eta
    for j in range(2):
        state[6 + j], turned = wheel_response(state[6 + j], targets[j], slopes[j], lag, duration[0])
        state[8 + j] += turned
    return True
