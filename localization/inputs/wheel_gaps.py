"""What wheels do not show: how the velocity changes between two samples, and the motion while no samples come."""

from __future__ import annotations

import math

import numpy as np

from localization.inputs.wheel_buffer import WheelWindow
from localization.messages import Message, message
from localization.small_filters import FORGETTING
from motion_models.compiled import kernel
from motion_models.se2 import Cov3, FloatArray, Twist2

_SAME_S = 1e-6
"""Difference of stamps that is rounding [s]."""
_CHANGES_WITHIN_S = 1.0
"""Time in which a velocity changes by the unknown twist's sigma, until the log has shown it [s]: prior with the weight of one interval."""
_MAX_VARIANCE = np.array([math.inf, math.inf, math.pi**2 / 3.0])
"""Upper bounds of the variances of x, y and yaw; yaw: that of a uniform distribution from -pi to pi [rad^2]."""
_LONG_S = 60.0
"""Time without wheel data, from which on a recorder that was paused explains it [s]."""


class VelocityWithinIntervals:
    """Error of taking the wheels' mean rates between two samples as constant: `add` each step's pieces.

    The velocity is a random walk of density q (white acceleration; Bar-Shalom, Li & Kirubarajan 2001, sec. 6.2.2). Where the ends of an
    interval of length T are measured, the way from its start is off by e(t) with

        var e(t) = q t^2 (T - t)^2 / (3 T)      (T / 2: q T^3 / 48),      e(t) = u t (T - t) to first order, u ~ N(0, q / (3 T)),

    which is zero at both ends. Mean rates of successive intervals differ by var q (T_1 + T_2) / 3: the log itself measures q. It is at most
    that of a velocity that varies by the unknown twist's sigma s within the interval, q T / 6 < s^2. An error of the yaw moves a robot that
    drives at speed v sideways by v int e(t) dt, and by v int e(t)^2 / 2 dt less ahead: v u^2 T^5 / 60 over the interval, whose mean square,
    with E u^4 = 3 (E u^2)^2, is at most the way itself squared. Rates without angles are off by a velocity of variance q T / 12 besides.
    """

    def __init__(self, unknown_sigma: Twist2) -> None:
        """``unknown_sigma`` (3,) of a twist that no wheel shows."""
        self._unknown = np.asarray(unknown_sigma)[[0, 2]]
        self._learned = np.array([*(self._unknown**2 / _CHANGES_WITHIN_S), 1.0, 0.0, 0.0, 0.0])
        """Sums of squared differences (2) and their weight; length of the last interval, its speed and its turn rate."""

    def add(self, window: WheelWindow, twists: FloatArray) -> Cov3:
        """Learn from the pieces of a step and their twists (n, 3): covariance (3, 3) of the motion of the step, in the body frame at its
        end, as the turn of a step turns its own errors little."""
        cov = np.zeros((3, 3))
        _learn(window.inside, window.dt, twists, self._learned)
        _add_cov(window.inside, window.dt, twists, self._learned, self._unknown, cov)
        return cov


@kernel
def _learn(inside: FloatArray, dt: FloatArray, twists: FloatArray, learned: FloatArray) -> None:
    """Add the differences between successive intervals, each where it ends."""
    for i in range(len(dt)):
        length, last = inside[i, 0], learned[3]
        if inside[i, 1] + dt[i] < length - _SAME_S or math.isinf(length):
            continue
        if last > 0.0:
            learned[0] = FORGETTING * learned[0] + 3.0 * (twists[i, 0] - learned[4]) ** 2 / (length + last)
            learned[1] = FORGETTING * learned[1] + 3.0 * (twists[i, 2] - learned[5]) ** 2 / (length + last)
            learned[2] = FORGETTING * learned[2] + 1.0
        learned[3], learned[4], learned[5] = length, twists[i, 0], twists[i, 2]


@kernel
def _add_cov(inside: FloatArray, dt: FloatArray, twists: FloatArray, learned: FloatArray, unknown: FloatArray, cov: FloatArray) -> None:
    """Add the covariance (3, 3) of each piece."""
    for i in range(len(dt)):
        start, end, speed, rate, has_angles = inside[i, 1], inside[i, 1] + dt[i], twists[i, 0], twists[i, 2], inside[i, 2] > 0.0
        if speed == 0.0 and rate == 0.0:
            continue  # at rest
        T = inside[i, 0] if has_angles else min(inside[i, 0], end)
        q_way = min(learned[0] / learned[2], 6.0 * max(unknown[0], abs(speed)) ** 2 / T)
        q_turn = min(learned[1] / learned[2], 6.0 * max(unknown[1], abs(rate)) ** 2 / T)
        grown = end * (T - end) - start * (T - start)  # of t (T - t)
        area = T * (end**2 - start**2) / 2.0 - (end**3 - start**3) / 3.0 - start * (T - start) * dt[i]
        by_way, by_turn, side = q_way / (3.0 * T), q_turn / (3.0 * T), speed * area
        shorter = speed * by_turn * T**4 * dt[i] / 60.0
        cov[0, 0] += by_way * grown**2 + min(3.0 * shorter**2, (speed * dt[i]) ** 2)
        cov[1, 1] += by_turn * side**2
        cov[2, 2] += by_turn * grown**2
        cov[1, 2] += by_turn * side * grown
        cov[2, 1] += by_turn * side * grown
        if not has_angles:
            cov[0, 0] += q_way * T / 12.0 * dt[i] ** 2
            cov[2, 2] += q_turn * T / 12.0 * dt[i] ** 2


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
        self.known_m2 = self._unknown_m2 = 0.0
        """Variance of the ways that wheels have measured, all together, and of those without them [m^2]."""
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
        self._unknown_m2 += after[0] - before[0] + after[1] - before[1]
        return np.diag(after - before)

    def warnings(self) -> list[Message]:
        """How long there were no wheel data in all, where more of the way is unknown by that than by the wheels themselves."""
        if self._unknown_m2 <= self.known_m2:
            return []
        if self._total_s < _LONG_S:
            return [message("wheel_gaps.no_data", total_s=self._total_s)]
        return [message("wheel_gaps.long", total_s=self._total_s)]
