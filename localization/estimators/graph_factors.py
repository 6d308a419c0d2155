"""The factors between neighbouring nodes as one table, and their rows of Gauss-Newton's linear system, all nodes at once.

A node is a pose and m slow states, n = 3 + m numbers. Between a node a and the next one b stand the link (`graph_link`), what it says of
the slow states, their random walk, and the LiDAR's motion. The table is all that every back end needs, and `residuals` is the same
for the filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from localization.errors import EstimatorError
from localization.estimators.graph_link import Link
from localization.estimators.graph_qr import inverse_root
from localization.residuals import motion_residual, position_residual
from motion_models import se2
from motion_models.base import Motion
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Pairs:
    """Factors of N pairs of nodes (a, b). Whitening matrices W have W^T W = inverse covariance."""

    delta: FloatArray
    """(N, 3) motion by the link at the slow states ``at``."""
    white: FloatArray
    """(N, 3, 3)"""
    d_slow: FloatArray
    """(N, 3, m)"""
    at: FloatArray
    """(N, m)"""
    rows: FloatArray
    """(N, m, m) and ``rhs`` (N, m): rows of unit variance about the slow states of a."""
    rhs: FloatArray
    walk: FloatArray
    """(N, m, m) whitening of the random walk from a to b."""
    seen: FloatArray
    """(N, 3) motion by the LiDAR."""
    seen_white: FloatArray
    """(N, 3, 3), zero where it saw nothing."""
    mount: FloatArray
    """(N, 3, m): the LiDAR's mount is off by ``exp(mount @ slow)`` in the body frame, where this motion shows it."""

    @classmethod
    def one(cls, link: Link, walk: FloatArray) -> Self:
        """The table of a single pair, without a LiDAR."""
        rows, rhs = link.compressed()
        none = np.zeros(3), np.zeros((3, 3)), np.zeros_like(link.d_slow)
        columns = (link.delta, whitening(link.cov), link.d_slow, link.at, rows, rhs, walk, *none)
        return cls(*(np.asarray(column)[None] for column in columns))

    def seeing(self, motion: Motion, mount: FloatArray | None = None) -> Pairs:
        """The single pair, with the motion that the LiDAR saw, and what of its ``mount`` (3, m) that shows."""
        seen = replace(self, seen=motion.delta[None], seen_white=whitening(motion.cov)[None])
        return seen if mount is None else replace(seen, mount=mount[None])

    def __len__(self) -> int:
        return len(self.delta)

    def __getitem__(self, part: slice) -> Pairs:
        return Pairs(*(getattr(self, f.name)[part] for f in fields(self)))

    def put(self, index: int, pair: Pairs) -> None:
        """Write the single ``pair`` into row ``index``."""
        for f in fields(self):
            getattr(self, f.name)[index] = getattr(pair, f.name)[0]

    def resized(self, size: int) -> Pairs:
        """A copy with room for ``size`` pairs."""
        columns = []
        for f in fields(self):
            old = getattr(self, f.name)
            new = np.zeros((size, *old.shape[1:]))
            new[: min(size, len(old))] = old[:size]
            columns.append(new)
        return Pairs(*columns)


def whitening(cov: FloatArray) -> FloatArray:
    """W (n, n), lower triangular, with W^T W = ``cov``^-1 (n, n). Raises `EstimatorError` if that is not positive definite."""
    W = inverse_root(cov)
    if math.isnan(W[0, 0]):
        raise EstimatorError(f"a covariance is not positive definite: {cov.tolist()}.")
    return np.asarray(W)


def linearize(pairs: Pairs, poses: FloatArray, slow: FloatArray) -> FloatArray:
    """Rows (N, 6 + 2m, 2n + 1) of the system ``J (change of a, change of b) = rhs`` in unit variances, the last column its right side.

    ``poses`` (N + 1, 3) and ``slow`` (N + 1, m) are those of all nodes in order; changes of poses act on the right.
    """
    m = slow.shape[-1]
    n, count = 3 + m, len(pairs)
    pose_a, pose_b, slow_a, slow_b = poses[:-1], poses[1:], slow[:-1], slow[1:]
    J = np.zeros((count, 6 + 2 * m, 2 * n + 1))
    off = slow_a - pairs.at

    shift = (pairs.d_slow @ off[..., None])[..., 0]
    error, d_a, d_b = motion_residual(pose_a, pose_b, se2.compose(pairs.delta, se2.exp(shift)))
    d_slow = -se2.right_jacobian_inverse(-error) @ se2.right_jacobian(shift) @ pairs.d_slow
    J[:, 0:3, 0:3] = pairs.white @ d_a
    J[:, 0:3, 3:n] = pairs.white @ d_slow
    J[:, 0:3, n : n + 3] = pairs.white @ d_b
    J[:, 0:3, -1] = -(pairs.white @ error[..., None])[..., 0]

    J[:, 3:n, 3:n] = pairs.rows
    J[:, 3:n, -1] = pairs.rhs - (pairs.rows @ off[..., None])[..., 0]

    J[:, n : n + m, 3:n] = -pairs.walk
    J[:, n : n + m, n + 3 : 2 * n] = pairs.walk
    J[:, n : n + m, -1] = (pairs.walk @ (slow_a - slow_b)[..., None])[..., 0]

    if pairs.seen_white.any():
        J[:, n + m :] = linearize_seen(pairs, pose_a, pose_b, slow_a)
    return J


