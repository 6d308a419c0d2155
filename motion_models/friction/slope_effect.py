"""What a slope changes of a model's motion: for others than the friction model, that model's difference between tilted and level ground."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from motion_models.base import MotionModel
from motion_models.friction.model import BoolArray, FrictionModel
from motion_models.motion import Twist
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope

_WARP = FrictionModel.param_names.index("warp")
_TYRES = [FrictionModel.param_names.index(name) for name in ("slip_stiffness", "mu")]
_POINTS = (-1.271, -0.325, 0.325, 1.271)
"""Means of the quarters of a normal distribution [sigmas]. Where a wheel is in the air more load changes nothing: there the mean motion by
three points of Gauss-Hermite is off by 4.4 % (RMS), by these 1.4 %."""


def _changed(params: FloatArray, tyres: tuple[float, float], warp: float = 0.0) -> FloatArray:
    """``params`` (13,) of the friction model with other ``tyres``, see `SlopeEffect.twist`, and ``warp`` added to theirs."""
    out = params.copy()
    out[_TYRES] *= np.exp(tyres)
    out[_WARP] += warp
    return out


class SlopeMotion(NamedTuple):
    """Motion on a slope, with its spread by the load on the diagonals, which is known to a sigma only."""

    twist: Twist
    """(n, 3)"""
    d_downhill: FloatArray
    """(n, 3, 2) by `Slope.downhill`."""
    by_tyres: FloatArray
    """(n, 3, 2) by the logarithms of slip stiffness and mu."""
    by_warp: FloatArray
    """(n, 3, 4) root B of the mean square B B^T by which motions at other loads on the diagonals are off `twist`."""
    limited: BoolArray
    """(n,) whose slope tips the robot over or lets it slide by itself: their twist is that of level ground."""


@dataclass(frozen=True)
class SlopeEffect:
    """The friction model of a robot, for the motion of its other models on slopes."""

    friction: FrictionModel
    cg_height: float
    """[m]"""
    deflection: float
    """`Geometry.wheel_deflection`."""

    @classmethod
    def from_robot(cls, robot: Robot) -> SlopeEffect:
        """The robot's friction parameters, the height of its CG and the stiffness of its wheels."""
        return cls(FrictionModel.from_robot(robot), robot.geometry.cg_height_m, robot.geometry.wheel_deflection)

    def warp_of(self, twist: float) -> float:
        """Load that ground with the ``twist`` [1/m] (`localization.inputs.ground_curvature`) moves onto the front left and rear right
        wheels, over m g / 4: their feet are higher than the others by twist * wheelbase * track / 2, which four tyres share."""
        track, wheelbase, radius = self.friction.nominal[1], self.friction.nominal[2], self.friction.nominal[0]
        return float(twist * wheelbase * track / (4.0 * self.deflection * radius))

    def twist(
        self,
        model: MotionModel,
        wheels: FloatArray,
        cg: FloatArray,
        params: FloatArray,
        downhill: FloatArray,
        warp: tuple[float, float] = (0.0, 0.0),
        tyres: tuple[float, float] = (0.0, 0.0),
    ) -> SlopeMotion:
        """Motion of ``model`` at ``wheels`` (n, 2), ``cg`` (n, 2) and ``params`` where the ground falls to ``downhill`` (n, 2).

        ``warp``: mean and sigma of the load that the ground moves onto the front left and rear right wheels, over m g / 4. The
        motion is that at the mean. A robot on either diagonal slides farther than on four wheels, so that its error is to one side.
        ``tyres``: logarithms of slip stiffness and mu over the robot file's.
        """
        level = model.twist(wheels, cg, params)
        is_friction = isinstance(model, FrictionModel)
        friction, own = (model, params) if isinstance(model, FrictionModel) else (self.friction, self.friction.nominal)
        flat = level if is_friction else friction.twist(wheels, cg, _changed(own, tyres))
        slope = Slope(downhill, self.cg_height)
        found = friction.find_on_slope(wheels, cg, _changed(own, tyres, warp[0]), slope)
        points = [friction.find_on_slope(wheels, cg, _changed(own, tyres, warp[0] + z * warp[1]), slope).twist.value for z in _POINTS]
        by_warp = np.stack([point - found.twist.value for point in points], axis=-1) / math.sqrt(len(points))
        twist, sizes = found.twist, _changed(own, tyres)[_TYRES]
        by_tyres = sizes * twist.d_params[..., _TYRES]
        if not is_friction:
            by_tyres = by_tyres - sizes * flat.d_params[..., _TYRES]
            twist = Twist(
                level.value + (twist.value - flat.value),
                level.d_wheels + (twist.d_wheels - flat.d_wheels),
                level.d_cg + (twist.d_cg - flat.d_cg),
                level.d_params,
            )
        limited = np.asarray(np.isnan(by_warp).any(axis=(-2, -1)))
        if not limited.any():
            return SlopeMotion(twist, found.d_downhill, by_tyres, by_warp, limited)
        at = limited[:, None, None]
        twist = Twist(
            np.where(limited[:, None], level.value, twist.value),
            np.where(at, level.d_wheels, twist.d_wheels),
            np.where(at, level.d_cg, twist.d_cg),
            np.where(at, level.d_params, twist.d_params),
        )
        d_downhill, by_tyres, by_warp = (np.where(at, 0.0, by) for by in (found.d_downhill, by_tyres, by_warp))
        return SlopeMotion(twist, d_downhill, by_tyres, by_warp, limited)
