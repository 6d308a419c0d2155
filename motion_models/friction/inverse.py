"""Wheel speeds for a commanded motion: the inverse of `equilibrium.motion`.

The balance is solved for the wheels' speeds and the sideways motion that go with a forward speed and a turn: three equations again, by
Newton's method. Where it does not converge, the wheels' directions are enclosed: without a centripetal force the balance does not depend
on speed, so the command is a direction (forward speed against turning) and the unknown is one too, how unlike the two sides roll.
The first grows with the second, so it can be enclosed and cannot be missed; the speed follows by scale.
"""

from __future__ import annotations

import math

import numba

from motion_models.friction.contact import CREEP
from motion_models.friction.equilibrium import Balance, Floor, Loads, Matrix3, balance, motion, newton, solve_3x3

_EFFORT = 40
"""Evaluations of the balance before the angle is enclosed instead."""
_CLOSE = 1e-7
"""Step of Newton's method [1], after which one more changes nothing: it squares the error."""
_BALANCED = 1e-9
"""Error of the angle [rad] up to which an enclosed solution counts."""
_ENCLOSING = 40
"""Steps of up to 0.4 rad towards the goal: more than a whole turn."""
_CLOSING = 100
"""Of Chandrupatla's method, at worst halves: down to rounding from any interval."""
_CLOSE_ANGLE = 1e-14
"""Rounding of an angle [rad]."""
_FINEST = 1e-3
"""Least step of the centripetal force, as a share of it."""


@numba.njit(cache=True, error_model="numpy")
def rolls_for(vx: float, wz: float, load: Loads, floor: Floor) -> tuple[float, float]:
    """Speeds [m/s] at which the left and right wheels have to roll for ``vx`` [m/s] and ``wz`` [rad/s]; NaN if there are none.

    ``load.pull`` is that of wheels at 1 m/s.
    """
    commanded = math.hypot(vx, floor.half_track * wz)
    if commanded == 0.0:
        return 0.0, 0.0
    to_x, to_w = vx / commanded, wz / commanded
    unit = load.pull * commanded * commanded
    angle, drift, share = _linear_start(to_x, to_w, load, floor)
    angle, drift, share, found = _solve(angle, drift, share, to_x, to_w, unit, load, floor)
    if not found:
        angle, drift, share, found = _enclosed(to_x, to_w, load, floor)
        if found and unit != 0.0:
            angle, drift, share, found = _pulled(angle, drift, share, to_x, to_w, unit, load, floor)
    if not found:
        return math.nan, math.nan
    speed = commanded / share
    return speed * (math.cos(angle) - math.sin(angle)), speed * (math.cos(angle) + math.sin(angle))


@numba.njit(cache=True, error_model="numpy")
def _linear_start(to_x: float, to_w: float, load: Loads, floor: Floor) -> tuple[float, float, float]:
    """What `_solve` starts from: the inverse of `equilibrium.linear_motion`."""
    x = floor.half_wheelbase * (load.fl + load.fr - load.rl - load.rr)
    y = floor.half_track * (load.fl + load.rl - load.fr - load.rr)
    arm = floor.half_track * floor.half_track + floor.half_wheelbase * floor.half_wheelbase - x * x - y * y
    forward = to_x - to_w * y  # left + right, then left - right of the rolls weighted by load
    apart = (y * forward - arm * to_w) / floor.half_track
    heavy_l, heavy_r = max(load.fl + load.rl, 1e-3), max(load.fr + load.rr, 1e-3)
    roll_l, roll_r = 0.5 * (forward + apart) / heavy_l, 0.5 * (forward - apart) / heavy_r
    size = math.sqrt(0.5 * (roll_l * roll_l + roll_r * roll_r))
    return math.atan2(roll_r - roll_l, roll_r + roll_l), -to_w * x / size, 1.0 / size


@numba.njit(cache=True, error_model="numpy")
def _solve(
    angle: float, drift: float, share: float, to_x: float, to_w: float, unit: float, load: Loads, floor: Floor
) -> tuple[float, float, float, bool]:
    """Newton's method for the wheels' angle (0 rolls straight on, pi/2 turns on the spot), vy and the motion's share of the wheels' speed.

    The motion is ``share`` times ``to_x, to_w``; ``unit`` is the pull at a share of 1.
    """
    d_angle = d_drift = d_share = 0.0
    fraction, left = 1.0, math.inf
    arm = floor.half_track
    for _ in range(_EFFORT):
        a, v, r = angle + fraction * d_angle, drift + fraction * d_drift, share + fraction * d_share
        c, s = math.cos(a), math.sin(a)
        pulled = Loads(load.fl, load.fr, load.rl, load.rr, load.cg_x, load.cg_y, unit / (r * r))
        b = balance(r * to_x, v, r * to_w, c - s, c + s, pulled, floor, CREEP)
        now = b.x * b.x + b.y * b.y + b.m * b.m / (arm * arm)
        if r > 0.0 and (now < (1.0 - 1e-4 * fraction) * left or now < 1e-26):
            angle, drift, share, left = a, v, r, now
            d_angle, d_drift, d_share = _step(b, c, s, v, r, to_x, to_w, pulled)
            size = max(abs(d_angle), abs(d_drift), abs(d_share))
            if size < _CLOSE:
                return angle + d_angle, drift + d_drift, share + d_share, True
            fraction = min(1.0, 0.5 / size)
        else:
            fraction *= 0.4
            if fraction < 1e-3:
                break
    return angle, drift, share, False


