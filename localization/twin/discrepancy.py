"""What a simulator gets wrong, by kind of motion: turns, ways and centres of rotation of its windows beside the measured ones."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localization.twin.engine import Played
from localization.twin.windows import Window, motion_of_point
from motion_models import se2
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_IN_PLACE, _STRAIGHT = 0.3, 0.1
"""Speed over that of the rims' turning below which a robot turns in place, and turning over speed below which it drives straight."""
_FEWEST = 4
"""Windows from which a kind is split into slow and fast."""
_SHOWN_SIGMAS = 2.0
_SHOWN_SHARE, _SHOWN_M = 0.02, 0.005
"""Differences below which nothing is said: how well radius and track of a robot are known."""
_LEAST_SLOPE, _LEAST_TURN = 0.03, 0.1
"""Slope (its tangent) and turn of a window [rad] from which on sliding downhill is compared: less is within an accelerometer's mount."""
_STOPPED = 0.1
"""Set point at the end of a window over its largest, below which the robot stops in it."""
_CG_SPREAD_M = 0.02
"""Distance between the centres of gravity of two halves of the windows from which on they are compared by themselves."""


@dataclass(frozen=True)
class Row:
    """Motion of one kind of windows in the simulator against the measured one. NaN where it was not measured, or there is none."""

    kind: str
    windows: int
    turn_error: float
    """Relative error of the turn."""
    turn_sigma: float
    """Its standard error, by the scatter from window to window."""
    way_error: float
    """Relative error of the distance."""
    way_sigma: float
    cor_error: tuple[float, float]
    """Centre of rotation less the measured one, ahead and to the left [m]."""
    cor_sigma: tuple[float, float]
    position_rms_m: float
    heading_rms_rad: float
    rate_error: float
    """Relative error of the wheels' rates against those that they had."""
    slope: float = math.nan
    """Mean slope of the ground under turns in place, its tangent; NaN where it is level."""
    slide_error_m: float = math.nan
    """How much farther it slides downhill in a full turn in place than the robot does [m]."""
    slide_sigma_m: float = math.nan
    slide_m: float = math.nan
    """How far the robot slides downhill in such a turn [m]."""

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


def compare(windows: Sequence[Window], played: Played, robot: Robot, frame: FloatArray) -> list[Row]:
    """Rows by kind of motion, and by speed within a kind; the last is of all windows. ``frame`` (2,): the point that was measured [m]."""
    kinds = kinds_of(windows, robot)
    rows = []
    for kind in ("in place", "on arcs", "straight"):
        if (kinds == kind).any():
            parts = [(kind, kinds == kind), *_parts(kinds == kind, windows, robot)]
            rows += [_row(kind if part == kind else f"{kind}, {part}", of, windows, played, robot, frame) for part, of in parts]
    stopping = np.array([_is_stopping(w) for w in windows])
    rows += [_row("stopping", stopping, windows, played, robot, frame)] if stopping.any() else []
    return [*rows, _row("all", np.ones(len(windows), dtype=bool), windows, played, robot, frame)]


def _parts(chosen: NDArray[np.bool_], windows: Sequence[Window], robot: Robot) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Halves (W,) of the ``chosen`` windows by speed, and by the centre of gravity along each axis, where these differ, with names."""
    rims = np.array([np.abs(w.mean_rates).max() for w in windows]) * robot.geometry.wheel_radius_m
    slow, fast = _halves(chosen, rims)
    if min(slow.sum(), fast.sum()) >= _FEWEST and rims[fast].mean() > 1.3 * rims[slow].mean():
        yield from ((f"{name} ({rims[part].mean():.2f} m/s at the rim)", part) for name, part in (("slow", slow), ("fast", fast)))
    for axis, names in enumerate((("back", "front"), ("right", "left"))):
        at = np.array([w.cg[axis] for w in windows])
        low, high = _halves(chosen, at)
        if min(low.sum(), high.sum()) >= _FEWEST and at[high].mean() > at[low].mean() + _CG_SPREAD_M:
            for name, part in zip(names, (low, high), strict=True):
                yield f"load at the {name} ({'xy'[axis]} = {1e3 * at[part].mean():.0f} mm)", part


def _halves(chosen: NDArray[np.bool_], values: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Those of the windows that are ``chosen`` (W,) with ``values`` (W,) up to their median, and above it."""
    middle = float(np.median(values[chosen]))
    return chosen & (values <= middle), chosen & (values > middle)


