"""A measured motion between two poses."""

from __future__ import annotations

from motion_models import se2
from motion_models.se2 import FloatArray, Pose2


def motion_residual(world_T_a: Pose2, world_T_b: Pose2, measured: Pose2) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residual (3,) of a ``measured`` motion from a to b, log(measured^-1 (a^-1 b)), with Jacobians (3, 3) by a and b [m, m, rad]."""
    a_T_b = se2.between(world_T_a, world_T_b)
    error = se2.local(measured, a_T_b)
    by_b = se2.right_jacobian_inverse(error)
    return error, -by_b @ se2.adjoint(se2.inverse(a_T_b)), by_b
