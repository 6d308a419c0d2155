"""The gain of a corrected robot: its file is written, read again, and the log replayed with it, on windows that did not correct it."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.causes.cause import Cause, Hypothesis, with_sizes
from localization.diagnosis.corrected_robot import CorrectedRobot, correct_robot, predictor_after
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import CHANNELS, DrivePredictor
from localization.diagnosis.findings import HandoverCheck, Replayed
from localization.diagnosis.linearization import Linearization, make_regression
from localization.diagnosis.noise import Noise
from localization.log_replay import Run, replay
from localization.logs.reader import Log
from localization.pipeline import Trial
from motion_models import se2
from motion_models.calibration.cross_validation import root_mean_gain
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
_BLOCK = 2  # neighbouring windows share their errors: a scan between them, and the floor
_LEAST_CHANGE = 1e-3
"""Change of a component over its noise, in the window where it is largest, below which a file does not change it: rounding."""
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
    _replayed: dict[tuple[int, str, int], tuple[Robot, list[Run]]] = dataclasses.field(default_factory=dict, init=False, repr=False)
    """Runs by robot, model and start; with the robot as above."""

    def log(self, robot: Robot) -> Log:
        """The log by ``robot``; opened and checked once."""
        if id(robot) not in self._logs:
            self._logs[id(robot)] = robot, self.open(robot)
        return self._logs[id(robot)][1]

    def drive(self, robot: Robot) -> Drive:
        """The windows of the log by ``robot``."""
        return self.cut(self.log(robot))

    def runs(self, robot: Robot, model: str, start_ns: int) -> list[Run]:
        """The log from ``start_ns`` on by ``robot`` and this model, by each of `_ESTIMATORS`; replayed once."""
        key = id(robot), model, start_ns
        if key not in self._replayed:
            log, trials = self.log(robot), [Trial(make_model(model, robot), name) for name in _ESTIMATORS]
            events = (event for event in log.events() if event.stamp_ns >= start_ns)
            self._replayed[key] = robot, replay(events, trials, log.robot, log.mounts, log.sources.lidar is not None)
        return self._replayed[key][1]


@dataclasses.dataclass(frozen=True)
class CandidateRobot:
    """A robot that was corrected by a part of a drive alone, and the rest, on which its file is checked."""

    corrected: CorrectedRobot
    sizes: Mapping[Cause, float]
    """Sizes of the causes that it was corrected by."""
    held: NDArray[np.bool_]
    """(W,) windows that did not correct it."""


def check_findings(
    predictor: DrivePredictor, linearization: Linearization, named: Sequence[str], reader: Reader | None = None
) -> HandoverCheck | None:
    """Correct the robot by the first half of the drive, and check its file on the second half, as `check_written`.

    ``named`` are the keys of the findings, strongest first. Where the file is not better, the weakest is left out, and the next file is
    tried. None where the first file would hold none of the findings, for tables, and for drives that are too short.
    """
    first: HandoverCheck | None = None
    held = np.arange(len(predictor.drive.maneuvers)) >= len(predictor.drive.maneuvers) // 2
    for count in range(len(named), 0, -1):
        sizes = _first_half_sizes(predictor, linearization, named[:count])
        if sizes is None:
            break
        try:
            corrected = correct_robot(predictor, sizes)
        except (CgError, ModelError):  # no robot has the sizes of this half
            continue
        found = check_written(predictor, linearization.noise, CandidateRobot(corrected, sizes, held), reader)
        if found is None:
            break
        found = dataclasses.replace(found, corrected=tuple(named[:count]))
        if found.is_better:
            return found
        first = first or found
    return first


def check_written(predictor: DrivePredictor, noise: Noise, candidate: CandidateRobot, reader: Reader | None) -> HandoverCheck | None:
    """Write the robot file of the ``candidate``, read it again, and predict and replay the windows that are held out with it.

    With a ``reader`` the log is read with the file, so that units, clocks, ranges and mounts act as they do in other commands, and is
    replayed by `odometry` and `ekf`; without one windows are predicted, which is the odometry of a table. Errors of a reference are no part
    of the check. None where the file changes nothing, or nothing was measured.
    """
    if candidate.corrected.robot == predictor.drive.robot:
        return None
    predictor = predictor.by_file
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(robot_toml(relocated(candidate.corrected.robot, path.parent)), encoding="utf-8")
        written = dataclasses.replace(candidate.corrected, robot=load_robot(path))
        candidate = dataclasses.replace(candidate, corrected=written)
        if reader is None:
            return _check_predicted(predictor, noise, candidate)
        return _check_replayed(predictor, noise, candidate, reader)


def _check_predicted(predictor: DrivePredictor, noise: Noise, candidate: CandidateRobot) -> HandoverCheck | None:
    """Windows held out, as the file predicts them."""
    drive, hypothesis = predictor.drive, with_sizes(candidate.sizes)
    after = predictor_after(predictor, candidate.corrected, predictor.model.name)
    held = candidate.held[predictor.batch.owner]
    rows = predictor.discrepancies(_of_reference(hypothesis, drive.is_lidar_reference)), after.discrepancies(_of_sensors(hypothesis))
    found = _compared_rows(rows[0][held], rows[1][held], noise.sigmas[held], noise.weights[held])
    if found is None or drive.kind == "log":
        return found
    weight = np.array([1.0, 1.0, 0.5 * drive.robot.geometry.track_width_m])
    before, now = (np.nansum((r[held, :3] * weight) ** 2, axis=1) for r in rows)
    odometry = _compared(before, now, np.zeros(len(before)), noise.weights[held])
    return found if odometry is None else dataclasses.replace(found, replays={"odometry": odometry})


def _check_replayed(predictor: DrivePredictor, noise: Noise, candidate: CandidateRobot, reader: Reader) -> HandoverCheck | None:
    """Windows held out, of the log as it is read and replayed with the file."""
    old, new, name = predictor.drive.robot, candidate.corrected.robot, predictor.model.name
    drive = reader.drive(new)
    if not drive.maneuvers:
        return None
    after = DrivePredictor(drive, make_model(name, new), has_inertia=predictor.has_inertia, baseline=predictor.baseline)
    of_marker = _of_reference(with_sizes(candidate.sizes), drive.is_lidar_reference)
    first, second = _paired(predictor.drive, drive, candidate.held)
    weights = noise.weights[first]
    rows = predictor.discrepancies(of_marker)[first], after.discrepancies(of_marker)[second]
    found = _compared_rows(*rows, noise.sigmas[first], weights)
    if found is None or not drive.has_headings:  # chords between positions are no poses to compare with
        return found
    start_ns = int(predictor.drive.spans_ns[candidate.held, 0].min()) - _LEAD_NS
    errors = []
    for robot, cut, windows in ((old, predictor.drive, first), (new, drive, second)):
        turn_m = 0.5 * robot.geometry.track_width_m
        errors.append({run.estimator: _window_error(run, cut, windows, turn_m) for run in reader.runs(robot, name, start_ns)})
    variances = _window_noise(noise, first, 0.5 * old.geometry.track_width_m)
    compared = {estimator: _compared(errors[0][estimator], errors[1][estimator], variances, weights) for estimator in errors[0]}
    return dataclasses.replace(found, replays={estimator: one for estimator, one in compared.items() if one is not None})


def _first_half_sizes(predictor: DrivePredictor, linearization: Linearization, named: Sequence[str]) -> dict[Cause, float] | None:
    """Sizes of the causes with keys ``named`` by the first half of the drive alone, within the bounds of each; None for tables, and halves
    with too few windows."""
    half = len(predictor.drive.maneuvers) // 2
    if predictor.drive.kind != "log" or half < _MIN_HALF_WINDOWS or not named:
        return None
    is_first = np.arange(len(linearization.rows)) < half
    arrays = linearization.linear, linearization.signatures, linearization.nuisances
    first = [np.where(is_first.reshape(-1, *(1,) * (a.ndim - 1)), a, np.nan) for a in arrays]
    chosen = [i for i, cause in enumerate(linearization.causes) if cause.key in named]
    causes = tuple(linearization.causes[i] for i in chosen)
    problem = make_regression(first[0], first[1][..., chosen], first[2], linearization.noise, causes, linearization.tolerance)
    sizes = problem.fit(tuple(range(len(causes))))[0]
    return {cause: float(np.clip(size, *cause.bounds)) for cause, size in zip(causes, sizes, strict=True)}


def _compared_rows(before: FloatArray, after: FloatArray, sigmas: FloatArray, weights: FloatArray) -> HandoverCheck | None:
    """Discrepancies ``before`` and ``after`` (M, 6) of windows that were held out; None where nothing was measured in both.

    The gain is the share by which errors over their noise ``sigmas`` (M, 6) shrink in the components that the file changes: the scatter of
    the others, and of a component that is measured less well, would hide it. Windows count by the ``weights`` (M,) of the noise, as in the
    fit: one in which the reference jumps is as far off by any file, and would decide alone.
    """
    shown = [c for c in range(4) if all(np.isfinite(r[:, c]).any() for r in (before, after))]
    if not shown:
        return None
    before_rms, after_rms = ({CHANNELS[c]: _root_mean(r[:, c] ** 2, weights) for c in shown} for r in (before, after))
    moved = np.nan_to_num(np.abs(after - before) / sigmas)
    changed = [c for c in shown if moved[:, c].max() > _LEAST_CHANGE] or shown
    scale = weights[:, None] / sigmas[:, changed]
    squares = [np.sum(np.nan_to_num(r[:, changed] * scale) ** 2, axis=1) for r in (before, after)]
    first, second = (s / max(float(squares[0].mean()), 1e-12) for s in squares)
    gain = root_mean_gain(first, second, np.arange(len(before)) // _BLOCK, np.random.default_rng(0))
    old, change = (np.nan_to_num(r[:, changed] * scale) for r in (before, before - after))
    whole = max(float(np.sum(change**2)), 1e-12)
    return HandoverCheck(before_rms, after_rms, len(before), gain, shown=(float(np.sum(change * old)) / whole, whole**-0.5))


def _root_mean(squares: FloatArray, weights: FloatArray) -> float:
    """Root of the mean of ``squares`` (n,) where these are known, by the squares of the windows' ``weights`` (n,)."""
    known = np.isfinite(squares)
    return math.sqrt(float(np.average(squares[known], weights=weights[known] ** 2)))


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
    return Replayed(*(_root_mean(squares[known], weights[known]) for squares in (before, after, noise)))


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
