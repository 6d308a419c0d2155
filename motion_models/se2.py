"""SE(2): the only home of this project's pose and tangent conventions, and the shapes of arrays on public interfaces.

A pose is ``[x, y, theta]``; a tangent vector is ``[x, y, theta]`` too, in that order, expressed in the body frame (metres,
radians). Perturbations act on the right: ``pose = compose(mean, exp(error))``. All functions take arrays of shape (..., 3),
broadcast over the leading axes and never change their input. Names of poses read ``world_T_body``; in
``compose(world_T_body, body_T_lidar)`` the inner names cancel.

Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix A. The maths stands in compiled
functions of three numbers, for compiled loops (`scalar_exp`, `fill_adjoint` and so on), and these in generalised ufuncs (`_exp`), which
numpy broadcasts: a single pose costs a microsecond or two, as filters need.

Shapes (`Pose2`, `Cov3`): all arrays are float64; type checkers take them as `FloatArray`, readers as what they hold. Arrays of poses and
covariances have the same names where all leading axes are given in the docstring.

>>> quarter_turn = exp([0.0, 0.0, math.pi / 2])
>>> compose([1.0, 2.0, math.pi / 2], [1.0, 0.0, 0.0]).round(6).tolist()
[1.0, 3.0, 1.570796]
>>> log(between(quarter_turn, compose(quarter_turn, exp([0.1, 0.3, 0.2])))).round(6).tolist()
[0.1, 0.3, 0.2]
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motion_models.compiled import gufunc, subroutine

FloatArray = NDArray[np.float64]
"""Any shape; the docstring gives it."""
Pose2 = FloatArray
"""(3,) x, y, yaw [m, m, rad]: a pose or a motion of SE(2); its name reads ``world_T_body``."""
Twist2 = FloatArray
"""(3,) vx, vy, wz in the body frame [m/s, m/s, rad/s]."""
Tangent2 = FloatArray
"""(3,) of the Lie algebra se(2): a right perturbation or a residual [m, m, rad]."""
Cov3 = FloatArray
"""(3, 3) covariance of a `Tangent2` [m^2, m rad, rad^2]."""
Points2 = FloatArray
"""(N, 2) points of a plane [m]."""

Triple = tuple[float, float, float]
"""A pose or tangent in compiled loops."""

# Below this angle the closed forms lose digits to cancellation and the series is exact to double precision.
_SMALL_ANGLE = 1e-4


@subroutine
def triple(v: FloatArray) -> Triple:
    """``v`` (3,)"""
    return v[0], v[1], v[2]


@subroutine
def scalar_wrap(angle: float) -> float:
    """`wrap_angle` of one angle."""
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    # rounding can carry an angle just below -pi up to +pi
    return -math.pi if wrapped >= math.pi else wrapped


@subroutine
def _sinc_terms(theta: float) -> tuple[float, float]:
    """``sin(t)/t`` and ``(1 - cos(t))/t``, smooth through t = 0."""
    if abs(theta) < _SMALL_ANGLE:
        return 1.0 - theta * theta / 6.0, theta * (0.5 - theta * theta / 24.0)
    # 1 - cos t is written 2 sin^2(t/2): it does not cancel
    return math.sin(theta) / theta, 2.0 * math.sin(0.5 * theta) ** 2 / theta


@subroutine
def _curl_terms(theta: float, a: float, b: float) -> tuple[float, float]:
    """``(t - sin(t))/t^2`` and ``(1 - cos(t))/t^2``, smooth through t = 0, by ``a, b`` of `_sinc_terms`."""
    if abs(theta) < _SMALL_ANGLE:
        return theta / 6.0, 0.5 - theta * theta / 24.0
    return (1.0 - a) / theta, b / theta


@subroutine
def scalar_exp(v: Triple) -> Triple:
    """`exp` of one tangent vector, for compiled loops."""
    a, b = _sinc_terms(v[2])
    return a * v[0] - b * v[1], b * v[0] + a * v[1], v[2]


@subroutine
def scalar_log(p: Triple) -> Triple:
    """`log` of one pose."""
    x, y, theta = p[0], p[1], scalar_wrap(p[2])
    a, b = _sinc_terms(theta)
    scale = 1.0 / (a * a + b * b)
    return scale * (a * x + b * y), scale * (a * y - b * x), theta


@subroutine
def scalar_transform(p: Triple, x: float, y: float) -> tuple[float, float]:
    """`transform` of one point."""
    c, s = math.cos(p[2]), math.sin(p[2])
    return p[0] + c * x - s * y, p[1] + s * x + c * y


@subroutine
def scalar_compose(a: Triple, b: Triple) -> Triple:
    """`compose` of two poses."""
    x, y = scalar_transform(a, b[0], b[1])
    return x, y, scalar_wrap(a[2] + b[2])


@subroutine
def scalar_inverse(p: Triple) -> Triple:
    """`inverse` of one pose."""
    c, s = math.cos(p[2]), math.sin(p[2])
    return -c * p[0] - s * p[1], s * p[0] - c * p[1], scalar_wrap(-p[2])


@subroutine
def scalar_between(a: Triple, b: Triple) -> Triple:
    """`between` of two poses."""
    return scalar_compose(scalar_inverse(a), b)


@subroutine
def fill_adjoint(p: Triple, out: FloatArray) -> None:
    """`adjoint` of one pose into ``out`` (3, 3)."""
    c, s = math.cos(p[2]), math.sin(p[2])
    out[0, 0], out[0, 1], out[0, 2] = c, -s, p[1]
    out[1, 0], out[1, 1], out[1, 2] = s, c, -p[0]
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


@subroutine
def fill_inverse_adjoint(p: Triple, out: FloatArray) -> None:
    """`adjoint` of the inverse of one pose into ``out`` (3, 3)."""
    c, s = math.cos(p[2]), math.sin(p[2])
    out[0, 0], out[0, 1], out[0, 2] = c, s, s * p[0] - c * p[1]
    out[1, 0], out[1, 1], out[1, 2] = -s, c, c * p[0] + s * p[1]
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


@subroutine
def fill_right_jacobian(v: Triple, out: FloatArray) -> None:
    """`right_jacobian` of one tangent vector into ``out`` (3, 3)."""
    a, b = _sinc_terms(v[2])
    f, g = _curl_terms(v[2], a, b)
    out[0, 0], out[0, 1], out[0, 2] = a, b, f * v[0] - g * v[1]
    out[1, 0], out[1, 1], out[1, 2] = -b, a, g * v[0] + f * v[1]
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


@subroutine
def fill_right_jacobian_inverse(v: Triple, out: FloatArray) -> None:
    """`right_jacobian_inverse` of one tangent vector into ``out`` (3, 3)."""
    a, b = _sinc_terms(v[2])
    f, g = _curl_terms(v[2], a, b)
    p, q = f * v[0] - g * v[1], g * v[0] + f * v[1]
    scale = 1.0 / (a * a + b * b)
    c, s = scale * a, scale * b
    out[0, 0], out[0, 1], out[0, 2] = c, -s, s * q - c * p
    out[1, 0], out[1, 1], out[1, 2] = s, c, -s * p - c * q
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Angles brought into [-pi, pi), any shape [rad]."""
    a = np.asarray(angle, dtype=float)
    wrapped = (a + math.pi) % (2.0 * math.pi) - math.pi
    return np.where(wrapped >= math.pi, -math.pi, wrapped)


