"""Which set-up a live robot has, asked of its first minutes: the question, the answer and the sentences are those of a log.

What is wrong is the way in which messages are read, so that these are kept as they came, and read again from the start of the drive on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from typing import Any

from localization.events import Event, ImuSample, Scan, WheelSample
from localization.evidence import SetUp
from localization.evidence.entrance import has_moved, infer, sources_of_readings
from localization.evidence.signals import Source, scan_sources
from localization.logs.decode import ArmReading, JointReading, OdometryReading
from localization.logs.topic_roles import Sources
from localization.messages import Message, phrase
from localization.ros.transports.transport import Received
from motion_models.robot import Mount, Robot

_FIRST_NS, _LAST_NS, _LONGER = 6_000_000_000, 120_000_000_000, 1.5
"""From the first motion to the first question and to the last one, and the factor from question to question: turns both ways come within a
minute of driving, and what is read again stays twice the drive."""
_STANDING_NS = 5_000_000_000
"""Kept of a robot that has not moved: the gyro's bias is learned from it."""
_SCANS_NS, _MAX_POINTS = 60_000_000_000, 2_000_000
"""Time after the first motion in which scans are kept, and their points at most: they bound the memory to 100 MB."""
_MAX_BYTES = 150_000_000
"""Largest size of the LiDAR's messages that are kept; beyond, the oldest are left out, and wheels and gyro bridge them."""
_SETTLED = 0.999
"""Probability of the robot file's set-up from where on no more is read: before any data it is 0.97."""
_OPEN = 0.9
"""Probability of the robot file's set-up below which the poses' covariance has twice the way, until the answer is certain."""


@dataclass
class LiveSensors:
    """A robot, its topics and joints, and the mounts of its sensors, where no log is."""

    robot: Robot
    sources: Sources
    joints: tuple[tuple[str, ...], tuple[str, ...]]
    mounts: Mapping[str, Mount]


@dataclass
class _Readings:
    """Readings of a drive so far, as its drivers published them."""

    wheels: deque[JointReading | OdometryReading] = field(default_factory=deque)
    gyro: deque[ImuSample] = field(default_factory=deque)
    scans: list[Scan] = field(default_factory=list)

    def forget(self, before_ns: int) -> None:
        """Leave out those with earlier stamps [ns]."""
        for rows in (self.wheels, self.gyro):
            while rows and rows[0].stamp_ns < before_ns:
                rows.popleft()

    def sources(self, sensors: LiveSensors) -> list[Source]:
        """Sources of motion so far."""
        first_ns = self.wheels[0].stamp_ns
        imu = sensors.sources.imu
        readings: dict[str, Sequence[Any]] = {sensors.sources.all_wheels[0].topic: self.wheels}
        if imu is not None:
            readings[imu.topic] = self.gyro
        found = sources_of_readings(sensors, readings, first_ns)
        return [*found, *scan_sources(sensors, self.scans, first_ns)]


