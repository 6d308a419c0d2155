"""What a log has beside the windows of a drive: the commands that its servos were given, and the slope of the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from localization.log_replay import replay
from localization.logs.commands import command_topics, read_commands
from localization.logs.event_decoder import driven_wheels
from localization.logs.reader import Log
from localization.pipeline import Trial
from localization.trajectory import IntArray
from localization.twin.fit import RATE_SIGMA
from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError
from motion_models.registry import make_model
from motion_models.se2 import FloatArray
from motion_models.slope import Slope

_NS = 1e-9
_HELD_S = 0.5
"""Age beyond which a driver no longer follows a command: diff_drive_controller's cmd_vel_timeout."""
_FEWEST = 5
"""Windows with a constant command from which on servos are judged."""
_STRAIGHT_GAIN = (0.9, 1.1)
"""Speed over the commanded one: servos reach it within this on straight ways, which take little torque."""
_TURN_GAIN = (0.4, 1.1)
"""Difference of the sides over the commanded one: skidding wheels may take all of a weak servo's torque."""


def with_commands(maneuvers: Sequence[Maneuver], spans_ns: IntArray, log: Log, topic: str | None = None) -> tuple[list[Maneuver], str]:
    """``maneuvers``, which began and ended at ``spans_ns`` (W, 2), with set points where the command is constant, and a sentence on them.

    While a command changes, a driver's limits of acceleration decide what the servos are given. Without a ``topic`` that of the log's
    commands counts by which most windows have one that its wheels follow. Raises `CalibrationError` for a ``topic`` without commands.
    """
    topics = command_topics(log) if topic is None else [topic]
    if topic and topic not in log.types:
        raise CalibrationError(f"{log.path.name} has no topic {topic}. Topics of commands: {', '.join(command_topics(log)) or 'none'}.")
    if topic == "" or not topics:
        return list(maneuvers), ""
    found = [_commanded(maneuvers, spans_ns, log, name) for name in topics]
    return max(found, key=lambda of_topic: sum(m.commands is not None for m in of_topic[0]))


def _commanded(maneuvers: Sequence[Maneuver], spans_ns: IntArray, log: Log, topic: str) -> tuple[list[Maneuver], str]:
    """With the commands of one ``topic``."""
    stamps, twists = read_commands(log, topic)
    driver = log.robot.driver
    set_points = driven_wheels(twists[:, [0, 2]], driver.half_track_m, driver.wheel_radius_m)
    tried = [_constant(m, span, stamps, set_points) for m, span in zip(maneuvers, spans_ns, strict=True)]
    constant = {i: command for i, command in enumerate(tried) if command is not None}
    if len(constant) < _FEWEST:
        return list(maneuvers), f"{topic} is constant in {len(constant)} windows: servos are not judged, measured rates are played."
    asked, rolled = np.array(list(constant.values())), np.array([_mean_rates(maneuvers[i]) for i in constant])
    straight, turning = _gain(rolled.sum(axis=1), asked.sum(axis=1)), _gain(np.diff(rolled)[:, 0], np.diff(asked)[:, 0])
    if not (_STRAIGHT_GAIN[0] < straight < _STRAIGHT_GAIN[1] and _TURN_GAIN[0] < turning < _TURN_GAIN[1]):
        text = f"{topic} is not what the wheels were given by [driver] of the robot file: their mean is {straight:.2f} of it, their"
        return list(maneuvers), f"{text} difference {turning:.2f}. Measured rates are played, and servos are not judged."
    changed = list(maneuvers)
    for i, command in constant.items():
        changed[i] = replace(maneuvers[i], commands=np.tile(command, (len(maneuvers[i].dt), 1)))
    return changed, f"commands of {topic} are played in {len(constant)} windows in which they are constant: servos are judged there."


def _constant(m: Maneuver, span_ns: IntArray, stamps: IntArray, set_points: FloatArray) -> FloatArray | None:
    """(2,) the set points that held from before the maneuver's lead to its end; None where they changed, or were missing."""
    lead_ns = round(float(m.dt[: m.lead].sum()) / _NS)
    first, last = np.searchsorted(stamps, [span_ns[0] - lead_ns, span_ns[1]], side="right")
    if first == 0:
        return None
    held = set_points[first - 1 : last]
    edges = np.concatenate([stamps[first - 1 : last], span_ns[1:]])
    scatter = np.ptp(held, axis=0).max()
    is_constant = scatter <= RATE_SIGMA[0] + RATE_SIGMA[1] * np.abs(held).max()
    return held.mean(axis=0) if is_constant and np.diff(edges).max() * _NS <= _HELD_S else None


def _mean_rates(m: Maneuver) -> FloatArray:
    """(2,) measured, over the maneuver [rad/s]."""
    inside = slice(m.lead, m.lead + int(m.ends[-1]))
    return np.asarray(m.dt[inside] @ m.wheels[inside] / m.dt[inside].sum())


def _gain(found: FloatArray, asked: FloatArray) -> float:
    """Slope of ``found`` over ``asked``, by least squares; 1 where nothing was asked."""
    square = float(asked @ asked)
    return float(found @ asked) / square if square > 0.0 else 1.0


def with_slopes(maneuvers: Sequence[Maneuver], spans_ns: IntArray, log: Log) -> list[Maneuver]:
    """``maneuvers`` with the ground's slope at their starts, where the accelerometers show that it tilts."""
    if log.sources.imu is None:
        return list(maneuvers)
    trial = Trial(make_model("skid_steer", log.robot), "odometry")  # diff_drive knows of no slopes
    path = replay(log.events(), [trial], log.robot, log.mounts, has_lidar=False)[0].in_space
    if path is None:
        return list(maneuvers)
    at = np.clip(np.searchsorted(path.stamps_ns, spans_ns[:, 0]), 0, len(path.stamps_ns) - 1)
    x, y, z, w = path.quaternions[at].T
    up = np.column_stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
    downhill = Slope.from_up(up, 0.0).downhill
    return [replace(m, downhill=of_start) for m, of_start in zip(maneuvers, downhill, strict=True)]
