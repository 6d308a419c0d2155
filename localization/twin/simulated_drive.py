"""A drive of `skidloc simulate` in the user's own MuJoCo file: its world, experiments and sensors, moved by that file's physics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from localization.errors import SimulationError
from localization.simulation.experiments import Experiment, find_experiment
from localization.simulation.simulator import Simulation, SimulationConfig
from localization.simulation.vehicle import ANGLES, CG, COLUMNS, POSE, RATES, TWIST, Body
from localization.twin.mujoco_engine import MujocoDrive
from localization.twin.mujoco_simulator import MujocoSimulator
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_CONTROL_S = 0.02
"""Period of the simulation's controllers."""


class MujocoSimulation(Simulation):
    """`Simulation` of a robot that MuJoCo moves by the file of ``simulator``, its servos and contacts."""

    def __init__(
        self,
        experiment: Experiment,
        robot: Robot,
        seed: int,
        simulator: MujocoSimulator,
        effects: Mapping[str, float] | None = None,
        config: SimulationConfig | None = None,
    ) -> None:
        super().__init__(experiment, robot, seed, effects or {}, config)
        name = simulator.file.path.name
        if experiment.has_hills or self.world.patches.size:
            raise SimulationError(f"experiment {experiment.name} needs a ground that '{name}' does not have. Use --engine skidloc.")
        self._check_body(name, effects or {})
        self._drive_in_mujoco = MujocoDrive(simulator.engine, np.array(experiment.start), self.reality.body.slope)
        self._substeps = round(self.config.vehicle.step_s / simulator.numbers.time_step_s)
        self._set_points, self._commands = np.zeros(2), np.zeros(2)
        self._heading = float(experiment.start[2])

    def _check_body(self, name: str, effects: Mapping[str, float]) -> None:
        """Raise `SimulationError` where ``effects`` change the robot's body, which is that of the file ``name``."""
        if not _same_but_slope(self.reality.body, Body.from_robot(self.robot)) or self.reality.payload_kg > 0.0:
            raise SimulationError(
                f"the robot is that of '{name}': leave out effects of its body ({', '.join(effects)}), or change that file."
            )

    def _move(self, times: FloatArray, wheels: FloatArray) -> FloatArray:
        config, rows = self.config.vehicle, np.empty((len(wheels), COLUMNS))
        drive = self._drive_in_mujoco
        cgs = self._masses.cg(times, config.step_s)[:, :2]
        ramp = config.acceleration_m_s2 / drive.radius_m * config.step_s
        keep = math.exp(-config.step_s / config.motor_lag_s)
        for row, target, cg in zip(rows, wheels, cgs, strict=True):
            self._set_points += np.clip(target - self._set_points, -ramp, ramp)
            self._commands = keep * self._commands + (1.0 - keep) * self._set_points
            drive.advance(self._commands, self._substeps, cg)
            pose = drive.pose()
            self._heading += math.remainder(pose[2] - self._heading, math.tau)
            row[POSE] = (*pose[:2], self._heading)
            row[TWIST] = drive.twist()
            row[RATES], row[ANGLES] = drive.wheel_rates(), drive.wheel_angles()
            row[CG], row[-1] = cg, 1.0
        self._state.numbers[:3] = rows[-1, POSE]
        self._state.steps += len(rows)
        return rows


def _same_but_slope(body: Body, described: Body) -> bool:
    names = set(body.__dataclass_fields__) - {"slope", "waves"}
    return all(np.array_equal(getattr(body, name), getattr(described, name)) for name in names)


def simulate_in_mujoco(
    experiment: str,
    robot: Robot,
    simulator: MujocoSimulator,
    seed: int = 0,
    effects: Mapping[str, float] | None = None,
    config: SimulationConfig | None = None,
) -> MujocoSimulation:
    """An experiment by name in the user's file, ready to be driven; records are whole time steps of that file. Raises `SimulationError`."""
    config, time_step = config or SimulationConfig(), simulator.numbers.time_step_s
    steps = round(_CONTROL_S / time_step)
    per_record = [n for n in range(1, steps + 1) if steps % n == 0 and n * time_step <= max(config.vehicle.step_s, time_step) + 1e-9]
    if abs(steps * time_step - _CONTROL_S) > 1e-9 or not per_record:
        raise SimulationError(
            f"'{simulator.file.path.name}' has time steps of {time_step:g} s, which do not divide the control period, {_CONTROL_S} s:"
            " change its timestep, to 0.002 for example."
        )
    config = replace(config, vehicle=replace(config.vehicle, step_s=per_record[-1] * time_step))
    return MujocoSimulation(find_experiment(experiment), robot, seed, simulator, effects, config)
