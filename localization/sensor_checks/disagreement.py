"""Times in which the motion by the scans, as the estimate has it, and that by the wheels disagree."""

from __future__ import annotations

import functools
import math
from collections import deque
from typing import NamedTuple

import numpy as np

from localization.events import Step
from localization.sensor_checks.faults import DetectedFault, FaultLog, SensorFault
from localization.sensor_checks.sensor_check import SensorCheck
from motion_models import se2
from motion_models.se2 import FloatArray

DISAGREEMENT = SensorFault(
    "for {seconds:.0f} s the motion by the scans and that by the wheels differ ({sigmas:.1f} sigma in the mean, {metres:.2f} m and"
    " {degrees:.0f} deg at the end{others}). Wheels slip, or the mount, the stamps or the scale of a sensor are wrong: run `skidloc"
    " diagnose` on the log."
)

_DISAGREEMENT_S, _MIN_DISAGREEING_SCANS = 5.0, 8
_MAX_SQUARE, _MAX_MEAN_SQUARE = 25.0, 10.0
"""Mean over 5 s of the squared distance between the wheels' motion and the estimate's, in sigmas, each at most 5 sigma; 3 is expected.
1.4 % of the time of CSAIL and 3.9 % of fr079 are above, none of ACES and simulated laps."""
_SCAN_NOISE = np.diag([0.02, 0.02, 0.01]) ** 2
"""Covariance of the motion from scan to scan [m^2, m^2, rad^2]."""
_NS = 1e-9


class Disagreement(SensorCheck):
    """Leaves out nothing, as either may be right. While it lasts, the covariance has the difference, and afterwards if a scan was lost
    meanwhile: else scans were matched all the way to a submap that is older, and it was the wheels."""

    def __init__(self, faults: FaultLog) -> None:
        self._faults, self._distance = faults, MotionDistance()
        self._now: _Episode | None = None
        self._largest: _Episode | None = None
        self._ended, self._ended_s = 0, 0.0  # number of episodes, and their sum [s]
        self._has_lost_scan = False  # in this episode

    def compare_estimate(self, step: Step, delta: FloatArray, nis: float | None) -> None:
        """Report the largest disagreement so far, with how often there was one."""
        if step.duration == 0.0:
            return
        self._distance.add(step, delta, nis)
        off = self._distance.difference
        self._faults.inflation.ongoing = off
        if off is not None:
            self._has_lost_scan |= step.scan is not None and nis is None
            self._now = _Episode(self._distance.began_s - self._faults.start_s, self._faults.now_s, off, self._distance.mean_square)
            self._faults.revise(self._describe(self._now))
        elif self._now is not None:
            if self._has_lost_scan and not self._faults.inflation.are_wheels_outvoted:
                self._faults.inflation.add(self._now.difference)
            self._has_lost_scan = False
            self._largest = self._larger(self._now)
            self._ended, self._ended_s, self._now = self._ended + 1, self._ended_s + self._now.seconds, None

    def restart(self) -> None:
        """The pose is known: a disagreement that lasts counts from here on."""
        self._distance.restart()
        self._has_lost_scan = False

    def _larger(self, now: _Episode) -> _Episode:
        return now if self._largest is None or now.distance > self._largest.distance else self._largest

    def _describe(self, now: _Episode) -> DetectedFault:
        largest, seconds = self._larger(now), self._ended_s + now.seconds
        message = DISAGREEMENT.message.format(
            seconds=largest.seconds,
            sigmas=math.sqrt(largest.mean_square),
            metres=largest.distance,
            degrees=abs(math.degrees(largest.difference[2])),
            others=f"; the largest of {self._ended + 1} such times, {seconds:.0f} s in all" if self._ended else "",
        )
        return DetectedFault(DISAGREEMENT, largest.begin_s, message)


class _Episode(NamedTuple):
    """A time in which scans and wheels disagree."""

    begin_s: float
    end_s: float
    difference: FloatArray
    """(3,) difference of the motion by the wheels from that by the estimate [m, m, rad]."""
    mean_square: float
    """Mean squared distance of both motions over the last 5 s, in sigmas."""

    @property
    def seconds(self) -> float:
        """[s]"""
        return self.end_s - self.begin_s

    @property
    def distance(self) -> float:
        """Length of the difference [m]."""
        return math.hypot(self.difference[0], self.difference[1])


class MotionDistance:
    """Distance of the estimate's motion from the wheels', over the last seconds."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, FloatArray, FloatArray]] = deque()  # time [s], motion by wheels and estimate
        self._squares: deque[float] = deque()
        self._motions: tuple[FloatArray, FloatArray] | None = None
        self.mean_square = 0.0
        self.began_s = 0.0
        """Time of the first step at which they differ [s]."""

    @property
    def difference(self) -> FloatArray | None:
        """Difference of the motion by the wheels from that by the estimate (3,), since they began to disagree; None where they agree."""
        return None if self._motions is None else se2.local(self._motions[1], self._motions[0])

    def restart(self) -> None:
        """A difference that lasts is measured from here on."""
        if self._motions is not None:
            self._motions = np.zeros(3), np.zeros(3)

    def add(self, step: Step, delta: FloatArray, nis: float | None) -> None:
        """``delta`` (3,) of ``step`` by the estimate, and its NIS. Steps without scans or moving wheels are not compared."""
        wheels = step.predicted.delta if step.has_wheels else delta
        if self._motions is not None:
            self._motions = se2.compose(self._motions[0], wheels), se2.compose(self._motions[1], delta)
        if step.scan is None or not step.has_wheels or step.is_standing:
            return
        off = se2.local(wheels, delta)
        square = max(float(off @ np.linalg.solve(step.cov + _SCAN_NOISE, off)), nis or 0.0)
        now_s = step.end_ns * _NS
        self._rows.append((now_s, wheels, delta))
        self._squares.append(min(square, _MAX_SQUARE))
        while self._rows[0][0] < now_s - _DISAGREEMENT_S:
            self._rows.popleft()
            self._squares.popleft()
        self.mean_square = sum(self._squares) / len(self._squares)
        is_short = now_s - self._rows[0][0] < 0.9 * _DISAGREEMENT_S or len(self._rows) < _MIN_DISAGREEING_SCANS
        if is_short or self.mean_square <= _MAX_MEAN_SQUARE:
            self._motions = None
        elif self._motions is None:
            wheels, estimated = (functools.reduce(se2.compose, (row[i] for row in self._rows), np.zeros(3)) for i in (1, 2))
            self._motions = wheels, estimated
            self.began_s = next(row[0] for row, square in zip(self._rows, self._squares, strict=True) if square > _MAX_MEAN_SQUARE)
