"""Any motion model with the wheels' radii as parameters: a scale of all, and a difference of left and right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motion_models.base import MotionModel, Twist
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

RADIUS_NAMES = ("wheel_radius_scale", "wheel_radius_difference")


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
