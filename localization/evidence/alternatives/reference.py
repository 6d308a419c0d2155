"""Reference poses: mirrored or exchanged axes, the yaw of the tracked body, units, inverse poses, the place of the antenna or prism."""

from __future__ import annotations

import math

import numpy as np

from localization.evidence.alternatives.alternative import Alternative, Row, side_evidence
from localization.evidence.alternatives.lidar import _sector, _small_yaw, _yaws
from localization.evidence.signals import Source
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_ODDS = {"mirror": math.log(1e-3), "yaw": math.log(2e-3), "unit": math.log(1e-3), "heading": math.log(5e-4)}
"""Prior odds by kind (`docs/theory/set-up.md`)."""
_PLACE_SIGMA_M = 0.5
"""Standard deviation of the place of an antenna, prism or marker along the robot."""
UNITS = {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048, "inch": 0.0254, "km": 1e3}
"""Metres per unit."""


def alternatives(source: Source, rates: FloatArray, second: FloatArray, robot: Robot) -> list[Alternative]:
    """Mirrors times yaws times units of the ``rates`` (n, 3) ahead, to the left and turn in the axes of the tracked body."""
    found = []
    for is_mirrored in (False, True):
        velocity, turn = rates[:, 0] + 1j * rates[:, 1], rates[:, 2]
        rows: tuple[Row, ...] = ()
        if is_mirrored:
            velocity, turn = velocity.conj(), -turn
            rows = (
                Row(
                    "reference.mirrored",
                    "the reference is mirrored (an axis with the opposite sign, or x and y exchanged)",
                    _ODDS["mirror"],
                ),
            )
        for name, factor in (("", 1.0), *UNITS.items()):
            unit = (Row("reference.unit", f"the reference is in {name}", _ODDS["unit"], name, factor),) if name else ()
            for yaw, odds in _yaws(factor * velocity, turn, 0.0):
                own_yaw = yaw if odds else _small_yaw(factor * velocity, turn, 0.0)
                body = factor * velocity * np.exp(1j * own_yaw)
                evidence, _ = side_evidence(body.imag, body.real, turn, _PLACE_SIGMA_M)
                turned = (
                    (Row("reference.yaw", f"its headings are turned by {math.degrees(yaw):.0f} deg", _ODDS["yaw"], _sector(yaw), yaw),)
                    if odds
                    else ()
                )
                found.append(Alternative((*rows, *unit, *turned), body.real, turn, 2.0 * math.log(factor), evidence))
    return found
