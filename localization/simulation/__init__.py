"""A physical skid-steer robot with arms, sensors and a world, that writes real bags. It knows nothing of the models under test."""

from localization.simulation.experiments import EXPERIMENTS, Experiment, ExperimentConfig
from localization.simulation.faults import EFFECTS, Effect
from localization.simulation.open_loop_scores import Score, score_runs
from localization.simulation.run_records import RunRecord
from localization.simulation.sensor_suite import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, simulate, write_simulation
from localization.simulation.vehicle import VehicleConfig
from localization.simulation.world import WORLDS, World
from localization.simulation.world_svg import world_svg

__all__ = [
    "EFFECTS",
    "EXPERIMENTS",
    "WORLDS",
    "Effect",
    "Experiment",
    "ExperimentConfig",
    "RunRecord",
    "Score",
    "SensorConfig",
    "Simulation",
    "SimulationConfig",
    "VehicleConfig",
    "World",
    "score_runs",
    "simulate",
    "world_svg",
    "write_simulation",
]
