"""Simulators against measured motion, mended and judged on what was held out; and simulators that were spoiled on purpose.

python -m tests.studies.twin rotations      VaultBot's 68 rotations against MuJoCo's default contacts
python -m tests.studies.twin husky          DRIVE's Husky windows, beside the friction model calibrated on the same windows
python -m tests.studies.twin spoiled [--seed 1] [--only mu,servo]     five spoiled copies of a true simulator, and an untouched one
python -m tests.studies.twin draws [--seed 1] [--count 60]     none to two wrong numbers of a quasi-static simulator, smooth and chaotic
python -m tests.studies.twin dart           VaultBot's rotations in DART with Gazebo's default friction
python -m tests.studies.twin own            the project's own simulator beside MuJoCo with the contact law, on the same commands

Rotations are fitted on every second row of x_G and judged on the others. Needs the extra `twin`.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console

from localization.commands.twin import print_twin
from localization.simulation.simulator import simulate
from localization.twin.discrepancy import centres, turns
from localization.twin.gazebo_simulator import read_gazebo_simulator
from localization.twin.mujoco_simulator import read_simulator
from localization.twin.robot_mjcf import mjcf_of
from localization.twin.robot_sdf import sdf_of
from localization.twin.simulated_drive import simulate_in_mujoco
from localization.twin.twin import Judged, TwinConfig, TwinResult, examine
from localization.twin.windows import motion_of_point
from motion_models import se2
from motion_models.calibration.fit import fit
from motion_models.calibration.maneuvers import Maneuver
from motion_models.calibration.regressions import rotations_as_maneuvers
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.helpers.quasi_static_simulator import HOPPING, named_of_draw
from tests.helpers.twin_drives import drive, spoiled, true_simulator
from tests.studies import drive_husky
from tests.studies.thesis_regressions import grid

FRICTION = ("wheel_radius", "mu_ratio", "tracked_x")
"""Parameters that the friction model is calibrated in by logs."""
SPOILS = ("healthy", "mu", "servo", "radius", "cg", "mass")


def k_and_centre(result: TwinResult, judged: Judged, robot: Robot) -> tuple[float, float, float, float]:
    """Root mean square errors of k [-] and of the centre of rotation ahead and across [m] on held-out rotations, and correlation of k."""
    windows = result.windows
    wheels = np.array([(w.mean_rates[1] - w.mean_rates[0]) * w.duration_s for w in windows])
    per_turn = robot.geometry.track_width_m / (wheels * robot.geometry.wheel_radius_m)
    moved = motion_of_point(judged.played.poses, judged.frame)
    measured = np.array([w.measured for w in windows])
    k, true = turns(windows, moved, robot) * per_turn, turns(windows, measured, robot) * per_turn
    off = centres(moved, turns(windows, moved, robot)) - centres(measured, turns(windows, measured, robot))
    rms = np.sqrt((off**2).mean(axis=0))
    return float(np.sqrt(((k - true) ** 2).mean())), float(rms[0]), float(rms[1]), float(np.corrcoef(k, true)[0, 1])


def study_rotations(console: Console) -> None:
    """Print the comparison of the thesis's rotations."""
    robot = load_robot("vaultbot")
    print_rotations(console, examine(rotations_as_maneuvers(grid(), robot), robot, read_simulator(mjcf_of(robot), robot)), robot)


def print_rotations(console: Console, result: TwinResult, robot: Robot) -> None:
    """Print the comparison, and errors of k and of the centre of rotation."""
    print_twin(console, result)
    for name, judged in (("file", result.before), *((m.name, m.judged) for m in result.repaired)):
        k, x, y, r = k_and_centre(result, judged, robot)
        console.print(f"{name}: k rms {k:.3f}, centre of rotation {1e3 * x:.0f}, {1e3 * y:.0f} mm, r of k {r:.3f}", soft_wrap=True)


def study_dart(console: Console) -> None:
    """Print the comparison of the thesis's rotations in DART."""
    robot = load_robot("vaultbot")
    print_rotations(console, examine(rotations_as_maneuvers(grid(), robot), robot, read_gazebo_simulator(sdf_of(robot), robot)), robot)


def study_own(console: Console) -> None:
    """Print how far the project's own simulator is from MuJoCo with the contact law after two seconds of the same commands."""
    robot = load_robot("husky_a200")
    model, stock = make_model("friction", robot), read_simulator(mjcf_of(robot), robot)
    mu, stiffness = (float(model.nominal[model.param_names.index(name)]) for name in ("mu", "slip_stiffness"))
    numbers = replace(stock.numbers, mu=mu, slip_stiffness=stiffness, servo_gain=20.0 * stock.numbers.servo_gain)
    law = read_simulator(stock.with_numbers(numbers), robot)
    for name, rates in {"in place": (-2.0, 2.0), "arc": (1.0, 4.0), "tight arc": (-1.0, 4.0), "straight": (4.0, 4.0)}.items():
        both = (simulate("laps", robot), simulate_in_mujoco("laps", robot, law))
        ends, seconds = [], []
        for simulation in both:
            start, begin = np.array(simulation.experiment.start), time.process_time()
            count = round(2.0 / simulation.config.vehicle.step_s)
            rows = simulation._move(np.arange(count) * simulation.config.vehicle.step_s, np.tile(rates, (count, 1)))
            seconds.append(time.process_time() - begin)
            ends.append(se2.between(start, rows[-1, :3]))
        off = se2.between(*ends)
        console.print(
            f"{name}: {1e3 * np.hypot(*off[:2]):.0f} mm, {off[2]:+.3f} rad of {ends[0][2]:+.3f} apart; CPU", *np.round(seconds, 2)
        )


