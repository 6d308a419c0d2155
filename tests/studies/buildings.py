"""Estimators in buildings that nobody tuned them on: fr079, MIT-CSAIL and ACES, with default settings.

python -m tests.studies.buildings [--log fr079,csail,aces] [--estimator ...] [--model diff_drive,skid_steer,icr]
    [--corrections none,constant,cg_field] [--matcher submap,kiss] [--reference-noise] [--starts 8] [--write]

Absolute trajectory error (ATE) after one SE(2) alignment, and the median relative pose error over 10 m of the reference's path. Both use
the reference at its own instants alone: MIT-CSAIL's holds at key scans only, so nothing is interpolated between its poses. ACES has
hand-verified relative poses instead: their mean translation error, over all of them and over those under 20 s.
NEES counts from the first instant of the reference, whose noise (tests/data/*/SOURCE.txt: 1.6 cm, 0.5 deg a pose) is added at both ends:
mean over all instants, and over those at which the robot turns by less than 0.1 rad/s. The yaw of MIT-CSAIL's reference is off by up to
0.35 rad at single instants of turning, for all estimators alike. 3 are expected; one drive is one sample.
``--reference-noise`` compares the reference with the smoothed graphs by both matchers, and these with each other: of three tracks with
independent errors, the differences give the error of each (Gray & Allan 1974, three-cornered hat). CPU is that of the whole replay in
memory, after a first run of a few seconds that compiles.
Where an estimator smooths at the end, its live poses have a row of their own.
``--starts N`` begins each log at N moments, 0.43 s apart, and prints the scatter: two versions differ where their means do, not where one
run does. ``--write`` puts the numbers into the tables of README.md and docs/lab/lidar.md, which are of this command alone.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from localization.core.motion import FilterConfig
from localization.estimators import ESTIMATORS, ESTIMATORS_WITH_CORRECTIONS, EstimatorConfig
from localization.evaluation.consistency import nees
from localization.evaluation.metrics import align, relation_errors
from localization.evaluation.reference_files import read_reference_file
from localization.evaluation.references import ReferenceTrack, Relations
from localization.events import Event
from localization.lidar import LidarConfig
from localization.log_replay import Run, replay
from localization.logs import open_log
from localization.pipeline import ReplayConfig, Trial
from localization.trajectory import IntArray, Trajectory
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount, Robot
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray

DATA = Path(__file__).parents[1] / "data"
_WARM_UP_S = 20.0
RPE_M = 10.0
SHORT_S = 20.0
REFERENCE_SIGMA = np.array([0.016, 0.016, np.radians(0.5)])
"""Noise of a pose of the references of fr079 and MIT-CSAIL [m, m, rad]."""
_SLOW_TURN_RAD_S = 0.1
_START_S = 0.43
"""From start to start of ``--starts``: key scans fall on other scans [s]."""
_REPOSITORY = Path(__file__).parents[2]
_README_ROWS = {
    "odometry": "odometry",
    "lidar": "KISS-ICP, scans alone (`lidar`)",
    "ekf": "EKF",
    "graph live": "factor graph, live",
    "graph smoothed": "factor graph, smoothed",
}
_BEGIN, _END = "<!-- buildings: begin -->", "<!-- buildings: end -->"
_SAME_INSTANT_NS = 1_000_000
"""A pose farther in time from a reference's instant is not scored: the references' stamps are those of scans, rounded to a microsecond."""


@dataclass(frozen=True)
class Building:
    """Where a log, its robot and its reference are."""

    log: Path
    robot: str
    reference: Path

    def open(self) -> Drive:
        """The log, read once."""
        robot = load_robot(self.robot)
        log = open_log(self.log, robot)
        return Drive(list(log.events()), robot, log.mounts, read_reference_file(self.reference))


BUILDINGS: Mapping[str, Building] = {
    "fr079": Building(DATA / "fr079/fr079.mcap", str(DATA / "fr079/fr079.toml"), DATA / "fr079/fr079_reference.tum"),
    "csail": Building(DATA / "mit-csail/csail.mcap", str(DATA / "mit-csail/csail.toml"), DATA / "mit-csail/csail_reference.tum"),
    "aces": Building(DATA / "aces/aces.mcap", "aces", DATA / "aces/aces.relations"),
}


@dataclass(frozen=True, eq=False)
class Drive:
    """A log in memory."""

    events: Sequence[Event]
    robot: Robot
    mounts: Mapping[str, Mount]
    reference: ReferenceTrack | Relations

    def run(self, estimator: str, model: str = "diff_drive", corrections: str = "constant", matcher: str = "submap", **ekf: float) -> Run:
        """One estimator over the log; ``ekf``: settings of the filter that are not the default ones."""
        config = ReplayConfig(estimator=EstimatorConfig(ekf=FilterConfig(**ekf), lidar=LidarConfig(matcher=matcher)))
        pair = Trial(make_model(model, self.robot), estimator, corrections)
        return replay(self.events, [pair], self.robot, self.mounts, True, config)[0]

    def begun_after(self, seconds: float) -> Drive:
        """It without the first ``seconds``."""
        begin = self.events[0].stamp_ns + round(seconds * 1e9)
        return Drive([event for event in self.events if event.stamp_ns >= begin], self.robot, self.mounts, self.reference)

    def until(self, seconds: float) -> Drive:
        """The first ``seconds`` of it."""
        end = self.events[0].stamp_ns + round(seconds * 1e9)
        return Drive([event for event in self.events if event.stamp_ns <= end], self.robot, self.mounts, self.reference)


def track_errors(trajectory: Trajectory, reference: ReferenceTrack) -> tuple[float, float]:
    """ATE and median RPE over 10 m [m] at the instants of ``reference``, by the nearest pose in time."""
    at, use = _same_instants(trajectory, reference)
    estimate, truth = trajectory.poses[at], reference.poses[use]
    aligned = se2.compose(align(estimate, truth[:, :2], truth[:, 2]), estimate)
    ate = float(np.sqrt(np.mean(np.sum((aligned - truth)[:, :2] ** 2, axis=1))))
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    end = np.searchsorted(way, way + RPE_M)
    start = np.flatnonzero(end < len(way))
    error = se2.between(se2.between(truth[start], truth[end[start]]), se2.between(estimate[start], estimate[end[start]]))
    return ate, float(np.median(np.hypot(error[:, 0], error[:, 1])))


def _same_instants(trajectory: Trajectory, reference: ReferenceTrack) -> tuple[IntArray, NDArray[np.bool_]]:
    """Indices (n,) of the poses at the reference's instants, and which of these have one (M,)."""
    stamps = trajectory.stamps_ns
    at = np.clip(np.searchsorted(stamps, reference.stamps_ns), 1, len(stamps) - 1)
    at -= reference.stamps_ns - stamps[at - 1] < stamps[at] - reference.stamps_ns
    use = np.abs(stamps[at] - reference.stamps_ns) < _SAME_INSTANT_NS
    return at[use], use


