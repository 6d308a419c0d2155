"""The vehicle in time: motors turn wheels, wheels push at the floor, arms move the mass, and the body goes where that leads."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numba
import numpy as np

from localization.errors import SimulationError
from localization.simulate.dynamics import GAMMA, Chassis, Now, change, follow, implicit_stage
from motion_models.friction import FrictionModel, check_parameters
from motion_models.friction_dynamics import FrictionDynamics
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

POSE, TWIST, RATES, ANGLES, CG, MARGIN, COLUMNS = slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 10), slice(10, 12), 12, 13
"""Columns of a record: pose in the world (heading not wrapped), body twist, rates and angles of left and right, CG, tipping margin."""
_HALVINGS = 10


@dataclass(frozen=True)
class VehicleConfig:
    """How the robot is driven and stepped."""

    step_s: float = 0.005
    """Length of an integration step [s]."""
    motor_lag_s: float = 0.08
    """Time constant of the wheel-speed loop [s]."""
    acceleration_m_s2: float = 1.5
    """How fast the controller lets the wheels' speed change [m/s^2]."""
    creep: float = 1e-3
    """Slip at which friction is fully there, as a fraction of the wheels' speed [-]."""
    gravity: float = 9.81
    """[m/s^2]"""


@dataclass(frozen=True)
class Body:
    """What the robot and its floor really are; the log's metadata know only the nominal robot."""

    params: FloatArray
    """(12,) as `FrictionModel.param_names`; the tracked point plays no part."""
    mass: float
    """[kg]"""
    inertia: float
    """Yaw inertia about the CG [kg m^2]."""
    cg_height: float
    """[m]"""
    radius_left: float
    """[m]"""
    radius_right: float
    """[m]"""
    slope: float = 0.0
    """Tilt of the floor: it rises towards the world's +x by this angle [rad]."""
    cg_offset: tuple[float, float] = (0.0, 0.0)
    """How far the CG really lies from where arms and robot file have it [m]."""
    yields: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shear of a loose floor layer, on which the contacts ride [s, s/m, s/rad]: vy += a vx wz; wz *= 1 - b |vx|; vx -= c vx |wz|."""

    @classmethod
    def from_robot(cls, robot: Robot) -> Body:
        """The nominal robot on its nominal floor."""
        plain = FrictionDynamics.from_robot(robot)
        radius = float(plain.params[0])
        return cls(plain.params, plain.mass, plain.inertia, plain.cg_height, radius, radius)

    def with_param(self, name: str, value: float) -> Body:
        """This body with another friction parameter."""
        params = self.params.copy()
        params[FrictionModel.param_names.index(name)] = value
        return dataclasses.replace(self, params=params)

    def param(self, name: str) -> float:
        return float(self.params[FrictionModel.param_names.index(name)])

    def chassis(self, config: VehicleConfig) -> Chassis:
        """The numbers that the compiled step reads."""
        p = self.params
        return Chassis(
            half_track=p[1] / 2.0,
            half_wheelbase=p[2] / 2.0,
            radius_left=self.radius_left,
            radius_right=self.radius_right,
            mu=p[3],
            side=p[4] * (1.0 - math.exp(-p[5])),
            slip_stiffness=p[5],
            rolling_resistance=p[6],
            scrub=p[7],
            warp=p[8],
            tread=p[9],
            height=self.cg_height,
            gravity=config.gravity * math.cos(self.slope),
            creep=config.creep,
            rest_speed=0.01,
        )


@dataclass
class VehicleState:
    """Where the vehicle is; changed by `advance`."""

    steps: int
    """Steps since the start of the simulation."""
    numbers: FloatArray
    """(12,) pose, twist of the contacts, wheel rates, wheel angles, the speed controller's set points of left and right."""

    @classmethod
    def at(cls, pose: FloatArray) -> VehicleState:
        return cls(0, np.concatenate([pose, np.zeros(9)]).astype(float))

    @property
    def pose(self) -> FloatArray:
        return self.numbers[0:3]

    @property
    def is_standing(self) -> bool:
        return bool(np.abs(self.numbers[3:8]).max() < 1e-3)


