"""Windows of motion for tests of the diagnosis: as a robot with hidden terms or changes drives them, and a reference measures them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from localization.diagnosis.drive import Drive, drive_of_table
from motion_models import se2
from motion_models.calibration.maneuvers import Maneuver, make_batch
from motion_models.calibration.prediction import predict
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import Robot, WheelNoise
from motion_models.se2 import FloatArray

SIGMA = np.array([0.003, 0.003, 0.002])
"""Scan matching's, of one window [m, m, rad]."""
_INTERVALS, _DT = 20, 0.1


def windows(robots: Sequence[Robot], model: str, seed: int) -> list[Maneuver]:
    """Windows of two seconds, of steady and changing rates, each as one of ``robots`` drives it and a reference measures it."""
    rng = np.random.default_rng(seed)
    found = []
    models = {id(robot): make_model(model, robot) for robot in robots}
    for i, robot in enumerate(robots):
        made = models[id(robot)]
        rates = rng.uniform(-5.0, 5.0, 2) + np.linspace(-1.0, 1.0, _INTERVALS)[:, None] * rng.uniform(-2.0, 2.0, 2)
        dt = np.full(_INTERVALS, _DT)
        true = preintegrate(made, dt, rates, robot.center_of_gravity, made.nominal, WheelNoise()).delta
        measured = se2.compose(true, se2.exp(SIGMA * rng.normal(size=3)))[None]
        cov, start_s = np.diag(SIGMA**2), i * _INTERVALS * _DT
        found.append(Maneuver(dt, rates, measured, np.array([_INTERVALS]), robot.center_of_gravity, cov, str(i), start_s=start_s))
    return found


def drive_of_windows(robot: Robot, drive: list[Maneuver]) -> Drive:
    """The windows one after the other as a log of ``robot``, the diagnosed one."""
    return dataclasses.replace(drive_of_table("windows", robot, drive, "windows"), kind="log")


def errors(robot: Robot, model: str, drive: list[Maneuver]) -> FloatArray:
    """(M,) length of the error of each window over its noise, by the robot's own file."""
    batch, made = make_batch(drive), make_model(model, robot)
    poses, _, _ = predict(made, batch, made.nominal, np.zeros(5), np.empty(0, dtype=np.int64), WheelNoise())
    return np.asarray(np.linalg.norm(se2.between(poses, batch.measured) / SIGMA, axis=1))
