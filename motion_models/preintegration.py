"""Preintegration: many wheel samples become one `Motion`, for any model, in compiled code.

The model gives twists and their derivatives for all samples at once; what follows (composition on SE(2), growth of the covariance,
propagation of the derivatives) is the same for every model and is written once, here.
"""

from __future__ import annotations

import math

import numpy as np

from motion_models.base import Motion, MotionModel, Twist
from motion_models.compiled import kernel
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray, scalar_exp


def noise_vector(noise: WheelNoise) -> FloatArray:
    """(8,) the numbers of ``noise`` in the order that `_integrate` reads them."""
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
    return integrate_twists(dt, model.twist(wheels, cg, params), noise)


def integrate_twists(dt: FloatArray, twist: Twist, noise: WheelNoise) -> Motion:
    """`preintegrate` for given twists (n, 3)."""
    k = twist.d_params.shape[-1]
    by = np.concatenate([twist.d_params, twist.d_cg], axis=-1)
    delta, cov, d = np.zeros(3), np.zeros((3, 3)), np.zeros((3, by.shape[-1]))
    _integrate(np.ascontiguousarray(dt), twist.value, by, noise_vector(noise), delta, cov, d)
    return Motion(delta, cov, d[:, :k], d[:, k:])


@kernel
def _integrate(
    dt: FloatArray, twist: FloatArray, by: FloatArray, noise: FloatArray, delta: FloatArray, cov: FloatArray, d: FloatArray
) -> None:
    """Compose the intervals into ``delta`` (3,), ``cov`` (3, 3), ``d`` (3, m), which start at zero and are changed in place."""
    m = by.shape[2]
    moved = np.empty((3, 3))
    for i in range(dt.shape[0]):
        h = dt[i]
        vx, vy, wz = twist[i, 0] * h, twist[i, 1] * h, twist[i, 2] * h
        x, y, t = scalar_exp((vx, vy, wz))

        # Adjoint of the inverse step: [[c, s, a], [-s, c, b], [0, 0, 1]]
        c, s = math.cos(t), math.sin(t)
        a, b = s * x - c * y, c * x + s * y
        for j in range(3):
            moved[0, j] = c * cov[0, j] + s * cov[1, j] + a * cov[2, j]
            moved[1, j] = -s * cov[0, j] + c * cov[1, j] + b * cov[2, j]
            moved[2, j] = cov[2, j]
        for j in range(3):
            cov[j, 0] = c * moved[j, 0] + s * moved[j, 1] + a * moved[j, 2]
            cov[j, 1] = -s * moved[j, 0] + c * moved[j, 1] + b * moved[j, 2]
            cov[j, 2] = moved[j, 2]

        # Right Jacobian of the step (see se2.right_jacobian)
        if abs(wz) < 1e-4:
            ja, jb, jf, jg = 1.0 - wz * wz / 6.0, wz * (0.5 - wz * wz / 24.0), wz / 6.0, 0.5 - wz * wz / 24.0
        else:
            ja, jb, jf = s / wz, 2.0 * math.sin(0.5 * wz) ** 2 / wz, (wz - s) / (wz * wz)
            jg = jb / wz
        jx, jy = jf * vx - jg * vy, jg * vx + jf * vy
        for j in range(m):
            d0, d1, d2 = d[0, j], d[1, j], d[2, j]
            e0, e1, e2 = by[i, 0, j] * h, by[i, 1, j] * h, by[i, 2, j] * h
            d[0, j] = c * d0 + s * d1 + a * d2 + ja * e0 + jb * e1 + jx * e2
            d[1, j] = -s * d0 + c * d1 + b * d2 - jb * e0 + ja * e1 + jy * e2
            d[2, j] = d2 + e2

        # Slip: variances that grow with what was driven and turned; nothing while standing still.
        driven, turned = math.hypot(vx, vy), abs(wz)
        if driven > 0.0 or turned > 0.0:
            floor_m, floor_rad = noise[6] * h, noise[7] * h
            cov[0, 0] += noise[0] * driven + noise[1] * turned + floor_m
            cov[1, 1] += noise[2] * driven + noise[3] * turned + floor_m
            cov[2, 2] += noise[4] * driven + noise[5] * turned + floor_rad

        x0, y0, t0 = delta[0], delta[1], delta[2]
        c0, s0 = math.cos(t0), math.sin(t0)
        delta[0] = x0 + c0 * x - s0 * y
        delta[1] = y0 + s0 * x + c0 * y
        delta[2] = t0 + t
