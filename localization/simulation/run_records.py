"""What truly happened in the named parts of a drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localization.simulation.drives import OpenLoop, Route
from motion_models.se2 import FloatArray

RUN_HZ = 20.0


@dataclass(frozen=True, eq=False)
class RunRecord:
    """What truly happened in one named phase, 20 times a second from the body's rest before it to its rest after it."""

    name: str
    start_s: float
    """[s] since the simulation's beginning."""
    poses: FloatArray
    """(n, 3) of the body in the world."""
    wheel_angles: FloatArray
    """(n, 2) left and right, exact [rad]."""
    cg: FloatArray
    """(n, 2) true CG [m]."""
    nominal_cg: FloatArray
    """(2,) as the robot knew it [m]."""
    command: OpenLoop | Route

    @property
    def times_s(self) -> FloatArray:
        """(n,) since the start of the run."""
        return np.asarray(np.arange(len(self.poses)) / RUN_HZ)
