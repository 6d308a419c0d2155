"""Signals that end a run."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any


class Stop:
    """Ctrl-C, and what stops services (SIGTERM): noted, and obeyed between two events, for half an event is no state. The second
    Ctrl-C does not wait."""

    def __init__(self) -> None:
        self._asked = threading.Event()
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Stop:
        self._before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self._asked.is_set():
            raise KeyboardInterrupt
        self._asked.set()

    def is_set(self) -> bool:
        return self._asked.is_set()

    def sleep(self, seconds: float) -> None:
        """Until then, or until asked to stop."""
        self._asked.wait(seconds)