def nees_at_instants(trajectory: Trajectory, reference: ReferenceTrack, sigma: FloatArray = REFERENCE_SIGMA) -> tuple[float, float]:
    """Mean NEES at the instants of ``reference``, with its noise ``sigma`` (3,): of all, and of those at which it hardly turns."""
    at, use = _same_instants(trajectory, reference)
    estimate, truth = trajectory.poses[at], reference.poses[use]
    assert trajectory.covariances is not None
    moved, noise = se2.between(truth[0], truth), np.diag(sigma**2)
    A = se2.adjoint(se2.inverse(moved))
    errors = se2.log(se2.between(moved, se2.between(estimate[0], estimate)))
    found = nees(errors, trajectory.covariances[at] + noise + A @ noise @ A.swapaxes(-1, -2))
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, len(trajectory) - 1)
    seconds = (trajectory.stamps_ns[after] - trajectory.stamps_ns[before]) * 1e-9
    turn = se2.wrap_angle(trajectory.poses[after, 2] - trajectory.poses[before, 2]) / seconds
    is_slow = np.abs(turn) < _SLOW_TURN_RAD_S
    return float(found.mean()), float(found[is_slow].mean())


def errors_of(trajectory: Trajectory, reference: ReferenceTrack | Relations) -> tuple[float, float]:
    """`track_errors`, or mean errors of relations: of all, and of those under 20 s [m]."""
    if isinstance(reference, ReferenceTrack):
        return track_errors(trajectory, reference)
    found = relation_errors(trajectory, reference)
    return float(found.translation_m.mean()), float(found.translation_m[found.spans_s < SHORT_S].mean())


