"""A process beside the node answers calls in order, passes on what is raised, and ends with the node."""

from __future__ import annotations

import math
import os
import time

import pytest

from localization.ros.quiet_process import QuietProcess


def test_calls_are_answered_by_one_process_of_the_lowest_priority():
    quiet = QuietProcess()
    try:
        values = [quiet.submit(math.factorial, n) for n in range(5)]
        assert [value.result(timeout=60.0) for value in values] == [1, 1, 2, 6, 24]
        pids = {quiet.submit(os.getpid).result(timeout=60.0) for _ in range(3)}
        assert len(pids) == 1
        assert os.getpid() not in pids
        assert quiet.submit(os.getpriority, os.PRIO_PROCESS, 0).result(timeout=60.0) == 19
    finally:
        quiet.shutdown()


def test_what_a_call_raises_is_raised_where_its_answer_is_taken():
    quiet = QuietProcess()
    try:
        with pytest.raises(ValueError, match="math domain"):
            quiet.submit(math.sqrt, -1.0).result(timeout=60.0)
        assert quiet.submit(math.sqrt, 4.0).result(timeout=60.0) == 2.0
    finally:
        quiet.shutdown()


def test_call_that_is_running_at_the_end_is_cancelled():
    quiet = QuietProcess()
    assert quiet.submit(math.sqrt, 1.0).result(timeout=60.0) == 1.0
    running = quiet.submit(time.sleep, 60.0)
    time.sleep(0.2)
    quiet.shutdown(wait=False, cancel_futures=True)
    deadline = time.monotonic() + 10.0
    while not running.done() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert running.cancelled()
