"""One node after the other: what is known of the newest, and of the one that a motion leads to. Compiled scalar loops."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numba
import numpy as np

from localization.errors import EstimatorError
from localization.estimators.graph_factors import Pairs, linearize, seen_residual, seen_rows, whitening
from localization.estimators.graph_link import Link
from localization.estimators.graph_qr import (
    add_product,
    add_spread,
    add_square,
    apply,
    eliminate,
    inverse_of_upper,
    inverse_root,
    is_regular,
    product,
    substitute,
    triangularize,
)
from localization.residuals import fill_motion_residual
from motion_models import se2
from motion_models.base import Motion
from motion_models.se2 import FloatArray, triple


class SingularError(EstimatorError):
    """A system whose solution is not determined, or not finite."""


@dataclass(frozen=True)
class Node:
    """What is known of one node: a mean, and the square root of the information about it."""

    pose: FloatArray
    """(3,)"""
    slow: FloatArray
    """(m,)"""
    root: FloatArray
    """(n, n) R, upper triangular, with R^T R = covariance^-1, for right perturbations of the pose and for the slow states."""

    @classmethod
    def known(cls, pose: FloatArray, slow: FloatArray, cov: FloatArray) -> Self:
        """With the covariance ``cov`` (n, n). Raises `EstimatorError` if that is not positive definite."""
        root = whitening(cov)
        triangularize(root, len(root))
        return cls(pose, slow, root)

    @cached_property
    def covariance(self) -> FloatArray:
        """(n, n)"""
        return np.asarray(covariance_of(self.root))


@dataclass(frozen=True)
class Ahead:
    """A node that could be added, its predecessor with it."""

    node: Node
    pair: Pairs
    conditional: FloatArray
    """(n, 2n + 1): the predecessor, given this node."""

    def motion_covariance(self, before: Node) -> FloatArray:
        """(3, 3) of the motion from the predecessor, which is at ``before`` now, to this node."""
        return np.asarray(_motion_covariance(before.pose, self.node.pose, self.node.root, self.conditional))


def extend(node: Node, pair: Pairs) -> Ahead:
    """The node that ``pair`` leads to from ``node``. Raises `SingularError`."""
    n, delta, shift = len(node.root), pair.delta[0], pair.d_slow[0] @ (node.slow - pair.at[0])
    poses, slow = np.empty((2, 3)), np.empty((2, n - 3))
    poses[0], slow[0], slow[1] = node.pose, node.slow, node.slow
    poses[1] = se2.compose(node.pose, se2.compose(delta, se2.exp(shift)))
    roots, conditionals = np.zeros((2, n, n + 1)), np.empty((1, n, 2 * n + 1))
    roots[0, :, :n] = node.root
    eliminate(roots, conditionals, linearize(pair, poses, slow), np.empty((2, 0, 4)))
    return _ahead(pair, poses[1], slow[1], roots[1], conditionals)


def see(node: Node, ahead: Ahead, motion: Motion, mount: FloatArray | None = None) -> Ahead:
    """What is ``ahead`` of ``node``, with the motion that a LiDAR saw on the way, and what of its ``mount`` (3, m) shows.

    Raises `SingularError`.
    """
    n, there, pair = len(node.root), ahead.node, ahead.pair.seeing(motion, mount)
    work = np.zeros((2 * n + 3, 2 * n + 1))
    work[:n], work[n : 2 * n, n : 2 * n] = ahead.conditional, there.root
    seen_rows(pair.table[0], node.pose, node.slow, there.pose, work[2 * n :])
    triangularize(work, 2 * n)
    return _ahead(pair, there.pose.copy(), there.slow.copy(), work[n : 2 * n, n:].copy(), work[None, :n].copy())


def _ahead(pair: Pairs, pose: FloatArray, slow: FloatArray, root: FloatArray, conditionals: FloatArray) -> Ahead:
    """The node that was linearised at ``pose`` and ``slow``, where its ``root`` (n, n + 1) says that it is."""
    change = np.empty((2, len(root)))
    if not (is_regular(root) and substitute(root, conditionals, change)):
        raise SingularError("the motion to a new node is not determined by what was measured.")
    move_newest(pose, slow, root, conditionals[0], change[1])
    return Ahead(Node(pose, slow, root[:, :-1].copy()), pair, conditionals[0])


def innovation(node: Node, ahead: Ahead, link: Link, motion: Motion, mount: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """How far the ``motion`` that a LiDAR saw is off the way by ``link`` from ``node`` to what is ``ahead``: (3,), its covariance (3, 3),
    and normalised.

    Squared and normalised it is NaN where there is no such number. ``mount`` (3, m): what of the LiDAR's mount shows.
    """
    there, error, cov = ahead.node, np.empty(3), np.zeros((3, 3))
    slow_cov = np.ascontiguousarray(there.covariance[3:, 3:])
    nis = _innovation(node.pose, there.pose, there.slow, slow_cov, link.cov, link.d_slow, motion.delta, motion.cov, mount, error, cov)
    return error, cov, nis


@numba.njit(cache=True)
def move_newest(pose: FloatArray, slow: FloatArray, root: FloatArray, before: FloatArray, change: FloatArray) -> None:  # pragma: no cover
    """Move a node by its ``change`` (n,), and expand its ``root`` (n, n + 1) and the conditional ``before`` it (n, 2n + 1) there."""
    n = change.shape[0]
    expand_anew(root, 0, change)
    expand_anew(before, n, change)
    pose[0], pose[1], pose[2] = se2.scalar_compose(triple(pose), se2.scalar_exp(triple(change)))
    for k in range(n - 3):
        slow[k] += change[3 + k]


@numba.njit(cache=True)
def expand_anew(rows: FloatArray, at: int, change: FloatArray) -> None:  # pragma: no cover
    """Expand ``rows`` (r, c + 1) about a node whose columns begin at ``at`` anew, where ``change`` (n,) has moved it."""
    J = np.empty((3, 3))
    se2.fill_right_jacobian_inverse(triple(change), J)
    for i in range(rows.shape[0]):
        for k in range(change.shape[0]):
            rows[i, -1] -= rows[i, at + k] * change[k]
        x, y, t = rows[i, at], rows[i, at + 1], rows[i, at + 2]
        for k in range(3):
            rows[i, at + k] = x * J[0, k] + y * J[1, k] + t * J[2, k]


@numba.njit(cache=True)
def covariance_of(root: FloatArray) -> FloatArray:  # pragma: no cover
    """(n, n) ``(root^T root)^-1``."""
    found = np.zeros(root.shape)
    add_square(found, inverse_of_upper(root))
    return found


@numba.njit(cache=True)
def _motion_covariance(pose_a: FloatArray, pose_b: FloatArray, root: FloatArray, conditional: FloatArray) -> FloatArray:  # pragma: no cover
    n = root.shape[0]
    d_a, d_b, found = np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    a, b = triple(pose_a), triple(pose_b)
    fill_motion_residual(a, b, se2.scalar_between(a, b), d_a, d_b)
    # the predecessor is off by what it is off itself, and by what the node is
    own = product(d_a, inverse_of_upper(conditional)[:3])
    by_node = product(own, conditional[:, n : 2 * n])
    for i in range(3):
        for j in range(n):
            by_node[i, j] = (d_b[i, j] if j < 3 else 0.0) - by_node[i, j]
    add_square(found, own)
    add_square(found, product(by_node, inverse_of_upper(root)))
    return found


@numba.njit(cache=True)
def _innovation(
    pose_a: FloatArray,
    pose_b: FloatArray,
    slow: FloatArray,
    slow_cov: FloatArray,
    link_cov: FloatArray,
    d_slow: FloatArray,
    seen: FloatArray,
    seen_cov: FloatArray,
    mount: FloatArray,
    error: FloatArray,
    S: FloatArray,
) -> float:  # pragma: no cover
    """Fill ``error`` (3,) and its covariance ``S`` (3, 3), zero before; ``slow`` (m,) and ``slow_cov`` (m, m) are those of node b."""
    d_a, d_b, d_mount, d_seen = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    off = seen_residual(triple(pose_a), triple(pose_b), triple(seen), apply(mount, slow), d_a, d_b, d_mount)
    error[0], error[1], error[2] = off
    se2.fill_right_jacobian_inverse(off, d_seen)
    by_slow = product(d_b, d_slow)
    add_product(by_slow, d_mount, mount)
    add_spread(S, d_b, link_cov)
    add_spread(S, by_slow, slow_cov)
    add_spread(S, d_seen, seen_cov)
    x, y, t = apply(inverse_root(S), error)
    nis = x * x + y * y + t * t
    is_number = math.isfinite(S[0, 0] + S[1, 1] + S[2, 2]) and math.isfinite(nis)
    return nis if is_number else math.nan