@numba.njit(cache=True, error_model="numpy")
def _step(b: Balance, c: float, s: float, v: float, r: float, to_x: float, to_w: float, load: Loads) -> tuple[float, float, float]:
    """The step in angle, vy and share that balances in first order."""
    by_l, by_r = -s - c, c - s
    x_a, y_a, m_a = b.x_left * by_l + b.x_right * by_r, b.y_left * by_l + b.y_right * by_r, b.m_left * by_l + b.m_right * by_r
    x_r, y_r, m_r = b.x_vx * to_x + b.x_wz * to_w, b.y_vx * to_x + b.y_wz * to_w, b.m_vx * to_x + b.m_wz * to_w
    if load.pull != 0.0:  # which grows with the wheels' speed, and that with 1 / share
        p, vx, w, gx, gy = -2.0 * load.pull / r, r * to_x, r * to_w, load.cg_x, load.cg_y
        x_r += p * (v + gx * w) * w
        y_r -= p * (vx - gy * w) * w
        m_r -= p * (gx * vx + gy * v) * w
    x_v, y_v, m_v = b.x_vy, b.y_vy, b.m_vy
    return solve_3x3(Matrix3(x_a, x_v, x_r, y_a, y_v, y_r, m_a, m_v, m_r), -b.x, -b.y, -b.m)


@numba.njit(cache=True, error_model="numpy")
def _pulled(
    angle: float, drift: float, share: float, to_x: float, to_w: float, unit: float, load: Loads, floor: Floor
) -> tuple[float, float, float, bool]:
    """`_solve` from the solution without a centripetal force, by one that grows."""
    reached, step = 0.0, 0.3
    while reached < 1.0:
        trial = min(reached + step, 1.0)
        a, v, r, found = _solve(angle, drift, share, to_x, to_w, trial * unit, load, floor)
        if found:
            angle, drift, share, reached = a, v, r, trial
            step *= 2.0
        else:
            step *= 0.3
            if step < _FINEST:
                return angle, drift, share, False
    return angle, drift, share, True


@numba.njit(cache=True, error_model="numpy")
def _enclosed(to_x: float, to_w: float, load: Loads, floor: Floor) -> tuple[float, float, float, bool]:
    """Angle, vy and share without a centripetal force, by enclosing the angle."""
    still = Loads(load.fl, load.fr, load.rl, load.rr, load.cg_x, load.cg_y, 0.0)
    goal = math.atan2(floor.half_track * to_w, to_x)

    # Enclose: from a robot whose wheels slip away half of the turn, towards the goal until beyond it.
    low = math.atan2(2.0 * floor.half_track * to_w, to_x)
    error, x, y, w = _miss(low, goal, math.nan, 0.0, 0.0, still, floor)
    step = -math.copysign(min(1.5 * abs(error) + 1e-6, 0.4), error)
    high, error_high = low, error
    for _ in range(_ENCLOSING):
        if abs(error_high) < _CLOSE_ANGLE or error_high * error < 0.0:
            break
        low, error = high, error_high
        high = low + step
        error_high, x, y, w = _miss(high, goal, x, y, w, still, floor)
        step = math.copysign(min(2.0 * abs(step), 0.4), step)
    else:
        return math.nan, math.nan, math.nan, False
    if abs(error_high) < _CLOSE_ANGLE:
        low, error = high, error_high

    # Close in: secants, and halves where they are slow (Brent's method in the form of Chandrupatla, 1997).
    other, error_other = low, error
    fraction = 0.5
    for _ in range(_CLOSING):
        if abs(error) < _CLOSE_ANGLE or abs(high - low) < 4e-16 * (1.0 + abs(low)):
            break
        middle = low + fraction * (high - low)
        error_middle, x, y, w = _miss(middle, goal, x, y, w, still, floor)
        if math.isnan(error_middle):
            return math.nan, math.nan, math.nan, False
        if (error_middle > 0.0) == (error > 0.0):
            other, error_other = low, error
        else:
            other, error_other = high, error_high
            high, error_high = low, error
        low, error = middle, error_middle
        width = abs(high - low)
        xi, phi = (low - high) / (other - high), (error - error_high) / (error_other - error_high)
        if phi * phi < xi and (1.0 - phi) * (1.0 - phi) < 1.0 - xi:
            fraction = error / (error_high - error) * error_other / (error_high - error_other)
            fraction += (other - low) / (high - low) * error / (error_other - error) * error_high / (error_other - error_high)
            least = 1e-15 / width
            fraction = min(1.0 - least, max(least, fraction)) if least < 0.5 else 0.5
        else:
            fraction = 0.5
    return low, y, math.hypot(x, floor.half_track * w), abs(error) < _BALANCED


@numba.njit(cache=True, error_model="numpy")
def _miss(angle: float, goal: float, x: float, y: float, w: float, load: Loads, floor: Floor) -> tuple[float, float, float, float]:
    """By how much wheels at ``angle`` miss the ``goal``, and their twist.

    The search starts at the twist ``x, y, w`` of an angle nearby, if it is one.
    """
    c, s = math.cos(angle), math.sin(angle)
    found = False
    if not math.isnan(x):
        x, y, w, found = newton(x, y, w, c - s, c + s, load, floor, CREEP)
    if not found:
        x, y, w, found = motion(c - s, c + s, load, floor)
    if not found:
        return math.nan, x, y, w
    miss = math.atan2(floor.half_track * w, x) - goal
    return miss - 2.0 * math.pi * math.floor(miss / (2.0 * math.pi) + 0.5), x, y, w
