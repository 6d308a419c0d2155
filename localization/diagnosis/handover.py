"""The gain of a corrected robot: its file is written, read again, and the log replayed with it, on windows that did not correct it."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.causes.cause import Cause, Hypothesis, with_sizes
from localization.diagnosis.corrected_robot import CorrectedRobot, correct_robot, predictor_after
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.gate import HandoverCheck, HeldRows, Replayed, compare_rows, find_supported, folds, reason
from localization.diagnosis.linearization import TOLERANCE, Linearization, candidate_causes, linearize, make_predictor, make_regression
from localization.diagnosis.noise import Noise
from localization.log_replay import Run, replay
from localization.logs.reader import Log, open_log
from localization.pipeline import Trial
from motion_models import se2
from motion_models.calibration.maneuvers import IntArray
from motion_models.errors import CgError, ModelError
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot, relocated, robot_toml
from motion_models.se2 import FloatArray

_ESTIMATORS = ("odometry", "ekf")
_LEAD_NS = 4_000_000_000
"""Before the first held-out window, for an estimator to begin [ns]."""
_SAME_WINDOW_S = 0.3
"""Windows of two readings of a log that begin so close are one: clocks that are corrected move them by less."""
_MIN_HALF_WINDOWS = 8
_UNCHANGED_M = 1e-6
"""Difference of two runs' poses that is rounding [m, rad]."""
_SENSOR_FIELDS = (
    *("wheel_time_offset_s", "gyro_time_offset_s", "gyro_scale", "lidar_offset", "lidar_time_offset_s", "range_scale"),
    "range_bias_m",
)
"""What of a hypothesis a robot file corrects when messages are read."""


@dataclasses.dataclass
class Reader:
    """Reads the diagnosed log with a given robot: its drive, and its events."""

    open: Callable[[Robot], Log]
    """The log as a robot reads it, with its wiring checked."""
    cut: Callable[[Log], Drive]
    """A log's windows."""
    _logs: dict[int, tuple[Robot, Log]] = dataclasses.field(default_factory=dict, init=False, repr=False)
    """Logs by the robot's `id()`; the robot is stored as well, so that no other object can get the same id."""
    _drives: dict[int, tuple[Robot, Drive]] = dataclasses.field(default_factory=dict, init=False, repr=False)
    """Windows by the robot's `id()`; with the robot as above."""
    _replayed: dict[tuple[int, str, int], tuple[Robot, list[Run]]] = dataclasses.field(default_factory=dict, init=False, repr=False)
    """Runs by robot, model and start; with the robot as above."""

    def know(self, log: Log, drive: Drive) -> None:
        """Take the ``log`` as open, and its ``drive`` as cut, which were before."""
        self._logs[id(drive.robot)] = drive.robot, log
        self._drives[id(drive.robot)] = drive.robot, drive

    def log(self, robot: Robot) -> Log:
        """The log by ``robot``; checked once for all robots that read it in the same way."""
        if id(robot) not in self._logs:
            known = next((log for other, log in self._logs.values() if is_read_alike(robot, other)), None)
            self._logs[id(robot)] = robot, self.open(robot) if known is None else open_log(known.path, robot, known.overrides)
        return self._logs[id(robot)][1]

    def is_cut(self, robot: Robot) -> bool:
        """Whether the log was read and cut by ``robot``."""
        return id(robot) in self._drives

    def drive(self, robot: Robot) -> Drive:
        """The windows of the log by ``robot``; cut once for all robots that read it in the same way."""
        if id(robot) not in self._drives:
            log = self.log(robot)
            known = next((drive for other, drive in self._drives.values() if is_read_alike(robot, other)), None)
            drive = self.cut(log) if known is None else dataclasses.replace(known, robot=log.robot)
            self._drives |= {id(robot): (robot, drive), id(drive.robot): (drive.robot, drive)}  # a log's wiring may be another robot's
        return self._drives[id(robot)][1]

    def runs(self, robot: Robot, model: str, start_ns: int) -> list[Run]:
        """The log from ``start_ns`` on by ``robot`` and this model, by each of `_ESTIMATORS`; replayed once."""
        key = id(robot), model, start_ns
        if key not in self._replayed:
            log, trials = self.log(robot), [Trial(make_model(model, robot), name) for name in _ESTIMATORS]
            events = (event for event in log.events() if event.stamp_ns >= start_ns)
            self._replayed[key] = robot, replay(events, trials, log.robot, log.mounts, log.sources.lidar is not None)
        return self._replayed[key][1]


