"""The last seconds of the wheels' motion."""

from __future__ import annotations

import bisect
from collections import deque
from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from localization.events import CgSample, WheelSample
from motion_models.se2 import FloatArray

_NS = 1e-9
_HELD_PERIODS = 2.0
"""For how many periods of the wheels the last rates are held, where that is longer than the settings' time: one sample was lost."""
_PERIODS = 51
"""Last intervals between samples, of which the period is the median: pauses among them do not count."""


class WheelInterval(NamedTuple):
    """Constant rates from one sample to the next."""

    start_ns: int
    left: float
    """[rad/s]"""
    right: float
    """[rad/s]"""
    x: float
    """x of the centre of gravity [m]."""
    y: float
    """y of the centre of gravity [m]."""
    has_angles: bool
    """The rates are differences of angles, and give all of the motion in the interval."""


class WheelWindow(NamedTuple):
    """Rates of the wheels over a time, in pieces of constant rates."""

    dt: FloatArray
    """(n,) duration of each piece [s]."""
    rates: FloatArray
    """(n, 2) left and right [rad/s]."""
    cg: FloatArray
    """(n, 2) centre of gravity [m]."""
    inside: FloatArray
    """(n, 3) where each piece is in its interval between two samples: length of that and start of the piece in it [s], and 1 where angles
    at both ends measure its whole motion, else 0."""
    missing: float
    """Time without data [s]."""


