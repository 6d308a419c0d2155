"""What a slope changes of a model's motion: for others than the friction model, that model's difference between tilted and level ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motion_models.base import MotionModel, Twist
from motion_models.friction.model import BoolArray, FrictionModel, slope_limits
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope, SlopeTwist

SLIDING_MODELS = ("skid_steer", "icr", "friction")
"""Models of robots that skid, whose coefficients hold on level ground."""


@dataclass(frozen=True)
class SlopeEffect:
    """The friction model of a robot, for the motion of its other models on slopes."""

    friction: FrictionModel
    cg_height: float
    """[m]"""

    @classmethod
    def from_robot(cls, robot: Robot) -> SlopeEffect:
        """The robot's friction parameters and the height of its CG."""
        return cls(FrictionModel.from_robot(robot), robot.geometry.cg_height_m)

    def twist(
        self, model: MotionModel, wheels: FloatArray, cg: FloatArray, params: FloatArray, downhill: FloatArray
    ) -> tuple[SlopeTwist, BoolArray]:
        """Twist of ``model`` at ``wheels`` (n, 2), ``cg`` (n, 2) and ``params`` where the ground falls to ``downhill`` (n, 2).

        Also the samples (n,) whose slope tips the robot over or lets it slide by itself: their twist is that of level ground.
        """
        own = self.friction.nominal
        limited = np.logical_or(*slope_limits(cg, own, Slope(downhill, self.cg_height)))
        slope = Slope(np.where(limited[:, None], 0.0, downhill), self.cg_height)
        if isinstance(model, FrictionModel):
            return model.twist_on_slope(wheels, cg, params, slope), limited
        level, tilted = model.twist(wheels, cg, params), self.friction.twist_on_slope(wheels, cg, own, slope)
        flat = self.friction.twist(wheels, cg, own)
        changed = Twist(
            level.value + (tilted.twist.value - flat.value),
            level.d_wheels + (tilted.twist.d_wheels - flat.d_wheels),
            level.d_cg + (tilted.twist.d_cg - flat.d_cg),
            level.d_params,
        )
        return SlopeTwist(changed, tilted.d_downhill, tilted.d_cg_height), limited
