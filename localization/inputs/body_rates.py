"""Turns about all three axes of the body, by the gyro of an IMU whose mount is known."""

from __future__ import annotations

import bisect
from collections.abc import Mapping

import numpy as np

from localization.events import BodyTurn, ImuSample, Scan
from motion_models.robot import GyroNoise, Mount
from motion_models.se2 import FloatArray

_NS = 1e-9
_KEEP_NS = 10_000_000_000
_SWEEP_TIMES = 21
"""Moments of a sweep at which its turns are known: 5 ms apart at 10 Hz, half the time between samples of most drivers."""
_MAX_GAP_NS, _MAX_HOLD_NS = 500_000_000, 100_000_000


class BodyRates:
    """The last seconds of the rates about the body's axes."""

    def __init__(self, noise: GyroNoise, mounts: Mapping[str, Mount]) -> None:
        self._noise, self._mounts = noise, mounts
        self._frame: str | None = None
        self._stamps: list[int] = []
        self._rates: list[FloatArray] = []
        self._angles: list[FloatArray] = []

    def insert(self, sample: ImuSample) -> None:
        """Take the next sample of the first IMU whose mount is known; one that does not come after the newest changes nothing."""
        if self._frame is None and sample.frame_id in self._mounts:
            self._frame, self._rotation = sample.frame_id, self._mounts[sample.frame_id].rotation
        if sample.frame_id != self._frame or (self._stamps and sample.stamp_ns <= self._stamps[-1]):
            return
        if self._stamps and sample.stamp_ns - self._stamps[-1] > _MAX_GAP_NS:
            self._stamps, self._rates, self._angles = [], [], []
        rate = self._rotation @ sample.angular_velocity
        if self._stamps:
            dt = (sample.stamp_ns - self._stamps[-1]) * _NS
            self._angles.append(self._angles[-1] + 0.5 * dt * (self._rates[-1] + rate))
        else:
            self._angles.append(np.zeros(3))
        self._stamps.append(sample.stamp_ns)
        self._rates.append(rate)
        if self._stamps[0] < sample.stamp_ns - 2 * _KEEP_NS:
            n = bisect.bisect_left(self._stamps, sample.stamp_ns - _KEEP_NS)
            del self._stamps[:n], self._rates[:n], self._angles[:n]

    def turn(self, start_ns: int, end_ns: int, scan: Scan | None) -> BodyTurn | None:
        """From ``start_ns`` to ``end_ns``, and through the sweep of ``scan``, whose middle is the end; None where the gyro has no sample
        from before the start to (nearly) the end. After the newest sample its rate is held."""
        if not self._stamps or start_ns < self._stamps[0] or end_ns > self._stamps[-1] + _MAX_HOLD_NS:
            return None
        before, after = self._at(start_ns), self._at(end_ns)
        half_s = 0.5 * float(np.ptp(scan.offsets)) if scan is not None and len(scan.offsets) else 0.0
        dt, times = (end_ns - start_ns) * _NS, np.linspace(-half_s, half_s, _SWEEP_TIMES)
        turned = [self._at(end_ns + round(t / _NS)) - after for t in times.tolist()]
        return BodyTurn(after - before, self._noise.white_rad_per_sqrt_s**2 * dt, dt, np.column_stack([times, turned]))

    def _at(self, stamp_ns: int) -> FloatArray:
        """Angles (3,) by interpolation; after the newest sample its rate is held."""
        i = bisect.bisect_left(self._stamps, stamp_ns)
        if i == len(self._stamps):
            return self._angles[-1] + (stamp_ns - self._stamps[-1]) * _NS * self._rates[-1]
        if i == 0:
            return self._angles[0]
        dt, span = (stamp_ns - self._stamps[i - 1]) * _NS, (self._stamps[i] - self._stamps[i - 1]) * _NS
        rate = self._rates[i - 1] + dt / span * (self._rates[i] - self._rates[i - 1])
        return self._angles[i - 1] + 0.5 * dt * (self._rates[i - 1] + rate)
