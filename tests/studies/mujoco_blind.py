"""Blind diagnoses of drives whose physics are MuJoCo's: a cause is hidden in the robot, and the diagnosis has the bag, the robot file, and
a drive of the healthy robot on another route.

python -m tests.studies.mujoco_blind [--cases 0:64] [--record FILE.jsonl] [--new 10]

A cause counts as named where it is the first finding or among its aliases; a drive in which nothing is hidden, where no cause is named.
Causes are also counted by themselves where their size is 3 sigma and more of what the drive shows, as in `tests.benchmarks.diagnosis`.
Needs the extra `mujoco`.
"""

from __future__ import annotations

import argparse
import functools
import json
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from localization.diagnosis.baseline import estimate_baseline
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.drive_predictor import Baseline
from localization.diagnosis.result import DiagnosisResult
from localization.logs import open_log
from localization.simulation.experiments import Experiment, ExperimentConfig, Phase
from localization.simulation.injected_faults import FAULTS
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import SimulationConfig, write_simulation
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot
from tests.benchmarks.diagnosis import significances
from tests.helpers.diagnosis_drives import ONE_SIDED, TYPICAL, drive
from tests.helpers.diagnosis_scores import STRONG
from tests.helpers.mujoco_vehicle import EFFECTS, MujocoSimulation

ROBOTS = ("husky_a200", "jackal", "warthog", "scout_2")
ROUTES = ("tour", "random_4", "random_9")
_MISSING_SHARE = 0.2
_TWO_SIDED_95 = 1.96
_HEALTHY_ROUTES, _HEALTHY_SEED = ("random_21", "random_22"), 6900
_PAYLOAD_SHARE = 0.15  # of the robot's mass: 8 kg on a Husky
_CG_SHARE = {"cg_offset_x": ("wheelbase_m", 0.08), "cg_offset_y": ("track_width_m", 0.06)}
_NULL_EVERY = 5  # every fifth case hides nothing


@dataclass(frozen=True)
class BlindCase:
    """What was hidden and what was found."""

    number: int
    robot: str
    route: str
    cause: str
    """Empty where nothing was hidden."""
    size: float
    verdict: str
    named: tuple[str, ...]
    """First finding and its aliases."""
    found: float | None
    """Size of the hidden cause, where it is a finding or among the first one's aliases."""
    others: tuple[str, ...] = ()
    """Further findings."""
    significance: float | None = None
    """Size over the sigma with which the drive can measure it; None where it does not act on the motion, or nothing was hidden."""
    sigma: float | None = None
    """Of the hidden cause's size, where it is a finding."""

    @property
    def is_in_interval(self) -> bool | None:
        """Whether the 95 % interval of the size holds the true one; None where the hidden cause is no finding."""
        if self.sigma is None or self.found is None:
            return None
        return abs(self.found - self.size) < _TWO_SIDED_95 * self.sigma

    @property
    def is_right(self) -> bool:
        return self.cause in self.named if self.cause else not self.named

    @property
    def is_shown(self) -> bool:
        """Whether the drive shows the hidden cause at its size."""
        return self.significance is None or self.significance >= STRONG


