"""The physics of Ebersole 2016, Ch. 3, per wheel and in compiled code: how the load is shared, and what the floor does to a wheel.

Everything here is per unit weight (forces divided by m g) and per unit speed (velocities divided by the wheels' own speed), for
quasi-static friction knows neither: twice the speed or twice the mass is the same motion. `friction_solve` balances it,
`friction_dynamics` moves by it. Wheels come in the order front left, front right, rear left, rear right.

Where the thesis's law is discontinuous it is rounded, by lengths that are fractions of the wheels' speed: Coulomb friction at zero slip
over `CREEP`, rolling resistance at a wheel that changes its direction over `ROLLING`.
"""

from __future__ import annotations

import math

import numba

CREEP = 1e-3
"""Slip, as a fraction of the wheels' speed, at which friction is fully there. A tyre's own is larger."""
ROLLING = 0.02
"""Speed of a wheel, as a fraction of both wheels' root mean square, at which its rolling resistance is fully there."""


@numba.njit(cache=True, error_model="numpy")
def loads(xi: float, eta: float, warp: float) -> tuple[float, float, float, float, float, float, float]:  # pragma: no cover
    """Shares of the weight on the four wheels, then the diagonal term t that is in them and its derivatives by xi and eta.

    ``xi = x_G / (wheelbase / 2)``, ``eta = y_G / (track / 2)``, both inside (-1, 1). On equally stiff wheels

        n_i = (1 + sx_i xi + sy_i eta + sx_i sy_i t) / 4,    sx_i, sy_i = the wheel's signs

    with t = ``warp``. All loads that balance weight and moments have this form, whatever t. Where a wheel would pull at the floor,
    t moves just so far that it lifts off and the other three carry all: that *is* clipping at zero with the balance kept.
    """
    lowest, highest = abs(xi + eta) - 1.0, 1.0 - abs(xi - eta)
    t, t_xi, t_eta = warp, 0.0, 0.0
    if t < lowest:  # front left or rear right in the air
        t = lowest
        t_xi = t_eta = 1.0 if xi + eta > 0.0 else -1.0
    if t > highest:  # front right or rear left in the air
        t = highest
        t_xi = -1.0 if xi - eta > 0.0 else 1.0
        t_eta = -t_xi
    front, rear = 1.0 + xi, 1.0 - xi
    fl, fr = 0.25 * max(front + (eta + t), 0.0), 0.25 * max(front - (eta + t), 0.0)
    rl, rr = 0.25 * max(rear + (eta - t), 0.0), 0.25 * max(rear - (eta - t), 0.0)
    return fl, fr, rl, rr, t, t_xi, t_eta


@numba.njit(cache=True, error_model="numpy")
def traction(slip: float, roll: float, stiffness: float, creep: float) -> tuple[float, float, float, float]:  # pragma: no cover
    """The factor 1 - exp(-K |s_x| / max(|s_x + r q|, |r q|)) of 3.15, with its derivatives by s_x, by r q and by K.

    ``slip`` is s_x, ``roll`` is r q, ``stiffness`` is K. Both sides of a wheelbase have one each: front and rear wheels slip alike.
    """
    over = slip + roll
    rounded = math.sqrt(slip * slip + creep * creep)
    by_slip, by_roll = slip / rounded, 0.0
    if abs(over) >= abs(roll) and abs(over) >= creep:
        fastest = abs(over)
        sign = 1.0 if over > 0.0 else -1.0
        ratio = rounded / fastest
        by_slip, by_roll = (by_slip - ratio * sign) / fastest, -ratio * sign / fastest
    elif abs(roll) >= creep:
        fastest = abs(roll)
        ratio = rounded / fastest
        by_slip, by_roll = by_slip / fastest, -ratio / roll
    else:
        ratio = rounded / creep
        by_slip = by_slip / creep
    left = math.exp(-stiffness * ratio)
    return 1.0 - left, stiffness * left * by_slip, stiffness * left * by_roll, ratio * left


@numba.njit(cache=True, error_model="numpy")
def rolling(roll: float) -> tuple[float, float]:  # pragma: no cover
    """Direction in which a wheel rolls, rounded through zero, and its derivative: the missing sign of 3.17."""
    whole = 1.0 / math.sqrt(roll * roll + ROLLING * ROLLING)
    return roll * whole, ROLLING * ROLLING * whole * whole * whole


@numba.njit(cache=True, error_model="numpy")
def contact(
    slip: float, drift: float, taken: float, taken_by_slip: float, side: float, tread: float, creep: float
) -> tuple[float, float, float, float, float, float]:  # pragma: no cover
    """Forces F_x, F_y at a wheel, per mu_x N, and their derivatives: F_x by s_x, by s_y, then F_y by s_x, by s_y.

    ``slip`` and ``drift`` are s_x and s_y, ``taken`` the factor of `traction` and its derivative, ``side`` is (1 - exp(-K)) mu_y / mu_x.
    ``tread`` makes a wheel that slides to the left grip more by that fraction than one that slides to the right grips less.
    """
    whole = 1.0 / math.sqrt(slip * slip + drift * drift + creep * creep)
    c, s = slip * whole, drift * whole
    fx = -taken * c  # 3.15
    fy = -side * s * (1.0 + tread * s)  # 3.16
    fy_by_s = -side * (1.0 + 2.0 * tread * s)
    fx_by_slip = -taken_by_slip * c - taken * whole * (1.0 - c * c)
    fx_by_drift = taken * whole * c * s
    return fx, fy, fx_by_slip, fx_by_drift, -fy_by_s * whole * c * s, fy_by_s * whole * (1.0 - s * s)
