"""What narrows a search of the map: a pose that was given, the odometry since the robot was tracked, or a measured position."""

from __future__ import annotations

import math

import numpy as np

from localization.lidar.registration import OUTLIER_SIGMAS
from localization.maps.place_probability import SAME_COV
from localization.maps.position_plane import PositionFix
from localization.maps.uncertain_pose import UncertainPose
from motion_models.se2 import Cov3, FloatArray, Pose2

_GIVEN_KEYFRAMES = 10
"""Keyframes after which a given pose that no scan confirms is dropped."""

Window = tuple[Pose2, FloatArray]
"""A pose (3,), and half the window (3,) about it [m, m, rad]."""


class SearchArea:
    """`give` a pose, `reckon` from a tracked one, or `measure` a position; `open` it where the robot may be anywhere."""

    def __init__(self) -> None:
        self.fix: PositionFix | None = None
        """The last measured position."""
        self.is_reckoned = False
        """Whether the pose is by odometry since it was tracked, and was not refuted."""
        self._given_left = 0

    @property
    def is_given(self) -> bool:
        """Whether a pose was given and is not dropped yet."""
        return self._given_left > 0

    def give(self) -> None:
        """The pose is one that a person gave."""
        self.is_reckoned, self._given_left = False, _GIVEN_KEYFRAMES

    def open(self) -> None:
        """The robot may be anywhere, or where a measured position has it."""
        self.is_reckoned, self._given_left = False, 0

    def move(self, delta: Pose2) -> None:
        """The robot has moved by ``delta`` (3,) since the measured position."""
        if self.fix is not None:
            self.fix = self.fix._replace(way_m=self.fix.way_m + math.hypot(delta[0], delta[1]))

    def take_given(self) -> bool:
        """A search about the given pose, if there is one, begins; returns whether that was the last one."""
        was_given = self.is_given
        self._given_left -= was_given
        return was_given and not self.is_given

    def contradicts(self, pose: Pose2) -> bool:
        """Whether the measured position contradicts ``pose`` (3,) of the map."""
        return self.fix is not None and self.fix.squared_mahalanobis(pose[:2], SAME_COV[:2, :2]) > OUTLIER_SIGMAS**2

    def around_fix(self, extent_cov: Cov3) -> Window | None:
        """Within 3 sigma of the measured position; None where that narrows nothing of a map of ``extent_cov`` (3, 3)."""
        if self.fix is None or np.trace(self.fix.cov) > np.trace(extent_cov[:2, :2]):
            return None
        radius = 3.0 * math.sqrt(float(np.trace(self.fix.cov)))
        return np.array([*self.fix.position, 0.0]), np.array([radius, radius, math.pi])


def around(at: UncertainPose) -> Window:
    """Within 3 sigma of ``at``, along any axes."""
    radius = math.sqrt(float(np.trace(at.cov[:2, :2])))
    return at.pose, 3.0 * np.array([radius, radius, math.sqrt(at.cov[2, 2])])
