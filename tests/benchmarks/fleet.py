"""Cost and memory of a comparison of a fleet, killed halfway and resumed, and whether the table finds the robot that has changed.

python -m tests.benchmarks.fleet FOLDER [--logs 200] [--processes 1]

Simulated Huskies with a planar LiDAR drive for 12 s on ten days; from the eighth day on one has tyres with a fifth more grip sideways.
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import psutil

from localization.simulation.experiments import Experiment, ExperimentConfig, OpenLoop, Phase, Rest, constant
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.robot import Robot
from motion_models.robot_file import load_robot

_ROBOTS, _DAYS = 4, 10
_CHANGED_ROBOT, _CHANGED_DAY, _CHANGE = 2, 7, {"friction_anisotropy": 0.2}
_KILL_AT = 0.5
"""Share of the logs after which the first call is killed."""
_POLL_S = 0.5
_SENSORS = SensorConfig(scanner=ScannerConfig(rate_hz=10.0, beams=181))


@dataclass
class Call:
    """One call of `skidloc compare` as seen from outside: samples of it and of all its processes."""

    done: list[int]
    """Logs with results."""
    cpu_s: list[float]
    memory_mb: list[float]
    """Resident."""
    wall_s: float


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    begin = time.process_time()
    manifest = write_fleet(given.folder, given.logs)
    print(f"{given.logs} logs simulated in {time.process_time() - begin:.0f} s of CPU", flush=True)
    command = [sys.executable, "-m", "localization.cli", "compare", "--manifest", str(manifest), "--model", "skid_steer"]
    command += ["--estimator", "odometry,ekf", "--processes", str(given.processes), "--out", str(given.folder / "out")]
    results = given.folder / "out" / "results"
    killed = run(command, results, stop_at=round(_KILL_AT * given.logs))
    kept = {path: path.stat().st_mtime_ns for path in _done(results)}
    resumed = run(command, results)
    again = sum(path.stat().st_mtime_ns != stamp for path, stamp in kept.items())
    print(f"killed after {len(kept)} logs; resumed: {len(_done(results)) - len(kept)} more, {again} run again")
    describe("first call", killed)
    describe("second call", resumed)
    subprocess.run([sys.executable, "-m", "localization.cli", "table", str(given.folder / "out")], check=True)


def write_fleet(folder: Path, logs: int) -> Path:
    """Robot files, logs and the manifest of the fleet; logs that are there already stay."""
    husky = (files("motion_models") / "robots" / "husky_a200.toml").read_text(encoding="utf-8")
    rows = []
    for i in range(logs):
        robot, day = i % _ROBOTS, (i // _ROBOTS) % _DAYS
        file = folder / f"husky_{robot}.toml"
        file.write_text(husky.replace('name = "husky_a200"', f'name = "husky_{robot}"'), encoding="utf-8")
        path = folder / f"drive_{i:04d}.mcap"
        if not path.exists():
            effects = _CHANGE if robot == _CHANGED_ROBOT and day >= _CHANGED_DAY else {}
            write_simulation(path, Simulation(DRIVE, load_robot("husky_a200"), i, effects, SimulationConfig(sensors=_SENSORS)))
        rows.append((path.name, file.name, "hall", f"2026-11-{day + 1:02d}"))
    manifest = folder / "logs.csv"
    with manifest.open("w", newline="") as target:
        csv.writer(target).writerows([("log", "robot", "floor", "day"), *rows])
    return manifest


def _phases(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(0.5)
    yield OpenLoop("turn", constant(0.0, 0.5), 4.0)
    yield OpenLoop("arc", constant(0.5, 0.3), 3.0)
    yield OpenLoop("turn back", constant(0.0, -0.5), 3.0)


DRIVE = Experiment("short", "turns and an arc", "hall", (-4.0, 0.0, 0.0), _phases)


def run(command: Sequence[str], results: Path, stop_at: int | None = None) -> Call:
    """Run the comparison; kill it with all its processes once ``stop_at`` logs are done."""
    begin, found = time.perf_counter(), Call([], [], [], 0.0)
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
    cpu: dict[int, float] = {}
    while process.poll() is None:
        found.done.append(len(_done(results)))
        found.memory_mb.append(_measure(psutil.Process(process.pid), cpu))
        found.cpu_s.append(sum(cpu.values()))
        if stop_at is not None and found.done[-1] >= stop_at:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        else:
            time.sleep(_POLL_S)
    found.wall_s = time.perf_counter() - begin
    return found


def _measure(process: psutil.Process, cpu: dict[int, float]) -> float:
    """Resident memory of ``process`` and its children [MB]; their CPU times [s] go into ``cpu``."""
    memory = 0.0
    for one in (process, *process.children(recursive=True)):
        try:
            memory += one.memory_info().rss / 1e6
            cpu[one.pid] = one.cpu_times().user + one.cpu_times().system
        except psutil.NoSuchProcess:
            continue
    return memory


def _done(results: Path) -> list[Path]:
    return list(results.rglob("*.csv"))


def describe(title: str, call: Call) -> None:
    """Print cost and memory of ``call``: of its start, until the first log is done, and of the logs after it."""
    done, cpu, memory = (np.array(values, dtype=float) for values in (call.done, call.cpu_s, call.memory_mb))
    started = int(np.argmax(done > done[0]))
    logs = done[-1] - done[started]
    if not logs:
        return
    per_log = (cpu[-1] - cpu[started]) / logs
    print(f"{title}: start and first log {cpu[started]:.1f} s of CPU, then {per_log:.2f} s a log ({logs:.0f} logs); {call.wall_s:.0f} s")
    print(f"  1,000 logs on two free cores would take {1000 * per_log / 2 / 60:.0f} min")
    quarters = (f"{np.median(part):.0f}/{part.max():.0f}" for part in np.array_split(memory[started:], 4) if len(part))
    print(f"  memory [MB], median/most in each quarter of that time: {'  '.join(quarters)}", flush=True)


if __name__ == "__main__":
    main()
