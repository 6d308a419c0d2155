"""Whether 95 % intervals of loads and grip hold the true sizes beside a healthy drive, by MuJoCo's contacts.

python -m tests.studies.mujoco_intervals [--cases 0:64] [--record FILE.jsonl]

A healthy drive shows how contacts turn a robot, and not how they respond to loads and grip, so that sizes of the centre of gravity, of
payload and of split friction have a share of themselves in their sigma (`model_error.response_error`). Each case hides one of them in one
of four robots, of half to twice its typical size, on one of three routes. Poses are MuJoCo's own with noise of 1 mm and 0.5 mrad a window:
what intervals have to hold is the error of the model. Needs the extra `mujoco`.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from localization.diagnosis.baseline import estimate_baseline
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.drive_predictor import Baseline
from localization.logs import open_log
from localization.simulation.experiments import Experiment
from localization.simulation.injected_faults import FAULTS
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import SimulationConfig, write_simulation
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import TYPICAL, drive
from tests.helpers.mujoco_vehicle import MujocoSimulation
from tests.studies.mujoco_blind import HEALTHY, ROBOTS, ROUTES

CAUSES = ("cg_offset_x", "cg_offset_y", "payload", "split_friction")
_PAYLOAD_SHARE = 0.15  # of the robot's mass
_CG_SHARES = {"cg_offset_x": ("wheelbase_m", 0.08), "cg_offset_y": ("track_width_m", 0.06)}
_SMALLEST, _LARGEST = 0.5, 2.0  # over the typical size
_SIGMAS = np.array([1e-3, 1e-3, 5e-4])
_END_SIGMAS = (7e-4, 3.5e-4)
"""The same of each end of a window [m, rad]."""
_SEED, _HEALTHY_SEED = 8_800_000, 8_799_999
_TWO_SIDED_95 = 1.96


class Case(NamedTuple):
    """A hidden cause, and what was found of it."""

    number: int
    robot: str
    route: str
    cause: str
    size: float
    found: float | None
    """None where it is no finding."""
    sigma: float | None

    @property
    def is_held(self) -> bool:
        """Whether the 95 % interval holds the true size."""
        return self.found is not None and self.sigma is not None and abs(self.found - self.size) < _TWO_SIDED_95 * self.sigma


def hidden(number: int) -> tuple[str, str, str, float]:
    """Robot, route, cause and size of the case ``number``."""
    rng = np.random.default_rng(_SEED + number)
    robot, cause = ROBOTS[number % len(ROBOTS)], CAUSES[number // len(ROBOTS) % len(CAUSES)]
    geometry = load_robot(robot).geometry
    if cause == "payload":
        typical = _PAYLOAD_SHARE * geometry.mass_kg
    elif cause in _CG_SHARES:
        field, share = _CG_SHARES[cause]
        typical = share * float(getattr(geometry, field))
    else:
        typical = TYPICAL[cause]
    size = min(typical * math.exp(rng.uniform(math.log(_SMALLEST), math.log(_LARGEST))), FAULTS[cause].largest)
    sign = 1.0 if cause == "payload" else float(rng.choice([-1.0, 1.0]))
    return robot, str(rng.choice(ROUTES)), cause, sign * size


def drive_with_poses(robot_name: str, experiment: Experiment, effects: Mapping[str, float], seed: int) -> Drive:
    """By MuJoCo, with its poses as the reference, and noise of the windows."""
    robot, config = load_robot(robot_name), SimulationConfig(sensors=SensorConfig(lidar="none"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        write_simulation(path, MujocoSimulation(experiment, robot, seed, effects, config))
        exact = drive_of_log(open_log(path, robot), "reference", "/ground_truth/odom", reference_sigmas=_END_SIGMAS)
    noise = _SIGMAS * np.random.default_rng(seed).normal(size=(len(exact.maneuvers), 1, 3))
    measured = (dataclasses.replace(m, measured=se2.compose(m.measured, e)) for m, e in zip(exact.maneuvers, noise, strict=True))
    return dataclasses.replace(exact, maneuvers=tuple(measured))


@functools.cache
def _healthy(robot_name: str) -> Baseline:
    measured = drive_with_poses(robot_name, HEALTHY, {}, _HEALTHY_SEED)
    return estimate_baseline(measured, make_model("friction", measured.robot))


def run(number: int) -> Case:
    """Hide the cause of the case ``number``, and diagnose the drive beside a healthy one."""
    robot, route, cause, size = hidden(number)
    measured = drive_with_poses(robot, drive(route), {cause: size}, _SEED + number)
    findings = examine(measured, make_model("friction", measured.robot), baseline=_healthy(robot)).diagnosis.findings
    found = next(((f.size, f.sigma) for f in findings if f.cause == cause), (None, None))
    return Case(number, robot, route, cause, size, *found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="0:64", metavar="A:B[:STEP]")
    parser.add_argument("--record", type=Path, default=None, metavar="FILE", help="rows; cases that it has are not run again")
    given = parser.parse_args()
    has_rows = given.record is not None and given.record.exists()
    done = {c.number: c for c in (Case(**json.loads(line)) for line in (given.record.read_text().splitlines() if has_rows else []))}
    numbers = range(*map(int, given.cases.split(":")))
    for number in numbers:
        if number not in done:
            done[number] = run(number)
            if given.record is not None:
                with given.record.open("a") as file:
                    file.write(json.dumps(done[number]._asdict()) + "\n")
        c = done[number]
        found = "not found" if c.found is None or c.sigma is None else f"{c.found:+.4f} +- {c.sigma:.4f}{'' if c.is_held else ' off'}"
        print(f"{number:3d} {c.robot:10s} {c.route:9s} {c.cause:15s} {c.size:+8.4f} {found}", flush=True)
    found_cases = [done[i] for i in numbers if done[i].found is not None]
    for cause in CAUSES:
        own = [c for c in found_cases if c.cause == cause]
        print(f"{cause:15s} {sum(c.is_held for c in own)} of {len(own)} intervals hold the size")
    held = sum(c.is_held for c in found_cases)
    print(f"{held} of {len(found_cases)} intervals hold the size, of {len(numbers)} hidden causes")


if __name__ == "__main__":
    main()
