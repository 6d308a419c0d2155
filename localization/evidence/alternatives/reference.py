"""Reference poses: mirrored or exchanged axes, the yaw of the tracked body, units, inverse poses, the place of the antenna or prism."""

from __future__ import annotations

import itertools
import math

import numpy as np

from localization.evidence.alternatives.alternative import Alternative, Row
from localization.evidence.alternatives.lidar import in_body, sector, yaws
from localization.evidence.alternatives.places import PlacePrior, usual_place
from localization.evidence.signals import Source
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_ODDS = {"mirror": math.log(1e-3), "yaw": math.log(2e-3), "unit": math.log(1e-3), "inverse": math.log(3e-4), "place": math.log(3e-3)}
"""Prior odds by kind (`docs/theory/set-up.md`)."""
_PLACE_SIGMA_M, _OTHER_PLACE = 0.12, PlacePrior(0.6)
"""Standard deviation along the robot of the middle of tracked markers with the centre of rotation [m]; and an antenna or a prism."""
UNITS = {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048, "inch": 0.0254, "km": 1e3}
"""Metres per unit."""


def alternatives(source: Source, rates: FloatArray, second: FloatArray, robot: Robot) -> list[Alternative]:
    """Mirrors times yaws times units of the ``rates`` (n, 3) ahead, to the left and turn in the axes of the tracked body."""
    found, places = [], (usual_place(_PLACE_SIGMA_M, robot, source.moves_cg), _OTHER_PLACE)
    for is_mirrored, (unit, factor) in itertools.product((False, True), (("", 1.0), *UNITS.items())):
        velocity, turn = factor * (rates[:, 0] + 1j * rates[:, 1]), rates[:, 2]
        rows: tuple[Row, ...] = ()
        if is_mirrored:
            velocity, turn = velocity.conj(), -turn
            text = "the reference is mirrored (an axis with the opposite sign, or x and y exchanged)"
            rows = (Row("reference.mirrored", text, _ODDS["mirror"]),)
        if unit:
            rows = (*rows, Row("reference.unit", f"the reference is in {unit}", _ODDS["unit"], unit, factor))
        found += _of_motion(rows, velocity, turn, factor, places)
    if np.isfinite(second).any():
        inverse = Row("reference.inverse", "the reference's poses are those of the world by the robot", _ODDS["inverse"])
        found += _of_motion((inverse,), second[:, 0] + 1j * second[:, 1], second[:, 2], 1.0, places)
    return found


def _of_motion(
    rows: tuple[Row, ...], velocity: FloatArray, turn: FloatArray, unit: float, places: tuple[PlacePrior, PlacePrior]
) -> list[Alternative]:
    """Yaws of the tracked body, at the robot's middle or elsewhere, times ``rows``."""
    found = []
    for yaw, odds in yaws(velocity, turn, 0.0, places):
        of_yaw = f"its headings are turned by {math.degrees(yaw):.0f} deg"
        turned = (Row("reference.yaw", of_yaw, _ODDS["yaw"], sector(yaw), yaw),) if odds else ()
        way, side = in_body(velocity, turn, 0.0, yaw, places[0])
        found.append(Alternative((*rows, *turned), way, turn, (unit, 1.0), side.evidence, own_by_bin=side.by_bin))
        way, side = in_body(velocity, turn, 0.0, yaw, places[1])
        text = f"the tracked point is {abs(side.ahead_m):.2f} m {'ahead of' if side.ahead_m > 0.0 else 'behind'} the middle of the wheels"
        place = Row("reference.place", text, _ODDS["place"], value=side.ahead_m)
        found.append(Alternative((*rows, *turned, place), way, turn, (unit, 1.0), side.evidence, own_by_bin=side.by_bin))
    return found
