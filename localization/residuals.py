"""What measurements say of poses: values and exact Jacobians, the same for every estimator. Perturbations act on the right."""

from __future__ import annotations

import numba
import numpy as np

from motion_models import se2
from motion_models.se2 import FloatArray, Triple, gufunc, triple


@numba.njit(cache=True)
def fill_motion_residual(a: Triple, b: Triple, measured: Triple, d_a: FloatArray, d_b: FloatArray) -> Triple:  # pragma: no cover
    """`motion_residual` for compiled loops; its Jacobians into ``d_a`` and ``d_b`` (3, 3)."""
    a_T_b = se2.scalar_between(a, b)
    error = se2.scalar_log(se2.scalar_between(measured, a_T_b))
    se2.fill_right_jacobian_inverse(error, d_b)
    adjoint = np.empty((3, 3))
    se2.fill_adjoint(se2.scalar_inverse(a_T_b), adjoint)
    for i in range(3):
        for j in range(3):
            d_a[i, j] = -(d_b[i, 0] * adjoint[0, j] + d_b[i, 1] * adjoint[1, j] + d_b[i, 2] * adjoint[2, j])
    return error


@gufunc("(n),(n),(n)->(n),(n,n),(n,n)")
def _motion_residual(
    a: FloatArray, b: FloatArray, measured: FloatArray, error: FloatArray, d_a: FloatArray, d_b: FloatArray
) -> None:  # pragma: no cover
    error[0], error[1], error[2] = fill_motion_residual(triple(a), triple(b), triple(measured), d_a, d_b)


def motion_residual(world_T_a: FloatArray, world_T_b: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far the motion from a to b is off the ``measured`` one: log(measured^-1 (a^-1 b)), (3,), with its Jacobians (3, 3) by a and b."""
    found: tuple[FloatArray, FloatArray, FloatArray] = _motion_residual(world_T_a, world_T_b, measured)
    return found


def turn_residual(world_T_a: FloatArray, world_T_b: FloatArray, angle: float, bias: float, duration: float) -> float:
    """How far the turn from a to b is off a gyro's ``angle`` less what its ``bias`` [rad/s] added in ``duration`` [s].

    [rad]; its derivative by the yaw of b is 1, by the yaw of a -1, by the bias ``duration``.
    """
    return float(se2.scalar_wrap(float(world_T_b[2] - world_T_a[2] + bias * duration - angle)))


def position_residual(world_T_a: FloatArray, lever: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far the point ``lever`` (..., 2) of the body at a is off a measured ``position`` (..., 2) [m]; Jacobian (..., 2, 3) by a."""
    c, s = np.cos(world_T_a[..., 2]), np.sin(world_T_a[..., 2])
    R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    sideways = np.stack([-lever[..., 1], lever[..., 0]], -1)
    return se2.transform(world_T_a, lever) - position, np.concatenate([R, R @ sideways[..., None]], -1)
