"""Wheels: signs, sides, units and lengths by joint."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from localization.evidence.alternatives.alternative import FACTOR_SIGMA, Alternative, Row, free_factor, mixture, size_of
from localization.evidence.noise import NOISE
from localization.evidence.signals import Source
from motion_models.prior import expected_scaling
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_SPREAD_FLOOR, _SPREAD_OF_SIDE = 0.05, 0.2
"""Standard deviation of a wheel's rate from that of its side: part of all rates' size (encoder steps), and of the side's rate (slip)."""
_ODDS = {"sign": math.log(1e-3), "unit": math.log(5e-4), "factor": math.log(3e-4), "side_unit": math.log(1e-4)}
"""Prior odds by kind: a judgement from public reports on skid-steer drivers, not counted (`docs/theory/set-up.md`)."""
_TWICE, _TWICE_SIGMA = (2.0, 0.5), 0.05
"""Factors of radius for diameter or half the resolution, and their inverses; sigma of the logarithm."""

_HOPELESS = 50.0
"""Logarithm of the evidence that wheels of a side turn alike, below the best wiring's, from where on no other source can redeem one."""

_ALIKE = 0.1
"""Difference of the logarithms of two units up to which they are one symptom, as m/s and rev/s of a wheel of 1 / (2 pi) m."""
_FIELDS_SIGMA, _FIELDS_WIDE = 0.1, 3.0
"""Sigma of the logarithm of velocities over rates of angles, of drivers that filter them; and of those in another unit."""

_MIN_MOVING = 12
"""Values in motion that show a ratio: half a wheel's rates over six seconds."""

Wiring = tuple[tuple[int, ...], tuple[int, ...], FloatArray, tuple[Row, ...]]
"""Columns of the left and right wheels, signs (joints,), rows."""


def alternatives(source: Source, rates: FloatArray, second: FloatArray, robot: Robot) -> list[Alternative]:
    """Wirings times units of the ``rates`` (n, joints) [rad/s by the robot file] of ``source``, ``second`` by its velocities."""
    radius = robot.geometry.wheel_radius_m
    scale = expected_scaling(robot) * radius / robot.geometry.track_width_m
    rates = _with_dead_filled(rates, source.left)
    found, fields = [], _fields(rates, second, radius)
    for left, right, signs, rows, alike in _believable(list(_wirings(source)), rates):
        of_left, of_right = (rates * signs)[:, left].mean(axis=1), (rates * signs)[:, right].mean(axis=1)
        way, turn = 0.5 * radius * (of_left + of_right), scale * (of_right - of_left)
        for factor, sigma, unit_rows in (*fields, *_units(robot)[len(fields) > 0 :]):
            found.append(Alternative((*rows, *unit_rows), factor * way, factor * turn, (factor, factor), alike, sigma, sigma))
        factor, of_factor = free_factor(way, turn, source.sizes_by_others)
        found.append(
            Alternative(
                (*rows, _factor_row(factor, FACTOR_SIGMA)),
                *(factor * way, factor * turn, (factor, factor), alike + of_factor, FACTOR_SIGMA, FACTOR_SIGMA),
            )
        )
        if not rows:
            found += _of_one_side(source, rates, radius, scale)
    return found


def _believable(wirings: list[Wiring], rates: FloatArray) -> list[tuple[*Wiring, float]]:
    """The robot file's wiring, and those whose wheels of one side turn as alike as in the best one, or nearly; with that evidence."""
    evidence = [_alike_evidence(rates * signs, left, right) for left, right, signs, _ in wirings]
    return [(*wiring, e) for i, (wiring, e) in enumerate(zip(wirings, evidence, strict=True)) if i == 0 or e > max(evidence) - _HOPELESS]


