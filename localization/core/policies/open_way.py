"""Ways that wheels alone measure: along a bare corridor nothing shows that they spin, or that the robot is pushed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from localization.events import Step
from localization.messages import Message, message
from motion_models.se2 import Cov3

_OPEN_M2 = 1.0
"""Variance of a scan along the robot's axis, from which on it leaves the way open [m^2]; a door frame in view holds it to 3 cm."""
_WAY_FACTOR_SIGMA = 1.0 / 9.0
"""Sigma of a factor on the wheels' way, which lasts: wheels that spin by half all along count a third too much, 3 sigma."""
_PUSH_SIGMA_M, _PUSH_S = 4.0 / 3.0, 20.0
"""Sigma of pushes along an open way, and the time in which it grows to that, so that short stretches have little [m, s]: a push of 4 m, as
in the corridors of `tests.helpers.corridors`, is 3 sigma."""
_MIN_REPORTED_M = 10.0
"""Shortest way by wheels alone that is reported [m]."""


class _Stretch(NamedTuple):
    """A way without a scan that shows it."""

    begin_s: float
    way_m: float
    seconds: float

    @property
    def variance(self) -> float:
        """Along the way, by a factor that lasts and by pushes [m^2]."""
        return (_WAY_FACTOR_SIGMA * self.way_m) ** 2 + (_PUSH_SIGMA_M * min(self.seconds / _PUSH_S, 1.0)) ** 2


class OpenWay:
    """`cov` of each step, then `add_scan` for each matched scan.

    The variance of a stretch grows with the square of its way, as that of one factor does, and is carried by the pose's covariance. While
    wheels, gyro and accelerometer all measure rest, nothing pushes the robot.
    """

    def __init__(self) -> None:
        self._now: _Stretch | None = None
        self._longest: _Stretch | None = None
        self._first_ns: int | None = None

    def cov(self, step: Step) -> Cov3:
        """(3, 3) of the motion in ``step``, by slip and pushes that no scan shows."""
        self._first_ns = step.start_ns if self._first_ns is None else self._first_ns
        cov, now = np.zeros((3, 3)), self._now
        if now is None or not step.has_wheels or step.rested_s:
            return cov
        way = math.hypot(step.predicted.delta[0], step.predicted.delta[1])
        self._now = _Stretch(now.begin_s, now.way_m + way, now.seconds + step.duration)
        cov[0, 0] = self._now.variance - now.variance
        if self._longest is None or self._now.way_m > self._longest.way_m:
            self._longest = self._now
        return cov

    def add_scan(self, R: Cov3, step: Step) -> None:
        """The scan at the end of ``step`` was matched, with the covariance ``R`` (3, 3) of its pose alone."""
        if R[0, 0] < _OPEN_M2:
            self._now = None
        elif self._now is None and self._first_ns is not None:
            self._now = _Stretch((step.end_ns - self._first_ns) * 1e-9, 0.0, 0.0)

    def warnings(self) -> list[Message]:
        """The longest way by wheels alone."""
        longest = self._longest
        if longest is None or longest.way_m < _MIN_REPORTED_M:
            return []
        sigma_m = math.sqrt(longest.variance)
        return [message("corridor.by_wheels", way_m=longest.way_m, begin_s=longest.begin_s, sigma_m=sigma_m)]
