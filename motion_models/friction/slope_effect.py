"""What a slope changes of a model's motion: for others than the friction model, that model's difference between tilted and level ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motion_models.base import MotionModel, Twist
from motion_models.friction.model import BoolArray, FrictionModel
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope, SlopeTwist


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
        slope, level = Slope(downhill, self.cg_height), model.twist(wheels, cg, params)
        if isinstance(model, FrictionModel):
            found = model.find_on_slope(wheels, cg, params, slope)
            twist = found.twist
        else:
            own = self.friction.nominal
            found, flat = self.friction.find_on_slope(wheels, cg, own, slope), self.friction.twist(wheels, cg, own)
            twist = Twist(
                level.value + (found.twist.value - flat.value),
                level.d_wheels + (found.twist.d_wheels - flat.d_wheels),
                level.d_cg + (found.twist.d_cg - flat.d_cg),
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
