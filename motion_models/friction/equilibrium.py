"""The balance of forces on a skidding robot (Ebersole 2016, 3.24-3.26), and its solution: from wheel speeds to motion.

In steady motion friction, rolling resistance and, where it is modelled, the centripetal force cancel. Newton's method with a line search
solves the three equations, from the closed solution of tyres whose force is proportional to slip, then from straight motion at the wheel
speed that is weighted by load. Where both fail (near a CG over an axle or a side, friction turns from sticking to sliding within a
thousandth of the wheels' speed), continuation follows: the friction is rounded as wide as the wheels' speed, which makes it almost
linear, and narrowed step by step; a centripetal force and the pull of a slope are then increased from zero in the same way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from motion_models.compiled import subroutine
from motion_models.friction.contact import CREEP, Tyre, contact, rolling
from motion_models.linear_equations import Matrix3, solve_3x3
from motion_models.se2 import FloatArray


class Floor(NamedTuple):
    """What the motion depends on besides wheels and load; see `model.FrictionModel`."""

    half_track: float
    half_wheelbase: float
    tyre: Tyre
    drag: float
    """f_r / mu_x: rolling resistance as part of the friction."""
    scrub: float


class Loads(NamedTuple):
    """Shares of the weight on front left, front right, rear left and rear right; and the CG, for the centripetal force."""

    fl: float
    fr: float
    rl: float
    rr: float
    cg_x: float = 0.0
    """[m]"""
    cg_y: float = 0.0
    """[m]"""
    pull: float = 0.0
    """Square of the wheels' speed over mu g [m]: centripetal acceleration in units of friction's. 0 leaves inertia out."""
    slope_x: float = 0.0
    """Gravity along the ground ahead, over mu times that normal to it: the pull of a slope in units of friction's."""
    slope_y: float = 0.0
    """Gravity along the ground to the left, over mu times that normal to it."""


class Balance(NamedTuple):
    """Residuals of the forces along x and y and of the yaw moment [m], per mu_x m g, with derivatives by vx, vy, wz and the rolls."""

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
    x_left: float
    y_left: float
    m_left: float
    x_right: float
    y_right: float
    m_right: float


COLUMNS = 20
"""Number of columns of `sensitivities`; the last three, from `_VX` on, are the balance's own derivatives by vx, vy, wz."""
_PULL, _SLOPE, _VX = 12, 15, 17
MAX_EVALUATIONS = 30
"""Evaluations of the balance from one start before another way is tried."""
NARROWING = 0.3
"""Largest step of the rounding, as a factor."""
_CONVERGED = 1e-7
"""Step of Newton's method, in units of the wheels' speed, after which one more changes nothing: it squares the error."""
_MIN_STEP = 1e-4
"""Least step of the centripetal force, as a share of it."""


