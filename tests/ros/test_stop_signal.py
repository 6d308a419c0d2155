"""SIGINT and SIGTERM end a run between two events, whatever it was doing."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import signal, sys
from localization.ros.node import StopSignal

def signal_at(k):
    seen = 0
    def trace(frame, event, argument):
        nonlocal seen
        seen += 1
        if seen == k:
            signal.raise_signal(signal.SIGINT)
        return trace
    return trace

for k in range(1, 60):
    with StopSignal() as stop:
        sys.settrace(signal_at(k))
        stop.sleep(0.01)
        sys.settrace(None)
print("awake")
"""


@pytest.mark.extended
def test_signal_at_any_line_of_a_sleep_does_not_block_it() -> None:
    """`Event.set` in a signal's handler waits forever where the signal came while `Event.wait` held its lock."""
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=60)
    assert done.stdout == "awake\n", done.stderr


@pytest.mark.extended
def test_second_signal_interrupts_at_once() -> None:
    code = """
import signal
from localization.ros.node import StopSignal
with StopSignal() as stop:
    signal.raise_signal(signal.SIGTERM)
    assert stop.is_set()
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "interrupted\n", done.stderr
