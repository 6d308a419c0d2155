"""What a replay costs: beside KISS-ICP alone on the same scans, per wheel sample, and in memory as the log grows.

python -m tests.benchmarks.replay_cost [checks]

`checks` measures the sensor checks alone: their share of the steps of the EKF over the first part of fr079.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from localization.events import Scan
from localization.lidar import KissIcp, LidarConfig, Sweep, choose_voxel_size
from localization.log_replay import replay
from localization.logs import open_log
from localization.pipeline import Pipeline, Trial
from motion_models.preintegration import preintegrate
from motion_models.registry import MODELS, make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.studies.buildings import BUILDINGS

ACES = Path(__file__).parents[1] / "data" / "aces" / "aces.mcap"


def kiss_seconds() -> float:
    """KISS-ICP's register_frame on all scans of ACES, and nothing else."""
    config = LidarConfig()
    log = open_log(ACES, load_robot("aces"))
    ranges = config.min_range_m, config.max_range_m
    clouds = [Sweep.from_scan(event, Mount(), *ranges).points for event in log.events() if isinstance(event, Scan)]
    kiss = KissIcp(choose_voxel_size(clouds[0]), config.max_range_m)
    begin = time.perf_counter()
    for cloud in clouds:
        kiss.register_frame(cloud)
    return time.perf_counter() - begin


def ekf_seconds(model: str = "diff_drive") -> float:
    """The whole replay with the EKF: reading the log, wheels, scan matching, filter."""
    robot = load_robot("aces")
    begin = time.perf_counter()
    log = open_log(ACES, robot)
    replay(log.events(), [Trial(make_model(model, robot), "ekf")], robot, log.mounts, has_lidar=True)
    return time.perf_counter() - begin


def checks_share(seconds: float = 200.0) -> tuple[float, float]:
    """CPU time of a step of fr079's EKF [s], and the share of the sensor checks, 0 to 1. The first drive compiles."""
    drive = BUILDINGS["fr079"].open().until(seconds)
    events = list(drive.events)
    for _ in range(2):
        pipeline, checks_s, steps = Pipeline(Trial(make_model("diff_drive", drive.robot), "ekf"), drive.robot, drive.mounts, True), 0.0, 0

        def timed(method: Callable[..., Any]) -> Callable[..., Any]:
            def call(*arguments: Any) -> Any:
                nonlocal checks_s
                begin = time.process_time()
                try:
                    return method(*arguments)
                finally:
                    checks_s += time.process_time() - begin

            return call

        for name in ("apply", "inflate", "examine"):
            setattr(pipeline.checks, name, timed(getattr(pipeline.checks, name)))
        begin = time.process_time()
        for event in events:
            steps += len(pipeline.process(event))
        total_s = time.process_time() - begin
    return total_s / steps, checks_s / total_s


def samples_per_second(model: str, n: int = 200_000) -> float:
    """Preintegrated wheel samples per second, derivatives and covariance included."""
    robot = load_robot("vaultbot")
    made = make_model(model, robot)
    rng = np.random.default_rng(0)
    dt, wheels, cg = np.full(n, 0.02), rng.uniform(-3.0, 3.0, (n, 2)), np.array([0.02, 0.01])
    preintegrate(made, dt[:9], wheels[:9], cg, made.nominal, robot.wheel_noise)
    seconds = []
    for _ in range(5):
        begin = time.perf_counter()
        preintegrate(made, dt, wheels, cg, made.nominal, robot.wheel_noise)
        seconds.append(time.perf_counter() - begin)
    return n / statistics.median(seconds)


_REPLAY = """
import json, resource, sys
from localization.cli import main
main(["replay", sys.argv[1], "--robot", "aces", "--model", "diff_drive", "--estimator", "ekf", "--reference", "none", "--out", sys.argv[2]])
print(json.dumps(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))
"""


def peak_megabytes(log: Path, folder: Path) -> float:
    """Peak resident memory of `skidloc replay` in a process of its own [MB], report and files included."""
    command = [sys.executable, "-c", _REPLAY, str(log), str(folder)]
    return float(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]))


def first_part(source: Path, target: Path, part: float) -> None:
    """Copy the first ``part`` (0 to 1) of a log, message by message."""
    with (
        AnyReader([source], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader,
        Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        copies = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=reader.typestore) for c in reader.connections}
        last = reader.start_time + int(part * (reader.end_time - reader.start_time))
        for connection, stamp, raw in reader.messages():
            if stamp <= last:
                writer.write(copies[connection.id], stamp, raw)


def main(part: str = "all") -> None:
    step_s, share = checks_share()
    print(f"step of fr079's EKF {1e3 * step_s:.2f} ms, of which sensor checks {100.0 * share:.1f} % (at most 15 is wanted)\n")
    if part == "checks":
        return
    kiss_seconds(), ekf_seconds()  # compile and warm up
    ratios = []
    print("whole ACES replay, 7,374 scans, one thread            KISS-ICP alone     with the EKF     ratio")
    for _ in range(3):
        alone, fused = kiss_seconds(), ekf_seconds()
        ratios.append(fused / alone)
        print(f"{'':52} {alone:8.2f} s       {fused:8.2f} s     {ratios[-1]:7.2f}")
    print(f"median ratio {statistics.median(ratios):.2f} (at most 2 is wanted)\n")
    for model in MODELS:
        print(f"preintegration of {model:12} {samples_per_second(model):12,.0f} wheel samples/s")
    with tempfile.TemporaryDirectory() as folder:
        tenth = Path(folder) / "tenth"
        first_part(ACES, tenth, 0.1)
        short, whole = peak_megabytes(tenth, Path(folder) / "a"), peak_megabytes(ACES, Path(folder) / "b")
    print(f"\npeak memory: {short:.0f} MB for a tenth of ACES, {whole:.0f} MB for all of it ({100.0 * (whole / short - 1.0):+.1f} %)")


if __name__ == "__main__":
    main(*sys.argv[1:])