def is_read_alike(robot: Robot, other: Robot) -> bool:
    """Whether messages are the same motion to both, which differ by their motion models at most."""
    return dataclasses.replace(robot, name=other.name, models=other.models) == other


@dataclasses.dataclass(frozen=True)
class CandidateRobot:
    """A robot that was corrected by a part of a drive alone, and the rest, on which its file is checked."""

    corrected: CorrectedRobot
    sizes: Mapping[Cause, float]
    """Sizes of the causes that it was corrected by."""
    held: NDArray[np.bool_]
    """(W,) windows that did not correct it."""
    is_beside: bool = False
    """Whether it is judged beside all that is tolerated as well, as a law is, which placebos have judged; else by the rows as they are,
    which are the only check of a cause that is independent of other causes."""

    def tolerated(self, state: Linearization) -> FloatArray | None:
        """(M, 6, b) what the drive of ``state`` may have beside its causes, times its prior sigma; None where that is not considered."""
        return state.tolerated(self.sizes) if self.is_beside else None


def check_findings(
    predictor: DrivePredictor,
    linearization: Linearization,
    named: Sequence[str],
    reader: Reader | None = None,
    others: Sequence[Reader] = (),
) -> HandoverCheck | None:
    """Correct the robot by the first half of the drive, and check its file on the second half, or by all of it on ``others``, as
    `check_written`.

    ``named`` are the keys of the findings, strongest first. Only those stay in the file that improve folds of the drive to which they were
    not fitted each beside all others (leave one out). None where no file would hold them, for tables, and for drives that are too short.
    """
    if not named or not _is_long_enough(predictor):
        return None
    held = np.arange(len(predictor.drive.maneuvers)) >= len(predictor.drive.maneuvers) // 2
    rows: dict[tuple[str, ...], HeldRows] = {}

    def check(fewer: tuple[str, ...], more: tuple[str, ...]) -> HandoverCheck | None:
        for keys in (fewer, more):
            if keys not in rows:
                try:
                    rows[keys] = _cross_predicted(predictor, linearization, keys)
                except (CgError, ModelError):  # no robot has the sizes of these windows
                    return None
        return compare_rows(rows[fewer], rows[more], linearization.noise.sigmas, linearization.noise.weights)

    kept, refused = find_supported(tuple(named), check)
    why = {key: reason(one) for key, one in refused.items()}
    harmful = tuple(key for key, one in refused.items() if one is not None and one.worse)
    tried = kept or tuple(named[:1])
    sizes = _sizes_on(linearization, tried, np.ones_like(held) if others else ~held)
    try:
        candidate = CandidateRobot(correct_robot(predictor, sizes), sizes, held)
    except (CgError, ModelError) as error:  # no robot has the sizes of this half
        found = check((), tried)
        return None if found is None else dataclasses.replace(found, refused={**why, **dict.fromkeys(tried, str(error))}, harmful=harmful)
    found = check_written(predictor, linearization, candidate, reader, others)
    if found is None and refused:
        found = check((), tried)
    if found is None:
        return None
    failure = found.failure if kept else why[tried[0]]
    return dataclasses.replace(found, corrected=kept, refused=why, harmful=harmful, failure=failure)


def _is_long_enough(predictor: DrivePredictor) -> bool:
    """Whether each half of the drive has as many windows as a diagnosis takes; false for tables."""
    return predictor.drive.kind == "log" and len(predictor.drive.maneuvers) // 2 >= _MIN_HALF_WINDOWS


