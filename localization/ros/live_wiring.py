"""Signs, sides, units and clocks of live wheels and gyro, until the sensors agree. Of a driver's odometry its turns are compared."""

from __future__ import annotations

from collections import deque
from typing import Any

from localization.calibration.wheel_signals import WheelSignals, signals_of_odometry, signals_of_readings
from localization.calibration.wheel_wiring import LiveSensors, WiringReport, check_live
from localization.events import ImuSample, Scan
from localization.logs.decode import ArmReading, JointReading, OdometryReading

_FIRST_NS, _LAST_NS, _LONGER = 6_000_000_000, 120_000_000_000, 1.5
"""From the first motion to the first check and to the last one, and the factor from check to check: turns both ways come within a minute of
driving, and what is read again stays twice the drive."""
_STANDING_NS = 5_000_000_000
"""Kept of a robot that has not moved: the gyro's bias is learned from it."""
_MOVED = 0.02
_AGREE = 0.95
"""Correlation of a turn from where on wheels are as the robot file has them, and no more is read: healthy drives have more."""
_LIDAR_S = 60.0
_MAX_POINTS = 2_000_000
"""Points of the scans that are kept, at most: they bound the memory to 100 MB."""


class LiveWiring:
    """`add` each reading, until `is_done`; then `found` is what contradicts the robot file."""

    def __init__(self, sensors: LiveSensors, joints: tuple[tuple[str, ...], tuple[str, ...]], is_clock_known: bool = False) -> None:
        """``joints``: of the left and right wheels that come. ``is_clock_known``: do not compare the gyro's clock."""
        self._sensors, self._joints, self._is_clock_known = sensors, joints, is_clock_known
        self._wheels: deque[JointReading | OdometryReading] = deque()
        self._gyro: deque[ImuSample] = deque()
        self._points = 0
        self._moving_ns: int | None = None
        self._next_ns = 0
        self.found: WiringReport | None = None
        """With the robot with which to go on."""
        self.is_done = False
        """Something was found, the sensors agree, or two minutes of driving have passed."""

    @property
    def has_moved(self) -> bool:
        """Whether the wheels have turned so far."""
        return self._moving_ns is not None

    def add(self, reading: Any) -> None:
        """Take a ``reading`` of any sensor."""
        if self.is_done:
            return
        wheels = reading.wheels if isinstance(reading, ArmReading) else reading
        if isinstance(reading, ImuSample):
            self._gyro.append(reading)
        elif isinstance(reading, Scan):
            self._add_scan(reading)
        elif isinstance(wheels, JointReading | OdometryReading):
            self._add_wheels(wheels)
            if self._moving_ns is not None and wheels.stamp_ns >= self._next_ns:
                self._check(wheels.stamp_ns, self._moving_ns)

    def _add_scan(self, scan: Scan) -> None:
        is_early = self._moving_ns is not None and scan.stamp_ns < self._moving_ns + _LIDAR_S * 1e9
        if is_early and self._points < _MAX_POINTS:
            self._points += len(scan.points)
            self._sensors.kept.append(scan)

    def _add_wheels(self, sample: JointReading | OdometryReading) -> None:
        first = self._wheels[0] if self._wheels else sample
        if self._moving_ns is None and _has_moved(first, sample):
            self._moving_ns, self._next_ns = sample.stamp_ns, sample.stamp_ns + _FIRST_NS
        self._wheels.append(sample)
        if self._moving_ns is None:  # while it stands
            _forget(self._wheels, sample.stamp_ns - _STANDING_NS)
            _forget(self._gyro, sample.stamp_ns - _STANDING_NS)

    def _signals(self) -> WheelSignals | None:
        gyro, mounts, wheels = list(self._gyro), self._sensors.mounts, self._sensors.sources.wheels
        odometry = [reading for reading in self._wheels if isinstance(reading, OdometryReading)]
        if odometry:
            return None if wheels is None else signals_of_odometry(wheels.topic, odometry, gyro, mounts)
        return signals_of_readings([r for r in self._wheels if isinstance(r, JointReading)], gyro, mounts, self._joints)

    def _check(self, now_ns: int, moving_ns: int) -> None:
        self._next_ns = moving_ns + min(round((now_ns - moving_ns) * _LONGER), _LAST_NS)
        signals = self._signals()
        if signals is None:
            return
        report = check_live(self._sensors, signals, self._is_clock_known)
        turns = [r for name, r in report.correlations.items() if name.startswith("turn")]
        agrees = bool(turns) and min(report.correlations.values()) >= _AGREE
        self.found = report if report.findings else None
        self.is_done = bool(report.findings) or agrees or now_ns >= moving_ns + _LAST_NS


def _has_moved(first: JointReading | OdometryReading, sample: JointReading | OdometryReading) -> bool:
    if isinstance(sample, JointReading) and isinstance(first, JointReading):
        return bool((abs(sample.velocity) > _MOVED).any() or (abs(sample.position - first.position) > _MOVED).any())
    if isinstance(sample, OdometryReading) and isinstance(first, OdometryReading):
        return bool((abs(sample.twist) > _MOVED).any() or (abs(sample.pose - first.pose) > _MOVED).any())
    return False


def _forget(readings: deque[Any], before_ns: int) -> None:
    while readings and readings[0].stamp_ns < before_ns:
        readings.popleft()
