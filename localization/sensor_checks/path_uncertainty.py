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
from motion_models.compiled import kernel
from motion_models.robot import Mount, Robot
from motion_models.se2 import Cov3, FloatArray, Pose2, Twist2

_NO_TWIST = np.zeros(3)


def lever_of_unknown_front(robot: Robot, mounts: Mapping[str, Mount]) -> float | None:
    """How far sensors at ``mounts`` are from the middle of a ``robot`` whose front may be its rear [m]; None where its front is known."""
    if robot.joints.is_front_known:
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
        twist = estimate.twist if estimate.twist is not None else _NO_TWIST
        return estimate.widened(_spread(pose, self.late_s, twist, self.scale, self.turned_about_m))

    def widen_trajectory(self, smoothed: Trajectory) -> Trajectory:
        """``smoothed`` with the covariance as it is at its end."""
        if smoothed.covariances is None or not self.is_any:
            return smoothed
        covariances = smoothed.covariances.copy()
        if self.late_s:
            way = _way_in(smoothed, self.late_s)
            covariances += way[:, :, None] * way[:, None, :]
        if self.scale or self.turned_about_m is not None:
            poses = se2.between(smoothed.poses[0], smoothed.poses)
            covariances += np.array([_spread(pose, 0.0, _NO_TWIST, self.scale, self.turned_about_m) for pose in poses])
        return Trajectory(smoothed.stamps_ns, smoothed.poses, covariances)


@kernel
def _spread(pose: Pose2, late_s: float, twist: Twist2, scale: float, turned_about_m: float | None) -> Cov3:
    """Covariance (3, 3) of a ``pose`` (3,) since the start, which is late by ``late_s`` [s] at ``twist`` (3,), and of which ``scale`` and
    front are unsure. A robot that may drive backwards may be as far away on the other side, and a sensor ahead of its middle behind it."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    way = (c * pose[0] + s * pose[1], c * pose[1] - s * pose[0], 0.0)  # from the start, along the body's axes
    of_way = scale**2 if turned_about_m is None else scale**2 + 4.0
    spread = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            spread[i, j] = of_way * way[i] * way[j] + late_s**2 * twist[i] * twist[j]
    if turned_about_m is not None:
        spread[0, 0] += (2.0 * turned_about_m) ** 2
        spread[1, 1] += (2.0 * turned_about_m) ** 2
    return spread


def _way_in(trajectory: Trajectory, seconds: float) -> FloatArray:
    """(n, 3) longer one of the ways in the ``seconds`` before and after each pose."""
    stamps, shift_ns = trajectory.stamps_ns, round(seconds * 1e9)
    before, after = (
        se2.local(trajectory.poses, trajectory.at(np.clip(stamps + shift, stamps[0], stamps[-1]))) for shift in (-shift_ns, shift_ns)
    )
    is_longer = np.hypot(*after[:, :2].T) > np.hypot(*before[:, :2].T)
    return np.where(is_longer[:, None], after, before)
