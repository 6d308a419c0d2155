"""One node after the other: what is known of the newest, and of the one that a motion leads to. Compiled scalar loops."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numba
import numpy as np

from localization.errors import EstimatorError
from localization.estimators.graph_factors import Pairs, apply, linearize_pair, linearize_seen, link_at, seen_residual, whitening
from localization.estimators.graph_link import Link
from localization.estimators.graph_qr import (
    add_product,
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
from motion_models.se2 import FloatArray, Triple

Found = tuple[bool, FloatArray, FloatArray, FloatArray, FloatArray]
"""Whether a node is sound, its pose, slow states and root, and its predecessor's conditional."""


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
    return _ahead(pair, *_extend(pair.table[0], node.pose, node.slow, node.root))


def see(node: Node, ahead: Ahead, motion: Motion, mount: FloatArray | None = None) -> Ahead:
    """What is ``ahead`` of ``node``, with the motion that a LiDAR saw on the way, and what of its ``mount`` (3, m) shows.

    Raises `SingularError`."""
    pair, there = ahead.pair.seeing(motion, mount), ahead.node
    return _ahead(pair, *_see(pair.table[0], node.pose, node.slow, there.pose, there.slow, there.root, ahead.conditional))


def innovation(node: Node, ahead: Ahead, link: Link, motion: Motion, mount: FloatArray) -> tuple[FloatArray, float]:
    """How far the ``motion`` that a LiDAR saw is off the way by ``link`` from ``node`` to what is ``ahead``: (3,), and normalised.

    Squared and normalised it is NaN where there is no such number. ``mount`` (3, m): what of the LiDAR's mount shows.
    """
    there = ahead.node
    error, nis = _innovation(node.pose, there.pose, there.slow, there.covariance, link.cov, link.d_slow, motion.delta, motion.cov, mount)
    return np.array(error), nis


def _ahead(pair: Pairs, is_sound: bool, pose: FloatArray, slow: FloatArray, root: FloatArray, conditional: FloatArray) -> Ahead:
    if not is_sound:
        raise SingularError("the motion to a new node is not determined by what was measured.")
    return Ahead(Node(pose, slow, root), pair, conditional)


@numba.njit(cache=True)
def _extend(pair: FloatArray, pose: FloatArray, slow: FloatArray, root: FloatArray) -> Found:  # pragma: no cover
    m = slow.shape[0]
    n = 3 + m
    rows = np.empty((1, 6 + 2 * m, 2 * n + 1))
    roots, conditionals = np.zeros((2, n, n + 1)), np.empty((1, n, 2 * n + 1))
    predicted: FloatArray = np.array(se2.scalar_compose(pose, link_at(pair, slow)[0]))
    linearize_pair(pair, pose, slow, predicted, slow, rows[0])
    roots[0, :, :n] = root
    eliminate(roots, conditionals, rows, np.empty((2, 0, 4)))
    return _settled(predicted, slow, roots[1], conditionals)


@numba.njit(cache=True)
def _see(
    pair: FloatArray,
    pose_a: FloatArray,
    slow_a: FloatArray,
    pose_b: FloatArray,
    slow_b: FloatArray,
    root: FloatArray,
    conditional: FloatArray,
) -> Found:  # pragma: no cover
    n = root.shape[0]
    work = np.zeros((2 * n + 3, 2 * n + 1))
    work[:n], work[n : 2 * n, n : 2 * n] = conditional, root
    linearize_seen(pair, pose_a, slow_a, pose_b, work[2 * n :])
    triangularize(work, 2 * n)
    return _settled(pose_b, slow_b, work[n : 2 * n, n:].copy(), work[:n].copy().reshape(1, n, 2 * n + 1))


@numba.njit(cache=True)
def _settled(pose: FloatArray, slow: FloatArray, root: FloatArray, conditionals: FloatArray) -> Found:  # pragma: no cover
    """The node that was linearised at ``pose`` and ``slow``, moved to where its ``root`` (n, n + 1) says that it is."""
    n = root.shape[0]
    change = np.empty((2, n))
    is_sound = is_regular(root) and substitute(root, conditionals, change)
    moved = change[1]
    if is_sound:
        expand_anew(root, 0, moved)
        expand_anew(conditionals[0], n, moved)
    there: FloatArray = np.array(se2.scalar_compose(pose, se2.scalar_exp(moved)))
    return is_sound, there, slow + moved[3:], root[:, :n].copy(), conditionals[0]


@numba.njit(cache=True)
def expand_anew(rows: FloatArray, at: int, change: FloatArray) -> None:  # pragma: no cover
    """Expand ``rows`` (r, c + 1) about a node whose columns begin at ``at`` anew, where ``change`` (n,) has moved it."""
    J = np.empty((3, 3))
    se2.fill_right_jacobian_inverse(change, J)
    for i in range(rows.shape[0]):
        for k in range(change.shape[0]):
            rows[i, -1] -= rows[i, at + k] * change[k]
        x, y, t = rows[i, at], rows[i, at + 1], rows[i, at + 2]
        for k in range(3):
            rows[i, at + k] = x * J[0, k] + y * J[1, k] + t * J[2, k]


@numba.njit(cache=True)
def covariance_of(root: FloatArray) -> FloatArray:  # pragma: no cover
    """(n, n) ``(root^T root)^-1``."""
    inverse = inverse_of_upper(root)
    return product(inverse, inverse.T)


@numba.njit(cache=True)
def _motion_covariance(pose_a: FloatArray, pose_b: FloatArray, root: FloatArray, conditional: FloatArray) -> FloatArray:  # pragma: no cover
    n = root.shape[0]
    d_a, d_b = np.empty((3, 3)), np.empty((3, 3))
    fill_motion_residual(pose_a, pose_b, se2.scalar_between(pose_a, pose_b), d_a, d_b)
    # the predecessor is off by what it is off itself, and by what the node is
    own = product(d_a, inverse_of_upper(conditional)[:3])
    by_node = -product(own, conditional[:, n : 2 * n])
    by_node[:, :3] += d_b
    by_node = product(by_node, inverse_of_upper(root))
    return product(own, own.T) + product(by_node, by_node.T)


@numba.njit(cache=True)
def _innovation(
    pose_a: FloatArray,
    pose_b: FloatArray,
    slow: FloatArray,
    cov: FloatArray,
    link_cov: FloatArray,
    d_slow: FloatArray,
    seen: FloatArray,
    seen_cov: FloatArray,
    mount: FloatArray,
) -> tuple[Triple, float]:  # pragma: no cover
    """``cov`` (n, n) of node b, whose ``slow`` states (m,) are."""
    d_a, d_b, d_mount, d_seen = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    error = seen_residual(pose_a, pose_b, seen, apply(mount, slow), d_a, d_b, d_mount)
    se2.fill_right_jacobian_inverse(error, d_seen)
    by_slow = product(d_b, d_slow)
    add_product(by_slow, 1.0, d_mount, mount)
    S = product(product(d_b, link_cov), d_b.T)
    add_product(S, 1.0, product(by_slow, cov[3:, 3:]), by_slow.T)
    add_product(S, 1.0, product(d_seen, seen_cov), d_seen.T)
    normalized = apply(inverse_root(S), np.array(error))
    nis = normalized[0] ** 2 + normalized[1] ** 2 + normalized[2] ** 2
    return error, nis if math.isfinite(S.sum()) and math.isfinite(nis) else math.nan
