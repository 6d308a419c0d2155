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

_KEPT = 0.85  # of what is known, from scan to scan: the last 7 count, for a map grows surer while it is drawn
_GUESSED = 0.5  # of what was only guessed, from scan to scan
_RIDGE = 0.002  # where all walls are seen alike, who knows which way points are off
_POSE = 3.0  # degrees of freedom that go into the pose
_LEAST_M, _LEAST_LINE_M, _LEAST_PART = 1e-3, 1e-4, 0.1


class Noise:
    """Begins with what is usual, worth one point and one line (unit information), and follows what is seen."""

    def __init__(self, sigma_point: float, sigma_line: float) -> None:
        """Sigmas [m] that are guessed."""
        self._guess = np.array([sigma_point**2, 1.0, 0.0, 0.0, 0.0, sigma_line**2, 1.0, 0.0])
        self._seen = np.zeros(8)

    @property
    def _sums(self) -> FloatArray:
        return self._guess + self._seen

    @property
    def sigmas_of_a_point(self) -> tuple[float, float]:
        """About its line [m]: whichever way its beam came, and further along the beam. By weighted least squares of groups' squares over
        the squared cosine between beam and normal, neither below zero."""
        squares, freedom, facing, facing_squared, squares_facing, *_ = self._sums
        slope = squares_facing - facing * squares / freedom
        along = max(slope / (facing_squared - facing * facing / freedom + _RIDGE * freedom), 0.0)
        across = (squares - along * facing) / freedom
        if across < 0.0:
            across, along = 0.0, squares_facing / facing_squared
        return max(math.sqrt(across), _LEAST_M), math.sqrt(along)

    @property
    def sigma_line(self) -> float:
        """Of a line of the map beyond `place_part`, shared by all points that meet it in one cell [m]."""
        *_, squares, freedom, place = self._sums
        return max(math.sqrt(max(squares - place, 0.0) / freedom), _LEAST_LINE_M)

    @property
    def place_part(self) -> float:
        """Which part of the error that a line would have if the map's points scattered by chance it has."""
        *_, squares, _, place = self._sums
        return 1.0 if squares >= place else max(squares / place, _LEAST_PART)

    def see(self, spread: Spread) -> None:
        """One more scan."""
        freedom = spread.between_freedom - _POSE
        if freedom > _POSE:
            # the pose takes its part of all that moves the groups' means, and a larger one of errors that neighbours have in common
            left = freedom / spread.between_freedom
            left_of_place = max(1.0 - _POSE * spread.alike / spread.between_freedom, 0.0)
            of_points = [spread.within, spread.within_freedom, spread.facing, spread.facing_squared, spread.within_facing]
            new = np.array([*of_points, spread.between - left * spread.noise, freedom, left_of_place * spread.place])
            self._seen = _KEPT * self._seen + new
            self._guess = _GUESSED * self._guess
