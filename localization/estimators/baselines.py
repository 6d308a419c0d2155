"""Baselines: dead reckoning by the motion model alone, and LiDAR alone (KISS-ICP as it comes). Neither fuses anything."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from localization.core.twist import mean_twist, twist_at_end
from localization.errors import EstimatorError
from localization.estimate import Estimate
from localization.estimators.estimator import NO_POINTS, Estimator
from localization.events import Step
from localization.lidar import KissIcp, LidarConfig, Sweep, choose_voxel_size
from localization.lidar.scan_matcher import MIN_POINTS
from motion_models import se2
from motion_models.online_calibration import Corrections
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Points2

_FALLBACK_VOXEL_M = 0.5
"""Voxel where the first scan has too few points to choose one."""


class DeadReckoning(Estimator):
    """Composes the predicted motions. With A = Ad(delta^-1), slip of covariance Q in each step, and errors that last, each as its sigma:

    P' = A P A^T + Q     D' = A D + d     d = [ (d delta / d CG) C^(1/2)   (d delta / d params) B   (d delta / d radius) sigma ]

    The pose has covariance P + D D^T. C is the CG's covariance, B B^T that of the motion model's parameters before a drive has corrected
    them, and sigma the radius'. Errors that last do not depend on how the drive is cut into steps.
    """

    def __init__(self, corrections: Corrections | None = None, radius_sigma: float = 0.0) -> None:
        """``corrections`` of the motion model, with their prior; None for parameters that are exact."""
        self._pose, self._cov = np.zeros(3), np.zeros((3, 3))
        self._by_params = None if corrections is None else corrections.directions @ np.linalg.cholesky(corrections.cov)
        self._radius_sigma = radius_sigma
        self._lasting: FloatArray | None = None

    def step(self, step: Step) -> Estimate:
        """The pose by the wheels at the end of the step, with its covariance."""
        motion, dt = step.predicted, step.duration
        A = se2.adjoint(se2.inverse(motion.delta))
        d = self._lasting_of(step)
        self._pose = se2.compose(self._pose, motion.delta)
        self._cov = A @ self._cov @ A.T + motion.cov
        self._lasting = d if self._lasting is None else A @ self._lasting + d
        twist, twist_cov = step.twist, None
        if dt > 0.0:
            twist, twist_cov = twist_at_end(*mean_twist(motion.delta, motion.cov, dt), step.twist - step.mean_twist, dt)
            twist_cov = twist_cov + d @ d.T / dt**2
        return Estimate(step.end_ns, self._pose, self._cov + self._lasting @ self._lasting.T, twist, twist_cov)

    def _lasting_of(self, step: Step) -> FloatArray:
        """(3, m) what errors that last do to the motion of ``step``, each as its sigma."""
        motion = step.predicted
        by_radius = self._radius_sigma * np.append(-se2.inverse(motion.delta)[:2], 0.0)  # R^T (x, y)
        columns = [motion.d_cg @ _square_root(step.cg_cov), by_radius[:, None]]
        return np.hstack(columns if self._by_params is None else [*columns, motion.d_params @ self._by_params])


def _square_root(cov: FloatArray) -> FloatArray:
    """The symmetric root (2, 2) of a covariance (2, 2), which may be singular: (C + s I) / sqrt(tr C + 2 s), s^2 = det C."""
    s = math.sqrt(max(float(np.linalg.det(cov)), 0.0))
    norm = math.sqrt(float(np.trace(cov)) + 2.0 * s)
    return (cov + s * np.eye(2)) / norm if norm else cov


class LidarOdometry(Estimator):
    """A pose for each scan; between scans it stays where it was. No covariance: KISS-ICP has none.

    ``mounts`` of the LiDARs are by frame; a frame without one is the body's.
    """

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig | None = None) -> None:
        self._mounts, self._config = mounts, config or LidarConfig()
        self._kiss: KissIcp | None = None
        self._used: dict[str, Mount] = {}  # a frame keeps its first mount: KISS-ICP has but one map, drawn from there
        self._pose, self._twist, self._stamp_ns = np.zeros(3), np.zeros(3), 0
        self._n_scans = 0

    def step(self, step: Step) -> Estimate:
        """The pose by KISS-ICP at the end of the step, without covariance."""
        if step.scan is not None:
            frame, c = step.scan.frame_id, self._config
            mount = self._used.setdefault(frame, self._mounts.get(frame, Mount()))
            points = Sweep.from_scan(step.scan, mount, c.min_range_m, c.max_range_m).deskew(self._twist)
            if self._kiss is None:
                voxel = c.voxel_size_m or (choose_voxel_size(points) if len(points) >= MIN_POINTS else _FALLBACK_VOXEL_M)
                self._kiss = KissIcp(voxel, c.max_range_m)
            pose = self._kiss.register_frame(points)
            if not np.isfinite(pose).all():
                raise EstimatorError(f"KISS-ICP failed at stamp {step.end_ns} ns: its pose is not finite.")
            if self._n_scans and step.end_ns > self._stamp_ns:
                self._twist = se2.local(self._pose, pose) / ((step.end_ns - self._stamp_ns) * 1e-9)
            self._pose, self._stamp_ns = pose, step.end_ns
            self._n_scans += 1
        return Estimate(step.end_ns, self._pose, None, self._twist, None)

    def counts(self) -> Mapping[str, int]:
        """Number of scans so far, as "scans"."""
        return {"scans": self._n_scans}

    def map_points(self) -> Points2:
        """(M, 2) points of KISS-ICP's map in the world [m]."""
        return NO_POINTS if self._kiss is None else self._kiss.point_cloud()[:, :2]
