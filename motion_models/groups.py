"""Lie groups as arguments: what a filter, a graph or a map takes to work in the plane and in space by the same lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from motion_models import se2, se3
from motion_models.se2 import FloatArray


class Group(Protocol):
    """A Lie group, by the arrays that stand for its elements."""

    @property
    def dim(self) -> int:
        """Dimension of the tangent space."""

    def compose(self, a: FloatArray, b: FloatArray, /) -> FloatArray:
        """The product a * b."""

    def inverse(self, a: FloatArray, /) -> FloatArray:
        """The element with compose(a, inverse(a)) = identity."""

    def retract(self, a: FloatArray, tangent: FloatArray, /) -> FloatArray:
        """``a`` moved by a perturbation (dim,) on the right: a * exp(tangent)."""

    def local(self, a: FloatArray, b: FloatArray, /) -> FloatArray:
        """Tangent vector (dim,) that moves a to b: log(a^-1 b)."""

    def adjoint(self, a: FloatArray, /) -> FloatArray:
        """Matrix (dim, dim) with a * exp(t) = exp(Ad t) * a."""


class PoseGroup(Group, Protocol):
    """A group of poses: its elements move points of two or three dimensions."""

    def identity(self) -> FloatArray:
        """The pose that moves nothing."""

    def transform(self, a: FloatArray, points: FloatArray, /) -> FloatArray:
        """``points`` (N, 2) or (N, 3) moved by the pose ``a``."""

    def position(self, poses: FloatArray, /) -> FloatArray:
        """(..., 2) or (..., 3) translations of a pose or of several."""


@dataclass(frozen=True)
class PlanarPose:
    """SE(2): poses x, y, yaw (`motion_models.se2`)."""

    dim = 3
    compose = staticmethod(se2.compose)
    inverse = staticmethod(se2.inverse)
    retract = staticmethod(se2.retract)
    local = staticmethod(se2.local)
    adjoint = staticmethod(se2.adjoint)
    transform = staticmethod(se2.transform)

    def identity(self) -> FloatArray:
        """(3,)"""
        return np.zeros(3)

    def position(self, poses: FloatArray, /) -> FloatArray:
        """(..., 2) of ``poses`` (..., 3)."""
        return poses[..., :2]


@dataclass(frozen=True)
class PoseInSpace:
    """SE(3): homogeneous matrices (4, 4) (`motion_models.se3`)."""

    dim = 6
    compose = staticmethod(se3.compose)
    inverse = staticmethod(se3.inverse)
    retract = staticmethod(se3.retract)
    local = staticmethod(se3.local)
    adjoint = staticmethod(se3.adjoint)
    transform = staticmethod(se3.transform)

    def identity(self) -> FloatArray:
        """(4, 4)"""
        return np.eye(4)

    def position(self, poses: FloatArray, /) -> FloatArray:
        """(..., 3) of ``poses`` (..., 4, 4)."""
        return poses[..., :3, 3]


SE2, SE3 = PlanarPose(), PoseInSpace()


def between(group: Group, a: FloatArray, b: FloatArray) -> FloatArray:
    """Motion from ``a`` to ``b``: a^-1 b."""
    return group.compose(group.inverse(a), b)
