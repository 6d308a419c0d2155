"""Factor on the times of a scan's points, by the distortion of scans as the robot turns.

A point of a sweep is measured t after its middle, while the body moves: deskewing moves it by t (v + omega x p). Two scans fit onto each
other if the times are right: the factor lambda on both scans' times is estimated beside the motion, by point-to-line Gauss-Newton as in
`scan_motion.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from localization.sensor_checks import scan_motion
from localization.sensor_checks.scan_motion import BEARINGS, Profile
from motion_models import se2
from motion_models.se2 import FloatArray, Pose2, Twist2

_ITERATIONS, _SCALE_M, _MAX_DISTANCE_M, _MIN_BEARINGS = 3, 0.05, 1.0, 30
"""Gauss-Newton steps; scale of the robust loss (Cauchy) [m]; largest distance of associated points along each axis [m]; fewest of these."""
_SAME_TIME = 0.05
"""Largest part of the sweep in which the points of one bearing (2 degrees) are measured."""
_NOISE_M = 0.01
"""Least noise of a range [m]."""


class TimedProfile(NamedTuple):
    """A scan by bearing, and how its times move its points."""

    profile: Profile
    skew: FloatArray
    """(180, 2) derivative of the deskewed points by the factor on their times [m]."""


@dataclass
class WeightedMean:
    """Mean of values by their information, whose sigma is at least that of their scatter."""

    count: int = 0
    _information: float = 0.0
    _sum: float = 0.0
    _squares: float = 0.0

    def add(self, value: float, information: float) -> None:
        """Take a ``value`` of an ``information``."""
        self.count, self._information = self.count + 1, self._information + information
        self._sum, self._squares = self._sum + information * value, self._squares + information * value**2

    @property
    def mean(self) -> float:
        """Weighted mean."""
        return self._sum / self._information

    @property
    def sigma(self) -> float:
        """Sigma of the mean."""
        scatter = (self._squares - self._information * self.mean**2) / max(self.count - 1, 1)
        return math.sqrt(max(scatter, 1.0) / self._information)


def times_by_bearing(points: FloatArray, times: FloatArray) -> FloatArray:
    """(180,) time after the sweep's middle of the points of each bearing [s], by ``points`` (N, 2) about the sensor and their ``times``
    (N,); NaN without any, and where they have several, as of a scanner that does not turn."""
    bins, first, last = scan_motion.bearing_bins(points), np.full(BEARINGS, np.inf), np.full(BEARINGS, -np.inf)
    np.minimum.at(first, bins, times)
    np.maximum.at(last, bins, times)
    is_one = last - first <= _SAME_TIME * np.ptp(times)
    return np.where(is_one & np.isfinite(first), last, np.nan)


def times_derivative(profile: Profile, times: FloatArray, twist: Twist2) -> FloatArray:
    """(180, 2) t (v + omega x p) of each bearing of ``profile`` [m], by its ``times`` (180,); ``twist`` (3,) of the body."""
    x, y = (profile.points + profile.center).T
    return np.asarray(times[:, None] * np.column_stack([twist[0] - twist[2] * y, twist[1] + twist[2] * x]))


def fit_factor(a: TimedProfile, b: TimedProfile, body_a_T_b: Pose2) -> tuple[float, float] | None:
    """Factor lambda on the times of scans ``a`` and ``b``, and its information, beside the motion, near ``body_a_T_b`` (3,); None where too
    few points are associated."""
    body_T_a, body_T_b = (np.array([*each.profile.center, 0.0]) for each in (a, b))
    a_T_b, factor = se2.between(body_T_a, se2.compose(body_a_T_b, body_T_b)), 0.0
    for _ in range(_ITERATIONS):
        r, J, w = _linearize(a, b, a_T_b, factor)
        if np.count_nonzero(w) < _MIN_BEARINGS:
            return None
        A = J.T @ (w[:, None] * J) + 1e-6 * np.eye(4)
        x = np.linalg.solve(A, -J.T @ (w * r))
        a_T_b, factor = a_T_b + x[:3], factor + float(x[3])
    variance = max(float(w @ r**2) / float(w.sum()), _NOISE_M**2)
    return factor, 1.0 / (variance * float(np.linalg.inv(A)[3, 3]))


def _linearize(a: TimedProfile, b: TimedProfile, a_T_b: Pose2, factor: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances r (180,) [m] of the points of ``b`` from the lines of ``a``, their derivative (180, 4) by ``a_T_b`` (3,) and the factor,
    and weights (180,); 0 where a point has no line."""
    R = se2.rotation(a_T_b[2])
    turned = (b.profile.points + factor * b.skew) @ R.T
    moved = turned + a_T_b[:2]
    k = scan_motion.bearing_bins(moved)
    n, d = a.profile.normals[k], moved - a.profile.points[k] - factor * a.skew[k]
    lever = n[:, 1] * turned[:, 0] - n[:, 0] * turned[:, 1]
    J = np.column_stack([n, lever, np.sum(n * (b.skew @ R.T - a.skew[k]), axis=1)])
    r = np.sum(n * d, axis=1)
    has_line = np.isfinite(J).all(axis=1) & (np.abs(d) < _MAX_DISTANCE_M).all(axis=1)
    r = np.where(has_line, r, 0.0)
    return r, np.where(has_line[:, None], J, 0.0), has_line / (1.0 + (r / _SCALE_M) ** 2)