@gufunc("(n)->(n)")
def _exp(v: FloatArray, out: FloatArray) -> None:
    out[0], out[1], out[2] = scalar_exp(triple(v))


def exp(tangent: ArrayLike) -> FloatArray:
    """Pose (..., 3) reached by moving along the constant body-frame ``tangent`` (..., 3) for unit time (Solà, eq. 156).

    The angle is kept as given, not wrapped, so that turns of more than half a revolution survive ``exp``.
    """
    return np.asarray(_exp(tangent))


@gufunc("(n)->(n)")
def _log(p: FloatArray, out: FloatArray) -> None:
    out[0], out[1], out[2] = scalar_log(triple(p))


def log(pose: ArrayLike) -> FloatArray:
    """Tangent (..., 3) whose `exp` is ``pose`` (..., 3), with its angle in [-pi, pi) (Solà, eq. 157)."""
    return np.asarray(_log(pose))


@gufunc("(n),(n)->(n)")
def _compose(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    out[0], out[1], out[2] = scalar_compose(triple(a), triple(b))


def compose(a_T_b: ArrayLike, b_T_c: ArrayLike) -> FloatArray:
    """``a_T_c`` (..., 3), with its angle wrapped to [-pi, pi)."""
    return np.asarray(_compose(a_T_b, b_T_c))


@gufunc("(n)->(n)")
def _inverse(p: FloatArray, out: FloatArray) -> None:
    out[0], out[1], out[2] = scalar_inverse(triple(p))


def inverse(a_T_b: ArrayLike) -> FloatArray:
    """``b_T_a`` (..., 3)."""
    return np.asarray(_inverse(a_T_b))


@gufunc("(n),(n)->(n)")
def _between(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    out[0], out[1], out[2] = scalar_between(triple(a), triple(b))


def between(world_T_a: ArrayLike, world_T_b: ArrayLike) -> FloatArray:
    """``a_T_b`` (..., 3): pose of b relative to a."""
    return np.asarray(_between(world_T_a, world_T_b))


@gufunc("(n),(n)->(n)")
def _retract(p: FloatArray, v: FloatArray, out: FloatArray) -> None:
    out[0], out[1], out[2] = scalar_compose(triple(p), scalar_exp(triple(v)))


def retract(pose: ArrayLike, tangent: ArrayLike) -> FloatArray:
    """``pose`` (..., 3) moved by a perturbation on the right: ``compose(pose, exp(tangent))`` (Solà, eq. 25)."""
    return np.asarray(_retract(pose, tangent))


@gufunc("(n),(n)->(n)")
def _local(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    out[0], out[1], out[2] = scalar_log(scalar_between(triple(a), triple(b)))


def local(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Tangent (..., 3) that moves pose ``a`` to ``b``: ``log(between(a, b))``, the inverse of `retract` (Solà, eq. 26)."""
    return np.asarray(_local(a, b))


@gufunc("(n),(m)->(m)")
def _transform(p: FloatArray, q: FloatArray, out: FloatArray) -> None:
    out[0], out[1] = scalar_transform(triple(p), q[0], q[1])


def transform(a_T_b: ArrayLike, points_b: ArrayLike) -> FloatArray:
    """Points (..., 2) of frame b in frame a."""
    return np.asarray(_transform(a_T_b, points_b))


def align_points(points_b: Points2, points_a: Points2, weights: FloatArray | None = None) -> Pose2:
    """``a_T_b`` (3,) that brings points (N, 2) of frame b nearest to ``points_a`` (N, 2), by least squares with ``weights`` (N,).

    In closed form (Horn 1987; Umeyama 1991 without scale).
    """
    mean_b, mean_a = np.average(points_b, axis=0, weights=weights), np.average(points_a, axis=0, weights=weights)
    b, a = points_b - mean_b, points_a - mean_a
    if weights is not None:
        b = weights[:, None] * b
    yaw = math.atan2(float(np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0])), float(np.sum(a * b)))
    return np.array([*(mean_a - transform(np.array([0.0, 0.0, yaw]), mean_b)), yaw])


@gufunc("(n)->(n,n)")
def _adjoint(p: FloatArray, out: FloatArray) -> None:
    fill_adjoint(triple(p), out)


def adjoint(pose: ArrayLike) -> FloatArray:
    """Matrix (..., 3, 3) with ``compose(pose, exp(t)) == compose(exp(Ad t), pose)`` (Solà, eq. 159)."""
    return np.asarray(_adjoint(pose))


def rotation(yaw: ArrayLike) -> FloatArray:
    """(..., 2, 2) rotation by ``yaw`` [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def rotate_covariance(cov: FloatArray, yaw: float) -> Cov3:
    """(3, 3) covariance of x, y, yaw in other axes, of which those of ``cov`` (3, 3) are turned by ``yaw`` [rad]: by its heading, that of a
    right perturbation in the world's axes."""
    R = adjoint(np.array([0.0, 0.0, yaw]))
    return np.asarray(R @ cov @ R.T)


@gufunc("(n)->(n,n)")
def _right_jacobian(v: FloatArray, out: FloatArray) -> None:
    fill_right_jacobian(triple(v), out)


def right_jacobian(tangent: ArrayLike) -> FloatArray:
    """Matrix J (..., 3, 3) with ``exp(t + d) = compose(exp(t), exp(J d))`` to first order in d (Solà, eq. 163)."""
    return np.asarray(_right_jacobian(tangent))


@gufunc("(n)->(n,n)")
def _right_jacobian_inverse(v: FloatArray, out: FloatArray) -> None:
    fill_right_jacobian_inverse(triple(v), out)


def right_jacobian_inverse(tangent: ArrayLike) -> FloatArray:
    """Inverse of `right_jacobian`: ``log(compose(exp(t), exp(d))) = t + Jinv d`` to first order in d."""
    return np.asarray(_right_jacobian_inverse(tangent))


def interpolate(world_T_a: ArrayLike, world_T_b: ArrayLike, fraction: ArrayLike) -> FloatArray:
    """Pose at ``fraction`` (0 at a, 1 at b) of the constant-twist motion from a to b."""
    step = log(between(world_T_a, world_T_b))
    return compose(world_T_a, exp(step * np.asarray(fraction, dtype=float)[..., None]))
