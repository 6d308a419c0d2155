"""Times of a scan's points, by its distortion as the robot turns: of the wrong sign or unit, or of beams that are measured at once.

Over a drive the factor lambda on the times (`sweep_distortion.py`) is near 1, near -1 where the sweep goes the other way, near 0 where
all beams are measured at once or were deskewed by the driver, and near 10 where the unit of the times is a tenth of the right one. Twist
and distortion are by the LiDAR alone: signs of wheels and gyro do not matter.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.events import Scan
from localization.messages import Value, phrase
from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.scan_motion import Profile
from localization.sensor_checks.sweep_distortion import TimedProfile, WeightedMean, fit_factor, times_by_bearing, times_derivative
from localization.sensor_checks.window import Window

REVERSED_TIMES = SensorFault(
    "sweep_times.reversed",
    reference="wheels and gyro",
    draws_map=True,
)

NO_SWEEP = SensorFault(
    "sweep_times.no_sweep",
    reference="wheels and gyro",
)

OTHER_UNIT = SensorFault(
    "sweep_times.other_unit",
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
            way = phrase("sweep_times.other_way") if self.is_reversed else ""
            numbers: dict[str, Value] = {"factor": factor, "sigma": sigma, "way": way, "used": math.copysign(self.unit, factor)}
            self._faults.declare(OTHER_UNIT, self._faults.now_s, numbers)
        elif self.is_reversed:
            self._faults.declare(REVERSED_TIMES, self._faults.now_s, {"sigmas": -sigmas})
