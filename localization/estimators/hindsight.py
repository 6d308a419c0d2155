"""What the whole way tells of each of its moments, once places that were seen again tie its ends together.

An estimate of a moment knows nothing of what comes after it: where a place is recognised, the estimate jumps, and all that was driven
since the place was seen first stays as far off as it had drifted. Seen from the end, the way is a pose graph: between moments stand the
motions that were estimated, as sure as the estimate's own account says, and between the visits of a place what the scans say.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from localization.errors import EstimatorError
from localization.estimators.graph_factors import Pairs, whitening
from localization.estimators.graph_history import History
from localization.estimators.graph_link import Link
from localization.estimators.graph_node import Node
from localization.estimators.graph_robust import Closure, Kernel
from localization.lidar import Revisit
from localization.lidar.track import positive_part
from localization.trajectory import IntArray, Trajectory
from motion_models import se2
from motion_models.se2 import FloatArray

_NODE_M, _NODE_RAD = 1.0, 0.5  # of way or turn: the motion within is as it was estimated
_LEAST = np.diag([0.002, 0.002, 5e-4]) ** 2  # of a motion between two nodes
_KERNEL = Kernel("cauchy", 3.0)
# A place is recognised by what was seen along some way, in both visits. Of errors that grow by g a metre, the mean over L metres to both
# sides of a place has g L / 6 against it, that over L metres behind it g L / 3.
_AROUND, _BEHIND = 4.0 / 6.0, 8.0 / 3.0


@dataclass(frozen=True)
class Loop:
    """A place that was seen again."""

    from_ns: int
    to_ns: int
    motion: FloatArray
    """(3,) pose of the second visit in the frame of the first."""
    cov: FloatArray
    """(3, 3) of its right perturbation."""
    slip: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) by which the way in between was worse than was thought, in the frame of the second visit."""


