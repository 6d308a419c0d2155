"""A physical skid-steer robot with arms, sensors and a world, that writes real bags. It shares no code with the linear models."""

from localization.simulation.experiments import EXPERIMENTS, Experiment, ExperimentConfig
from localization.simulation.injected_faults import FAULTS, Fault
from localization.simulation.open_loop_scores import OpenLoopScore, score_open_loop_runs
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import RunRecord, Simulation, SimulationConfig, simulate, write_simulation
from localization.simulation.vehicle import VehicleConfig
from localization.simulation.world import WORLDS, World, world_svg

__all__ = [
    "EXPERIMENTS",
    "FAULTS",
    "WORLDS",
    "Experiment",
    "ExperimentConfig",
    "Fault",
    "OpenLoopScore",
    "RunRecord",
    "SensorConfig",
    "Simulation",
    "SimulationConfig",
    "VehicleConfig",
    "World",
    "score_open_loop_runs",
    "simulate",
    "world_svg",
    "write_simulation",
]
