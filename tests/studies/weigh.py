"""Weighing by driving: hidden loads on simulated robots, and the thesis's 68 rotations with their known centres of gravity.

python -m tests.studies.weigh [--cases 0:100] [--vehicle simulator|mujoco|brush] [--record FILE.jsonl] [--new 10]

Hidden loads: five robots, each with its CG moved by up to a sixth of wheelbase and track, with what else may differ from a robot file
drawn from the priors of `localization.diagnosis.weigh`; a minute of turning by the simulator's own tyre dynamics; LiDAR, wheels and gyro go
through a bag. With --vehicle the same robots, but VaultBot, move by MuJoCo's contacts or by brush tyres of other laws and stiffnesses, and
of what differs from the file there is what these vehicles have. Rotations: the friction model is fitted to 67, and the centre of gravity
of the other follows from how it turned.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.optimize import least_squares

from localization.diagnosis.drive import drive_of_log
from localization.diagnosis.weigh import PRIOR_SIGMAS, DrivenWeighing, weigh
from localization.logs import open_log
from localization.simulation.experiments import Experiment, ExperimentConfig, OpenLoop, Phase, Rest, constant
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from tests.helpers import brush_vehicle
from tests.studies import friction_grid
from tests.studies.thesis_regressions import grid

Vehicle = Literal["simulator", "mujoco", "brush"]
ROBOTS = ("vaultbot", "husky_a200", "jackal", "scout_2", "warthog")
HIDDEN = (
    *("wheel_radius_scale", "wheel_radius_difference", "track_width", "lidar_offset_x", "lidar_offset_y", "lidar_yaw"),
    *("lidar_time_offset", "wheel_time_offset", "friction_anisotropy", "scrub", "diagonal_load", "tread_asymmetry"),
    *("rolling_resistance", "split_friction", "slope", "gyro_scale"),
)
_NOT_NEGATIVE = ("scrub", "rolling_resistance")
_LARGEST_SIGMAS = 2.0  # beyond it priors are cut, where the simulator's limits and the robots' stability are near
_CG_SHARE = 1.0 / 6.0
_BRUSH_STIFFNESSES = (6.0, 12.0)
_BAND = 5.99  # 95 % of chi squared with 2 degrees of freedom


def _turning(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    yield Rest(1.0)
    for sign in (1.0, -1.0):
        yield OpenLoop(f"turn {sign:+g}", constant(0.0, 0.5 * sign), 12.0)
        yield OpenLoop(f"arc {sign:+g}", constant(0.4, 0.5 * sign), 7.0)
        yield OpenLoop(f"arc back {sign:+g}", constant(-0.4, -0.5 * sign), 7.0)


MINUTE = Experiment("turning", "turns in place and tight arcs to both sides", "hall", (-1.0, 0.0, 0.0), _turning)


@dataclass(frozen=True)
class Case:
    """One hidden load and what was weighed."""

    robot: str
    truth: FloatArray
    """(2,) offset of the CG [m]."""
    found: FloatArray
    """(2,) [m]"""
    covariance: FloatArray
    """(2, 2) [m^2]"""
    is_described: bool = True
    """Whether the friction model describes the drive."""

    @property
    def z(self) -> FloatArray:
        """(2,) errors over their sigmas."""
        return (self.found - self.truth) / np.sqrt(np.diagonal(self.covariance))

    @property
    def is_inside(self) -> bool:
        """Whether the truth is in the 95 % ellipse."""
        error = self.found - self.truth
        return float(error @ np.linalg.solve(self.covariance, error)) < _BAND


def hidden(seed: int, vehicle: Vehicle = "simulator") -> tuple[str, dict[str, float]]:
    """Robot and effects (size by id) of the case ``seed``; those that ``vehicle`` has."""
    rng = np.random.default_rng([23, seed])
    robots = ROBOTS if vehicle == "simulator" else [name for name in ROBOTS if load_robot(name).arms is None]
    name = robots[seed % len(robots)]
    g = load_robot(name).geometry
    cg = rng.uniform(-1.0, 1.0, 2) * _CG_SHARE * np.array([g.wheelbase_m, g.track_width_m])
    drawn = np.clip(rng.standard_normal(len(HIDDEN)), -_LARGEST_SIGMAS, _LARGEST_SIGMAS)
    others = {effect: float(z * PRIOR_SIGMAS[effect]) for effect, z in zip(HIDDEN, drawn, strict=True)}
    others |= {effect: abs(others[effect]) for effect in _NOT_NEGATIVE}
    found = {"cg_offset_x": float(cg[0]), "cg_offset_y": float(cg[1]), **others}
    return name, found if vehicle == "simulator" else {k: v for k, v in found.items() if k in _effects(vehicle)}


def _effects(vehicle: Vehicle) -> frozenset[str]:
    if vehicle == "brush":
        return brush_vehicle.EFFECTS
    from tests.helpers import mujoco_vehicle  # an extra

    return mujoco_vehicle.EFFECTS


def simulation_of(vehicle: Vehicle, experiment: Experiment, robot: Robot, seed: int, effects: Mapping[str, float]) -> Simulation:
    """``experiment`` on one of three vehicles, with a LiDAR of 191 beams."""
    config = SimulationConfig(sensors=SensorConfig(scanner=ScannerConfig(rate_hz=6.25, beams=191)))
    if vehicle == "simulator":
        return Simulation(experiment, robot, seed, effects, config)
    if vehicle == "brush":
        simulation = brush_vehicle.BrushSimulation(experiment, robot, seed, effects, config)
        stiffness = np.random.default_rng([29, seed]).uniform(*_BRUSH_STIFFNESSES)
        simulation.tyre = brush_vehicle.BrushTyre("brush" if seed % 2 else "tanh", float(stiffness))
        return simulation
    from tests.helpers import mujoco_vehicle

    return mujoco_vehicle.MujocoSimulation(experiment, robot, seed, effects, config)


def weigh_simulated(name: str, effects: Mapping[str, float], seed: int, vehicle: Vehicle = "simulator") -> DrivenWeighing:
    """Drive `MINUTE` with ``effects`` hidden, and weigh by the bag and the robot file alone."""
    robot = load_robot(name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "turning.mcap"
        write_simulation(path, simulation_of(vehicle, MINUTE, robot, seed, effects))
        return weigh(drive_of_log(open_log(path, robot)))[0]


def run_case(seed: int, vehicle: Vehicle = "simulator") -> Case:
    name, effects = hidden(seed, vehicle)
    found = weigh_simulated(name, effects, seed, vehicle)
    truth = np.array([effects["cg_offset_x"], effects["cg_offset_y"]])
    return Case(name, truth, found.offset, found.covariance, not found.model_errors)


def cases(seeds: range, vehicle: Vehicle = "simulator", record: Path | None = None, new: int | None = None) -> list[Case]:
    """The cases of ``seeds``; those in ``record`` are taken from there, and at most ``new`` others are run and added to it."""
    done: dict[int, Case] = {}
    if record is not None and record.exists():
        for line in record.read_text().splitlines():
            row = json.loads(line)
            numbers = (np.array(row[name]) for name in ("truth", "found", "covariance"))
            done[row["seed"]] = Case(row["robot"], *numbers, is_described=row["is_described"])
    for seed in [i for i in seeds if i not in done][:new]:
        done[seed] = case = run_case(seed, vehicle)
        if record is not None:
            numbers = {n: getattr(case, n).tolist() for n in ("truth", "found", "covariance")}
            row = {"seed": seed, "robot": case.robot, **numbers, "is_described": case.is_described}
            with record.open("a") as file:
                file.write(json.dumps(row) + "\n")
    return [done[i] for i in seeds if i in done]


def left_out_cgs(every: int = 1) -> FloatArray:
    """(68, 2) errors [m] of the CG of each (or each ``every``-th) rotation of the thesis, by how it turned and the friction model fitted
    to the other 67."""
    table, seen = grid(), friction_grid.measured(grid())
    errors = []
    for i in range(0, len(seen), every):
        others = np.arange(len(seen)) != i
        params = friction_grid.fit(friction_grid.FITTED, table.cg[others], seen[others]).params
        scatter = (friction_grid.predict(table.cg[others], params)[0] - seen[others]).std(axis=0)
        found = least_squares(_misfit, np.zeros(2), args=(seen[i], params, scatter), bounds=(-0.2, 0.2))
        errors.append(found.x - table.cg[i])
    return np.array(errors)


def _misfit(cg: FloatArray, seen: FloatArray, params: FloatArray, scatter: FloatArray) -> FloatArray:
    return np.asarray((friction_grid.predict(cg[None], params)[0][0] - seen) / scatter)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="0:100", metavar="A:B", help="seeds; the estimate was developed on 0 to 49")
    parser.add_argument("--vehicle", default="simulator", choices=get_args(Vehicle))
    parser.add_argument("--record", type=Path, default=None)
    parser.add_argument("--new", type=int, default=None, help="at most so many cases that are not in the record")
    given = parser.parse_args()
    found = cases(range(*map(int, given.cases.split(":"))), given.vehicle, given.record, given.new)
    z, sigmas = np.array([c.z for c in found]), np.sqrt([np.diagonal(c.covariance) for c in found])
    inside = np.mean([c.is_inside for c in found])
    held = np.mean(np.abs(z) < 1.96, axis=0)
    described = sum(c.is_described for c in found)
    print(f"{len(found)} hidden loads, in {described} of which the friction model describes the drive")
    print(f"95 % ellipses hold {100 * inside:.0f} %, intervals of x and y {(100 * held).round()} %")
    middle, largest, rms = (1e3 * np.median(sigmas, axis=0)).round(1), (1e3 * sigmas.max(axis=0)).round(1), np.sqrt(np.mean(z**2, axis=0))
    print(f"sigmas of x and y: median {middle} mm, largest {largest} mm; errors over sigmas {rms.round(2)} (RMS)")
    for robot in ROBOTS:
        own = np.array([c.z for c in found if c.robot == robot])
        if len(own):
            print(f"  {robot:12} rms z {np.sqrt(np.mean(own**2, axis=0)).round(2)}, mean {own.mean(axis=0).round(2)}")
    if given.vehicle != "simulator":
        return
    errors = left_out_cgs()
    rms = np.sqrt(np.mean(errors**2, axis=0))
    print(f"68 rotations, each left out: CG within {1e3 * rms[0]:.1f} mm in x, {1e3 * rms[1]:.1f} mm in y (RMS)")


if __name__ == "__main__":
    main()
