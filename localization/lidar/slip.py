"""By how much the robot moves otherwise than its wheels say, now: for the motion within a sweep, which no scan has measured yet.

Slip lasts for a while, so what the last scans saw of it holds for the sweep that is being matched. Three scalar Kalman filters, whose state
returns to zero within `LASTS_S` (an Ornstein-Uhlenbeck process of the variance that the wheels' own noise says).
"""

from __future__ import annotations

import math

import numpy as np

from motion_models.se2 import FloatArray

LASTS_S = 0.5
_SURPRISE = 9.0  # squared sigmas beyond which slip began anew: the wheels' noise does not know of wheels that spin on the spot


class Slip:
    """State in, state out."""

    def __init__(self) -> None:
        self.rate, self._variance, self._usual = np.zeros(3), np.zeros(3), np.zeros(3)

    def advance(self, duration: float, cov: FloatArray, unheard: FloatArray) -> None:
        """``duration`` [s] have passed, in which the wheels' motion had ``cov`` (3, 3), or the twist the variance ``unheard`` (3,) if they
        were not heard, else zero."""
        if duration <= 0.0:
            return
        stays = math.exp(-duration / LASTS_S)
        self._usual = usual = unheard if unheard.any() else np.diag(cov) / (2.0 * LASTS_S * duration)
        self.rate = stays * self.rate
        self._variance = stays**2 * self._variance + (1.0 - stays**2) * usual

    def variance_in(self, seconds: float) -> FloatArray:
        """(3,) of `rate` as that of the slip so much later."""
        stays = math.exp(-2.0 * seconds / LASTS_S)
        return np.asarray(stays * self._variance + (1.0 - stays) * self._usual)

    def measure(self, rate: FloatArray, variance: FloatArray) -> FloatArray:
        """The mean slip (3,) [m/s, m/s, rad/s] of the time that has passed was ``rate``, with ``variance`` (3,)."""
        off = rate - self.rate
        expected = self._variance + variance
        self._variance = self._variance + np.where(off**2 > _SURPRISE * expected, off**2, 0.0)
        gain = self._variance / (self._variance + variance)
        self.rate = self.rate + gain * off
        self._variance = (1.0 - gain) * self._variance
        return np.asarray(gain)
