"""Run skidloc and its peers on the same logs, with the defaults of each or tuned on another log, and judge them by evo and smfeval.

python -m tests.league [--log fr079,csail,aces,hills-trees,hills-grass] [--system NAME,...] [--folder MY_LOGS] [--out league-out]
    [--peer NAME=PATH ...] [--tune LOG] [--budget 40] [--write]

Peers are installed into .league/, an environment of their own, from tests/league/requirements.txt; what cannot be installed or crashes
is a row with the reason, and is tried again by the next run. What has been run is kept in the output folder and is not run again: delete a
file to run it anew. All of it takes some ten minutes. MRPT is of Debian (`apt install mrpt-apps mrpt-common`). The page
league.html has tables, plots and settings; league.json the numbers. CPU seconds are those of the estimate alone, of all its threads,
without reading the log. `--peer` adds a system that is built from sources in PATH, or a folder of finished LOG.tum files (`joined`).
`--tune` gives each peer with settings of its own a row more on every other log: those settings that were best on LOG, of at most
`--budget` drawn from its grid. skidloc is never tuned: its rows are its defaults. `--folder` adds NAME.mcap with NAME.toml and a
reference NAME.tum, .csv, .txt or .relations beside it. `--write` puts what was run into the tables of docs/lab/league.md and README.md.
"""

from __future__ import annotations

import argparse
import json
import math
import operator
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from localization.evaluation.metrics import relation_errors
from localization.evaluation.references import ReferenceTrack, Relations
from localization.trajectory import Trajectory
from tests.league import joined, page, tables, tuning
from tests.league.hills import HILLS, SECONDS
from tests.league.logs import find_logs, peer_arrays
from tests.league.systems import PEERS, SYSTEMS, SYSTEMS_IN_SPACE, System
from tests.studies.buildings import REFERENCE_SIGMA, SHORT_S, Building, Drive

_ENVIRONMENT = Path(".league")
_TIMEOUT_S = 3600.0
NO_SETTINGS: Mapping[str, float] = {}
_ALL = (*SYSTEMS, *SYSTEMS_IN_SPACE)


