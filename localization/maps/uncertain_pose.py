"""A pose with its covariance, on SE(2) or SE(3): moved by the odometry, updated by what scans measure (Barfoot 2017, 7.3 and 8.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from motion_models import se2, se3
from motion_models.se2 import FloatArray


@dataclass(frozen=True, eq=False)
class UncertainPose:
    """A pose ``map_T_body``, or a motion."""

    pose: FloatArray
    """(3,) of SE(2), or (4, 4) of SE(3)."""
    cov: FloatArray
    """(3, 3) or (6, 6) of its right perturbation."""

    @property
    def _group(self) -> Any:
        return se2 if self.pose.ndim == 1 else se3

    def move(self, delta: FloatArray, cov: FloatArray) -> UncertainPose:
        """After a motion ``delta`` with covariance ``cov``: x delta, Ad P Ad^T + Q."""
        A = self._group.adjoint(self._group.inverse(delta))
        return UncertainPose(self._group.compose(self.pose, delta), A @ self.cov @ A.T + cov)

    def squared_distance(self, measured: FloatArray, R: FloatArray) -> float:
        """Squared Mahalanobis distance of a ``measured`` pose with covariance ``R``, both covariances added [-]."""
        off = self._group.local(self.pose, measured)
        return float(off @ np.linalg.solve(self.cov + R, off))

    def update(self, measured: FloatArray, R: FloatArray) -> UncertainPose:
        """After the pose was ``measured`` with covariance ``R``: Kalman's update in Joseph's form."""
        K = np.linalg.solve(self.cov + R, self.cov).T
        rest = np.eye(len(K)) - K
        pose = self._group.retract(self.pose, K @ self._group.local(self.pose, measured))
        return UncertainPose(pose, np.asarray(rest @ self.cov @ rest.T + K @ R @ K.T))
