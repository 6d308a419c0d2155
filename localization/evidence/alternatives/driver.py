"""A driver's odometry: its sides, its units, and whether it turns or corrects for skidding."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

from localization.evidence.alternatives.alternative import Alternative, Row
from localization.evidence.signals import Source
from motion_models.prior import expected_scaling
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_ODDS = {
    "sign": math.log(5e-4),
    "side": math.log(2e-4),
    "unit": math.log(5e-4),
    "usual": 0.0,
    "multiplier": math.log(0.05),
    "k": math.log(0.03),
}
"""Prior odds by kind, as of wheels; where the robot file has the default multiplier, a driver that corrects for
skidding is as usual as one that does not (diff_drive_controller's wheel_separation_multiplier)."""
_K_SIGMA = 0.25
"""Sigma of the logarithm of k by geometry: that of seven robots whose k was measured (`motion_models.prior.EVIDENCE`), and of floors."""
UNITS = {
    "millimetres": 1e-3,
    "centimetres": 1e-2,
    "inches": 0.0254,
    "feet": 0.3048,
    "km/h": 1.0 / 3.6,
    "miles per hour": 0.44704,
}
"""Metres, or metres per second, per unit."""


def alternatives(source: Source, rates: FloatArray, second: FloatArray, robot: Robot) -> list[Alternative]:
    """Sides times units of the ``rates`` (n, 2) way and turn of a driver's odometry."""
    way, turned = rates[:, 0], rates[:, 1]
    multiplier = expected_scaling(robot) * robot.driver.wheel_separation_multiplier
    is_default = robot.driver.wheel_separation_multiplier == 1.0 and "k_0" not in robot.models.get("skid_steer", {})
    half = 0.5 * robot.driver.track_width_m
    at_driver = "Correct the encoder's or motor's sign in the driver."
    sides: list[tuple[FloatArray, FloatArray, float, tuple[Row, ...]]] = [
        (way, turned, 0.0, ()),
        (
            way,
            -turned,
            0.0,
            (Row("driver.sides_exchanged", "left and right are exchanged in the driver", _ODDS["sign"], remedy=at_driver),),
        ),
        (-way, -turned, 0.0, (Row("driver.reversed", "the driver counts backwards on both sides", _ODDS["sign"], remedy=at_driver),)),
        (-way, turned, 0.0, (Row("driver.backwards", "the driver's front is the robot's back", _ODDS["side"], remedy=at_driver),)),
    ]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        row = Row(f"driver.{side}_reversed", f"the {side} side counts backwards in the driver", _ODDS["side"], remedy=at_driver)
        sides.append((sign * half * turned, sign * way / half, 0.15, (row,)))
    found = []
    for v, w, sigma, rows in sides:
        found.append(Alternative(rows, v, multiplier * w, 0.0, 0.0, sigma, _K_SIGMA + sigma))
        for name, factor in UNITS.items():
            correct = partial(_set_unit, factor * robot.driver.length_unit_m)
            row = Row("driver.unit", f"the driver publishes {name}", _ODDS["unit"], name, factor, correct)
            found.append(Alternative((*rows, row), factor * v, multiplier * w, math.log(factor), 0.0, sigma, _K_SIGMA + sigma))
        if abs(math.log(multiplier)) > 0.05:
            corrected = Row(
                "driver.corrects_skidding",
                "the driver corrects for skidding",
                _ODDS["usual" if is_default else "multiplier"],
                value=float(f"{1.0 / expected_scaling(robot):.4g}"),
                correct=partial(_set_multiplier, float(f"{1.0 / expected_scaling(robot):.4g}")),
            )
            found.append(Alternative((*rows, corrected), v, w, -math.log(multiplier), 0.0, sigma, sigma))
    vary = Row("driver.turns_vary", "the robot turns by a changing part of what its wheels turn", _ODDS["k"], is_fault=False)
    found.append(Alternative((vary,), way, multiplier * turned, 0.0, 0.0, 0.0, 1.0, 8.0))
    return found


def _set_unit(value: float, robot: Robot) -> Robot:
    return replace(robot, driver=replace(robot.driver, length_unit_m=float(f"{value:.6g}")))


def _set_multiplier(value: float, robot: Robot) -> Robot:
    return replace(robot, driver=replace(robot.driver, wheel_separation_multiplier=value))
