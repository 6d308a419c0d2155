"""Events of a log at the time at which they would come on a robot."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

_NS = 1e-9
_LONGEST_GAP_S = 5.0


class Pace:
    """``rate`` times as fast as the log; infinite: as fast as it goes."""

    def __init__(self, rate: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep) -> None:
        self._rate, self._clock, self._sleep = rate, clock, sleep
        self._last_ns: int | None = None
        self._due = 0.0

    def wait(self, stamp_ns: int) -> None:
        """Until the event of ``stamp_ns`` is due. Pauses of the log are cut to some seconds; what is late is not waited for."""
        if math.isinf(self._rate):
            return
        now = self._clock()
        if self._last_ns is None:
            self._due = now
        else:
            gap = min(max((stamp_ns - self._last_ns) * _NS, 0.0), _LONGEST_GAP_S)
            self._due += gap / self._rate
        self._last_ns = stamp_ns if self._last_ns is None else max(stamp_ns, self._last_ns)
        if self._due > now:
            self._sleep(self._due - now)
