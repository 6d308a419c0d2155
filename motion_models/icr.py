"""The ICR model: each side's tread turns about its own instantaneous centre of rotation (ICR), nearly fixed while the robot skids.

Sources: J. L. Martinez, A. Mandow, J. Morales, S. Pedraza, A. Garcia-Cerezo, "Approximating kinematics for tracked mobile robots",
Int. J. Robotics Research 24(10), 2005; A. Mandow, J. L. Martinez, J. Morales, J. L. Blanco, A. Garcia-Cerezo, J. Gonzalez, "Experimental
kinematics for wheeled skid-steer mobile robots", IROS 2007. The latter calls it EDD5, the extended differential drive with five
parameters. Their axes (x to the right, y ahead) are turned into REP-103 here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from motion_models.base import ModelBase
from motion_models.compiled import kernel
from motion_models.motion import Twist
from motion_models.param import CENTRE_X_SIGMA_M, TURNING_SIGMA, Free, Param, Scale, Traits
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.skid_steer import SkidSteer


@dataclass(frozen=True)
class Icr(ModelBase):
    """Five parameters: the three ICRs in the body frame [m], and the effectiveness alpha of each side: tread speed over r q [-].

    At its own ICR a side's tread does not slip lengthwise, so the body moves there as the tread does:

    alpha_s r q_s = vx - wz y_icr_s   for both sides s;   0 = vy + wz x_icr.

    ``y_icr_left`` is positive; the further the ICRs lie outside the wheels, the more the robot slips. A skid-steer robot with
    rotation scaling k has y_icr_left - y_icr_right = track / k. The CG does not enter: the parameters hold where they were fitted.
    """

    wheel_radius: float
    """[m]"""
    nominal: FloatArray
    """(5,) the parameters of the class's text, in the order of `param_names`."""
    sigmas: FloatArray = field(default_factory=lambda: np.zeros(5))
    """(5,) standard deviations of those that come from the robot's geometry (`motion_models.prior`); 0 for those of a calibration."""
    name: ClassVar[str] = "icr"
    params: ClassVar[tuple[Param, ...]] = (
        Param(
            "y_icr_left",
            *(
                "m",
                "where the left treads do not slip lengthwise, left of the middle",
                Scale(0.5, track_width=1),
                TURNING_SIGMA,
                "y_icr_left",
            ),
            free=Free(logs=1, turns=1, rotations=1),
        ),
        Param(
            "y_icr_right",
            *(
                "m",
                "where the right treads do not slip lengthwise, left of the middle (negative)",
                Scale(0.5, track_width=1),
                TURNING_SIGMA,
                "y_icr_left",
            ),
            free=Free(logs=5, turns=2, rotations=3),
            mirror=("y_icr_left", -1.0),
        ),
        Param(
            "x_icr",
            "m",
            "centre of rotation ahead of the middle",
            Scale(0.1, wheelbase=1),
            CENTRE_X_SIGMA_M,
            free=Free(logs=2, rotations=2),
        ),
        Param("alpha_left", "1", "effectiveness: tread speed of the left side over that of its wheels", Scale(0.3), free=Free(logs=3)),
        Param("alpha_right", "1", "effectiveness of the right side", Scale(0.3), free=Free(logs=4), mirror=("alpha_left", 1.0)),
    )
    traits: ClassVar[Traits] = Traits(is_level=True)

    @classmethod
    def from_robot(cls, robot: Robot) -> Icr:
        """For what [models.icr] does not name, the ICRs of the robot's `SkidSteer` at its nominal CG: y_icr = y_CR +- track / (2 k)."""
        skid = SkidSteer.from_robot(robot)
        k, x_cr, y_cr = (float(value) for value in skid.rotation(robot.center_of_gravity, skid.nominal))
        half = skid.track_width / (2.0 * k)
        defaults = np.array([y_cr + half, y_cr - half, x_cr, 1.0, 1.0])
        spread = half * float(skid.sigmas[0]) / k
        own = robot.models.get(cls.name, {})
        sigmas = np.array([spread, spread, float(skid.sigmas[3]), 0.0, 0.0])
        sigmas[[name in own for name in cls.param_names]] = 0.0
        return cls(skid.wheel_radius, robot.coefficients(cls.name, cls.param_names, defaults), sigmas)

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`."""
        return Twist.from_kernel(_twist, np.array([self.wheel_radius]), wheels, cg, params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`."""
        vx, wz = np.moveaxis(np.broadcast_arrays(command, cg)[0], -1, 0)
        y_left, y_right, _, alpha_left, alpha_right = params
        left, right = (vx - wz * y_left) / alpha_left, (vx - wz * y_right) / alpha_right
        return np.asarray(np.stack([left, right], axis=-1) / self.wheel_radius)


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
    """See `Twist.from_kernel`; ``constants`` (1,) is the wheel radius."""
    r = constants[0]
    y_l, y_r, x_icr, alpha_l, alpha_r = params[0], params[1], params[2], params[3], params[4]
    gap = y_l - y_r
    for i in range(wheels.shape[0]):
        v_l, v_r = alpha_l * r * wheels[i, 0], alpha_r * r * wheels[i, 1]  # speeds of the treads
        wz = (v_r - v_l) / gap
        vx = v_l + wz * y_l
        value[i, 0], value[i, 1], value[i, 2] = vx, -wz * x_icr, wz

        # By the speed of a tread, then by what that speed depends on.
        for j in range(2):
            vx_by_v = -y_r / gap if j == 0 else y_l / gap
            wz_by_v = -1.0 / gap if j == 0 else 1.0 / gap
            v_by_wheel = alpha_l * r if j == 0 else alpha_r * r
            v_by_alpha = r * wheels[i, j]
            d_wheels[i, 0, j] = vx_by_v * v_by_wheel
            d_wheels[i, 1, j] = -x_icr * wz_by_v * v_by_wheel
            d_wheels[i, 2, j] = wz_by_v * v_by_wheel
            d_params[i, 0, 3 + j] = vx_by_v * v_by_alpha
            d_params[i, 1, 3 + j] = -x_icr * wz_by_v * v_by_alpha
            d_params[i, 2, 3 + j] = wz_by_v * v_by_alpha

            wz_by_y = -wz / gap if j == 0 else wz / gap
            d_params[i, 0, j] = wz_by_y * y_l + (wz if j == 0 else 0.0)
            d_params[i, 1, j] = -x_icr * wz_by_y
            d_params[i, 2, j] = wz_by_y
        d_params[i, 1, 2] = -wz
