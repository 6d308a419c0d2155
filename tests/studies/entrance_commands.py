"""Logs, descriptions and references as practitioners bring them, through `replay`, `check` and `init` with default settings.

`python -m tests.studies.entrance_commands [base | verification | field | symptoms | mixed | forum | closing | threads | last | other |
more | hostile | KIND | part of a NAME] [-v]` prints kind, name and outcome (of `tests.studies.entrances`); with `-v` also the errors of
trajectories [m], of wheels alone and of the EKF, with those of the same drive with nothing wrong in brackets.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from localization.cli import main as skidloc
from localization.evaluation.metrics import align
from motion_models import se2
from motion_models.errors import SkidlocError
from motion_models.robot import Robot
from motion_models.robot_file import load_robot, robot_toml
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import Motion, Publishing, Vehicle, cast, drive, records_of
from tests.studies.entrances import AS_THEY_ARE, Found, choose_outcome, print_shares

Edit = Callable[[list[Record]], list[Record]]
Times = Callable[[np.ndarray, float, int], np.ndarray]
"""Times of points from parts of the sweep (n,), its period [s] and its stamp [ns]."""


@dataclass(frozen=True)
class Case:
    """One input of one command."""

    kind: str
    name: str
    judge: Callable[[Path], Found]


def run_command(*arguments: str) -> tuple[int, str]:
    """Exit code and all that a command prints."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        code = skidloc(arguments)
    return code, out.getvalue()


def write_log(
    folder: Path, vehicle: Vehicle, how: Publishing, edit: Edit, robot: Callable[[Robot], Robot] = lambda r: r
) -> tuple[Path, Path, Motion]:
    """Log and robot file of a drive."""
    motion = drive(vehicle)
    log = bags.write_mcap(folder / "log.mcap", sorted(edit(records_of(vehicle, motion, how)), key=lambda record: record[2]))
    (folder / "robot.toml").write_text(robot_toml(robot(vehicle.robot()), {}, ""))
    return log, folder / "robot.toml", motion


def replayed(folder: Path, log: Path, robot: Path, *options: str) -> tuple[int, str]:
    """`skidloc replay` of odometry and EKF."""
    model = "diff_drive" if 'drive = "diff_drive"' in robot.read_text() else "skid_steer"
    given = ["--model", model, "--estimator", "odometry,ekf", "--out", str(folder / "out"), *options]
    return run_command("replay", str(log), "--robot", str(robot), *given)


def errors_of(folder: Path, motion: Motion) -> tuple[float, float]:
    """Absolute trajectory errors [m] of odometry and EKF."""
    found = []
    for estimator in ("odometry", "ekf"):
        (path,) = folder.glob(f"*_{estimator}.tum")
        table = np.array([[float(v) for v in line.split()] for line in path.read_text().splitlines() if line[:1] not in "#"])
        t, poses = table[:, 0], np.column_stack([table[:, 1:3], 2.0 * np.arctan2(table[:, 6], table[:, 7])])
        truth = motion.trajectory()
        stamps = np.round(t * S).astype(np.int64)
        inside = (stamps >= truth.stamps_ns[0]) & (stamps <= truth.stamps_ns[-1])
        if inside.mean() < 0.9:
            return math.inf, math.inf
        true, ours = truth.at(stamps[inside]), poses[inside]
        moved = se2.compose(align(ours, true[:, :2], true[:, 2]), ours)
        found.append(float(np.sqrt(np.mean(np.sum((moved - true)[:, :2] ** 2, axis=1)))))
    return found[0], found[1]


