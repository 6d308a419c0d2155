"""One step of an estimator: an interval of time, and what each sensor measured of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from localization.events import Scan
from localization.gyro import Turn
from motion_models.base import Motion
from motion_models.se2 import FloatArray

_NS = 1e-9


class StepInterval(NamedTuple):
    """Time of one step, and the scan at its end."""

    start_ns: int
    end_ns: int
    scan: Scan | None


@dataclass(frozen=True)
class Step:
    """The time from ``start_ns`` to ``end_ns``, and what each sensor measured of it."""

    start_ns: int
    end_ns: int
    predicted: Motion
    """By the wheels and the motion model, at its nominal parameters."""
    d_clock: FloatArray
    """(3,) change of the predicted motion (right perturbation) per second by which the wheels' clock is shifted [m/s, m/s, rad/s]."""
    twist: FloatArray
    """(3,) body twist at the end, by the wheels; of a step of no duration, by the nearest wheel sample. Without wheel data zero, but for
    the mean turn rate by the gyro."""
    is_standing: bool
    """No wheel moved during the step."""
    has_wheels: bool
    """Wheel data cover all of the step; of no duration, they are near it."""
    turn: Turn | None = None
    scan: Scan | None = None

    @property
    def duration(self) -> float:
        """[s]"""
        return (self.end_ns - self.start_ns) * _NS
