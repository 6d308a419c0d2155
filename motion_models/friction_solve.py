"""The balance of forces on a skidding robot (Ebersole 2016, 3.24-3.26), and its solution: from wheel speeds to motion.

Without accelerations the three equations say that friction and rolling resistance cancel. Newton's method with a line search solves
them from one of two starts, a robot that slides through its turn or one that its loaded side holds. Where both fail (near a CG over an
axle or a side, the floor holds and lets go within a thousandth of the wheels' speed), the friction is first rounded as wide as the
wheels' speed itself, which makes it almost linear, and then narrowed step by step, from solution to solution.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba

from motion_models.friction_kernel import CREEP, contact, rolling, traction
from motion_models.se2 import FloatArray


class Floor(NamedTuple):
    """What the motion depends on besides wheels and load; see `friction.FrictionModel`."""

    half_track: float
    half_wheelbase: float
    slip_stiffness: float
    side: float
    """mu_y / mu_x (1 - exp(-K)) of 3.16."""
    drag: float
    """f_r / mu_x: rolling resistance as part of the friction."""
    scrub: float
    tread: float


class Loads(NamedTuple):
    """Shares of the weight on front left, front right, rear left and rear right."""

    fl: float
    fr: float
    rl: float
    rr: float


class Balance(NamedTuple):
    """What is left of the forces along x and y and of the yaw moment [m], per mu_x m g, with its derivatives by vx, vy, wz."""

    x: float
    y: float
    m: float
    x_vx: float
    x_vy: float
    x_wz: float
    y_vx: float
    y_vy: float
    y_wz: float
    m_vx: float
    m_vy: float
    m_wz: float


EFFORT = 30
"""Evaluations of the balance from one start before another way is tried."""
NARROWING = 0.3
"""Largest step of the rounding, as a factor."""


@numba.njit(cache=True, error_model="numpy")
def balance(
    vx: float, vy: float, wz: float, roll_l: float, roll_r: float, load: Loads, floor: Floor, creep: float
) -> Balance:  # pragma: no cover
    """The balance at the twist ``vx, vy, wz`` [1, 1, 1/m] of wheels that roll at ``roll_l`` and ``roll_r`` [1]."""
    bx = by = bm = x_vx = x_vy = x_wz = y_vx = y_vy = y_wz = m_vx = m_vy = m_wz = 0.0
    for left in (True, False):
        y, roll, front, rear = (floor.half_track, roll_l, load.fl, load.rl) if left else (-floor.half_track, roll_r, load.fr, load.rr)
        slip = vx - y * wz - roll
        taken, taken_by_slip, _, _ = traction(slip, roll, floor.slip_stiffness, creep)
        drag = floor.drag * rolling(roll)[0]  # 3.17
        for ahead in (True, False):
            x, n = (floor.half_wheelbase, front) if ahead else (-floor.half_wheelbase, rear)
            fx, fy, fx_slip, fx_drift, fy_slip, fy_drift = contact(
                slip, vy + x * wz, n * taken, n * taken_by_slip, n * floor.side, floor.tread, creep
            )
            fx -= n * drag
            fx_wz, fy_wz = x * fx_drift - y * fx_slip, x * fy_drift - y * fy_slip
            bx, by, bm = bx + fx, by + fy, bm + (x * fy - y * fx)  # 3.24, 3.25, 3.26
            x_vx, x_vy, x_wz = x_vx + fx_slip, x_vy + fx_drift, x_wz + fx_wz
            y_vx, y_vy, y_wz = y_vx + fy_slip, y_vy + fy_drift, y_wz + fy_wz
            m_vx, m_vy = m_vx + (x * fy_slip - y * fx_slip), m_vy + (x * fy_drift - y * fx_drift)
            m_wz += x * fy_wz - y * fx_wz
    spin = wz * floor.half_track
    whole = 1.0 / math.sqrt(spin * spin + creep * creep)
    bm -= floor.scrub * spin * whole
    m_wz -= floor.scrub * floor.half_track * creep * creep * whole * whole * whole
    return Balance(bx, by, bm, x_vx, x_vy, x_wz, y_vx, y_vy, y_wz, m_vx, m_vy, m_wz)


@numba.njit(cache=True, error_model="numpy")
def solved(b: Balance, x: float, y: float, m: float) -> tuple[float, float, float]:  # pragma: no cover
    """The twist by which the balance changes by ``x, y, m``: its derivative matrix, inverted and applied. NaN where it is singular."""
    c00 = b.y_vy * b.m_wz - b.y_wz * b.m_vy
    c10 = b.y_wz * b.m_vx - b.y_vx * b.m_wz
    c20 = b.y_vx * b.m_vy - b.y_vy * b.m_vx
    whole = 1.0 / (b.x_vx * c00 + b.x_vy * c10 + b.x_wz * c20)
    vx = c00 * x + (b.x_wz * b.m_vy - b.x_vy * b.m_wz) * y + (b.x_vy * b.y_wz - b.x_wz * b.y_vy) * m
    vy = c10 * x + (b.x_vx * b.m_wz - b.x_wz * b.m_vx) * y + (b.x_wz * b.y_vx - b.x_vx * b.y_wz) * m
    wz = c20 * x + (b.x_vy * b.m_vx - b.x_vx * b.m_vy) * y + (b.x_vx * b.y_vy - b.x_vy * b.y_vx) * m
    return vx * whole, vy * whole, wz * whole


@numba.njit(cache=True, error_model="numpy")
def newton(
    vx: float, vy: float, wz: float, roll_l: float, roll_r: float, load: Loads, floor: Floor, creep: float
) -> tuple[float, float, float, bool]:  # pragma: no cover
    """The twist that balances, from the twist ``vx, vy, wz``, and whether it was found within `EFFORT` evaluations."""
    arm = floor.half_track
    dx = dy = dw = 0.0
    fraction, left = 1.0, math.inf
    for _ in range(EFFORT):
        x, y, w = vx + fraction * dx, vy + fraction * dy, wz + fraction * dw
        b = balance(x, y, w, roll_l, roll_r, load, floor, creep)
        now = b.x * b.x + b.y * b.y + b.m * b.m / (arm * arm)
        if now < (1.0 - 1e-4 * fraction) * left or now < 1e-26:
            vx, vy, wz, left = x, y, w, now
            dx, dy, dw = solved(b, -b.x, -b.y, -b.m)
            size = max(abs(dx), abs(dy), abs(dw) * arm)
            if size < 1e-10:  # this last step squares it
                return vx + dx, vy + dy, wz + dw, True
            fraction = min(1.0, 2.0 / size)
        else:
            fraction *= 0.4
            if fraction < 1e-3:
                break
    return vx, vy, wz, False


@numba.njit(cache=True, error_model="numpy")
def motion(roll_l: float, roll_r: float, load: Loads, floor: Floor) -> tuple[float, float, float, bool]:  # pragma: no cover
    """The twist [1, 1, 1/m] of wheels that roll at ``roll_l, roll_r`` (root mean square 1, or both 0), and whether it was found."""
    if roll_l == 0.0 and roll_r == 0.0:
        return 0.0, 0.0, 0.0, True
    forward = 0.5 * (roll_l + roll_r)
    sliding = 0.27 * (roll_r - roll_l) / floor.half_track
    held = roll_l * (load.fl + load.rl) + roll_r * (load.fr + load.rr)
    for start_x, start_w in ((forward, sliding), (held, 0.0)):
        vx, vy, wz, found = newton(start_x, 0.0, start_w, roll_l, roll_r, load, floor, CREEP)
        if found:
            return vx, vy, wz, True

    from_x, from_y, from_w = forward, 0.0, 0.0
    creep, reached, factor = 1.0, 1.0 / NARROWING, NARROWING
    while factor < 0.995:
        vx, vy, wz, found = newton(from_x, from_y, from_w, roll_l, roll_r, load, floor, creep)
        if found:
            if creep == CREEP:
                return vx, vy, wz, True
            from_x, from_y, from_w, reached = vx, vy, wz, creep
            factor = max(factor * factor, NARROWING)
        else:
            factor = math.sqrt(factor)
        creep = max(reached * factor, CREEP)
    return vx, vy, wz, False


@numba.njit(cache=True, error_model="numpy")
def sensitivities(
    vx: float,
    vy: float,
    wz: float,
    roll_l: float,
    roll_r: float,
    load: Loads,
    tilt: tuple[float, float, float],
    floor: Floor,
    by: FloatArray,
) -> None:  # pragma: no cover
    """Derivatives of the solved twist, by the implicit function theorem: -(balance by twist)^-1 (balance by what moves it).

    ``tilt`` are the derivatives of the loads' diagonal term by xi, eta and warp (see `friction_kernel.loads`). Fills ``by`` (3, 12):
    columns roll_l, roll_r, xi, eta, warp, half_track, half_wheelbase, slip_stiffness, side, drag, scrub, tread.
    """
    by[:] = 0.0
    for left in (True, False):
        sign_y, wheel = (1.0, 0) if left else (-1.0, 1)
        y, roll, front, rear = (floor.half_track, roll_l, load.fl, load.rl) if left else (-floor.half_track, roll_r, load.fr, load.rr)
        slip = vx - y * wz - roll
        taken, by_slip, by_roll, by_stiffness = traction(slip, roll, floor.slip_stiffness, CREEP)
        direction, direction_by_roll = rolling(roll)
        for ahead in (True, False):
            sign_x, n = (1.0, front) if ahead else (-1.0, rear)
            x = sign_x * floor.half_wheelbase
            drift = vy + x * wz
            fx, fy, fx_slip, fx_drift, fy_slip, fy_drift = contact(slip, drift, taken, by_slip, floor.side, floor.tread, CREEP)
            fx -= floor.drag * direction
            whole = 1.0 / math.sqrt(slip * slip + drift * drift + CREEP * CREEP)
            c, s = slip * whole, drift * whole

            _add(by, wheel, n * (-fx_slip - by_roll * c - floor.drag * direction_by_roll), -n * fy_slip, x, y)
            for j, sign in ((0, sign_x), (1, sign_y), (2, 0.0)):
                share = 0.25 * (sign + sign_x * sign_y * tilt[j])
                _add(by, 2 + j, share * fx, share * fy, x, y)
            _add(by, 5, -sign_y * wz * n * fx_slip, -sign_y * wz * n * fy_slip, x, y)
            by[2, 5] -= sign_y * n * fx
            _add(by, 6, sign_x * wz * n * fx_drift, sign_x * wz * n * fy_drift, x, y)
            by[2, 6] += sign_x * n * fy
            _add(by, 7, -n * by_stiffness * c, 0.0, x, y)
            _add(by, 8, 0.0, n * fy / floor.side, x, y)
            _add(by, 9, -n * direction, 0.0, x, y)
            _add(by, 11, 0.0, -n * floor.side * s * s, x, y)
    spin = wz * floor.half_track
    whole = 1.0 / math.sqrt(spin * spin + CREEP * CREEP)
    by[2, 5] -= floor.scrub * wz * CREEP * CREEP * whole * whole * whole
    by[2, 10] -= spin * whole

    b = balance(vx, vy, wz, roll_l, roll_r, load, floor, CREEP)
    for j in range(12):
        by[0, j], by[1, j], by[2, j] = solved(b, -by[0, j], -by[1, j], -by[2, j])


@numba.njit(cache=True, error_model="numpy")
def _add(by: FloatArray, column: int, x: float, y: float, at_x: float, at_y: float) -> None:  # pragma: no cover
    """Add a force of a wheel at ``at_x, at_y`` to the balance in a column."""
    by[0, column] += x
    by[1, column] += y
    by[2, column] += at_x * y - at_y * x
