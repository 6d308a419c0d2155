"""The friction model as an estimator corrects it: with an offset of its CG, and estimates held to what a robot can have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from motion_models.base import Twist
from motion_models.friction.model import FrictionModel, check_parameters
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_N = len(FrictionModel.param_names)
_MU_RATIO = FrictionModel.param_names.index("mu_ratio")
_LEAST_MU_RATIO = 0.05
_EDGE = 0.98  # of the way to where the robot tips over


@dataclass(frozen=True)
class CorrectedFriction:
    """`FrictionModel` with two more parameters, cg_offset_x and cg_offset_y [m]: how far the CG is from where it is given.

    An estimate may move to where no robot is: it is held at the edge, where its derivative is zero.
    """

    inner: FrictionModel
    name: ClassVar[str] = FrictionModel.name
    param_names: ClassVar[tuple[str, ...]] = (*FrictionModel.param_names, "cg_offset_x", "cg_offset_y")

    @classmethod
    def from_robot(cls, robot: Robot) -> CorrectedFriction:
        """`FrictionModel.from_robot`, the CG where it is given."""
        return cls(FrictionModel.from_robot(robot))

    @property
    def nominal(self) -> FloatArray:
        """(14,)"""
        return np.append(self.inner.nominal, [0.0, 0.0])

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `FrictionModel.twist`."""
        held, shifted, is_free = _held(cg, params)
        found = self.inner.twist(wheels, shifted, held)
        d_cg = found.d_cg * is_free[..., None, :]
        d_params = np.concatenate([found.d_params, d_cg], axis=-1)
        if held[_MU_RATIO] != params[_MU_RATIO]:
            d_params[..., _MU_RATIO] = 0.0
        return Twist(found.value, found.d_wheels, d_cg, d_params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `FrictionModel.wheels`."""
        held, shifted, _ = _held(cg, params)
        return self.inner.wheels(command, shifted, held)


def _held(cg: FloatArray, params: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parameters (12,) and CG (..., 2) that a robot can have, and 1 where the CG (..., 2) is free to move, else 0."""
    held = params[:_N].copy()
    held[_MU_RATIO] = max(held[_MU_RATIO], _LEAST_MU_RATIO)
    check_parameters(cg, held)
    edge = 0.5 * _EDGE * held[[2, 1]]
    moved = cg + params[_N:]
    return held, np.clip(moved, -edge, edge), (np.abs(moved) < edge).astype(float)
