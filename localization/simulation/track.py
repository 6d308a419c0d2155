"""The last seconds of the true motion, from which sensors read."""

from __future__ import annotations

import numba
import numpy as np

from localization.simulation.vehicle import COLUMNS
from motion_models.se2 import FloatArray


class Track:
    """Records of the vehicle at even steps, linear in between. Steps are milliseconds long: linear is exact to micrometres."""

    def __init__(self, first: FloatArray, step_s: float) -> None:
        self.step_s = step_s
        self.first_step = 0
        self.rows = np.array(first, dtype=float).reshape(1, COLUMNS)

    @property
    def end_s(self) -> float:
        """Up to when the motion is known [s]."""
        return (self.first_step + len(self.rows) - 1) * self.step_s

    @property
    def start_s(self) -> float:
        return self.first_step * self.step_s

    def append(self, rows: FloatArray) -> None:
        self.rows = np.concatenate([self.rows, rows])

    def forget(self, before_s: float) -> None:
        """Drop what lies before ``before_s``, but never the last record."""
        drop = min(int(before_s / self.step_s) - self.first_step, len(self.rows) - 1)
        if drop > 0:
            self.rows = self.rows[drop:]
            self.first_step += drop

    def at(self, times_s: FloatArray) -> FloatArray:
        """(n, 13) records at ``times_s`` (n,); held beyond both ends."""
        where = np.clip((times_s - self.start_s) / self.step_s, 0.0, len(self.rows) - 1.0)
        i = np.minimum(where.astype(np.int64), max(len(self.rows) - 2, 0))
        f = (where - i)[:, None]
        return np.asarray((1.0 - f) * self.rows[i] + f * self.rows[np.minimum(i + 1, len(self.rows) - 1)])


@numba.njit(cache=True, error_model="numpy")
def pose_at(rows: FloatArray, start_s: float, step_s: float, t: float) -> tuple[float, float, float]:  # pragma: no cover
    """`Track.at` of one moment, the pose only."""
    where = min(max((t - start_s) / step_s, 0.0), rows.shape[0] - 1.0)
    i = min(int(where), max(rows.shape[0] - 2, 0))
    j, f = min(i + 1, rows.shape[0] - 1), where - i
    return (
        (1.0 - f) * rows[i, 0] + f * rows[j, 0],
        (1.0 - f) * rows[i, 1] + f * rows[j, 1],
        (1.0 - f) * rows[i, 2] + f * rows[j, 2],
    )