def measure(drive: Drive, estimator: str, model: str, form: str, matcher: str) -> Iterator[tuple[str, str]]:
    """A name and a cell for each kind of poses that the estimator has."""
    begin = time.process_time()
    run = drive.run(estimator, model, form, matcher)
    seconds = time.process_time() - begin
    lidar = "–" if run.lidar is None else f"{100.0 * (1.0 - run.lidar.matched / max(run.lidar.scans, 1)):.2f}"  # noqa: RUF001
    scans = sum(hasattr(event, "points") for event in drive.events)
    rest = f"{lidar} | {1e3 * seconds / scans:.2f}"
    names = {"": run.trajectory} if run.live is None else {" live": run.live, " smoothed": run.trajectory}
    for kind, trajectory in names.items():
        has_nees = trajectory.covariances is not None and isinstance(drive.reference, ReferenceTrack)
        consistency = "{:.1f} / {:.1f}".format(*nees_at_instants(trajectory, drive.reference)) if has_nees else "–"  # noqa: RUF001
        yield kind, "{:.3f} / {:.4f} | {} | {}".format(*errors_of(trajectory, drive.reference), consistency, rest)


def reference_noise(drive: Drive, reference: ReferenceTrack) -> str:
    """Errors of relations over `RPE_M` of the reference and of the smoothed graphs by both matchers, and NEES with such a reference."""
    graph, kiss = drive.run("graph"), drive.run("graph", matcher="kiss").trajectory
    at, _ = _same_instants(kiss, reference)
    by_kiss = ReferenceTrack(kiss.stamps_ns[at], kiss.poses[at, :2], kiss.poses[at, 2])
    pairs = {"submap": (graph.trajectory, reference), "kiss": (kiss, reference), "reference": (graph.trajectory, by_kiss)}
    apart = {name: track_errors(*pair)[1] for name, pair in pairs.items()}  # "reference": of the other two
    half = 0.5 * sum(value**2 for value in apart.values())
    errors = {"submap": half - apart["kiss"] ** 2, "kiss": half - apart["submap"] ** 2, "reference": half - apart["reference"] ** 2}
    sigma = math.sqrt(max(errors["reference"], 0.0) / 2.0)  # of one pose
    tracks = {"ekf": drive.run("ekf").trajectory, "graph live": graph.live or graph.trajectory, "graph smoothed": graph.trajectory}
    noise = np.array([sigma, sigma, REFERENCE_SIGMA[2]])
    nees_of = ", ".join("{} {:.1f} / {:.1f}".format(name, *nees_at_instants(track, reference, noise)) for name, track in tracks.items())
    error_of = ", ".join(f"{name} {math.sqrt(max(square, 0.0)):.3f}" for name, square in errors.items())
    return (
        f"submap and reference {apart['submap']:.3f}, kiss and reference {apart['kiss']:.3f}, submap and kiss {apart['reference']:.3f} m: "
        f"errors of {error_of} m; NEES with {sigma:.3f} m a pose of the reference: {nees_of}"
    )


def rows(drive: Drive, options: argparse.Namespace) -> Iterator[str]:
    """Lines of the table for one log."""
    for estimator in options.estimator:
        models = options.model if estimator != "lidar" else options.model[:1]
        forms = options.corrections if estimator in ESTIMATORS_WITH_CORRECTIONS else ["none"]
        matchers = options.matcher if estimator in ESTIMATORS_WITH_CORRECTIONS else ["submap"]
        for model, form, matcher in ((m, f, k) for m in models for f in forms for k in matchers):
            parts = [model] * (estimator != "lidar") + ([form, matcher] if estimator in ESTIMATORS_WITH_CORRECTIONS else [])
            for kind, cells in measure(drive, estimator, model, form, matcher):
                yield f"{estimator}{kind}{' (' + ', '.join(parts) + ')' if parts else ''} | {cells}"


