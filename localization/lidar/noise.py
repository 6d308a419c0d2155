"""How far points are off the map's lines, as the scans themselves show it: the noise of one point, and that of a whole line.

An analysis of variance: points that meet a line in one cell of the map scatter about their mean by the noise of a point; the means of
cells scatter by the lines' own errors, which all points there share. A scanner of centimetres and one of millimetres need no other
settings, and a map drawn badly says so.
"""

from __future__ import annotations

import math

import numpy as np

from localization.lidar.lines import Spread

_KEPT = 0.98  # of what is known, from scan to scan: the last 50 count
_POINTS, _CELLS = 500.0, 20.0  # as much as is known beforehand, in degrees of freedom: about one scan
_POSE = 3.0  # degrees of freedom that go into the pose
_LEAST_M = 1e-3


class Noise:
    """Begins with what is usual, and follows what is seen."""

    def __init__(self, sigma_point: float, sigma_line: float, cells: float = _CELLS) -> None:
        """Sigmas [m]; the second is believed as if ``cells`` lines had shown it."""
        self._sums = np.array([_POINTS * sigma_point**2, _POINTS, cells * sigma_line**2, cells])

    @property
    def sigma_point(self) -> float:
        """Of one point about its line [m]."""
        return max(math.sqrt(self._sums[0] / self._sums[1]), _LEAST_M)

    @property
    def sigma_line(self) -> float:
        """Of a line of the map, shared by all points that meet it in one cell [m]."""
        return max(math.sqrt(max(self._sums[2], 0.0) / self._sums[3]), _LEAST_M)

    def see(self, spread: Spread) -> None:
        """One more scan."""
        if spread.between_freedom > 2.0 * _POSE:
            new = np.array([spread.within, spread.within_freedom, spread.between, spread.between_freedom - _POSE])
            self._sums = _KEPT * self._sums + new