def _is_stopping(window: Window) -> bool:
    """Whether the wheels come to stand in the window."""
    rates = np.abs(window.rates)
    return bool(rates[-1].max() < _STOPPED * rates.max())


def kinds_of(windows: Sequence[Window], robot: Robot) -> NDArray[np.str_]:
    """(W,) in place, on arcs, straight."""
    rates = np.array([w.mean_rates for w in windows])
    speed, turning = np.abs(rates.sum(axis=1)) / 2.0, np.abs(rates[:, 1] - rates[:, 0]) / 2.0
    return np.where(speed < _IN_PLACE * turning, "in place", np.where(turning < _STRAIGHT * speed, "straight", "on arcs"))


def turns(windows: Sequence[Window], poses: FloatArray, robot: Robot) -> FloatArray:
    """(W,) headings of ``poses`` (W, 3) as turns that may exceed a half [rad]: those nearest to half of what the wheels' turn would be."""
    g = robot.geometry
    rates = np.array([w.mean_rates for w in windows])
    duration = np.array([w.duration_s for w in windows])
    guess = 0.5 * (rates[:, 1] - rates[:, 0]) * g.wheel_radius_m / g.track_width_m * duration
    return np.asarray(poses[:, 2] + math.tau * np.round((guess - poses[:, 2]) / math.tau))


def _row(kind: str, chosen: NDArray[np.bool_], windows: Sequence[Window], played: Played, robot: Robot, frame: FloatArray) -> Row:
    used = [w for w, is_chosen in zip(windows, chosen, strict=True) if is_chosen]
    moved = motion_of_point(played.poses[chosen], frame)
    measured = np.array([w.measured for w in used])
    known = np.isfinite(np.array([np.diagonal(w.cov) for w in used]))
    turn, true_turn = turns(used, moved, robot), turns(used, measured, robot)
    way, true_way = (np.hypot(*p[:, :2].T) for p in (moved, measured))
    off = se2.between(measured, moved)
    has_position = known[:, 0]
    rates = np.array([w.mean_rates for w in used])
    cor, cor_sigma = (math.nan, math.nan), (math.nan, math.nan)
    if kind.startswith("in place") and has_position.any():
        error = (centres(moved, turn) - centres(measured, true_turn))[has_position]
        error = error[np.isfinite(error).all(axis=1)]
        if len(error):
            cor, spread = _pair(np.median(error, axis=0)), error.std(axis=0) * 1.25 / math.sqrt(max(len(error), 2))
            cor_sigma = _pair(spread)
    is_turning = kind not in ("straight", "stopping")
    is_going = has_position.any() and not kind.startswith("in place")
    turn_error, turn_sigma = _relative(turn * np.sign(true_turn), np.abs(true_turn)) if is_turning else (math.nan, math.nan)
    way_error, way_sigma = _relative(way[has_position], true_way[has_position]) if is_going else (math.nan, math.nan)
    return Row(
        kind,
        len(used),
        turn_error,
        turn_sigma,
        way_error,
        way_sigma,
        cor,
        cor_sigma,
        float(np.sqrt((off[has_position, :2] ** 2).sum(axis=1).mean())) if has_position.any() else math.nan,
        float(np.sqrt((off[:, 2] ** 2).mean())),
        float(np.abs(played.rates[chosen]).sum() / max(np.abs(rates).sum(), 1e-9) - 1.0),
        *(_slides(used, moved, measured, turn) if kind.startswith("in place") else ()),
    )


