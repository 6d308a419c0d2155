"""Short drives for blind diagnoses: the simulator hides causes in a bag, and nothing else of it reaches the diagnosis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from localization.diagnosis.diagnose import Examined, examine
from localization.diagnosis.drive import drive_of_log
from localization.logs import open_log
from localization.simulate.drives import MoveArms, OpenLoop, Phase, Rest, constant, sine
from localization.simulate.experiments import Experiment, ExperimentConfig
from localization.simulate.scanners import ScannerConfig
from localization.simulate.sensors import ImuConfig
from localization.simulate.simulator import Simulation, SimulationConfig, write_simulation
from localization.simulate.suite import SensorConfig
from motion_models.registry import make_model
from motion_models.robot import Robot, load_robot

TYPICAL: Mapping[str, float] = {
    "wheel_radius_scale": 0.02,
    "wheel_radius_difference": 0.02,
    "track_width": 0.03,
    "payload": 10.0,
    "cg_offset_x": 0.03,
    "cg_offset_y": 0.02,
    "lidar_offset_x": 0.05,
    "lidar_offset_y": 0.05,
    "lidar_yaw": 0.03,
    "lidar_time_offset": 0.05,
    "wheel_time_offset": 0.05,
    "friction_anisotropy": 0.2,
    "friction_change": 0.3,
    "diagonal_load": 0.15,
    "tread_asymmetry": 0.15,
    "rolling_resistance": 0.03,
    "scrub": 0.02,
    "slope": 0.05,
    "encoder_dropout": 0.1,
    "gyro_bias": 0.02,
    "lateral_slip_speed": 0.1,
    "rotation_slip_speed": 0.1,
    "longitudinal_slip_turning": 0.1,
}
"""Sizes that robots really have."""

_CGS = ((0.06, -0.01), (-0.02, 0.02))


def _tour(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    """Straight on, arcs and turns to both sides, backwards: with each of two postures, if the robot has arms."""
    yield Rest(2.0)
    for i, cg in enumerate(_CGS):
        if robot.arms is not None:
            yield MoveArms(np.array(cg))
        sign = 1.0 if i % 2 == 0 else -1.0
        yield OpenLoop(f"ahead_{i}", constant(0.5, 0.0), 3.0)
        yield OpenLoop(f"arc_{i}", constant(0.5, 0.35 * sign), 4.0)
        yield OpenLoop(f"turn_{i}", constant(0.0, 0.4 * sign), 5.0)
        yield OpenLoop(f"curves_{i}", sine(0.45, 0.5, 4.0), 4.0)
        yield OpenLoop(f"turn_back_{i}", constant(0.0, -0.4 * sign), 5.0)
        yield OpenLoop(f"back_{i}", constant(-0.5, -0.1 * sign), 4.0)


TOUR = Experiment("tour", "all kinds of motion in a hall", "hall", (-4.0, 0.0, 0.0), _tour)


def bag(
    path: Path,
    effects: Mapping[str, float],
    seed: int,
    robot: str = "vaultbot",
    experiment: Experiment = TOUR,
    lidar: Literal["2d", "none"] = "2d",
    imu_hz: float = 50.0,
) -> Path:
    """A bag in which ``effects`` (size by id) are hidden; half of the usual beams save half of the time."""
    sensors = SensorConfig(lidar=lidar, scanner=ScannerConfig(beams=191), imu=ImuConfig(rate_hz=imu_hz))
    simulation = Simulation(experiment, load_robot(robot), seed, effects, SimulationConfig(sensors=sensors))
    write_simulation(path, simulation)
    return path


def look(path: Path, robot: str = "vaultbot", model: str = "friction") -> Examined:
    """What the diagnosis says of a bag, by the nominal robot's file."""
    nominal = load_robot(robot)
    return examine(drive_of_log(open_log(path, nominal)), make_model(model, nominal))
