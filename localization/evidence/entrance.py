"""The one question that all entrances ask of a log: which set-up is it?

`infer_set_up` reads the first two minutes of driving; `open_log_with_set_up` opens a log with what is certain corrected, each contradiction
in `Log.warnings`. Replay, calibration, diagnosis, comparison and the live node have the same answer, probability and sentence.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from localization.events import Scan
from localization.evidence.alternatives import Row
from localization.evidence.fields import own_faults
from localization.evidence.search import make_stacks
from localization.evidence.signals import Source, bin_edges, from_gyro, from_joints, from_odometry, from_poses, is_comparable, scan_sources
from localization.evidence.verdict import SetUp, decide
from localization.logs import Log, TopicOverrides, open_log
from localization.logs.decode import MAX_RATE_RAD_S, JointReading, OdometryReading, imu_decoder
from localization.logs.event_decoder import TopicDecoder, late_ns
from localization.logs.wheel_messages import angle_period_rad, odometry_decoder, wheel_decoder
from motion_models.errors import CalibrationError
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_MOVING_S, _READ_S, _SCANS_S, _STANDING_S = 120.0, 900.0, 75.0, 5.0
"""Time after the first motion that is read, in all, with scans (registering one takes a millisecond), and kept from before it [s]."""
_MIN_BINS = 12
"""Bins in which sources are compared, at least: 6 s."""
_MOVED = 0.02
"""Change of an angle, or rate, from where on wheels have moved, in any unit that practice has: above the noise of rates at standstill."""
_DEG_PER_RAD = 180.0 / math.pi


@dataclass(frozen=True, eq=False)
class SetUpLog:
    """A log and which set-up it has."""

    log: Log
    """With what is certain corrected (`Log.robot`, `Log.mounts`)."""
    set_up: SetUp
    sources: tuple[Source, ...] | None = None
    """What it was inferred from; None where the log is read otherwise now, or where the answer was known."""


def open_log_with_set_up(path: Path | str, robot: Robot, topics: TopicOverrides = TopicOverrides()) -> SetUpLog:  # noqa: B008
    """The log at ``path`` as `open_log` opens it, with what is certain corrected. Raises what that does."""
    log, question = open_log(path, robot, topics), _question(Path(path), robot, topics)
    sources = None if question in _ANSWERS else tuple(read_sources(log))
    found = _ANSWERS[question] if sources is None else infer(sources, log.robot)
    _ANSWERS[question] = found
    if not found.is_as_declared:
        sources = None
        log = open_log(path, found.robot, topics if found.is_gyro_used else replace(topics, imu=""))
        log.add_notes(found.sentences)
    return SetUpLog(log, found, sources)


_ANSWERS: dict[bytes, SetUp] = {}
"""By question: commands of several parts ask the same one for each."""


def _question(path: Path, robot: Robot, topics: TopicOverrides) -> bytes:
    """What is asked, of files as they are now."""
    files = [file.stat() for file in ([path] if path.is_file() else sorted(path.iterdir()))]
    return pickle.dumps((str(path.resolve()), [(file.st_size, file.st_mtime_ns) for file in files], robot, topics))


def open_log_to_fit(path: Path | str, robot: Robot, topics: TopicOverrides = TopicOverrides()) -> Log:  # noqa: B008
    """The log at ``path`` for what is fitted to it, with what is certain of its set-up corrected, in `Log.robot` as well.

    Raises what `open_log` does, and `CalibrationError` where several set-ups remain, or where a sensor other than the gyro, which is then
    left out, is off in a way that no robot file corrects: nothing is fitted to sensors that contradict each other.
    """
    found = open_log_with_set_up(path, robot, topics)
    set_up = found.set_up
    if set_up.is_open or any(row.correct is None and row.source != "gyro" for row in set_up.faults):
        raise CalibrationError(f"{' '.join(set_up.sentences)} Nothing is fitted to sensors that contradict each other.")
    return found.log


class ReferencePoses(Protocol):
    """Poses of the robot by a reference system."""

    @property
    def source(self) -> str:
        """Topic or file."""
        ...

    @property
    def stamps_ns(self) -> Any:
        """(N,) strictly increasing."""
        ...

    @property
    def yaws(self) -> Any:
        """(N,) [rad], or None where there are positions only."""
        ...

    @property
    def poses(self) -> FloatArray:
        """(N, 3)"""
        ...


def infer_set_up(log: Log, reference: ReferencePoses | None = None) -> SetUp:
    """The set-up of ``log``, by its own sources and a ``reference``."""
    return infer(read_sources(log, reference), log.robot)


def infer(sources: Sequence[Source], robot: Robot) -> SetUp:
    """The set-up with which ``sources`` are most probable."""
    own: tuple[Row, ...] = ()
    used: list[Source] = []
    for source in sources:
        alive, rows = own_faults(source, robot)
        used, own = [*used, *([alive] if is_comparable(alive) else [])], (*own, *rows)
    if len(used) < 2:
        there = used[0].name if used else "no source"
        return SetUp("undecidable", robot, reason=f"{there} alone measures the motion often enough: nothing can be compared.")
    start, end = max(source.t[0] for source in used), min(source.t[-1] for source in used)
    edges = bin_edges(used, start, end)
    if len(edges) < _MIN_BINS:
        return SetUp("undecidable", robot, reason=f"the sources overlap by {max(end - start, 0.0):.1f} s: too short to be compared.")
    measured = [(source, rates) for source in used if np.isfinite(rates := source.rates(edges)).any(axis=1).sum() >= _MIN_BINS]
    if len(measured) < 2:
        return SetUp("undecidable", robot, reason="no two sources know their motion for long enough: nothing can be compared.")
    if all(float(np.nanmax(np.abs(rates), initial=0.0)) < 1e-3 for _, rates in measured):
        return SetUp("undecidable", robot, reason="nothing moves: drive straight on for 10 s and turn in place both ways.")
    used = [source for source, _ in measured]
    return decide(used, make_stacks(used, edges, robot), robot, own)


def read_sources(log: Log, reference: ReferencePoses | None = None) -> list[Source]:
    """Sources of the first two minutes of driving, and the ``reference`` of all of the log; none where the log has no wheels."""
    if log.sources.wheels is None or log.wheels_error is not None:
        return []
    decoders = _decoders(log)
    late = {source.topic: late_ns(source.kind, log.robot.clock) for source in log.sources.used()}
    gathered: dict[str, list[Any]] = {}
    first_ns = moving_ns = first = None
    for payload in log.readings({t: TopicDecoder(0, _tagged(t, decode), late.get(t, 0)) for t, decode in decoders.items()}):
        first_ns = payload.stamp_ns if first_ns is None else first_ns
        reading = payload.reading
        if reading.stamp_ns != payload.stamp_ns:  # by its topic's clock
            reading = replace(reading, stamp_ns=payload.stamp_ns)
        gathered.setdefault(payload.topic, []).append(reading)
        if moving_ns is None and payload.topic == log.sources.wheels.topic:
            first = payload.reading if first is None else first
            moving_ns = payload.stamp_ns if has_moved(first, payload.reading) else None
        if payload.stamp_ns > (first_ns + _READ_S * 1e9 if moving_ns is None else moving_ns + _MOVING_S * 1e9):
            break
    if first_ns is None:
        return []
    begin_ns = first_ns if moving_ns is None else max(first_ns, moving_ns - round(_STANDING_S * 1e9))
    rows = {topic: [r for r in readings if r.stamp_ns >= begin_ns] for topic, readings in gathered.items()}
    found = sources_of_readings(log, rows, begin_ns)
    found += scan_sources(log, _scans_of(log, begin_ns), begin_ns)
    if reference is not None and reference.yaws is not None:
        of_reference = from_poses(reference.source, reference.stamps_ns, reference.poses, begin_ns)
        found += [] if of_reference is None else [of_reference]
    return [replace(source, first_ns=begin_ns, behind_s=log.behind_s.get(source.name)) for source in found]


def sources_of_readings(log: Any, readings: Mapping[str, Sequence[Any]], first_ns: int) -> list[Source]:
    """Sources of ``readings`` by topic; ``log``: what has `robot`, `sources`, `joints` and `mounts`."""
    found: list[Source | None] = []
    wheels = sorted((r for source in log.sources.all_wheels for r in readings.get(source.topic, ())), key=lambda reading: reading.stamp_ns)
    name = " and ".join(source.topic for source in log.sources.all_wheels)
    joints = [r for r in wheels if isinstance(r, JointReading)]
    odometry = [r for r in wheels if isinstance(r, OdometryReading)]
    if joints:
        period = angle_period_rad(log.robot.joints, log.sources.all_wheels[0].type)
        found.append(from_joints(name, joints, log.joints, period, first_ns))
    elif odometry:
        found.append(from_odometry(name, odometry, first_ns))
    if log.sources.imu is not None and readings.get(log.sources.imu.topic):
        found.append(from_gyro(log.sources.imu.topic, readings[log.sources.imu.topic], log.mounts, first_ns))
    return [source for source in found if source is not None]


def _scans_of(log: Log, begin_ns: int) -> Iterator[Scan]:
    for scan in log.scans():
        if scan.stamp_ns > begin_ns + (_STANDING_S + _SCANS_S) * 1e9:
            return
        if scan.stamp_ns >= begin_ns:
            yield scan


@dataclass(frozen=True)
class _Tagged:
    """A payload with its topic."""

    stamp_ns: int
    topic: str
    reading: Any


def _tagged(topic: str, decode: Callable[[Any, int], Any]) -> Callable[[Any, int], _Tagged | None]:
    def tagged(message: Any, stamp: int) -> _Tagged | None:
        reading = decode(message, stamp)
        return None if reading is None else _Tagged(reading.stamp_ns, topic, reading)

    return tagged


def _decoders(log: Log) -> dict[str, Callable[[Any, int], Any]]:
    """By topic: wheels and IMU."""
    found: dict[str, Callable[[Any, int], Any]] = {}
    of_wheels = wheel_decoder((*log.joints[0], *log.joints[1]), log.robot.joints)
    for source in log.sources.all_wheels:
        if source.kind == "joint_states":
            found[source.topic] = of_wheels
        else:
            found[source.topic] = odometry_decoder(source.type, log.robot.driver.length_unit_m)
    if log.sources.imu is not None:
        found[log.sources.imu.topic] = imu_decoder(log.robot.imu.rate_unit_rad_s, _DEG_PER_RAD * MAX_RATE_RAD_S)
    return found


def has_moved(first: Any, reading: Any) -> bool:
    """Whether the wheels have turned since their ``first`` reading, in any unit."""
    if isinstance(reading, JointReading):
        return bool((np.abs(reading.velocity) > _MOVED).any() or (np.abs(reading.position - first.position) > _MOVED).any())
    return bool((np.abs(reading.twist) > _MOVED).any() or (np.abs(reading.pose - first.pose) > _MOVED).any())
