"""What the IMU measures of a step: the yaw by its gyro, and, where they are needed, the vertical and the turns about all axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from localization.events import BodyTurn, Gravity, ImuSample, Scan, Turn
from localization.inputs.attitude import AttitudeFilter
from localization.inputs.body_rates import BodyRates
from localization.inputs.gyro import GyroBuffer
from localization.messages import Message
from motion_models.robot import Mount, Robot


class InertialMotion(NamedTuple):
    """Turn of a step about the body's z axis and about all axes, and gravity at its end; None each where it was not measured."""

    turn: Turn | None = None
    body_turn: BodyTurn | None = None
    gravity: Gravity | None = None


class InertialSensors:
    """`insert` each sample of the IMU, then `measure` each step."""

    def __init__(self, robot: Robot, mounts: Mapping[str, Mount], has_slopes: bool) -> None:
        """``has_slopes``: the vertical is measured, for gravity on slopes."""
        self._noise, self._radius_m, self._mounts = robot.gyro_noise, robot.geometry.wheel_radius_m, mounts
        self.gyro = GyroBuffer(self._noise, mounts)
        self.attitude: AttitudeFilter | None = None
        """The vertical; None where nothing needs it."""
        self._body_rates: BodyRates | None = None
        if has_slopes:
            self._measure_attitude()

    def _measure_attitude(self) -> None:
        self.attitude = AttitudeFilter(self._noise, self._mounts, self._radius_m)

    def measure_in_space(self) -> None:
        """Measure the vertical and turns about all three axes from here on, as poses in space need them."""
        if self._body_rates is None:
            self._body_rates = BodyRates(self._noise, self._mounts)
        if self.attitude is None:
            self._measure_attitude()

    def insert(self, sample: ImuSample) -> None:
        """Take the next sample."""
        self.gyro.insert(sample)
        if self.attitude is not None:
            self.attitude.insert(sample)
        if self._body_rates is not None:
            self._body_rates.insert(sample)

    def measure(self, start_ns: int, end_ns: int, by_wheels: float, scan: Scan | None = None) -> InertialMotion:
        """From ``start_ns`` to ``end_ns``, the middle of ``scan``; the turn ``by_wheels`` [rad] has the sign where a gyro has no mount."""
        has_turn = end_ns > start_ns and self.gyro.newest_ns is not None
        turn = self.gyro.turn(start_ns, end_ns, by_wheels) if has_turn else None
        if self._body_rates is None or self.attitude is None:
            return InertialMotion(turn)
        return InertialMotion(turn, self._body_rates.turn(start_ns, end_ns, scan), self.attitude.gravity)

    def warnings(self) -> list[Message]:
        """Problems of the IMU."""
        return [*self.gyro.warnings(), *([] if self.attitude is None else self.attitude.warnings())]
