"""Wheels, gyro and LiDAR of a live drive against each other and the robot file, from its first metres on: what is wrong is the way in which
messages are read, so that these are kept as they came, and read again from the start of the drive on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from localization.calibration.lidar_check import LidarCheck, LidarFinding
from localization.calibration.wheel_units import CORRECTED
from localization.calibration.wheel_wiring import WiringReport
from localization.events import Event
from localization.ros.live_inputs import LiveInputs
from localization.ros.live_wiring import LiveWiring
from localization.ros.transports.transport import Received
from motion_models.robot import Mount

_STANDING_NS = 5_000_000_000
"""Kept of a robot that has not moved: the gyro's bias is learned from it."""
_MAX_BYTES = 150_000_000
"""Largest size of the LiDAR's messages that are kept; beyond, the oldest are left out, and wheels and gyro bridge them."""
_NOW = "Corrected from the start of the drive on; write to the robot file:"


class LiveEntrance:
    """`keep` each message, then `add` its readings and `add_event` its events, until `is_done`: something that contradicts the robot file
    was found, or all checks have ended."""

    def __init__(self, wiring: LiveWiring | None, lidar: LidarCheck | None, lidar_topic: str) -> None:
        """``wiring``: None where nothing can contradict the wheels; ``lidar``: None where its mount and clock are not to be checked."""
        self._wiring, self._lidar = wiring, lidar
        self._messages = KeptMessages(lidar_topic)
        self.lidar: LidarFinding | None = None
        """What is wrong with the mount or the clock of the LiDAR."""

    @property
    def wiring(self) -> WiringReport | None:
        """Signs, sides, units and clock of wheels and gyro, where they contradict the robot file."""
        return None if self._wiring is None else self._wiring.found

    @property
    def is_done(self) -> bool:
        """Whether there is something to correct, or nothing more to find."""
        is_found = self.wiring is not None or (self.lidar is not None and self.lidar.is_corrected)
        return is_found or ((self._wiring is None or self._wiring.is_done) and self._lidar is None)

    @property
    def messages(self) -> Sequence[Received]:
        """Since the start of the drive."""
        return self._messages.in_order()

    @property
    def texts(self) -> tuple[str, ...]:
        """Sentences on what was found; of the LiDAR where nothing else was, as it is checked again after that."""
        of_lidar = () if self.lidar is None else (self.lidar.text,)
        texts = of_lidar if self.wiring is None else self.wiring.findings
        return tuple(text.replace(CORRECTED, _NOW) for text in texts)

    @property
    def largest_error_m(self) -> float:
        """Largest error of the position [m]: twice the way while the LiDAR travels in another direction, or what it lags; else 0."""
        return 0.0 if self._lidar is None else 2.0 * self._lidar.contradicted_way_m

    def keep(self, received: Received) -> None:
        """Keep a message, before its readings are added."""
        self._messages.add(received)
        has_moved = (self._wiring is not None and self._wiring.has_moved) or (self._lidar is not None and self._lidar.has_moved)
        if not has_moved:
            self._messages.forget(received.received_ns - _STANDING_NS)

    def add(self, reading: Any) -> None:
        """Take a ``reading`` of any sensor, as its driver published it."""
        if self._wiring is not None:
            self._wiring.add(reading)

    def add_event(self, event: Event) -> None:
        """Take an ``event`` that the readings made."""
        if self._lidar is None:
            return
        self._lidar.add(event)
        if self._lidar.is_done:
            self.lidar, self._lidar = self._lidar.result(), None


class EntranceChecks:
    """`begin` what is to be checked from here on; `running` is None once nothing is."""

    def __init__(self, inputs: LiveInputs) -> None:
        self._inputs = inputs
        self.running: LiveEntrance | None = None
        self.notes: list[str] = []
        """Sentences on what was found."""

    def begin(
        self,
        mounts: Mapping[str, Mount],
        *,
        wiring: bool = True,
        lidar: bool = True,
        is_gyro_clock_known: bool = False,
        is_lidar_clock_known: bool = False,
    ) -> None:
        """Compare the sensors from here on, with the LiDAR at ``mounts``: the ``wiring`` of wheels and gyro, the mount of the ``lidar``,
        and the clocks that are not known."""
        wheels = self._inputs.wiring_check(mounts, is_clock_known=is_gyro_clock_known) if wiring else None
        scans = self._inputs.lidar_check(mounts, is_clock_known=is_lidar_clock_known) if lidar else None
        source = self._inputs.sources.lidar
        has_checks = wheels is not None or scans is not None
        self.running = LiveEntrance(wheels, scans, "" if source is None else source.topic) if has_checks else None
        self._inputs.stream.on_reading = None if self.running is None else self.running.add

    def end(self, report: Callable[[str], None]) -> None:
        """The running checks have ended: what they have found is noted and reported."""
        if self.running is None:
            return
        for text in self.running.texts:
            self.notes.append(text)
            report(text)
        self.running = self._inputs.stream.on_reading = None


class KeptMessages:
    """Messages in order of coming; those of the LiDAR, which are large, up to `_MAX_BYTES`."""

    def __init__(self, lidar: str) -> None:
        """``lidar``: its topic."""
        self._lidar_topic = lidar
        self._lidar: deque[Received] = deque()
        self._others: deque[Received] = deque()
        self._bytes = 0

    def add(self, received: Received) -> None:
        """Keep ``received``."""
        if received.topic != self._lidar_topic:
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
