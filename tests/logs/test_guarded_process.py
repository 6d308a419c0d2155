"""Jobs of the campaign that hang or die."""

from __future__ import annotations

import os
import time
from typing import Any

import pytest

from tests.helpers.guarded_process import Ended, GuardedProcess


def _work(jobs: Any, results: Any) -> None:
    while True:
        job = jobs.get()
        while job == "spin":
            pass
        if job == "wait":
            time.sleep(3600.0)
        if job == "die":
            os._exit(7)
        results.put(f"done: {job}")


@pytest.mark.extended
@pytest.mark.parametrize(
    ("job", "is_hanging", "message"),
    [("spin", True, "of CPU time"), ("wait", True, "after 0 s of CPU time"), ("die", False, "died with code 7")],
)
def test_job_that_spins_waits_or_dies_ends_after_others_are_done(job: str, is_hanging: bool, message: str) -> None:
    """Two seconds of CPU time, or four without any, are a hang."""
    process = GuardedProcess(_work, most_cpu_s=2.0, most_idle_s=4.0)
    try:
        assert process.run("ours")[0] == "done: ours"
        ended, cpu_s = process.run(job)
    finally:
        process.stop()
    assert isinstance(ended, Ended)
    assert ended.is_hanging == is_hanging
    assert message in ended.message
    assert (cpu_s >= 2.0) == (job == "spin")
