"""Covariance of what is unsure of all of a path: its scale, which end of the robot is its front, and the clock of its poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from localization.estimators import Estimate
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.robot import Mount, Robot
from motion_models.se2 import Cov3, FloatArray, Pose2


def lever_of_unknown_front(robot: Robot | None, mounts: Mapping[str, Mount]) -> float | None:
    """How far sensors at ``mounts`` are from the middle of a ``robot`` whose front may be its rear [m]; None where its front is known."""
    if robot is None or robot.joints.is_front_known:
        return None
    return max((abs(mount.x) for mount in mounts.values()), default=0.0)


@dataclass(frozen=True)
class PathUncertainty:
    """`widen` each estimate. No step is changed by it, and no sensor is left out."""

    turned_about_m: float | None = None
    """`lever_of_unknown_front`."""
    late_s: float = 0.0
    """By how much the clock of the poses may be off [s]."""
    scale: float = 0.0
    """Share by which the path may be too long or too short."""

    @cached_property
    def is_any(self) -> bool:
        """Whether anything is unsure of all of the path."""
        return bool(self.late_s or self.scale) or self.turned_about_m is not None

    def widen(self, estimate: Estimate, pose: Pose2) -> Estimate:
        """``estimate`` with this covariance; ``pose`` (3,) since the start by sensors alone."""
        spread, twist = self._of_pose(pose), estimate.twist
        return estimate.widened(spread if twist is None else spread + self.late_s**2 * twist[:, None] * twist)

    def widen_trajectory(self, smoothed: Trajectory) -> Trajectory:
        """``smoothed`` with the covariance as it is at its end."""
        if smoothed.covariances is None or not self.is_any:
            return smoothed
        covariances = smoothed.covariances.copy()
        if self.late_s:
            way = _way_in(smoothed, self.late_s)
            covariances += way[:, :, None] * way[:, None, :]
        if self.scale or self.turned_about_m is not None:
            covariances += np.array([self._of_pose(se2.between(smoothed.poses[0], pose)) for pose in smoothed.poses])
        return Trajectory(smoothed.stamps_ns, smoothed.poses, covariances)

    def _of_pose(self, pose: Pose2) -> Cov3:
        """Covariance (3, 3) of a ``pose`` since the start, of which scale and front are unsure. A robot that may drive backwards may be as
        far away on the other side, and a sensor ahead of its middle behind it."""
        x, y, yaw = pose.tolist()
        cos, sin = math.cos(yaw), math.sin(yaw)
        way = np.array([cos * x + sin * y, cos * y - sin * x, 0.0])  # from the start, along the body's axes
        spread: Cov3 = self.scale**2 * way[:, None] * way
        if self.turned_about_m is not None:
            spread += 4.0 * way[:, None] * way + (2.0 * self.turned_about_m) ** 2 * np.diag([1.0, 1.0, 0.0])
        return spread


def _way_in(trajectory: Trajectory, seconds: float) -> FloatArray:
    """(n, 3) longer one of the ways in the ``seconds`` before and after each pose."""
    stamps, shift_ns = trajectory.stamps_ns, round(seconds * 1e9)
    before, after = (
        se2.local(trajectory.poses, trajectory.at(np.clip(stamps + shift, stamps[0], stamps[-1]))) for shift in (-shift_ns, shift_ns)
    )
    is_longer = np.hypot(*after[:, :2].T) > np.hypot(*before[:, :2].T)
    return np.where(is_longer[:, None], after, before)
