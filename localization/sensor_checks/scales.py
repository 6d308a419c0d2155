"""Ways by the LiDAR and by the wheels of another scale, where no third sensor shows which is off.

The filter learns the wheels' radius from scans. Ranges that are all too long by a factor look the same: no turn shows it, and the submap
has the factor as well. Then the whole path is too long by it, from the start on.

The difference m of both scales is that of the wheels' error less that of the ranges', of which the wheels' has the standard deviation s_w a
priori and the ranges' s_r. By Bayes the square of the ranges' error is w m^2 in the mean, w = s_r^2 / (s_r^2 + s_w^2), where m itself shows
how large such errors are: its mean is w m, its variance w (1 - w) m^2. The covariance has w times what m^2 is beyond the
variance of m. From `_MIN_PRIOR_SIGMAS` on, m is too large for an error of the wheels alone, and the covariance has all of it.
"""

from __future__ import annotations

import math
from dataclasses import replace

from localization.estimators import LearnedParameter
from localization.messages import Value
from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault
from localization.sensor_checks.innovations import SLIP_S
from localization.sensor_checks.pairs import LIDAR_WHEELS_WAYS, NAMED, WAY_SLIP

SCALES_APART = SensorFault(
    "lidar_scale.apart",
)
RADIUS = "wheel_radius_scale"
_MIN_PRIOR_SIGMAS, _MIN_SIGMAS, _MIN_REPORTED_SIGMAS = 2.0, 2.0, 4.0
"""Radius by scans alone, in sigmas of its prior (3 %) and of its own, from which on the covariance has the difference, and is reported.
MIT-CSAIL's is 1.3 to 3.1 %, the others' 1.6 % and less: ranges that are off by less are not distinguished from such wheels."""
_RANGES_SIGMA = 0.015
"""Standard deviation of the scale of ranges: accuracy of LiDARs that triangulate (RPLIDAR A1: 1 % up to 3 m, 2 % up to 5 m)."""
_MAX_SCALE = 0.3
"""Beyond it the wheels have another unit, or spin: ranges that are 3 % off are those of the cheapest LiDARs (URG-04LX)."""


class ScaleCheck:
    """`compare` the radius as it is learned. The error of ranges lasts all along: it is at most the least that was possible so far, so that
    wheels that begin to spin, or lose counts, on the way leave the scale of the ranges as it was."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults, self._most, self._reported = faults, math.inf, 0.0

    def compare(self, radius: LearnedParameter, driven_s: float) -> None:
        """Take the wheels' ``radius`` as it is learned in ``driven_s`` of driving [s]. Slip that lasts for seconds, which the filter takes
        for white noise, moves it as well: what that explains is not reported."""
        if self._faults.declared and any(fault in self._faults.declared for fault in NAMED[LIDAR_WHEELS_WAYS]):
            self._faults.path = replace(self._faults.path, scale=0.0)
            self._faults.retract(SCALES_APART)
            return
        share = 1.0 - (radius.sigma / radius.prior_sigma) ** 2  # of its information, by scans
        if share <= 0.0:
            return
        off, sigma = (radius.value - radius.file_value) / share, radius.sigma / math.sqrt(share)
        self._most = min(self._most, abs(off) + 2.0 * sigma)
        scale = min(abs(off), self._most)
        is_off = max(_MIN_PRIOR_SIGMAS * radius.prior_sigma, _MIN_SIGMAS * sigma) < scale < _MAX_SCALE
        error = scale if is_off else _error_of_ranges(share * scale, radius)
        self._faults.path = replace(self._faults.path, scale=error)
        slip = WAY_SLIP * math.sqrt(0.5 * min(1.0, 2.0 * SLIP_S / max(driven_s, SLIP_S)))
        if is_off and scale > _MIN_REPORTED_SIGMAS * math.hypot(sigma, slip) and round(scale, 2) != self._reported:
            self._reported = round(scale, 2)
            words = ("longer", "long", "larger") if off > 0.0 else ("shorter", "short", "smaller")
            numbers: dict[str, Value] = dict(zip(("longer", "long", "larger"), words, strict=True))
            found = SCALES_APART.describe({"percent": 100.0 * scale, **numbers})
            self._faults.revise(DetectedFault(SCALES_APART, 0.0, found))


def _error_of_ranges(off: float, radius: LearnedParameter) -> float:
    """Standard deviation of the ranges' scale where a ``radius`` is learned as ``off`` by a share, by what is beyond its own error."""
    w = 1.0 / (1.0 + (radius.prior_sigma / _RANGES_SIGMA) ** 2)
    return math.sqrt(w * max(off**2 - radius.sigma**2, 0.0)) if off < _MAX_SCALE else 0.0
