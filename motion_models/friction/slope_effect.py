"""What a slope changes of a model's motion: for others than the friction model, that model's difference between tilted and level ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motion_models.base import MotionModel, Twist
from motion_models.friction.model import BoolArray, FrictionModel
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope, SlopeTwist

LimitedTwist = tuple[SlopeTwist, BoolArray]
"""A twist on slopes, and the samples whose slope tips the robot over or lets it slide by itself."""
_WARP = FrictionModel.param_names.index("warp")


def _warped(params: FloatArray, warp: float) -> FloatArray:
    """``params`` (13,) of the friction model with ``warp`` added to theirs."""
    out = params.copy()
    out[_WARP] += warp
    return out


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
        """Load that ground with the ``twist`` [1/m] (`localization.ground_curvature`) moves onto the front left and rear right wheels, over
        m g / 4: their feet are higher than the others by twist * wheelbase * track / 2, which four tyres share."""
        track, wheelbase, radius = self.friction.nominal[1], self.friction.nominal[2], self.friction.nominal[0]
        return float(twist * wheelbase * track / (4.0 * self.deflection * radius))

    def twist(
        self, model: MotionModel, wheels: FloatArray, cg: FloatArray, params: FloatArray, downhill: FloatArray, warp: float = 0.0
    ) -> LimitedTwist:
        """Twist of ``model`` at ``wheels`` (n, 2), ``cg`` (n, 2) and ``params`` where the ground falls to ``downhill`` (n, 2) and moves
        the load ``warp`` onto the front left and rear right wheels, over m g / 4.

        Also the samples (n,) whose slope tips the robot over or lets it slide by itself: their twist is that of level ground.
        """
        level = model.twist(wheels, cg, params)
        is_friction = isinstance(model, FrictionModel)
        friction, own = (model, params) if isinstance(model, FrictionModel) else (self.friction, self.friction.nominal)
        flat = level if is_friction else friction.twist(wheels, cg, own)
        found = friction.find_on_slope(wheels, cg, _warped(own, warp), Slope(downhill, self.cg_height))
        twist = found.twist
        if not is_friction:
            twist = Twist(
                level.value + (twist.value - flat.value),
                level.d_wheels + (twist.d_wheels - flat.d_wheels),
                level.d_cg + (twist.d_cg - flat.d_cg),
                level.d_params,
            )
        limited = np.asarray(np.isnan(twist.value).any(axis=-1))
        if not limited.any():
            return SlopeTwist(twist, found.d_downhill, found.d_cg_height), limited
        at = limited[:, None, None]
        twist = Twist(
            np.where(limited[:, None], level.value, twist.value),
            np.where(at, level.d_wheels, twist.d_wheels),
            np.where(at, level.d_cg, twist.d_cg),
            np.where(at, level.d_params, twist.d_params),
        )
        return SlopeTwist(twist, np.where(at, 0.0, found.d_downhill), np.where(limited[:, None], 0.0, found.d_cg_height)), limited
