"""Short drives for blind diagnoses: the simulator hides causes in a bag, and nothing else of it reaches the diagnosis."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import drive_of_log
from localization.diagnosis.result import DiagnosisResult
from localization.logs import open_log
from localization.simulation.experiments import EXPERIMENTS, Experiment, ExperimentConfig, MoveArms, OpenLoop, Phase, Rest, constant, sine
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import ImuConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.friction import FrictionModel
from motion_models.registry import make_model
from motion_models.robot import Driver, Geometry, Robot
from motion_models.robot_file import load_robot

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
    "lateral_force_law": 1.0,
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
    "gyro_scale": 0.05,
    "gyro_time_offset": 0.05,
    "range_scale": 0.02,
    "wheel_radius_drift": 0.03,
    "split_friction": 0.3,
}
"""Sizes that robots really have. A bias of all ranges hardly shows in a hall."""
ONE_SIDED = ("payload", "encoder_dropout", "scrub", "rolling_resistance", "lateral_force_law")

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


def _first_seconds(seconds: float) -> Callable[[Robot, ExperimentConfig], Iterator[Phase]]:
    """As much of the tour as begins in time; its parts in an order in which each is met early."""

    def phases(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
        yield Rest(1.0)
        driven = 0.0
        for name, profile, duration in (
            ("arc", constant(0.5, 0.35), 4.0),
            ("turn", constant(0.0, -0.4), 4.0),
            ("back", constant(-0.5, -0.1), 4.0),
            ("curves", sine(0.45, 0.5, 4.0), 4.0),
            ("turn_back", constant(0.0, 0.4), 5.0),
            ("ahead", constant(0.5, 0.0), 4.0),
            ("arc_back", constant(-0.5, 0.3), 4.0),
        ):
            if driven < seconds:
                yield OpenLoop(name, profile, duration)
                driven += duration + 1.0

    return phases


def _random(seed: int) -> Callable[[Robot, ExperimentConfig], Iterator[Phase]]:
    """Arcs of any kind there and back, so that the hall is wide enough; arms somewhere else for every third."""

    def phases(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
        rng = np.random.default_rng(seed)
        yield Rest(2.0)
        for i in range(8):
            if robot.arms is not None and i % 3 == 1:
                yield MoveArms(rng.uniform([-0.04, -0.025], [0.08, 0.025]))
            v = float(rng.uniform(0.2, 0.7)) * float(rng.integers(0, 4) > 0)
            w = float(rng.uniform(-0.6, 0.6)) * float(rng.integers(0, 4) > 0 or v == 0.0)
            duration = float(rng.uniform(2.5, 4.5))
            yield OpenLoop(f"there_{i}", constant(v, w), duration)
            yield OpenLoop(f"back_{i}", constant(-v, -w), duration)

    return phases


def _spin(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(2.0)
    for i in range(4):
        yield OpenLoop(f"turn_{i}", constant(0.0, 0.4), 5.0)
        yield OpenLoop(f"turn_back_{i}", constant(0.0, -0.4), 5.0)


def drive(name: str) -> Experiment:
    """The tour, "20s" or "40s" of it, "spin" (turns in place alone), "random_SEED", or one of the simulator's experiments with one lap."""
    start = (-4.0, 0.0, 0.0)
    if name == "tour":
        return TOUR
    if name == "spin":
        return Experiment(name, "turns in place", "hall", start, _spin)
    if name.startswith("random_"):
        return Experiment(name, "arcs of any kind", "hall", (-1.0, 0.0, 0.0), _random(int(name.removeprefix("random_"))))
    if name.endswith("s") and name[:-1].isdigit():
        return Experiment(name, "a part of the tour", "hall", start, _first_seconds(float(name[:-1])))
    return EXPERIMENTS[name]


def robot_named(name: str) -> Robot:
    """A shipped robot, or a small one (the published sizes of Clearpath's Jackal).

    ``_thesis`` at the end: by the thesis's contact law, at the stiffness that the robot has without it.
    """
    if name.endswith("_thesis"):
        plain = robot_named(name.removesuffix("_thesis"))
        stiffness = float(FrictionModel.from_robot(plain).nominal[FrictionModel.param_names.index("slip_stiffness")])
        models = {**plain.models, "friction": {**plain.models.get("friction", {}), "slip_stiffness": stiffness}}
        return dataclasses.replace(plain, models=models, options={"friction": {"contact": "thesis"}})
    if name != "jackal":
        return load_robot(name)
    geometry = Geometry(wheel_radius_m=0.098, track_width_m=0.37559, wheelbase_m=0.262, mass_kg=17.0, cg_x_m=0.012, cg_y_m=0.002)
    return Robot("jackal", geometry, Driver(geometry.wheel_radius_m, geometry.track_width_m, 1.5))


def bag(
    path: Path,
    effects: Mapping[str, float],
    seed: int,
    robot: str = "vaultbot",
    experiment: Experiment = TOUR,
    lidar: Literal["2d", "none"] = "2d",
    imu_hz: float = 50.0,
) -> Path:
    """A bag in which ``effects`` (size by id) are hidden; half of the typical beams save half of the time."""
    sensors = SensorConfig(lidar=lidar, scanner=ScannerConfig(beams=191), imu=ImuConfig(rate_hz=imu_hz))
    config = SimulationConfig(experiment=ExperimentConfig(laps=1, payload_kg=0.0), sensors=sensors)
    simulation = Simulation(experiment, robot_named(robot), seed, effects, config)
    write_simulation(path, simulation)
    return path


def diagnose_bag(path: Path, robot: str = "vaultbot", model: str = "friction") -> DiagnosisResult:
    """What the diagnosis says of a bag, by the nominal robot's file."""
    nominal = robot_named(robot)
    return examine(drive_of_log(open_log(path, nominal)), make_model(model, nominal))