def _cross_predicted(predictor: DrivePredictor, linearization: Linearization, named: Sequence[str]) -> HeldRows:
    """All windows, each as the causes with keys ``named`` predict it at the sizes of the other folds."""
    rows = np.empty_like(linearization.rows)
    for held in folds(len(predictor.drive.maneuvers)):
        windows = held[predictor.batch.owner]
        rows[windows] = predictor.discrepancies(with_sizes(_sizes_on(linearization, named, ~held)))[windows]
    return HeldRows(rows, predictor.batch.measured)


def check_written(
    predictor: DrivePredictor, state: Linearization, candidate: CandidateRobot, reader: Reader | None, others: Sequence[Reader] = ()
) -> HandoverCheck | None:
    """Write the robot file of the ``candidate``, read it again, and predict and replay the windows that are held out with it.

    With a ``reader`` the log is read with the file, so that units, clocks, ranges and mounts act as they do in other commands, and is
    replayed by `odometry` and `ekf`; without one windows are predicted, which is the odometry of a table. With ``others``, logs of further
    drives, all of their windows are held out. Errors of a reference are no part of the check. None where the file changes nothing, or
    nothing was measured.
    """
    if candidate.corrected.robot == predictor.drive.robot:
        return None
    predictor = predictor.by_file
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(robot_toml(relocated(candidate.corrected.robot, path.parent)), encoding="utf-8")
        written = dataclasses.replace(candidate.corrected, robot=load_robot(path))
        candidate = dataclasses.replace(candidate, corrected=written)
        if others:
            return _check_on_others(predictor, candidate, others)
        if reader is None:
            return _check_predicted(predictor, state, candidate)
        return _check_replayed(predictor, state, candidate, reader)


def _check_predicted(predictor: DrivePredictor, state: Linearization, candidate: CandidateRobot) -> HandoverCheck | None:
    """Windows held out, as the file predicts them."""
    drive, hypothesis = predictor.drive, with_sizes(candidate.sizes)
    after = predictor_after(predictor, candidate.corrected, predictor.model.name)
    held = candidate.held[predictor.batch.owner]
    rows = predictor.discrepancies(_of_reference(hypothesis, drive.is_lidar_reference)), after.discrepancies(_of_sensors(hypothesis))
    noise, tolerated = state.noise, candidate.tolerated(state)
    old, new = (HeldRows(row, predictor.batch.measured, tolerated).part(held) for row in rows)
    found = compare_rows(old, new, noise.sigmas[held], noise.weights[held])
    if found is None or drive.kind == "log":
        return found
    weight = np.array([1.0, 1.0, 0.5 * drive.robot.geometry.track_width_m])
    before, now = (np.nansum((r[held, :3] * weight) ** 2, axis=1) for r in rows)
    odometry = _compared(before, now, np.zeros(len(before)), noise.weights[held])
    return found if odometry is None else dataclasses.replace(found, replays={"odometry": odometry})


class _Reread(NamedTuple):
    """Held-out windows of a log that was read and replayed with both files."""

    before: HeldRows
    after: HeldRows
    sigmas: FloatArray
    weights: FloatArray
    squares: dict[str, tuple[FloatArray, FloatArray]]
    """(W,) squared errors of the windows by estimator, with either file [m^2]."""
    variances: FloatArray
    """(W,) of the drive's noise in them [m^2]."""


def _check_replayed(predictor: DrivePredictor, state: Linearization, candidate: CandidateRobot, reader: Reader) -> HandoverCheck | None:
    """Windows held out, of the log as it is read and replayed with the file."""
    reread = _reread(predictor, state, candidate, reader)
    return None if reread is None else _compare_reread([reread])


def _check_on_others(predictor: DrivePredictor, candidate: CandidateRobot, others: Sequence[Reader]) -> HandoverCheck | None:
    """All windows of other drives, as they are read and replayed with the file; None where nothing was measured there."""
    found, names = [], []
    for reader in others:
        drive = reader.drive(predictor.drive.robot)
        if len(drive.maneuvers) < _MIN_HALF_WINDOWS:
            continue
        other = make_predictor(drive, predictor.model, predictor.baseline)
        state = linearize(other, candidate_causes(other, 0), {}, TOLERANCE)
        held = dataclasses.replace(candidate, held=np.ones(len(drive.maneuvers), dtype=bool))
        reread = _reread(other, state, held, reader)
        if reread is not None:
            found.append(reread)
            names.append(drive.name)
    checked = _compare_reread(found) if found else None
    return None if checked is None else dataclasses.replace(checked, other_drives=tuple(names))


