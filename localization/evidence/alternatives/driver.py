"""A driver's odometry: its sides, its units, and whether it turns or corrects for skidding."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from localization.evidence.alternatives.alternative import (
    FACTOR_SIGMA,
    LEVELS,
    STILL_RAD_S,
    Alternative,
    Row,
    free_factor,
    mixture,
    noise_evidence,
    size_of,
)
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
    "pose": math.log(3e-4),
    "turns": math.log(3e-4),
    "factor": math.log(2e-4),
    "twist": math.log(0.1),
}
"""Prior odds by kind, as of wheels; where the robot file has the default multiplier, a driver that corrects for skidding is as usual as one
that does not, and no fault (diff_drive_controller's wheel_separation_multiplier)."""
_K_SIGMA = 0.25
"""Sigma of the logarithm of k by geometry: that of seven robots whose k was measured (`motion_models.prior.EVIDENCE`), and of floors."""
_MIN_BINS = 8
_ALIKE_FLOOR, _ALIKE_OF_MOTION = 0.03, 0.1
"""Standard deviation of poses from twists in a bin: part of the size of the motion (latencies, jitter), and of the motion itself."""
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
    """Sides times units of the ``rates`` (n, 2) way and turn of a driver's odometry, by its poses or its twists (``second``)."""
    alike = _alike_evidence(rates, second, 1.0)
    found = _of_channels(source, rates, robot, alike, ())
    ratio = _ratio(rates, second)
    if ratio is not None:
        twist = Row("driver.twist", "the driver's twists are better than its poses", _ODDS["twist"], is_fault=False)
        found += _of_channels(source, second, robot, alike, (twist,))
        remedy = "Poses that sum speeds without the time between messages: correct the driver; until then its twists are right."
        text = f"the driver's poses move {ratio:.3g} times as far as its twists say"
        row = Row("driver.pose_against_twist", text, _ODDS["pose"], value=ratio, remedy=remedy)
        found += _of_channels(source, second, robot, _alike_evidence(rates, second, ratio), (row,))
    return found


def _ratio(rates: FloatArray, second: FloatArray) -> float | None:
    """Median of the way by poses over that by twists; None where there is only one of them, or no way."""
    moving = np.isfinite(rates[:, 0]) & (np.abs(second[:, 0]) > 0.2 * size_of(second[:, 0]))
    ratio = float(np.median(rates[moving, 0] / second[moving, 0])) if moving.sum() > _MIN_BINS else 0.0
    return ratio if ratio > 0.0 else None


def _alike_evidence(rates: FloatArray, second: FloatArray, ratio: float) -> float:
    """Evidence that the poses move ``ratio`` times as the twists, relative to their size; one of the two channels is the other's copy."""
    found = 0.0
    for of_pose, of_twist in zip(rates.T, second.T, strict=True):
        size = size_of(of_pose)
        sigma = _ALIKE_FLOOR + _ALIKE_OF_MOTION * np.abs(ratio * of_twist) / size
        found += mixture((of_pose - ratio * of_twist) / size, sigma, 1.0)
    return found


def _of_channels(source: Source, rates: FloatArray, robot: Robot, evidence: float, more: tuple[Row, ...]) -> list[Alternative]:
    way, turned = rates[:, 0], rates[:, 1]
    multiplier = expected_scaling(robot) * robot.driver.wheel_separation_multiplier
    is_default = robot.driver.wheel_separation_multiplier == 1.0 and "k_0" not in robot.models.get("skid_steer", {})
    units: list[tuple[float, tuple[Row, ...]]] = [(1.0, ())]
    for name, factor in UNITS.items():
        correct = partial(_set_unit, factor * robot.driver.length_unit_m)
        units.append((factor, (Row("driver.unit", f"the driver publishes {name}", _ODDS["unit"], name, factor, correct),)))
    found = []
    for factor, of_unit in units:
        for v, w, sigma, of_side in _sides(factor * rates[:, 0], turned, robot):
            rows = (*of_side, *of_unit, *more)
            in_units = (1.0, factor) if sigma > 0.0 else (factor, 1.0)  # where a side is reversed, turns are made of ways
            found.append(Alternative(rows, v, multiplier * w, in_units, evidence, sigma, _K_SIGMA + sigma))
    for v, w, sigma, of_side in _sides(way, turned, robot):
        rows = (*of_side, *more)
        if abs(math.log(multiplier)) > 0.05:
            corrected = Row(
                "driver.corrects_skidding",
                "the driver corrects for skidding",
                _ODDS["usual" if is_default else "multiplier"],
                value=float(f"{1.0 / expected_scaling(robot):.4g}"),
                correct=partial(_set_multiplier, float(f"{1.0 / expected_scaling(robot):.4g}")),
                is_fault=not is_default,
            )
            found.append(Alternative((*rows, corrected), v, w, (1.0, 1.0 / multiplier), evidence, sigma, sigma))
    remedy = "Check the radius and the resolution in the driver's parameters."
    for v, w, _, of_side in _sides(way, turned, robot):
        factor, of_factor = free_factor(v, w, source.sizes_by_others)
        text = f"the driver's odometry is {1.0 / factor:.3g} times too large"
        scaled = Row("driver.factor", text, _ODDS["factor"], "", factor, remedy=remedy)
        values = factor * v, factor * multiplier * w, (factor, factor), evidence + of_factor, FACTOR_SIGMA, FACTOR_SIGMA
        found.append(Alternative((*of_side, scaled, *more), *values))
    no_turns = Row("driver.no_turns", "the driver publishes no turns", _ODDS["turns"], remedy="Correct the driver's yaw rate and heading.")
    sigma = min(max(size_of(turned), LEVELS[0] * STILL_RAD_S), STILL_RAD_S)
    still = evidence + noise_evidence(turned, sigma)
    found.append(Alternative((no_turns, *more), way, np.full_like(turned, np.nan), (1.0, 1.0), still))
    return found


def _sides(way: FloatArray, turned: FloatArray, robot: Robot) -> list[tuple[FloatArray, FloatArray, float, tuple[Row, ...]]]:
    """Way [m/s] and turn of a driver whose sides are wired in another way, sigma of the logarithm of their scale, rows."""
    half = 0.5 * robot.driver.track_width_m * robot.driver.wheel_separation_multiplier
    remedy = "Correct the encoder's or motor's sign in the driver."
    exchanged = Row("driver.sides_exchanged", "left and right are exchanged in the driver", _ODDS["sign"], remedy=remedy)
    reversed_ = Row("driver.reversed", "the driver counts backwards on both sides", _ODDS["sign"], remedy=remedy)
    backwards = Row("driver.backwards", "the driver's front is the robot's back", _ODDS["side"], remedy=remedy)
    found = [
        (way, turned, 0.0, ()),
        (way, -turned, 0.0, (exchanged,)),
        (-way, -turned, 0.0, (reversed_,)),
        (-way, turned, 0.0, (backwards,)),
    ]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        row = Row(f"driver.{side}_reversed", f"the {side} side counts backwards in the driver", _ODDS["side"], remedy=remedy)
        found.append((sign * half * turned, sign * way / half, 0.15, (row,)))
    return found


def _set_unit(value: float, robot: Robot) -> Robot:
    return replace(robot, driver=replace(robot.driver, length_unit_m=float(f"{value:.6g}")))


def _set_multiplier(value: float, robot: Robot) -> Robot:
    return replace(robot, driver=replace(robot.driver, wheel_separation_multiplier=value))
