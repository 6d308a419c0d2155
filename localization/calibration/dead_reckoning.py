"""Path of a robot by its wheels and gyro over the first minutes of a log, without a filter: what a reference is compared with."""

from __future__ import annotations

import numpy as np

from localization.calibration.wheel_signals import STEP_S, WheelSignals
from localization.errors import EvaluationError
from localization.evaluation.reference_check import reference_contradictions
from localization.evaluation.references import ReferenceTrack, no_overlap_message
from localization.logs import Log
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.prior import expected_scaling
from motion_models.se2 import FloatArray

_NS = 1e-9


def dead_reckon(log: Log, signals: WheelSignals) -> Trajectory:
    """Poses at the edges of the intervals of ``signals``: ways by the wheels, turns by the gyro, else by an odometry, else by the wheels.

    Where one of them is unknown the robot counts as standing.
    """
    speed = forward_rate(log, signals) * (log.robot.geometry.wheel_radius_m if signals.joints else 1.0)
    turns = next((signals.turns[name] for name in ("gyro", *signals.turns) if name in signals.turns), None)
    if turns is None:
        rates, left = signals.joint_rates, signals.left
        scale = expected_scaling(log.robot) * log.robot.geometry.wheel_radius_m / log.robot.geometry.track_width_m
        turns = scale * (rates[:, left:].mean(axis=1) - rates[:, :left].mean(axis=1))
    twists = np.nan_to_num(np.stack([speed, np.zeros_like(speed), turns], axis=1))
    poses = [np.zeros(3)]
    for step in se2.exp(twists * STEP_S):
        poses.append(se2.compose(poses[-1], step))
    edges_s = signals.start_s + STEP_S * np.arange(len(poses))
    return Trajectory(signals.first_ns + np.round(edges_s / _NS).astype(np.int64), np.array(poses))


def forward_rate(log: Log, signals: WheelSignals) -> FloatArray:
    """(n,) speed by a driver's odometry [m/s], or mean rate of the wheels [rad/s]; NaN where unknown."""
    if signals.joints:
        return np.asarray(signals.joint_rates.mean(axis=1))
    assert log.sources.wheels is not None
    return signals.speeds[log.sources.wheels.topic]


def check_reference(log: Log, signals: WheelSignals | None, reference: ReferenceTrack) -> None:
    """Refuse a ``reference`` whose clock, scale, axes or run are not those of the log's wheels and gyro. Raises `EvaluationError`."""
    if signals is None:
        return
    path = dead_reckon(log, signals)
    if apart := disjoint_message(log, path, reference):
        raise EvaluationError(apart)
    found = reference_contradictions([path], reference)
    if found:
        raise EvaluationError(f"{' '.join(found)} Nothing is fitted to such a reference.")


def disjoint_message(log: Log, path: Trajectory, reference: ReferenceTrack) -> str:
    """That no pose of ``reference`` is of the log's time, by its recording or by the stamps of ``path``, and why; "" where some are."""
    spans = [(log.start_ns, log.end_ns), (int(path.stamps_ns[0]), int(path.stamps_ns[-1]))]
    if any(((reference.stamps_ns >= start) & (reference.stamps_ns <= end)).any() for start, end in spans):
        return ""
    return no_overlap_message(path.stamps_ns, reference.stamps_ns, reference.source, 0)
