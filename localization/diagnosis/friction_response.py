"""Twists of the friction model from sample to sample, without derivatives: quasi-static, or with inertia and on a slope.

`quasi_static_twists` solves the balance of `motion_models.friction.model` by the same Newton's method; it starts from the sample before
where the wheels roll at nearly the same proportion. In `dynamic_twists` each wheel sample is one implicit (backward Euler) step of
`motion_models.friction.dynamics`: stiff contact forces cannot make it unstable, and a long step ends at the quasi-static motion.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from motion_models.calibration.maneuvers import IntArray
from motion_models.errors import ModelError
from motion_models.friction.contact import CREEP
from motion_models.friction.dynamics import FrictionDynamics, _accelerations, _Body
from motion_models.friction.equilibrium import Floor, motion, newton
from motion_models.friction.model import FrictionModel, check_parameters, loads_at, pull_of, unit_rolls
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_CREEP = 3e-3
_NEWTON = 12
_MAX_RESIDUAL = 1e-7  # m/s and rad/s
_MIN_REDUCTION = 0.2  # slopes are good for as long as a step leaves no more than this
_DIFFERENCE = 1e-5
_MAX_ROLL_CHANGE = 0.02  # of unit rolls between samples, for which the last solution starts the next


def quasi_static_twists(model: FrictionModel, params: FloatArray, wheels: FloatArray, cg: FloatArray) -> FloatArray:
    """Body twists (N, 3) of the tracked point for wheel rates (N, 2), CG (N, 2) and ``params`` (12,), by the contact law of ``model``.

    Raises `CgError` and `ModelError` as `FrictionModel.twist` does.
    """
    check_parameters(cg, params)
    out = np.empty((len(wheels), 3))
    _solve_quasi_static(wheels, cg, params, model.floor(params), float(model.centripetal), out)
    lost = np.isnan(out[:, 2]) & np.isfinite(wheels).all(axis=1)
    if np.any(lost):
        raise ModelError(f"no balance of forces found for {np.count_nonzero(lost)} of {lost.size} samples.")
    return out


@numba.njit(cache=True, error_model="numpy")
def _solve_quasi_static(wheels: FloatArray, cg: FloatArray, params: FloatArray, floor: Floor, centripetal: float, out: FloatArray) -> None:
    radius, mu, warp, tracked_x, tracked_y = params[0], params[3], params[8], params[10], params[11]
    vx = vy = wz = previous_l = previous_r = 0.0
    for i in range(wheels.shape[0]):
        speed, roll_l, roll_r = unit_rolls(radius, wheels[i, 0], wheels[i, 1])
        if speed == 0.0:
            out[i] = 0.0
            continue
        load, _ = loads_at(cg[i, 0], cg[i, 1], warp, floor, pull_of(speed, mu, centripetal))
        found = False
        if abs(roll_l - previous_l) < _MAX_ROLL_CHANGE and abs(roll_r - previous_r) < _MAX_ROLL_CHANGE:
            vx, vy, wz, found = newton(vx, vy, wz, roll_l, roll_r, load, floor, CREEP)
        if not found:
            vx, vy, wz, found = motion(roll_l, roll_r, load, floor)
        if not found:
            out[i] = math.nan
            previous_l = previous_r = 0.0
            continue
        previous_l, previous_r = roll_l, roll_r
        out[i, 0], out[i, 1], out[i, 2] = (vx - wz * tracked_y) * speed, (vy + wz * tracked_x) * speed, wz * speed


def dynamic_twists(
    robot: Robot,
    model: FrictionModel,
    params: FloatArray,
    dt: FloatArray,
    wheels: FloatArray,
    cg: FloatArray,
    first: IntArray,
    headings: FloatArray,
    slope: tuple[float, float],
    quasi_static: FloatArray,
) -> FloatArray:
    """Body twists (N, 3) of the wheelbase's centre for wheel rates (N, 2) in intervals ``dt`` (N,), CG (N, 2), ``params`` (12,).

    The contact law is that of ``model``. Maneuvers begin at ``first`` (W + 1,), with the ``headings`` (W,) [rad]; ``slope`` is by how much
    the floor rises along the x and y axes in which headings count [rad]. ``quasi_static`` (N, 3) are the twists without inertia: where each
    maneuver starts, and the result where no step is found. Raises `CgError` and `ModelError` as `FrictionModel` does.
    """
    check_parameters(cg, params)
    dynamics = FrictionDynamics.from_robot(robot)
    body = _Body(
        float(params[3]),
        float(params[8]),
        float(params[0]),
        dynamics.mass,
        dynamics.inertia,
        dynamics.cg_height,
        dynamics.gravity,
        _CREEP,
        dynamics.rest_speed,
    )
    out = np.empty((len(dt), 3))
    _integrate(dt, wheels, cg, first, headings, np.array(slope), quasi_static, model.floor(params), body, out)
    return out


TRACKED = tuple(FrictionModel.param_names.index(name) for name in ("tracked_x", "tracked_y"))


@numba.njit(cache=True, error_model="numpy")
def _integrate(
    dt: FloatArray,
    wheels: FloatArray,
    cg: FloatArray,
    first: IntArray,
    headings: FloatArray,
    slope: FloatArray,
    quasi_static: FloatArray,
    floor: Floor,
    body: _Body,
    out: FloatArray,
) -> None:
    state, influence = np.zeros(6), np.zeros(13)
    influence[12] = body.height
    jacobian, off, off_tried, tried = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    weight = body.mass * body.gravity
    for w in range(first.shape[0] - 1):
        heading = headings[w]
        before = quasi_static[first[w]].copy()
        fresh = True  # the slopes are of another drive, or of none
        for i in range(first[w], first[w + 1]):
            q_l, q_r, h = wheels[i, 0], wheels[i, 1], dt[i]
            if q_l == 0.0 and q_r == 0.0:
                before[:] = 0.0
                out[i] = 0.0
                continue
            c, s = math.cos(heading), math.sin(heading)
            influence[0], influence[1] = cg[i, 0], cg[i, 1]
            influence[7] = -weight * (c * slope[0] + s * slope[1])
            influence[8] = -weight * (-s * slope[0] + c * slope[1])
            influence[10], influence[11] = cg[i, 0], cg[i, 1]
            # start as far from the quasi_static motion as the sample before was, or from it; by the slopes of the sample before, if they do
            found = False
            for start in range(2):
                now = quasi_static[i].copy()
                if start == 0 and i > first[w]:
                    now += before - quasi_static[i - 1]
                size = _misfit(now, before, h, q_l, q_r, state, influence, floor, body, off)
                for _ in range(_NEWTON):
                    if size < _MAX_RESIDUAL:
                        break
                    if not fresh:
                        d0, d1, d2, regular = _solve(jacobian, off)
                        tried[0], tried[1], tried[2] = now[0] - d0, now[1] - d1, now[2] - d2
                        new = _misfit(tried, before, h, q_l, q_r, state, influence, floor, body, off_tried) if regular else math.inf
                        if new < _MIN_REDUCTION * size:
                            now[:] = tried
                            off[:] = off_tried
                            size = new
                            continue
                    for j in range(3):
                        tried[:] = now
                        tried[j] += _DIFFERENCE
                        _misfit(tried, before, h, q_l, q_r, state, influence, floor, body, off_tried)
                        for k in range(3):
                            jacobian[k, j] = (off_tried[k] - off[k]) / _DIFFERENCE
                    fresh = False
                    d0, d1, d2, regular = _solve(jacobian, off)
                    if not regular:
                        break
                    share, better = 1.0, False
                    for _ in range(8):
                        tried[0], tried[1], tried[2] = now[0] - share * d0, now[1] - share * d1, now[2] - share * d2
                        new = _misfit(tried, before, h, q_l, q_r, state, influence, floor, body, off_tried)
                        if new < size:
                            better = True
                            break
                        share *= 0.4
                    if not better:
                        break
                    now[:] = tried
                    off[:] = off_tried
                    size = new
                if size < 1e-3:
                    found = True
                    break
                fresh = True
            out[i] = now if found else quasi_static[i]
            before[:] = out[i]
            heading += out[i, 2] * h


@numba.njit(cache=True, error_model="numpy")
def _misfit(
    twist: FloatArray,
    before: FloatArray,
    h: float,
    q_l: float,
    q_r: float,
    state: FloatArray,
    influence: FloatArray,
    floor: Floor,
    body: _Body,
    off: FloatArray,
) -> float:
    """Fill ``off`` (3,) with how far ``twist`` is off a backward Euler step [m/s, m/s, rad/s]; its length."""
    state[3], state[4], state[5] = twist[0], twist[1], twist[2]
    a_x, a_y, a_w, _ = _accelerations(state, q_l, q_r, influence, floor, body)
    off[0], off[1], off[2] = twist[0] - before[0] - h * a_x, twist[1] - before[1] - h * a_y, twist[2] - before[2] - h * a_w
    return math.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])


@numba.njit(cache=True, error_model="numpy")
def _solve(a: FloatArray, b: FloatArray) -> tuple[float, float, float, bool]:
    """x of a x = b, by Cramer's rule."""
    c0 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c1 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    c2 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    det = a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2
    if det == 0.0 or not math.isfinite(det):
        return 0.0, 0.0, 0.0, False
    x = b[0] * c0 + a[0, 1] * (a[1, 2] * b[2] - b[1] * a[2, 2]) + a[0, 2] * (b[1] * a[2, 1] - a[1, 1] * b[2])
    y = a[0, 0] * (b[1] * a[2, 2] - a[1, 2] * b[2]) + b[0] * c1 + a[0, 2] * (a[1, 0] * b[2] - b[1] * a[2, 0])
    z = a[0, 0] * (a[1, 1] * b[2] - b[1] * a[2, 1]) + a[0, 1] * (b[1] * a[2, 0] - a[1, 0] * b[2]) + b[0] * c2
    return x / det, y / det, z / det, True
