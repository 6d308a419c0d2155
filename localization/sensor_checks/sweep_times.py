"""Times of a scan's points, by the distortion of scans as the robot turns: a `time_increment` of the wrong sign, or of beams at once.

Over a drive the factor lambda on the times (`sweep_distortion.py`) is near 1, near -1 where the sweep goes the other way, and near 0 where
all beams are measured at once. Twist and distortion are by the LiDAR alone: signs of wheels and gyro do not matter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from localization.events import Scan
from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.scan_motion import Profile
from localization.sensor_checks.sweep_distortion import TimedProfile, WeightedMean, fit_factor, times_derivative
from localization.sensor_checks.window import Window

REVERSED_TIMES = SensorFault(
    "as the robot turns, scans are distorted as if their points were measured in the opposite order ({sigmas:.1f} sigma): the sweep goes"
    " the other way than time_increment has it. From now on its sign is reversed; correct it in the LiDAR's driver.",
    reference="wheels and gyro",
    draws_map=True,
)

NO_SWEEP = SensorFault(
    "as the robot turns, scans are not distorted as if their points were measured one after the other ({factor:+.2f} +- {sigma:.2f} times"
    " what time_increment has): the beams are measured at once. From now on these times are left out; let the driver publish a"
    " time_increment of 0.",
    reference="wheels and gyro",
)

_MIN_RATE_RAD_S = 0.05
"""Slower turns distort a sweep of 0.1 s by less than 2 cm at 4 m."""
_MIN_PAIRS, _SIGMAS = 8, 4.5
"""Fewest pairs of scans, and distance of lambda from 0 in sigmas, from where on its sign is decided: 7e-6 by chance, as for pairs of
sensors."""
_NO_SWEEP, _NO_SWEEP_PAIRS, _NO_SWEEP_SIGMA = 0.25, 20, 0.08
"""Largest lambda, fewest pairs of scans, and largest sigma of lambda, where beams are measured at once: lambda is then 0.00 +- 0.005 after
90 pairs, and 1.1 to 1.5 +- 0.25 after 19 where times are right (two rooms each)."""


class SweepTimes:
    """Decides once in a drive whether the times of points are reversed, or of no sweep."""

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
        self.is_wrong = False
        """One of both."""

    def correct(self, scan: Scan) -> Scan:
        """``scan`` with reversed times, or all at the sweep's middle, as they were found to be."""
        return replace(scan, offsets=-scan.offsets if self.is_reversed else np.full(len(scan.offsets), scan.middle_s))

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
        now = self._before = TimedProfile(
            last[1], times_derivative(last[1], window.points_about_lidar(last[0]), last[0].times_from_middle, twist)
        )
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
        sigmas, is_small = self._factor.mean / self._factor.sigma, abs(self._factor.mean) < _NO_SWEEP
        self.is_at_once = is_small and self._factor.count >= _NO_SWEEP_PAIRS and self._factor.sigma < _NO_SWEEP_SIGMA
        self._is_decided = self.is_at_once or (abs(sigmas) > _SIGMAS and not is_small)
        self.are_likely_right = self._is_decided or sigmas > 0.0  # as they are corrected from then on
        self.is_wrong = self.is_at_once or (self._is_decided and sigmas < 0.0)
        if self.is_at_once:
            self._faults.declare(NO_SWEEP, self._faults.now_s, {"factor": self._factor.mean, "sigma": self._factor.sigma})
        elif self._is_decided and sigmas < 0.0:
            self.is_reversed = True
            self._faults.declare(REVERSED_TIMES, self._faults.now_s, {"sigmas": -sigmas})