def prepare_environment() -> None:
    """Make the peers' environment, each package by itself, so that the others stay without one; the next run tries that again."""
    if not _python().exists():
        subprocess.run([sys.executable, "-m", "venv", str(_ENVIRONMENT)], check=True)
    ready = _ENVIRONMENT / "ready.txt"
    installed = ready.read_text().split() if ready.exists() else []
    for line in (Path(__file__).parent / "requirements.txt").read_text().split():
        if line in installed:
            continue
        print(f"installing {line}", flush=True)
        command = [str(_python()), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", line]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            installed.append(line)
            ready.write_text("\n".join(installed))
        else:
            print(f"not installed: {(done.stderr.strip().splitlines() or ['pip ended without a word'])[-1]}", flush=True)


def _python() -> Path:
    return _ENVIRONMENT / "bin" / "python"


def run_system(system: System, log: str, out: Path, folder: Path | None, settings: Mapping[str, float] = NO_SETTINGS) -> str:
    """Run ``system`` on ``log`` unless its result is there. Returns why it failed, or an empty string. ``settings`` that are not its
    defaults are part of the result's name."""
    target = out / log / tuning.name_with(system.name, settings)
    if target.with_name(f"{target.name}.json").exists():
        return ""
    pairs = [f"{name}={value:g}" for name, value in settings.items()]
    if system.folders and not system.tuned:
        return joined.take_trajectory(system, log, target)
    if system.folders:
        try:
            program = joined.build(system.name, system.folders, out)
        except SystemExit as reason:
            return str(reason)
        script = PEERS / "source.py"
        command = [sys.executable, str(script), str(out / log / "drive.npz"), str(target), system.name, str(program), *pairs]
    elif system.in_space is not None:
        peers = next((_ENVIRONMENT / "lib").glob("python*/site-packages"), _ENVIRONMENT)
        command = [sys.executable, "-m", "tests.league.hills", log, system.in_space, str(peers), str(target)]
    elif system.peer:
        command = [str(_python()), str(PEERS / f"{system.peer}.py"), str(out / log / "drive.npz"), str(target), *pairs]
    else:
        command = [
            sys.executable,
            "-m",
            "tests.league.ours",
            log,
            system.estimator,
            system.matcher,
            str(target),
            *([str(folder)] if folder else []),
        ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return f"not finished after {_TIMEOUT_S:.0f} s"
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]


def write_reference(drive: Drive, path: Path) -> None:
    """Write the reference's poses for the judge, with the noise of a pose (tests/data/*/SOURCE.txt) where it has no covariance."""
    track = drive.reference
    assert isinstance(track, ReferenceTrack)
    noise = np.broadcast_to(np.diag(REFERENCE_SIGMA**2), (len(track.stamps_ns), 3, 3))
    given = noise if track.covariances is None else np.where(np.isfinite(track.covariances), track.covariances, noise)
    np.savez_compressed(path, stamps_ns=track.stamps_ns, poses=track.poses, covariances=given)


def judge(estimate: Path, reference: Path | Relations) -> dict[str, Any]:
    """Scores, or a failure: by `peers/judge.py`; of relations, which evo does not have, mean errors of all and of those under 20 s."""
    if isinstance(reference, Path):
        done = subprocess.run(
            [str(_python()), str(PEERS / "judge.py"), str(estimate), str(reference)], capture_output=True, text=True, check=False
        )
        if done.returncode:
            return {"failure": f"not judged: {(done.stderr.strip().splitlines() or ['the judge ended without a word'])[-1]}"}
        return dict(json.loads(done.stdout))
    with np.load(estimate) as arrays:
        found = relation_errors(Trajectory(arrays["stamps_ns"], arrays["poses"]), reference)
    return {"ate_m": float(found.translation_m.mean()), "rpe_m": float(found.translation_m[found.spans_s < SHORT_S].mean())}


def prepare_log(log: str, building: Building, out: Path) -> tuple[Path | Relations, float]:
    """The reference of a log for the judge, and its length [s]; what peers are given is written into ``out``."""
    drive = building.open()
    (out / log).mkdir(parents=True, exist_ok=True)
    if not (out / log / "drive.npz").exists():
        peer_arrays(drive).save(out / log / "drive.npz")
    reference: Path | Relations = drive.reference if isinstance(drive.reference, Relations) else out / log / "reference.npz"
    if isinstance(reference, Path):
        write_reference(drive, reference)
    return reference, (drive.events[-1].stamp_ns - drive.events[0].stamp_ns) * 1e-9


def rows_of(
    log: str, building: Building, systems: Sequence[tuple[System, tuning.Tuned | None]], out: Path, folder: Path | None
) -> list[dict[str, Any]]:
    """A row for each kind of poses of each system on one log."""
    reference, seconds = prepare_log(log, building, out)
    rows: list[dict[str, Any]] = []
    floor = {} if isinstance(reference, Relations) else {"floor_m": math.hypot(*REFERENCE_SIGMA[:2])}
    for system, tuned in systems:
        if tuned is not None and tuned.log == log:  # which judges no settings that it has chosen
            continue
        settings = NO_SETTINGS if tuned is None else tuned.settings
        name, file = system.name + ("" if tuned is None else f", tuned on {tuned.log}"), tuning.name_with(system.name, settings)
        reason = run_system(system, log, out, folder, settings)
        print(f"{log}: {name}: {reason or 'done'}", flush=True)
        if reason:
            rows.append({"log": log, "system": name, "failure": reason})
            continue
        cost = json.loads((out / log / f"{file}.json").read_text())
        usage = {"cpu_per_s": cost["cpu_s"] / seconds, "memory_mb": cost["memory_mb"]} if math.isfinite(cost["cpu_s"]) else {}
        for kind in ("", " live"):
            estimate = out / log / f"{file}{kind}.npz"
            if estimate.exists():
                rows.append({"log": log, "system": name + kind, **judge(estimate, reference), **usage, **floor})
    return rows


def tune(system: System, log: str, reference: Path | Relations, out: Path, budget: int) -> tuning.Tuned | None:
    """The settings of ``system`` with the least error on ``log``, of at most ``budget``; None where all fail."""
    scores: dict[str, tuple[float, Mapping[str, float]]] = {}
    for settings in tuning.draw(system.tuned, budget):
        if not run_system(system, log, out, None, settings):
            name = tuning.name_with(system.name, settings)
            score = judge(out / log / f"{name}.npz", reference)
            if "failure" not in score:
                scores[name] = score["ate_m"], settings
    if not scores:
        return None
    least, settings = min(scores.values(), key=operator.itemgetter(0))
    print(f"{log}: {system.name}: least error {least:.3f} m of {len(scores)} settings: {settings}", flush=True)
    return tuning.Tuned(log, settings)


def rows_in_space(log: str, systems: Sequence[System], out: Path) -> list[dict[str, Any]]:
    """A row for each system with a 3D LiDAR on simulated hills, without memory, which is that of the simulator."""
    (out / log).mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for system in systems:
        reason = run_system(system, log, out, None)
        print(f"{log}: {system.name}: {reason or 'done'}", flush=True)
        if reason:
            rows.append({"log": log, "system": system.name, "failure": reason})
            continue
        target = out / log / system.name
        cost = json.loads(Path(f"{target}.json").read_text())
        scores = judge(Path(f"{target}.npz"), Path(f"{target} reference.npz"))
        rows.append({"log": log, "system": system.name, **scores, "cpu_per_s": cost["cpu_s"] / SECONDS})
    return rows


def _arguments(words: Sequence[str] | None, logs: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--log", type=lambda text: text.split(","), default=list(logs))
    parser.add_argument("--system", type=lambda text: text.split(","), default=[system.name for system in _ALL])
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--peer", action="append", default=[], metavar="NAME=PATH")
    parser.add_argument("--tune", metavar="LOG")
    parser.add_argument("--budget", type=int, default=40)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("league-out"))
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> None:
    """Run, judge, and write the page."""
    folder = argparse.ArgumentParser(add_help=False)
    folder.add_argument("--folder", type=Path)
    logs = find_logs(folder.parse_known_args(words)[0].folder)
    options = _arguments(words, [*logs, *HILLS])
    names = {system.name for system in _ALL}
    for given, known, what in ((options.log, (*logs, *HILLS), "log"), (options.system, names, "system")):
        if unknown := [name for name in given if name not in known]:
            raise SystemExit(f"no {what} {', '.join(unknown)}; there are {', '.join(known)}.")
    if options.tune is not None and options.tune not in logs:
        raise SystemExit(f"no log {options.tune} to tune on; there are {', '.join(logs)}.")
    systems, in_space = ([system for system in each if system.name in options.system] for each in (SYSTEMS, SYSTEMS_IN_SPACE))
    systems += joined.parse(options.peer)
    prepare_environment()
    entries: list[tuple[System, tuning.Tuned | None]] = [(system, None) for system in systems]
    if options.tune is not None:
        reference, _ = prepare_log(options.tune, logs[options.tune], options.out)
        best = [(system, tune(system, options.tune, reference, options.out, options.budget)) for system in systems if system.tuned]
        entries += [(system, found) for system, found in best if found is not None]
    rows = [row for log in options.log if log in logs for row in rows_of(log, logs[log], entries, options.out, options.folder)]
    rows += [row for log in options.log if log in HILLS for row in rows_in_space(log, in_space, options.out)]
    (options.out / "league.json").write_text(json.dumps(rows, indent=1))
    page.write(rows, [*systems, *in_space], options.out)
    if options.write:
        tables.write(rows)
    print(f"{options.out / 'league.html'}")


if __name__ == "__main__":
    main()
