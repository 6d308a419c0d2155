"""How often a healthy LiDAR is taken for a turned or shifted one, and how well a wrong mount is measured, on simulated robots.

`python -m tests.studies.lidar_mounts [--drives 24] [--seed 700]` drives each robot of `ROBOTS` in turn for 75 s, with a centre of gravity
off the middle and a floor that shears sideways in curves, three times: with the LiDAR as its transform has it, turned by 6 to 18 degrees,
and shifted along the robot by .25 to .5 m. No limit of a yaw was chosen on these drives.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from itertools import takewhile
from pathlib import Path

import numpy as np

from localization.evidence import open_log_with_set_up
from localization.evidence.alternatives import Row
from localization.logs import open_log
from localization.logs.writer import write_bag
from localization.simulation.simulator import simulate
from motion_models.robot_file import load_robot

ROBOTS = (
    "jackal", "husky_a300", "scout_2", "scout_mini", "leo", "rosbot", "rosbot_xl", "pioneer_3at", "rover_pro", "warthog", "vaultbot",
    "pioneer_3dx",
)  # fmt: skip
SECONDS = 75.0


def found_on(robot_name: str, experiment: str, seed: int, effects: dict[str, float]) -> tuple[tuple[Row, ...], float, float]:
    """Faults of its LiDAR, and true yaw and place along the robot of its LiDAR less those of the mount that is used then [rad, m]."""
    robot = load_robot(robot_name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        simulation = simulate(experiment, robot, seed, effects)
        messages = simulation.messages()
        first = next(messages)
        write_bag(path, (first, *takewhile(lambda message: message.log_ns < first.log_ns + SECONDS * 1e9, messages)))
        checked = open_log_with_set_up(path, robot)
        sources = checked.log.sources
        frame = "" if sources.lidar is None else checked.log.frames[sources.lidar.topic]
        before, after = open_log(path, robot).mounts[frame], checked.log.mounts[frame]
    yaw = math.remainder(before.yaw + effects.get("lidar_yaw", 0.0) - after.yaw, math.tau)
    found = tuple(row for row in checked.set_up.faults if row.source == "lidar")
    return found, yaw, before.x + effects.get("lidar_offset_x", 0.0) - after.x


def main() -> None:
    """Print each drive, then false alarms, shares and errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drives", type=int, default=24)
    parser.add_argument("--seed", type=int, default=700)
    options = parser.parse_args()
    alarms, yaws, shifts = [], [], []
    for i in range(options.drives):
        name, rng = ROBOTS[i % len(ROBOTS)], np.random.default_rng(options.seed + i)
        experiment = ("laps", "preliminary")[i // len(ROBOTS) % 2]
        wheelbase = load_robot(name).geometry.wheelbase_m
        effects = {"cg_offset_x": rng.uniform(-0.12, 0.12) * wheelbase, "cg_offset_y": rng.uniform(-0.1, 0.1) * wheelbase}
        effects["lateral_slip_speed"] = rng.uniform(0.0, 0.05)
        yaw = rng.choice([-1.0, 1.0]) * math.radians(rng.uniform(6.0, 18.0))
        shift = rng.choice([-1.0, 1.0]) * rng.uniform(0.25, 0.5)
        healthy, _, _ = found_on(name, experiment, options.seed + i, effects)
        alarms.append(len(healthy))
        turned, yaw_error, _ = found_on(name, experiment, options.seed + i, {**effects, "lidar_yaw": yaw})
        yaws.append((bool(turned), math.degrees(yaw_error)))
        moved, _, shift_error = found_on(name, experiment, options.seed + i, {**effects, "lidar_offset_x": shift})
        shifts.append((bool(moved), shift_error))
        print(
            f"{name:12s} {experiment:12s} healthy: {len(healthy)} found; yaw {math.degrees(yaw):+6.1f} deg: {len(turned)} found, left"
            f" {math.degrees(yaw_error):+6.2f}; x {shift:+.2f} m: {len(moved)} found, left {shift_error:+.3f}",
            flush=True,
        )
        for one in (*healthy, *moved):
            print("      " + one.text, flush=True)
    for what, rows in (("yaw [deg]", yaws), ("x [m]", shifts)):
        left = np.array([error for is_found, error in rows if is_found])
        rms = math.sqrt(float(np.mean(left**2))) if len(left) else math.nan
        print(f"{what}: named in {len(left)} of {len(rows)}, error {rms:.3f} rms, {np.abs(left).max(initial=0.0):.3f} at most")
    print(f"false alarms: {sum(n > 0 for n in alarms)} of {len(alarms)}")


if __name__ == "__main__":
    main()
