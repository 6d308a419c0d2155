"""How much faster two processes compare logs than one; some three minutes on two idle cores.

python -m tests.benchmarks.compare
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

from localization.comparison.jobs import Job, job_key, run_local, trials
from localization.logs import TopicOverrides
from localization.pipeline import ReplayConfig
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.simulator import SimulationConfig, simulate, write_simulation
from motion_models.robot_file import load_robot

_LOGS, _ROUNDS = 8, 2
_WANTED = 1.7


def seconds(jobs: list[Job], processes: int) -> float:
    """The start of the processes included."""
    begin = time.perf_counter()
    rows = [row for _, found in run_local(jobs, processes) for row in found]
    assert all(row["status"] == "ok" for row in rows)
    return time.perf_counter() - begin


def main() -> None:
    robot, config = load_robot("vaultbot"), ReplayConfig()
    wanted = tuple(trials(["diff_drive", "skid_steer"], ["odometry", "ekf"], ["constant"]))
    with tempfile.TemporaryDirectory() as folder:
        jobs = []
        for seed in range(_LOGS):
            path = Path(folder) / f"laps_{seed}.mcap"
            write_simulation(path, simulate("laps", robot, seed, {}, SimulationConfig(experiment=ExperimentConfig(laps=1))))
            jobs.append(Job(str(path), robot, wanted, job_key(str(path), robot, None, TopicOverrides(), config)))
        seconds(jobs[:1], 1)  # compile
        print(f"{_LOGS} logs, {len(wanted)} pairs each           1 process   2 processes   ratio")
        ratios = []
        for _ in range(_ROUNDS):
            one, two = seconds(jobs, 1), seconds(jobs, 2)
            ratios.append(one / two)
            print(f"{'':40}{one:8.1f} s{two:12.1f} s{ratios[-1]:8.2f}", flush=True)
    print(f"median ratio {statistics.median(ratios):.2f} (at least {_WANTED} is wanted, on two idle cores)")


if __name__ == "__main__":
    main()
