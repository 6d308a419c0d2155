"""Factors that are not between neighbouring nodes, and may be wrong: positions of one node, motions between any two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from localization.estimators.graph_qr import triangularize
from localization.residuals import motion_residual, position_residual
from motion_models.se2 import FloatArray

UNARY = 3
"""Rows that positions leave on the pose of a node."""


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


def position_rows(positions: Sequence[Position], pose: FloatArray, kernel: Kernel) -> FloatArray:
    """(3, 4): rows about the ``pose`` (3,) of one node that say what all its ``positions`` say."""
    rows = np.zeros((max(2 * len(positions), UNARY), 4))
    for i, position in enumerate(positions):
        rows[2 * i : 2 * i + 2] = position.linearize(pose, kernel)
    triangularize(rows, 3)
    return rows[:UNARY]
