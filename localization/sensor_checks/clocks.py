"""Clocks of two sensors that are apart, where no third one shows which is off.

The filter learns by how much the wheels' stamps are late against the LiDAR's, or the gyro's, whose clock the poses have. If that clock is
the one that is off, what is published for t is the pose at t - late: an error of the body by its twist times that time.
"""

from __future__ import annotations

from localization.estimators import MAX_LATENCY_S, Estimator
from localization.events import Step
from localization.lidar import OUTLIER_SIGMAS
from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault

CLOCKS_APART = SensorFault(
    "the wheels' stamps are {seconds:.2f} s {direction} than those of the {other}: the clock of one of both is off, and no third sensor"
    " shows which. Poses have the {other}'s clock, and their covariance the way in that time. Synchronize the clocks, or write"
    " clock.wheel_time_offset_s = {late:.2f} or clock.{role}_time_offset_s = {early:.2f} to the robot file."
)


class ClockCheck:
    """`add` each step with its estimator: clocks that are apart are declared, and inflate the covariance while the robot moves."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults = faults
        self._has_gyro = self._has_scans = False

    def add(self, step: Step, estimator: Estimator) -> None:
        """Take the clock offset after ``step``."""
        self._has_gyro, self._has_scans = self._has_gyro or step.turn is not None, self._has_scans or step.scan is not None
        late, inflation = estimator.clock_offset_s, self._faults.inflation
        inflation.late_s = 0.0
        if abs(late) < MAX_LATENCY_S or self._has_gyro == self._has_scans:
            return
        _, sigma = estimator.parameters().get("wheel_clock_offset_s", (0.0, abs(late)))
        if abs(late) < OUTLIER_SIGMAS * sigma:
            return
        inflation.late_s = late
        other, role = ("gyro", "gyro") if self._has_gyro else ("LiDAR", "lidar")
        direction = "later" if late > 0.0 else "earlier"
        numbers: dict[str, float | str] = {
            "other": other,
            "role": role,
            "seconds": abs(late),
            "direction": direction,
            "late": late,
            "early": -late,
        }
        self._faults.declare(CLOCKS_APART, 0.0, numbers)
        self._faults.revise(DetectedFault(CLOCKS_APART, 0.0, CLOCKS_APART.message.format(**numbers)))
