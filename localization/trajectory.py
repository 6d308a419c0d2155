"""A trajectory: poses over time with their covariance, read from and written to TUM files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Trajectory:
    """Poses ``world_T_body`` in order of time."""

    stamps_ns: NDArray[np.int64]
    """(N,) strictly increasing."""
    poses: FloatArray
    """(N, 3) x, y, theta [m, m, rad]."""
    covariances: FloatArray | None = None
    """(N, 3, 3) of the right (body-frame) perturbation, or None where nothing is known of it."""

    def __len__(self) -> int:
        return len(self.stamps_ns)
