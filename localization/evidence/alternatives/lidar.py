"""A LiDAR: the yaw of its mount, upside down, its place and the unit of its ranges. A robot does not drive sideways."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localization.evidence.alternatives.alternative import Alternative, Row, correction, mount_correction
from localization.evidence.alternatives.places import PlacePrior, SideEvidence, side_evidence, usual_place
from localization.evidence.sensor_errors import LIDAR_OFFSET_X, LIDAR_YAW, up_to_pi, with_range_scale
from localization.evidence.signals import Source
from motion_models.robot import Mount, Robot
from motion_models.se2 import FloatArray

_ODDS = {"quarter": math.log(2e-3), "yaw": math.log(3e-4), "flip": math.log(1e-3), "unit": math.log(1e-4), "place": math.log(1e-3)}
"""Prior odds by kind (`docs/theory/set-up.md`)."""
UNITS = {"mm": 1e-3, "cm": 1e-2, "ft": 0.3048}
"""Metres per unit."""
_QUARTER_RAD, _YAW_SIGMA_RAD = math.radians(4.0), math.radians(3.0)
"""LiDARs are mounted by quarter turns: an estimate that is so near to one is that; and the standard deviation of a mount's yaw with a
slide."""
_PLACE_SIGMA_M, _WRONG_PLACE = 0.07, PlacePrior(0.6)
"""Standard deviation along the robot of a mount with the centre of rotation (robots without a load turn within 5 cm of the middle of their
wheels), and the place of a mount that is wrong."""
Velocity = NDArray[Any]
"""Complex: ahead + i to the left [m/s]."""
_GRID = np.radians(np.arange(-180.0, 180.0, 3.0))


def alternatives(source: Source, rates: FloatArray, second: FloatArray, robot: Robot) -> list[Alternative]:
    """Yaws times upside down times units of the ``rates`` (n, 3) ahead, to the left and turn at the sensor, in the axes of its mount."""
    mount, found = source.mount, list[Alternative]()
    usual = usual_place(_PLACE_SIGMA_M, robot, source.moves_cg)
    places = [(_WRONG_PLACE, False)] if source.is_second else [(usual, False), (_WRONG_PLACE, True)]
    for is_flipped, (unit, factor) in itertools.product((False, True), (("", 1.0), *UNITS.items())):
        velocity, turn = factor * (rates[:, 0] + 1j * rates[:, 1]), rates[:, 2]
        if is_flipped:
            velocity, turn = velocity.conj(), -turn
        in_metres = partial(with_range_scale, factor=1.0 / factor)
        in_unit = Row("lidar.unit", f"the LiDAR's ranges are in {unit}", _ODDS["unit"], unit, factor, in_metres)
        for yaw, odds in yaws(velocity, turn, source.place, (usual, _WRONG_PLACE)):
            rows = [*([in_unit] if unit else []), *_mount_rows(source.frame, mount, is_flipped, yaw, odds)]
            for place, is_elsewhere in places:
                way, side = in_body(velocity, turn, source.place, yaw, place)
                more = [_place_row(source, side.ahead_m)] if is_elsewhere else []
                found.append(Alternative((*rows, *more), way, turn, (factor, 1.0), side.evidence, own_by_bin=side.by_bin))
    return found


def _place_row(source: Source, ahead: float) -> Row:
    """A place that neither log nor robot file give is as likely as the body's origin, and no fault."""
    ahead = round(ahead, 3)
    anywhere = f"the LiDAR is {abs(ahead):.2f} m {'ahead of' if ahead > 0 else 'behind'} the body's origin"
    return Row(
        "lidar.place",
        LIDAR_OFFSET_X.describe(ahead) if source.is_mounted else anywhere,
        _ODDS["place"] if source.is_mounted else 0.0,
        value=ahead,
        correct=correction(LIDAR_OFFSET_X, ahead, source.frame, source.mount) if source.frame else None,
        is_fault=source.is_mounted,
        is_reported=True,
    )


def in_body(velocity: Velocity, turn: FloatArray, at: complex, yaw: float, place: PlacePrior) -> tuple[FloatArray, SideEvidence]:
    """Forward speed (n,) of a body in which the sensor is turned by ``yaw``, and the evidence of its sideways speed. A mount of the file
    has a small yaw, with its prior."""
    small = 0.0 if yaw else _small_yaw(velocity - 1j * turn * at, turn, place.spread_m)[0]
    body = velocity * np.exp(1j * (yaw + small)) - 1j * turn * at
    side = side_evidence(body.imag, body.real, turn, place)
    return body.real, side._replace(evidence=side.evidence - 0.5 * (small / _YAW_SIGMA_RAD) ** 2)