@subroutine
def balance(vx: float, vy: float, wz: float, roll_l: float, roll_r: float, load: Loads, floor: Floor, creep: float) -> Balance:
    """The balance at the twist ``vx, vy, wz`` [1, 1, 1/m] of wheels that roll at ``roll_l`` and ``roll_r`` [1]."""
    bx = by = bm = x_vx = x_vy = x_wz = y_vx = y_vy = y_wz = m_vx = m_vy = m_wz = 0.0
    x_left = y_left = m_left = x_right = y_right = m_right = 0.0
    for left in (True, False):
        y, roll, front, rear = (floor.half_track, roll_l, load.fl, load.rl) if left else (-floor.half_track, roll_r, load.fr, load.rr)
        slip = vx - y * wz - roll
        direction, direction_by_roll = rolling(roll)
        drag, drag_by_roll = floor.drag * direction, floor.drag * direction_by_roll  # 3.17
        x_roll = y_roll = m_roll = 0.0
        for ahead in (True, False):
            x, n = (floor.half_wheelbase, front) if ahead else (-floor.half_wheelbase, rear)
            f = contact(slip, vy + x * wz, roll, floor.tyre, creep)
            fx, fy = n * (f.x - drag), n * f.y
            xs, xd, ys, yd = n * f.x_slip, n * f.x_drift, n * f.y_slip, n * f.y_drift
            xw, yw = x * xd - y * xs, x * yd - y * ys
            xr, yr = n * (f.x_roll - drag_by_roll) - xs, n * f.y_roll - ys
            bx, by, bm = bx + fx, by + fy, bm + (x * fy - y * fx)  # 3.24, 3.25, 3.26
            x_vx, x_vy, x_wz = x_vx + xs, x_vy + xd, x_wz + xw
            y_vx, y_vy, y_wz = y_vx + ys, y_vy + yd, y_wz + yw
            m_vx, m_vy, m_wz = m_vx + (x * ys - y * xs), m_vy + (x * yd - y * xd), m_wz + (x * yw - y * xw)
            x_roll, y_roll, m_roll = x_roll + xr, y_roll + yr, m_roll + (x * yr - y * xr)
        if left:
            x_left, y_left, m_left = x_roll, y_roll, m_roll
        else:
            x_right, y_right, m_right = x_roll, y_roll, m_roll
    spin = wz * floor.half_track
    whole = 1.0 / math.sqrt(spin * spin + creep * creep)
    bm -= floor.scrub * spin * whole
    m_wz -= floor.scrub * floor.half_track * creep * creep * whole * whole * whole
    if load.pull != 0.0:  # m a of the CG on its circle, by 3.18 and 3.19; its moment about the wheelbase's centre
        p, gx, gy = load.pull, load.cg_x, load.cg_y
        bx += p * (vy + gx * wz) * wz
        by -= p * (vx - gy * wz) * wz
        bm -= p * (gx * vx + gy * vy) * wz
        x_vy, x_wz = x_vy + p * wz, x_wz + p * (vy + 2.0 * gx * wz)
        y_vx, y_wz = y_vx - p * wz, y_wz - p * (vx - 2.0 * gy * wz)
        m_vx, m_vy, m_wz = m_vx - p * gx * wz, m_vy - p * gy * wz, m_wz - p * (gx * vx + gy * vy)
    if load.slope_x != 0.0 or load.slope_y != 0.0:  # gravity along the ground, at the CG
        bx, by = bx + load.slope_x, by + load.slope_y
        bm += load.cg_x * load.slope_y - load.cg_y * load.slope_x
    return Balance(
        *(bx, by, bm, x_vx, x_vy, x_wz, y_vx, y_vy, y_wz, m_vx, m_vy, m_wz),
        *(x_left, y_left, m_left, x_right, y_right, m_right),
    )


@subroutine
def twist_change(b: Balance, x: float, y: float, m: float) -> tuple[float, float, float]:
    """The twist by which the balance changes by ``x, y, m``. NaN where its derivative is singular."""
    return solve_3x3(Matrix3(b.x_vx, b.x_vy, b.x_wz, b.y_vx, b.y_vy, b.y_wz, b.m_vx, b.m_vy, b.m_wz), x, y, m)


@subroutine
def newton(
    vx: float, vy: float, wz: float, roll_l: float, roll_r: float, load: Loads, floor: Floor, creep: float
) -> tuple[float, float, float, bool]:
    """The twist that balances, from the twist ``vx, vy, wz``, and whether it was found within `MAX_EVALUATIONS` evaluations."""
    arm = floor.half_track
    dx = dy = dw = 0.0
    fraction, left = 1.0, math.inf
    for _ in range(MAX_EVALUATIONS):
        x, y, w = vx + fraction * dx, vy + fraction * dy, wz + fraction * dw
        b = balance(x, y, w, roll_l, roll_r, load, floor, creep)
        now = b.x * b.x + b.y * b.y + b.m * b.m / (arm * arm)
        if now < (1.0 - 1e-4 * fraction) * left or now < 1e-26:
            vx, vy, wz, left = x, y, w, now
            dx, dy, dw = twist_change(b, -b.x, -b.y, -b.m)
            size = max(abs(dx), abs(dy), abs(dw) * arm)
            if size < _CONVERGED:
                return vx + dx, vy + dy, wz + dw, True
            fraction = min(1.0, 2.0 / size)
        else:
            fraction *= 0.4
            if fraction < 1e-3:
                break
    return vx, vy, wz, False


@subroutine
def linear_motion(roll_l: float, roll_r: float, load: Loads, floor: Floor) -> tuple[float, float, float]:
    """The twist of wheels whose force is proportional to slip and load: with the CG at the centre k = 1 / (1 + (wheelbase / track)^2)."""
    left, right = roll_l * (load.fl + load.rl), roll_r * (load.fr + load.rr)
    x = floor.half_wheelbase * (load.fl + load.fr - load.rl - load.rr)
    y = floor.half_track * (load.fl + load.rl - load.fr - load.rr)
    arm = floor.half_track * floor.half_track + floor.half_wheelbase * floor.half_wheelbase
    forward = left + right
    wz = (y * forward - floor.half_track * (left - right)) / (arm - x * x - y * y)
    return forward + wz * y, -wz * x, wz


