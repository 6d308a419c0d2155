"""State of an estimator: named variables, each an element of a group, and one covariance of the errors of all.

The mean of a variable lives in its group, and its error in the tangent space (Solà 2017, "Quaternion kinematics for the error-state Kalman
filter"), with right perturbations: true value = mean * exp(error). The group is an attribute of the variable: SE(2), SE(3) or a vector
space. Nothing here changes a state: `localization.core.filter` makes new ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from motion_models.groups import Group
from motion_models.se2 import FloatArray

IntArray = NDArray[np.int64]

_MIN_VARIANCE = 1e-14
"""Variance of a relative motion, at least: a tenth of a micrometre or microradian [m^2, rad^2]."""


@dataclass(frozen=True)
class Vector:
    """The vector space of ``dim`` numbers: sums for products."""

    dim: int

    def compose(self, a: FloatArray, b: FloatArray, /) -> FloatArray:
        """The sum."""
        return a + b

    def inverse(self, a: FloatArray, /) -> FloatArray:
        """The negative."""
        return -a

    def retract(self, a: FloatArray, tangent: FloatArray, /) -> FloatArray:
        """The sum."""
        return a + tangent

    def local(self, a: FloatArray, b: FloatArray, /) -> FloatArray:
        """The difference."""
        return b - a

    def adjoint(self, a: FloatArray, /) -> FloatArray:
        """The identity."""
        return np.eye(self.dim)


@dataclass(frozen=True)
class Perturbation(Vector):
    """Error of what a pose is measured against, as a right perturbation of that pose, whose own error contains it."""

    of: str
    """Name of the pose."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Names and groups of a state's variables, in the order of their rows in the covariance."""

    groups: Mapping[str, Group]

    @cached_property
    def rows(self) -> Mapping[str, slice]:
        """Rows of each variable."""
        ends = np.cumsum([group.dim for group in self.groups.values()]).tolist()
        return {name: slice(end - group.dim, end) for (name, group), end in zip(self.groups.items(), ends, strict=True)}

    def indices(self, names: Sequence[str]) -> IntArray:
        """(k,) rows of the variables ``names``, one after another."""
        return np.concatenate([np.arange(self.rows[name].start, self.rows[name].stop) for name in names])


@dataclass(frozen=True, eq=False)
class State:
    """Means by name, and the covariance of their errors."""

    layout: Layout
    means: Mapping[str, FloatArray]
    P: FloatArray
    """(n, n) covariance of the errors of all variables, in the order of ``layout``."""

    def __contains__(self, name: str) -> bool:
        return name in self.means

    def __getitem__(self, name: str) -> FloatArray:
        """Mean of the variable ``name``."""
        return self.means[name]

    def number(self, name: str) -> float:
        """Mean of a variable of one dimension."""
        return float(self.means[name][0])

    def variance(self, name: str) -> float:
        """Variance of a variable of one dimension."""
        row = self.layout.rows[name].start
        return float(self.P[row, row])

    def cov(self, *names: str) -> FloatArray:
        """Joint covariance (k, k) of the errors of the variables ``names``."""
        if len(names) == 1:
            rows = self.layout.rows[names[0]]
            return self.P[rows, rows].copy()
        indices = self.layout.indices(names)
        return self.P[np.ix_(indices, indices)]

    def difference_cov(self, one: str, other: str) -> FloatArray:
        """Covariance (k, k) of e_one - e_other, for errors in one tangent space."""
        P, a, b = self.P, self.layout.rows[one], self.layout.rows[other]
        return clip_eigenvalues(P[a, a] + P[b, b] - P[a, b] - P[b, a])

    def between(self, start: str, end: str) -> tuple[FloatArray, FloatArray]:
        """``start``^-1 ``end`` of two variables of one group, and the covariance (k, k) of its right perturbation, to first order."""
        group = self.layout.groups[end]
        delta = group.compose(group.inverse(self.means[start]), self.means[end])
        A = group.adjoint(group.inverse(delta))
        P, a, b = self.P, self.layout.rows[start], self.layout.rows[end]
        cross = P[b, a] @ A.T
        return delta, clip_eigenvalues(P[b, b] - cross - cross.T + A @ P[a, a] @ A.T)


def clip_eigenvalues(cov: FloatArray) -> FloatArray:
    """``cov`` (n, n), a difference of large covariances, with eigenvalues of at least `_MIN_VARIANCE`: rounding leaves negative ones."""
    values, vectors = np.linalg.eigh(0.5 * (cov + cov.T))
    return np.asarray((vectors * np.maximum(values, _MIN_VARIANCE)) @ vectors.T, dtype=float)
