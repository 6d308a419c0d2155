"""How far points are off the map's lines, as the scans themselves show it: the noise of one point, and that of a whole line.

An analysis of variance: points that meet a line in one cell of the map scatter about their mean by the noise of a point; the means of
cells scatter by the lines' own errors, which all points there share. A scanner of centimetres and one of millimetres need no other
settings, and a map drawn badly says so.
"""

from __future__ import annotations

import math

import numpy as np

from localization.lidar.lines import Spread
from motion_models.se2 import FloatArray

_KEPT = 0.9
_GUESSED = 0.5  # of what was only guessed, from scan to scan
_USUAL = 2.0
_POSE = 3.0  # degrees of freedom that go into the pose
_LEAST_M, _LEAST_LINE_M, _LEAST_PART = 1e-3, 1e-4, 0.1


class Noise:
    """Begins with what is usual, worth one point and one line (unit information), and follows what is seen."""

    def __init__(self, sigma_point: float, sigma_line: float) -> None:
        """Sigmas [m] that are guessed."""
        self._guess = np.array([sigma_point**2, 1.0, sigma_line**2, 1.0, 0.0])
        self._seen = np.zeros(5)

    @property
    def _sums(self) -> FloatArray:
        return self._guess + self._seen

    @property
    def sigma_point(self) -> float:
        """Of one point about its line [m]."""
        squares, freedom, *_ = self._sums
        return max(math.sqrt(squares / freedom), _LEAST_M)

    @property
    def sigma_line(self) -> float:
        """Of a line of the map beyond `place_part`, shared by all points that meet it in one cell [m]."""
        _, _, squares, freedom, place = self._sums
        return max(math.sqrt(max(squares - place, 0.0) / freedom), _LEAST_LINE_M)

    @property
    def place_part(self) -> float:
        """Which part of the error that a line would have if the map's points scattered by chance it has."""
        _, _, squares, _, place = self._sums
        return 1.0 if squares >= place else max(squares / place, _LEAST_PART)

    def see(self, spread: Spread) -> None:
        """One more scan."""
        freedom = spread.between_freedom - _POSE
        if freedom > _POSE:
            # the pose takes its part of all that moves the groups' means, whatever it comes from
            left = freedom / spread.between_freedom
            expected = left * (spread.noise + self.place_part * spread.place) + freedom * self.sigma_line**2
            between = min(spread.between, expected * (1.0 + _USUAL * math.sqrt(2.0 / freedom)))
            new = np.array([spread.within, spread.within_freedom, between - left * spread.noise, freedom, left * spread.place])
            self._seen = _KEPT * self._seen + new
            self._guess = _GUESSED * self._guess
