"""Forces at a wheel contact, compiled: shares of the load on the wheels, friction and rolling resistance of a slipping wheel.

Everything here is per unit weight (forces divided by m g) and per unit speed (velocities divided by the wheels' own speed). `equilibrium`
balances it, `dynamics` moves by it. Wheels come in the order front left, front right, rear left, rear right.

Two laws, with slip s = (s_x, s_y), wheel speed r q and V = max(|s_x + r q|, |r q|):

    isotropic:  F   = -mu N (1 - exp(-K |s| / V)) s / |s|
    thesis:     F_x = -mu N (1 - exp(-K |s_x| / V)) s_x / |s|     (Ebersole 2016, 3.15)
                F_y = -mu N (1 - exp(-K)) s_y / |s|               (3.16)

The thesis's lateral force is saturated at any slip angle beside a longitudinal force that is not: a free roller is held sideways by the
whole of mu N. In the isotropic law one factor of the total slip acts on both components, as in shear-displacement theory (Wong & Chiang
2001, Proc. IMechE D 215(3): shear stress opposes the resultant shear displacement) and in combined slip of brush tyres (Gaefvert &
Svendenius 2003, ISRN LUTFD2/TFRT-7606; Pacejka, Tyre and Vehicle Dynamics, ch. 3): both components start linear in the slip.

What is discontinuous is rounded, by lengths that are fractions of the wheels' speed: Coulomb friction at zero slip over `CREEP`, rolling
resistance at a wheel that changes its direction over `ROLLING`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from motion_models.compiled import subroutine

CREEP = 1e-3
"""Slip, as a fraction of the wheels' speed, at which the thesis's friction saturates. A tyre's own is larger."""
ROLLING = 0.02
"""Speed of a wheel, as a fraction of both wheels' root mean square, at which its rolling resistance saturates."""
SATURATION: Mapping[str, float] = {"isotropic": 0.0, "thesis": 1.0}
"""Contact laws by name: share of the thesis's law in the force, the rest is isotropic."""


class Tyre(NamedTuple):
    """What the force of a slipping wheel depends on, beside mu and its load."""

    stiffness: float
    """K: slope of the force at zero slip, over mu N [-]."""
    locked: float
    """1 - exp(-K), see `tyre`."""
    mu_ratio: float
    """mu_y / mu_x [-]."""
    tread: float
    """Relative increase of the lateral force of a wheel that slides to the left, and decrease to the right [-]."""
    saturation: float
    """Share of the thesis's law."""


class Force(NamedTuple):
    """Forces at a wheel per mu_x N, with their derivatives by the slip s_x, s_y, by the wheel's speed r q at fixed slip, and by K."""

    x: float
    y: float
    x_slip: float
    x_drift: float
    y_slip: float
    y_drift: float
    x_roll: float
    y_roll: float
    x_stiffness: float
    y_stiffness: float
    y_tread: float


@subroutine
def loads(xi: float, eta: float, warp: float) -> tuple[float, float, float, float, float, float, float]:
    """Shares of the weight on the four wheels, then the diagonal term t that is in them and its derivatives by xi and eta.

    ``xi = x_G / (wheelbase / 2)``, ``eta = y_G / (track / 2)``, both inside (-1, 1). On equally stiff wheels

        n_i = (1 + sx_i xi + sy_i eta + sx_i sy_i t) / 4,    sx_i, sy_i = the wheel's signs

    with t = ``warp``. All loads that balance weight and moments have this form, whatever t. Where a load would be negative, t is moved
    until it is zero: clipping at zero that keeps the balance.
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


@subroutine
def tyre(stiffness: float, mu_ratio: float, tread: float, saturation: float) -> Tyre:
    """A `Tyre`, with its force at a locked wheel computed once."""
    return Tyre(stiffness, 1.0 - math.exp(-stiffness), mu_ratio, tread, saturation)


@subroutine
def rolling(roll: float) -> tuple[float, float]:
    """Direction in which a wheel rolls, rounded through zero, and its derivative: the missing sign of 3.17."""
    whole = 1.0 / math.sqrt(roll * roll + ROLLING * ROLLING)
    return roll * whole, ROLLING * ROLLING * whole * whole * whole


@subroutine
def _fastest(slip: float, roll: float, creep: float) -> tuple[float, float, float]:
    """V = max(|s_x + r q|, |r q|, creep), with its derivatives by s_x and by r q."""
    over = slip + roll
    if abs(over) >= abs(roll) and abs(over) >= creep:
        sign = 1.0 if over > 0.0 else -1.0
        return abs(over), sign, sign
    if abs(roll) >= creep:
        return abs(roll), 0.0, 1.0 if roll > 0.0 else -1.0
    return creep, 0.0, 0.0


@subroutine
def contact(slip: float, drift: float, roll: float, on: Tyre, creep: float) -> Force:
    """Forces at a wheel that slips by ``slip`` = s_x and ``drift`` = s_y while its rim moves at ``roll`` = r q, rounded over ``creep``."""
    whole = 1.0 / math.sqrt(slip * slip + drift * drift + creep * creep)
    c, s = slip * whole, drift * whole
    speed, by_slip, by_roll = _fastest(slip, roll, creep)
    per = 1.0 / speed
    # Factors of both components, with their derivatives
    tx = ty = tx_slip = tx_drift = tx_roll = tx_k = ty_slip = ty_roll = ty_k = 0.0
    if on.saturation != 1.0:
        ratio = per / whole
        left = math.exp(-on.stiffness * ratio)
        slope = (1.0 - on.saturation) * on.stiffness * left * per
        tx = ty = (1.0 - on.saturation) * (1.0 - left)
        tx_slip = ty_slip = slope * (c - ratio * by_slip)
        tx_drift = slope * s
        tx_roll = ty_roll = -slope * ratio * by_roll
        tx_k = ty_k = (1.0 - on.saturation) * ratio * left
    ty_drift = tx_drift
    if on.saturation != 0.0:
        rounded = math.sqrt(slip * slip + creep * creep)
        ratio = rounded * per
        left = math.exp(-on.stiffness * ratio)
        slope = on.saturation * on.stiffness * left * per
        tx += on.saturation * (1.0 - left)  # 3.15
        tx_slip += slope * (slip / rounded - ratio * by_slip)
        tx_roll -= slope * ratio * by_roll
        tx_k += on.saturation * ratio * left
        ty += on.saturation * on.locked  # 3.16
        ty_k += on.saturation * (1.0 - on.locked)
    across = on.mu_ratio * s * (1.0 + on.tread * s)
    across_s = on.mu_ratio * (1.0 + 2.0 * on.tread * s)
    return Force(
        -tx * c,
        -ty * across,
        -tx_slip * c - tx * whole * (1.0 - c * c),
        -tx_drift * c + tx * whole * c * s,
        -ty_slip * across + ty * across_s * whole * c * s,
        -ty_drift * across - ty * across_s * whole * (1.0 - s * s),
        -tx_roll * c,
        -ty_roll * across,
        -tx_k * c,
        -ty_k * across,
        -ty * on.mu_ratio * s * s,
    )