def hidden(number: int) -> tuple[str, str, str, float]:
    """Robot, route, cause and size of the case ``number``."""
    robot, route = ROBOTS[number % len(ROBOTS)], ROUTES[number // len(ROBOTS) % len(ROUTES)]
    if number % _NULL_EVERY == _NULL_EVERY - 1:
        return robot, route, "", 0.0
    effects = sorted(EFFECTS)
    cause = effects[(number - number // _NULL_EVERY) % len(effects)]
    geometry = load_robot(robot).geometry
    if cause in _CG_SHARE:
        field, share = _CG_SHARE[cause]
        size = share * float(getattr(geometry, field))
    elif cause == "payload":
        size = min(_PAYLOAD_SHARE * geometry.mass_kg, FAULTS[cause].largest)
    else:
        size = TYPICAL.get(cause, _MISSING_SHARE)
    is_negative = cause not in (*ONE_SIDED, "missing_joint_messages") and number % 2 == 1
    return robot, route, cause, -size if is_negative else size


def _healthy_phases(robot: Robot, config: ExperimentConfig) -> Iterator[Phase]:
    for route in _HEALTHY_ROUTES:
        yield from drive(route).phases(robot, config)


HEALTHY = Experiment("healthy", "two minutes of arcs and turns", "hall", (-4.0, 0.0, 0.0), _healthy_phases)


def drive_mujoco(robot: Robot, experiment: Experiment, effects: Mapping[str, float], seed: int) -> Drive:
    """Simulated in MuJoCo with hidden ``effects``; what the bag and the robot file have of it."""
    config = SimulationConfig(sensors=SensorConfig(scanner=ScannerConfig(rate_hz=6.25, beams=191)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        write_simulation(path, MujocoSimulation(experiment, robot, seed, effects, config))
        return drive_of_log(open_log(path, robot))


@functools.cache
def healthy(robot_name: str, experiment: Experiment = HEALTHY) -> Baseline:
    """How the healthy robot in MuJoCo differs from its file."""
    robot = load_robot(robot_name)
    return estimate_baseline(drive_mujoco(robot, experiment, {}, _HEALTHY_SEED), make_model("friction", robot))


def diagnose_mujoco(robot_name: str, route: str, effects: Mapping[str, float], seed: int, baseline: Baseline) -> DiagnosisResult:
    """Diagnosis of a drive in MuJoCo with hidden ``effects``, by the bag, the robot file and the ``baseline`` of the healthy robot."""
    robot = load_robot(robot_name)
    return examine(drive_mujoco(robot, drive(route), effects, seed), make_model("friction", robot), baseline=baseline)


def run_case(number: int) -> BlindCase:
    robot, route, cause, size = hidden(number)
    effects = {cause: size} if cause else {}
    result = diagnose_mujoco(robot, route, effects, 7000 + number, healthy(robot))
    found, significance = result.diagnosis, significances(result, effects).get(cause)
    sizes = {found.findings[0].cause: found.findings[0].size, **dict(found.findings[0].aliases)} if found.findings else {}
    others = tuple(f.cause for f in found.findings[1:])
    measured = next(((f.size, f.sigma) for f in found.findings if f.cause == cause), (sizes.get(cause), None))
    return BlindCase(number, robot, route, cause, size, found.verdict, tuple(sizes), measured[0], others, significance, measured[1])


def cases(numbers: range, record: Path | None = None, new: int | None = None) -> list[BlindCase]:
    """The cases of these ``numbers``; those in ``record`` are taken from there, and at most ``new`` others are run and added to it."""
    rows = record.read_text().splitlines() if record is not None and record.exists() else []
    done = {row["number"]: BlindCase(**{**row, "named": tuple(row["named"])}) for row in map(json.loads, rows)}
    for number in [i for i in numbers if i not in done][:new]:
        done[number] = case = run_case(number)
        print(_line(case), flush=True)
        if record is not None:
            with record.open("a") as file:
                file.write(json.dumps(asdict(case)) + "\n")
    return [done[i] for i in numbers if i in done]


def _line(case: BlindCase) -> str:
    found = "-" if case.found is None else f"{case.found:+.4g}"
    named = ", ".join(case.named) or "nothing"
    mark = " " if case.is_right else "!"
    found += "" if case.sigma is None else f" +- {case.sigma:.2g}{'' if case.is_in_interval else ' off'}"
    hidden_cause = f"{case.cause or 'nothing':24} {case.size:+8.4g} {found:>18}"
    return f"{mark} {case.robot:10} {case.route:9} {hidden_cause} {case.verdict}: {named} {case.others or ''}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="0:64", metavar="A:B")
    parser.add_argument("--record", type=Path, default=None)
    parser.add_argument("--new", type=int, default=None, help="at most so many cases that are not in the record")
    given = parser.parse_args()
    found = cases(range(*map(int, given.cases.split(":"))), given.record, given.new)
    hidden_cases, nulls = [c for c in found if c.cause], [c for c in found if not c.cause]
    for case in found:
        print(_line(case))
    right, quiet = sum(c.is_right for c in hidden_cases), sum(c.is_right for c in nulls)
    share = 100 * right / max(len(hidden_cases), 1)
    shown = [c for c in hidden_cases if c.is_shown]
    print(f"{sum(c.is_right for c in shown)} of {len(shown)} hidden causes over {STRONG:g} sigma named")
    intervals = [c.is_in_interval for c in hidden_cases if c.is_in_interval is not None]
    print(f"{sum(intervals)} of {len(intervals)} 95 % intervals hold the true size")
    print(f"{right} of {len(hidden_cases)} hidden causes named ({share:.0f} %), {quiet} of {len(nulls)} drives without one have no finding")


if __name__ == "__main__":
    main()