@subroutine
def motion(roll_l: float, roll_r: float, load: Loads, floor: Floor) -> tuple[float, float, float, bool]:
    """The twist [1, 1, 1/m] of wheels that roll at ``roll_l, roll_r`` (root mean square 1, or both 0), and whether it was found."""
    if roll_l == 0.0 and roll_r == 0.0:
        return 0.0, 0.0, 0.0, True
    start_x, start_y, start_w = linear_motion(roll_l, roll_r, load, floor)
    vx, vy, wz, found = newton(start_x, start_y, start_w, roll_l, roll_r, load, floor, CREEP)
    if not found:
        held = roll_l * (load.fl + load.rl) + roll_r * (load.fr + load.rr)
        vx, vy, wz, found = newton(held, 0.0, 0.0, roll_l, roll_r, load, floor, CREEP)
    if not found:
        still = reduced(load, 0.0, 0.0)
        vx, vy, wz, found = _narrowed(roll_l, roll_r, still, floor)
        if found and (load.pull != 0.0 or load.slope_x != 0.0 or load.slope_y != 0.0):
            vx, vy, wz, found = _pulled(vx, vy, wz, roll_l, roll_r, load, floor)
    return vx, vy, wz, found


@subroutine
def _narrowed(roll_l: float, roll_r: float, load: Loads, floor: Floor) -> tuple[float, float, float, bool]:
    """`motion` by continuation: friction rounded less and less."""
    from_x, from_y, from_w = 0.5 * (roll_l + roll_r), 0.0, 0.0
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
    return from_x, from_y, from_w, False


@subroutine
def _pulled(vx: float, vy: float, wz: float, roll_l: float, roll_r: float, load: Loads, floor: Floor) -> tuple[float, float, float, bool]:
    """`motion` by continuation, from the twist without a centripetal force and the pull of a slope."""
    share, step = 0.0, 1.0
    while share < 1.0:
        trial = min(share + step, 1.0)
        pulled = reduced(load, trial, load.pull)
        x, y, w, found = newton(vx, vy, wz, roll_l, roll_r, pulled, floor, CREEP)
        if found:
            vx, vy, wz, share = x, y, w, trial
            step *= 2.0
        else:
            step *= 0.3
            if step < _MIN_STEP * max(share, _MIN_STEP):
                return vx, vy, wz, False
    return vx, vy, wz, True


@subroutine
def reduced(load: Loads, share: float, pull: float) -> Loads:
    """``load`` with a ``share`` of the slope's pull and of ``pull`` instead of its own."""
    return Loads(load.fl, load.fr, load.rl, load.rr, load.cg_x, load.cg_y, share * pull, share * load.slope_x, share * load.slope_y)


class Steady(NamedTuple):
    """A solved motion: twist and wheels' speeds, over the wheels' root mean square."""

    vx: float
    vy: float
    wz: float
    """[1/m]"""
    roll_l: float
    roll_r: float


