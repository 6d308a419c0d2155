"""Keyframes of SE(3) in a `PoseGraph`, which gravity levels: GTSAM's Pose3, whose tangents have the rotation first.

a            bias of the accelerometer, with what its mount is off
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from localization.core.measurements.position import predict_position_in_space
from localization.estimators.keyframe_motion import PreintegratedMotion
from localization.estimators.pose_graph import (
    ALIGNMENT,
    ALIGNMENT_SIGMA,
    LEVER,
    LEVER_SIGMA_M,
    GravityMeasurement,
    PositionMeasurement,
    robust_factor,
)
from motion_models import se2, se3
from motion_models.groups import SE3
from motion_models.se2 import FloatArray
from motion_models.se3 import Transform3
from motion_models.slope import GRAVITY

_PLANAR = [0, 1, 5]
_BIAS = gtsam.symbol("a", 0)
_FIRST_POSITION_M, _FIRST_HEADING, _FIRST_TILT = 1e-3, 1e-4, 0.2
"""Sigmas of the first keyframe, which is the origin of the map [m, rad]; gravity measures its roll and pitch."""
_ANTENNA_HEIGHT_SIGMA_M = 1.0
"""Prior sigma of the antenna's height above base_link around its given value [m]."""


@dataclass(frozen=True)
class SpaceKeyframes:
    """See `Keyframes`. The alignment is x, y, z and yaw."""

    accelerometer_sigma: float
    """[m/s^2]"""
    group = SE3
    rows = (3, 4, 5, 0, 1, 2)

    def value(self, pose: Transform3, /) -> gtsam.Pose3:
        """``pose`` (4, 4) as GTSAM has it."""
        return gtsam.Pose3(pose)

    def pose(self, values: gtsam.Values, key: int, /) -> Transform3:
        """(4, 4) the pose ``key`` of ``values``."""
        return np.asarray(values.atPose3(key).matrix())

    def poses(self, values: gtsam.Values, count: int, /) -> FloatArray:
        """(count, 4, 4) the keyframes of ``values``."""
        return np.array([self.pose(values, gtsam.symbol("x", k)) for k in range(count)]).reshape(-1, 4, 4)

    def first(self, key: int, pose: Transform3, /) -> gtsam.NonlinearFactor:
        """The prior of the first keyframe."""
        information = _first_information(pose)[np.ix_(self.rows, self.rows)]
        return gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), gtsam.noiseModel.Gaussian.Information(information))

    def motion(self, a: int, b: int, delta: Transform3, noise: gtsam.noiseModel.Base, /) -> gtsam.NonlinearFactor:
        """The motion ``delta`` (4, 4) from the pose ``a`` to ``b``."""
        return gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(delta), noise)

    def wheels(self, a: int, b: int, corrections: int, wheels: PreintegratedMotion, /) -> gtsam.CustomFactor:
        """x, y and yaw of log(lift(delta exp(D (c - c0)))^-1 (x_a^-1 x_b)): the wheels' motion in the plane of the body."""

        def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
            D = wheels.by_corrections
            shift = D @ (values.atVector(corrections) - wheels.at)
            a_T_b = se3.compose(se3.inverse(self.pose(values, a)), self.pose(values, b))
            residual = se3.local(se3.lift(se2.retract(wheels.delta, shift)), a_T_b)
            if H is not None:  # to first order in the residual
                H[0] = np.asfortranarray(-se3.adjoint(se3.inverse(a_T_b))[np.ix_(_PLANAR, self.rows)])
                H[1] = np.asfortranarray(np.eye(6)[np.ix_(_PLANAR, self.rows)])
                H[2] = np.asfortranarray(-se2.adjoint(se2.exp(-residual[_PLANAR])) @ se2.right_jacobian(shift) @ D)
            return np.asarray(residual[_PLANAR])

        return robust_factor([a, b, corrections], wheels.cov, error)

    def bias_prior(self) -> tuple[int, gtsam.NonlinearFactor]:
        """Key and prior of the accelerometer's bias."""
        return _BIAS, gtsam.PriorFactorVector(_BIAS, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, self.accelerometer_sigma))

    def gravity(self, measured: GravityMeasurement, /) -> gtsam.CustomFactor:
        """g T^T R_k^T e_z + a - f: gravity of a keyframe's attitude in the axes of the body at the measurement.

        GTSAM's own attitude factor has no bias; one that lasts for the drive would count as often as gravity is measured.
        """
        key = gtsam.symbol("x", measured.k)

        def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
            up = self.pose(values, key)[2, :3]
            if H is not None:
                H[0] = np.asfortranarray(GRAVITY * measured.turned.T @ np.hstack([se3.cross(up), np.zeros((3, 3))]))
                H[1] = np.asfortranarray(np.eye(3))
            return np.asarray(GRAVITY * measured.turned.T @ up + values.atVector(_BIAS) - measured.force)

        return robust_factor([key, _BIAS], measured.variance * np.eye(3), error)

    def place(self, alignment: FloatArray, lever: FloatArray, /) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Priors and values of ``enu_T_map`` (4,) and of the ``lever`` arm (3,)."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, mean, sigmas in (
            (ALIGNMENT, alignment, np.full(4, ALIGNMENT_SIGMA)),
            (LEVER, lever, np.array([LEVER_SIGMA_M, LEVER_SIGMA_M, _ANTENNA_HEIGHT_SIGMA_M])),
        ):
            values.insert(key, mean)
            factors.add(gtsam.PriorFactorVector(key, mean, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
        return factors, values

    def alignment(self, values: gtsam.Values, /) -> FloatArray:
        """(4,) ``enu_T_map`` of ``values``."""
        return np.asarray(values.atVector(ALIGNMENT))

    def position(self, measured: PositionMeasurement, /) -> gtsam.CustomFactor:
        """t x_k (offset l) - p: where the antenna is, against its measured position."""
        key, n = gtsam.symbol("x", measured.k), len(measured.position)

        def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
            place = self.alignment(values), self.pose(values, key), measured.offset, np.asarray(values.atVector(LEVER))
            predicted, by_alignment, by_key, by_lever = predict_position_in_space(*place)
            if H is not None:
                H[0], H[1], H[2] = map(np.asfortranarray, (by_alignment[:n], by_key[:n, self.rows], by_lever[:n]))
            return np.asarray(predicted[:n] - measured.position)

        return robust_factor([ALIGNMENT, key, LEVER], measured.cov, error)


def _first_information(pose: Transform3) -> FloatArray:
    """(6, 6) of the first keyframe: its position and the heading of its x axis are the map's, roll and pitch are open.

    With rotation errors e in the body's axes that heading changes by (R_yy e_z - R_yz e_y) / R_xx, for R turned to heading zero.
    """
    level = se3.rotation(np.array([0.0, 0.0, -np.arctan2(pose[1, 0], pose[0, 0])])) @ pose[:3, :3]
    heading = np.array([0.0, -level[1, 2], level[1, 1]]) / level[0, 0]
    out = np.eye(6) / _FIRST_POSITION_M**2
    out[3:, 3:] = np.eye(3) / _FIRST_TILT**2 + np.outer(heading, heading) / _FIRST_HEADING**2
    return out
