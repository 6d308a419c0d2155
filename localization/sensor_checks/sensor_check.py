"""Base class of the sensor checks."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from localization.events import ImuSample, Step, turn_twist
from localization.sensor_checks.window import Window
from motion_models.se2 import Cov3, FloatArray


class SensorCheck:
    """A check overrides what it needs; `SensorChecks` calls these in the order in which they stand here."""

    is_of_declared_faults: ClassVar[bool] = False
    """`apply` changes nothing before a fault has been declared."""

    def insert_imu(self, sample: ImuSample) -> None:
        """Take ``sample``."""

    def prepare(self, step: Step) -> Step:
        """``step`` as the sensors are to be compared."""
        return step

    def compare(self, window: Window) -> bool:
        """Compare the sensors over the last seconds; whether they agree."""
        return True

    def apply(self, step: Step) -> Step:
        """``step`` as it is to be fused: without what is faulty."""
        return step

    def compare_estimate(self, step: Step, delta: FloatArray, nis: float | None) -> None:
        """Compare ``step`` with its motion ``delta`` (3,) by the estimate, whose normalised innovation squared is ``nis``."""


def without_scan(step: Step) -> Step:
    """``step`` whose scan is not used."""
    return step if step.scan is None else replace(step, scan=None, is_scan_excluded=True)


def without_wheels(step: Step, unknown: Cov3) -> Step:
    """``step`` whose wheels are not used: the covariance of its motion has ``unknown`` (3, 3) besides, its twist is by the gyro alone."""
    motion = replace(step.predicted, cov=step.predicted.cov + unknown)
    return replace(step, predicted=motion, twist=turn_twist(step.turn), is_standing=False, has_wheels=False)