def advance(
    state: VehicleState,
    body: Body,
    config: VehicleConfig,
    wheels: FloatArray,
    cg: FloatArray,
    payload: tuple[float, float],
    patches: FloatArray,
) -> FloatArray:
    """Drive on by n steps; the records (n, 13) at their ends.

    ``wheels`` (n, 2) commanded rates [rad/s]; ``cg`` (n, 7) CG x, y, its velocity and its acceleration (z too) at the start of each step;
    ``payload`` mass [kg] and distance from the CG of all [m]; ``patches`` (k, 5) floor rectangles x0, y0, x1, y1 with a factor of the
    friction. Raises `SimulationError` where the robot tips over, `CgError` for a CG outside of the wheels.
    """
    cg = cg + np.array([*body.cg_offset, 0.0, 0.0, 0.0, 0.0, 0.0])
    check_parameters(cg[:, :2], body.params)
    mass = body.mass + payload[0]
    inertia = body.inertia + payload[0] * payload[1] ** 2 * (1.0 + payload[0] / body.mass)
    out = np.empty((len(wheels), COLUMNS))
    ramp = config.acceleration_m_s2 / (0.5 * (body.radius_left + body.radius_right))
    chassis = body.chassis(config)
    start = state.steps * config.step_s
    along = config.gravity * math.sin(body.slope)
    failed = _advance(
        *(state.numbers, np.ascontiguousarray(wheels), np.ascontiguousarray(cg), out, config.step_s),
        *(mass, inertia, along, np.array(body.yields), patches, chassis, config.motor_lag_s, ramp),
    )
    if failed >= 0:
        raise SimulationError(
            f"the forces on the robot could not be balanced {start + failed * config.step_s:.2f} s into the drive (CG at x = "
            f"{cg[failed, 0]:.3f}, y = {cg[failed, 1]:.3f} m). Take a smaller vehicle.step_s, or a larger vehicle.creep."
        )
    tipped = np.flatnonzero(out[:, MARGIN] < 0.0)
    if tipped.size:
        i = int(tipped[0])
        raise SimulationError(
            f"the robot tips over {start + i * config.step_s:.2f} s into the drive: its CG, at x = {cg[i, 0]:.3f}, y = {cg[i, 1]:.3f}, "
            f"z = {body.cg_height:.2f} m, takes the load off both wheels of a side or an axle at a wheel speed of "
            f"{out[i, 6] * body.radius_left:.2f} and {out[i, 7] * body.radius_right:.2f} m/s. Drive more gently or lower the CG."
        )
    state.steps += len(wheels)
    return out


@numba.njit(cache=True, error_model="numpy")
def _grip(x: float, y: float, patches: FloatArray) -> float:  # pragma: no cover
    for i in range(patches.shape[0] - 1, -1, -1):
        if patches[i, 0] <= x <= patches[i, 2] and patches[i, 1] <= y <= patches[i, 3]:
            return float(patches[i, 4])
    return 1.0


@numba.njit(cache=True, error_model="numpy")
def _advance(
    state: FloatArray,
    wheels: FloatArray,
    cg: FloatArray,
    out: FloatArray,
    h: float,
    mass: float,
    inertia: float,
    along: float,
    yields: FloatArray,
    patches: FloatArray,
    body: Chassis,
    lag: float,
    ramp: float,
) -> int:  # pragma: no cover
    """Change ``state`` (12,), fill ``out`` (n, 13); the index of the step that failed, or -1."""
    targets, slopes = np.empty(2), np.empty(2)
    for k in range(wheels.shape[0]):
        for j in range(2):
            targets[j] = state[10 + j]
            slopes[j] = min(ramp, max(-ramp, (wheels[k, j] - targets[j]) / h))
        c, s = math.cos(state[2]), math.sin(state[2])
        grips = 1.0, 1.0, 1.0, 1.0
        if patches.shape[0] > 0:
            fx, fy, lx, ly = c * body.half_wheelbase, s * body.half_wheelbase, -s * body.half_track, c * body.half_track
            grips = (
                _grip(state[0] + fx + lx, state[1] + fy + ly, patches),
                _grip(state[0] + fx - lx, state[1] + fy - ly, patches),
                _grip(state[0] - fx + lx, state[1] - fy + ly, patches),
                _grip(state[0] - fx - lx, state[1] - fy - ly, patches),
            )
        # Where Newton's method does not settle, the step is cut in pieces.
        pieces, margin = 1, -2.0
        for _ in range(_HALVINGS):
            margin = _step(state, targets, slopes, cg[k], h, pieces, mass, inertia, along, yields, grips, body, lag)
            if margin > -2.0:
                break
            pieces *= 2
        if not margin > -2.0:
            return k
        for j in range(2):
            state[10 + j] = targets[j] + slopes[j] * h
        out[k, :10] = state[:10]
        vx, vy, wz = state[3], state[4], state[5]
        out[k, 3], out[k, 4], out[k, 5] = _sheared(vx, vy, wz, yields)
        out[k, 10] = cg[k, 0] + h * (cg[k, 2] + 0.5 * h * cg[k, 4])
        out[k, 11] = cg[k, 1] + h * (cg[k, 3] + 0.5 * h * cg[k, 5])
        out[k, 12] = margin
    return -1


