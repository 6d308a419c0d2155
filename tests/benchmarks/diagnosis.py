"""How often the diagnosis is right: every cause on four robots, from a quarter of its typical size to twice it, pairs and nulls.

`python -m tests.benchmarks.diagnosis [--cases A:B[:STEP]] [--out FILE.jsonl] [--drives FOLDER] [--rivals]` runs cases A to B-1 of 1,500
(default: all; a STEP such as 37 takes a share of them with all causes, robots and kinds) and appends a row for each to FILE (default:
diagnosis-benchmark.jsonl); cases that FILE has are not run again, so that it can be stopped at any time. Drives are kept in FOLDER, if one
is given: to diagnose them again takes a third of the time.
A case is determined by its number. No robot is exactly as its file: beside what is hidden, geometry, mounts, clocks, floor and gyro of each
deviate by as much as the diagnosis takes for the accuracy of robot files (`TOLERANCE`), and intervals are to hold the hidden size.
Tables come from the rows: `--report` prints them without running anything.

`--public [--quick] [--sources simulator,mujoco,windows,fr079,csail] [--out FILE.jsonl] [--drives FOLDER]` runs the public benchmark
instead (`tests.helpers.diagnosis_public`): effects of 32 kinds, most in no list, and other methods beside the diagnosis.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pickle
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Cause, with_sizes
from localization.diagnosis.diagnose import TOLERANCE, examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.findings import Finding
from localization.diagnosis.linearization import Linearization, linearize, make_regression
from localization.diagnosis.result import DiagnosisResult
from localization.logs import open_log
from localization.simulation.injected_faults import FAULTS
from motion_models.registry import make_model
from tests.helpers.diagnosis_drives import ONE_SIDED, TYPICAL, bag, drive, robot_named
from tests.helpers.diagnosis_public import (
    EFFECTS,
    FLAT_K,
    METHODS,
    QUICK,
    SOURCES,
    acts_on,
    baseline_of,
    cases,
    flat_k,
    is_installed,
    score,
    simulate,
    table,
)
from tests.helpers.diagnosis_rivals import oracle, rivals
from tests.helpers.diagnosis_scores import report

Kind = Literal["single", "null", "pair"]
CASES = 1500
_BLOCK = 25  # of so many cases 5 are nulls and one is a pair
_ROBOTS = ("vaultbot", "husky_a200", "jackal", "warthog")
_SEED = 7_000_000
_MIN_FACTOR, _MAX_FACTOR = 0.25, 2.0  # of the typical size
_DEVIATING = (
    *("wheel_radius_scale", "wheel_radius_difference", "track_width", "cg_offset_x", "cg_offset_y", "lidar_offset_x", "lidar_offset_y"),
    *("lidar_yaw", "lidar_time_offset", "wheel_time_offset", "friction_anisotropy", "diagonal_load", "tread_asymmetry"),
    "gyro_scale",
)
_PAYLOAD_SHARE = 10.0 / 119.0  # of the robot's mass: the typical payload is that of VaultBot


@dataclass(frozen=True)
class Case:
    """What is hidden in which drive."""

    number: int
    kind: Kind
    effects: Mapping[str, float]
    robot: str
    drive: str
    deviations: Mapping[str, float]
    """Of the robot from its file, by cause."""

    @property
    def seed(self) -> int:
        return _SEED + self.number

    @property
    def simulated(self) -> dict[str, float]:
        """What is hidden and what deviates, together."""
        return {name: self.effects.get(name, 0.0) + self.deviations.get(name, 0.0) for name in {**self.effects, **self.deviations}}


def case_of(number: int) -> Case:
    """The case of this number: each cause, robot and kind in turn, sizes and routes by chance."""
    rng = np.random.default_rng(_SEED + number)
    place, causes = number % _BLOCK, list(TYPICAL)
    kind: Kind = "null" if place % 5 == 4 else "pair" if place == 3 else "single"
    robot = _ROBOTS[(number + number // len(_ROBOTS)) % len(_ROBOTS)]
    route = f"random_{number}" if number % 3 else "tour"
    effects = {}
    if kind != "null":
        first = number % len(causes)
        chosen = [causes[first]] if kind == "single" else [causes[first], causes[(first + int(rng.integers(1, len(causes)))) % len(causes)]]
        effects = {name: _size(name, robot, rng) for name in chosen}
    deviations = {name: float(rng.normal(0.0, TOLERANCE * CAUSES[name].negligible)) for name in _DEVIATING}
    return Case(number, kind, effects, robot, route, deviations)


def _size(cause: str, robot: str, rng: np.random.Generator) -> float:
    """Log-uniform from a quarter of the typical size to twice it, or to what the simulator applies."""
    factor = float(np.exp(rng.uniform(np.log(_MIN_FACTOR), np.log(_MAX_FACTOR))))
    typical = _PAYLOAD_SHARE * robot_named(robot).geometry.mass_kg if cause == "payload" else TYPICAL[cause]
    if cause == "lateral_force_law":
        factor = min(factor, 1.0)  # the whole of the other law
    sign = 1.0 if cause in ONE_SIDED or rng.random() < 0.5 else -1.0
    return round(sign * min(factor * typical, FAULTS[cause].largest), 6)


def drive_of(case: Case, kept_in: Path | None = None) -> Drive:
    """What the diagnosis gets: the log alone, and the nominal robot; read from the folder ``kept_in`` if it is there."""
    if kept_in is not None:
        kept = kept_in / f"{case.number}.pickle"
        if not kept.exists():
            kept_in.mkdir(parents=True, exist_ok=True)
            kept.write_bytes(pickle.dumps(drive_of(case)))
        return pickle.loads(kept.read_bytes())  # type: ignore[no-any-return]
    robot = robot_named(case.robot)
    with tempfile.TemporaryDirectory() as folder:
        log = bag(Path(folder) / "drive.mcap", case.simulated, case.seed, case.robot, drive(case.drive))
        return drive_of_log(open_log(log, robot))


def run(case: Case, has_rivals: bool, kept_in: Path | None = None) -> dict[str, Any]:
    """One row."""
    begin = time.process_time()
    measured = drive_of(case, kept_in)
    found = examine(measured, make_model("friction", measured.robot))
    seconds = time.process_time() - begin
    d = found.diagnosis
    row: dict[str, Any] = {
        "number": case.number,
        "kind": case.kind,
        "robot": case.robot,
        "drive": case.drive,
        "truth": dict(case.effects),
        "verdict": d.verdict,
        "findings": [finding_row(f) for f in d.findings],
        "suspected": [finding_row(f) for f in (d.suspected,) if f is not None],
        "left": [t.text for t in d.trends] + [f"{name} row" for name, c in d.discrepancy.items() if c.status == "unexplained"],
        "seconds": round(seconds, 2),
    }
    if found.predictor is None or found.linearization is None:
        return row
    row["significance"] = significances(found, case.effects)
    row["tolerated"] = {
        name: max((e.negligible for e in found.linearization.causes if e.id == name), default=None) for name in case.effects
    }
    if has_rivals:
        pipeline, nominal = found.predictor, nominal_state(found, {})
        row["gain"] = round(d.gain.relative, 5) if d.gain is not None else 0.0
        row["oracle"] = round(oracle(pipeline, nominal, dict(case.effects)), 5)
        row["rivals"] = {name: [first, round(gain, 5)] for name, (first, gain) in rivals(measured, pipeline, nominal).items()}
    return row


def finding_row(f: Finding) -> dict[str, Any]:
    """A finding in a row of the table."""
    return {"cause": f.cause, "size": f.size, "sigma": f.sigma, "p": f.p_value, "aliases": dict(f.aliases)}


def nominal_state(found: DiagnosisResult, effects: Mapping[str, float]) -> Linearization:
    """The drive of ``found`` about the robot file, in the noise that was left in the end; signatures of the ``effects`` are those of their
    whole sizes, as some bend."""
    assert found.predictor is not None
    assert found.linearization is not None
    last = found.linearization
    first = linearize(found.predictor, last.causes, {}, TOLERANCE)
    for name, size in effects.items():
        for i in _columns(first, name):
            ahead = found.predictor.discrepancies(with_sizes({first.causes[i]: size}))
            first.signatures[..., i] = (first.rows - ahead) / size
    problem = make_regression(first.linear, first.signatures, first.nuisances, last.noise, first.causes, TOLERANCE)
    return dataclasses.replace(first, noise=last.noise, problem=problem)


def significances(found: DiagnosisResult, effects: Mapping[str, float]) -> dict[str, float | None]:
    """Of each of the hidden ``effects``: its size over the sigma with which this drive can measure it, while the other hidden causes are
    free and all others keep within their tolerance. None for a cause that the drive does not show at all."""
    if not effects or found.linearization is None:
        return {}
    state = nominal_state(found, effects)
    result: dict[str, float | None] = {}
    for name, size in effects.items():
        own = _columns(state, name)
        given = tuple(i for other in effects if other != name for i in _columns(state, other))
        cov = state.problem.scores(given, own)[1]
        result[name] = round(float(np.sqrt(cov[0, 0]) * abs(size) / state.problem.scale[own[0]]), 2) if own else None
    return result


def _columns(state: Linearization, name: str) -> list[int]:
    """Where the cause is among the state's, at most one."""
    return [i for i, e in enumerate(state.causes) if e.id == name and _is_true(e, state)]


