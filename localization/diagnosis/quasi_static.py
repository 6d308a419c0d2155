"""Twists of the friction model without their derivatives, from sample to sample: a diagnosis predicts a drive some hundred times.

The same balance as `motion_models.friction.model`, by the same Newton's method. It starts from the sample before where the wheels roll at
nearly the same proportion, which is where it ends, too.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from motion_models.errors import ModelError
from motion_models.friction.contact import CREEP
from motion_models.friction.equilibrium import Floor, motion, newton
from motion_models.friction.model import FrictionModel, check_parameters, loads_at, pull_of, unit_rolls
from motion_models.se2 import FloatArray

_NEAR = 0.02


def steady_twists(model: FrictionModel, params: FloatArray, wheels: FloatArray, cg: FloatArray) -> FloatArray:
    """Body twists (N, 3) of the tracked point for wheel rates (N, 2), CG (N, 2) and ``params`` (12,), by the contact law of ``model``.

    Raises `CgError` and `ModelError` as `FrictionModel.twist` does.
    """
    check_parameters(cg, params)
    out = np.empty((len(wheels), 3))
    _steady(wheels, cg, params, model.floor(params), float(model.centripetal), out)
    lost = np.isnan(out[:, 2]) & np.isfinite(wheels).all(axis=1)
    if np.any(lost):
        raise ModelError(f"no balance of forces found for {np.count_nonzero(lost)} of {lost.size} samples.")
    return out


@numba.njit(cache=True, error_model="numpy")
def _steady(
    wheels: FloatArray, cg: FloatArray, params: FloatArray, floor: Floor, centripetal: float, out: FloatArray
) -> None:  # pragma: no cover
    radius, mu, warp, tracked_x, tracked_y = params[0], params[3], params[8], params[10], params[11]
    vx = vy = wz = last_l = last_r = 0.0
    for i in range(wheels.shape[0]):
        speed, roll_l, roll_r = unit_rolls(radius, wheels[i, 0], wheels[i, 1])
        if speed == 0.0:
            out[i] = 0.0
            continue
        load, _ = loads_at(cg[i, 0], cg[i, 1], warp, floor, pull_of(speed, mu, centripetal))
        found = False
        if abs(roll_l - last_l) < _NEAR and abs(roll_r - last_r) < _NEAR:
            vx, vy, wz, found = newton(vx, vy, wz, roll_l, roll_r, load, floor, CREEP)
        if not found:
            vx, vy, wz, found = motion(roll_l, roll_r, load, floor)
        if not found:
            out[i] = math.nan
            last_l = last_r = 0.0
            continue
        last_l, last_r = roll_l, roll_r
        out[i, 0], out[i, 1], out[i, 2] = (vx - wz * tracked_y) * speed, (vy + wz * tracked_x) * speed, wz * speed
