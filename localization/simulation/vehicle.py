"""The vehicle in time: motors turn wheels, wheels push at the floor, arms move the mass, and the body moves by the forces.

`TrueMotion` holds the last seconds of it, from which sensors read.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from localization.bounded_settings import Positive, Settings, up_to
from localization.errors import SimulationError
from localization.simulation.terrain import NO_WAVES
from localization.simulation.vehicle_dynamics import Chassis, DynamicsInput, Plant, derivatives, integrate
from motion_models.center_of_gravity.cg_model import CgModel, Posture, posture_for
from motion_models.center_of_gravity.files import arms_model, arms_postures
from motion_models.center_of_gravity.parts import Payload
from motion_models.compiled import subroutine
from motion_models.friction.contact import tyre
from motion_models.friction.dynamics import FrictionDynamics
from motion_models.friction.model import FrictionModel, check_parameters
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

POSE, TWIST, RATES, ANGLES, CG, MARGIN, COLUMNS = slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 10), slice(10, 12), 12, 13
"""Columns of a record: pose in the world (heading not wrapped), body twist, rates and angles of left and right, CG, tipping margin."""
IntArray = NDArray[np.int64]
_MAX_LIFTED_S = 0.1  # a robot that its own jerk lifts for less than about sqrt(z_G / g) / 2 falls back onto its wheels


@dataclass(frozen=True)
class VehicleConfig(Settings):
    """How the robot is driven and stepped."""

    step_s: Annotated[float, up_to(0.02)] = 0.005
    """Length of an integration step [s]."""
    motor_lag_s: Positive = 0.08
    """Time constant of the wheel-speed loop [s]."""
    acceleration_m_s2: Positive = 1.5
    """How fast the controller lets the wheels' speed change [m/s^2]."""
    creep: Annotated[float, up_to(0.5)] = 1e-3
    """Slip at which friction is fully there, as a fraction of the wheels' speed [-]."""
    tyre_lag_s: Positive = 0.02
    """Time in which the wheels' loads follow the forces: that of the robot bouncing on its tyres [s]."""
    gravity: Positive = 9.81
    """[m/s^2]"""


