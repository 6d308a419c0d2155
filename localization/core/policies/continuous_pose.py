"""A pose that never jumps, beside the one that later measurements correct (the frames `odom` and `map` of REP-105)."""

from __future__ import annotations

import numpy as np

from localization.core.state import State
from motion_models import se2
from motion_models.se2 import Cov3, Pose2


class ContinuousPose:
    """`add` each step. Of a robot that has driven for minutes without a LiDAR, a gyro bias that is found late moves the pose by all of the
    way; those who steer by a pose, or build a map on it, need one that does not."""

    def __init__(self) -> None:
        self._pose = np.zeros(3)

    def add(self, state: State) -> tuple[Pose2, Cov3]:
        """The continuous pose (3,) at the end of a step, and its covariance (3, 3): it moves from `start` to `pose` of ``state`` as the
        robot has by all that is known then, and later measurements leave it as it is.

        The true pose is pose exp(e), and continuous exp(d) with the d that takes it to pose: continuous exp(d + J_r^-1(d) e) to first
        order (Solà 2018, eq. 69). Its error has the mean d and the covariance of e, so that E |error|^2 is J_r^-1 P J_r^-T + d d^T.
        """
        self._pose = se2.compose(self._pose, se2.between(state["start"], state["pose"]))
        d = se2.local(self._pose, state["pose"])
        J = se2.right_jacobian_inverse(d)
        return self._pose, J @ state.cov("pose") @ J.T + np.outer(d, d)
