"""What a minute of calibration is worth on a loaded robot: k, the centre of rotation, and the odometry of the next drive.

python -m tests.studies.loaded_robots [--cases 0:12] [--vehicle mujoco|brush|simulator] [--model MODEL]

Each case is a robot without coefficients whose load moves its centre of gravity by up to a sixth of wheelbase and track, and which the
robot file does not have; on MuJoCo's contacts, on brush tyres, or in the simulator. It is calibrated by a minute as `ADVICE` asks for, with
the LiDAR. k and the centre of rotation are compared with those of the true turns in place of that minute, and the odometry of another
drive with that of diff_drive: by the robot file, and calibrated on the same minute.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

import skidloc
from localization.calibration.calibrate import turning
from localization.simulation.experiments import Experiment, ExperimentConfig, OpenLoop, Phase, Rest, constant
from localization.simulation.simulator import RunRecord, write_simulation
from motion_models.calibration.regressions import center_of_arc
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import drive
from tests.studies.weigh import Vehicle, simulation_of

ROBOTS = ("husky_a200", "jackal", "scout_2", "warthog", "husky_a300", "rover_pro")
_CG_SHARE = 1.0 / 6.0
_SEED = 6300
_STEADY_S = 1.0
"""After which a turn in place is steady [s]."""
_EXACT = 1e-6 * np.eye(3)
"""Covariance of true poses, of which the centre of an arc asks for some."""


def _minute(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(2.0)
    yield OpenLoop("ahead", constant(0.5, 0.0), 5.0)
    yield OpenLoop("back", constant(-0.5, 0.0), 5.0)
    for sign in (1.0, -1.0):
        yield OpenLoop(f"turn {sign:+g}", constant(0.0, 0.5 * sign), 10.0)
        yield OpenLoop(f"arc {sign:+g}", constant(0.4, 0.4 * sign), 5.0)
        yield OpenLoop(f"arc back {sign:+g}", constant(-0.4, -0.4 * sign), 5.0)


MINUTE = Experiment("minute", "straight, turns in place to each side, arcs", "hall", (-3.0, 0.0, 0.0), _minute)


@dataclass(frozen=True)
class Turning:
    """Turning in place."""

    k: float
    x_cr_m: float


@dataclass(frozen=True)
class Case:
    """One robot: turning in place as it is and as calibrated, and odometry of another drive [m]."""

    robot: str
    true: Turning
    found: Turning
    odometry_m: float
    diff_drive_m: float
    """By the robot file."""
    calibrated_diff_drive_m: float


def true_turning(runs: Sequence[RunRecord], robot: Robot) -> Turning:
    """Mean over the steady parts of all turns in place, by the true poses and wheel angles."""
    k, centres = [], []
    for run in runs:
        if not run.name.startswith("turn"):
            continue
        steady = (run.times_s > _STEADY_S) & (run.times_s < run.times_s[-1] - 2.0 * _STEADY_S)
        poses, angles = run.poses[steady], run.wheel_angles[steady]
        turned = np.unwrap(poses[:, 2])
        ways = robot.geometry.wheel_radius_m * (angles[-1] - angles[0])
        k.append((turned[-1] - turned[0]) / (ways[1] - ways[0]) * robot.geometry.track_width_m)
        centres.append(center_of_arc(poses, _EXACT).value[0])
    return Turning(float(np.mean(k)), float(np.mean(centres)))


def run_case(seed: int, vehicle: Vehicle, model: str, folder: Path) -> Case:
    """Draw, drive, calibrate, and drive once more."""
    rng = np.random.default_rng([_SEED, seed])
    name = ROBOTS[seed % len(ROBOTS)]
    robot = dataclasses.replace(load_robot(name), models={}, options={})
    g = robot.geometry
    load = rng.uniform(-1.0, 1.0, 2) * _CG_SHARE * np.array([g.wheelbase_m, g.track_width_m])
    effects = {"cg_offset_x": float(load[0]), "cg_offset_y": float(load[1])}
    minute, following = (simulation_of(vehicle, e, robot, seed, effects) for e in (MINUTE, drive(f"random_{_SEED + seed}")))
    paths = [folder / f"{seed}-{part}.mcap" for part in ("minute", "drive")]
    for path, simulation in zip(paths, (minute, following), strict=True):
        write_simulation(path, simulation)
    calibration, plain = (skidloc.open(paths[0], robot).calibrate(each) for each in (model, "diff_drive"))
    assert calibration.robot is not None
    assert plain.robot is not None
    about = turning(calibration.result, calibration.robot)
    found = Turning(g.track_width_m / about.effective_track_m[0], about.x_cr_m[0])
    errors = [
        skidloc.open(paths[1], known).replay([f"{each}/odometry"], known.topics.reference)[0].ate_m or np.nan
        for known, each in ((calibration.robot, model), (robot, "diff_drive"), (plain.robot, "diff_drive"))
    ]
    return Case(name, true_turning(minute.runs, robot), found, *errors)


def main() -> None:
    """Print one line a case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="0:12")
    parser.add_argument("--vehicle", choices=get_args(Vehicle), default="mujoco")
    parser.add_argument("--model", default="skid_steer")
    arguments = parser.parse_args()
    first, last = map(int, arguments.cases.split(":"))
    print(f"{'robot':12s} {'k':>14s} {'off %':>6s} {'x_CR [m]':>14s} {'off mm':>6s}  odometry [m], diff_drive calibrated, and by the file")
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(first, last):
            found = run_case(seed, arguments.vehicle, arguments.model, Path(folder))
            print(
                f"{found.robot:12s} {found.true.k:6.3f} {found.found.k:7.3f} {100 * (found.found.k / found.true.k - 1):6.1f} "
                f"{found.true.x_cr_m:6.3f} {found.found.x_cr_m:7.3f} {1e3 * (found.found.x_cr_m - found.true.x_cr_m):6.0f}  "
                f"{found.odometry_m:.3f} {found.calibrated_diff_drive_m:.3f} {found.diff_drive_m:.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