class Hindsight:
    """Keeps on the way what its parts are worth, and the places that were seen again; knows at the end what they make of it."""

    def __init__(self) -> None:
        self.loops: list[Loop] = []
        self._jumps: dict[int, FloatArray] = {}  # by a place seen again the estimate of a moment moved, the robot did not
        self._stamps, self._growth = array("q"), array("d")  # of nodes, and of the motion up to each
        self._last: FloatArray | None = None

    def is_due(self, pose: FloatArray) -> bool:
        """So far from the last node, there should be one at ``pose`` (3,)."""
        if self._last is None:
            return True
        x, y, turn = se2.between(self._last, pose).tolist()
        return math.hypot(x, y) >= _NODE_M or abs(turn) >= _NODE_RAD

    def add(self, stamp_ns: int, pose: FloatArray, growth: FloatArray) -> None:
        """A node at ``pose`` (3,), with the covariance ``growth`` (3, 3) of the motion since the one before."""
        self._last = pose.copy()
        if not self._stamps or stamp_ns > self._stamps[-1]:
            self._stamps.append(stamp_ns)
            self._growth.extend(growth.ravel().tolist())

    def see(self, known: Revisit, stamp_ns: int) -> None:
        """At the last node the robot was at a place ``known`` from long ago."""
        self.loops.append(Loop(known.then.stamp_ns, stamp_ns, se2.between(known.then.pose, known.pose), known.cov, known.slip))

    def jump(self, stamp_ns: int, pose: FloatArray) -> None:
        """At the last node, the estimate became ``pose`` (3,)."""
        self._last = self._jumps[stamp_ns] = pose.copy()

    def smooth(self, moments: Trajectory) -> Trajectory | None:
        """``moments``, the estimates of all moments, as the loops correct them; None where there is nothing to correct them by.

        Raises `EstimatorError` if no solution is found.
        """
        poses, stamps, covs = moments.poses, moments.stamps_ns, moments.covariances
        loops = [loop for loop in self.loops if stamps[0] <= loop.from_ns and loop.to_ns <= stamps[-1]]
        if not loops or covs is None:
            return None
        nodes, growth = self._nodes(poses, stamps, covs)
        after = poses.copy()
        for stamp_ns, pose in self._jumps.items():
            after[stamps == stamp_ns] = pose
        ways = se2.between(after[nodes[:-1]], poses[nodes[1:]])
        tied = [(*_ends(loop, stamps, nodes), loop) for loop in loops]
        tied = [(a, b, loop) for a, b, loop in tied if a < b]

        history = History(Node.known(poses[0], np.zeros(0), covs[0] + _LEAST), "batch", _KERNEL)
        history.mark(int(stamps[0]), None)
        last = poses[0]
        for i, way, cov in zip(nodes[1:], ways, _slipped(growth, poses[nodes], tied)[1:], strict=True):
            last = se2.compose(last, way)
            history.add(Pairs.one(_link(way, cov + _LEAST), np.zeros((0, 0))), Node(last, np.zeros(0), np.eye(3)))
            history.mark(int(stamps[i]), None)
        for a, b, loop in tied:
            # where the robot was then is less than a node's distance behind a node
            then = int(np.searchsorted(stamps, loop.from_ns))
            motion = loop.motion if then == nodes[a] else se2.compose(se2.between(after[nodes[a]], poses[then]), loop.motion)
            bent = _AROUND * _each_metre(growth, ways, a) + _BEHIND * _each_metre(growth, ways, b)
            history.add_closure(Closure(a, b, motion, whitening(loop.cov + bent + _LEAST)))
        found = history.trajectory()
        assert found.covariances is not None
        whole, cov = _between(nodes, found.poses, found.covariances, poses, after)
        # what was known of a moment when it was there is known at the end
        known = np.trace(covs[:, :2, :2], axis1=1, axis2=2) < np.trace(cov[:, :2, :2], axis1=1, axis2=2)
        return Trajectory(stamps, whole, np.where(known[:, None, None], covs, cov))

    def _nodes(self, poses: FloatArray, stamps: IntArray, covs: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
        """Which moments (K,) are nodes, the first and the last among them, and (K, 3, 3) of the motion up to each."""
        known = np.array(self._stamps, dtype=np.int64)
        growth = np.array(self._growth).reshape(-1, 3, 3)
        nodes, first = np.unique(np.searchsorted(stamps, known).clip(max=len(stamps) - 1), return_index=True)
        growth = growth[first]
        if nodes[0] > 0:  # before scans share a map, nothing is kept of the motion, and the estimates' own covariance is all there is
            A = se2.adjoint(se2.between(poses[nodes[0]], poses[0]))
            growth[0] = covs[nodes[0]] - A @ covs[0] @ A.T
            nodes, growth = np.concatenate([[0], nodes]), np.concatenate([np.zeros((1, 3, 3)), growth])
        if not np.isfinite(growth).all():
            raise EstimatorError("what the motion between two places is worth is not finite. Look at the log.")
        return nodes, np.array([positive_part(cov) for cov in growth])


def _ends(loop: Loop, stamps: IntArray, nodes: NDArray[np.intp]) -> tuple[int, int]:
    """The node at or before the first visit, and that of the second."""
    a, b = np.searchsorted(stamps, [loop.from_ns, loop.to_ns])
    return int(np.searchsorted(nodes, a, side="right")) - 1, min(int(np.searchsorted(nodes, b)), len(nodes) - 1)


def _slipped(growth: FloatArray, poses: FloatArray, tied: Sequence[tuple[int, int, Loop]]) -> FloatArray:
    """(K, 3, 3) the ``growth`` up to each of the ``poses`` (K, 3), with the slip that the loops show somewhere on the way between them."""
    grown = growth.copy()
    for a, b, loop in tied:
        if loop.slip.any():
            A = se2.adjoint(se2.between(poses[a + 1 : b + 1], poses[b]))
            grown[a + 1 : b + 1] += A @ loop.slip @ A.swapaxes(-1, -2) / (b - a)
    return grown


def _each_metre(growth: FloatArray, ways: FloatArray, node: int) -> FloatArray:
    """(3, 3) what the ``growth`` (K, 3, 3) up to the nodes around a ``node`` is for a metre of the ``ways`` (K - 1, 3)."""
    first, last = max(node - 3, 1), node + 5
    return np.asarray(growth[first:last].sum(axis=0) / max(float(np.hypot(*ways[first - 1 : last - 1, :2].T).sum()), 1.0))


def _link(way: FloatArray, cov: FloatArray) -> Link:
    nothing = np.zeros(0)
    return Link(way, cov, np.zeros((3, 0)), nothing, np.zeros((0, 0)), nothing, 0.0, 0.0)


def _between(
    nodes: NDArray[np.intp], found: FloatArray, covs: FloatArray, poses: FloatArray, after: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses (N, 3) and covariances (N, 3, 3) of all moments, where those of the ``nodes`` (K,) were ``found``.

    What the way between two nodes has changed by grows evenly along it, and not where the robot stands.
    """
    steps = se2.between(poses[:-1], poses[1:])
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]) + np.abs(steps[:, 2]) + 1e-9)])
    k = np.clip(np.searchsorted(nodes, np.arange(len(poses)), side="right") - 1, 0, len(nodes) - 2)
    since = se2.between(after[nodes[k]], poses)
    since[nodes[k] == np.arange(len(poses))] = 0.0
    until = se2.between(poses, poses[nodes[k + 1]])
    part = (driven - driven[nodes[k]]) / (driven[nodes[k + 1]] - driven[nodes[k]])
    forward, backward = se2.compose(found[k], since), se2.compose(found[k + 1], se2.inverse(until))
    A, B = se2.adjoint(se2.inverse(since)), se2.adjoint(until)
    mixed = (1.0 - part)[:, None, None] * (A @ covs[k] @ A.swapaxes(-1, -2)) + part[:, None, None] * (B @ covs[k + 1] @ B.swapaxes(-1, -2))
    return se2.compose(forward, se2.exp(part[:, None] * se2.log(se2.between(forward, backward)))), mixed
