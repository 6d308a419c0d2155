"""Motion models with additional parameters, as estimators correct them: wheel radii of any model, and the CG of the friction model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from motion_models.base import MotionModel, Twist
from motion_models.friction import FrictionModel, check_parameters
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

RADIUS_NAMES = ("wheel_radius_scale", "wheel_radius_difference")
_N = len(FrictionModel.param_names)
_MU_RATIO = FrictionModel.param_names.index("mu_ratio")
_LEAST_MU_RATIO = 0.05  # -; castors and free rollers
_EDGE = 0.98  # of the way to where the robot tips over


@dataclass(frozen=True)
class CorrectedWheels:
    """``inner`` with two more parameters [-], 0 for the robot file's radii: wheel_radius_scale s and wheel_radius_difference d.

    Left wheels have the radius r (1 + s + d/2), right ones r (1 + s - d/2), so that the inner model gets the rates
    q_l (1 + s + d/2) and q_r (1 + s - d/2). Straight ahead, d turns the robot by -d k / track per metre.
    """

    inner: MotionModel

    @property
    def name(self) -> str:
        """Name of the inner model."""
        return self.inner.name

    @property
    def param_names(self) -> tuple[str, ...]:
        """The inner model's, then `RADIUS_NAMES`."""
        return (*self.inner.param_names, *RADIUS_NAMES)

    @property
    def nominal(self) -> FloatArray:
        """(k + 2,)"""
        return np.append(self.inner.nominal, [0.0, 0.0])

    @property
    def sigmas(self) -> FloatArray:
        """(k + 2,) of the inner model's prior, where it has one (`motion_models.prior`)."""
        return np.append(getattr(self.inner, "sigmas", np.zeros(len(self.inner.param_names))), [0.0, 0.0])

    @classmethod
    def from_robot(cls, robot: Robot) -> CorrectedWheels:
        """Not of a robot alone: it wraps a model."""
        raise NotImplementedError("wrap the model of the robot: CorrectedWheels(make_model(name, robot)).")

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`."""
        sides = self._sides(params)
        found = self.inner.twist(wheels * sides, cg, params[:-2])
        rates = np.broadcast_to(wheels, (*found.value.shape[:-1], 2))
        by_rates = found.d_wheels * rates[..., None, :]
        by_scale = by_rates.sum(axis=-1, keepdims=True)
        by_difference = 0.5 * (by_rates[..., :1] - by_rates[..., 1:])
        d_params = np.concatenate([found.d_params, by_scale, by_difference], axis=-1)
        return Twist(found.value, found.d_wheels * sides, found.d_cg, d_params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`."""
        return np.asarray(self.inner.wheels(command, cg, params[:-2]) / self._sides(params))

    @staticmethod
    def _sides(params: FloatArray) -> FloatArray:
        scale, difference = params[-2], params[-1]
        return np.array([1.0 + scale + difference / 2.0, 1.0 + scale - difference / 2.0])


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
