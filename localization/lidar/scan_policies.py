"""What is not nominal about a scan, one policy each: a frozen scanner, and a robot that was moved."""

from __future__ import annotations

import math

import numpy as np

from localization.events import Scan, Step
from localization.lidar.scan_matcher import LidarConfig
from motion_models import se2
from motion_models.se2 import FloatArray, Pose2

MOVED_COV = np.diag([3.0, 3.0, 1.5]) ** 2
"""Covariance of the pose of a robot that was moved by other than its wheels: carried across a room, and turned to any side [m^2, m^2,
rad^2]."""


class StaleScans:
    """Recognizes scanners that repeat their last scan."""

    def __init__(self) -> None:
        self._points: dict[str, FloatArray] = {}  # of the last scan in each frame
        self._is_frozen: dict[str, bool] = {}

    def is_stale(self, scan: Scan, is_standing: bool) -> bool:
        """The very same ranges as last time although the wheels turn: noise alone would have changed them.

        A scanner that froze while the robot drove stays stale until its ranges change, also where the robot stands.
        """
        last = self._points.get(scan.frame_id)
        is_same = last is not None and len(last) > 0 and np.array_equal(last, scan.points)
        is_frozen = is_same and (self._is_frozen.get(scan.frame_id, False) or not is_standing)
        self._points[scan.frame_id], self._is_frozen[scan.frame_id] = scan.points, is_frozen
        return is_frozen


class MovedRobot:
    """Recognizes a robot that was moved by other than its wheels: its scans lose the map at once.

    The mapped share of scans falls from where no search is needed to where a scan is lost, within a way after which no key scan is due. It
    falls from 0.97 to 0.52 at most on fr079, MIT-CSAIL and ACES, and below 0.25 where a robot is carried.
    """

    def __init__(self, config: LidarConfig) -> None:
        self._config = config
        self._mapped_shares: dict[str, float] = {}  # of the last scan in each frame
        self.since: Pose2 = np.zeros(3)
        """(3,) motion by the wheels from the last scan to the begin of the step."""
        self._at_ns: int | None = None

    def add_no_scan(self, step: Step) -> None:
        """A step that ends without a scan, or with one that shows nothing."""
        self.since = se2.compose(self.since, step.predicted.delta)

    def begin(self, scan: Scan) -> None:
        """``scan`` begins a submap: all of it is mapped."""
        self.since = np.zeros(3)
        self._mapped_shares = {scan.frame_id: 1.0}

    def is_moved(self, step: Step, scan: Scan, motion: Pose2, mapped_share: float, *, is_matched: bool) -> bool:
        """Whether the robot was moved by other than its wheels since the last scan, which have the ``motion`` (3,): by the ``mapped_share``
        of the points of ``scan`` of ``step`` and before."""
        before, c = self._mapped_shares.get(scan.frame_id, 0.0), self._config
        self._mapped_shares[scan.frame_id] = mapped_share
        (x, y, yaw), self.since = motion, np.zeros(3)
        if is_matched or step.is_scan_partial or before <= c.search_below or mapped_share >= c.lost_below:
            return False
        if math.hypot(x, y) >= c.key_distance_m or abs(yaw) >= c.key_angle_rad:
            return False
        self._at_ns = step.end_ns
        return True

    def cov(self, step: Step) -> FloatArray | None:
        """(3, 3) by which the pose is off besides, where the robot was moved in ``step``."""
        return MOVED_COV if self._at_ns == step.end_ns else None
