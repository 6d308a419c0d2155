"""Times without wheel data: the robot moves on with an unknown velocity."""

from __future__ import annotations

import math

import numpy as np

from motion_models.se2 import Cov3, FloatArray, Twist2

_MAX_VARIANCE = np.array([math.inf, math.inf, math.pi**2 / 3.0])
"""Upper bounds of the variances of x, y and yaw; yaw: that of a uniform distribution from -pi to pi [rad^2]."""
_MIN_REPORTED_S = 0.05
"""Shorter times without wheel data are not reported: the first scan is often some milliseconds before the first wheel sample."""
_LONG_S = 60.0
_PAUSED = (
    "Where no other sensor has data either, the recorder was paused, or the computer's clock was set forward: `skidloc info` has the gaps;"
    " if it was the clock, cut the log there."
)


class UnknownVelocity:
    """Motion by an unmeasured constant velocity, whose sigma is that of the settings or the last measured velocity, if that is larger.

    It moves the robot by v t, with the variance sigma^2 t^2: a step from t_0 to t_1 after the last measured pose adds
    sigma^2 (t_1^2 - t_0^2), so that the sum does not depend on how the time is cut into steps.
    """

    def __init__(self, least_sigma: Twist2) -> None:
        """``least_sigma`` (3,) of an unknown twist, at least."""
        self._least_sigma = least_sigma
        self.measured: Twist2 = np.zeros(3)
        """(3,) the last measured twist: the next unknown velocity may be as large."""
        self.lasted_s: FloatArray | float = 0.0
        """For how long the motion along x, along y and the turn (3,), or all alike, have been unknown [s]: 0 where the pose was measured
        now."""
        self._total_s = 0.0

    def increment(self, missing_s: float, has_turn: bool) -> Cov3:
        """Covariance (3, 3) of the motion in the next ``missing_s`` [s]. ``has_turn``: a gyro measures the turn of each step, so that
        the turn before is known."""
        self._total_s += missing_s
        is_unknown, speed = np.array([True, True, not has_turn]), math.hypot(self.measured[0], self.measured[1])
        sigma = np.maximum(self._least_sigma, [speed, speed, abs(self.measured[2])])
        since = self.lasted_s * is_unknown
        until = since + missing_s
        self.lasted_s = until * is_unknown
        after, before = (np.minimum((sigma * t) ** 2, _MAX_VARIANCE) for t in (until, since))
        return np.diag(after - before)

    def warnings(self) -> list[str]:
        """How long there were no wheel data in all."""
        if self._total_s < _MIN_REPORTED_S:
            return []
        text = f"no wheel data for {self._total_s:.1f} s in all: motion there is predicted with a wide covariance."
        return [text if self._total_s < _LONG_S else f"{text} {_PAUSED}"]
