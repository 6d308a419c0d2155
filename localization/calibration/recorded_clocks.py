"""A clock that is off by the times of recording, where turns confirm it.

A message is recorded soon after its measurement, and never before. A topic whose stamps are ahead of that, far behind it, or run faster or
slower, has a clock of its own, or waits in a queue with stamps that are right. The turns of another sensor decide: they agree with those by
the corrected clock, or with those of the stamps as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from localization.calibration.wheel_signals import MAX_BIAS_RAD_S, MIN_TURN_RAD_S, WheelSignals, correlation, read_signals, with_lidar
from localization.calibration.wheel_units import CORRECTED
from localization.logs import Log, open_log
from localization.logs.event_decoder import CLOCKS
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_MIN_OFF_S, _MAX_LATENCY_S = 0.15, 0.1
"""Least time of recording less stamp, of either sign, of a clock that may be off, and largest of one that is not: the latency of drivers,
as of the LiDAR's check."""
_MIN_OFF_OF_THREE_S = 1.4
"""Least offset, where there are three sensors, whose smaller ones the LiDAR's check measures by turns [s]."""
_MIN_CORRELATION, _MIN_GAIN = 0.9, 2.0
"""Correlation of turns with the corrected clock, at least, and how many times nearer to 1 than without."""


@dataclass(frozen=True)
class RecordedClock:
    """A sensor's clock that is off, or may be."""

    robot: Robot
    """With the corrected clock, or, where nothing confirms it, with its offset as `clock.sigma_s`."""
    text: str
    keys: Mapping[str, str]
    """Entries to write to the robot file."""


@dataclass(frozen=True)
class Suspect:
    """A clock that may be the one that is off."""

    sensor: str
    """Its name, as it begins the entries of `Clock`: wheel, lidar or gyro."""
    topic: str
    key: str
    value: float
    """Value of that entry of `Clock`."""
    why: str


def find_recorded_clock(log: Log, signals: WheelSignals, turn: Callable[[WheelSignals], FloatArray]) -> RecordedClock | None:
    """The first clock of ``log`` that is off by the times of recording, where turns of another sensor agree better with it corrected.

    Where turns agree with neither, an offset is named, and in the covariance.

    ``signals``: of ``log``; ``turn``: (n,) by the wheels, up to a scale.
    """
    undecided = None
    for suspect in find_suspects(log):
        clock = replace(log.robot.clock, **{suspect.key: suspect.value})
        corrected = open_log(log.path, replace(log.robot, clock=clock), log.overrides)
        after_signals = read_signals(corrected)
        if after_signals is None:
            continue
        before, after = _agreement(log, signals, suspect, turn), _agreement(corrected, after_signals, suspect, turn)
        is_open = before is not None and after is not None and max(before, after) < _MIN_CORRELATION
        if is_open and undecided is None and suspect.key.endswith("_time_offset_s"):
            undecided = suspect
        if before is None or after is None or after < _MIN_CORRELATION or 1.0 - before < _MIN_GAIN * (1.0 - after):
            continue
        value = f"{suspect.value:.4g}"
        other = "other sensor" if suspect.sensor == "wheel" else "wheels"
        text = (
            f"{suspect.topic}: {suspect.why}, and its turns agree with those of the {other} with that undone"
            f" (correlation {before:.3f} -> {after:.3f}): its clock is off. {CORRECTED} clock.{suspect.key} = {value}, or"
            " synchronize the clocks."
        )
        return RecordedClock(corrected.robot, text, {f"clock.{suspect.key}": value})
    if undecided is None:
        return None
    text = (
        f"{undecided.topic}: {undecided.why}: its clock is off, or it waits in a queue with stamps that are right, which the turns of this"
        f" drive do not show. The covariance has the way in that time. Synchronize the clocks, or write clock.{undecided.key} ="
        f" {undecided.value:g}, if it is the clock."
    )
    late_s = abs(undecided.value - getattr(log.robot.clock, undecided.key))
    return RecordedClock(replace(log.robot, clock=replace(log.robot.clock, sigma_s=late_s)), text, {})


def find_suspects(log: Log) -> Iterator[Suspect]:
    """Clocks of sensors that are late, or run at another rate, against the times of recording."""
    sensors = {source.topic: CLOCKS[source.kind] for source in log.sources.used() if source.kind in CLOCKS}
    clock = log.robot.clock
    if len({*sensors.values()}) < 2:
        return
    for topic, rate in log.rate_errors().items():
        if topic not in sensors:
            continue  # the centre of gravity, arms
        key = f"{sensors[topic]}_rate_error"
        value = round(getattr(clock, key) + rate, 5)
        way = "faster" if rate > 0.0 else "slower"
        yield Suspect(sensors[topic], topic, key, value, f"its stamps run {abs(rate):.2%} {way} than the times of recording")
    least = _MIN_OFF_OF_THREE_S if len({*sensors.values()}) > 2 else _MIN_OFF_S
    behind = {topic: late for topic, late in log.behind_s.items() if topic in sensors}
    for topic, late in behind.items():
        others = [abs(other) for name, other in behind.items() if sensors[name] != sensors[topic]]
        if abs(late) < least or not others or max(others) > _MAX_LATENCY_S:
            continue
        key = f"{sensors[topic]}_time_offset_s"
        value = round(getattr(clock, key) - late, 2)
        way = "behind" if late > 0.0 else "ahead of"
        off = f"those of the other sensors at most {max(others):.2f} s off them"
        why = f"its stamps are {abs(late):.2f} s {way} the times of recording, {off}"
        yield Suspect(sensors[topic], topic, key, value, why)


def _agreement(log: Log, signals: WheelSignals, suspect: Suspect, turn: Callable[[WheelSignals], FloatArray]) -> float | None:
    """Correlation of turns by the wheels with those of the gyro, or of the LiDAR where it is in question or there is no gyro."""
    if suspect.sensor == "lidar" or "gyro" not in signals.turns:
        signals = with_lidar(log, signals)
    other = signals.turns.get("LiDAR" if suspect.sensor == "lidar" or "gyro" not in signals.turns else "gyro")
    r = None if other is None else correlation(turn(signals), other, MIN_TURN_RAD_S, MAX_BIAS_RAD_S)
    return None if r is None else abs(r)