def linearize_seen(pairs: Pairs, pose_a: FloatArray, pose_b: FloatArray, slow_a: FloatArray) -> FloatArray:
    """The last three rows (N, 3, 2n + 1) of `linearize`, the LiDAR's."""
    n = 3 + slow_a.shape[-1]
    J = np.zeros((len(pairs), 3, 2 * n + 1))
    if pairs.mount.any():
        error, d_a, d_b, d_mount = seen_residual(pose_a, pose_b, pairs.seen, (pairs.mount @ slow_a[..., None])[..., 0])
        J[:, :, 3:n] = pairs.seen_white @ d_mount @ pairs.mount
    else:
        error, d_a, d_b = motion_residual(pose_a, pose_b, pairs.seen)
    J[:, :, 0:3] = pairs.seen_white @ d_a
    J[:, :, n : n + 3] = pairs.seen_white @ d_b
    J[:, :, -1] = -(pairs.seen_white @ error[..., None])[..., 0]
    return J


def seen_residual(
    world_T_a: FloatArray, world_T_b: FloatArray, seen: FloatArray, mount: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """`motion_residual` for a LiDAR that sits ``exp(mount)`` (3,) off where it is believed to sit, and its Jacobian by ``mount`` too.

    Points are brought into the body by the believed mount, so what it measures is the motion of that frame, C^-1 (a^-1 b) C.
    """
    body_T_believed = se2.exp(mount)
    error, d_a, d_b = motion_residual(se2.compose(world_T_a, body_T_believed), se2.compose(world_T_b, body_T_believed), seen)
    A = se2.adjoint(se2.inverse(body_T_believed))
    return error, d_a @ A, d_b @ A, (d_a + d_b) @ se2.right_jacobian(mount)


@dataclass(frozen=True)
class Kernel:
    """How much of a residual counts that is far off: its rows are scaled by the root of the kernel's weight."""

    name: str = "cauchy"
    """none, huber (its pull is bounded) or cauchy (its pull fades: one wild closure moves next to nothing)."""
    scale: float = 3.0
    """From here on [sigmas]."""

    def weight(self, size: float) -> float:
        """Root of the weight of a residual whose whitened norm is ``size``."""
        far = size / self.scale
        if self.name == "huber":
            return far**-0.5 if far > 1.0 else 1.0
        return float((1.0 + far**2) ** -0.5) if self.name == "cauchy" else 1.0

    def cost(self, size: float) -> float:
        """Twice what such a residual costs: what `weight` is the derivative of."""
        far = size / self.scale
        if self.name == "huber" and far > 1.0:
            return self.scale**2 * (2.0 * far - 1.0)
        return self.scale**2 * math.log1p(far**2) if self.name == "cauchy" else size**2


@dataclass(frozen=True)
class Position:
    """A measured position of a point of the body, as by GPS."""

    xy: FloatArray
    """(2,) in the estimator's world [m]."""
    white: FloatArray
    """(2, 2)"""
    lever: FloatArray
    """(2,) the point in the body frame of its node [m]."""

    def linearize(self, pose: FloatArray, kernel: Kernel) -> FloatArray:
        """(2, 4): rows about the pose of its node, and the right side."""
        error, d_pose = position_residual(pose, self.lever, self.xy)
        whitened = self.white @ error
        weight = kernel.weight(float(np.linalg.norm(whitened)))
        return np.asarray(weight * np.column_stack([self.white @ d_pose, -whitened]))

    def cost(self, pose: FloatArray, kernel: Kernel) -> float:
        """Twice what it costs to be at ``pose`` (3,)."""
        return kernel.cost(float(np.linalg.norm(self.white @ position_residual(pose, self.lever, self.xy)[0])))


@dataclass(frozen=True)
class Closure:
    """A motion between two nodes that are no neighbours: a place seen again."""

    a: int
    b: int
    delta: FloatArray
    """(3,)"""
    white: FloatArray
    """(3, 3)"""

    def linearize(self, poses: FloatArray, kernel: Kernel) -> FloatArray:
        """(3, 7): rows about the poses of a and b, and the right side."""
        error, d_a, d_b = motion_residual(poses[self.a], poses[self.b], self.delta)
        whitened = self.white @ error
        weight = kernel.weight(float(np.linalg.norm(whitened)))
        return np.asarray(weight * np.column_stack([self.white @ d_a, self.white @ d_b, -whitened]))

    def cost(self, poses: FloatArray, kernel: Kernel) -> float:
        """Twice what it costs that a and b are where they are."""
        return kernel.cost(float(np.linalg.norm(self.white @ motion_residual(poses[self.a], poses[self.b], self.delta)[0])))