@numba.njit(cache=True, error_model="numpy")
def _sheared(vx: float, vy: float, wz: float, yields: FloatArray) -> tuple[float, float, float]:  # pragma: no cover
    return vx - yields[2] * vx * abs(wz), vy + yields[0] * vx * wz, wz * (1.0 - yields[1] * abs(vx))


@numba.njit(cache=True, error_model="numpy")
def _step(
    state: FloatArray,
    targets: FloatArray,
    slopes: FloatArray,
    cg: FloatArray,
    whole: float,
    pieces: int,
    mass: float,
    inertia: float,
    along: float,
    yields: FloatArray,
    grips: tuple[float, float, float, float],
    body: Chassis,
    lag: float,
) -> float:  # pragma: no cover
    """One step in ``pieces``: changes the first ten of ``state`` and returns the least tipping margin; -3 and no change on failure."""
    h, least = whole / pieces, 1.0
    x, y, theta, vx, vy, wz = state[0], state[1], state[2], state[3], state[4], state[5]
    q_l, q_r, a_l, a_r = state[6], state[7], state[8], state[9]
    for i in range(pieces):
        v_0 = (vx, vy, wz)
        base, guess = v_0, v_0
        rate_x = rate_y = rate_w = 0.0
        from_x, from_y, from_theta = x, y, theta
        by_x = by_y = by_theta = 0.0
        for stage in range(2):
            share = GAMMA if stage == 0 else 1.0
            t = i * h + share * h
            roll_l = follow(state[6], targets[0], slopes[0], lag, t)[0]
            roll_r = follow(state[7], targets[1], slopes[1], lag, t)[0]
            ahead = theta + share * h * guess[2]
            push_x, push_y = -along * mass * math.cos(ahead), along * mass * math.sin(ahead)
            now = Now(
                body.radius_left * roll_l,
                body.radius_right * roll_r,
                grips[0],
                grips[1],
                grips[2],
                grips[3],
                mass,
                inertia,
                cg[0] + t * (cg[2] + 0.5 * t * cg[4]),
                cg[1] + t * (cg[3] + 0.5 * t * cg[5]),
                cg[2] + t * cg[4],
                cg[3] + t * cg[5],
                cg[4],
                cg[5],
                cg[6],
                push_x,
                push_y,
            )
            if stage == 1:
                more = (1.0 - GAMMA) * h
                base = v_0[0] + more * rate_x, v_0[1] + more * rate_y, v_0[2] + more * rate_w
            u, v, w, margin, found = implicit_stage(guess, base, GAMMA * h, now, body)
            if not found or not margin > -2.0:
                return -3.0
            least = min(least, margin)
            rate_x, rate_y, rate_w = (u - base[0]) / (GAMMA * h), (v - base[1]) / (GAMMA * h), (w - base[2]) / (GAMMA * h)
            if stage == 1:
                more = (1.0 - GAMMA) * h
                from_x, from_y, from_theta = x + more * by_x, y + more * by_y, theta + more * by_theta
            su, sv, by_theta = _sheared(u, v, w, yields)
            heading = from_theta + GAMMA * h * by_theta
            c, s = math.cos(heading), math.sin(heading)
            by_x, by_y = c * su - s * sv, s * su + c * sv
            guess = (u, v, w)
        vx, vy, wz = guess
        x, y, theta = from_x + GAMMA * h * by_x, from_y + GAMMA * h * by_y, from_theta + GAMMA * h * by_theta
    state[0], state[1], state[2], state[3], state[4], state[5] = x, y, theta, vx, vy, wz
    q_l, turned_l = follow(state[6], targets[0], slopes[0], lag, whole)
    q_r, turned_r = follow(state[7], targets[1], slopes[1], lag, whole)
    state[6], state[7], state[8], state[9] = q_l, q_r, a_l + turned_l, a_r + turned_r
    return least


def accelerations(body: Body, config: VehicleConfig, wheels: FloatArray, twist: FloatArray, cg: FloatArray) -> tuple[FloatArray, float]:
    """Rate of change (3,) of ``twist`` (3,) at wheel rates ``wheels`` (2,) and a resting CG (2,), and the tipping margin."""
    now = Now(
        *(body.radius_left * wheels[0], body.radius_right * wheels[1], 1.0, 1.0, 1.0, 1.0, body.mass, body.inertia),
        *(cg[0], cg[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )
    found = change(twist[0], twist[1], twist[2], now, body.chassis(config))
    return np.array([found.x, found.y, found.w]), found.margin
