"""What clockwise rotations would add to the thesis's 68 counter-clockwise ones. `python -m tests.helpers.diagnosis_rotations`.

The simulator turns a robot that is wrong as the diagnosis says VaultBot is (tracked point, warp, track) at the same 68 centres of
gravity, with the scatter of the measured table: 136 times counter-clockwise, or 68 times each way. What is compared is by how much the
sizes of all causes together remain open, and what the diagnosis names.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import Drive, drive_of_table
from localization.diagnosis.findings import Diagnosis
from localization.simulation.experiments import Experiment, ExperimentConfig, MoveArms, OpenLoop, Phase, Rest, constant, grid_points
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig
from motion_models import se2
from motion_models.calibration.maneuvers import Maneuver
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot

WRONG = {"diagonal_load": 0.135, "track_width": 0.024}
TRACKED_X_M = 0.066
SCATTER = np.array([0.007, 0.006, 0.015])
"""[m, m, rad] of the measured table's rows about what the diagnosis explains."""


@dataclass(frozen=True)
class Known:
    """What a table of rotations tells."""

    diagnosis: Diagnosis
    sigma: dict[str, float]
    """Of each cause's size while all the others are free, in its own unit."""
    warp_and_treads: float
    """Correlation of the two signatures, the tracked point and the track free."""


def _experiment(rates: tuple[float, ...]) -> Experiment:
    def phases(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
        yield Rest(1.0)
        for cg in grid_points():
            yield MoveArms(cg)
            for i, rate in enumerate(rates):
                yield Rest(0.5)
                yield OpenLoop(f"{cg[0]:.2f},{cg[1]:.2f},{i}", constant(0.0, rate), 5.0)

    return Experiment("rotations", "both ways", "lab", (0.0, 0.0, 0.0), phases)


def rotations(rates: tuple[float, ...], seed: int) -> Drive:
    """A table of 68 rotations for each of the ``rates`` [rad/s]."""
    robot = load_robot("vaultbot")
    simulation = Simulation(_experiment(rates), robot, seed, WRONG, SimulationConfig(sensors=SensorConfig(lidar="none")))
    for _ in simulation.messages():
        pass
    rng = np.random.default_rng(seed)
    tracked = np.array([TRACKED_X_M, 0.0, 0.0])
    found = []
    for run in simulation.runs:
        turned = se2.between(run.poses[0], run.poses[-1])
        seen = se2.compose(se2.compose(se2.inverse(tracked), turned), tracked) + SCATTER * rng.standard_normal(3)
        seconds = float(run.times_s[-1])
        wheels = (run.wheel_angles[-1] - run.wheel_angles[0])[None] / seconds
        group = f"x_G = {run.nominal_cg[0]:g} m"
        found.append(Maneuver(np.array([seconds]), wheels, seen[None], np.array([1]), run.nominal_cg, np.diag(SCATTER**2), group=group))
    return drive_of_table("rotations", robot, found, "rotations")


def known(drive: Drive) -> Known:
    found = examine(drive, make_model("friction", drive.robot))
    assert found.linearization is not None
    problem, names = found.linearization.problem, [e.id for e in found.linearization.causes]
    free = np.sqrt(np.diagonal(np.linalg.inv(problem.gram + np.eye(len(names))))) * problem.scale
    given = tuple(names.index(name) for name in ("lidar_offset_x", "track_width"))
    cov = problem.scores(given, [names.index("diagonal_load"), names.index("tread_asymmetry")])[1]
    alike = cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1])
    return Known(found.diagnosis, dict(zip(names, (float(v) for v in free), strict=True)), float(alike))


def main() -> None:
    one = [known(rotations((0.3, 0.3), seed)) for seed in range(3)]
    both = [known(rotations((0.3, -0.3), seed)) for seed in range(3)]
    print(f"{'cause':28s} {'136 ccw':>10s} {'68 + 68 cw':>10s} {'better by':>10s}")
    for name in one[0].sigma:
        a, b = (float(np.mean([k.sigma[name] for k in table])) for table in (one, both))
        print(f"{name:28s} {a:10.4f} {b:10.4f} {a / b:10.1f}")
    for text, table in (("136 ccw", one), ("68 + 68 cw", both)):
        print(f"{text}: warp and treads look alike to {np.mean([k.warp_and_treads for k in table]):+.2f}")
        for k in table:
            reported = ", ".join(
                f"{f.cause} {f.size:+.3f} +- {f.sigma:.3f} {[name for name, _ in f.aliases]}" for f in k.diagnosis.findings
            )
            print(f"  {k.diagnosis.verdict}: {reported}")


if __name__ == "__main__":
    main()
