"""Maneuvers: short drives with wheel rates and the motion that a reference (LiDAR, gyro, motion capture) measured.

Calibration compares the two (see `motion_models.calibration.prediction`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motion_models.errors import CalibrationError
from motion_models.se2 import FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Maneuver:
    """One short drive. Its start is the end of interval ``lead``; poses are relative to the body's pose there."""

    dt: FloatArray
    """(n,) lengths of the intervals [s]."""
    wheels: FloatArray
    """(n, 2) left and right wheel rate in each interval [rad/s]."""
    measured: FloatArray
    """(m, 3) measured poses relative to the start [m, m, rad]."""
    ends: IntArray
    """(m,) number of intervals driven since the start when each pose was measured, increasing."""
    cg: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) or (n, 2) centre of gravity [m]."""
    cov: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) or (m, 3, 3) covariance of the measured poses (right perturbation); inf on the diagonal for what is not measured, as
    the position of a gyro."""
    group: str = ""
    """Maneuvers of one group share their errors (same step, same place): they are resampled and held out together."""
    lead: int = 0
    """First intervals that lie before the start; they feed a lag and a time offset, and are not integrated."""


@dataclass(frozen=True)
class Batch:
    """Many maneuvers end to end, as the compiled loops take them."""

    dt: FloatArray
    """(N,)"""
    wheels: FloatArray
    """(N, 2)"""
    cg: FloatArray
    """(N, 2)"""
    first: IntArray
    """(W + 1,) where each maneuver's intervals begin; the last is N."""
    lead: IntArray
    """(W,)"""
    ends: IntArray
    """(M,) index after the last interval before each measured pose."""
    owner: IntArray
    """(M,) maneuver of each measured pose."""
    measured: FloatArray
    """(M, 3)"""
    cov: FloatArray
    """(M, 3, 3)"""
    group: IntArray
    """(M,) index of the group of each measured pose."""
    groups: tuple[str, ...]
    """Names of the groups, in order of their first maneuver."""


def make_batch(maneuvers: Sequence[Maneuver]) -> Batch:
    """Check and join ``maneuvers``. Raises `CalibrationError`, naming the maneuver that cannot be used and why."""
    if not maneuvers:
        raise CalibrationError("nothing to calibrate on: there is no maneuver.")
    for i, m in enumerate(maneuvers):
        _check(m, i)
    lengths = np.array([len(m.dt) for m in maneuvers])
    first = np.concatenate([[0], np.cumsum(lengths)])
    lead = np.array([m.lead for m in maneuvers])
    counts = [len(m.ends) for m in maneuvers]
    owner = np.repeat(np.arange(len(maneuvers)), counts)
    names = {m.group: i for i, m in reversed(list(enumerate(maneuvers)))}
    groups = tuple(sorted(names, key=lambda name: names[name]))
    index = {name: i for i, name in enumerate(groups)}
    batch = Batch(
        dt=np.concatenate([m.dt for m in maneuvers]),
        wheels=np.ascontiguousarray(np.concatenate([m.wheels for m in maneuvers])),
        cg=np.ascontiguousarray(np.concatenate([np.broadcast_to(m.cg, m.wheels.shape) for m in maneuvers])),
        first=first,
        lead=lead,
        ends=np.concatenate([m.ends for m in maneuvers]) + (first[:-1] + lead)[owner],
        owner=owner,
        measured=np.concatenate([m.measured for m in maneuvers]),
        cov=np.concatenate([np.broadcast_to(m.cov, (n, 3, 3)) for m, n in zip(maneuvers, counts, strict=True)]),
        group=np.array([index[m.group] for m in maneuvers])[owner],
        groups=groups,
    )
    interval_owner = np.repeat(np.arange(len(maneuvers)), lengths)
    for what, array, whose in (
        ("dt", batch.dt, interval_owner),
        ("wheels", batch.wheels, interval_owner),
        ("cg", batch.cg, interval_owner),
        ("measured", batch.measured, owner),
        ("cov", np.where(np.isposinf(batch.cov) & np.eye(3, dtype=bool), 1.0, batch.cov), owner),
    ):
        bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
        if bad.any():
            i = int(whose[np.argmax(bad)])
            raise CalibrationError(f"{_called(maneuvers[i], i)}: {what} has values that are not finite; leave such samples out.")
    if batch.dt.min() <= 0.0:
        i = int(interval_owner[np.argmin(batch.dt)])
        raise CalibrationError(f"{_called(maneuvers[i], i)}: an interval is {batch.dt.min():g} s long; all must be positive.")
    return batch


def _called(m: Maneuver, index: int) -> str:
    return f"maneuver {index}" + (f" (group '{m.group}')" if m.group else "")


def _check(m: Maneuver, index: int) -> None:
    """Refuse shapes that do not fit together."""
    n, poses = len(m.dt), len(m.ends)
    shapes: list[tuple[str, NDArray[Any], list[tuple[int, ...]]]] = [
        ("dt", m.dt, [(n,)]),
        ("wheels", m.wheels, [(n, 2)]),
        ("cg", m.cg, [(2,), (n, 2)]),
        ("measured", m.measured, [(poses, 3)]),
        ("cov", m.cov, [(3, 3), (poses, 3, 3)]),
    ]
    for what, array, allowed in shapes:
        if array.shape not in allowed:
            expected = " or ".join(str(shape) for shape in allowed)
            raise CalibrationError(
                f"{_called(m, index)}: {what} has shape {array.shape}; with {n} intervals and {poses} poses it must be {expected}."
            )
    ends = m.ends.tolist()
    if not ends or not 0 <= m.lead < n or ends != sorted(set(ends)) or ends[0] < 1 or ends[-1] > n - m.lead:
        raise CalibrationError(
            f"{_called(m, index)}: 'ends' must increase from at least 1 to at most the {n - m.lead} intervals after the start."
        )
