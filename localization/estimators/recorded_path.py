"""The filter's path through the keyframes of a graph, which smoothing bends to where the graph has these."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from localization.trajectory import IntArray
from motion_models.groups import Group, between
from motion_models.se2 import FloatArray


class RecordedPath:
    """Elements of ``group`` at all steps, and which of them are nodes: keyframes of a graph. Memory grows with the drive, by 104 bytes a
    step of SE(2) and 424 of SE(3)."""

    def __init__(self, group: Group) -> None:
        self._group = group
        self._stamps_ns, self._nodes = array("q"), array("q")
        self._poses, self._covs_since = array("d"), array("d")

    def add(self, stamp_ns: int, pose: FloatArray, cov_since: FloatArray) -> None:
        """The filter's ``pose`` at the end of a step, with the covariance (dim, dim) of the motion since the last node. A step of no
        duration changes nothing."""
        if not self._stamps_ns or stamp_ns > self._stamps_ns[-1]:
            self._stamps_ns.append(stamp_ns)
            self._poses.extend(pose.ravel())
            self._covs_since.extend(cov_since.ravel())

    def add_node(self) -> None:
        """The newest element is a node."""
        self._nodes.append(len(self._stamps_ns) - 1)

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) of all elements."""
        return np.array(self._stamps_ns, dtype=np.int64)

    @property
    def nodes(self) -> NDArray[np.intp]:
        """(K,) rows of the nodes."""
        return np.array(self._nodes, dtype=np.intp)

    @property
    def ends_at_node(self) -> bool:
        """The newest element is a node."""
        return bool(self._nodes) and self._nodes[-1] == len(self._stamps_ns) - 1

    def through(self, poses: FloatArray, covs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """All elements and their covariances, where the nodes are at ``poses`` (K, ...) with ``covs`` (K, dim, dim), by `through_nodes`."""
        n, dim = len(self._stamps_ns), self._group.dim
        path, since = np.array(self._poses).reshape(n, *poses.shape[1:]), np.array(self._covs_since).reshape(n, dim, dim)
        return through_nodes(self._group, path, since, self.nodes, poses, covs)


def through_nodes(
    group: Group, odometry: FloatArray, covs_since: FloatArray, nodes: NDArray[np.intp], poses: FloatArray, covs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Elements (N, ...) of ``group`` and covariances (N, dim, dim) of ``odometry`` (N, ...), whose ``nodes`` (K,) are at ``poses`` (K, ...)
    with ``covs`` (K, dim, dim).

    What the motion between two nodes has changed by grows evenly along it, and not where the robot stands. Elements between nodes have the
    noise of the motion since the last one as well, ``covs_since`` (N, dim, dim), the less of it the nearer the next one is: the covariance
    of a random walk between two known ends. After the last node the odometry goes on.
    """

    def each(function: Callable[..., FloatArray], *rows: FloatArray) -> FloatArray:
        return np.array([function(*row) for row in zip(*rows, strict=True)])

    a = np.clip(np.searchsorted(nodes, np.arange(len(odometry)), side="right") - 1, 0, len(nodes) - 1)
    b = np.minimum(a + 1, len(nodes) - 1)
    travelled = np.append(0.0, np.cumsum(np.linalg.norm(each(group.local, odometry[:-1], odometry[1:]), axis=1) + 1e-9))
    length = np.where(b > a, travelled[nodes[b]] - travelled[nodes[a]], math.inf)
    part = np.clip((travelled - travelled[nodes[a]]) / length, 0.0, 1.0)
    back, until = (each(partial(between, group), odometry, odometry[nodes[end]]) for end in (a, b))
    forward, backward = each(group.compose, poses[a], each(group.inverse, back)), each(group.compose, poses[b], each(group.inverse, until))
    A, B, w = each(group.adjoint, back), each(group.adjoint, until), part[:, None, None]
    mixed = (1.0 - w) * (A @ covs[a] @ A.swapaxes(-1, -2)) + w * (B @ covs[b] @ B.swapaxes(-1, -2))
    noise = (1.0 - w) * covs_since
    noise[nodes] = 0.0
    return each(group.retract, forward, part[:, None] * each(group.local, forward, backward)), mixed + noise
