"""What a check may do: the base class of all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from localization.events import ImuSample, Step
from localization.sensor_checks.window import Window
from motion_models.base import Motion
from motion_models.se2 import FloatArray

_UNKNOWN_SPEED = np.array([0.5, 0.5, 0.5])
"""Sigma of a twist that no sensor measures [m/s, m/s, rad/s], as `StepConfig.lost_speed_m_s`."""


class Check:
    """A check overrides what it needs; `SensorChecks` calls these in the order in which they stand here."""

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

    def warnings(self) -> list[str]:
        """What is reported besides faults."""
        return []


def with_unknown_motion(step: Step, seconds2: float) -> Step:
    """``step`` with the covariance of a lasting unknown twist, which grows by ``seconds2`` [s^2]."""
    motion = step.predicted
    cov = motion.cov + np.diag(_UNKNOWN_SPEED**2) * seconds2
    return replace(step, predicted=Motion(motion.delta, cov, motion.d_params), is_standing=False, has_wheels=False)
