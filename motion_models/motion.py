"""A body twist that a model predicts, and a relative motion with covariance, which wheels and LiDAR share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class Twist:
    """Body twist that a model predicts, with its exact derivatives. Leading axes broadcast."""

    value: FloatArray
    """(..., 3) vx, vy, wz [m/s, m/s, rad/s]."""
    d_wheels: FloatArray
    """(..., 3, 2) by the left and right wheel rate."""
    d_cg: FloatArray
    """(..., 3, 2) by the x and y of the centre of gravity."""
    d_params: FloatArray
    """(..., 3, k) by the model's parameters, in the order of `MotionModel.param_names`."""

    @classmethod
    def from_kernel(
        cls, kernel: Callable[..., None], constants: FloatArray, wheels: FloatArray, cg: FloatArray, params: FloatArray
    ) -> Twist:
        """Run a compiled loop over all samples, whatever their leading axes.

        ``kernel(wheels (n, 2), cg (n, 2), params (k,), constants, value, d_wheels, d_cg, d_params)`` fills the last four, which start
        at zero, for each of n samples.
        """
        lead = wheels.shape[:-1] if wheels.shape == cg.shape else np.broadcast_shapes(wheels.shape[:-1], cg.shape[:-1])
        n, k = math.prod(lead), params.shape[0]
        value, d_params = np.zeros((n, 3)), np.zeros((n, 3, k))
        d_wheels, d_cg = np.zeros((n, 3, 2)), np.zeros((n, 3, 2))
        # Always copies: numba would compile the kernel once more for each kind of view, and round it differently.
        full = [a if a.shape == (*lead, 2) else np.broadcast_to(a, (*lead, 2)) for a in (wheels, cg)]  # broadcast_* take microseconds
        flat = [np.array(a, dtype=np.float64, order="C").reshape(n, 2) for a in full]
        kernel(*flat, np.array(params, dtype=np.float64), constants, value, d_wheels, d_cg, d_params)
        return cls(value.reshape(*lead, 3), d_wheels.reshape(*lead, 3, 2), d_cg.reshape(*lead, 3, 2), d_params.reshape(*lead, 3, k))


@dataclass(frozen=True)
class Motion:
    """A relative motion with its covariance: what wheels predict, and what a LiDAR measures, between two moments."""

    delta: FloatArray
    """(3,) pose of the end relative to the start [m, m, rad]."""
    cov: FloatArray
    """(3, 3) of the right perturbation of ``delta`` by slip."""
    d_params: FloatArray = field(default_factory=lambda: np.zeros((3, 0)))
    """(3, k) change of ``delta`` (right perturbation) by the model's parameters."""
    d_cg: FloatArray = field(default_factory=lambda: np.zeros((3, 2)))
    """(3, 2) change of ``delta`` (right perturbation) by a CG error that is the same over all of it."""
