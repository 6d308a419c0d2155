"""Published steps that are still to be examined, and whether the last of them has to be at once."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from localization.estimators import Estimate, Residuals
from localization.events import Step
from localization.sensor_checks.moving_objects import MAX_NIS, MIN_OFF_M
from motion_models import se2
from motion_models.se2 import Pose2


class Record(NamedTuple):
    """A step, and what the estimator has made of it."""

    step: Step
    estimate: Estimate
    pose: Pose2
    """(3,) of the estimate, by sensors alone: without what loops have moved it by."""
    residuals: Residuals | None
    is_compared: bool
    """Its sensors were compared before the estimator had it."""


class Records:
    """`add` each step, and `take` all that wait when they are examined."""

    def __init__(self) -> None:
        self.waiting: list[Record] = []
        """Steps that were not examined yet."""
        self._by_wheels = np.zeros(3)  # pose
        self._examined = np.zeros((2, 3)), np.zeros((2, 3))  # poses by wheels and estimate at the last examination but one, and at the last

    def add(self, record: Record) -> bool:
        """Let ``record`` wait; whether it has to be examined at once: its scan contradicts all else, or the estimate has left the motion by
        the wheels since the last examination but one."""
        self.waiting.append(record)
        self._by_wheels = se2.compose(self._by_wheels, record.step.predicted.delta)
        x, y, _ = np.subtract(*se2.between(self._examined[0], (self._by_wheels, record.pose)))
        nis = record.estimate.nis
        return math.hypot(x, y) > MIN_OFF_M or not (nis is None or nis < MAX_NIS)

    def take(self) -> list[Record]:
        """All that wait, one at least, to be examined now."""
        records, self.waiting = self.waiting, []
        self._examined = self._examined[1], np.array([self._by_wheels, records[-1].pose])
        return records
