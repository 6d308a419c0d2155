"""Times of a scan's points, by the distortion of scans as the robot turns: a `time_increment` of the wrong sign.

A point of a sweep is measured t after its middle, while the body moves: deskewing moves it by t (v + omega x p). Two scans fit onto each
other if the times are right. From a scan to the next the factor lambda on both scans' times is estimated beside the motion, by
point-to-line Gauss-Newton as in `scan_motion.py`; over a drive lambda is near 1, and near -1 where the sweep goes the other way. Twist and
distortion are by the LiDAR alone: signs of wheels and gyro do not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from localization.events import Scan
from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.scan_motion import BEARINGS, Profile, bearing_bins
from localization.sensor_checks.window import Window
from motion_models import se2
from motion_models.se2 import FloatArray, Pose2, Twist2

REVERSED_TIMES = SensorFault(
    "as the robot turns, scans are distorted as if their points were measured in the opposite order ({sigmas:.1f} sigma): the sweep goes"
    " the other way than time_increment has it. From now on its sign is reversed; correct it in the LiDAR's driver.",
    reference="wheels and gyro",
    draws_map=True,
)

_MIN_RATE_RAD_S = 0.05
"""Slower turns distort a sweep of 0.1 s by less than 2 cm at 4 m."""
_ITERATIONS, _SCALE_M, _MAX_DISTANCE_M, _MIN_BEARINGS = 3, 0.05, 1.0, 30
"""Gauss-Newton steps; scale of the robust loss (Cauchy) [m]; largest distance of associated points along each axis [m]; fewest of these."""
_NOISE_M = 0.01
"""Least noise of a range [m]."""
_MIN_PAIRS, _SIGMAS = 8, 4.5
"""Fewest pairs of scans, and distance of lambda from 0 in sigmas, from where on its sign is decided: 7e-6 by chance, as for pairs of
sensors."""


class _TimedProfile(NamedTuple):
    """A scan by bearing, and how its times move its points."""

    profile: Profile
    skew: FloatArray
    """(180, 2) derivative of the deskewed points by the factor on their times [m]."""


class SweepTimes:
    """Decides once in a drive whether the times of points are reversed."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._last: tuple[Scan, Profile] | None = None  # scan at the end of the last bin
        self._before: _TimedProfile | None = None  # that at the end of the bin before
        self._factor = _WeightedMean()
        self._is_decided = False
        self.are_likely_right = True
        """The times are likelier right than reversed."""
        self.is_reversed = False
        """The sweep goes the other way than the scans' times have it."""

    def compare(self, window: Window) -> None:
        """Take the scan that ended a bin."""
        scan, before, last = window.registered, self._before, self._last
        if self._is_decided or scan is None or not scan.is_planar or not len(scan.offsets):
            return
        profile = window.profile(scan)
        self._last = None if profile is None or (last is not None and scan is last[0]) else (scan, profile)
        rates = window.bins.lidar[-2:] / window.bins.durations_s[-2:, None]
        self._before = None
        if last is None or self._last is None or not np.isfinite(rates).all():
            return
        twist = rates.mean(axis=0)
        now = self._before = _TimedProfile(last[1], _skew(last[1], window.points_about_lidar(last[0]), last[0].times_from_middle, twist))
        if before is None or float(np.abs(rates[:, 2]).max()) < _MIN_RATE_RAD_S:
            return
        found = _fit_factor(before, now, window.bins.lidar[-2])
        if found is not None:
            self._factor.add(*found)
        self._decide()

    def _decide(self) -> None:
        """Whether the times are likelier right than reversed; declare that they are reversed once it is certain."""
        if self._factor.count < _MIN_PAIRS:
            return
        sigmas = self._factor.mean / self._factor.sigma
        self._is_decided = abs(sigmas) > _SIGMAS
        self.are_likely_right = self._is_decided or sigmas > 0.0  # as they are corrected from then on
        if self._is_decided and sigmas < 0.0:
            self.is_reversed = True
            self._faults.declare(REVERSED_TIMES, self._faults.now_s, {"sigmas": -sigmas})


@dataclass
class _WeightedMean:
    """Mean of values by their information, whose sigma is at least that of their scatter."""

    count: int = 0
    _information: float = 0.0
    _sum: float = 0.0
    _squares: float = 0.0

    def add(self, value: float, information: float) -> None:
        self.count, self._information = self.count + 1, self._information + information
        self._sum, self._squares = self._sum + information * value, self._squares + information * value**2

    @property
    def mean(self) -> float:
        return self._sum / self._information

    @property
    def sigma(self) -> float:
        scatter = (self._squares - self._information * self.mean**2) / max(self.count - 1, 1)
        return math.sqrt(max(scatter, 1.0) / self._information)


def _skew(profile: Profile, points: FloatArray, times: FloatArray, twist: Twist2) -> FloatArray:
    """(180, 2) t (v + omega x p) of each bearing of ``profile`` [m], by ``points`` (N, 2) about the sensor and their ``times`` (N,) after
    the sweep's middle [s]; ``twist`` (3,) of the body."""
    by_bearing = np.full(BEARINGS, np.nan)
    by_bearing[bearing_bins(points)] = times
    x, y = (profile.points + profile.center).T
    return np.asarray(by_bearing[:, None] * np.column_stack([twist[0] - twist[2] * y, twist[1] + twist[2] * x]))


def _fit_factor(a: _TimedProfile, b: _TimedProfile, body_a_T_b: Pose2) -> tuple[float, float] | None:
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


def _linearize(a: _TimedProfile, b: _TimedProfile, a_T_b: Pose2, factor: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances r (180,) [m] of the points of ``b`` from the lines of ``a``, their derivative (180, 4) by ``a_T_b`` (3,) and the factor,
    and weights (180,); 0 where a point has no line."""
    R = se2.rotation(a_T_b[2])
    turned = (b.profile.points + factor * b.skew) @ R.T
    moved = turned + a_T_b[:2]
    k = bearing_bins(moved)
    n, d = a.profile.normals[k], moved - a.profile.points[k] - factor * a.skew[k]
    lever = n[:, 1] * turned[:, 0] - n[:, 0] * turned[:, 1]
    J = np.column_stack([n, lever, np.sum(n * (b.skew @ R.T - a.skew[k]), axis=1)])
    r = np.sum(n * d, axis=1)
    has_line = np.isfinite(J).all(axis=1) & (np.abs(d) < _MAX_DISTANCE_M).all(axis=1)
    r = np.where(has_line, r, 0.0)
    return r, np.where(has_line[:, None], J, 0.0), has_line / (1.0 + (r / _SCALE_M) ** 2)