def _with_dead_filled(rates: FloatArray, left: int) -> FloatArray:
    """``rates`` (n, joints) whose unknown columns have the mean of their side."""
    found = rates.copy()
    for side in (slice(0, left), slice(left, None)):
        known = np.isfinite(rates[:, side])
        count = known.sum(axis=1)
        mean = np.where(count > 0, np.where(known, rates[:, side], 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)
        found[:, side] = np.where(known, rates[:, side], mean[:, None])
    return found


def _alike_evidence(rates: FloatArray, left: tuple[int, ...], right: tuple[int, ...]) -> float:
    """Wheels of one side turn alike: evidence of the ``rates`` (n, joints), relative to their size, so that no unit changes it."""
    n = rates.shape[1]
    if n <= 2:
        return 0.0
    size = size_of(rates)
    sides = [rates[:, side] / size for side in (left, right)]
    means = [np.broadcast_to(side.mean(axis=1, keepdims=True), side.shape) for side in sides]
    spread, mean = np.hstack([side - of_side for side, of_side in zip(sides, means, strict=True)]), np.hstack(means)
    sigma = np.sqrt(_SPREAD_FLOOR**2 + (_SPREAD_OF_SIDE * mean) ** 2)
    return float((n - 2) / n * mixture(spread, sigma, 1.0))  # of n residuals n - 2 are independent


def _wirings(source: Source) -> Iterator[Wiring]:
    """Sides as the file has them, exchanged, or with one wheel of each exchanged; times signs."""
    n, nl = len(source.joints), source.left
    left, right = tuple(range(nl)), tuple(range(nl, n))
    names = source.joints
    sides: list[tuple[tuple[int, ...], tuple[int, ...], tuple[Row, ...]]] = [(left, right, ())]
    exchange = Row(
        "wheels.sides_exchanged", "left and right wheels are exchanged", _ODDS["sign"], correct=partial(_set_sides, names[nl:], names[:nl])
    )
    sides.append((right, left, (exchange,)))
    for i, j in itertools.product(left, right) if n > 2 else ():
        new_left = tuple(j if k == i else k for k in left)
        new_right = tuple(i if k == j else k for k in right)
        of_left, of_right = tuple(names[k] for k in new_left), tuple(names[k] for k in new_right)
        text = f"the left wheels are {', '.join(of_left)}, the right ones {', '.join(of_right)}"
        row = Row("wheels.other_side", text, _ODDS["sign"], ",".join(sorted(of_left)), correct=partial(_set_sides, of_left, of_right))
        sides.append((new_left, new_right, (row,)))
    for (a, b, rows), (columns, sign_rows) in itertools.product(sides, _signs(source)):
        signs = np.ones(n)
        signs[list(columns)] = -1.0
        yield a, b, signs, (*rows, *sign_rows)


def _signs(source: Source) -> Iterator[tuple[tuple[int, ...], tuple[Row, ...]]]:
    """Columns that count backwards, and their rows."""
    n, nl, names = len(source.joints), source.left, source.joints
    left, right = tuple(range(nl)), tuple(range(nl, n))
    yield (), ()
    sets = [
        ("wheels.left_reversed", f"the left side counts backwards ({', '.join(names[:nl])})", left),
        ("wheels.right_reversed", f"the right side counts backwards ({', '.join(names[nl:])})", right),
        ("wheels.all_reversed", "all wheels count backwards", (*left, *right)),
    ]
    for key, text, columns in sets:
        yield columns, (Row(key, text, _ODDS["sign"], correct=partial(_reverse, tuple(names[i] for i in columns))),)
    for i in range(n) if n > 2 else ():
        correct = partial(_reverse, (names[i],))
        yield (i,), (Row("wheels.one_reversed", f"{names[i]} counts backwards", _ODDS["sign"], names[i], correct=correct),)


Unit = tuple[float, float, tuple[Row, ...]]
"""Factor to rad/s, sigma of its logarithm, rows."""


def _names(radius: float) -> dict[str, float]:
    """Radians per second, by the unit's name."""
    return {"rpm": math.tau / 60.0, "deg/s": math.pi / 180.0, "rev/s": math.tau, "m/s": 1.0 / radius, "mm/s": 1e-3 / radius}


def _fields(rates: FloatArray, second: FloatArray, radius: float) -> list[Unit]:
    """Where velocities are another multiple of the angles' rates: the velocities have another unit, or the angles have."""
    ratio, sigma = _log_ratio(rates, second)
    same = -0.5 * (ratio / math.hypot(sigma, _FIELDS_SIGMA)) ** 2 - math.log(_FIELDS_SIGMA)
    other = _ODDS["unit"] - 0.5 * (ratio / _FIELDS_WIDE) ** 2 - math.log(_FIELDS_WIDE)
    if not math.isfinite(sigma) or same > other:
        return []
    times = math.exp(ratio)
    name = min(_names(radius), key=lambda n: abs(ratio + math.log(_names(radius)[n])))
    exact = _names(radius)[name] if abs(ratio + math.log(_names(radius)[name])) < _FIELDS_SIGMA else 1.0 / times
    inverse = min(_names(radius), key=lambda n: abs(ratio - math.log(_names(radius)[n])))
    of_angles = _names(radius)[inverse] if abs(ratio - math.log(_names(radius)[inverse])) < _FIELDS_SIGMA else times
    velocity = f"velocities of the wheels are {times:.3g} times those of their angles ({exact:.6g} rad/s each)"
    angle = f"angles of the wheels turn {1.0 / times:.3g} times as fast as their velocities ({of_angles:.6g} rad each)"
    odds = _ODDS["unit"]
    return [
        (1.0, 0.0, (Row("wheels.velocity_unit", velocity, odds, value=exact, correct=partial(_scale_fields, 1.0, exact)),)),
        (of_angles, 0.0, (Row("wheels.angle_unit", angle, odds, value=of_angles, correct=partial(_scale_fields, of_angles, 1.0)),)),
    ]


def _log_ratio(first: FloatArray, second: FloatArray) -> tuple[float, float]:
    """Logarithm of the size of ``second`` (n, joints) over ``first``, and its standard error."""
    known = np.isfinite(first) & np.isfinite(second)
    a, b = first[known], second[known]
    size = float(np.sqrt(np.mean(a * a))) if len(a) else 0.0
    moving = np.abs(a) > 0.3 * size
    if size == 0.0 or moving.sum() < _MIN_MOVING or not np.any(b[moving]):
        return 0.0, math.inf
    ratios = np.log(np.abs(b[moving]) / np.abs(a[moving]) + 1e-12)
    spread = float(np.median(np.abs(ratios - np.median(ratios)))) * 1.48
    return float(np.median(ratios)), max(spread, 0.03) / math.sqrt(moving.sum() / 4.0)


def _units(robot: Robot) -> list[Unit]:
    """The unit of both fields, that of the robot file first."""
    found: list[Unit] = [(1.0, 0.0, ())]
    named = _names(robot.geometry.wheel_radius_m)
    for factor in named.values():
        alike = [n for n, other in named.items() if abs(math.log(other / factor)) < _ALIKE]
        detail = " or ".join(alike)  # nothing tells them apart, and their corrections hardly differ
        text = f"the wheels' rates are in {detail}, not in rad/s (1 rad/s is {1.0 / factor:.4g} of them)"
        found.append((factor, 0.05, (Row("wheels.unit", text, _ODDS["unit"], detail, factor, partial(scale_unit, factor)),)))
    return [*found, *((factor, _TWICE_SIGMA, (_factor_row(factor, _TWICE_SIGMA),)) for factor in _TWICE)]


def factor_text(factor: float, spread: str = "") -> str:
    """Clause on rates that have to be multiplied by ``factor``."""
    size, what = (1.0 / factor, "large") if factor < 1.0 else (factor, "small")
    return f"the wheels' rates are {size:.3g}{spread} times too {what}"


def _factor_row(factor: float, sigma: float) -> Row:
    return Row("wheels.factor", factor_text(factor), _ODDS["factor"], f"{sigma:g}", factor, partial(scale_unit, factor), may_change=True)


def _of_one_side(source: Source, rates: FloatArray, radius: float, scale: float) -> Iterator[Alternative]:
    """Rates of one side in another unit."""
    n, nl = rates.shape[1], source.left
    sides = tuple(range(nl)), tuple(range(nl, n))
    left, right = (rates[:, part].mean(axis=1) for part in sides)
    alike = _alike_evidence(rates, *sides)
    for name, factor in (
        ("rpm", math.tau / 60.0),
        ("deg/s", math.pi / 180.0),
        ("x 2", 0.5),
        ("x 1/2", 2.0),
        ("x 4", 0.25),
        ("x 1/4", 4.0),
        ("m/s", 1.0 / radius),
    ):
        for side in ("left", "right"):
            of_left, of_right = (factor * left, right) if side == "left" else (left, factor * right)
            text = f"rates of the {side} wheels are in another unit than the others' ({name})"
            row = Row(f"wheels.factor_{side}", text, _ODDS["side_unit"], name, factor, partial(_scale_side, side, factor))
            way, turn = 0.5 * radius * (of_left + of_right), scale * (of_right - of_left)
            own, other = (left, of_right) if side == "left" else (right, of_left)
            units = factor ** (0.5 * _seen(own, other))
            yield Alternative((row,), way, turn, (units, units), alike, 0.05, 0.05, has_two_units=True)


def _seen(rate: FloatArray, other: FloatArray) -> FloatArray:
    """Share (n,) of the ``rate`` of a side that is seen beside the noise of the ``other`` side's: one that hardly rolls shows no unit."""
    return np.asarray(rate**2 / (rate**2 + (NOISE["wheels"].relative * other) ** 2 + 1e-12))


def _set_sides(left: tuple[str, ...], right: tuple[str, ...], robot: Robot) -> Robot:
    return replace(robot, joints=replace(robot.joints, left=left, right=right))


def _reverse(names: tuple[str, ...], robot: Robot) -> Robot:
    turned = {*names} ^ {*robot.joints.reversed}
    backwards = tuple(name for name in (*robot.joints.left, *robot.joints.right) if name in turned)
    return replace(robot, joints=replace(robot.joints, reversed=backwards))


def scale_unit(factor: float, robot: Robot) -> Robot:
    """``robot`` whose wheel joints have ``factor`` times the units."""
    return _scale_fields(factor, factor, robot)


def _scale_fields(of_angles: float, of_rates: float, robot: Robot) -> Robot:
    angle, rate = _six(robot.joints.angle_unit_rad * of_angles), _six(robot.joints.rate_unit_rad_s * of_rates)
    return replace(robot, joints=replace(robot.joints, angle_unit_rad=angle, rate_unit_rad_s=rate))


def _scale_side(side: str, factor: float, robot: Robot) -> Robot:
    key = f"{side}_wheel_radius_multiplier"
    return replace(robot, geometry=replace(robot.geometry, **{key: getattr(robot.geometry, key) * factor}))


def _six(value: float) -> float:
    return float(f"{value:.6g}")
