"""The published transform `odom` -> `base_link` is continuous, whatever the estimator does (REP-105)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from localization.estimate import Estimate
from localization.ros.publisher import EstimatePublisher
from localization.ros.start_pose import StartPose
from motion_models import se2
from motion_models.se2 import Pose2, Tangent2

_NS = 1e-9


class ContinuousOdometry:
    """Publishes ``correction * odom_T_body`` for ``odom_T_body`` of the estimator, by `correct` and `place`.

    Where the estimator's pose of one moment changes, by a scan, by a LiDAR that was lost and found, or as another estimator takes over from
    interim odometry, the correction cancels that step. Then it returns to the identity, no faster than one sigma of the published twist:
    what is published moves by its twist, within the uncertainty of that, and ends at the estimator's pose.

    Where an estimator of covariance P is d away from what is published, E |error|^2 of that is P + d d^T.
    """

    def __init__(self) -> None:
        self._correction: Pose2 = np.zeros(3)
        self.last: Estimate | None = None
        """The last one that was placed; None before the first."""

    def correct(self, before: Estimate, after: Estimate) -> None:
        """The estimator's pose has changed from ``before``, carried by its twist to the stamp of ``after``, to that."""
        published = se2.compose(self._correction, carried(before, after.stamp_ns))
        self._correction = se2.compose(published, se2.inverse(odom_T_body(after)))

    def forget(self) -> None:
        """The next pose is published as the estimator has it: somebody has set it in `odom`, or no estimator was there before."""
        self._correction = np.zeros(3)

    def resume(self) -> Estimate | None:
        """What was published last, for interim odometry to go on from; None where nothing was."""
        self.forget()
        return self.last

    def place(self, estimate: Estimate) -> Estimate:
        """``estimate`` as it is published next, with the correction that is left by then."""
        correction = self._relax(estimate)
        if correction.any():
            estimate = StartPose(self._correction, np.outer(correction, correction)).apply(estimate)
        self.last = replace(estimate, pose=odom_T_body(estimate), odometry=None, map_T_odom=None, in_space=None, in_map=None)
        return estimate

    def publish(self, estimate: Estimate, stamp_ns: int, publisher: EstimatePublisher) -> None:
        """Publish ``estimate``, unless one that is as new was."""
        if self.last is None or estimate.stamp_ns > self.last.stamp_ns:
            publisher.publish_continuous(self.place(estimate), stamp_ns)

    def _relax(self, estimate: Estimate) -> Tangent2:
        """Move the correction towards the identity, for the time since the last published pose; its logarithm (3,)."""
        log, cov = se2.log(self._correction), estimate.twist_covariance
        if self.last is None or cov is None or not log.any():
            self._correction = np.zeros(3)
            return self._correction
        at_body = se2.adjoint(se2.inverse(odom_T_body(estimate))) @ log
        seconds = (estimate.stamp_ns - self.last.stamp_ns) * _NS
        whole_s = math.sqrt(float(at_body @ np.linalg.solve(cov, at_body)))  # at one sigma
        log = log * max(1.0 - seconds / whole_s, 0.0)
        self._correction = se2.exp(log)
        return log


def odom_T_body(estimate: Estimate) -> Pose2:
    """Pose (3,) in the odometry frame."""
    return estimate.pose if estimate.odometry is None else estimate.odometry[0]


def carried(estimate: Estimate, stamp_ns: int) -> Pose2:
    """Pose (3,) of ``estimate`` in the odometry frame, moved by its twist to ``stamp_ns``."""
    return se2.retract(odom_T_body(estimate), (stamp_ns - estimate.stamp_ns) * _NS * estimate.twist)
