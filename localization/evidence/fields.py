"""Fields of the same message check each other: angles and velocities of a wheel, wheels of one side, steps of a counter.

What they show needs no other source. Where two fields differ, either may be wrong: both are alternatives of the source, and the other
sources decide.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from localization.evidence.alternatives.alternative import Row
from localization.evidence.signals import Source
from motion_models.robot import Robot

_DEAD = 1e-6
"""Part of the way of a side's fastest wheel, up to which an encoder counts nothing: rounding."""
_COUNTERS = (65536.0, 32768.0, 4294967296.0, 16777216.0)
"""Ranges of counters of 16, 15, 32 and 24 bits."""
_STEP_S, _MIN_MOVING = 0.5, 12
"""Bins in which fields are compared [s], and how many must go backwards to show a sign."""
_SAME_JUMP, _MIN_JUMPS = 0.02, 2
"""Relative difference of jumps of one size (a wheel turns a little in that step), and jumps that show a range without a usual size."""


def own_faults(source: Source, robot: Robot) -> tuple[Source, tuple[Row, ...]]:
    """``source`` without the wheels that its own messages show to be dead, and the rows of what they show."""
    if source.kind != "wheels":
        return source, ()
    alive, rows = _without_dead(source)
    return alive, (*rows, *_counter(source, robot), *_unsigned(alive))


def _without_dead(source: Source) -> tuple[Source, tuple[Row, ...]]:
    """Encoders that count nothing, or have no data, while another wheel of their side turns."""
    has_data = source.is_known.any(axis=0)
    way = np.abs(np.diff(source.integrals, axis=0)).sum(axis=0)
    is_left = np.arange(len(source.joints)) < source.left
    most = np.where(is_left, way[is_left].max(), way[~is_left].max())
    is_kept = (way > _DEAD * most) | (most == 0.0)
    if is_kept.all():
        return source, ()
    names = np.array(source.joints)
    left, right = tuple(names[is_left & is_kept].tolist()), tuple(names[~is_left & is_kept].tolist())
    correct = partial(_keep_joints, left, right)
    rows = []
    for lost, text, remedy in (
        (names[~is_kept & has_data], "counts nothing while another wheel of its side turns, which is used alone", "Check the encoder."),
        (names[~is_kept & ~has_data], "has no data in this log; another wheel of its side is used alone", "Record all wheels."),
    ):
        rows += [Row("wheels.dead", f"{name} {text}", 0.0, name, correct=correct, remedy=remedy) for name in lost.tolist()]
    kept = replace(
        source,
        integrals=source.integrals[:, is_kept],
        is_known=source.is_known[:, is_kept],
        second=None if source.second is None else source.second[:, is_kept],
        joints=(*left, *right),
        left=len(left),
    )
    return kept, tuple(rows)


def _keep_joints(left: tuple[str, ...], right: tuple[str, ...], robot: Robot) -> Robot:
    return replace(robot, joints=replace(robot.joints, left=left, right=right))


def _counter(source: Source, robot: Robot) -> tuple[Row, ...]:
    """Angles that jump by one size again and again: a counter that wraps. All wheels at once, and once, are a reset."""
    sizes = np.abs(source.jumps[:, 1]) / robot.joints.angle_unit_rad
    if not len(sizes) or robot.joints.angle_range:
        return ()
    size = float(np.median(sizes))
    counter = next((c for c in _COUNTERS if abs(size / c - 1.0) <= _SAME_JUMP), None)
    is_one_size = float(np.abs(sizes / size - 1.0).max()) <= _SAME_JUMP
    if not is_one_size or (counter is None and len(set(source.jumps[:, 0])) < _MIN_JUMPS):
        return ()
    value = counter if counter is not None else float(f"{size:.6g}")
    what = f"a counter of {math.log2(value):.0f} bits wraps" if counter is not None else "a counter wraps"
    text = f"positions jump by {value:.10g} ({len(sizes)} times): {what}"
    return (Row("wheels.counter", text, 0.0, value=value, correct=partial(_set_range, value)),)


def _unsigned(source: Source) -> tuple[Row, ...]:
    """Velocities that are positive while angles go backwards: the angles have the sign."""
    if source.second is None or len(source.t) < _MIN_MOVING:
        return ()
    edges = np.arange(source.t[0], source.t[-1], _STEP_S)
    by_angle, by_rate = source.rates(edges), source.rates(edges, of_second=True)
    known = np.isfinite(by_angle) & np.isfinite(by_rate)
    a, b = by_angle[known], by_rate[known]
    backwards = a < -0.3 * math.sqrt(float(np.mean(a * a)) if len(a) else 0.0)
    if backwards.sum() < _MIN_MOVING or b.min() < -1e-3 * np.abs(b).max() or b[backwards].min() <= 0.0:
        return ()
    text = "velocities of the wheels have no sign: they are positive while angles go backwards; angles are used"
    return (Row("wheels.unsigned_velocities", text, 0.0, remedy="Let the driver publish signed velocities, or none."),)


def _set_range(value: float, robot: Robot) -> Robot:
    return replace(robot, joints=replace(robot.joints, angle_range=value))
