"""Angles of wheels as messages have them: on a circle, restarted, or of two publishers by turns; and as sums of increments."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from motion_models.se2 import FloatArray

BoolArray = NDArray[np.bool_]

_RESET_FACTOR = 8.0
"""Increment of a wheel's angle over the 97th percentile of all, from where on it is a reset or a counter that wrapped, no motion."""
_IS_ONE, _IS_AGAIN = math.log(0.5), math.log(0.05)
"""Logarithms of the probabilities that a reading is of the one or the other publisher, and that the slower one publishes twice running."""
_ARE_TWO = math.log(1e-4)
"""Logarithm of the prior odds that two publishers share a topic."""


def on_circle(angles: FloatArray, period_rad: float) -> FloatArray:
    """``angles`` (m, c) with the turns added that wheels lost whose angles stay within one period, as those on (-pi, pi] do."""
    found = angles.copy()
    for column in found.T:
        known = np.isfinite(column)
        if known.any() and np.ptp(column[known]) <= period_rad * (1.0 + 1e-6):
            column[known] = np.unwrap(column[known], period=period_rad)
    return found


def of_one_publisher(angles: FloatArray) -> BoolArray:
    """(m,) which readings of ``angles`` (m, c) are of one publisher: of two, of the one whose wheels turn more.

    Of two publishers each goes on from its own last readings: its increments change by less than those from reading to reading do, and by
    more than it costs to label each reading. Changes have a Cauchy density: a restart is one large change.
    """
    every = np.ones(len(angles), bool)
    if not np.isfinite(angles).all() or len(angles) < 4:
        return every
    is_second, by_two, turned = _by_nearest(angles)
    by_one = np.abs(np.diff(angles, 2, axis=0))
    sizes = np.abs(np.diff(angles, axis=0))
    encoder_step = float(sizes[sizes > 0.0].min()) if (sizes > 0.0).any() else 1.0
    scale = float(np.median(by_two)) + encoder_step
    of_changes = float(np.log1p((by_one / scale) ** 2).sum() - np.log1p((by_two / scale) ** 2).sum())
    fewer = is_second if is_second.sum() < 0.5 * len(is_second) else ~is_second
    of_labels = (len(fewer) - float(fewer.sum())) * _IS_ONE + float((fewer[1:] & fewer[:-1]).sum()) * _IS_AGAIN
    if of_changes + of_labels + _ARE_TWO < 0.0:
        return every
    return is_second if turned[1] > turned[0] else ~is_second


def _by_nearest(angles: FloatArray) -> tuple[BoolArray, FloatArray, list[float]]:
    """Each of ``angles`` (m, c) to that of two publishers who would be nearest if its wheels turned on: (m,) whether it is the second's,
    (m, c) changes of its increments, and how far the wheels of each have turned. It begins where they are farthest apart."""
    rows = angles.tolist()
    begin = int(np.abs(np.diff(angles, axis=0)).sum(axis=1).argmax())
    labels, changes, turned = np.zeros(len(rows), bool), np.zeros(angles.shape), [0.0, 0.0]
    labels[begin + 1] = True
    for order in (range(begin + 2, len(rows)), range(begin - 1, -1, -1)):
        beside, next_ = [rows[begin], rows[begin + 1]], [rows[begin], rows[begin + 1]]
        for at in order:
            row = rows[at]
            far = [[abs(a - b) for a, b in zip(row, expected, strict=True)] for expected in next_]
            i = int(sum(far[1]) < sum(far[0]))
            turned[i] += sum(abs(a - b) for a, b in zip(row, beside[i], strict=True))
            next_[i] = [2.0 * a - b for a, b in zip(row, beside[i], strict=True)]
            beside[i] = row
            labels[at], changes[at] = bool(i), far[i]
    return labels, changes, turned


def jumps(values: FloatArray, is_known: BoolArray) -> FloatArray:
    """(m, 2) row and size of the finite steps of ``values`` (n, c) that are no motion."""
    steps = np.diff(values, axis=0)
    rows, columns = np.nonzero(np.isfinite(steps) & ~is_known)
    return np.column_stack([rows.astype(float), steps[rows, columns]])


def without_resets(values: FloatArray) -> tuple[FloatArray, BoolArray]:
    """``values`` (m, c) without steps that no motion explains, and (m - 1, c) where they are known."""
    steps = np.diff(values, axis=0)
    known = np.isfinite(steps)
    sizes = np.abs(steps[known])
    usual = float(np.percentile(sizes[sizes > 0.0], 97.0)) if (sizes > 0.0).any() else math.inf
    known &= np.abs(np.nan_to_num(steps)) <= _RESET_FACTOR * usual
    first = np.nan_to_num(values[:1])
    return np.vstack([first, first + np.cumsum(np.where(known, steps, 0.0), axis=0)]), known