@cache
def healthy_errors(vehicle: Vehicle) -> tuple[float, float]:
    """`errors_of` the drive with nothing wrong."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log, robot, motion = write_log(folder, vehicle, Publishing(), lambda records: records)
        code, text = replayed(folder, log, robot)
        assert code == 0, text
        return errors_of(folder / "out", motion)


def warnings_in(text: str) -> str:
    return "\n".join(
        line for line in text.splitlines() if (line.startswith("!") and "has no k_0" not in line) or line.startswith("skidloc:")
    )


def contradictions(folder: Path, log: Path, robot: Path) -> str:
    """What `skidloc check` of a log contradicts."""
    code, _ = run_command("check", str(log), "--robot", str(robot), "--json", str(folder / "check.json"))
    rows = json.loads((folder / "check.json").read_text())["rows"] if code == 0 else []
    wrong = [f"{row['quantity']}: {row['advice']}" for row in rows if row["verdict"] == "contradiction"]
    return str(wrong or code or "none")


def driven(
    kind: str,
    name: str,
    vehicle: Vehicle,
    how: Publishing = AS_THEY_ARE,
    words: Sequence[str] = (),
    edit: Edit = lambda records: records,
    refused: bool = False,
    robot: Callable[[Robot], Robot] = lambda r: r,
) -> Case:
    """A log: right where `replay` is as good as with nothing wrong and a warning has one of ``words``; else `check` is printed as well.

    ``refused``: that it ends with exit 2 and one of ``words`` is right.
    """

    def judge(folder: Path) -> Found:
        log, file, motion = write_log(folder, vehicle, how, edit, robot)
        code, text = replayed(folder, log, file)
        warned = warnings_in(text)
        is_named = not words or any(word in warned for word in words)
        if code:
            return Found(choose_outcome(refused, is_named, True, words), f"[exit {code}] {warned or text}")
        ours, best = errors_of(folder / "out", motion), healthy_errors(vehicle)
        state = f"[odometry {ours[0]:.3f} ({best[0]:.3f}), EKF {ours[1]:.3f} ({best[1]:.3f}) m]"
        is_right = all(a < 1.5 * b + 0.03 for a, b in zip(ours, best, strict=True))
        is_named = is_named or (is_right and bool(warned))  # what is corrected to the true motion is named by whatever sentence says so
        outcome = choose_outcome(is_right, is_named, bool(warned), words)
        checked = "" if outcome == "right" else f" check: {contradictions(folder, log, file)}"
        return Found(outcome, f"{state}{checked}\n{warned}")

    return Case(kind, name, judge)


_BY_SCANS = "covariances are not too small: wheels and scans differ less"
"""A verdict that needs no reference."""


def judge_scores(
    code: int,
    text: str,
    scores: Path,
    words: Sequence[str],
    healthy: Callable[[], dict[str, float]],
    noise_m: float,
    is_corrected: bool = False,
) -> Found:
    """Of a replay with a reference that ended with ``code``: all of ``words`` and no verdict by it (but where it ``is_corrected``), where
    there are some; else the errors in the file ``scores`` are those of the ``healthy`` drive [m], but for the reference's noise."""
    flat = " ".join(text.split()).replace(_BY_SCANS, "")
    if words:
        is_named, is_judged = all(word in flat for word in words), not is_corrected and ("covariances are" in flat or "is best" in flat)
        is_warned = bool(code) or "reference" in warnings_in(text) or "until that" in flat.lower()
        return Found(choose_outcome(True, is_named and not is_judged, is_warned, words), f"[exit {code}] {text}")
    if code:
        return Found("misnamed", f"[exit {code}] {text}")
    found, best = {r["estimator"]: r["ate_rmse_m"] for r in json.loads(scores.read_text())["results"]}, healthy()
    is_right = all(abs(found[k] - best[k]) < 0.3 * best[k] + 0.03 + noise_m for k in best)
    has_doubt, warned = "Until that" in text, warnings_in(text)
    if not is_right and "is of a point" in flat:  # of the robot, in the summary
        return Found("named", f"[{found}, {best}] {text}")
    return Found(choose_outcome(is_right, not has_doubt, has_doubt or bool(warned), words), f"[{found}, {best}] {warned}")


def scored(
    name: str, vehicle: Vehicle, content: Callable[[Motion], str], suffix: str = "tum", words: Sequence[str] = (), noise: float = 0.0
) -> Case:
    """A reference file: right where the runs have the errors of the healthy drive against it, or where a sentence has all of ``words``."""

    def judge(folder: Path) -> Found:
        log, robot, motion = write_log(folder, vehicle, Publishing(), lambda records: records)
        path = folder / f"reference.{suffix}"
        path.write_text(content(motion))
        code, text = replayed(folder, log, robot, "--reference", str(path), "--json", str(folder / "m.json"))
        return judge_scores(
            code, text, folder / "m.json", words, lambda: dict(zip(("odometry", "ekf"), healthy_errors(vehicle), strict=True)), noise
        )

    return Case("references", name, judge)


def clouded(name: str, vehicle: Vehicle, field_name: str, dtype: str, times: Times, words: Sequence[str] = ()) -> Case:
    """Sweeps of 0.1 s: right where the EKF is as good as with times in seconds, or where one of ``words`` names what is wrong."""

    def judge(folder: Path) -> Found:
        found = _cloud_error(folder, vehicle, field_name, dtype, times)
        (folder / "healthy").mkdir()
        best = _cloud_error(folder / "healthy", vehicle, "time", "f4", lambda u, period, stamp: u * period)
        warned, state = warnings_in(found[1]), f"[EKF {found[0]:.3f} ({best[0]:.3f}) m] "
        is_named = any(word in warned for word in words) if words else not warned
        is_right = bool(words) or found[0] < 1.5 * best[0] + 0.01
        return Found(choose_outcome(is_right, is_named, bool(warned), words), state + warned)

    return Case("point times", name, judge)


