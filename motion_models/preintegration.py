"""Preintegration: many wheel samples become one `Motion`, for any model, in compiled code.

The model gives twists and their derivatives for all samples at once. Composition on SE(2) and propagation of covariance and derivatives
are the same for every model.
"""

from __future__ import annotations

import math

import numpy as np

from motion_models.base import MotionModel
from motion_models.compiled import kernel
from motion_models.linear_equations import multiply_affine
from motion_models.motion import Motion, Twist
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray, fill_inverse_adjoint, fill_right_jacobian, scalar_exp, scalar_transform, triple


def noise_vector(noise: WheelNoise) -> FloatArray:
    """(8,) the numbers of ``noise`` in the order that `integrate` reads them."""
    return np.array(
        [
            *(noise.longitudinal_m2_per_m, noise.longitudinal_m2_per_rad),
            *(noise.lateral_m2_per_m, noise.lateral_m2_per_rad),
            *(noise.yaw_rad2_per_m, noise.yaw_rad2_per_rad),
            *(noise.floor_m2_per_s, noise.floor_rad2_per_s),
        ]
    )


def preintegrate(
    model: MotionModel,
    dt: FloatArray,
    wheels: FloatArray,
    cg: FloatArray,
    params: FloatArray,
    noise: WheelNoise,
) -> Motion:
    """The motion over n intervals of constant wheel rates and constant CG.

    ``dt`` (n,) [s] lengths of the intervals; ``wheels`` (n, 2) [rad/s]; ``cg`` (n, 2) or (2,) [m]; ``params`` (k,). The error of
    the motion is a right perturbation, as everywhere; on each interval it follows e' = Ad(exp(-xi dt)) e + J_r(xi dt) d(xi) dt.
    """
    return integrate_twists(dt, model.twist(wheels, cg, params), noise_vector(noise))


def integrate_twists(dt: FloatArray, twist: Twist, noise: FloatArray) -> Motion:
    """`preintegrate` for given twists (n, 3) and ``noise`` (8,) of `noise_vector`."""
    k = twist.d_params.shape[-1]
    by = np.concatenate([twist.d_params, twist.d_cg], axis=-1)
    delta, cov, d = np.zeros(3), np.zeros((3, 3)), np.zeros((3, by.shape[-1]))
    integrate(np.ascontiguousarray(dt), twist.value, by, noise, delta, cov, d)
    return Motion(delta, cov, d[:, :k].copy(), d[:, k:].copy())


@kernel
def integrate(
    dt: FloatArray, twist: FloatArray, by: FloatArray, noise: FloatArray, delta: FloatArray, cov: FloatArray, d: FloatArray
) -> None:
    """Compose the intervals into ``delta`` (3,), ``cov`` (3, 3), ``d`` (3, m), which start at zero and are changed in place."""
    A, J, half = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(dt.shape[0]):
        h = dt[i]
        way = twist[i, 0] * h, twist[i, 1] * h, twist[i, 2] * h
        step = scalar_exp(way)
        fill_inverse_adjoint(step, A)
        fill_right_jacobian(way, J)
        for j in range(3):
            half[j, 0], half[j, 1], half[j, 2] = multiply_affine(A, (cov[0, j], cov[1, j], cov[2, j]))  # (A P)^T = P A^T
        for j in range(3):
            cov[0, j], cov[1, j], cov[2, j] = multiply_affine(A, (half[0, j], half[1, j], half[2, j]))  # A P A^T
        for j in range(by.shape[2]):
            before = multiply_affine(A, (d[0, j], d[1, j], d[2, j]))
            added = multiply_affine(J, (by[i, 0, j] * h, by[i, 1, j] * h, by[i, 2, j] * h))
            d[0, j], d[1, j], d[2, j] = before[0] + added[0], before[1] + added[1], before[2] + added[2]

        # Slip: variances that grow with the distance driven and the angle turned; none at standstill.
        driven, turned = math.hypot(way[0], way[1]), abs(way[2])
        if driven > 0.0 or turned > 0.0:
            floor_m, floor_rad = noise[6] * h, noise[7] * h
            cov[0, 0] += noise[0] * driven + noise[1] * turned + floor_m
            cov[1, 1] += noise[2] * driven + noise[3] * turned + floor_m
            cov[2, 2] += noise[4] * driven + noise[5] * turned + floor_rad

        delta[0], delta[1] = scalar_transform(triple(delta), step[0], step[1])
        delta[2] += step[2]  # not wrapped: it counts whole turns
