"""Robot files that a diagnosis hands over, on measured logs: estimators with the file before and after, against poses that were no input.

python -m tests.studies.handover_real [--log aces,fr079,mit-csail] [--folder FOLDER]

The log is diagnosed by its scans and wheels alone (`skidloc diagnose --out`) and replayed with both files (`skidloc replay`); the reference
is scored against, and nothing else. Errors are ATE, for ACES the mean error of the relations, in metres.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console

from localization.commands.diagnose import Diagnose
from localization.commands.replay import Replay

_DATA = Path(__file__).parents[1] / "data"
LOGS: dict[str, dict[str, Any]] = {
    "aces": {"log": "aces/aces.mcap", "robot": "aces", "reference": "aces/aces.relations"},
    "fr079": {"log": "fr079/fr079.mcap", "robot": "fr079/fr079.toml", "reference": "fr079/fr079_reference.tum"},
    "mit-csail": {"log": "mit-csail/csail.mcap", "robot": "mit-csail/csail.toml", "reference": "mit-csail/csail_reference.tum"},
}
ESTIMATORS = ("odometry", "ekf", "graph")
_SCORES = ("relations_all_translation_m", "ate_rmse_m")


def _robot(name: str) -> str:
    path = _DATA / name
    return str(path) if path.is_file() else name


def handed_over(log: str, folder: Path, console: Console) -> str:
    """Diagnose ``log`` into ``folder``; the robot file that it wrote."""
    entry = LOGS[log]
    out = folder / f"{log}-diagnosis"
    if not out.exists():
        Diagnose(_DATA / entry["log"], _robot(entry["robot"]), out=out).run(console)
    return str(out / "robot.toml")


def errors(log: str, robot: str, out: Path, console: Console) -> dict[str, float]:
    """Error of each estimator with the file ``robot`` [m]."""
    entry = LOGS[log]
    if not out.exists():
        reference = str(_DATA / entry["reference"])
        estimators = ",".join(ESTIMATORS)
        Replay(_DATA / entry["log"], robot, out, model="diff_drive", estimator=estimators, reference=reference, static=True).run(console)
    runs = json.loads((out / "metrics.json").read_text())["results"]
    return {run["estimator"]: next(float(run[key]) for key in _SCORES if run.get(key) is not None) for run in runs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", default=",".join(LOGS))
    parser.add_argument("--folder", type=Path, default=None, help="keeps what was written, and is continued")
    options = parser.parse_args()
    console = Console(width=200)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        rows = []
        for log in options.log.split(","):
            new = handed_over(log, folder, console)
            before = errors(log, _robot(LOGS[log]["robot"]), folder / f"{log}-before", console)
            after = errors(log, new, folder / f"{log}-after", console)
            rows.append(f"{log:10s}" + "".join(f"  {before[name]:8.4f} -> {after[name]:8.4f}" for name in ESTIMATORS))
    print(f"{'':10s}" + "".join(f"  {name:>20s}" for name in ESTIMATORS))
    print("\n".join(rows))


if __name__ == "__main__":
    main()
