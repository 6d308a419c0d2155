"""A process that does one job after the other, and is watched: jobs that hang end by CPU time, or where none is used for long."""

from __future__ import annotations

import multiprocessing
import os
import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

_LOOK_S = 1.0


class Ended(NamedTuple):
    """What became of a job that gave no result."""

    is_hanging: bool
    """Else the process died."""
    message: str


class GuardedProcess:
    """`run` jobs in another process, which runs the loop ``work(jobs, results)``."""

    def __init__(self, work: Callable[[Any, Any], None], most_cpu_s: float, most_idle_s: float) -> None:
        """A job hangs after ``most_cpu_s`` of CPU time [s], or ``most_idle_s`` without any [s]: on a busy machine time on the wall shows
        neither."""
        self._most_cpu_s, self._most_idle_s = most_cpu_s, most_idle_s
        context = multiprocessing.get_context("spawn")
        self._jobs, self._results = context.Queue(), context.Queue()
        self._process = context.Process(target=work, args=(self._jobs, self._results), daemon=True)
        self._process.start()

    def run(self, job: Any) -> tuple[Any, float]:
        """Result of a job, or how it `Ended`, and its CPU time [s]."""
        self._jobs.put(job)
        begin_s, cpu_s, worked_at = self._cpu_seconds(), 0.0, time.monotonic()
        while cpu_s < self._most_cpu_s and time.monotonic() - worked_at < self._most_idle_s:
            try:
                return self._results.get(timeout=_LOOK_S), self._cpu_seconds() - begin_s
            except queue.Empty:
                if not self._process.is_alive():
                    return Ended(False, f"the process died with code {self._process.exitcode}"), cpu_s
            before_s, cpu_s = cpu_s, self._cpu_seconds() - begin_s
            worked_at = time.monotonic() if cpu_s > before_s else worked_at
        return Ended(True, f"not done after {cpu_s:.0f} s of CPU time"), cpu_s

    def _cpu_seconds(self) -> float:
        """CPU time of the process so far [s], as proc(5) has it: fields 14 and 15, after the name in brackets."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
