"""Weighing on slopes: height of the centre of gravity and mu of robots that turn for a minute on a tilted floor, with their intervals.

python -m tests.studies.weigh_slopes [--cases 0:10] [--vehicle simulator|mujoco] [--no-imu]

Each case is a Husky, a Jackal or a Scout 2 whose centre of gravity and grip are hidden, beside all else that robots differ by from their
files (`tests.studies.weigh`), on a slope of 5 to 10 degrees; its poses are measured with a noise of 3 mm and .1 deg. By MuJoCo's contacts
nothing of the friction model is shared. With --no-imu the slope is found by how the robot slides downhill.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.weigh import DrivenWeighing, weigh
from localization.logs import open_log
from localization.simulation.experiments import Experiment
from localization.simulation.sensors import ImuConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models import se2
from motion_models.friction import FrictionModel
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.studies.weigh import MINUTE, hidden

_ROBOTS = ("husky_a200", "jackal", "scout_2")
_SIGMAS = (0.003, math.radians(0.1))
_STEEP_DEG = (5.0, 10.0)
_HEIGHT_SHARE, _LOG_GRIP = (-0.3, 0.6), (-0.5, 0.1)


class SlopeCase(NamedTuple):
    """What was hidden, and what was weighed."""

    robot: str
    slope_deg: float
    height: float
    mu: float
    found: DrivenWeighing

    @property
    def errors(self) -> tuple[float, float]:
        """Relative errors of height and mu; NaN where no slope was found."""
        s = self.found.slope
        return (math.nan, math.nan) if s is None else (s.height / self.height - 1.0, s.mu / self.mu - 1.0)

    @property
    def z(self) -> tuple[float, float]:
        """Errors over their sigmas."""
        s = self.found.slope
        return (math.nan, math.nan) if s is None else ((s.height - self.height) / s.height_sigma, (s.mu - self.mu) / s.mu_sigma)


def drive_on_slope(
    robot: Robot, slope_deg: float, seed: int, effects: dict[str, float], vehicle: str = "simulator", imu: bool = True
) -> Drive:
    """`MINUTE` on a slope, measured by a reference with noise."""
    rng = np.random.default_rng([41, seed])
    start = (-1.0, 0.0, float(rng.uniform(-math.pi, math.pi)))
    experiment: Experiment = dataclasses.replace(MINUTE, slope_deg=slope_deg, start=start)
    config = SimulationConfig(sensors=SensorConfig(lidar="none", imu=ImuConfig() if imu else ImuConfig(rate_hz=0.0)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "turning.mcap"
        write_simulation(path, _simulation(vehicle)(experiment, robot, seed, effects, config))
        drive = drive_of_log(open_log(path, robot), reference=robot.topics.reference, reference_sigmas=_SIGMAS)
    noisy = tuple(
        dataclasses.replace(m, measured=se2.retract(m.measured, rng.multivariate_normal(np.zeros(3), m.cov, len(m.measured))))
        for m in drive.maneuvers
    )
    return dataclasses.replace(drive, maneuvers=noisy)


def _simulation(vehicle: str) -> type[Simulation]:
    if vehicle == "simulator":
        return Simulation
    from tests.helpers.mujoco_vehicle import MujocoSimulation  # an extra

    return MujocoSimulation


def run_case(seed: int, vehicle: str = "simulator", imu: bool = True) -> SlopeCase:
    """One robot on one slope."""
    rng = np.random.default_rng([43, seed])
    robot = load_robot(_ROBOTS[seed % len(_ROBOTS)])
    _, others = hidden(seed, vehicle)  # type: ignore[arg-type]
    effects = {name: size for name, size in others.items() if not name.startswith(("slope", "cg_offset", "lidar_time", "wheel_time"))}
    g, mu = robot.geometry, float(FrictionModel.from_robot(robot).nominal[3])
    cg = rng.uniform(-1.0, 1.0, 2) / 12.0 * np.array([g.wheelbase_m, g.track_width_m])
    more, grip = g.cg_height_m * rng.uniform(*_HEIGHT_SHARE), math.exp(rng.uniform(*_LOG_GRIP))
    effects |= {"cg_offset_x": float(cg[0]), "cg_offset_y": float(cg[1]), "cg_height": more, "grip": grip - 1.0}
    slope = float(rng.uniform(*_STEEP_DEG))
    found, _ = weigh(drive_on_slope(robot, slope, seed, effects, vehicle, imu))
    return SlopeCase(robot.name, slope, g.cg_height_m + more, mu * grip, found)


def main() -> None:
    """Print the cases and their summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="0:10", metavar="A:B", help="seeds")
    parser.add_argument("--vehicle", default="simulator", choices=("simulator", "mujoco"))
    parser.add_argument("--no-imu", action="store_true")
    given = parser.parse_args()
    print("| seed | robot | slope | height [m] | found | mu | found | described |\n" + "|---" * 8 + "|")
    cases = []
    for seed in range(*map(int, given.cases.split(":"))):
        c = run_case(seed, given.vehicle, not given.no_imu)
        cases.append(c)
        s = c.found.slope
        found = ("-", "-") if s is None else (f"{s.height:.3f} +- {s.height_sigma:.3f}", f"{s.mu:.2f} +- {s.mu_sigma:.2f}")
        described = "no" if c.found.model_errors else "yes"
        print(
            f"| {seed} | {c.robot} | {c.slope_deg:.1f} | {c.height:.3f} | {found[0]} | {c.mu:.2f} | {found[1]} | {described} |", flush=True
        )
    errors, z = np.array([c.errors for c in cases]), np.array([c.z for c in cases])
    for name, error, own in zip(("height", "mu"), errors.T, z.T, strict=True):
        shown = np.isfinite(error)
        print(
            f"{name}: median |error| {np.median(np.abs(error[shown])):.1%}, largest {np.abs(error[shown]).max():.1%}; within 10 %: "
            f"{np.mean(np.abs(error[shown]) < 0.1):.0%}; errors over sigmas {np.sqrt(np.mean(own[shown] ** 2)):.2f} (RMS); "
            f"95 % intervals hold {np.mean(np.abs(own[shown]) < 1.96):.0%} of {shown.sum()}"
        )


if __name__ == "__main__":
    main()
