"""Rotations in place as maneuvers, so that any model can be fitted to a table of them (Ebersole 2016, Tables 4-1 to 4-3)."""

from __future__ import annotations

import math

import numpy as np

from motion_models.calibration.maneuvers import Maneuver
from motion_models.calibration.regressions import RotationTable
from motion_models.robot import Robot

COMMANDED_RAD_PER_S = 0.3
SECONDS = 5.0
_SIGMA = (0.01, 0.01, 0.02)  # m, m, rad; scatter of the table's rows about a smooth surface, at the end of a rotation


def rotations_as_maneuvers(
    table: RotationTable, robot: Robot, rate: float = COMMANDED_RAD_PER_S, seconds: float = SECONDS
) -> list[Maneuver]:
    """Rotations that were commanded at ``rate`` for ``seconds`` through the robot's own driver, one maneuver a row.

    The wheel rates are those that the driver makes of the command; the pose follows from the measured turn about the measured centre.
    Rows of one x_G are one group.
    """
    driver = robot.driver
    half = driver.wheel_separation_multiplier * driver.track_width_m * rate / (2.0 * driver.wheel_radius_m)
    found = []
    for cg, ratio, cor in zip(table.cg, table.ratio, table.cor, strict=True):
        turned = ratio * rate * seconds
        c, s = math.cos(turned), math.sin(turned)
        x = cor[0] - (c * cor[0] - s * cor[1])
        y = cor[1] - (s * cor[0] + c * cor[1])
        found.append(
            Maneuver(
                dt=np.array([seconds]),
                wheels=np.array([[-half, half]]),
                measured=np.array([[x, y, turned]]),
                ends=np.array([1]),
                cg=cg,
                cov=np.diag(np.square(_SIGMA)),
                group=f"x_G = {cg[0]:g} m",
            )
        )
    return found
