"""Runs of a trajectory under a controller, of which only the vision error was measured (Ebersole 2016, sec. 5.2 and Table 5-2).

One line a run: trajectory, arm_configuration, controller and vision_error_m, the mean distance between the path that was driven and that
of the controller's odometry. Wheel rates follow from command and controller, the odometry's path from the controller's own model.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.diagnosis.drive import Drive, drive_of_table
from localization.simulation.experiments import CONFIGURATION_CGS, CONTROLLERS, TRAJECTORIES
from motion_models import se2
from motion_models.calibration.maneuvers import Maneuver, read_rows
from motion_models.errors import CalibrationError
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

COLUMNS = ("trajectory", "arm_configuration", "controller", "vision_error_m")
_STEP_S = 0.05
_SIGMA_M = 0.01  # of a vision error, before the runs' own scatter is estimated


@dataclass(frozen=True)
class Run:
    """One line of the table."""

    trajectory: str
    arm_configuration: str
    controller: str
    vision_error_m: float


def read_runs(path: Path) -> list[Run]:
    """The table's runs. Raises `CalibrationError`, naming line and column."""
    columns, rows = read_rows(path)
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        raise CalibrationError(f"table '{path}' has no column {', '.join(missing)}; it has {', '.join(columns)}.")
    allowed = dict(zip(COLUMNS, (TRAJECTORIES, CONFIGURATION_CGS, CONTROLLERS), strict=False))
    found = []
    for line, cells in rows:
        for column, names in allowed.items():
            if cells[column] not in names:
                raise CalibrationError(f"table '{path}', line {line}: no {column} '{cells[column]}'; there are {', '.join(names)}.")
        try:
            error = float(cells["vision_error_m"])
        except ValueError:
            error = math.nan
        if not (math.isfinite(error) and error >= 0.0):
            raise CalibrationError(
                f"table '{path}', line {line}: vision_error_m must be a distance in metres, found {cells['vision_error_m']!r}."
            )
        found.append(Run(cells["trajectory"], cells["arm_configuration"], cells["controller"], error))
    if not found:
        raise CalibrationError(f"table '{path}' has no rows below its header.")
    return found


def drive_of_runs(name: str, robot: Robot, runs: list[Run]) -> Drive:
    """Each run as a maneuver that ends with the odometry's path."""
    maneuvers, paths = [], []
    for run in runs:
        profile, duration = TRAJECTORIES[run.trajectory]
        middles = (np.arange(round(duration / _STEP_S), dtype=np.float64) + 0.5) * _STEP_S
        command = profile(middles)
        cg = np.array(CONFIGURATION_CGS[run.arm_configuration])
        controller = make_model(run.controller, robot)
        wheels = controller.wheels(command, np.broadcast_to(cg, command.shape), controller.nominal)
        path = path_of(controller.twist(wheels, cg, controller.nominal).value * _STEP_S)
        n = len(middles)
        cov = np.diag([_SIGMA_M**2, math.inf, math.inf])
        maneuvers.append(Maneuver(np.full(n, _STEP_S), wheels, path[-1:], np.array([n]), cg, cov, group=run.arm_configuration))
        paths.append(path)
    drive = drive_of_table(name, robot, maneuvers, "runs")
    errors = np.array([run.vision_error_m for run in runs])
    note = "x is the vision error; centres of gravity are those inferred for the seven configurations from `rotate` under diff_drive."
    return dataclasses.replace(drive, paths=tuple(paths), path_errors=errors, warnings=(note,))


def path_of(steps: FloatArray) -> FloatArray:
    """(n, 3) poses after each of the ``steps`` (n, 3), twists times their durations."""
    moves = se2.exp(steps)
    poses = np.empty_like(moves)
    pose = np.zeros(3)
    for i, move in enumerate(moves):
        pose = se2.compose(pose, move)
        poses[i] = pose
    return poses
