"""The dynamic friction model with a floor under each wheel and a radius for each side, and with its exact derivatives.

The physics are those of `motion_models.friction.dynamics` (Ebersole 2016, 3.15-3.26), with one thing added: tyres are springs. On a
rigid robot the loads hang on the forces and the forces on the loads at the same instant, and for a high CG on a grippy floor there may
be no loads that agree (Painleve's paradox, 1895). Here the loads follow what the forces ask for within a tyre's time; at rest and in
steady motion they are the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba

from motion_models.friction.contact import Tyre, contact, loads, rolling


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
    """Of the CG above the floor [m]."""
    gravity: float
    """Normal to the floor [m/s^2]."""
    creep: float
    rest_speed: float
    tyre_lag: float
    """Time in which the loads follow the forces [s]."""


class Now(NamedTuple):
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


class Change(NamedTuple):
    """Rates of vx, vy, wz, the tilts that the forces ask for, and the rates' derivatives by vx, vy, wz at fixed loads."""

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


@numba.njit(cache=True, error_model="numpy")
def change(vx: float, vy: float, wz: float, xi: float, eta: float, now: Now, body: Chassis) -> Change:  # pragma: no cover
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

    # 3.21-3.23: what the forces ask of the loads. 3.24-3.26, then 3.18 and 3.19 solved for the base.
    load = now.mass * (body.gravity + now.cg_az)
    p, i = load / now.mass, load / now.inertia
    alpha = i * m
    x_g, y_g = now.cg_x, now.cg_y
    base_x = p * x + now.force_x / now.mass - now.cg_ax + y_g * alpha + 2.0 * now.cg_vy * wz + x_g * wz * wz + vy * wz
    base_y = p * y + now.force_y / now.mass - now.cg_ay - x_g * alpha - 2.0 * now.cg_vx * wz + y_g * wz * wz - vx * wz
    return Change(
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
