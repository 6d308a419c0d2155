"""Diff-drive: the model of common drivers, for skid-steer robots too, with one hand-tuned multiplier; the baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from motion_models.base import ModelBase
from motion_models.compiled import kernel
from motion_models.motion import Twist
from motion_models.param import TURNING_SIGMA, Free, Param, Scale
from motion_models.robot import Robot
from motion_models.se2 import FloatArray


@dataclass(frozen=True)
class DiffDrive(ModelBase):
    """Ebersole 2016, eqs. 1.4-1.8: no sideways motion, and a track widened by the wheel separation multiplier.

    Parameters: the wheels' radius [m] and the multiplier [-].
    """

    track_width: float
    """Distance between left and right contacts [m]."""
    nominal: FloatArray
    """(2,) wheel radius [m], wheel separation multiplier [-]."""
    name: ClassVar[str] = "diff_drive"
    params: ClassVar[tuple[Param, ...]] = (
        Param("wheel_radius", "m", "how far the robot drives per radian of its wheels", Scale(0.3, wheel_radius=1), free=Free(logs=2)),
        Param(
            "wheel_separation_multiplier",
            *("1", "track that the robot turns by, over the real one", Scale(0.5), TURNING_SIGMA, "wheel_separation_multiplier"),
            free=Free(logs=1, turns=1, rotations=1),
        ),
    )

    @classmethod
    def from_robot(cls, robot: Robot) -> DiffDrive:
        """The robot's driver's own geometry, where its file has no [models.diff_drive]."""
        geometry, driver = robot.geometry, robot.driver
        # The driver may have another track; the product of track and multiplier is what it turns by.
        multiplier = driver.wheel_separation_multiplier * driver.track_width_m / geometry.track_width_m
        defaults = np.array([geometry.wheel_radius_m, multiplier])
        return cls(geometry.track_width_m, robot.coefficients(cls.name, cls.param_names, defaults))

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`."""
        return Twist.from_kernel(_twist, np.array([self.track_width]), wheels, cg, params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`."""
        vx, wz = np.moveaxis(np.broadcast_arrays(command, cg)[0], -1, 0)
        r, multiplier = params
        half = wz * multiplier * self.track_width / 2.0
        return np.asarray(np.stack([vx - half, vx + half], axis=-1) / r)  # 1.4, 1.5


@kernel
def _twist(
    wheels: FloatArray,
    cg: FloatArray,
    params: FloatArray,
    constants: FloatArray,
    value: FloatArray,
    d_wheels: FloatArray,
    d_cg: FloatArray,
    d_params: FloatArray,
) -> None:
    """See `Twist.from_kernel`; ``constants`` (1,) is the track width."""
    r, multiplier = params[0], params[1]
    turn = r / (multiplier * constants[0])
    for i in range(wheels.shape[0]):
        q_l, q_r = wheels[i, 0], wheels[i, 1]
        wz = turn * (q_r - q_l)  # 1.8
        value[i, 0] = r * (q_l + q_r) / 2.0  # 1.6
        value[i, 2] = wz  # vy = 0 by 1.7

        d_wheels[i, 0, 0] = d_wheels[i, 0, 1] = r / 2.0
        d_wheels[i, 2, 0], d_wheels[i, 2, 1] = -turn, turn
        d_params[i, 0, 0] = (q_l + q_r) / 2.0
        d_params[i, 2, 0] = wz / r
        d_params[i, 2, 1] = -wz / multiplier
