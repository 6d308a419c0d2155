"""When a sensor takes its samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motion_models.se2 import FloatArray

IntArray = NDArray[np.int64]


class Ticks:
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
