"""SE(2): the only home of this project's pose and tangent conventions.

A pose is ``[x, y, theta]``; a tangent vector is ``[x, y, theta]`` too, in that order, expressed in the body frame (metres,
radians). Perturbations act on the right: ``pose = compose(mean, exp(error))``. All functions take arrays of shape (..., 3),
broadcast over the leading axes and never change their input. Names of poses read ``world_T_body``; in
``compose(world_T_body, body_T_lidar)`` the inner names cancel.

Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix A. The functions with the
prefix ``scalar_`` are the same maths for compiled loops.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

# Below this angle the closed forms lose digits to cancellation and the series is exact to double precision.
_SMALL_ANGLE = 1e-4


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Angles brought into [-pi, pi), any shape [rad]."""
    a = np.asarray(angle, dtype=float)
    wrapped = (a + math.pi) % (2.0 * math.pi) - math.pi
    # rounding can carry an angle just below -pi up to +pi
    return np.where(wrapped >= math.pi, -math.pi, wrapped)


def _sinc_terms(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``sin(t)/t`` and ``(1 - cos(t))/t``, smooth through t = 0."""
    small = np.abs(theta) < _SMALL_ANGLE
    safe = np.where(small, 1.0, theta)
    t2 = theta * theta
    a = np.where(small, 1.0 - t2 / 6.0, np.sin(safe) / safe)
    # 1 - cos t is written 2 sin^2(t/2): it does not cancel
    b = np.where(small, theta * (0.5 - t2 / 24.0), 2.0 * np.sin(0.5 * safe) ** 2 / safe)
    return a, b


def exp(tangent: ArrayLike) -> FloatArray:
    """Pose (..., 3) reached by moving along the constant body-frame ``tangent`` (..., 3) for unit time (Solà, eq. 156).

    The angle is kept as given, not wrapped, so that turns of more than half a revolution survive ``exp``.
    """
    v = np.asarray(tangent, dtype=float)
    a, b = _sinc_terms(v[..., 2])
    return np.stack([a * v[..., 0] - b * v[..., 1], b * v[..., 0] + a * v[..., 1], v[..., 2]], axis=-1)


def log(pose: ArrayLike) -> FloatArray:
    """Tangent (..., 3) whose `exp` is ``pose`` (..., 3), with its angle in [-pi, pi) (Solà, eq. 158)."""
    p = np.asarray(pose, dtype=float)
    theta = wrap_angle(p[..., 2])
    a, b = _sinc_terms(theta)
    scale = 1.0 / (a * a + b * b)
    x = scale * (a * p[..., 0] + b * p[..., 1])
    y = scale * (a * p[..., 1] - b * p[..., 0])
    return np.stack([x, y, theta], axis=-1)


def compose(a_T_b: ArrayLike, b_T_c: ArrayLike) -> FloatArray:
    """``a_T_c`` (..., 3), with its angle wrapped to [-pi, pi)."""
    a, b = np.asarray(a_T_b, dtype=float), np.asarray(b_T_c, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack(
        [
            a[..., 0] + c * b[..., 0] - s * b[..., 1],
            a[..., 1] + s * b[..., 0] + c * b[..., 1],
            wrap_angle(a[..., 2] + b[..., 2]),
        ],
        axis=-1,
    )


def inverse(a_T_b: ArrayLike) -> FloatArray:
    """``b_T_a`` (..., 3)."""
    p = np.asarray(a_T_b, dtype=float)
    c, s = np.cos(p[..., 2]), np.sin(p[..., 2])
    x = -c * p[..., 0] - s * p[..., 1]
    y = s * p[..., 0] - c * p[..., 1]
    return np.stack([x, y, wrap_angle(-p[..., 2])], axis=-1)


def between(world_T_a: ArrayLike, world_T_b: ArrayLike) -> FloatArray:
    """``a_T_b`` (..., 3): where b is, seen from a."""
    return compose(inverse(world_T_a), world_T_b)


def transform(a_T_b: ArrayLike, points_b: ArrayLike) -> FloatArray:
    """Points (..., 2) of frame b in frame a."""
    p, q = np.asarray(a_T_b, dtype=float), np.asarray(points_b, dtype=float)
    c, s = np.cos(p[..., 2]), np.sin(p[..., 2])
    x = p[..., 0] + c * q[..., 0] - s * q[..., 1]
    y = p[..., 1] + s * q[..., 0] + c * q[..., 1]
    return np.stack([x, y], axis=-1)


def adjoint(pose: ArrayLike) -> FloatArray:
    """Matrix (..., 3, 3) with ``compose(pose, exp(t)) == compose(exp(Ad t), pose)`` (Solà, eq. 159)."""
    p = np.asarray(pose, dtype=float)
    c, s = np.cos(p[..., 2]), np.sin(p[..., 2])
    zero, one = np.zeros_like(c), np.ones_like(c)
    rows = [
        np.stack([c, -s, p[..., 1]], axis=-1),
        np.stack([s, c, -p[..., 0]], axis=-1),
        np.stack([zero, zero, one], axis=-1),
    ]
    return np.stack(rows, axis=-2)


def right_jacobian(tangent: ArrayLike) -> FloatArray:
    """Matrix J (..., 3, 3) with ``exp(t + d) = compose(exp(t), exp(J d))`` to first order in d (Solà, eq. 163)."""
    v = np.asarray(tangent, dtype=float)
    theta = v[..., 2]
    a, b = _sinc_terms(theta)
    small = np.abs(theta) < _SMALL_ANGLE
    safe = np.where(small, 1.0, theta)
    # (t - sin t)/t^2 and (1 - cos t)/t^2, smooth through zero
    f = np.where(small, theta / 6.0, (safe - np.sin(safe)) / (safe * safe))
    g = np.where(small, 0.5 - theta * theta / 24.0, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)
    zero, one = np.zeros_like(theta), np.ones_like(theta)
    rows = [
        np.stack([a, b, f * v[..., 0] - g * v[..., 1]], axis=-1),
        np.stack([-b, a, g * v[..., 0] + f * v[..., 1]], axis=-1),
        np.stack([zero, zero, one], axis=-1),
    ]
    return np.stack(rows, axis=-2)


def right_jacobian_inverse(tangent: ArrayLike) -> FloatArray:
    """Inverse of `right_jacobian`: ``log(compose(exp(t), exp(d))) = t + Jinv d`` to first order in d."""
    return np.asarray(np.linalg.inv(right_jacobian(tangent)), dtype=np.float64)


def interpolate(world_T_a: ArrayLike, world_T_b: ArrayLike, fraction: ArrayLike) -> FloatArray:
    """Pose at ``fraction`` (0 at a, 1 at b) of the constant-twist motion from a to b."""
    step = log(between(world_T_a, world_T_b))
    return compose(world_T_a, exp(step * np.asarray(fraction, dtype=float)[..., None]))


@numba.njit(cache=True)
def scalar_exp(vx: float, vy: float, wz: float) -> tuple[float, float, float]:  # pragma: no cover
    """`exp` of one tangent vector, for compiled loops."""
    if abs(wz) < 1e-4:
        a, b = 1.0 - wz * wz / 6.0, wz * (0.5 - wz * wz / 24.0)
    else:
        a, b = math.sin(wz) / wz, 2.0 * math.sin(0.5 * wz) ** 2 / wz
    return a * vx - b * vy, b * vx + a * vy, wz
