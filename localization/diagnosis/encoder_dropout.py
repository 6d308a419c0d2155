"""Encoder dropouts: one side's rate falls to half between two samples and doubles later, while the other's is steady."""

from __future__ import annotations

import numpy as np

from motion_models.calibration.maneuvers import Batch, IntArray
from motion_models.se2 import FloatArray

_DROP = (0.4, 0.62)  # one of two encoders silent; the rate of a side is their mean
_LEAST_RATE = 0.5  # rad/s
REST_RATE_RAD_PER_S = 0.25  # rad/s
_LONGEST_S = 3.0


def find_dropouts(batch: Batch) -> FloatArray:
    """(N, 2) what would have to be added to each rate, as a share of it: 1 where half of a side's counts are missing, else 0.

    A spell begins where a side's rate falls to about half between two samples while the other's stays, and ends where it doubles.
    """
    found = np.zeros_like(batch.wheels)
    for w in range(len(batch.first) - 1):
        inside = slice(batch.first[w], batch.first[w + 1])
        for side in (0, 1):
            found[inside, side] = _spells(batch.wheels[inside, side], batch.wheels[inside, 1 - side], batch.dt[inside])
    return found


def _spells(rate: FloatArray, other: FloatArray, dt: FloatArray) -> FloatArray:
    share = np.zeros_like(rate)
    n = len(rate)
    if n < 3:
        return share
    jumps = []  # (index, +1 for a rise, -1 for a fall)
    for i in range(1, n):
        before, after = rate[i - 1], rate[i]
        earlier, later = rate[max(i - 2, 0)], rate[min(i + 1, n - 1)]
        if abs(other[i] - other[i - 1]) > 0.15 * max(abs(other[i]), _LEAST_RATE) or before * after <= 0.0:
            continue
        # a step between two samples, level on both sides of it: no wheel accelerates so
        falls, rises = after / before, before / after
        level = _like(before, earlier) and _like(after, later)
        if level and abs(before) > _LEAST_RATE and _DROP[0] < falls < _DROP[1]:
            jumps.append((i, -1))
        elif level and abs(after) > _LEAST_RATE and _DROP[0] < rises < _DROP[1]:
            jumps.append((i, 1))
    # steps do not show while wheels hardly turn, so that every spell ends at a rest
    rests = np.flatnonzero(np.abs(rate) < REST_RATE_RAD_PER_S)
    spells = []
    start = None
    if jumps and jumps[0][1] == 1:
        before = rests[rests < jumps[0][0]]
        start = int(before[-1]) + 1 if len(before) else 0  # it was silent when the window began, or when the wheels began to turn
    for i, kind in jumps:
        if start is not None:
            spells.append((start, _until(rests, start, i)))
        start = i if kind == -1 else None
    if start is not None:
        spells.append((start, _until(rests, start, n)))
    for a, b in spells:
        if dt[a:b].sum() < _LONGEST_S:
            share[a:b] = 1.0
    return share


def _until(rests: IntArray, start: int, end: int) -> int:
    """``end``, or the first rest between it and ``start``."""
    between = rests[(rests > start) & (rests < end)]
    return int(between[0]) if len(between) else end


def _like(a: float, b: float) -> bool:
    """Nearly the same rate."""
    return abs(a - b) < 0.12 * max(abs(a), abs(b)) + 0.05
