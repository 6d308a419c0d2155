"""Signs, sides and units of live wheels and gyro: named once the drive shows them, with the keys of the robot file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from localization.calibration.wheel_signals import signals_of_readings
from localization.calibration.wheel_units import CORRECTED
from localization.calibration.wheel_wiring import LiveSensors, check_live
from localization.events import ImuSample
from localization.logs.decode import ArmReading, JointReading
from motion_models.robot import Mount

_PERIOD_NS, _LAST_NS = 10_000_000_000, 120_000_000_000
"""Time between two checks, and from the first motion to the last one: turns both ways come within a minute of driving."""
_MOVED = 0.02
_NOW = "Not corrected live; write to the robot file and start again:"


class LiveWiring:
    """`add` the readings of a drive, as the drivers publish them; a sentence comes once wheels and gyro contradict the robot file."""

    def __init__(self, sensors: LiveSensors, mounts: Mapping[str, Mount], joints: tuple[tuple[str, ...], tuple[str, ...]]) -> None:
        """``mounts``: by frame; those that are added later are used as well. ``joints``: of the left and right wheels that come."""
        self._sensors, self._mounts, self._joints = sensors, mounts, joints
        self._wheels: list[JointReading] = []
        self._gyro: list[ImuSample] = []
        self._next_ns: int | None = None
        self._last_ns = 0
        self.is_done = False
        """Something was found, or two minutes of driving have passed."""

    def add(self, reading: Any) -> tuple[str, ...]:
        """Take a ``reading`` of any sensor; sentences on what contradicts the robot file, the first time that it is seen."""
        wheels = reading.wheels if isinstance(reading, ArmReading) else reading
        if isinstance(reading, ImuSample):
            self._gyro.append(reading)
        elif isinstance(wheels, JointReading):
            self._add_wheels(wheels)
            if self._next_ns is not None and wheels.stamp_ns >= self._next_ns:
                return self._check(wheels.stamp_ns)
        return ()

    def _add_wheels(self, sample: JointReading) -> None:
        first = self._wheels[0] if self._wheels else sample
        has_moved = bool((abs(sample.velocity) > _MOVED).any() or (abs(sample.position - first.position) > _MOVED).any())
        if self._next_ns is None and has_moved:
            self._next_ns, self._last_ns = sample.stamp_ns + _PERIOD_NS, sample.stamp_ns + _LAST_NS
        elif self._next_ns is None:  # while it stands
            self._wheels.clear()
            self._gyro = self._gyro[-1:]
        self._wheels.append(sample)

    def _check(self, now_ns: int) -> tuple[str, ...]:
        self._next_ns = now_ns + _PERIOD_NS
        signals = signals_of_readings(self._wheels, self._gyro, self._mounts, self._joints)
        found = () if signals is None else check_live(self._sensors, signals).findings
        self.is_done = bool(found) or now_ns > self._last_ns
        return tuple(text.replace(CORRECTED, _NOW) for text in found)
