"""Wheel speeds for a wanted motion: the inverse of `friction_solve.motion`.

The balance knows no speed, so what is wanted is a direction (forward speed against turning) and what is sought is one too: how unlike
the two sides roll. The first grows with the second, so it can be enclosed and cannot be missed; the speed follows by scale.
"""

from __future__ import annotations

import math

import numba

from motion_models.friction_kernel import CREEP
from motion_models.friction_solve import Floor, Loads, motion, newton

_ENCLOSING = 40
_CLOSING = 100
_CLOSE = 1e-14


@numba.njit(cache=True, error_model="numpy")
def rolls_for(vx: float, wz: float, load: Loads, floor: Floor) -> tuple[float, float]:  # pragma: no cover
    """Speeds [m/s] at which the left and right wheels have to roll for ``vx`` [m/s] and ``wz`` [rad/s]; NaN if there are none."""
    wanted = math.hypot(vx, floor.half_track * wz)
    if wanted == 0.0:
        return 0.0, 0.0
    goal = math.atan2(floor.half_track * wz, vx)

    # Enclose: from a robot whose wheels slip away half of the turn, towards the goal until beyond it.
    low = math.atan2(2.0 * floor.half_track * wz, vx)
    error, x, y, w = _miss(low, goal, math.nan, 0.0, 0.0, load, floor)
    step = -math.copysign(min(1.5 * abs(error) + 1e-6, 0.4), error)
    high, error_high = low, error
    for _ in range(_ENCLOSING):
        if abs(error_high) < _CLOSE or error_high * error < 0.0:
            break
        low, error = high, error_high
        high = low + step
        error_high, x, y, w = _miss(high, goal, x, y, w, load, floor)
        step = math.copysign(min(2.0 * abs(step), 0.4), step)
    else:
        return math.nan, math.nan
    if abs(error_high) < _CLOSE:
        low, error = high, error_high

    # Close in: secants, and halves where they are slow (Brent's method in the form of Chandrupatla, 1997).
    other, error_other = low, error
    fraction = 0.5
    for _ in range(_CLOSING):
        if abs(error) < _CLOSE or abs(high - low) < 4e-16 * (1.0 + abs(low)):
            break
        middle = low + fraction * (high - low)
        error_middle, x, y, w = _miss(middle, goal, x, y, w, load, floor)
        if math.isnan(error_middle):
            return math.nan, math.nan
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
    if not abs(error) < 1e-9:
        return math.nan, math.nan
    speed = wanted / math.hypot(x, floor.half_track * w)
    return speed * (math.cos(low) - math.sin(low)), speed * (math.cos(low) + math.sin(low))


@numba.njit(cache=True, error_model="numpy")
def _miss(
    angle: float, goal: float, x: float, y: float, w: float, load: Loads, floor: Floor
) -> tuple[float, float, float, float]:  # pragma: no cover
    """By how much wheels at ``angle`` (0 rolls straight on, pi/2 turns on the spot) miss the ``goal``, and their twist.

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