def _cloud_error(folder: Path, vehicle: Vehicle, field_name: str, dtype: str, times: Times) -> tuple[float, str]:
    period = 0.1
    motion, part = drive(vehicle), np.linspace(0.0, 0.9975, 400)
    rng = np.random.default_rng(4)

    def edit(records: list[Record]) -> list[Record]:
        more = [("/tf_static", bags.tf(START, [("base_link", "lidar", (0.15, 0.0, 0.3), bags.quaternion())]), START)]
        for t in np.arange(0.0, 25.0, period):
            stamp = START + round(t * S)
            poses = motion.poses[np.minimum(np.round((t + part * period) / 0.01).astype(int), len(motion.t) - 1)]
            bearings = 0.001 - math.pi + math.tau * part
            x, y = poses[:, 0] + 0.15 * np.cos(poses[:, 2]), poses[:, 1] + 0.15 * np.sin(poses[:, 2])
            r = np.array([cast(a, b, np.array([c]), vehicle.room)[0] for a, b, c in zip(x, y, poses[:, 2] + bearings, strict=True)])
            r += 0.008 * rng.normal(size=len(r))
            table = np.zeros((6, len(part)), dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), (field_name, dtype)])
            table["x"], table["y"], table[field_name] = r * np.cos(bearings), r * np.sin(bearings), times(part, period, stamp)
            table["z"] = np.linspace(-0.15, 0.6, 6)[:, None]
            more.append(("/points", bags.cloud(stamp, table), stamp + round(1.2 * period * S)))
        return [record for record in [*records, *more] if record[2] < START + 25 * S]

    log, robot, motion = write_log(folder, vehicle, Publishing(), edit)
    code, text = replayed(folder, log, robot)
    return (math.inf if code else errors_of(folder / "out", motion)[1]), text


def initialized(
    name: str,
    vehicle: Vehicle,
    urdf: str,
    how: Publishing = AS_THEY_ARE,
    words: Sequence[str] = (),
    asked: Sequence[str] = (),
    refused: bool = False,
) -> Case:
    """A URDF beside a log: right where the file has radius, track and sides of the vehicle, and the output has all of ``words``."""

    def judge(folder: Path) -> Found:
        log, _, _ = write_log(folder, vehicle, how, lambda records: records)
        (folder / "robot.urdf").write_text(urdf)
        code, text = run_command("init", str(log), "--urdf", str(folder / "robot.urdf"), "--out", str(folder / "new.toml"))
        flat = " ".join(text.split())
        is_named = all(word in flat for word in words)
        if code or not (folder / "new.toml").exists():
            return Found(choose_outcome(refused, is_named, True, words), f"[exit {code}] {text}")
        try:
            robot = load_robot(folder / "new.toml")
        except SkidlocError as error:
            is_right = bool(asked) and all(name in str(error) + text for name in asked)
            return Found(choose_outcome(is_right, is_named, True, words), f"{error}\n{text}")
        pairs = ((robot.geometry.wheel_radius_m, vehicle.radius), (robot.geometry.track_width_m, vehicle.track))
        is_right = all(abs(math.log(a / b)) < 0.05 for a, b in pairs) and not refused
        state = f"[{pairs}, CG {robot.center_of_gravity}] "
        return Found(choose_outcome(is_right, is_named, is_right, words), state + text)

    return Case("descriptions", name, judge)


def main(arguments: Sequence[str]) -> None:
    """Judge those that are named, by default all."""
    from tests.studies.entrance_closing_cases import CLOSING
    from tests.studies.entrance_command_cases import CASES
    from tests.studies.entrance_field_cases import FIELD
    from tests.studies.entrance_forum_cases import FORUM
    from tests.studies.entrance_hostile_cases import HOSTILE
    from tests.studies.entrance_last_cases import LAST
    from tests.studies.entrance_mixed_cases import MIXED
    from tests.studies.entrance_more_cases import MORE
    from tests.studies.entrance_other_cases import OTHER
    from tests.studies.entrance_symptom_cases import SYMPTOMS
    from tests.studies.entrance_thread_cases import THREADS
    from tests.studies.entrance_verification_cases import VERIFICATION

    wanted = [a for a in arguments if not a.startswith("-")]
    sets = {
        "base": CASES,
        "more": MORE,
        "hostile": HOSTILE,
        "other": OTHER,
        "last": LAST,
        "threads": THREADS,
        "closing": CLOSING,
        "forum": FORUM,
        "mixed": MIXED,
        "symptoms": SYMPTOMS,
        "field": FIELD,
        "verification": VERIFICATION,
    }
    found = []
    for case in (
        c
        for c in (*VERIFICATION, *FIELD, *SYMPTOMS, *MIXED, *FORUM, *CLOSING, *THREADS, *LAST, *OTHER, *MORE, *HOSTILE, *CASES)
        if not wanted or any(c in sets[w] if w in sets else w == c.kind or w in c.name for w in wanted)
    ):
        with tempfile.TemporaryDirectory() as folder:
            try:
                one = case.judge(Path(folder))
            except Exception:
                one = Found("silent", traceback.format_exc())
        found.append((case, one))
        print(f"{case.kind:13s} {case.name:50s} {one.outcome}", flush=True)
        if "-v" in arguments or one.outcome in ("silent", "misnamed"):
            print("      " + one.text[:1500].replace("\n", "\n      "), flush=True)
    print_shares(found)


if __name__ == "__main__":
    main(sys.argv[1:])
