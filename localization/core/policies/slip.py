"""Slip of the wheels within a sweep: how far it bends a scan that was deskewed with one twist."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.events import Step
from localization.lidar import OUTLIER_SIGMAS, ScanMatch, ScanMatchingSensor
from localization.small_filters import FORGETTING
from motion_models import se2
from motion_models.se2 import Cov3, Pose2, Tangent2, Twist2

_PRIOR_SCANS = 0.2
"""Weight of white slip, as the wheels' noise model has it, in scans: the first key scans are drawn by then, and their error stays (NEES of
simulated rooms with weight 1: 1.6, with 0.2: 1.9; with white slip 4.7 and 4.8)."""

_MAX_CHANGE_M, _MAX_CHANGE_RAD = 0.1, 0.1
"""Motion in a step and that with the twist before it differ by no more where the robot goes on as before [m, rad]."""
_MIN_STEP_S = 0.02
"""Shortest step whose motion shows a twist [s]: LiDARs give up to 40 scans a second. Nearer scans are of two LiDARs, or have stamps that
jitter, and their motion over the step is error."""


class SweepSlip:
    """A sweep is deskewed with the wheels' twist first, and with the slip that its match shows then; slip that is white bends it.

    Where the wheels were an outlier of the last match, and the robot went on as before, the last twist is taken for theirs."""

    def __init__(self) -> None:
        self._twist, self._slip = np.zeros(3), np.zeros(3)  # of the last step, and less that of the wheels
        self._is_measured = self._goes_on = self._is_long = False
        self._changes = SlipChanges()

    def start_step(self, step: Step) -> tuple[Step, Tangent2]:
        """``step`` with the twist that its sweep is deskewed with first, and (3,) from the wheels' motion to that with the last twist:
        where wheels stall and catch up, the robot goes on as before."""
        offset = se2.local(step.predicted.delta, se2.exp(step.duration * self._twist))
        return (replace(step, twist=self._twist) if self._goes_on else step), offset

    def refine(self, sensor: ScanMatchingSensor, step: Step, start: Pose2, match: ScanMatch) -> tuple[ScanMatch, Cov3]:
        """``match`` of the scan deskewed anew, with the slip since the pose ``start`` (3,), and its covariance (3, 3) with white slip."""
        if step.duration == 0.0:
            return match, match.cov
        motion = se2.local(start, match.pose)
        off = motion - step.duration * self._twist
        is_near = math.hypot(off[0], off[1]) < _MAX_CHANGE_M and abs(off[2]) < _MAX_CHANGE_RAD
        self._goes_on = is_near and bool(match.outlier_cov.any())
        self._is_long = step.duration >= _MIN_STEP_S
        if step.scan is None or not len(step.scan.offsets):  # all points were measured at once
            return match, match.cov
        if self._is_measured and self._is_long:  # else the error of the pose at the start would look like motion
            slip = motion / step.duration - step.mean_twist
            match = sensor.refine(match, step.twist + slip)
            self._changes.add(slip - self._slip, match.cov, step, sensor.sweep_s)
        return match, match.cov + sensor.intra_scan_slip_cov(match, self._changes.rate(step))

    def end_step(self, step: Step, twist: Twist2, is_measured: bool) -> None:
        """The estimated mean ``twist`` (3,) of ``step``; ``is_measured``: by a scan."""
        self._goes_on &= is_measured
        self._is_measured = is_measured
        if self._is_long or not is_measured:
            self._twist, self._slip = twist, twist - step.mean_twist


class SlipChanges:
    """Share of the wheels' noise that is white, along each axis, from the slip of successive scans.

    Slip that lasts is in the twist that a sweep is deskewed with. White slip is not: it bends the scan.
    """

    def __init__(self) -> None:
        self._sum, self._weight = np.full(3, _PRIOR_SCANS), np.full(3, _PRIOR_SCANS)  # white, until measured
        self._last: Tangent2 | None = None  # change before the last scan [m, m, rad]

    def add(self, change: Twist2, scan_cov: Cov3, step: Step, sweep_s: float) -> None:
        """``change`` (3,) of the slip since the last scan [m/s, m/s, rad/s]; ``scan_cov`` (3, 3) of the scans that measured it.

        Changes c of the motion's error from step to step have E[c_k c_k+1] = -q for white slip with variance q a step, and hardly any
        covariance where slip lasts. Scans with noise n add -4 n. As a scan gives the mean over its sweep of T, it is -(1 - 2/3 T / dt) q.
        """
        if not step.has_wheels or step.is_standing:
            self._last = None
            return
        last, self._last = self._last, change * step.duration
        if last is None:
            return
        white = (1.0 - min(sweep_s / step.duration, 1.0) * 2.0 / 3.0) * np.diagonal(step.cov)
        scans = np.diagonal(scan_cov)
        limit = OUTLIER_SIGMAS**2 * (2.0 * white + 6.0 * scans)
        is_inlier = np.maximum(last**2, self._last**2) < limit  # else wheels or scans are outliers
        excess = (-last * self._last - 4.0 * scans) / white
        self._sum = np.where(is_inlier, FORGETTING * self._sum + excess, self._sum)
        self._weight = np.where(is_inlier, FORGETTING * self._weight + 1.0, self._weight)

    def rate(self, step: Step) -> Cov3:
        """(3, 3) covariance a second of the slip in ``step`` that changes within a sweep, as a random walk."""
        if not step.has_wheels or step.is_standing:
            return np.zeros((3, 3))
        root = np.sqrt(np.maximum(self._sum / self._weight, 0.0))
        return np.asarray(root[:, None] * step.cov * root / step.duration)
