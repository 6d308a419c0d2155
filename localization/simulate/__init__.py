"""A physical skid-steer robot with arms, sensors and a world, that writes real bags. It knows nothing of the models under test."""

from localization.simulate.effects import EFFECTS, Effect
from localization.simulate.evaluation import Score, score_runs
from localization.simulate.experiments import EXPERIMENTS, Experiment, ExperimentConfig
from localization.simulate.picture import world_svg
from localization.simulate.runs import RunRecord
from localization.simulate.simulator import Simulation, SimulationConfig, simulate, write_simulation
from localization.simulate.suite import SensorConfig
from localization.simulate.vehicle import VehicleConfig
from localization.simulate.world import WORLDS, World

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
