"""The last seconds of the true motion, from which sensors read."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from localization.simulation.drives import OpenLoop, Route
from localization.simulation.vehicle import COLUMNS
from motion_models.se2 import FloatArray


class TrueMotion:
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

    def drop_before(self, before_s: float) -> None:
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
def pose_at(rows: FloatArray, start_s: float, step_s: float, t: float) -> tuple[float, float, float]:
    """`TrueMotion.at` of one moment, the pose only."""
    where = min(max((t - start_s) / step_s, 0.0), rows.shape[0] - 1.0)
    i = min(int(where), max(rows.shape[0] - 2, 0))
    j, f = min(i + 1, rows.shape[0] - 1), where - i
    return (
        (1.0 - f) * rows[i, 0] + f * rows[j, 0],
        (1.0 - f) * rows[i, 1] + f * rows[j, 1],
        (1.0 - f) * rows[i, 2] + f * rows[j, 2],
    )


IntArray = NDArray[np.int64]


class SampleClock:
    """Sample times k / rate, in integer nanoseconds since the start, each handed out once, when it is over."""

    def __init__(self, rate_hz: float, takes_s: float = 0.0) -> None:
        self._rate, self._takes_s = rate_hz, takes_s
        self._next = 0

    def due(self, end_s: float) -> IntArray:
        """(n,) [ns] of the samples that were not yet handed out and end by ``end_s``."""
        last = int(np.floor((end_s - self._takes_s) * self._rate + 1e-6))
        ticks = np.arange(self._next, last + 1)
        self._next = max(self._next, last + 1)
        return np.round(ticks * (1e9 / self._rate)).astype(np.int64)


def seconds(ticks_ns: IntArray) -> FloatArray:
    """(n,) [s] of times in nanoseconds."""
    return np.asarray(ticks_ns * 1e-9, dtype=np.float64)


RUN_HZ = 20.0


@dataclass(frozen=True, eq=False)
class RunRecord:
    """True motion of one named phase, 20 times a second from the body's rest before it to its rest after it."""

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
    """(2,) as the robot has it [m]."""
    command: OpenLoop | Route

    @property
    def times_s(self) -> FloatArray:
        """(n,) since the start of the run."""
        return np.asarray(np.arange(len(self.poses)) / RUN_HZ)
