"""Robot files that a diagnosis hands over, on simulated drives: odometry and EKF on a fresh drive with the file before and after.

python -m tests.studies.handover_simulated [--cases 2000:2032] [--record FILE.jsonl]

A case is one of `tests.benchmarks.diagnosis.case_of`: a cause of a quarter to twice its typical size, hidden in one of four robots (the
VaultBot has arms), which also deviates from its file by what files are accurate to. The drive is diagnosed (`skidloc diagnose --out`) by
friction and by skid_steer; the robot file that it wrote is read again, and a fresh drive of the same robot, of another route and seed, is
replayed with both files: that by friction with either model. Errors are ATE against the simulator's own poses [m]. A filter's error moves
with its first scan alone, so that the fresh drive is replayed from two begins: mean of the errors, and the change of each begin.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from localization.commands.diagnose import Diagnose
from localization.evaluation.metrics import evaluate
from localization.evaluation.reference_files import load_reference
from localization.log_replay import replay
from localization.logs import open_log
from localization.pipeline import Trial
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot, robot_toml
from tests.benchmarks.diagnosis import Case, case_of
from tests.helpers.diagnosis_drives import bag, drive, robot_named

ESTIMATORS = ("odometry", "ekf")
DIAGNOSED = {"friction": ("friction", "skid_steer"), "skid_steer": ("skid_steer",)}
"""Models by which a drive is diagnosed, and those with which the file is replayed."""
BEGINS_S = (0.0, 1.0)
"""After the log's first message; drives begin with two seconds at rest."""
WORSE = 1.02
_FRESH = 100_000
"""Of the fresh drive's route and seed, above those of the case."""
_TRUTH = "/ground_truth/odom"


def errors(log_path: Path, robot: Robot, model: str) -> list[list[float]]:
    """ATE [m] of each of `ESTIMATORS`, for each of `BEGINS_S`."""
    log = open_log(log_path, robot)
    events, truth = list(log.events()), load_reference(log, _TRUTH)
    found = []
    for begin_s in BEGINS_S:
        start_ns = events[0].stamp_ns + round(begin_s * 1e9)
        trials = [Trial(make_model(model, robot), estimator) for estimator in ESTIMATORS]
        runs = replay([e for e in events if e.stamp_ns >= start_ns], trials, robot, log.mounts, has_lidar=True)
        found.append([evaluate(run.trajectory, truth).ate_rmse_m for run in runs])
    return np.transpose(found).tolist()  # type: ignore[no-any-return]


def run(case: Case) -> list[dict[str, Any]]:
    """A row for each model that diagnoses, and each that replays."""
    robot, rows = robot_named(case.robot), []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        file = folder / "nominal.toml"
        file.write_text(robot_toml(robot), encoding="utf-8")
        log = bag(folder / "drive.mcap", case.simulated, case.seed, case.robot, drive(case.drive))
        fresh = bag(folder / "fresh.mcap", case.simulated, case.seed + _FRESH, case.robot, drive(f"random_{case.number + _FRESH}"))
        old = load_robot(file)
        before: dict[str, list[list[float]]] = {}
        for model, replayed in DIAGNOSED.items():
            begin, out = time.process_time(), folder / model
            Diagnose(log, str(file), model=model, out=out, static=True).run(Console(file=(folder / "printed.txt").open("w")))
            written, new = json.loads((out / "diagnosis.json").read_text()), load_robot(out / "robot.toml")
            row = {
                "number": case.number,
                "robot": case.robot,
                "model": model,
                "truth": dict(case.effects),
                "verdict": written["verdict"],
                "findings": [f["cause"] for f in written["findings"]],
                "seconds": round(time.process_time() - begin, 1),
            }
            for name in replayed if robot_toml(new) != robot_toml(old) else ():
                if name not in before:
                    before[name] = errors(fresh, old, name)
                rows.append({**row, "replayed": name, "before": before[name], "after": errors(fresh, new, name)})
            if robot_toml(new) == robot_toml(old):
                rows.append(row)
    return rows


def report(rows: list[dict[str, Any]]) -> str:
    """How many files make each estimator better, and worse by more than 2 %."""
    lines = []
    pairs = [(model, name) for model, names in DIAGNOSED.items() for name in names]
    for model, name in pairs:
        own = [r for r in rows if r["model"] == model]
        written = [r for r in own if r.get("replayed") == name]
        explained = sum(r["verdict"] == "explained" for r in written)
        lines.append(f"diagnosed by {model}, replayed by {name}: {len(written)} files, {explained} of explained drives")
        for i, estimator in enumerate(ESTIMATORS):
            ratios = np.array([np.mean(r["after"][i]) / np.mean(r["before"][i]) for r in written])
            if len(ratios):
                counts = f"better {np.sum(ratios < 1.0)}, worse by more than 2 % {np.sum(ratios > WORSE)}"
                lines.append(f"  {estimator}: {counts}, median {np.median(ratios):.3f}, largest {ratios.max():.3f} of the error before")
    return "\n".join(lines)


def _shown(row: dict[str, Any]) -> str:
    hidden = ", ".join(f"{name} {size:+.3g}" for name, size in row["truth"].items()) or "nothing"
    models = f"{row['model']}/{row['replayed']}" if "replayed" in row else row["model"]
    head = f"{row['number']} {row['robot']:10s} {models:21s} {hidden:32s} -> {row['verdict']:11s} {', '.join(row['findings']):40s}"
    if "before" not in row:
        return f"{head} no file"
    parts = []
    for i, estimator in enumerate(ESTIMATORS):
        before, after = np.array(row["before"][i]), np.array(row["after"][i])
        change = 100.0 * (after / before - 1.0)
        parts.append(f"{estimator} {before.mean():.4f} -> {after.mean():.4f} m ({change.mean():+.1f} %, sd {change.std(ddof=1):.1f})")
    return f"{head} {'; '.join(parts)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="2000:2032", metavar="A:B[:STEP]")
    parser.add_argument("--record", type=Path, default=None, metavar="FILE", help="rows; cases that it has are not run again")
    given = parser.parse_args()
    has_rows = given.record is not None and given.record.exists()
    rows = [json.loads(line) for line in given.record.read_text().splitlines()] if has_rows else []
    numbers = range(*map(int, given.cases.split(":")))
    done = {row["number"] for row in rows}
    for number in numbers:
        if number in done:
            continue
        for row in run(case_of(number)):
            rows.append(row)
            print(_shown(row), flush=True)
            if given.record is not None:
                with given.record.open("a") as file:
                    file.write(json.dumps(row) + "\n")
    print(report([row for row in rows if row["number"] in numbers]))


if __name__ == "__main__":
    main()
