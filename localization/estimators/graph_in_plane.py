"""Keyframes of SE(2) in a `PoseGraph`: GTSAM's Pose2, in the order of `motion_models.se2`."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from localization.core.measurements.position import predict_position
from localization.core.measurements.relative_pose import motion_residual
from localization.estimators.keyframe_motion import PreintegratedMotion
from localization.estimators.pose_graph import ALIGNMENT, ALIGNMENT_SIGMA, LEVER, LEVER_SIGMA_M, PositionMeasurement, robust_factor
from motion_models import se2
from motion_models.groups import SE2
from motion_models.se2 import FloatArray, Pose2

_FIRST_SIGMA = np.array([1e-3, 1e-3, 1e-4])
"""The first keyframe is the origin of the map [m, m, rad]."""


@dataclass(frozen=True)
class PlanarKeyframes:
    """See `Keyframes`. The alignment is x, y and yaw."""

    group = SE2
    rows = (0, 1, 2)

    def value(self, pose: Pose2, /) -> gtsam.Pose2:
        """``pose`` (3,) as GTSAM has it."""
        return gtsam.Pose2(*pose)

    def pose(self, values: gtsam.Values, key: int, /) -> Pose2:
        """(3,) the pose ``key`` of ``values``."""
        pose = values.atPose2(key)
        return np.array([pose.x(), pose.y(), pose.theta()])

    def poses(self, values: gtsam.Values, count: int, /) -> FloatArray:
        """(count, 3) the keyframes of ``values``."""
        poses = gtsam.utilities.extractPose2(values)  # in order of keys: before x, there may be t
        return np.asarray(poses[len(poses) - count :])

    def first(self, key: int, pose: Pose2, /) -> gtsam.NonlinearFactor:
        """The prior of the first keyframe."""
        return gtsam.PriorFactorPose2(key, gtsam.Pose2(*pose), gtsam.noiseModel.Diagonal.Sigmas(_FIRST_SIGMA))

    def motion(self, a: int, b: int, delta: Pose2, noise: gtsam.noiseModel.Base, /) -> gtsam.NonlinearFactor:
        """The motion ``delta`` (3,) from the pose ``a`` to ``b``."""
        return gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*delta), noise)

    def wheels(self, a: int, b: int, corrections: int, wheels: PreintegratedMotion, /) -> gtsam.CustomFactor:
        """log((delta exp(D (c - c0)))^-1 (x_a^-1 x_b)): the motion model's prediction as a factor of both poses and the corrections."""
        keys, has_corrections = [a, b], wheels.by_corrections.any()
        if has_corrections:
            keys.append(corrections)

        def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
            D = wheels.by_corrections
            shift = D @ (values.atVector(corrections) - wheels.at) if has_corrections else np.zeros(3)
            predicted = se2.retract(wheels.delta, shift)
            residual, by_a, by_b = motion_residual(self.pose(values, a), self.pose(values, b), predicted)
            if H is not None:
                H[0], H[1] = np.asfortranarray(by_a), np.asfortranarray(by_b)
                if has_corrections:
                    by_predicted = -by_b @ se2.adjoint(se2.exp(-residual))
                    H[2] = np.asfortranarray(by_predicted @ se2.right_jacobian(shift) @ D)
            return residual

        return robust_factor(keys, wheels.cov, error)

    def bias_prior(self) -> None:
        """Gravity is no measurement of a planar pose."""

    def gravity(self, *_: object) -> gtsam.CustomFactor:
        """Raises `TypeError`: gravity is no measurement of a planar pose."""
        raise TypeError("gravity is no measurement of a planar pose")

    def place(self, alignment: Pose2, lever: FloatArray, /) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Priors and values of ``enu_T_map`` (3,) and of the ``lever`` arm, of which x and y count."""
        factors, values, sigmas = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel.Diagonal.Sigmas
        factors.add(gtsam.PriorFactorPose2(ALIGNMENT, gtsam.Pose2(*alignment), sigmas(np.full(3, ALIGNMENT_SIGMA))))
        factors.add(gtsam.PriorFactorPoint2(LEVER, lever[:2], sigmas(np.full(2, LEVER_SIGMA_M))))
        values.insert(ALIGNMENT, gtsam.Pose2(*alignment))
        values.insert(LEVER, lever[:2])
        return factors, values

    def alignment(self, values: gtsam.Values, /) -> Pose2:
        """(3,) ``enu_T_map`` of ``values``."""
        return self.pose(values, ALIGNMENT)

    def position(self, measured: PositionMeasurement, /) -> gtsam.CustomFactor:
        """t x_k (offset l) - p: where the antenna at lever arm l is, against the measured position."""
        key = gtsam.symbol("x", measured.k)

        def error(this: gtsam.CustomFactor, values: gtsam.Values, H: list[FloatArray] | None) -> FloatArray:
            enu_T_map, map_T_key, lever = self.alignment(values), self.pose(values, key), np.asarray(values.atPoint2(LEVER))
            predicted, *jacobians = predict_position(enu_T_map, map_T_key, measured.offset, lever)
            if H is not None:
                H[0], H[1], H[2] = map(np.asfortranarray, jacobians)
            return np.asarray(predicted - measured.position)

        return robust_factor([ALIGNMENT, key, LEVER], measured.cov, error)
