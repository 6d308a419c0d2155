"""Short simulated drives for the tests of what runs online: a lap's part through rooms, turns and rests, all sensors."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

import numpy as np

from localization.estimators import Estimate
from localization.logs import open_log
from localization.online.core import Core, Pair
from localization.simulate.drives import MoveArms, OpenLoop, Rest, constant
from localization.simulate.experiments import Experiment
from localization.simulate.sensors import EncoderConfig
from localization.simulate.simulator import Simulation, SimulationConfig, write_simulation
from localization.simulate.suite import SensorConfig
from motion_models.registry import make_model
from motion_models.robot import load_robot

ROBOT = load_robot("vaultbot")
_FOLDER = tempfile.TemporaryDirectory(prefix="skidloc-tests-")


def _phases(robot, config):
    yield Rest(1.0)
    yield OpenLoop("ahead", constant(0.5, 0.1), 3.0)
    yield OpenLoop("turn", constant(0.0, 0.5), 2.0)
    yield MoveArms(np.array([0.02, 0.01]))
    yield OpenLoop("back", constant(-0.4, -0.3), 4.0)
    yield Rest(0.5)
    yield OpenLoop("arc", constant(0.5, 0.5), 6.0)


DRIVE = Experiment("short", "for tests", "hall", (0.0, 0.0, 0.0), _phases)


@functools.cache
def drive_log(lidar: str = "2d", seed: int = 0) -> Path:
    """An .mcap of about 20 s."""
    path = Path(_FOLDER.name) / f"drive_{lidar}_{seed}.mcap"
    config = SimulationConfig(sensors=SensorConfig(lidar=lidar, encoders=EncoderConfig()))
    write_simulation(path, Simulation(DRIVE, ROBOT, seed, {}, config))
    return path


@functools.cache
def drive_events():
    log = open_log(drive_log(), ROBOT)
    return list(log.events()), log.mounts


def new_core(estimator: str, model: str = "skid_steer", form: str = "constant") -> Core:
    _, mounts = drive_events()
    return Core(Pair(make_model(model, ROBOT), estimator, form), ROBOT, mounts, has_lidar=True)


def numbers(estimate: Estimate) -> tuple:
    """All of an estimate, to the last bit."""
    arrays = (estimate.pose, estimate.covariance, estimate.twist, estimate.twist_covariance)
    return estimate.stamp_ns, *(None if a is None else np.asarray(a).tobytes() for a in arrays), estimate.nis
