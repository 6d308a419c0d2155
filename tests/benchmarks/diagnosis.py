"""How often the diagnosis is right: every cause at three sizes, pairs and nulls, beside other methods.

`SKIDLOC_SEEDS=3 python -m tests.benchmarks.diagnosis [FOLDER]` runs so many seeds of each case and keeps a row for each in FOLDER/rows.csv
as it goes (default: diagnosis-benchmark); started again, it goes on where it was. Tables and confusion.png come from the rows.
With SKIDLOC_DRIVES=FOLDER the drives are kept, so that another method can be tried on them without simulating anew.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from localization.diagnosis.causes import Cause
from localization.diagnosis.diagnose import TOLERANCES, examine
from localization.diagnosis.drive import Drive, drive_of_log
from localization.diagnosis.linearization import Linearization, linearize, make_regression
from localization.logs import open_log
from motion_models.registry import make_model
from tests.helpers.diagnosis_drives import ONE_SIDED, TYPICAL, bag, drive, robot_named
from tests.helpers.diagnosis_rivals import NONE, oracle, rivals
from tests.helpers.diagnosis_scores import COLUMNS, report

Kind = Literal["single", "null", "pair", "alike"]
SIZES = (0.5, 1.0, 2.0)
PAIRS = (
    ("cg_offset_x", "lidar_yaw"),
    ("wheel_radius_difference", "friction_anisotropy"),
    ("track_width", "lidar_time_offset"),
    ("lidar_offset_x", "slope"),
    ("payload", "gyro_bias"),
    ("wheel_radius_scale", "tread_asymmetry"),
)
ALIKE: tuple[tuple[tuple[str, str], str, str, float], ...] = (
    (("payload", "cg_offset_x"), "husky_a200", "tour", 50.0),
    (("lidar_time_offset", "wheel_time_offset"), "vaultbot", "tour", 0.0),
    (("track_width", "friction_anisotropy"), "husky_a200", "spin", 50.0),
)
"""Causes that cannot be told apart: without arms a payload over the front edge is a shift of the CG; without a gyro only the clocks'
difference shows; turns in place with one CG show one number, by how much the robot turns less."""
NULLS = (
    ("vaultbot", "tour"),
    ("husky_a200", "tour"),
    ("vaultbot", "random_1"),
    ("jackal", "tour"),
    ("vaultbot", "laps"),
    ("husky_a200", "random_2"),
    ("vaultbot", "payload_pickup"),
    ("vaultbot", "40s"),
    ("jackal", "random_3"),
    ("vaultbot", "20s"),
)


@dataclass(frozen=True)
class Case:
    """What is hidden in which drive."""

    kind: Kind
    effects: Mapping[str, float]
    robot: str
    drive: str
    seed: int
    imu_hz: float = 50.0
    alike: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        said = "+".join(f"{name}={size:g}" for name, size in self.effects.items()) or NONE
        return f"{self.kind} {self.robot} {self.drive} {said} {self.seed}" + ("" if self.imu_hz else " no IMU")


def cases(seeds: int) -> Iterator[Case]:
    """Seed by seed, so that wherever it is stopped every kind has had its share."""
    for k in range(seeds):
        singles = []
        for n, (cause, typical) in enumerate(TYPICAL.items()):
            for j, factor in enumerate(SIZES):
                sign = 1.0 if cause in ONE_SIDED or (n + j + k) % 2 == 0 else -1.0
                singles.append(Case("single", {cause: sign * factor * typical}, "vaultbot", "tour", 6000 + 1000 * k + 10 * n + j))
        nulls = [Case("null", {}, *NULLS[i % len(NULLS)], seed=20_000 + 100 * k + i) for i in range(20)]  # the same drives, other noise
        several = []
        for i, pair in enumerate(PAIRS):
            sizes = {name: TYPICAL[name] * (1.0 if name in ONE_SIDED or (i + k + m) % 2 else -1.0) for m, name in enumerate(pair)}
            several.append(Case("pair", sizes, "vaultbot", "tour", 30_000 + 100 * k + i))
        for i, (pair, robot, route, imu_hz) in enumerate(ALIKE):
            name = pair[k % 2]
            several.append(Case("alike", {name: TYPICAL[name]}, robot, route, 40_000 + 100 * k + i, imu_hz, pair))
        others = []
        while nulls or several:
            others += nulls[:2] + several[:1]
            nulls, several = nulls[2:], several[1:]
        # three of the one, then one of the other
        while singles or others:
            yield from singles[:3]
            yield from others[:1]
            singles, others = singles[3:], others[1:]


def drive_of(case: Case) -> Drive:
    """As the diagnosis sees it."""
    keep = os.environ.get("SKIDLOC_DRIVES")
    kept = Path(keep) / f"{case.key}.pickle" if keep else None
    if kept is not None and kept.exists():
        return pickle.loads(kept.read_bytes())  # type: ignore[no-any-return]
    robot = robot_named(case.robot)
    with tempfile.TemporaryDirectory() as folder:
        log = bag(Path(folder) / "drive.mcap", case.effects, case.seed, case.robot, drive(case.drive), imu_hz=case.imu_hz)
        found = drive_of_log(open_log(log, robot))
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps(found))
    return found


def run(case: Case) -> dict[str, Any]:
    """One row."""
    seen = drive_of(case)
    begin = time.process_time()
    found = examine(seen, make_model("friction", seen.robot))
    seconds = time.process_time() - begin
    d = found.diagnosis
    row: dict[str, Any] = {
        "key": case.key,
        "kind": case.kind,
        "truth": json.dumps(dict(case.effects)),
        "alike": json.dumps(case.alike),
        "verdict": d.verdict,
        "findings": json.dumps(
            [{"cause": f.cause, "size": f.size, "sigma": f.sigma, "p": f.p_value, "aliases": dict(f.aliases)} for f in d.findings]
        ),
        "seconds": round(seconds, 2),
    }
    if found.predictor is None or found.linearization is None:
        return row
    pipeline, state = found.predictor, found.linearization
    looked = linearize(pipeline, state.causes, {}, TOLERANCES[0])
    problem = make_regression(looked.linear, looked.signatures, looked.nuisances, state.noise, looked.causes, TOLERANCES[0])
    nominal = dataclasses.replace(looked, noise=state.noise, problem=problem)
    said = {name: [name_, round(gain, 5)] for name, (name_, gain) in rivals(seen, pipeline, nominal).items()}
    row["rivals"] = json.dumps(said)
    row["gain"] = round(d.gain.relative, 5) if d.gain is not None else 0.0
    if case.effects:
        row["oracle"] = round(oracle(pipeline, nominal, dict(case.effects)), 5)
        row["significance"] = json.dumps({name: significance(nominal, case.effects, name) for name in case.effects})
        row["rms"] = json.dumps({name: loudness(nominal, name, size) for name, size in case.effects.items()})
    return row


def significance(state: Linearization, effects: Mapping[str, float], name: str) -> float | None:
    """Of effect ``name``: its size over the sigma with which this drive can measure it, while the other hidden causes are free and all
    others keep within their tolerance. None if the drive does not show the cause at all."""
    problem = state.problem
    own = _columns(state, name)
    if not own:
        return None
    given = tuple(i for other in effects if other != name for i in _columns(state, other))
    cov = problem.scores(given, own)[1]
    return round(float(np.sqrt(cov[0, 0]) * abs(effects[name]) / problem.scale[own[0]]), 2)


def loudness(state: Linearization, name: str, size: float) -> float | None:
    """Root mean square over the windows of what the effect does, over their noise, in the channel where that is most."""
    own = _columns(state, name)
    if not own:
        return None
    part = np.nan_to_num(state.signatures[..., own[0]] * size / state.noise.sigmas)
    return round(float(np.sqrt(np.mean(part**2, axis=0)).max()), 2)


def _columns(state: Linearization, name: str) -> list[int]:
    """Where the cause is among the state's, at most one."""
    return [i for i, e in enumerate(state.causes) if e.id == name and _is_true(e, state)]


def _is_true(effect: Cause, state: Linearization) -> bool:
    """Of many moments the middle one; of two slopes the one along the first heading, which is the world's x."""
    if effect.id == "friction_change":
        moments = [e.at_s for e in state.causes if e.id == "friction_change" and e.at_s is not None]
        return effect.at_s == moments[len(moments) // 2]
    return effect.id != "slope" or effect.at_s is None


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 and __name__ == "__main__" else "diagnosis-benchmark")
    folder.mkdir(parents=True, exist_ok=True)
    rows = folder / "rows.csv"
    done = set()
    if rows.exists():
        with rows.open(newline="") as file:
            done = {row["key"] for row in csv.DictReader(file)}
    for case in cases(int(os.environ.get("SKIDLOC_SEEDS", "1"))):
        if case.key in done:
            continue
        row = run(case)
        with rows.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
        said = ", ".join(f"{f['cause']} {f['size']:+.3g}" for f in json.loads(row["findings"]))
        print(f"{case.key:60s} -> {row['verdict']:12s} {said}", flush=True)
    print(report(rows, folder / "confusion.png"))


if __name__ == "__main__":
    main()
