"""SE(3): poses in space as homogeneous matrices (4, 4), tangent vectors as x, y, z, then the rotation vector, in the body frame [m, rad].

Perturbations act on the right: ``pose = mean @ exp(error)``. With the rotation's angle t and unit axis a, ``[.]`` its cross product:

    R = I + sin(t) [a] + (1 - cos(t)) [a]^2        V = I + (1 - cos(t)) / t [a] + (1 - sin(t) / t) [a]^2

Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, appendix D.
"""

from __future__ import annotations

import math

import numpy as np

from motion_models import se2
from motion_models.se2 import FloatArray, Pose2

Transform3 = FloatArray
"""(4, 4) homogeneous matrix of SE(3)."""
Tangent3 = FloatArray
"""(6,) x, y, z, rotation vector [m, rad]."""

_SMALL_ANGLE = 1e-4
"""Below this angle the series is exact to double precision [rad]."""


def cross(v: FloatArray) -> FloatArray:
    """(3, 3) matrix with cross(v) @ w = v x w."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def compose(a: Transform3, b: Transform3) -> Transform3:
    """The product a b."""
    return np.asarray(a @ b)


def inverse(a: Transform3) -> Transform3:
    """The pose with compose(a, inverse(a)) = identity."""
    out = np.eye(4)
    out[:3, :3] = a[:3, :3].T
    out[:3, 3] = -a[:3, :3].T @ a[:3, 3]
    return out


def lift(planar: Pose2) -> Transform3:
    """(4, 4) of a pose or motion ``planar`` (3,) in the plane."""
    x, y, yaw = planar.tolist()
    out = np.eye(4)
    out[:2, :2] = se2.rotation(yaw)
    out[0, 3], out[1, 3] = x, y
    return out


def rotation(v: FloatArray) -> FloatArray:
    """(3, 3) rotation by the rotation vector ``v`` (3,) [rad]."""
    first, second, _ = _series(float(np.sqrt(v @ v)))
    W = cross(v)
    return np.asarray(np.eye(3) + first * W + second * (W @ W))


def rotation_vector(R: FloatArray) -> FloatArray:
    """(3,) rotation vector of a rotation (3, 3) [rad], of a length below pi."""
    skew = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = float(np.sqrt(skew @ skew)), 0.5 * (float(np.trace(R)) - 1.0)
    angle = math.atan2(sine, cosine)
    if sine > _SMALL_ANGLE:
        return np.asarray(skew * (angle / sine))
    if cosine > 0.0:
        return np.asarray(skew * (1.0 + angle * angle / 6.0))
    squares = 0.5 * (np.diagonal(R) + 1.0)  # near a half turn: a a^T = (R + I) / 2
    k = int(np.argmax(squares))
    axis = 0.5 * (R[:, k] + np.eye(3)[k]) / math.sqrt(squares[k])
    return np.asarray(axis * (angle if axis @ skew >= 0.0 else -angle))


def exp(tangent: Tangent3) -> Transform3:
    """Pose of a tangent vector (6,)."""
    v = tangent[3:]
    first, second, third = _series(float(np.sqrt(v @ v)))
    W = cross(v)
    out = np.eye(4)
    out[:3, :3] += first * W + second * (W @ W)
    out[:3, 3] = (np.eye(3) + second * W + third * (W @ W)) @ tangent[:3]
    return out


def log(a: Transform3) -> Tangent3:
    """Tangent vector (6,) of a pose; its rotation is below pi."""
    v = rotation_vector(a[:3, :3])
    _, second, third = _series(float(np.sqrt(v @ v)))
    W = cross(v)
    return np.concatenate([np.linalg.solve(np.eye(3) + second * W + third * (W @ W), a[:3, 3]), v])


def retract(a: Transform3, tangent: Tangent3) -> Transform3:
    """``a`` moved by a perturbation (6,) on the right: a exp(tangent)."""
    return compose(a, exp(tangent))


def local(a: Transform3, b: Transform3) -> Tangent3:
    """Tangent (6,) that moves ``a`` to ``b``: log(a^-1 b)."""
    return log(compose(inverse(a), b))


def adjoint(a: Transform3) -> FloatArray:
    """(6, 6) with a exp(t) = exp(adjoint(a) t) a."""
    R = a[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = cross(a[:3, 3]) @ R
    return out


def transform(a: Transform3, points: FloatArray) -> FloatArray:
    """(N, 3) ``points`` (N, 3) moved by the pose."""
    return np.asarray(points @ a[:3, :3].T + a[:3, 3])


def _series(angle: float) -> tuple[float, float, float]:
    """sin(t) / t, (1 - cos(t)) / t^2 and (t - sin(t)) / t^3."""
    square = angle * angle
    if angle < _SMALL_ANGLE:
        return 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    sine = math.sin(angle) / angle
    return sine, (1.0 - math.cos(angle)) / square, (1.0 - sine) / square
