"""The gain of a corrected robot: its file is written, read again, and the log replayed with it, on windows that did not correct it."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from localization.diagnosis.causes.cause import with_sizes
from localization.diagnosis.corrected_robot import BLOCK, compared_halves, correct_robot, first_half_sizes, of_reference
from localization.diagnosis.drive import Drive
from localization.diagnosis.findings import HandoverCheck, Replayed
from localization.diagnosis.linearization import Linearization
from localization.diagnosis.noise import Noise
from localization.diagnosis.prediction import DrivePredictor
from localization.logs.reader import Log
from localization.pipeline import Run, Trial, replay
from motion_models import se2
from motion_models.calibration.cross_validation import root_mean_gain
from motion_models.calibration.maneuvers import IntArray
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot, relocated, robot_toml
from motion_models.se2 import FloatArray

_ESTIMATORS = ("odometry", "ekf")
_LEAD_NS = 4_000_000_000
"""Before the first held-out window, for an estimator to begin [ns]."""
_SAME_WINDOW_S = 0.3
"""Windows of two readings of a log that begin so close are one: clocks that are corrected move them by less."""


@dataclasses.dataclass(frozen=True)
class Reader:
    """How the diagnosed log is read with a robot: its drive, and its events."""

    drive: Callable[[Robot], Drive]
    log: Callable[[Robot], Log]


def check_written_robot(
    reader: Reader, predictor: DrivePredictor, linearization: Linearization, named: Sequence[str]
) -> HandoverCheck | None:
    """Correct the robot by the first half of the drive, write its file, read it again, and predict and replay the second half with it.

    ``named`` are the keys of the findings. Everything that the file holds acts as it does in other commands: units, clocks, ranges and
    mounts when messages are decoded. None where the file would hold none of the findings, or the drive is too short.
    """
    sizes = first_half_sizes(predictor, linearization, named)
    if sizes is None:
        return None
    old = predictor.drive.robot
    corrected = correct_robot(predictor, sizes).robot
    if corrected == old:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(robot_toml(relocated(corrected, path.parent)), encoding="utf-8")
        new = load_robot(path)
        drive = reader.drive(new)
        if not drive.maneuvers:
            return None
        model = make_model(predictor.model.name, new)
        after = DrivePredictor(drive, model, has_inertia=predictor.has_inertia, baseline=predictor.baseline)
        of_marker = of_reference(with_sizes(sizes), drive.is_lidar_reference)
        first, second = _paired(predictor.drive, drive)
        rows = predictor.discrepancies(of_marker)[first], after.discrepancies(of_marker)[second]
        found = compared_halves(*rows)
        if found is None:
            return None
        if not drive.has_headings:  # chords between positions are no poses to compare with
            return found
        runs = (old, predictor.drive, first), (new, drive, second)
        errors = [_replay_errors(reader.log(robot), robot, predictor.model.name, cut, windows) for robot, cut, windows in runs]
    noise = _window_noise(linearization.noise, first, 0.5 * old.geometry.track_width_m)
    compared = {name: _compared(errors[0][name], errors[1][name], noise) for name in errors[0]}
    return dataclasses.replace(found, replays={name: one for name, one in compared.items() if one is not None})


def _compared(before: FloatArray, after: FloatArray, noise: FloatArray) -> Replayed | None:
    """Squared errors (W,) of one estimator in the same windows with both files, and the variance of their noise (W,), where both runs
    cover the windows; None where none do."""
    known = np.isfinite(before) & np.isfinite(after)
    if not known.any():
        return None
    gain = root_mean_gain(before[known], after[known], np.arange(int(known.sum())) // BLOCK, np.random.default_rng(0))
    return Replayed(
        math.sqrt(float(before[known].mean())), math.sqrt(float(after[known].mean())), gain, math.sqrt(float(noise[known].mean()))
    )


def _paired(before: Drive, after: Drive) -> tuple[IntArray, IntArray]:
    """Indices of the windows of the second half of ``before``, and of the same windows ``after``."""
    half = len(before.maneuvers) // 2
    starts = after.spans_ns[:, 0]
    pairs = []
    for i in range(half, len(before.maneuvers)):
        j = int(np.argmin(np.abs(starts - before.spans_ns[i, 0])))
        if abs(int(starts[j] - before.spans_ns[i, 0])) <= _SAME_WINDOW_S * 1e9:
            pairs.append((i, j))
    first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return first, second


def _replay_errors(log: Log, robot: Robot, model: str, drive: Drive, windows: IntArray) -> dict[str, FloatArray]:
    """Squared errors (W,) of the motion in ``windows`` of ``drive`` by each estimator, headings times half the track [m^2]."""
    trials = [Trial(make_model(model, robot), name) for name in _ESTIMATORS]
    start_ns = int(drive.spans_ns[windows, 0].min()) - _LEAD_NS
    events = (event for event in log.events() if event.stamp_ns >= start_ns)
    runs = replay(events, trials, log.robot, log.mounts, log.sources.lidar is not None)
    return {run.estimator: _window_error(run, drive, windows, 0.5 * robot.geometry.track_width_m) for run in runs}


def _window_noise(noise: Noise, windows: IntArray, turn_m: float) -> FloatArray:
    """(W,) variance of the motion in ``windows`` that is noise on this drive, headings times ``turn_m`` [m^2]."""
    variances = np.where(noise.known, noise.sigmas, 0.0)[windows, :3] ** 2
    return np.asarray(variances @ np.array([1.0, 1.0, turn_m**2]))


def _window_error(run: Run, drive: Drive, windows: IntArray, turn_m: float) -> FloatArray:
    spans, used = drive.spans_ns[windows], [drive.maneuvers[int(i)] for i in windows]
    moved = se2.between(run.trajectory.at(spans[:, 0]), run.trajectory.at(spans[:, 1]))  # NaN where the run does not cover the window
    known = np.array([np.isfinite(np.diagonal(np.broadcast_to(m.cov, (len(m.ends), 3, 3))[-1])) for m in used])
    off = se2.between(np.array([m.measured[-1] for m in used]), moved) * np.array([1.0, 1.0, turn_m])
    return np.asarray(np.sum(np.where(known, off, 0.0) ** 2, axis=1))
