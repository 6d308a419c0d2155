"""Measurement models of filter and graph, with Jacobians. Perturbations act on the right."""

from __future__ import annotations

import numpy as np

from localization.events import Turn
from motion_models import se2
from motion_models.se2 import FloatArray, Pose2

_YAW = np.array([0.0, 0.0, 1.0])


def predict_turn(
    world_T_start: Pose2, world_T_now: Pose2, turn: Turn, bias: float, scale: float
) -> tuple[float, FloatArray, FloatArray, float, float]:
    """What a gyro measures from start to now [rad]: (1 + scale) (yaw_now - yaw_start) + bias dt.

    Returns it with its Jacobians by the pose now (3,), by the start (3,), by the bias [s] and by the scale [rad].
    """
    measured = (turn.angle - bias * turn.duration) / (1.0 + scale)  # resolves full revolutions within a gap
    turned = measured + float(se2.scalar_wrap(float(world_T_now[2] - world_T_start[2]) - measured))
    return (1.0 + scale) * turned + bias * turn.duration, (1.0 + scale) * _YAW, -(1.0 + scale) * _YAW, turn.duration, turned


def submap_residual(odom_T_body: Pose2, measured: Pose2) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Innovation log(pose^-1 measured) (3,) of a pose ``measured`` in a submap, with its Jacobians (3, 3) by the errors of pose and submap.

    To first order the innovation is e_pose - e_map - n, where n is the scan's own noise.
    """
    return se2.log(se2.between(odom_T_body, measured)), np.eye(3), -np.eye(3)


def motion_residual(world_T_a: Pose2, world_T_b: Pose2, measured: Pose2) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far the motion from a to b is off the ``measured`` one: log(measured^-1 (a^-1 b)), (3,), with its Jacobians (3, 3) by a and b."""
    a_T_b = se2.between(world_T_a, world_T_b)
    error = se2.log(se2.between(measured, a_T_b))
    by_b = se2.right_jacobian_inverse(error)
    return error, -by_b @ se2.adjoint(se2.inverse(a_T_b)), by_b


def transform_point(a_T_b: Pose2, point: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``point`` (2,) of frame b in frame a, with its Jacobians by the pose (2, 3) and by the point (2, 2)."""
    c, s = np.cos(a_T_b[2]), np.sin(a_T_b[2])
    R = np.array([[c, -s], [s, c]])
    return se2.transform(a_T_b, point), np.column_stack([R, R @ [-point[1], point[0]]]), R