def husky_maneuvers(steps: int) -> list[Maneuver]:
    """Windows of the first ``steps`` calibration steps of DRIVE's Husky; each has the one before it in its step as lead."""
    found = []
    maneuvers = drive_husky.maneuvers(mended=True)[: 3 * steps]
    for i, m in enumerate(maneuvers):
        if i % drive_husky.WINDOWS_PER_STEP == 0:
            continue
        before = maneuvers[i - 1]
        lead = len(before.dt)
        found.append(Maneuver(np.r_[before.dt, m.dt], np.r_[before.wheels, m.wheels], m.measured, m.ends, m.cg, m.cov, m.group, lead))
    return found


def study_husky(console: Console, steps: int = 100) -> None:
    """Print the comparison of DRIVE's Husky, beside the friction model fitted to the other half of the windows."""
    robot = drive_husky.robot()
    maneuvers = husky_maneuvers(steps)
    result = examine(maneuvers, robot, read_simulator(mjcf_of(robot), robot))
    print_twin(console, result)
    held = {w.group for w in result.windows}
    fitted = fit(make_model("friction", robot), [m for m in maneuvers if m.group not in held], FRICTION)
    residuals = fitted.residuals([m for m in maneuvers if m.group in held])
    friction = math.sqrt(float((residuals[:, :2] ** 2).sum(axis=1).mean()))
    measured = turns(result.windows, np.array([w.measured for w in result.windows]), robot)
    turn = float(residuals[:, 2] @ np.sign(measured) / np.abs(measured).sum())
    heading = math.sqrt(float((residuals[:, 2] ** 2).mean()))
    console.print(f"friction, calibrated: position {friction:.3f} m, heading {heading:.3f} rad, turn {100 * turn:+.1f} %")
    for m in result.repaired:
        console.print(f"{m.name}: position over that of friction {m.judged.rows[-1].position_rms_m / friction:.2f}")


def study_spoiled(console: Console, seed: int, only: Sequence[str], config: TwinConfig | None = None) -> None:
    """Print what is named of each spoiled simulator."""
    robot = load_robot("husky_a200")
    true = true_simulator(robot)
    maneuvers, n = drive(true, robot, seed, 96), true.numbers
    changes = {
        "healthy": {},
        "mu": {"mu": 0.5 * n.mu},
        "servo": {"servo_gain": 0.2 * n.servo_gain},
        "radius": {"radius_scale": 1.04},
        "cg": {"cg_x_m": n.cg_x_m + 0.08},
        "mass": {"mass_kg": 0.7 * n.mass_kg},
    }
    for name in only:
        result = examine(maneuvers, robot, spoiled(true, **changes[name]), config)
        named = "; ".join(f"{f.best.field} ({', '.join(r.field for r in f.rivals) or 'alone'})" for f in result.findings) or "nothing"
        better = ", ".join(m.name for m in result.repaired if m.is_better) or "none"
        console.print(f"{name}: {named}; better: {better}; {result.steps / 1e6:.1f} million time steps", soft_wrap=True)


def study_draws(console: Console, seed: int, count: int) -> None:
    """Print what is named of ``count`` drives, a third of which have nothing wrong, a third one number, a third two."""
    for chaos in ((0.0, 0.0, 0.0), HOPPING):
        wrong, missed, accused = [], [], []
        for number in range(seed * 1000, seed * 1000 + count):
            numbers, named = named_of_draw(number, chaos)
            wrong += [number] if any(not of & set(numbers) for of in named) else []
            accused += [number] if named and not numbers else []
            missed += [number] if set(numbers) - set().union(*named) else []
        what = f"{len(wrong)} have another number named {wrong}, {len(accused)} of them with nothing wrong; {len(missed)} miss one"
        console.print(f"chaos {chaos}: of {count} drives {what}", soft_wrap=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("rotations", "husky", "spoiled", "draws", "dart", "own"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--only", default=",".join(SPOILS))
    given = parser.parse_args()
    terminal = Console(width=200, highlight=False)
    studies = {"rotations": study_rotations, "husky": study_husky, "dart": study_dart, "own": study_own}
    if given.what in studies:
        studies[given.what](terminal)
    elif given.what == "draws":
        study_draws(terminal, given.seed, given.count)
    else:
        study_spoiled(terminal, given.seed, given.only.split(","))