@dataclass(frozen=True)
class Body:
    """True parameters of the robot and its floor; the log's metadata have the nominal ones."""

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
    saturation: float = 0.0
    """Contact law of the tyres, as `FrictionModel.saturation`."""
    slope: float = 0.0
    """Tilt of the floor: it rises towards the world's +x by this angle [rad]."""
    grip_split: float = 0.0
    """The left wheels grip more by half of this share, the right ones less."""
    cg_offset: tuple[float, float] = (0.0, 0.0)
    """How far the CG really lies from where arms, topic and `cg_x_m` have it [m]."""
    waves: FloatArray = field(default_factory=lambda: NO_WAVES)
    """(n, 4) hills (`simulation.terrain`)."""
    yields: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shear of a loose floor layer, on which the contacts ride [s, s/m, s/rad]: vy += a vx wz; wz *= 1 - b |vx|; vx -= c vx |wz|."""

    @classmethod
    def from_robot(cls, robot: Robot) -> Body:
        """The nominal robot on its nominal floor."""
        plain = FrictionDynamics.from_robot(robot)
        radius = float(plain.params[0])
        g = robot.geometry
        off = (g.cg_offset_x_m, g.cg_offset_y_m)
        return cls(plain.params, plain.mass, plain.inertia, plain.cg_height, radius, radius, plain.saturation, cg_offset=off)

    def with_param(self, name: str, value: float) -> Body:
        """This body with another friction parameter."""
        params = self.params.copy()
        params[FrictionModel.param_names.index(name)] = value
        return dataclasses.replace(self, params=params)

    def with_radii(self, start: Body, factor: float) -> Body:
        """This body with the wheel radii of ``start`` times ``factor``."""
        return dataclasses.replace(self, radius_left=start.radius_left * factor, radius_right=start.radius_right * factor)

    def param(self, name: str) -> float:
        """A parameter of the friction model by its name."""
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
            tyre=tyre(p[5], p[4], p[9], self.saturation),
            rolling_resistance=p[6],
            scrub=p[7],
            warp=p[8],
            height=self.cg_height,
            gravity=config.gravity * math.cos(self.slope),
            creep=config.creep,
            rest_speed=0.01,
            tyre_lag=config.tyre_lag_s,
            grip_split=self.grip_split,
        )


@dataclass
class VehicleState:
    """State of the vehicle; changed by `advance`."""

    steps: int
    """Steps since the start of the simulation."""
    numbers: FloatArray
    """(16,) pose, twist of the contacts, wheel rates, wheel angles, the speed controller's set points of left and right, tilt of the
    loads and its rate (NaN before the first step)."""
    on_two_wheels: int = 0
    """For how many steps now the tipping margin has been negative."""

    @classmethod
    def at(cls, pose: FloatArray) -> VehicleState:
        """At rest at ``pose`` (3,)."""
        return cls(0, np.concatenate([pose, np.zeros(9), np.full(4, np.nan)]).astype(float))

    @property
    def pose(self) -> FloatArray:
        """(3,) of the body in the world."""
        return self.numbers[0:3]

    @property
    def is_standing(self) -> bool:
        """Whether twist and wheel rates are all below 0.001 [m/s, rad/s]."""
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
    start = state.steps * config.step_s
    along = config.gravity * math.sin(body.slope)
    failed = integrate(
        state.numbers,
        np.ascontiguousarray(wheels),
        np.ascontiguousarray(cg),
        out,
        config.step_s,
        Plant(body.chassis(config), mass, inertia, along, np.array(body.yields), patches, config.motor_lag_s, ramp, body.waves),
    )
    if failed >= 0:
        raise SimulationError(
            f"the forces on the robot could not be balanced {start + failed * config.step_s:.2f} s into the drive (CG at x = "
            f"{cg[failed, 0]:.3f}, y = {cg[failed, 1]:.3f} m): one wheel may carry nearly all of it. "
            "Move the CG inwards, or take a larger vehicle.creep."
        )
    lifted = out[:, MARGIN] < 0.0
    for i in range(len(out)) if lifted.any() else ():
        state.on_two_wheels = state.on_two_wheels + 1 if lifted[i] else 0
        if state.on_two_wheels * config.step_s <= _MAX_LIFTED_S:
            continue
        raise SimulationError(
            f"the robot tips over {start + i * config.step_s:.2f} s into the drive: its CG, at x = {cg[i, 0]:.3f}, y = {cg[i, 1]:.3f}, "
            f"z = {body.cg_height:.2f} m, takes the load off both wheels of a side or an axle at a wheel speed of "
            f"{out[i, 6] * body.radius_left:.2f} and {out[i, 7] * body.radius_right:.2f} m/s. Drive more gently or lower the CG."
        )
    state.on_two_wheels = state.on_two_wheels if lifted[-1] else 0
    state.steps += len(wheels)
    return out


def accelerations(
    body: Body, config: VehicleConfig, wheels: FloatArray, twist: FloatArray, cg: FloatArray, tilt: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rate of change (3,) of ``twist`` (3,) at wheel rates ``wheels`` (2,), a resting CG (2,) and loads tilted by ``tilt`` (2,); and the
    tilt (2,) of quasi-static balance with the forces."""
    now = DynamicsInput(
        *(body.radius_left * wheels[0], body.radius_right * wheels[1], 1.0, 1.0, 1.0, 1.0, body.mass, body.inertia),
        *(cg[0], cg[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )
    found = derivatives(twist[0], twist[1], twist[2], tilt[0], tilt[1], now, body.chassis(config))
    return np.array([found.x, found.y, found.w]), np.array([found.xi, found.eta])


_DIFFERENCE_S = 1e-3
_MAX_JOINT_SPEED_RAD_S = 1.0
_GRIPPERS = ("left_gripper", "gripper", "tool0", "left_tool0")


class MassDistribution:
    """The robot's arms, or, on a robot without any, a ballast that is pushed about on its top.

    Joints move along minimum-jerk profiles (Flash & Hogan 1985): velocity and acceleration start and end at zero.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._empty: CgModel | None = None
        self.postures: Mapping[str, Posture] = {}
        start = robot.center_of_gravity - robot.geometry.cg_offset
        if robot.arms is not None:
            self._empty = arms_model(robot.arms, robot.folder)
            self.postures = arms_postures(robot.arms, robot.folder)
            chain = self._empty.chain
            zero = np.clip(np.zeros(len(chain.joint_names)), chain.lower, chain.upper)
            rows = [chain.posture(posture) for posture in self.postures.values()] or [zero]
            start = min(rows, key=lambda q: float(np.hypot(*self._empty_cg(q))))  # parked: the most central of the named postures
        self._model = self._empty
        self._from, self._to = start.astype(float), start.astype(float)
        self._start_s, self._duration_s = -1.0, 1e-3  # at rest
        self.payload_kg = 0.0
        self._rest: tuple[FloatArray, FloatArray] | None = None

    def _empty_cg(self, positions: FloatArray) -> FloatArray:
        """(2,) CG without payload."""
        return positions if self._empty is None else self._empty.cg(positions)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints of the arms; empty for a robot without."""
        return self._empty.chain.joint_names if self._empty is not None else ()

    def reach(self, cg: FloatArray) -> FloatArray:
        """Positions that put the nominal CG at ``cg`` (2,) [m]. Raises `CgError` where no posture does."""
        if self._empty is None:
            return np.asarray(cg, dtype=float)
        found = posture_for(self._empty, cg, self.postures)
        return np.array([found[name] for name in self.joint_names])

    def posture(self, name: str) -> FloatArray:
        """Positions of a named posture. Raises `SimulationError`."""
        if self._empty is None or name not in self.postures:
            known = ", ".join(self.postures) or "none"
            raise SimulationError(f"robot '{self._robot.name}' has no arm posture '{name}'; its postures: {known}.")
        return self._empty.chain.posture(self.postures[name])

    def time_to(self, target: FloatArray) -> float:
        """Seconds that a motion to ``target`` takes at the joints' speed, 1 at least; half a second per 5 cm for a ballast."""
        far = float(np.abs(target - self._to).max(initial=0.0))
        return max(1.0, 1.875 * far / _MAX_JOINT_SPEED_RAD_S if self._empty is not None else 10.0 * far)

    def move(self, target: FloatArray, start_s: float, duration_s: float) -> None:
        """Begin a motion to ``target``; the one before must have ended."""
        self._from, self._to = self._to, np.asarray(target, dtype=float)
        self._start_s, self._duration_s = start_s, max(duration_s, 1e-3)
        self._rest = None

    def pick_up(self, payload_kg: float) -> None:
        """Take a payload into the (left) gripper; without arms it is set down at the front edge, between the wheels. 0 puts it down."""
        self.payload_kg, self._rest = payload_kg, None
        if self._empty is None or self._robot.arms is None:
            return
        if payload_kg <= 0.0:
            self._model = self._empty
            return
        link = next((name for name in _GRIPPERS if name in self._empty.chain.links), None)
        if link is None:
            raise SimulationError(f"robot '{self._robot.name}' has no link {' or '.join(_GRIPPERS)} to hold a payload.")
        self._model = arms_model(self._robot.arms, self._robot.folder, Payload(link, payload_kg))

    def joints(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (n, k) of the joints at ``times_s`` (n,)."""
        u = np.clip((times_s - self._start_s) / self._duration_s, 0.0, 1.0)[:, None]
        far = self._to - self._from
        position = self._from + far * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        velocity = far * 30.0 * u**2 * (1.0 - u) ** 2 / self._duration_s
        return position, velocity

    def cg(self, times_s: FloatArray, step_s: float = 1e-3) -> FloatArray:
        """(n, 7) CG x, y and its velocity in the body frame, payload included, at ``times_s`` (n,); its mean acceleration (z too) over
        the ``step_s`` after each.

        The velocity is a difference over 2 ms of the chain's exact CG: right to a micrometre per second.
        """
        out = np.zeros((len(times_s), 7))
        if times_s[0] >= self._start_s + self._duration_s + 0.01:  # mostly they rest
            out[:, :2] = self._resting()[0]
            return out
        d = _DIFFERENCE_S

        def velocity(t: FloatArray) -> FloatArray:
            return np.asarray((self._at(t + d) - self._at(t - d)) / (2.0 * d))

        now = velocity(times_s)
        out[:, :2], out[:, 2:4] = self._at(times_s)[:, :2], now[:, :2]
        out[:, 4:7] = (velocity(times_s + step_s) - now) / step_s
        return out

    def nominal_cg(self, times_s: FloatArray) -> FloatArray:
        """(n, 2) CG by the robot file and the joints, without payload."""
        if times_s[0] >= self._start_s + self._duration_s:
            return np.broadcast_to(self._resting()[1], (len(times_s), 2))
        position, _ = self.joints(times_s)
        return self._empty_cg(position)

    def _resting(self) -> tuple[FloatArray, FloatArray]:
        """CG (2,) with and without payload once the arms have come to rest."""
        if self._rest is None:
            end = np.array([self._start_s + self._duration_s])
            self._rest = self._at(end)[0, :2], self._empty_cg(self._to)
        return self._rest

    def payload_distance(self, time_s: float) -> float:
        """How far the payload is from the CG of all [m]."""
        if self.payload_kg <= 0.0:
            return 0.0
        at = np.array([time_s])
        nominal, loaded = self.nominal_cg(at)[0], self._at(at)[0, :2]
        mass = self._robot.geometry.mass_kg
        # From the payload to the CG of all, and from there to the rest, as the masses: m p = (M + m) g - M n
        return float(np.hypot(*(loaded - nominal)) * mass / self.payload_kg)

    def _at(self, times_s: FloatArray) -> FloatArray:
        """(n, 3) CG with its payload."""
        position, _ = self.joints(times_s)
        if self._model is not None:
            return self._model.chain.center_of_mass(position)
        mass, load = self._robot.geometry.mass_kg, self.payload_kg
        edge = np.array([0.5 * self._robot.geometry.wheelbase_m, 0.0])
        planar = (mass * position + load * edge) / (mass + load)
        return np.column_stack([planar, np.zeros(len(planar))])


class TrueMotion:
    """Records of the vehicle at even steps, linear in between. Steps are milliseconds long: linear is exact to micrometres.

    ``first`` (COLUMNS,) is the record at the start, ``step_s`` the time between two [s].
    """

    def __init__(self, first: FloatArray, step_s: float) -> None:
        self.step_s = step_s
        self.first_step = 0
        self.rows = np.array(first, dtype=float).reshape(1, COLUMNS)

    @property
    def end_s(self) -> float:
        """Up to when the motion is known [s]."""
        return (self.first_step + len(self.rows) - 1) * self.step_s

    @property
    def start_s(self) -> float:
        """From when on the motion is known [s]."""
        return self.first_step * self.step_s

    def append(self, rows: FloatArray) -> None:
        """Add records (n, COLUMNS) of the next steps."""
        self.rows = np.concatenate([self.rows, rows])

    def drop_before(self, before_s: float) -> None:
        """Drop what lies before ``before_s``, but never the last record."""
        drop = min(int(before_s / self.step_s) - self.first_step, len(self.rows) - 1)
        if drop > 0:
            self.rows = self.rows[drop:]
            self.first_step += drop

    def at(self, times_s: FloatArray) -> FloatArray:
        """(n, 13) records at ``times_s`` (n,); held beyond both ends."""
        where = np.clip((times_s - self.start_s) / self.step_s, 0.0, len(self.rows) - 1.0)
        i = np.minimum(where.astype(np.int64), max(len(self.rows) - 2, 0))
        f = (where - i)[:, None]
        return np.asarray((1.0 - f) * self.rows[i] + f * self.rows[np.minimum(i + 1, len(self.rows) - 1)])


@subroutine
def pose_at(rows: FloatArray, start_s: float, step_s: float, t: float) -> tuple[float, float, float]:
    """`TrueMotion.at` of one moment, the pose only."""
    where = min(max((t - start_s) / step_s, 0.0), rows.shape[0] - 1.0)
    i = min(int(where), max(rows.shape[0] - 2, 0))
    j, f = min(i + 1, rows.shape[0] - 1), where - i
    return (
        (1.0 - f) * rows[i, 0] + f * rows[j, 0],
        (1.0 - f) * rows[i, 1] + f * rows[j, 1],
        (1.0 - f) * rows[i, 2] + f * rows[j, 2],
    )


class SampleClock:
    """Sample times k / rate, in integer nanoseconds since the start, each handed out once, when it is over.

    ``takes_s`` is how long a sample takes from its time on [s]: a sweep.
    """

    def __init__(self, rate_hz: float, takes_s: float = 0.0) -> None:
        self._rate, self._takes_s = rate_hz, takes_s
        self._next = 0

    def due(self, end_s: float) -> IntArray:
        """(n,) [ns] of the samples that were not yet handed out and end by ``end_s``."""
        last = int(np.floor((end_s - self._takes_s) * self._rate + 1e-6))
        ticks = np.arange(self._next, last + 1)
        self._next = max(self._next, last + 1)
        return np.round(ticks * (1e9 / self._rate)).astype(np.int64)


def seconds(ticks_ns: IntArray) -> FloatArray:
    """(n,) [s] of times in nanoseconds."""
    return np.asarray(ticks_ns * 1e-9, dtype=np.float64)
