"""`skidloc simulate`: drive a simulated robot through an experiment and write what it would have logged."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from localization.commands.common import write_json
from localization.errors import SimulationError
from localization.output import check_outputs
from localization.simulation.experiments import EXPERIMENTS
from localization.simulation.injected_faults import FAULTS, parse_faults
from localization.simulation.open_loop_scores import OpenLoopScore, mean_scores_by_trajectory, score_open_loop_runs
from localization.simulation.sensors import START_NS
from localization.simulation.simulator import Simulation, SimulationConfig, simulate, write_simulation
from motion_models.robot import Robot
from motion_models.robot_file import load_robot

_EXPERIMENTS = "; ".join(f"{e.name}: {e.meaning}" for e in EXPERIMENTS.values())
_EFFECTS = "; ".join(f"{e.id} [{e.unit}]: {e.meaning}" for e in FAULTS.values())


@dataclass(frozen=True)
class Simulate:
    """Simulate a skid-steer robot and write a log."""

    experiment: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help=_EXPERIMENTS)]
    """What is driven."""
    out: Path
    """New log: .bag (ROS 1), .mcap, or any other name for a ROS 2 folder (SQLite)."""
    robot: str = "vaultbot"
    """Name of a shipped robot, or path of a robot TOML file."""
    seed: int = 0
    """Seed of all noise. The same seed gives the same log, byte for byte."""
    effect: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="ID=SIZE", help=_EFFECTS)] = ()
    """Difference of the robot from its file; may be given several times."""
    engine: Literal["skidloc", "mujoco"] = "skidloc"
    """What moves the robot: our model of a skid-steer vehicle, or MuJoCo with the file of --simulator."""
    simulator: Path | None = None
    """The robot in MuJoCo (MJCF), as `skidloc twin` takes it and writes it. Without one it is written from the robot file."""
    config: SimulationConfig = field(default_factory=SimulationConfig)
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write what is printed, and when each run began and ended, to this file as well."""

    def run(self, console: Console) -> None:
        """Run the command, with output on ``console``."""
        check_outputs(self.out, self.json)
        robot, effects = load_robot(self.robot), parse_faults(self.effect)
        simulation = self._simulation(robot, effects)
        with console.status("driving") as status:
            shown = 0

            def on_message(log_ns: int) -> None:
                nonlocal shown
                second = (log_ns - START_NS) // 10**9
                if second >= shown + 20:
                    shown = second
                    status.update(f"driving: {second} s")

            count = write_simulation(self.out, simulation, on_message)
        scores = score_open_loop_runs(simulation)
        if self.json is not None:
            write_json(self.json, _content(simulation, self.seed, effects, count, scores))
        _print(console, simulation, self.out, count, scores)

    def _simulation(self, robot: Robot, effects: dict[str, float]) -> Simulation:
        if self.engine == "skidloc":
            if self.simulator is not None:
                raise SimulationError("--simulator is a file of MuJoCo: add --engine mujoco.")
            return simulate(self.experiment, robot, self.seed, effects, self.config)
        from localization.twin.mujoco_simulator import read_simulator
        from localization.twin.robot_mjcf import mjcf_of
        from localization.twin.simulated_drive import simulate_in_mujoco
        from localization.twin.xml_file import load

        file = mjcf_of(robot) if self.simulator is None else load(self.simulator)
        return simulate_in_mujoco(self.experiment, robot, read_simulator(file, robot), self.seed, effects, self.config)


def _content(simulation: Simulation, seed: int, effects: dict[str, float], count: int, scores: list[OpenLoopScore]) -> dict[str, Any]:
    runs = [
        {
            "name": run.name,
            "start_ns": START_NS + round(run.start_s * 1e9),
            "end_ns": START_NS + round((run.start_s + float(run.times_s[-1])) * 1e9),
            "cg": run.cg[0].tolist(),
        }
        for run in simulation.runs
    ]
    return {
        "experiment": simulation.experiment.name,
        "robot": simulation.robot.name,
        "seed": seed,
        "effects": effects,
        "duration_s": simulation.time_s,
        "messages": count,
        "runs": runs,
        "scores": [score.to_dict() for score in scores],
    }


def _print(console: Console, simulation: Simulation, out: Path, count: int, scores: list[OpenLoopScore]) -> None:
    what, who = simulation.experiment.name, simulation.robot.name
    driven = f"{simulation.time_s:.1f} s, {count} messages, {len(simulation.runs)} named runs"
    console.print(f"{escape(str(out))}: {what} with {who}, {driven}", soft_wrap=True)
    if simulation.experiment.name != "controller_evaluation":
        return
    table = Table("trajectory", "controller", "drive m", "correction s", "vision m", box=None, header_style="bold", pad_edge=False)
    for trajectory, by_controller in mean_scores_by_trajectory(scores).items():
        for controller, mean in by_controller.items():
            numbers = f"{mean.drive_error_m:.3f}", f"{mean.correction_time_s:.2f}", f"{mean.vision_error_m:.3f}"
            table.add_row(trajectory, controller, *numbers)
    console.print(table)
