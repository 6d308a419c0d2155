"""What an engine is: it plays the wheel rates of windows and returns the motion that they make."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from localization.twin.windows import Window
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Touch:
    """How the wheels stand on the ground while the robot drives."""

    airborne: FloatArray
    """(W,) share of the time that a wheel is in the air, mean over the wheels of each window."""
    shares: FloatArray
    """(n + 1,) share of the time steps in which 0, 1, ... n wheels touch."""
    load_scatter: float
    """Standard deviation of a wheel's load from step to step over its mean [-]; NaN where loads are not known."""

    @property
    def all_wheels(self) -> float:
        """Share of the time steps in which all wheels touch."""
        return float(self.shares[-1])

    def describe(self) -> str:
        """One sentence.

        >>> import numpy as np
        >>> Touch(np.zeros(1), np.array([0.0, 0.0, 0.1, 0.5, 0.4]), 0.8).describe()
        'all four wheels touch in 40 % of the time steps; their loads scatter by 80 %'
        """
        numbers = {2: "two", 3: "three", 4: "four", 6: "six", 8: "eight"}
        count = len(self.shares) - 1
        scatter = "" if math.isnan(self.load_scatter) else f"; their loads scatter by {100 * self.load_scatter:.0f} %"
        return f"all {numbers.get(count, str(count))} wheels touch in {100 * self.all_wheels:.0f} % of the time steps{scatter}"


@dataclass(frozen=True)
class Played:
    """Motion of W windows in an engine."""

    poses: FloatArray
    """(W, 3) of the body frame at the end of each window, relative to its start [m, m, rad]."""
    rates: FloatArray
    """(W, 2) mean rates of the left and the right wheels [rad/s]."""
    touch: Touch
    """How the wheels stood on the ground meanwhile."""
    steps: int
    """Time steps that were computed."""


class Engine(Protocol):
    """A robot in a simulator, ready to drive."""

    def play(self, windows: Sequence[Window]) -> Played:
        """Play each window from its lead on. Raises `SimulationError` where the robot flies, falls or does not stay finite."""
