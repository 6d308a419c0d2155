"""A LiDAR: the yaw of its mount, upside down, its place and the unit of its ranges. A robot does not drive sideways."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import partial

import numpy as np

from localization.evidence.alternatives.alternative import Alternative, Row, mount_correction, side_evidence
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
_PLACE_SIGMA_M, _WRONG_PLACE_SIGMA_M = 0.07, 0.6
"""Standard deviation along the robot of a mount with the centre of rotation (robots turn within 5 cm of the middle of their wheels), and of
a mount that is wrong."""
_GRID = np.radians(np.arange(-180.0, 180.0, 3.0))


def alternatives(source: Source, rates: FloatArray, second: FloatArray, robot: Robot) -> list[Alternative]:
    """Yaws times upside down times units of the ``rates`` (n, 3) ahead, to the left and turn at the sensor, in the axes of its mount."""
    mount, found = source.mount, list[Alternative]()
    for is_flipped, (unit, factor) in itertools.product((False, True), (("", 1.0), *UNITS.items())):
        velocity, turn = factor * (rates[:, 0] + 1j * rates[:, 1]), rates[:, 2]
        if is_flipped:
            velocity, turn = velocity.conj(), -turn
        in_unit = Row("lidar.unit", f"the LiDAR's ranges are in {unit}", _ODDS["unit"], unit, factor, partial(_set_range, 1.0 / factor))
        for yaw, odds in _yaws(velocity, turn, source.place):
            rows = [*([in_unit] if unit else []), *_mount_rows(source.frame, mount, is_flipped, yaw, odds)]
            own_yaw = yaw if odds else _small_yaw(velocity, turn, source.place)
            body = velocity * np.exp(1j * own_yaw) - 1j * turn * source.place
            of_yaw = 0.0 if odds else -0.5 * (own_yaw / _YAW_SIGMA_RAD) ** 2
            evidence, _ = side_evidence(body.imag, body.real, turn, _PLACE_SIGMA_M)
            found.append(Alternative(tuple(rows), body.real, turn, 2.0 * math.log(factor), of_yaw + evidence))
            evidence, ahead = side_evidence(body.imag, body.real, turn, _WRONG_PLACE_SIGMA_M)
            rows = [*rows, _place_row(source.frame, mount, ahead)]
            found.append(Alternative(tuple(rows), body.real, turn, 2.0 * math.log(factor), of_yaw + evidence))
    return found


def _place_row(frame: str, mount: Mount, ahead: float) -> Row:
    text = f"the LiDAR is {abs(ahead):.2f} m {'ahead of' if ahead > 0 else 'behind'} its mount"
    correct = mount_correction(frame, mount, partial(_moved, ahead)) if frame else None
    return Row("lidar.place", text, _ODDS["place"], value=ahead, correct=correct)


def _small_yaw(velocity: FloatArray, turn: FloatArray, place: complex) -> float:
    """Posterior mean of a small yaw [rad]: least squares of the sideways speed on the forward one, with a prior."""
    body = velocity - 1j * turn * place
    known = np.isfinite(body)
    way, side = body.real[known], body.imag[known]
    weight = 1.0 / (0.02**2 + (0.1 * way) ** 2 + (0.15 * turn[known]) ** 2)
    for _ in range(3):
        yaw = -float((weight * way * side).sum()) / (float((weight * way * way).sum()) + _YAW_SIGMA_RAD**-2)
        weight = 1.0 / ((0.02**2 + (0.1 * way) ** 2 + (0.15 * turn[known]) ** 2) * (1.0 + ((side + yaw * way) / 0.1) ** 2))
    return yaw


def _yaws(velocity: FloatArray, turn: FloatArray, place: complex) -> list[tuple[float, float]]:
    """Yaws by which the mount may be wrong, with the logarithm of their prior odds: 0, and the axis of travel with both ends."""
    known = np.isfinite(velocity)
    u, w = velocity[known], turn[known]
    found = [(0.0, 0.0)]
    if len(u) < 6:
        return [*found, (math.pi, _ODDS["quarter"])]
    rotated = u[None, :] * np.exp(1j * _GRID)[:, None] - 1j * w * place
    sigma = np.sqrt(0.02**2 + (0.1 * np.abs(u)) ** 2 + (0.15 * np.abs(w)) ** 2)
    cost = np.log1p((rotated.imag / sigma) ** 2).sum(axis=1)
    best = int(cost.argmin())
    yaw = float(_GRID[best]) + _small_yaw(u * np.exp(1j * _GRID[best]), w, place)
    for angle in (yaw, yaw + math.pi):
        angle = math.remainder(angle, math.tau)
        quarter = round(angle / (0.5 * math.pi)) * 0.5 * math.pi
        is_quarter = abs(angle - quarter) < _QUARTER_RAD
        if is_quarter and round(quarter / (0.5 * math.pi)) % 4 == 0:
            continue
        found.append((_up_to_pi(quarter), _ODDS["quarter"]) if is_quarter else (angle, _ODDS["yaw"]))
    for quarter in (math.pi, 0.5 * math.pi, -0.5 * math.pi):
        if all(abs(math.remainder(quarter - angle, math.tau)) > 2.0 * _QUARTER_RAD for angle, _ in found):
            found.append((quarter, _ODDS["quarter"]))
    return found


def _up_to_pi(angle: float) -> float:
    """``angle`` in (-pi, pi]."""
    wrapped = math.remainder(angle, math.tau)
    return math.pi if wrapped <= -math.pi + 1e-9 else wrapped


def _mount_rows(frame: str, mount: Mount, is_flipped: bool, yaw: float, yaw_odds: float) -> list[Row]:
    """Rows of a mount that is upside down, turned, or both; the first corrects all of it."""
    rows = []
    correct = mount_correction(frame, mount, partial(_set_mount, is_flipped, yaw)) if frame else None
    if is_flipped:
        rows.append(Row("lidar.upside_down", "the LiDAR is mounted upside down", _ODDS["flip"], correct=correct))
    if yaw_odds:
        side = "left" if yaw > 0.0 else "right"
        angle = f"{abs(math.degrees(yaw)):.0f} deg" + ("" if abs(abs(yaw) - math.pi) < 1e-6 else f" to the {side}")
        rows.append(
            Row("lidar.yaw", f"the LiDAR is turned by {angle}", yaw_odds, _sector(yaw), yaw, correct=None if is_flipped else correct)
        )
    return rows


def _sector(yaw: float) -> str:
    """Sector of a yaw, of 30 degrees: yaws in one are one symptom."""
    return f"{30 * round(math.degrees(yaw) / 30.0) % 360} deg"


def _set_mount(is_flipped: bool, yaw: float, mount: Mount) -> Mount:
    """``mount`` turned by ``yaw`` in the body, about itself; and upside down."""
    if not is_flipped:
        return replace(mount, yaw=_up_to_pi(mount.yaw + yaw))
    return replace(mount, roll=_up_to_pi(mount.roll + math.pi), yaw=_up_to_pi(yaw - mount.yaw))


def _moved(ahead: float, mount: Mount) -> Mount:
    return replace(mount, x=round(mount.x + ahead, 3))


def _set_range(scale: float, robot: Robot) -> Robot:
    return replace(robot, lidar=replace(robot.lidar, range_scale=scale * robot.lidar.range_scale))
