"""What paces and ends a run: the clock by which a log is played back, and the signals that stop a process between two events."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

_NS = 1e-9
_MAX_GAP_S = 5.0
"""Longer pauses of a log are cut to this [s]."""


class PlaybackClock:
    """``rate`` times as fast as the log was recorded; infinite: without waiting."""

    def __init__(self, rate: float, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep) -> None:
        self._rate, self._clock, self._sleep = rate, clock, sleep
        self._last_ns: int | None = None
        self._due = 0.0

    def wait(self, stamp_ns: int) -> None:
        """Sleep until the event of ``stamp_ns`` is due; return at once where it is overdue."""
        if math.isinf(self._rate):
            return
        now = self._clock()
        if self._last_ns is None:
            self._due = now
        else:
            gap = min(max((stamp_ns - self._last_ns) * _NS, 0.0), _MAX_GAP_S)
            self._due += gap / self._rate
        self._last_ns = stamp_ns if self._last_ns is None else max(stamp_ns, self._last_ns)
        if self._due > now:
            self._sleep(self._due - now)


class StopSignal:
    """SIGINT and SIGTERM, stored until the present event is processed: half an event is no state. The second one interrupts at once."""

    def __init__(self) -> None:
        self._is_requested = threading.Event()
        self._handlers_before: dict[int, Any] = {}

    def __enter__(self) -> StopSignal:
        self._handlers_before = {number: signal.signal(number, self._request) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._handlers_before.items():
            signal.signal(number, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self._is_requested.is_set():
            raise KeyboardInterrupt
        self._is_requested.set()

    def is_set(self) -> bool:
        return self._is_requested.is_set()

    def sleep(self, seconds: float) -> None:
        """Sleep, or until a signal comes."""
        self._is_requested.wait(seconds)
