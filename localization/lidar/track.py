"""The way the robot came: poses with covariances, and how far the pose now may be off one of them.

Errors of odometry grow by independent increments, so what two poses of one way share is the error of the older one, and what they do not
share is the growth since then: ``P_now - A P_then A^T`` with ``A = adjoint(inverse(motion since then))`` (as in `consistency`). Where the
robot came back to an old place and its pose was tied to the old one, the way goes on from there: ways form a tree, and two poses
share the error of the place where their ways part.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motion_models import se2
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Place:
    """Where the robot was at one moment."""

    stamp_ns: int
    travel: float
    """Distance travelled until then [m]."""
    pose: FloatArray
    """(3,) ``world_T_body`` as it was estimated then."""
    cov: FloatArray
    """(3, 3) of its right perturbation."""


class Track:
    """Places in the order of time, about one a metre."""

    def __init__(self) -> None:
        # columns of numbers: the way is kept for as long as the robot drives
        self._stamps, self._travels = array("q"), array("d")
        self._xs, self._ys, self._yaws, self._covs = array("d"), array("d"), array("d"), array("d")
        self._starts = array("q")  # of each place: the first of those that follow each other up to it
        self._parents: dict[int, int] = {}  # of each start but the first: the place that its way goes on from
        self._next_parent: int | None = None

    def __len__(self) -> int:
        return len(self._stamps)

    def __getitem__(self, index: int) -> Place:
        pose = np.array([self._xs[index], self._ys[index], self._yaws[index]])
        return Place(self._stamps[index], self._travels[index], pose, np.array(self._covs[9 * index : 9 * index + 9]).reshape(3, 3))

    def add(self, place: Place) -> None:
        """The robot is here now."""
        n = len(self)
        if self._next_parent is not None:
            self._parents[n], self._next_parent = self._next_parent, None
        is_start = n == 0 or n in self._parents
        self._starts.append(n if is_start else self._starts[-1])
        self._stamps.append(place.stamp_ns)
        self._travels.append(place.travel)
        for column, value in zip((self._xs, self._ys, self._yaws), place.pose.tolist(), strict=True):
            column.append(value)
        self._covs.extend(place.cov.ravel().tolist())

    def tie(self, index: int) -> None:
        """The pose was corrected by what was seen at place ``index``: the way goes on from there."""
        self._next_parent = index

    def at_travel(self, travel: float) -> int:
        """The place nearest to ``travel`` [m]."""
        after = min(bisect_left(self._travels, travel), len(self._travels) - 1)
        is_before = after > 0 and travel - self._travels[after - 1] < self._travels[after] - travel
        return after - 1 if is_before else after

    def at_stamp(self, stamp_ns: int) -> int:
        """The last place up to ``stamp_ns``, or the first of all."""
        return max(bisect_right(self._stamps, stamp_ns) - 1, 0)

    def near(self, pose: FloatArray, radius: float, before: float) -> NDArray[np.intp]:
        """Places within ``radius`` [m] of ``pose`` (3,), passed before ``before`` [m], in their order."""
        n = bisect_left(self._travels, before)
        return np.flatnonzero(np.hypot(np.array(self._xs[:n]) - pose[0], np.array(self._ys[:n]) - pose[1]) < radius)

    def growth(self, index: int) -> FloatArray:
        """(3, 3) covariance of the last place against place ``index``, in the body frame of the last."""
        now, then = self[len(self) - 1], self[index]
        shared = moved(self[self._fork(index)], now.pose)
        # increments are only nearly independent
        return positive_part(now.cov - shared) + positive_part(moved(then, now.pose) - shared)

    def _fork(self, then: int) -> int:
        """Where the ways to the last place and to ``then`` part."""
        now = len(self) - 1
        while now != then:
            ahead, behind = max(now, then), min(now, then)
            start = self._starts[ahead]
            now, then = (behind, behind) if start <= behind else (self._parents[start], behind)
        return now


def moved(place: Place, pose: FloatArray) -> FloatArray:
    """(3, 3) covariance of ``place`` as that of a body at ``pose`` (3,) that is tied to it."""
    A = se2.adjoint(se2.between(pose, place.pose))
    found: FloatArray = A @ place.cov @ A.T
    return found


def positive_part(matrix: FloatArray) -> FloatArray:
    """The nearest (3, 3) to ``matrix`` that is a covariance."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    found: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return found
