"""KISS-ICP's adaptive threshold with a state that can be written down: theirs is in C++ and cannot be read.

How far the pose was off its guess lately says how far to search (Vizzo et al., RA-L 2023, eq. 5 to 7).
"""

from __future__ import annotations

import math

import numpy as np

from motion_models.se2 import FloatArray


class AdaptiveThreshold:
    """Same methods as kiss-icp's class of this name."""

    def __init__(self, initial: float, least_motion: float, max_range: float) -> None:
        """``initial`` [m]; deviations below ``least_motion`` [m] do not count; turns count by what they move at ``max_range`` [m]."""
        self._least, self._max_range = least_motion, max_range
        self._squares, self._count = initial**2, 1

    def get_threshold(self) -> float:
        """Sigma of the deviation [m]."""
        return math.sqrt(self._squares / self._count)

    def update_model_deviation(self, model_deviation: FloatArray) -> None:
        """``model_deviation`` (4, 4): guess^-1 @ pose."""
        R = model_deviation[:3, :3]
        skew = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        angle = math.atan2(float(np.linalg.norm(skew)), 0.5 * (float(np.trace(R)) - 1.0))
        error = 2.0 * self._max_range * math.sin(0.5 * angle) + float(np.linalg.norm(model_deviation[:3, 3]))
        if error > self._least:
            self._squares += error * error
            self._count += 1