def _reread(predictor: DrivePredictor, state: Linearization, candidate: CandidateRobot, reader: Reader) -> _Reread | None:
    """The held-out windows of a drive, whose log is read and replayed with the old and the new file; None where nothing is measured."""
    old, new, name = predictor.drive.robot, candidate.corrected.robot, predictor.model.name
    before, after = reader.drive(old), reader.drive(new)
    if not before.maneuvers or not after.maneuvers:
        return None
    predictors = [
        DrivePredictor(drive, make_model(name, robot), has_inertia=predictor.has_inertia, baseline=predictor.baseline)
        for drive, robot in ((before, old), (after, new))
    ]
    of_marker = _of_reference(with_sizes(candidate.sizes), after.is_lidar_reference)
    first, second = _paired(before, after, candidate.held)
    noise, tolerated = state.noise, candidate.tolerated(state)
    held = [
        HeldRows(p.discrepancies(of_marker)[windows], p.batch.measured[windows], None if tolerated is None else tolerated[first])
        for p, windows in zip(predictors, (first, second), strict=True)
    ]
    squares: dict[str, tuple[FloatArray, FloatArray]] = {}
    if after.has_headings:  # chords between positions are no poses to compare with
        start_ns = int(before.spans_ns[candidate.held, 0].min()) - _LEAD_NS
        runs = [{run.estimator: run for run in reader.runs(robot, name, start_ns)} for robot in (old, new)]
        turns_m = [0.5 * robot.geometry.track_width_m for robot in (old, new)]
        for estimator, by_old in runs[0].items():
            by_new = runs[1][estimator]
            if _is_changed(by_old, by_new):
                squares[estimator] = _window_error(by_old, before, first, turns_m[0]), _window_error(by_new, after, second, turns_m[1])
    variances = _window_noise(noise, first, 0.5 * old.geometry.track_width_m)
    return _Reread(held[0], held[1], noise.sigmas[first], noise.weights[first], squares, variances)


def _is_changed(one: Run, other: Run) -> bool:
    """Whether the files move an estimator at all: odometry is as good or bad with any mount of the LiDAR, whose motion it is compared
    with."""
    a, b = one.trajectory, other.trajectory
    return len(a) != len(b) or not np.allclose(a.poses, b.poses, rtol=0.0, atol=_UNCHANGED_M)


def _compare_reread(drives: Sequence[_Reread]) -> HandoverCheck | None:
    """`compare_rows` and replays of all windows of all ``drives``."""
    before, after = _joined([d.before for d in drives]), _joined([d.after for d in drives])
    weights, variances = np.concatenate([d.weights for d in drives]), np.concatenate([d.variances for d in drives])
    found = compare_rows(before, after, np.concatenate([d.sigmas for d in drives]), weights)
    if found is None:
        return None
    replays = {}
    for estimator in (name for name in drives[0].squares if all(name in d.squares for d in drives)):
        old, new = (np.concatenate([d.squares[estimator][k] for d in drives]) for k in (0, 1))
        if (one := _compared(old, new, variances, weights)) is not None:
            replays[estimator] = one
    return dataclasses.replace(found, replays=replays)


def _joined(drives: Sequence[HeldRows]) -> HeldRows:
    """All windows of ``drives``, each with what is tolerated of its own."""
    columns = [d.beside for d in drives if d.beside is not None]
    ends = np.cumsum([c.shape[-1] for c in columns]).tolist()
    padded = [np.pad(c, ((0, 0), (0, 0), (end - c.shape[-1], ends[-1] - end))) for c, end in zip(columns, ends, strict=True)]
    beside = np.concatenate(padded) if len(padded) == len(drives) else None
    return HeldRows(np.concatenate([d.rows for d in drives]), np.concatenate([d.measured for d in drives]), beside)


