"""Logs to compare on, and work that goes wrong; in a module of its own, for other processes import it."""

from __future__ import annotations

import functools
import os
import signal
import tempfile
from pathlib import Path

from localization.comparison.jobs import Job, Row, failed_rows, run_job
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from tests.helpers.online import DRIVE, ROBOT

_FOLDER = tempfile.TemporaryDirectory(prefix="skidloc-compare-")
BLIND = SimulationConfig(sensors=SensorConfig(lidar="none"))


@functools.cache
def logs(count: int) -> tuple[Path, ...]:
    """Short drives without LiDAR, each with another noise."""
    found = []
    for seed in range(count):
        path = Path(_FOLDER.name) / f"drive_{seed}.mcap"
        if not path.exists():
            write_simulation(path, Simulation(DRIVE, ROBOT, seed, {}, BLIND))
        found.append(path)
    return tuple(found)


def killing(job: Job) -> list[Row]:
    """As logs that take all memory: one always, one once."""
    mark = Path(job.log + ".tried")
    if "drive_1" in job.log or ("drive_2" in job.log and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return run_job(job)


def quick(job: Job) -> list[Row]:
    return failed_rows(job, "not run", "process")