def _is_true(effect: Cause, state: Linearization) -> bool:
    """Of many moments the middle one; of two slopes the one along the first heading, which is the world's x."""
    if effect.id == "friction_change":
        moments = [e.at_s for e in state.causes if e.id == "friction_change" and e.at_s is not None]
        return effect.at_s == moments[len(moments) // 2]
    return effect.id != "slope" or effect.at_s is None


def run_public(sources: tuple[str, ...], names: tuple[str, ...], out: Path, folder: Path | None) -> None:
    """Run the cases that the file ``out`` does not have, append a row for each method, and print the table."""
    folder = folder or Path(tempfile.mkdtemp())
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    done = {(row["source"], row["effect"], row["method"]) for row in rows}
    methods = [method for method in METHODS if is_installed(method)]
    for source in sources:
        k = flat_k(simulate(source, "train", "", 0.0, folder)) if source == "mujoco" else FLAT_K[0]
        if not FLAT_K[0] <= k <= FLAT_K[1]:
            raise SystemExit(f"{source}: k of turns in place is {k:.3f}, and {FLAT_K[0]} to {FLAT_K[1]} on real floors.")
        if source == "mujoco":
            print(f"mujoco: k of turns in place on flat ground {k:.3f}")
        baseline = baseline_of(source, folder)
        for _, name, *drives in cases((source,), names, folder):
            if name != "nothing" and not acts_on(drives[0], simulate(source, "train", "", 0.0, folder)):
                print(f"{source:10s} {name:36s} does not act on this drive")
                continue
            for method in methods:
                if (source, name, method) in done:
                    continue
                row = {"source": source, **score(method, name, (drives[0], drives[1], drives[2]), baseline)}
                rows.append(row)
                with out.open("a") as file:
                    file.write(json.dumps(row) + "\n")
                shown = f"{row['removed']:+.2f} removed" if row["removed"] == row["removed"] else ""
                print(f"{source:10s} {name:36s} {method:28s} {', '.join(row['names'][:2]) or '-':60s} {shown}", flush=True)
    print(table([row for row in rows if row["source"] in sources and row["effect"] in names]))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=f"0:{CASES}", metavar="A:B[:STEP]")
    parser.add_argument("--out", type=Path, default=Path("diagnosis-benchmark.jsonl"), metavar="FILE")
    parser.add_argument("--drives", type=Path, default=None, metavar="FOLDER")
    parser.add_argument("--rivals", action="store_true", help="other methods on the same signatures as well")
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--public", action="store_true", help="effects of all kinds, and other methods beside the diagnosis")
    parser.add_argument("--quick", action="store_true", help="with --public: five effects, in minutes")
    parser.add_argument("--sources", default=",".join(SOURCES), help="with --public: generators of drives")
    options = parser.parse_args(arguments if arguments is not None else ([] if __name__ != "__main__" else None))
    if options.public:
        run_public(tuple(options.sources.split(",")), QUICK if options.quick else tuple(EFFECTS), options.out, options.drives)
        return
    numbers = range(*(int(number) for number in options.cases.split(":")))
    rows = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    done = {row["number"] for row in rows}
    for number in numbers if not options.report else ():
        if number in done:
            continue
        row = run(case_of(number), options.rivals, options.drives)
        rows.append(row)
        with options.out.open("a") as file:
            file.write(json.dumps(row) + "\n")
        named = ", ".join(f"{f['cause']} {f['size']:+.3g}" for f in row["findings"])
        hidden = ", ".join(f"{name} {size:+.3g}" for name, size in row["truth"].items()) or "nothing"
        print(f"{number:5d} {row['robot']:10s} {hidden:40s} -> {row['verdict']:12s} {named}", flush=True)
    print(report([row for row in rows if row["number"] in numbers]))


if __name__ == "__main__":
    main()