def _sizes_on(linearization: Linearization, named: Sequence[str], used: NDArray[np.bool_]) -> dict[Cause, float]:
    """Sizes of the causes with keys ``named`` by the windows ``used`` (W,) alone, within the bounds of each."""
    chosen = [i for i, cause in enumerate(linearization.causes) if cause.key in named]
    if not chosen:
        return {}
    arrays = linearization.linear, linearization.signatures, linearization.nuisances
    kept = used[: len(linearization.rows)]
    part = [np.where(kept.reshape(-1, *(1,) * (a.ndim - 1)), a, np.nan) for a in arrays]
    causes = tuple(linearization.causes[i] for i in chosen)
    problem = make_regression(part[0], part[1][..., chosen], part[2], linearization.noise, causes, linearization.tolerance)
    sizes = problem.fit(tuple(range(len(causes))))[0]
    return {cause: float(np.clip(size, *cause.bounds)) for cause, size in zip(causes, sizes, strict=True)}


def _of_sensors(hypothesis: Hypothesis) -> Hypothesis:
    """The part of ``hypothesis`` by which the robot file corrects what was measured."""
    return Hypothesis(**{name: getattr(hypothesis, name) for name in _SENSOR_FIELDS})


def _of_reference(hypothesis: Hypothesis, is_lidar_reference: bool) -> Hypothesis:
    """The part of ``hypothesis`` that is a reference's, none where the LiDAR measured the motion."""
    if is_lidar_reference:
        return Hypothesis()
    return Hypothesis(lidar_offset=hypothesis.lidar_offset, lidar_time_offset_s=hypothesis.lidar_time_offset_s)


def _compared(before: FloatArray, after: FloatArray, noise: FloatArray, weights: FloatArray) -> Replayed | None:
    """Squared errors (W,) of one estimator in the same windows with both files, and the variance of their noise (W,), where both runs
    cover the windows, which count by their ``weights`` (W,); None where none do."""
    known = np.isfinite(before) & np.isfinite(after)
    if not known.any():
        return None
    share = weights[known] ** 2
    return Replayed(*(float(np.sqrt(np.average(squares[known], weights=share))) for squares in (before, after, noise)))


def _paired(before: Drive, after: Drive, held: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """Indices of the windows of ``before`` that are ``held`` (W,) out, and of the same windows ``after``."""
    starts = after.spans_ns[:, 0]
    pairs = []
    for i in np.flatnonzero(held):
        j = int(np.argmin(np.abs(starts - before.spans_ns[i, 0])))
        if abs(int(starts[j] - before.spans_ns[i, 0])) <= _SAME_WINDOW_S * 1e9:
            pairs.append((int(i), j))
    first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return first, second


def _window_noise(noise: Noise, windows: IntArray, turn_m: float) -> FloatArray:
    """(W,) variance of the motion in ``windows`` that is noise on this drive, headings times ``turn_m`` [m^2]."""
    variances = np.where(noise.known, noise.sigmas, 0.0)[windows, :3] ** 2
    return np.asarray(variances @ np.array([1.0, 1.0, turn_m**2]))


def _window_error(run: Run, drive: Drive, windows: IntArray, turn_m: float) -> FloatArray:
    """(W,) squared error of the motion in ``windows`` that was measured, headings times ``turn_m`` [m^2]; NaN where the run does not cover
    the window."""
    spans = drive.spans_ns[windows]
    covered = np.flatnonzero(np.all(run.trajectory.covers(spans), axis=1))
    used, spans = [drive.maneuvers[int(i)] for i in windows[covered]], spans[covered]
    found = np.full(len(windows), np.nan)
    if used:
        moved = se2.between(run.trajectory.at(spans[:, 0]), run.trajectory.at(spans[:, 1]))
        known = np.array([np.isfinite(np.diagonal(np.broadcast_to(m.cov, (len(m.ends), 3, 3))[-1])) for m in used])
        off = se2.between(np.array([m.measured[-1] for m in used]), moved) * np.array([1.0, 1.0, turn_m])
        found[covered] = np.sum(np.where(known, off, 0.0) ** 2, axis=1)
    return found