class LiveSetUp:
    """`keep` each message, then `add` its readings and `add_event` its events, until `is_done`."""

    def __init__(self, sensors: LiveSensors, executor: Executor | None = None) -> None:
        """``executor``: where questions are answered beside the estimator; None: at once."""
        self._sensors, self._executor = sensors, executor
        self._messages = KeptMessages({source.topic for source in sensors.sources.lidars})
        self._readings = _Readings()
        self._first: JointReading | OdometryReading | None = None
        self._moving_ns: int | None = None
        self._next_ns = 0
        self._points = 0
        self._way_m = 0.0
        self._last: WheelSample | None = None
        self._asked: Future[SetUp] | None = None
        self._is_last = False
        self.found: SetUp | None = None
        """The newest answer."""
        self.is_done = False
        """The answer is certain, the sensors agree, or two minutes of driving have passed."""

    @property
    def messages(self) -> Sequence[Received]:
        """Since the start of the drive."""
        return self._messages.in_order()

    @property
    def texts(self) -> tuple[Message, ...]:
        """Sentences on what was found."""
        found = () if self.found is None else self.found.sentences
        return tuple(each.but(correction=phrase("set_up.since_start")) for each in found)

    @property
    def largest_error_m(self) -> float:
        """Largest error of the position [m]: twice the way while the robot file's set-up is improbable; else 0."""
        is_open = self.found is not None and self.found.verdict != "undecidable" and self.found.by_file < _OPEN
        return 2.0 * self._way_m if is_open else 0.0

    def keep(self, received: Received) -> None:
        """Keep a message, before its readings are added."""
        self._messages.add(received)
        if self._moving_ns is None:
            self._messages.forget(received.received_ns - _STANDING_NS)

    def add(self, reading: Any) -> None:
        """Take a ``reading`` of any sensor, as its driver published it."""
        wheels = reading.wheels if isinstance(reading, ArmReading) else reading
        if isinstance(reading, ImuSample):
            self._readings.gyro.append(reading)
        elif isinstance(reading, Scan):
            self._add_scan(reading)
        elif isinstance(wheels, JointReading | OdometryReading):
            self._add_wheels(wheels)

    def add_event(self, event: Event) -> None:
        """Take an ``event`` that the readings made."""
        if isinstance(event, WheelSample):
            if self._last is not None:
                seconds = (event.stamp_ns - self._last.stamp_ns) * 1e-9
                rates = event.velocity[event.velocity == event.velocity]
                radius = self._sensors.robot.geometry.wheel_radius_m
                self._way_m += abs(float(rates.mean())) * seconds * radius if len(rates) else 0.0
            self._last = event
        self._take_answer()

    def _add_scan(self, scan: Scan) -> None:
        is_early = self._moving_ns is not None and scan.stamp_ns < self._moving_ns + _SCANS_NS
        if is_early and self._points < _MAX_POINTS:
            self._points += len(scan.points)
            self._readings.scans.append(scan)

    def _add_wheels(self, sample: JointReading | OdometryReading) -> None:
        self._first = sample if self._first is None or type(sample) is not type(self._first) else self._first
        if self._moving_ns is None and has_moved(self._first, sample):
            self._moving_ns, self._next_ns = sample.stamp_ns, sample.stamp_ns + _FIRST_NS
        self._readings.wheels.append(sample)
        if self._moving_ns is None:  # while it stands
            self._readings.forget(sample.stamp_ns - _STANDING_NS)
        elif sample.stamp_ns >= self._next_ns and self._asked is None and not self.is_done:
            self._ask(sample.stamp_ns, self._moving_ns)

    def _ask(self, now_ns: int, moving_ns: int) -> None:
        self._is_last = now_ns >= moving_ns + _LAST_NS
        self._next_ns = moving_ns + min(round((now_ns - moving_ns) * _LONGER), _LAST_NS)
        readings = _Readings(self._readings.wheels.copy(), self._readings.gyro.copy(), self._readings.scans.copy())
        sensors = self._sensors

        def answer() -> SetUp:
            return infer(readings.sources(sensors), sensors.robot)

        if self._executor is not None:
            self._asked = self._executor.submit(answer)
            return
        self._asked = Future()
        self._asked.set_result(answer())
        self._take_answer()

    def _take_answer(self) -> None:
        if self._asked is None or not self._asked.done():
            return
        self.found, self._asked = self._asked.result(), None
        is_settled = self.found.verdict == "consistent" and self.found.by_file > _SETTLED
        self.is_done = self.found.verdict == "certain" or is_settled or self._is_last


class EntranceChecks:
    """`begin` what is to be asked from here on; `running` is None once nothing is."""

    def __init__(self, executor: Executor | None = None) -> None:
        self._executor = executor
        self.running: LiveSetUp | None = None
        self.notes: list[Message] = []
        """What was found."""
        self._corrected: set[str] = set()  # keys of the robot file

    def begin(self, sensors: LiveSensors) -> LiveSetUp | None:
        """Compare the ``sensors`` from here on; None where one alone measures the motion."""
        sources = sensors.sources
        others = [source for source in (sources.imu, sources.lidar) if source is not None]
        self.running = LiveSetUp(sensors, self._executor) if sources.wheels is not None and others else None
        return self.running

    def end(self, report: Callable[[str], None]) -> SetUp | None:
        """The question is answered: what was found is noted and reported. The set-up to go on with, where that is another one.

        A key of the robot file is corrected once: what a correction does not change would begin the drive anew for ever.
        """
        running, self.running = self.running, None
        if running is None:
            return None
        for text in running.texts:
            self.notes.append(text)
            report(text)
        found = running.found
        if found is None or found.is_as_declared or (found.keys and self._corrected >= found.keys.keys()):
            return None
        self._corrected |= found.keys.keys()
        return found


class KeptMessages:
    """Messages in order of coming; those of LiDARs, which are large, up to `_MAX_BYTES`."""

    def __init__(self, lidars: Collection[str]) -> None:
        """``lidars``: their topics."""
        self._lidars = lidars
        self._lidar: deque[Received] = deque()
        self._others: deque[Received] = deque()
        self._bytes = 0

    def add(self, received: Received) -> None:
        """Keep ``received``."""
        if received.topic not in self._lidars:
            self._others.append(received)
            return
        self._lidar.append(received)
        self._bytes += len(received.data)
        while self._bytes > _MAX_BYTES:
            self._bytes -= len(self._lidar.popleft().data)

    def forget(self, before_ns: int) -> None:
        """Leave out those that were received earlier [ns]."""
        while self._others and self._others[0].received_ns < before_ns:
            self._others.popleft()
        while self._lidar and self._lidar[0].received_ns < before_ns:
            self._bytes -= len(self._lidar.popleft().data)

    def in_order(self) -> list[Received]:
        """All, by the time of receiving."""
        return sorted([*self._others, *self._lidar], key=lambda received: received.received_ns)