def _slides(windows: Sequence[Window], moved: FloatArray, measured: FloatArray, turn: FloatArray) -> tuple[float, float, float, float]:
    """`Row.slope` and the three on sliding, of those windows on slopes in which the robot turned in place."""
    downhill = np.array([w.downhill for w in windows])
    steep = np.hypot(*downhill.T)
    used = (steep > _LEAST_SLOPE) & (np.abs(turn) > _LEAST_TURN) & np.isfinite(np.array([w.cov[0, 0] for w in windows]))
    if used.sum() < 2:
        return math.nan, math.nan, math.nan, math.nan
    along, turned = downhill[used] / steep[used, None], np.abs(turn[used]) / math.tau
    excess = ((moved - measured)[used, :2] * along).sum(axis=1)
    error = float(excess @ turned) / float(turned @ turned)
    left = excess - error * turned
    sigma = math.sqrt(float(left @ left) / (len(left) - 1) / float(turned @ turned))
    slid = float((measured[used, :2] * along).sum(axis=1) @ turned) / float(turned @ turned)
    return float(steep[used].mean()), error, sigma, slid


def _relative(found: FloatArray, true: FloatArray) -> tuple[float, float]:
    """Relative error of the sum of ``found`` against that of ``true``, and its standard error."""
    total = float(true.sum())
    if total <= 0.0:
        return math.nan, math.nan
    error = float(found.sum()) / total - 1.0
    left = found - (1.0 + error) * true
    return error, float(math.sqrt((left**2).sum() * len(left) / max(len(left) - 1, 1)) / total)


def centres(poses: FloatArray, turned: FloatArray) -> FloatArray:
    """(W, 2) centres of rotation in the body frame [m]; NaN where the robot hardly turned."""
    half = 0.5 * turned
    with np.errstate(divide="ignore", invalid="ignore"):
        cot = np.where(np.abs(turned) > 0.1, np.cos(half) / np.sin(half), np.nan)
    x, y = poses[:, 0], poses[:, 1]
    return np.column_stack([0.5 * (x - cot * y), 0.5 * (y + cot * x)])


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def words(rows: Sequence[Row]) -> list[str]:
    """What is wrong, a sentence for each kind of motion; empty where nothing is beyond its scatter.

    >>> row = Row("in place", 68, -0.62, 0.01, math.nan, math.nan, (0.13, 0.0), (0.01, 0.01), 0.1, 0.4, -0.13)
    >>> words([row])
    ['in place it turns 62 % too little; its centre of rotation is 130 mm too far ahead; its wheels turn 13 % too slowly']
    >>> words([Row("in place", 9, 0.0, 0.01, 0.0, 0.0, (0.0, 0.0), (0.01, 0.01), 0.1, 0.1, 0.0, 0.0875, -0.1, 0.01, 0.19)])
    ['in place on slopes of 5 deg it slides 0.09 m a turn downhill where the robot slides 0.19 m']
    """
    found = []
    for row in rows:
        if row.kind == "all" or "," in row.kind:
            continue
        parts = []
        if abs(row.turn_error) > max(_SHOWN_SHARE, _SHOWN_SIGMAS * row.turn_sigma):
            parts.append(f"it turns {100 * abs(row.turn_error):.0f} % too {'much' if row.turn_error > 0.0 else 'little'}")
        if abs(row.way_error) > max(_SHOWN_SHARE, _SHOWN_SIGMAS * row.way_sigma):
            parts.append(f"it drives {100 * abs(row.way_error):.0f} % too {'far' if row.way_error > 0.0 else 'short a way'}")
        for error, sigma, names in zip(row.cor_error, row.cor_sigma, (("ahead", "back"), ("to the left", "to the right")), strict=True):
            if abs(error) > max(_SHOWN_M, _SHOWN_SIGMAS * sigma):
                parts.append(f"its centre of rotation is {1e3 * abs(error):.0f} mm too far {names[0] if error > 0.0 else names[1]}")
        if abs(row.slide_error_m) > max(_SHOWN_M, _SHOWN_SIGMAS * row.slide_sigma_m):
            slopes = f"on slopes of {math.degrees(math.atan(row.slope)):.0f} deg it slides"
            parts.append(f"{slopes} {row.slide_m + row.slide_error_m:.2f} m a turn downhill where the robot slides {row.slide_m:.2f} m")
        if abs(row.rate_error) > _SHOWN_SHARE:
            parts.append(f"its wheels turn {100 * abs(row.rate_error):.0f} % too {'fast' if row.rate_error > 0.0 else 'slowly'}")
        if parts:
            found.append(f"{row.kind} " + "; ".join(parts))
    return found
