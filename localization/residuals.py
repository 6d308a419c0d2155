"""What measurements say of poses: values and exact Jacobians, the same for every estimator. Perturbations act on the right."""

from __future__ import annotations

import numpy as np

from motion_models import se2
from motion_models.se2 import FloatArray


def motion_residual(world_T_a: FloatArray, world_T_b: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far the motion from a to b is off the ``measured`` one: log(measured^-1 (a^-1 b)), (3,), with its Jacobians (3, 3) by a and b."""
    a_T_b = se2.between(world_T_a, world_T_b)
    error = se2.log(se2.between(measured, a_T_b))
    d_b = se2.right_jacobian_inverse(error)
    d_a = -d_b @ se2.adjoint(se2.inverse(a_T_b))
    return error, d_a, d_b


def turn_residual(world_T_a: FloatArray, world_T_b: FloatArray, angle: float, bias: float, duration: float) -> float:
    """How far the turn from a to b is off a gyro's ``angle`` less what its ``bias`` [rad/s] added in ``duration`` [s].

    [rad]; its derivative by the yaw of b is 1, by the yaw of a -1, by the bias ``duration``.
    """
    return float(se2.wrap_angle(np.asarray(world_T_b[2] - world_T_a[2] + bias * duration - angle)))


def position_residual(world_T_a: FloatArray, lever: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far the point ``lever`` (..., 2) of the body at a is off a measured ``position`` (..., 2) [m]; Jacobian (..., 2, 3) by a."""
    c, s = np.cos(world_T_a[..., 2]), np.sin(world_T_a[..., 2])
    R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    sideways = np.stack([-lever[..., 1], lever[..., 0]], -1)
    return se2.transform(world_T_a, lever) - position, np.concatenate([R, R @ sideways[..., None]], -1)
