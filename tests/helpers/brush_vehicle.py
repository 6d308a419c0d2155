"""A third vehicle for blind tests: four brush tyres under a rigid body, with their own force law, load transfer and integration.

World, drives and sensors are the simulator's. The force of a contact opposes its slip s by mu N f(K |s| / V), with V the faster of the
contact's and the wheel's speed, and f the brush model's parabola 1 - (1 - z / 3)^3 (Pacejka 2012, ch. 3) or tanh z.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Literal

import numpy as np

from localization.errors import SimulationError
from localization.simulation.experiments import Experiment
from localization.simulation.simulator import Simulation, SimulationConfig
from localization.simulation.vehicle import ANGLES, CG, COLUMNS, POSE, RATES, TWIST
from motion_models.compiled import kernel, subroutine
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_SUBSTEPS = 20
_MIN_SPEED_M_PER_S = 0.02
"""Below it the stiffness of a contact no longer grows, so that the robot stops."""
_REST_SPEED_M_PER_S = 2e-3
_LOAD_LAG = 0.05
"""Share of a change of acceleration that the loads take over in a substep."""
_GRAVITY = 9.81
_PHYSICAL = frozenset(
    {"wheel_radius_scale", "wheel_radius_difference", "track_width", "cg_offset_x", "cg_offset_y", "split_friction"}
    | {"rolling_resistance"}
)
_OF_SENSORS = frozenset({"lidar_offset_x", "lidar_offset_y", "lidar_yaw", "lidar_time_offset", "wheel_time_offset", "gyro_scale"})
EFFECTS = _PHYSICAL | _OF_SENSORS
"""Ids of the faults that can be hidden in it."""


@dataclasses.dataclass(frozen=True)
class BrushTyre:
    """Force of a contact by its slip."""

    law: Literal["brush", "tanh"] = "brush"
    stiffness: float = 8.0


class BrushSimulation(Simulation):
    """`Simulation` of a robot without arms on brush tyres."""

    tyre = BrushTyre()

    def __init__(
        self, experiment: Experiment, robot: Robot, seed: int, effects: Mapping[str, float], config: SimulationConfig | None = None
    ) -> None:
        unknown = sorted(set(effects) - EFFECTS)
        if unknown or robot.arms is not None:
            raise SimulationError(f"The vehicle on brush tyres has no {', '.join(unknown) or 'arms'}.")
        super().__init__(experiment, robot, seed, effects, config)
        self._twist, self._wheels, self._set_points, self._angles = np.zeros(3), np.zeros(2), np.zeros(2), np.zeros(2)
        self._pose = np.array(experiment.start, dtype=float)

    def _move(self, times: FloatArray, wheels: FloatArray) -> FloatArray:
        config, body = self.config.vehicle, self._body
        radii = np.array([body.radius_left, body.radius_right])
        ramp, keep = config.acceleration_m_s2 / float(radii.mean()) * config.step_s, math.exp(-config.step_s / config.motor_lag_s)
        cg = self._masses.cg(np.zeros(1))[0, :2] + np.array(body.cg_offset)
        half = np.array([0.5 * body.param("wheelbase"), 0.5 * body.param("track_width")])
        grip = body.param("mu") * (1.0 + 0.5 * body.grip_split * np.array([1.0, -1.0]))
        tyres = np.array([self.tyre.law == "tanh", self.tyre.stiffness, body.param("rolling_resistance")])
        masses = np.array([body.mass, body.inertia, body.cg_height])
        rows = np.zeros((len(wheels), COLUMNS))
        for row, target in zip(rows, wheels, strict=True):
            self._set_points += np.clip(target - self._set_points, -ramp, ramp)
            self._wheels = keep * self._wheels + (1.0 - keep) * self._set_points
            if not target.any() and np.abs(self._wheels * radii).max() < _REST_SPEED_M_PER_S:
                self._wheels = np.zeros(2)
            _step(self._twist, self._wheels * radii, half, cg, grip, tyres, masses, config.step_s)
            heading = self._pose[2] + 0.5 * config.step_s * self._twist[2]
            c, s = math.cos(heading), math.sin(heading)
            vx, vy, wz = self._twist
            self._pose = self._pose + config.step_s * np.array([c * vx - s * vy, s * vx + c * vy, wz])
            self._angles = self._angles + config.step_s * self._wheels
            row[POSE], row[TWIST], row[RATES], row[ANGLES] = self._pose, self._twist, self._wheels, self._angles
            row[CG], row[-1] = cg, 1.0
        self._state.numbers[:3] = rows[-1, POSE]
        self._state.steps += len(rows)
        return rows


@kernel
def _step(
    twist: FloatArray,
    rolling: FloatArray,
    half: FloatArray,
    cg: FloatArray,
    grip: FloatArray,
    tyres: FloatArray,
    masses: FloatArray,
    dt: float,
) -> None:
    """Move ``twist`` (3,) of the wheelbase's middle on by ``dt``; ``tyres`` are law, stiffness and rolling resistance."""
    mass, inertia, height = masses
    forward = across = 0.0
    h = dt / _SUBSTEPS
    for _ in range(_SUBSTEPS):
        force_x = force_y = moment = 0.0
        for i in range(4):
            x, y = half[0] * (1.0 - 2.0 * (i // 2)), half[1] * (1.0 - 2.0 * (i % 2))
            lever_x, lever_y = x / half[0] ** 2, y / half[1] ** 2
            share = 1.0 + lever_x * cg[0] + lever_y * cg[1] - height / _GRAVITY * (lever_x * forward + lever_y * across)
            load = max(0.25 * mass * _GRAVITY * share, 0.0)
            f_x, f_y = _contact(twist[0] - twist[2] * y, twist[1] + twist[2] * x, rolling[i % 2], load * grip[i % 2], tyres)
            f_x -= tyres[2] * load * math.tanh((twist[0] - twist[2] * y) / 0.02)
            force_x, force_y = force_x + f_x, force_y + f_y
            moment += (x - cg[0]) * f_y - (y - cg[1]) * f_x
        alpha, w = moment / inertia, twist[2]
        forward += _LOAD_LAG * (force_x / mass - forward)
        across += _LOAD_LAG * (force_y / mass - across)
        a_x = force_x / mass + alpha * cg[1] + w * w * cg[0] + w * twist[1]
        a_y = force_y / mass - alpha * cg[0] + w * w * cg[1] - w * twist[0]
        twist[0], twist[1], twist[2] = twist[0] + h * a_x, twist[1] + h * a_y, w + h * alpha
    if rolling[0] == 0.0 and rolling[1] == 0.0:
        twist *= 0.9 if np.abs(twist).max() > _REST_SPEED_M_PER_S else 0.0


@subroutine
def _contact(u_x: float, u_y: float, rolling: float, most: float, tyres: FloatArray) -> tuple[float, float]:
    """Force of a contact that moves by ``u_x``, ``u_y`` over the floor; at ``most`` its load times its grip."""
    s_x = u_x - rolling
    slip = math.sqrt(s_x * s_x + u_y * u_y)
    if slip < 1e-12:
        return 0.0, 0.0
    z = tyres[1] * slip / max(abs(u_x), abs(rolling), _MIN_SPEED_M_PER_S)
    share = math.tanh(z) if tyres[0] > 0.0 else 1.0 - max(1.0 - z / 3.0, 0.0) ** 3
    return -most * share * s_x / slip, -most * share * u_y / slip