class WheelBuffer:
    """The last seconds of wheel motion as intervals of constant rates, with the centre of gravity that held in each.

    ``cg`` (2,) holds from the start on [m]; after ``keep_s`` [s] intervals are dropped.
    """

    def __init__(self, cg: FloatArray, keep_s: float = 10.0) -> None:
        self.cg = cg
        """(2,) CG of the samples to come [m]."""
        self.cg_cov: FloatArray = np.zeros((2, 2))
        """(2, 2) covariance of the CG [m^2]."""
        self._keep_ns = int(keep_s / _NS)
        self._last: WheelSample | None = None
        self.first_ns: int | None = None
        """Stamp of the first sample; None before that."""
        self.newest_ns: int | None = None
        """Stamp of the newest sample; None before the first."""
        self.rates_known_until_ns: int | None = None
        """Up to when rates are known; None before two samples."""
        self._ends: list[int] = []
        self._intervals: list[WheelInterval] = []
        self._lengths_ns: deque[int] = deque(maxlen=_PERIODS)
        self.period_s = 0.0
        """Median time from sample to sample [s]; 0 before the second."""

    def __len__(self) -> int:
        """Stored intervals."""
        return len(self._intervals)

    def set_cg(self, sample: CgSample) -> None:
        """Set the CG of the samples to come."""
        self.cg, self.cg_cov = sample.position, sample.covariance

    def insert(self, sample: WheelSample) -> None:
        """Store the next sample. One that does not come after the newest, or has no number for a side, changes nothing."""
        self.first_ns = sample.stamp_ns if self.first_ns is None else self.first_ns
        # plain numbers: numpy takes five times as long on two of them, and this is done for every message of the wheels
        (p_left, p_right), (v_left, v_right) = sample.position.tolist(), sample.velocity.tolist()
        if not ((isfinite(p_left) or isfinite(v_left)) and (isfinite(p_right) or isfinite(v_right))):
            return
        last = self._last
        if last is not None and sample.stamp_ns <= last.stamp_ns:  # its motion is in the next sample's angles as well
            return
        self._last, self.newest_ns = sample, sample.stamp_ns
        if last is None:
            return
        seconds = (sample.stamp_ns - last.stamp_ns) * _NS
        before_left, before_right = last.position.tolist()
        left, right = (p_left - before_left) / seconds, (p_right - before_right) / seconds
        has_angles = isfinite(left) and isfinite(right)
        if not has_angles:
            before_left, before_right = last.velocity.tolist()
            left, right = _mean_of_known(v_left, before_left), _mean_of_known(v_right, before_right)
        if not (isfinite(left) and isfinite(right)):
            return
        self._ends.append(sample.stamp_ns)
        self._lengths_ns.append(sample.stamp_ns - last.stamp_ns)
        self.period_s = sorted(self._lengths_ns)[(len(self._lengths_ns) - 1) // 2] * _NS
        self.rates_known_until_ns = sample.stamp_ns
        x, y = self.cg.tolist()
        self._intervals.append(WheelInterval(last.stamp_ns, left, right, x, y, has_angles))
        if self._ends[0] < sample.stamp_ns - 2 * self._keep_ns:
            n = bisect.bisect_left(self._ends, sample.stamp_ns - self._keep_ns)
            del self._ends[:n], self._intervals[:n]

    def end_of_interval(self, stamp_ns: int) -> int | None:
        """Stamp of the sample that ends the interval around ``stamp_ns`` [ns]; None past the newest."""
        i = bisect.bisect_left(self._ends, stamp_ns)
        return self._ends[i] if i < len(self._ends) and self._intervals[i].start_ns <= stamp_ns else None

    def at(self, stamp_ns: int, max_hold_s: float) -> tuple[FloatArray, FloatArray]:
        """Rates (n, 2) and CG (n, 2) of the interval at ``stamp_ns``, else of the next or the last one; n = 0 where that is farther away
        than rates are held."""
        i = min(bisect.bisect_right(self._ends, stamp_ns), len(self._ends) - 1)
        is_known, hold_ns = False, round(max(max_hold_s, _HELD_PERIODS * self.period_s) / _NS)
        if i >= 0:
            start_ns, end_ns, has_angles = self._intervals[i].start_ns, self._ends[i], self._intervals[i].has_angles
            known_until_ns = end_ns + hold_ns if has_angles or stamp_ns > end_ns else start_ns + hold_ns
            is_known = start_ns - hold_ns <= stamp_ns <= known_until_ns
        table = np.array(self._intervals[i][1:5] if is_known else ()).reshape(-1, 4)
        return table[:, :2], table[:, 2:]

    def window(self, start_ns: int, end_ns: int, max_hold_s: float) -> WheelWindow:
        """Rates from ``start_ns`` to ``end_ns``.

        Angles at both ends of an interval measure its motion, however long it is. Rates hold for at most ``max_hold_s``, or two periods of
        the wheels, be it past the newest sample or between two of them.
        """
        hold_ns = round(max(max_hold_s, _HELD_PERIODS * self.period_s) / _NS)
        rows: list[tuple[float, ...]] = []
        known, covered = start_ns, 0.0
        for i in range(bisect.bisect_right(self._ends, start_ns), len(self._ends)):
            interval, end = self._intervals[i], min(self._ends[i], end_ns)
            if interval.start_ns >= end_ns:
                break
            begin, end = max(interval.start_ns, known), end if interval.has_angles else min(end, interval.start_ns + hold_ns)
            if end <= begin:
                continue
            inside = (self._ends[i] - interval.start_ns) * _NS, (begin - interval.start_ns) * _NS, float(interval.has_angles)
            rows.append(((end - begin) * _NS, *interval[1:5], *inside))
            covered += (end - begin) * _NS
            known = end
        if known < end_ns and self._ends:
            begin = max(known, self._ends[-1])
            hold = min(end_ns, self._ends[-1] + hold_ns) - begin
            if hold > 0:
                rows.append((hold * _NS, *self._intervals[-1][1:5], inf, (begin - self._ends[-1]) * _NS, 0.0))
                covered += hold * _NS
        table = np.array(rows).reshape(-1, 8)
        missing = max((end_ns - start_ns) * _NS - covered, 0.0)
        return WheelWindow(table[:, 0], table[:, 1:3], table[:, 3:5], table[:, 5:], missing if missing > 1e-6 else 0.0)


def _mean_of_known(one: float, other: float) -> float:
    """The mean of those of two that are finite; not finite where neither is."""
    if not isfinite(one):
        return other
    return 0.5 * (one + other) if isfinite(other) else one
