"""Times of a scan's points, by its distortion as the robot turns: of the wrong sign or unit, or of beams that are measured at once.

A point of a sweep is measured t after its middle, while the body moves: deskewing moves it by t (v + omega x p). Two scans fit onto each
other if the times are right: the factor lambda on both scans' times is estimated beside the motion, by point-to-line Gauss-Newton as in
`scan_motion.py`. Over a drive it is near 1, near -1 where the sweep goes the other way, near 0 where
all beams are measured at once or were deskewed by the driver, and near 10 where the unit of the times is a tenth of the right one. Twist
and distortion are by the LiDAR alone: signs of wheels and gyro do not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.events import Scan
from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.scan_motion import BEARINGS, Profile, bearing_bins
from localization.sensor_checks.window import Window
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
    bins, first, last = bearing_bins(points), np.full(BEARINGS, np.inf), np.full(BEARINGS, -np.inf)
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
    k = bearing_bins(moved)
    n, d = a.profile.normals[k], moved - a.profile.points[k] - factor * a.skew[k]
    lever = n[:, 1] * turned[:, 0] - n[:, 0] * turned[:, 1]
    J = np.column_stack([n, lever, np.sum(n * (b.skew @ R.T - a.skew[k]), axis=1)])
    r = np.sum(n * d, axis=1)
    has_line = np.isfinite(J).all(axis=1) & (np.abs(d) < _MAX_DISTANCE_M).all(axis=1)
    r = np.where(has_line, r, 0.0)
    return r, np.where(has_line[:, None], J, 0.0), has_line / (1.0 + (r / _SCALE_M) ** 2)


REVERSED_TIMES = SensorFault(
    "as the robot turns, scans are distorted as if their points were measured in the opposite order ({sigmas:.1f} sigma): the sweep goes"
    " the other way than time_increment, or the points' times, have it. From now on they are reversed; correct the LiDAR's driver.",
    reference="wheels and gyro",
    draws_map=True,
)

NO_SWEEP = SensorFault(
    "as the robot turns, scans are not distorted as if their points were measured one after the other ({factor:+.2f} +- {sigma:.2f} times"
    " what their times have): the beams are measured at once, or a driver has deskewed them. From now on these times are left out; let the"
    " driver publish a time_increment of 0, or clouds without times.",
    reference="wheels and gyro",
)

OTHER_UNIT = SensorFault(
    "as the robot turns, scans are distorted {factor:+.1f} +- {sigma:.1f} times as much as the times of their points have it: these have"
    " another unit{way}. From now on they are {used:g} times what they were; correct the LiDAR's driver.",
    reference="wheels and gyro",
    draws_map=True,
)

_MIN_RATE_RAD_S = 0.05
"""Slower turns distort a sweep of 0.1 s by less than 2 cm at 4 m."""
_MIN_PAIRS, _SIGMAS = 8, 4.5
"""Fewest pairs of scans, and distance of lambda from 0 in sigmas, from where on its sign is decided: 7e-6 by chance, as for pairs of
sensors."""
_NO_SWEEP, _NO_SWEEP_PAIRS, _NO_SWEEP_SIGMA = 0.25, 20, 0.08
"""Largest lambda, fewest pairs of scans, and largest sigma of lambda, where beams are measured at once: lambda is then 0.00 +- 0.005 after
90 pairs, and 1.1 to 1.5 +- 0.25 after 19 where times are right (two rooms each)."""
_OTHER_UNIT, _LARGEST_RIGHT, _SAME_DECADE = 3.0, 1.5, 0.2
"""Least lambda of another unit, and the largest where times are right; distance of its logarithm (10) from a whole number that is that
power of ten, as of units that drivers mix up."""


class SweepTimes:
    """Decides once in a drive whether the times of points are reversed, of another unit, or of no sweep."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._last: tuple[Scan, Profile] | None = None  # scan at the end of the last bin
        self._before: TimedProfile | None = None  # that at the end of the bin before
        self._factor = WeightedMean()
        self._is_decided = False
        self.are_likely_right = True
        """The times are likelier right than reversed."""
        self.is_reversed = False
        """The sweep goes the other way than the scans' times have it."""
        self.is_at_once = False
        """The scans have times of a sweep, but are measured at one instant."""
        self.unit = 1.0
        """True times over those that the scans have."""
        self.is_wrong = False
        """One of these."""

    def correct(self, scan: Scan) -> Scan:
        """``scan`` with reversed times, of another unit, or all at the sweep's middle, as they were found to be."""
        if self.is_at_once:
            return replace(scan, offsets=np.full(len(scan.offsets), scan.middle_s))
        if not self.is_reversed or not len(scan.offsets):
            return replace(scan, offsets=self.unit * scan.offsets)
        mirrored = -scan.offsets if scan.is_planar else 2.0 * scan.middle_s - scan.offsets
        return replace(scan, offsets=self.unit * mirrored)

    def compare(self, window: Window) -> None:
        """Take the scan that ended a bin."""
        scan, before, last = window.scans.registered, self._before, self._last
        if self._is_decided or scan is None or not len(scan.offsets):
            return
        profile = window.scans.profile(scan)
        self._last = None if profile is None or (last is not None and scan is last[0]) else (scan, profile)
        rates = window.bins.lidar[-2:] / window.bins.durations_s[-2:, None]
        self._before = None
        if last is None or self._last is None or not np.isfinite(rates).all():
            return
        twist = rates.mean(axis=0)
        times = times_by_bearing(window.scans.points_about_lidar(last[0]), last[0].times_from_middle)
        now = self._before = TimedProfile(last[1], times_derivative(last[1], times, twist))
        if before is None or float(np.abs(rates[:, 2]).max()) < _MIN_RATE_RAD_S:
            return
        found = fit_factor(before, now, window.bins.lidar[-2])
        if found is not None:
            self._factor.add(*found)
        self._decide()

    def _decide(self) -> None:
        """Whether the times are likelier right than reversed; declare that they are reversed once it is certain."""
        if self._factor.count < _MIN_PAIRS:
            return
        factor, sigma = self._factor.mean, self._factor.sigma
        sigmas, is_small, is_large = factor / sigma, abs(factor) < _NO_SWEEP, abs(factor) > _OTHER_UNIT
        self.is_at_once = is_small and self._factor.count >= _NO_SWEEP_PAIRS and sigma < _NO_SWEEP_SIGMA
        is_sure = abs(sigmas) > _SIGMAS and (not is_large or abs(factor) - _LARGEST_RIGHT > _SIGMAS * sigma)
        self._is_decided = self.is_at_once or (is_sure and not is_small)
        self.are_likely_right = self._is_decided or sigmas > 0.0  # as they are corrected from then on
        self.is_reversed = self._is_decided and not self.is_at_once and sigmas < 0.0
        self.is_wrong = self.is_at_once or (self._is_decided and (sigmas < 0.0 or is_large))
        if self.is_at_once:
            self._faults.declare(NO_SWEEP, self._faults.now_s, {"factor": factor, "sigma": sigma})
        elif self._is_decided and is_large:
            decades = math.log10(abs(factor))
            self.unit = 10.0 ** round(decades) if abs(decades - round(decades)) < _SAME_DECADE else abs(factor)
            way = ", and the sweep goes the other way" if self.is_reversed else ""
            numbers: dict[str, float | str] = {"factor": factor, "sigma": sigma, "way": way, "used": math.copysign(self.unit, factor)}
            self._faults.declare(OTHER_UNIT, self._faults.now_s, numbers)
        elif self.is_reversed:
            self._faults.declare(REVERSED_TIMES, self._faults.now_s, {"sigmas": -sigmas})