@subroutine
def sensitivities(at: Steady, load: Loads, tilt: tuple[float, float, float], floor: Floor, by: FloatArray, has_slope: bool) -> None:
    """Derivatives of the solved twist, by the implicit function theorem: -(d balance / d twist)^-1 (d balance / d parameter).

    ``tilt`` are the derivatives of the loads' diagonal term by xi, eta and warp (see `contact.loads`). Fills ``by`` (3, `COLUMNS`): columns
    roll_l, roll_r, xi, eta, warp, half_track, half_wheelbase, slip_stiffness, mu_ratio, drag, scrub, tread, pull, then cg_x and cg_y as
    far as inertia and the pull of a slope act at them; with ``has_slope`` the slope's pull along x and y, too.
    """
    by[:] = 0.0
    _add_wheels(at, load, tilt, floor, by)
    spin = at.wz * floor.half_track
    whole = 1.0 / math.sqrt(spin * spin + CREEP * CREEP)
    by[2, 5] -= floor.scrub * at.wz * CREEP * CREEP * whole * whole * whole
    by[2, _VX + 2] -= floor.scrub * floor.half_track * CREEP * CREEP * whole * whole * whole
    by[2, 10] -= spin * whole
    columns = _PULL
    if load.pull != 0.0:
        columns = _SLOPE
        _add_pull(at, load, by)
    if has_slope:
        columns = _VX
        by[0, _SLOPE], by[2, _SLOPE] = 1.0, -load.cg_y
        by[1, _SLOPE + 1], by[2, _SLOPE + 1] = 1.0, load.cg_x
        by[2, 13] += load.slope_y
        by[2, 14] -= load.slope_x
    b = Balance(
        *(0.0, 0.0, 0.0, by[0, _VX], by[0, _VX + 1], by[0, _VX + 2], by[1, _VX], by[1, _VX + 1], by[1, _VX + 2]),
        *(by[2, _VX], by[2, _VX + 1], by[2, _VX + 2]),
        *(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )
    for j in range(columns):
        by[0, j], by[1, j], by[2, j] = twist_change(b, -by[0, j], -by[1, j], -by[2, j])


@subroutine
def _add_wheels(at: Steady, load: Loads, tilt: tuple[float, float, float], floor: Floor, by: FloatArray) -> None:
    """Derivatives of the contact forces' balance; arguments as in `sensitivities`."""
    for left in (True, False):
        sign_y, wheel = (1.0, 0) if left else (-1.0, 1)
        y, roll, front, rear = (floor.half_track, at.roll_l, load.fl, load.rl) if left else (-floor.half_track, at.roll_r, load.fr, load.rr)
        slip = at.vx - y * at.wz - roll
        direction, direction_by_roll = rolling(roll)
        for ahead in (True, False):
            sign_x, n = (1.0, front) if ahead else (-1.0, rear)
            x = sign_x * floor.half_wheelbase
            f = contact(slip, at.vy + x * at.wz, roll, floor.tyre, CREEP)
            fx = f.x - floor.drag * direction
            xs, xd, ys, yd = n * f.x_slip, n * f.x_drift, n * f.y_slip, n * f.y_drift
            _add(by, wheel, n * (f.x_roll - floor.drag * direction_by_roll) - xs, n * f.y_roll - ys, x, y)
            for j, sign in ((0, sign_x), (1, sign_y), (2, 0.0)):
                share = 0.25 * (sign + sign_x * sign_y * tilt[j])
                _add(by, 2 + j, share * fx, share * f.y, x, y)
            _add(by, 5, -sign_y * at.wz * xs, -sign_y * at.wz * ys, x, y)
            by[2, 5] -= sign_y * n * fx
            _add(by, 6, sign_x * at.wz * xd, sign_x * at.wz * yd, x, y)
            by[2, 6] += sign_x * n * f.y
            _add(by, 7, n * f.x_stiffness, n * f.y_stiffness, x, y)
            _add(by, 8, 0.0, n * f.y / floor.tyre.mu_ratio, x, y)
            _add(by, 9, -n * direction, 0.0, x, y)
            _add(by, 11, 0.0, n * f.y_tread, x, y)
            _add(by, _VX, xs, ys, x, y)
            _add(by, _VX + 1, xd, yd, x, y)
            _add(by, _VX + 2, x * xd - y * xs, x * yd - y * ys, x, y)


@subroutine
def _add_pull(at: Steady, load: Loads, by: FloatArray) -> None:
    """Derivatives of the centripetal force's balance."""
    vx, vy, wz, p, gx, gy = at.vx, at.vy, at.wz, load.pull, load.cg_x, load.cg_y
    by[0, 12], by[1, 12], by[2, 12] = (vy + gx * wz) * wz, -(vx - gy * wz) * wz, -(gx * vx + gy * vy) * wz
    by[0, 13], by[2, 13] = load.pull * wz * wz, -load.pull * vx * wz
    by[1, 14], by[2, 14] = load.pull * wz * wz, -load.pull * vy * wz
    by[0, _VX + 1], by[0, _VX + 2] = by[0, _VX + 1] + p * wz, by[0, _VX + 2] + p * (vy + 2.0 * gx * wz)
    by[1, _VX], by[1, _VX + 2] = by[1, _VX] - p * wz, by[1, _VX + 2] - p * (vx - 2.0 * gy * wz)
    by[2, _VX], by[2, _VX + 1] = by[2, _VX] - p * gx * wz, by[2, _VX + 1] - p * gy * wz
    by[2, _VX + 2] -= p * (gx * vx + gy * vy)


@subroutine
def _add(by: FloatArray, column: int, x: float, y: float, at_x: float, at_y: float) -> None:
    """Add a force of a wheel at ``at_x, at_y`` to the balance in a column."""
    by[0, column] += x
    by[1, column] += y
    by[2, column] += at_x * y - at_y * x
