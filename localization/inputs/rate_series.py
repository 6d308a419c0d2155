"""The last seconds of a turn rate, without spikes, and the turn between any two moments."""

from __future__ import annotations

import bisect

from localization.events import Turn

_NS = 1e-9
MAX_GAP_NS = 500_000_000
"""Time between samples over which no turn is interpolated [ns]: at 1 rad/s^2 it is off by 0.1 rad then."""
_MAX_HOLD_NS = 100_000_000
"""Time for which the newest rate is held [ns]: at 1 rad/s^2 the turn is off by 0.005 rad then."""
_SCATTER_SAMPLES = 25
"""Samples over which the scatter of the rates is measured: half a second of most drivers."""
_JUMP_RAD_PER_S, _JUMP_RAD_PER_S2, _MAX_JUMP_RAD_PER_S = 2.0, 200.0, 10.0
"""Change of the rate that is no spike: noise and shaking, how fast such a robot may begin to turn, and what none reaches."""
_MAX_SPIKES = 2
"""Spikes in a row that agree; a third is accepted."""


class RateSeries:
    """``keep_s`` seconds of a rate [rad/s] with white noise ``white_rad_per_sqrt_s``.

    Spike filter: a sample that differs from the last accepted one by more than 2 rad/s + 200 rad/s^2 dt (at most 10 rad/s) is held; three
    in a row that agree are accepted.
    """

    def __init__(self, white_rad_per_sqrt_s: float, keep_s: float) -> None:
        self._white, self._keep_ns = white_rad_per_sqrt_s, keep_s / _NS
        self._stamps: list[int] = []
        self._rates: list[float] = []
        self._angles: list[float] = []
        self._sum_squared_differences: list[float] = []  # second ones, of the rate
        self._pending: list[tuple[int, float]] = []
        self.spikes = 0
        """Samples that were left out."""

    def __len__(self) -> int:
        """Stored samples."""
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample; None before the first."""
        return self._stamps[-1] if self._stamps else None

    def restart(self) -> None:
        """Forget all samples."""
        self._reject()
        for column in (self._stamps, self._rates, self._angles, self._sum_squared_differences):
            column.clear()

    def insert(self, stamp_ns: int, rate: float) -> None:
        """Append a rate, or keep it pending until later ones agree with it."""
        if self._stamps and stamp_ns - self._stamps[-1] > MAX_GAP_NS:
            self.restart()
        if not self._stamps or _may_follow((self._stamps[-1], self._rates[-1]), (stamp_ns, rate)):
            self._reject()
            self._append(stamp_ns, rate)
            return
        if self._pending and not _may_follow(self._pending[-1], (stamp_ns, rate)):
            self._reject()
        self._pending.append((stamp_ns, rate))
        if len(self._pending) > _MAX_SPIKES:
            accepted, self._pending = self._pending, []
            if len(self._stamps) == 1:  # only the first sample contradicts them
                self.restart()
                self.spikes += 1
            for entry in accepted:
                self._append(*entry)

    def turn(self, start_ns: int, end_ns: int) -> Turn | None:
        """The turn from ``start_ns`` to ``end_ns``; None without a sample from before the start to (nearly) the end."""
        if not self._stamps or start_ns < self._stamps[0] or end_ns > self._stamps[-1] + _MAX_HOLD_NS:
            return None
        angle, dt = self._angle(end_ns) - self._angle(start_ns), (end_ns - start_ns) * _NS
        variance = self._white**2 * dt + self._sampling_variance(start_ns, end_ns)
        age_s = max(end_ns - self._stamps[-1], 0) * _NS
        of_rate = self._rate_variance(end_ns)
        first = max(len(self._stamps) - _SCATTER_SAMPLES, 0)
        period = (self._stamps[-1] - self._stamps[first]) * _NS / max(len(self._stamps) - 1 - first, 1)
        return Turn(angle, variance, dt, self._rate_at(end_ns), of_rate, of_rate * period * dt, age_s)

    def _append(self, stamp_ns: int, rate: float) -> None:
        angle = squares = 0.0
        if self._stamps:
            before, dt = self._rates[-1], (stamp_ns - self._stamps[-1]) * _NS
            angle = self._angles[-1] + 0.5 * (before + rate) * dt
            difference = rate - 2.0 * before + self._rates[-2] if len(self._stamps) > 1 else 0.0
            squares = self._sum_squared_differences[-1] + difference**2
        self._stamps.append(stamp_ns)
        self._rates.append(rate)
        self._angles.append(angle)
        self._sum_squared_differences.append(squares)
        if self._stamps[0] < stamp_ns - 2 * self._keep_ns:
            n = bisect.bisect_left(self._stamps, stamp_ns - self._keep_ns)
            del self._stamps[:n], self._rates[:n], self._angles[:n], self._sum_squared_differences[:n]

    def _reject(self) -> None:
        self.spikes += len(self._pending)
        self._pending = []

    def _angle(self, stamp_ns: int) -> float:
        past = stamp_ns - self._stamps[-1]
        if past > 0:
            return self._angles[-1] + self._rates[-1] * past * _NS
        return self._interpolate(self._angles, max(bisect.bisect_left(self._stamps, stamp_ns), 1), stamp_ns)

    def _rate_at(self, stamp_ns: int) -> float:
        """Between samples by interpolation, after the newest its own [rad/s]."""
        i = bisect.bisect_left(self._stamps, stamp_ns)
        return self._rates[0] if i == 0 else self._interpolate(self._rates, i, stamp_ns)

    def _interpolate(self, values: list[float], i: int, stamp_ns: int) -> float:
        """Between samples ``i`` - 1 and ``i``; the newest of the ``values`` after these."""
        if i >= len(values):
            return values[-1]
        part = (stamp_ns - self._stamps[i - 1]) / (self._stamps[i] - self._stamps[i - 1])
        return values[i - 1] + part * (values[i] - values[i - 1])

    def _rate_variance(self, stamp_ns: int) -> float:
        """Variance of `_rate_at` [rad^2/s^2]: white noise sigma gives second differences the variance 6 sigma^2; shaking adds to both."""
        j = min(bisect.bisect_left(self._stamps, stamp_ns), len(self._stamps) - 1)
        i = max(j - _SCATTER_SAMPLES, 0)
        squares = self._sum_squared_differences[j] - self._sum_squared_differences[i]
        return squares / 6.0 / (j - i) if j > i else 0.0

    def _sampling_variance(self, start_ns: int, end_ns: int) -> float:
        """Variance of the turn [rad^2] by what the rate does between samples: shaking, wheels that slip by jerks.

        A white rate of density q [rad^2/s], sampled every dt as the mean over 2 dt around the stamp: second differences have the variance
        q / dt, and the sum of trapezoids errs by q dt / 8 at each end. White noise of the gyro adds 6 sigma^2 / dt to the former.
        """
        last = len(self._stamps) - 1
        i = min(bisect.bisect_right(self._stamps, start_ns) - 1, last)
        j = min(bisect.bisect_left(self._stamps, end_ns), last)
        if j <= i:
            return 0.0
        dt = (self._stamps[j] - self._stamps[i]) / (j - i) * _NS
        noise = 6.0 * self._white**2 / dt
        squares = self._sum_squared_differences[j] - self._sum_squared_differences[i]
        return 0.25 * dt**2 * max(squares / (j - i) - noise, 0.0)


def _may_follow(before: tuple[int, float], after: tuple[int, float]) -> bool:
    """Whether a robot's rate can be ``after`` [ns, rad/s] where it was ``before``."""
    return abs(after[1] - before[1]) <= min(_JUMP_RAD_PER_S + _JUMP_RAD_PER_S2 * (after[0] - before[0]) * _NS, _MAX_JUMP_RAD_PER_S)