def _small_yaw(body: Velocity, turn: FloatArray, place_sigma_m: float) -> tuple[float, float]:
    """Posterior means of a small yaw [rad] and of the place ahead [m]: side = ahead wz - yaw v by least squares, with their priors."""
    known = np.isfinite(body)
    X, side = np.stack([-body.real[known], turn[known]], axis=1), body.imag[known]
    variance = 0.02**2 + (0.1 * X[:, 0]) ** 2 + (0.15 * X[:, 1]) ** 2
    weight: FloatArray = 1.0 / variance
    found = np.zeros(2)
    for _ in range(3):
        information = (weight[:, None] * X).T @ X + np.diag([_YAW_SIGMA_RAD**-2, place_sigma_m**-2])
        found = np.linalg.solve(information, X.T @ (weight * side))
        weight = 1.0 / (variance * (1.0 + ((side - X @ found) / 0.1) ** 2))
    return float(found[0]), float(found[1])


def yaws(velocity: Velocity, turn: FloatArray, at: complex, places: tuple[PlacePrior, PlacePrior]) -> list[tuple[float, float]]:
    """Yaws by which the mount may be wrong, with the logarithm of their prior odds: 0, and the axis of travel with both ends, for a sensor
    at its place and for one elsewhere."""
    known = np.isfinite(velocity)
    u, w = velocity[known], turn[known]
    found = [(0.0, 0.0)]
    for place in places if len(u) >= 6 else ():
        yaw = _axis_of_travel(u, w, at, place.spread_m)
        for angle in (math.remainder(yaw, math.tau), math.remainder(yaw + math.pi, math.tau)):
            quarter = round(angle / (0.5 * math.pi)) * 0.5 * math.pi
            is_quarter = abs(angle - quarter) < _QUARTER_RAD
            angle, odds = (up_to_pi(quarter), _ODDS["quarter"]) if is_quarter else (angle, _ODDS["yaw"])
            if all(abs(math.remainder(angle - other, math.tau)) > 0.5 * _QUARTER_RAD for other, _ in found):
                found.append((angle, odds))
    for quarter in (math.pi, 0.5 * math.pi, -0.5 * math.pi):
        if all(abs(math.remainder(quarter - angle, math.tau)) > 2.0 * _QUARTER_RAD for angle, _ in found):
            found.append((quarter, _ODDS["quarter"]))
    return found


def _axis_of_travel(velocity: Velocity, turn: FloatArray, at: complex, place_sigma_m: float) -> float:
    """Yaw [rad] by which the sideways part of the ``velocity`` (n,) is least, the place ahead profiled at each of `_GRID`."""
    rotated = velocity[None, :] * np.exp(1j * _GRID)[:, None] - 1j * turn * at
    sigma = np.sqrt(0.02**2 + (0.1 * np.abs(velocity)) ** 2 + (0.15 * np.abs(turn)) ** 2)
    weight = sigma**-2.0
    ahead = (rotated.imag * turn * weight).sum(1) / ((turn**2 * weight).sum() + place_sigma_m**-2)
    cost = np.log1p(((rotated.imag - ahead[:, None] * turn) / sigma) ** 2).sum(axis=1)
    yaw = float(_GRID[int(cost.argmin())])
    return yaw + _small_yaw(velocity * np.exp(1j * yaw) - 1j * turn * at, turn, place_sigma_m)[0]


def _mount_rows(frame: str, mount: Mount, is_flipped: bool, yaw: float, yaw_odds: float) -> list[Row]:
    """Rows of a mount that is upside down, turned, or both; the first corrects all of it."""
    rows = []
    if is_flipped:
        correct = mount_correction(frame, mount, partial(_flipped, yaw)) if frame else None
        rows.append(Row("lidar.upside_down", "the LiDAR is mounted upside down", _ODDS["flip"], correct=correct))
    if yaw_odds:
        correct = correction(LIDAR_YAW, yaw, frame, mount) if frame and not is_flipped else None
        rows.append(Row("lidar.yaw", LIDAR_YAW.describe(yaw), yaw_odds, sector(yaw), yaw, correct=correct, may_change=True))
    return rows


def sector(yaw: float) -> str:
    """Sector of a yaw, of 30 degrees: yaws in one are one symptom."""
    return f"{30 * round(math.degrees(yaw) / 30.0) % 360} deg"


def _flipped(yaw: float, mount: Mount) -> Mount:
    """``mount`` upside down, and turned by ``yaw`` in the body, about itself."""
    return replace(mount, roll=up_to_pi(mount.roll + math.pi), yaw=up_to_pi(yaw - mount.yaw))
