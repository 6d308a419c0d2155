"""Whether a drive was on a slope: by an accelerometer that turns against it, else by how the robot slides downhill."""

from __future__ import annotations

import math

import numpy as np

from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.causes.floor import SLOPE_ACROSS, SLOPE_ALONG
from localization.diagnosis.drive_predictor import DrivePredictor
from motion_models.robot import DIFF_DRIVE
from motion_models.se2 import FloatArray

_POSITION, _FORCE = [0, 1], [4, 5]
"""Channels of the discrepancies."""
_LEAST_RAD, _LEAST_SIGMAS = math.radians(3.0), 5.0
"""Slope from which a floor is not level (a Husky outdoors is level within 1.8 deg), and how certain it must be."""


def find_floor_slope(predictor: DrivePredictor) -> FloatArray | None:
    """(2,) rise of the floor along the axes of the drive's first heading [rad], by least squares; None on a level floor.

    A slope turns against the robot while whatever else moves it turns along. Of drives that are no log, that have no positions, or whose
    wheels do not skid, it is not known.
    """
    drive = predictor.drive
    if drive.kind != "log" or not drive.has_positions or drive.robot.drive == DIFF_DRIVE:
        return None
    channels = _POSITION if drive.forces is None else _FORCE
    rows = predictor.discrepancies(Hypothesis())
    signatures = np.stack([predictor.signature(Hypothesis(), cause, rows) for cause in (SLOPE_ALONG, SLOPE_ACROSS)], axis=-1)
    levels = np.zeros((*rows.shape, 2))
    levels[:, _FORCE[0], 0] = levels[:, _FORCE[1], 1] = 1.0
    design = np.concatenate([signatures, levels], axis=-1)[:, channels].reshape(-1, 4)[:, : 2 if drive.forces is None else 4]
    y = rows[:, channels].ravel()
    known = np.isfinite(y) & np.isfinite(design).all(axis=1)
    if known.sum() <= design.shape[1]:
        return None
    y, design = y[known], design[known]
    gram = design.T @ design + 1e-12 * np.eye(design.shape[1])
    found = np.linalg.solve(gram, design.T @ y)
    variance = float(np.sum((y - design @ found) ** 2)) / (len(y) - design.shape[1])
    slope, cov = found[:2], variance * np.linalg.inv(gram)[:2, :2]
    is_steep = math.hypot(*slope) > _LEAST_RAD and float(slope @ np.linalg.solve(cov, slope)) > _LEAST_SIGMAS**2
    return slope if is_steep else None
