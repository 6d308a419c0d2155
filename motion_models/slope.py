"""Slopes: how the ground tilts under a robot, in its body frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motion_models.motion import Twist
from motion_models.se2 import FloatArray

GRAVITY = 9.81
"""[m/s^2]"""


@dataclass(frozen=True)
class Slope:
    """Gravity on tilted ground, and the height at which it acts. Leading axes broadcast with those of wheels and CG."""

    downhill: FloatArray
    """(..., 2) gravity along the ground over that normal to it, in the body's x and y: its length is the tangent of the tilt [-]."""
    cg_height: float
    """Height of the centre of gravity above the ground [m]."""

    @classmethod
    def from_up(cls, up: FloatArray, cg_height: float) -> Slope:
        """From the vertical ``up`` (..., 3) in body axes, of any length; its z is positive."""
        return cls(np.asarray(-up[..., :2] / up[..., 2:]), cg_height)

    def samples(self, lead: tuple[int, ...]) -> FloatArray:
        """(n, 3) `downhill` and `cg_height` for the n samples of the leading axes ``lead``."""
        down = np.broadcast_to(np.asarray(self.downhill, dtype=np.float64), (*lead, 2)).reshape(-1, 2)
        return np.column_stack([down, np.full(len(down), float(self.cg_height))])


@dataclass(frozen=True)
class SlopeTwist:
    """Twist on a slope, with its derivatives by the slope."""

    twist: Twist
    d_downhill: FloatArray
    """(..., 3, 2) by `Slope.downhill`."""
    d_cg_height: FloatArray
    """(..., 3) by `Slope.cg_height`."""
