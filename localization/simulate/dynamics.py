"""The dynamic friction model with a floor under each wheel and a radius for each side, and with its exact derivatives.

The physics are those of `motion_models.friction_dynamics` (Ebersole 2016, 3.15-3.26), and so are the numbers where floor and radii are
the same everywhere. The derivatives go through the shift of load as well; implicit steps (`stepping`) need them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba

from motion_models.friction_kernel import contact, loads, rolling, traction

_CLOSURE_STEPS = 12


class Chassis(NamedTuple):
    """What of the robot and its floor does not change from step to step. Fields as in `FrictionModel` and `FrictionDynamics`."""

    half_track: float
    half_wheelbase: float
    radius_left: float
    radius_right: float
    mu: float
    side: float
    """mu_y / mu_x (1 - exp(-K))."""
    slip_stiffness: float
    rolling_resistance: float
    scrub: float
    warp: float
    tread: float
    height: float
    """Of the CG above the floor [m]."""
    gravity: float
    """Normal to the floor [m/s^2]."""
    creep: float
    rest_speed: float


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
    """Rates of vx, vy, wz, the tipping margin, and the rates' derivatives by vx, vy, wz."""

    x: float
    y: float
    w: float
    margin: float
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
def change(vx: float, vy: float, wz: float, now: Now, body: Chassis) -> Change:  # pragma: no cover
    """Accelerations of the wheelbase's centre in the body frame at the twist ``vx, vy, wz``; see `FrictionDynamics.accelerations`."""
    mean_square = 0.5 * (now.roll_left * now.roll_left + now.roll_right * now.roll_right)
    speed = math.sqrt(mean_square + body.rest_speed * body.rest_speed)
    per = 1.0 / speed

    # Of the forces per load: sums over the wheels, plain and with the signs in which the loads depend on xi, eta, t. Rows x, y, m.
    x_0 = x_xi = x_eta = x_t = y_0 = y_xi = y_eta = y_t = m_0 = m_xi = m_eta = m_t = 0.0
    for left in (True, False):
        sign_y, roll = (1.0, now.roll_left * per) if left else (-1.0, now.roll_right * per)
        y = sign_y * body.half_track
        slip = (vx - y * wz) * per - roll
        taken, _, _, _ = traction(slip, roll, body.slip_stiffness, body.creep)
        drag = body.rolling_resistance * rolling(roll)[0]  # 3.17
        for ahead in (True, False):
            sign_x, grip = (1.0, now.grip_fl if left else now.grip_fr) if ahead else (-1.0, now.grip_rl if left else now.grip_rr)
            x = sign_x * body.half_wheelbase
            drift = (vy + x * wz) * per
            whole = 1.0 / math.sqrt(slip * slip + drift * drift + body.creep * body.creep)
            fx = -body.mu * grip * taken * slip * whole - drag  # 3.15
            fy = -body.mu * grip * body.side * drift * whole * (1.0 + body.tread * drift * whole)  # 3.16
            m = (x - now.cg_x) * fy - (y - now.cg_y) * fx
            x_0, x_xi, x_eta, x_t = x_0 + fx, x_xi + sign_x * fx, x_eta + sign_y * fx, x_t + sign_x * sign_y * fx
            y_0, y_xi, y_eta, y_t = y_0 + fy, y_xi + sign_x * fy, y_eta + sign_y * fy, y_t + sign_x * sign_y * fy
            m_0, m_xi, m_eta, m_t = m_0 + m, m_xi + sign_x * m, m_eta + sign_y * m, m_t + sign_x * sign_y * m

    # Loads hang on the accelerations, and these on the loads: 3.21-3.25, linear until a wheel lifts.
    load = now.mass * (body.gravity + now.cg_az)  # 3.21
    lean_x, lean_y = 0.25 * body.height / body.half_wheelbase, 0.25 * body.height / body.half_track
    xi_0, eta_0 = now.cg_x / body.half_wheelbase, now.cg_y / body.half_track  # 3.23, 3.22
    xi, eta = _inside(xi_0), _inside(eta_0)
    t = t_xi = t_eta = 0.0
    for _ in range(_CLOSURE_STEPS):
        _, _, _, _, t, t_xi, t_eta = loads(xi, eta, body.warp)
        off_x = xi - xi_0 + lean_x * (x_0 + x_xi * xi + x_eta * eta + x_t * t)
        off_y = eta - eta_0 + lean_y * (y_0 + y_xi * xi + y_eta * eta + y_t * t)
        a, b = 1.0 + lean_x * (x_xi + x_t * t_xi), lean_x * (x_eta + x_t * t_eta)
        c, d = lean_y * (y_xi + y_t * t_xi), 1.0 + lean_y * (y_eta + y_t * t_eta)
        over = 1.0 / (a * d - b * c)
        new_xi = _inside(xi - over * (d * off_x - b * off_y))
        new_eta = _inside(eta - over * (a * off_y - c * off_x))
        moved = abs(new_xi - xi) + abs(new_eta - eta)
        xi, eta = new_xi, new_eta
        if moved < 1e-13:
            break
    _, _, _, _, t, t_xi, t_eta = loads(xi, eta, body.warp)
    share_x = 0.25 * (x_0 + x_xi * xi + x_eta * eta + x_t * t)
    share_y = 0.25 * (y_0 + y_xi * xi + y_eta * eta + y_t * t)
    share_m = 0.25 * (m_0 + m_xi * xi + m_eta * eta + m_t * t)
    mean_mu = 0.25 * body.mu * (now.grip_fl + now.grip_fr + now.grip_rl + now.grip_rr)
    spin = wz * body.half_track * per
    whole = 1.0 / math.sqrt(spin * spin + body.creep * body.creep)
    share_m -= mean_mu * body.scrub * spin * whole
    margin = 1.0 - max(abs(xi_0 - 4.0 * lean_x * share_x), abs(eta_0 - 4.0 * lean_y * share_y))

    # Derivatives: of the forces at these loads, then by the loads, which move so that off_x and off_y stay zero.
    fx_vx = fx_vy = fx_wz = fy_vx = fy_vy = fy_wz = fm_vx = fm_vy = fm_wz = 0.0
    for left in (True, False):
        sign_y, roll = (1.0, now.roll_left * per) if left else (-1.0, now.roll_right * per)
        y = sign_y * body.half_track
        slip = (vx - y * wz) * per - roll
        taken, by_slip, _, _ = traction(slip, roll, body.slip_stiffness, body.creep)
        for ahead in (True, False):
            sign_x, grip = (1.0, now.grip_fl if left else now.grip_fr) if ahead else (-1.0, now.grip_rl if left else now.grip_rr)
            x = sign_x * body.half_wheelbase
            n = 0.25 * (1.0 + sign_x * xi + sign_y * eta + sign_x * sign_y * t) * body.mu * grip * per
            _, _, xs, xd, ys, yd = contact(slip, (vy + x * wz) * per, taken, by_slip, body.side, body.tread, body.creep)
            xs, xd, ys, yd = n * xs, n * xd, n * ys, n * yd
            x_w, y_w = x * xd - y * xs, x * yd - y * ys
            at_x, at_y = x - now.cg_x, y - now.cg_y
            fx_vx, fx_vy, fx_wz = fx_vx + xs, fx_vy + xd, fx_wz + x_w
            fy_vx, fy_vy, fy_wz = fy_vx + ys, fy_vy + yd, fy_wz + y_w
            fm_vx, fm_vy, fm_wz = fm_vx + at_x * ys - at_y * xs, fm_vy + at_x * yd - at_y * xd, fm_wz + at_x * y_w - at_y * x_w
    fm_wz -= mean_mu * body.scrub * body.half_track * per * body.creep * body.creep * whole * whole * whole
    a, b = 1.0 + lean_x * (x_xi + x_t * t_xi), lean_x * (x_eta + x_t * t_eta)
    c, d = lean_y * (y_xi + y_t * t_xi), 1.0 + lean_y * (y_eta + y_t * t_eta)
    over = 1.0 / (a * d - b * c)
    by_xi = 0.25 * (x_xi + x_t * t_xi), 0.25 * (y_xi + y_t * t_xi), 0.25 * (m_xi + m_t * t_xi)
    by_eta = 0.25 * (x_eta + x_t * t_eta), 0.25 * (y_eta + y_t * t_eta), 0.25 * (m_eta + m_t * t_eta)
    xi_vx, eta_vx = _tilt(fx_vx, fy_vx, lean_x, lean_y, a, b, c, d, over)
    xi_vy, eta_vy = _tilt(fx_vy, fy_vy, lean_x, lean_y, a, b, c, d, over)
    xi_wz, eta_wz = _tilt(fx_wz, fy_wz, lean_x, lean_y, a, b, c, d, over)
    fx_vx, fy_vx, fm_vx = _with(fx_vx, fy_vx, fm_vx, xi_vx, eta_vx, by_xi, by_eta)
    fx_vy, fy_vy, fm_vy = _with(fx_vy, fy_vy, fm_vy, xi_vy, eta_vy, by_xi, by_eta)
    fx_wz, fy_wz, fm_wz = _with(fx_wz, fy_wz, fm_wz, xi_wz, eta_wz, by_xi, by_eta)

    # 3.24-3.26, then 3.18 and 3.19 solved for the base
    p, i = load / now.mass, load / now.inertia
    alpha = i * share_m
    x_g, y_g = now.cg_x, now.cg_y
    base_x = p * share_x + now.force_x / now.mass - now.cg_ax + y_g * alpha + 2.0 * now.cg_vy * wz + x_g * wz * wz + vy * wz
    base_y = p * share_y + now.force_y / now.mass - now.cg_ay - x_g * alpha - 2.0 * now.cg_vx * wz + y_g * wz * wz - vx * wz
    return Change(
        base_x,
        base_y,
        alpha,
        margin,
        p * fx_vx + y_g * i * fm_vx,
        p * fx_vy + y_g * i * fm_vy + wz,
        p * fx_wz + y_g * i * fm_wz + 2.0 * now.cg_vy + 2.0 * x_g * wz + vy,
        p * fy_vx - x_g * i * fm_vx - wz,
        p * fy_vy - x_g * i * fm_vy,
        p * fy_wz - x_g * i * fm_wz - 2.0 * now.cg_vx + 2.0 * y_g * wz - vx,
        i * fm_vx,
        i * fm_vy,
        i * fm_wz,
    )


@numba.njit(cache=True, error_model="numpy")
def _inside(share: float) -> float:  # pragma: no cover
    return min(1.0, max(-1.0, share))


@numba.njit(cache=True, error_model="numpy")
def _tilt(
    fx: float, fy: float, lean_x: float, lean_y: float, a: float, b: float, c: float, d: float, over: float
) -> tuple[float, float]:  # pragma: no cover
    """How xi and eta move with a velocity by which the shares of force change by ``fx`` and ``fy`` at fixed loads."""
    off_x, off_y = 4.0 * lean_x * fx, 4.0 * lean_y * fy
    return -over * (d * off_x - b * off_y), -over * (a * off_y - c * off_x)


@numba.njit(cache=True, error_model="numpy")
def _with(
    x: float, y: float, m: float, xi: float, eta: float, by_xi: tuple[float, float, float], by_eta: tuple[float, float, float]
) -> tuple[float, float, float]:  # pragma: no cover
    return x + by_xi[0] * xi + by_eta[0] * eta, y + by_xi[1] * xi + by_eta[1] * eta, m + by_xi[2] * xi + by_eta[2] * eta
