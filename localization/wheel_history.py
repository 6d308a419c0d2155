"""What the wheels did lately."""

from __future__ import annotations

import bisect

import numpy as np

from localization.events import CgSample, WheelSample
from motion_models.se2 import FloatArray

_NS = 1e-9


class WheelHistory:
    """The last seconds of wheel motion as intervals of constant rates, with the centre of gravity that held in each."""

    def __init__(self, cg: FloatArray, keep_s: float = 10.0) -> None:
        self._cg, self._cg_cov = cg, np.zeros((2, 2))
        self._keep_ns = int(keep_s / _NS)
        self._last: WheelSample | None = None
        self._ends: list[int] = []
        self._intervals: list[tuple[int, float, float, float, float]] = []  # start_ns, q_l, q_r, x_G, y_G

    @property
    def newest_ns(self) -> int | None:
        return None if self._last is None else self._last.stamp_ns

    def set_cg(self, sample: CgSample) -> None:
        self._cg, self._cg_cov = sample.position, sample.covariance

    @property
    def cg_cov(self) -> FloatArray:
        return self._cg_cov

    def push(self, sample: WheelSample) -> None:
        last, self._last = self._last, sample
        if last is None or sample.stamp_ns <= last.stamp_ns:
            return
        rates = (sample.position - last.position) / ((sample.stamp_ns - last.stamp_ns) * _NS)
        if not np.isfinite(rates).all():
            rates = np.nanmean([last.velocity, sample.velocity], axis=0)
        if not np.isfinite(rates).all():
            return
        self._ends.append(sample.stamp_ns)
        self._intervals.append((last.stamp_ns, rates[0], rates[1], self._cg[0], self._cg[1]))
        if self._ends[0] < sample.stamp_ns - 2 * self._keep_ns:
            n = bisect.bisect_left(self._ends, sample.stamp_ns - self._keep_ns)
            del self._ends[:n], self._intervals[:n]

    def window(self, start_ns: int, end_ns: int, max_hold_s: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Intervals (n,) [s], rates (n, 2), CG (n, 2) from ``start_ns`` to ``end_ns``, and the seconds that nothing is known of.

        Past the newest sample the last rates hold for at most ``max_hold_s``.
        """
        rows: list[tuple[float, float, float, float, float]] = []
        known = start_ns
        for i in range(bisect.bisect_right(self._ends, start_ns), len(self._ends)):
            begin, q_l, q_r, x, y = self._intervals[i]
            begin, end = max(begin, known), min(self._ends[i], end_ns)
            if end <= begin:
                break
            rows.append(((end - begin) * _NS, q_l, q_r, x, y))
            known = end
        covered = sum(row[0] for row in rows)
        if known < end_ns and self._ends:
            _, q_l, q_r, x, y = self._intervals[-1]
            hold = min(end_ns, self._ends[-1] + int(max_hold_s / _NS)) - max(known, self._ends[-1])
            if hold > 0:
                rows.append((hold * _NS, q_l, q_r, x, y))
                covered += hold * _NS
        table = np.array(rows).reshape(-1, 5)
        missing = max((end_ns - start_ns) * _NS - covered, 0.0)
        return table[:, 0], table[:, 1:3], table[:, 3:5], missing if missing > 1e-6 else 0.0