def scatter(drive: Drive, starts: int, estimator: str, model: str = "diff_drive", form: str = "constant", matcher: str = "submap") -> str:
    """Mean and standard deviation of both errors over moments at which the log begins, and the error of the mean."""
    runs = [drive.begun_after(k * _START_S).run(estimator, model, form, matcher) for k in range(starts)]
    cells = []
    for kind, tracks in (("", [run.trajectory for run in runs]), (" live", [run.live for run in runs if run.live is not None])):
        if tracks:
            errors = np.array([errors_of(track, drive.reference) for track in tracks])
            mean, sd = errors.mean(axis=0), errors.std(axis=0, ddof=1)
            cells.append(f"{estimator}{kind}: {mean[0]:.3f} +- {sd[0] / math.sqrt(starts):.3f}, one run +- {sd[0]:.3f}; {mean[1]:.4f}")
    return " | ".join(cells)


def write_tables(lines: Sequence[str]) -> None:
    """Put the rows of `main`'s table, of all logs and estimators, into README.md and docs/lab/lidar.md."""
    journal = _REPOSITORY / "docs/lab/lidar.md"
    before, _, rest = journal.read_text().partition(_BEGIN)
    journal.write_text(before + "\n".join([_BEGIN, *lines, _END]) + rest.partition(_END)[2])
    numbers: dict[tuple[str, str], str] = {}
    for line in lines[2:]:
        log, estimator, errors = (cell.strip() for cell in line.split("|")[1:4])
        ate, rpe = errors.split(" / ")
        numbers[log, estimator.partition(" (")[0]] = f"{float(ate):.3f} / {float(rpe):.3f}"
    readme = _REPOSITORY / "README.md"
    text = readme.read_text().splitlines()
    for estimator, label in _README_ROWS.items():
        at = next(i for i, line in enumerate(text) if line.startswith(f"| {label} |"))
        cells = [cell.strip() for cell in text[at].split("|")[1:-1]]
        cells[1:4] = [numbers[log, estimator] for log in BUILDINGS]
        text[at] = f"| {' | '.join(cells)} |".replace("|  |", "| |")
    readme.write_text("\n".join(text) + "\n")


def _arguments(words: Sequence[str] | None) -> argparse.Namespace:
    def split(text: str) -> list[str]:
        return text.split(",")

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--log", type=split, default=list(BUILDINGS), help="fr079, csail, aces")
    parser.add_argument("--estimator", type=split, default=list(ESTIMATORS))
    parser.add_argument("--model", type=split, default=["diff_drive"])
    parser.add_argument("--corrections", type=split, default=["constant"])
    parser.add_argument("--matcher", type=split, default=["submap"])
    parser.add_argument("--starts", type=int, default=0, help="moments at which each log begins: their scatter, in place of the table")
    parser.add_argument("--write", action="store_true", help="also into README.md and docs/lab/lidar.md; all logs and estimators")
    parser.add_argument("--reference-noise", action="store_true", help="compare the reference with both matchers, in place of the table")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> None:
    options = _arguments(words)
    if options.reference_noise:
        for name in options.log:
            drive = BUILDINGS[name].open()
            if isinstance(drive.reference, ReferenceTrack):
                print(f"{name}: {reference_noise(drive, drive.reference)}", flush=True)
        return
    if options.starts:
        for name in options.log:
            drive = BUILDINGS[name].open()
            for estimator in options.estimator:
                print(f"{name}: {scatter(drive, options.starts, estimator, options.model[0])}", flush=True)
        return
    lines = ["| log | estimator | ATE / RPE 10 m, or relations all / < 20 s [m] | NEES all / slow turns | scans lost [%] | CPU ms a scan |"]
    lines.append("|---" * 6 + "|")
    print("\n".join(lines))
    for name in options.log:
        drive = BUILDINGS[name].open()
        drive.until(_WARM_UP_S).run("ekf")
        for line in rows(drive, options):
            lines.append(f"| {name} | {line} |")
            print(lines[-1], flush=True)
    if options.write:
        write_tables(lines)


if __name__ == "__main__":
    main()
