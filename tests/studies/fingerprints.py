"""Digests of estimates, to show that a change leaves all results the same to the last bit.

python -m tests.studies.fingerprints [--write FILE] [--against FILE] [--only NAME,...]

Each row is one estimator over the first part of a log: SHA-256 of stamps, poses, covariances, twists, NIS, parameters, counts and warnings,
the last pose, and the CPU time. ``--write`` stores the rows; ``--against`` compares with stored ones, of the same machine and
libraries, and ends with exit code 1 if any differs. Drives: three real buildings, laps of the simulator with gyro and with friction model,
a Husky outdoors, of wheels, gyro and positions, two scenes that move, and hills with a 3D LiDAR, in space and by slopes alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from localization.estimators import PriorMap
from localization.evaluation.references import reference_track
from localization.inputs.step_config import StepConfig
from localization.log_replay import Run, replay
from localization.logs import open_log
from localization.logs.reference_topics import merge_positions, read_positions
from localization.maps.place_search import PlaceMap
from localization.pipeline import ReplayConfig, Trial
from localization.simulation.sensors import SensorConfig
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.hill_scans import MOUNT, make_scene, scans
from tests.helpers.hills import rolling_drive, with_accelerometer_bias, with_gyro_bias
from tests.helpers.in_space import IN_SPACE, in_order
from tests.helpers.moving_scenes import SCENES
from tests.studies.ablation import simulated
from tests.studies.buildings import BUILDINGS, DATA, Drive

_RANGE_NOISE_M = 0.02


@dataclass(frozen=True)
class Case:
    """One estimator over one drive."""

    drive: str
    estimator: str
    model: str = "skid_steer"
    corrections: str = "constant"

    @property
    def name(self) -> str:
        """Of the row."""
        return f"{self.drive} {self.estimator} {self.model} {self.corrections}"


CASES = (
    *(Case(drive, estimator) for drive in ("aces", "fr079", "csail") for estimator in ("ekf", "graph")),
    Case("fr079", "map"),
    Case("csail", "ekf", "friction", "cg_field"),
    Case("laps", "ekf"),
    Case("laps", "graph", "friction"),
    Case("laps", "ekf", "diff_drive", "wheel_radius_scale"),
    Case("husky", "ekf"),
    Case("husky", "graph", "full_linear"),
    Case("laps", "odometry"),
    Case("crowd", "ekf"),
    Case("walk off", "ekf"),
    Case("space", "ekf"),
    Case("space", "graph", "diff_drive"),
    Case("slopes", "ekf", "friction"),
)


def _husky() -> Drive:
    robot = load_robot("husky_a200")
    log = open_log(DATA / "husky-outdoor-gps/test1.bag", robot)
    events = list(merge_positions(log.events(), read_positions(log.references("/fix"), "/fix")))
    return Drive(events, robot, log.mounts, reference_track(log.references("/fix"), "/fix")).until(60.0)


def _scene(name: str) -> Drive:
    drive = SCENES[name](1)
    return Drive(drive.events, drive.robot, drive.mounts, None)


def _hills(seconds: float, seed: int, has_clouds: bool) -> Drive:
    """Biases of gyro and accelerometer beside; the truth is not used."""
    drive = with_gyro_bias(with_accelerometer_bias(rolling_drive(seconds, seed=seed), seed), seed)
    clouds = list(scans(drive, make_scene(drive, seed))) if has_clouds else []
    return Drive(in_order(drive, clouds), drive.robot, {**drive.mounts, "lidar_link": MOUNT}, None)


DRIVES: Mapping[str, Callable[[], Drive]] = {
    "aces": lambda: BUILDINGS["aces"].open().until(120.0),
    "fr079": lambda: BUILDINGS["fr079"].open().until(90.0),
    "csail": lambda: BUILDINGS["csail"].open().until(120.0),
    "laps": lambda: simulated("laps", SensorConfig(), 0).until(60.0),
    "husky": _husky,
    "crowd": lambda: _scene("crowd of 12 overtakes"),
    "walk off": lambda: _scene("12 people walk off"),
    "space": lambda: _hills(8.0, 2, has_clouds=True),
    "slopes": lambda: _hills(40.0, 3, has_clouds=False),
}
CONFIGS: Mapping[str, ReplayConfig] = {"space": IN_SPACE, "slopes": ReplayConfig(step=StepConfig(slopes=True))}
"""Of the drives whose steps are not those of the plane."""


def run(case: Case, drive: Drive) -> Run:
    """The estimate of ``case`` over its ``drive``; the estimator `map` in the map that the graph makes of it."""
    has_lidar, model = case.drive not in ("husky", "slopes"), make_model(case.model, drive.robot)

    def once(trial: Trial) -> Run:
        return replay(drive.events, [trial], drive.robot, drive.mounts, has_lidar, CONFIGS.get(case.drive, ReplayConfig()))[0]

    if case.estimator != "map":
        return once(Trial(model, case.estimator, case.corrections))
    keyframes = once(Trial(model, "graph")).keyframes
    assert keyframes is not None
    return once(Trial(model, "map", case.corrections, PriorMap(PlaceMap(keyframes, _RANGE_NOISE_M))))


def digest(found: Run) -> str:
    """SHA-256 of all that ``found`` has but its computing time."""
    total = hashlib.sha256()
    for trajectory in (found.trajectory, found.live):
        if trajectory is not None:
            for part in (trajectory.stamps_ns, trajectory.poses, trajectory.covariances):
                total.update(b"" if part is None else np.ascontiguousarray(part).tobytes())
    if found.in_space is not None:
        for part in (found.in_space.positions, found.in_space.quaternions, found.in_space.covariances):
            total.update(b"" if part is None else np.ascontiguousarray(part).tobytes())
    for array in (found.twists, found.twist_covariances, found.nis, found.map_points):
        total.update(np.ascontiguousarray(array).tobytes())
    rest = {"parameters": found.parameters, "counts": found.counts, "warnings": found.warnings, "localization": found.localization}
    total.update(json.dumps(rest, sort_keys=True, default=str).encode())
    return total.hexdigest()[:16]


def rows(only: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and content of each row whose drive or estimator is in ``only``, or of all."""
    drives: dict[str, Drive] = {}
    for case in CASES:
        if only and not {case.drive, case.estimator} & set(only):
            continue
        if case.drive not in drives:
            drives[case.drive] = DRIVES[case.drive]()
        begin = time.process_time()
        found = run(case, drives[case.drive])
        seconds = time.process_time() - begin
        pose = [round(value, 4) for value in found.trajectory.poses[-1].tolist()]
        yield case.name, {"digest": digest(found), "last_pose": pose, "seconds": round(seconds, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", type=Path, help="file in which the rows are stored")
    parser.add_argument("--against", type=Path, help="file of stored rows")
    parser.add_argument("--only", default="", help="drives and estimators, separated by commas")
    options = parser.parse_args()
    stored = json.loads(options.against.read_text()) if options.against else {}
    found, n_different = {}, 0
    for name, row in rows([part for part in options.only.split(",") if part]):
        before = stored.get(name)
        is_equal = before is None or before["digest"] == row["digest"]
        n_different += not is_equal
        note = "" if before is None else "same" if is_equal else f"DIFFERS, was {before['last_pose']}"
        print(f"{name:<40} {row['digest']} {row['last_pose']} {row['seconds']:6.2f} s {note}", flush=True)
        found[name] = row
    if options.write:
        options.write.write_text(json.dumps(found, indent=1))
    sys.exit(bool(n_different))


if __name__ == "__main__":
    main()
