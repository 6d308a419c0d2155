"""The skid-steer model with a moving centre of gravity: rotation scaling k and centre of rotation (CoR), both functions of the CG."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeVar

import numpy as np

from motion_models.base import Twist
from motion_models.compiled import kernel, subroutine
from motion_models.prior import skid_prior
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_Number = TypeVar("_Number", float, FloatArray)
YcrVariant = Literal["multivariate", "full", "symmetric"]

# Ebersole 2016: 4.21 divided by its 1.875, 4.22; then y_CR as a polynomial in x_G (c) plus y_G times one (s).
_K = [0.9541 / 1.875, 0.1056 / 1.875, 46.902 / 1.875]
_X_CR = [-0.0635, 2.1722]
_Y_CR: dict[YcrVariant, list[float]] = {
    "multivariate": [-0.0006, -0.166, 0.0, -1.295, 0.0, 0.0],  # 4.23
    "full": [-0.0043, -0.2512, 1.5852, -1.6955, -0.2808, 115.18],  # 4.24
    "symmetric": [0.0, 0.0, 0.0, -1.6955, -0.2808, 115.18],  # 4.25, the thesis's choice
}


def thesis_coefficients(variant: YcrVariant = "symmetric") -> FloatArray:
    """(11,) coefficients that Ebersole 2016 fitted to VaultBot (eqs. 4.21, 4.22 and one of 4.23-4.25), in the model's order."""
    return np.array([*_K, *_X_CR, *_Y_CR[variant]])


@dataclass(frozen=True)
class SkidSteer:
    """Ebersole 2016, eqs. 4.6-4.18, with the regressions on the CG as parameters:

    k    = k_0 + k_1 x_G + k_2 x_G^2                                                   (4.21)
    x_CR = x_cr_0 + x_cr_1 x_G                                                         (4.22)
    y_CR = y_cr_0 + y_cr_1 x_G + y_cr_2 x_G^2 + (y_cr_s0 + y_cr_s1 x_G + y_cr_s2 x_G^2) y_G   (4.23-4.25)

    The inverse takes two inputs, vx and wz: vy = -wz x_CR follows and cannot be commanded.
    """

    wheel_radius: float
    """[m]"""
    track_width: float
    """[m]"""
    nominal: FloatArray
    """(11,) the coefficients above."""
    sigmas: FloatArray = field(default_factory=lambda: np.zeros(11))
    """(11,) standard deviations of those that come from the robot's geometry (`motion_models.prior`); 0 for those of a calibration."""
    name: ClassVar[str] = "skid_steer"
    param_names: ClassVar[tuple[str, ...]] = (
        *("k_0", "k_1", "k_2", "x_cr_0", "x_cr_1"),
        *("y_cr_0", "y_cr_1", "y_cr_2", "y_cr_s0", "y_cr_s1", "y_cr_s2"),
    )

    @classmethod
    def from_robot(cls, robot: Robot) -> SkidSteer:
        """The coefficients of [models.skid_steer]; what it does not name comes from the robot's geometry (`motion_models.prior`)."""
        radius, track, own = robot.geometry.wheel_radius_m, robot.geometry.track_width_m, robot.models.get(cls.name, {})
        if all(name in own for name in cls.param_names):
            return cls(radius, track, robot.coefficients(cls.name, cls.param_names, np.zeros(len(cls.param_names))))
        prior = skid_prior(robot)
        sigmas = np.array([0.0 if name in own else s for name, s in zip(cls.param_names, prior.sigmas, strict=True)])
        return cls(radius, track, robot.coefficients(cls.name, cls.param_names, prior.coefficients), sigmas)

    def rotation(self, cg: FloatArray, params: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """k [-], x_CR [m] and y_CR [m], each (...,), for ``cg`` (..., 2)."""
        return _rotation(cg[..., 0], cg[..., 1], params)

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`."""
        return Twist.from_kernel(_twist, np.array([self.wheel_radius, self.track_width]), wheels, cg, params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`. Raises nothing; a k of zero (a robot that cannot turn) gives infinite rates."""
        command, cg = np.broadcast_arrays(command, cg)
        vx, wz = np.moveaxis(command, -1, 0)
        k, _, y_cr = self.rotation(cg, params)
        forward = vx - wz * y_cr
        half = wz * self.track_width / (2.0 * k)
        return np.stack([forward - half, forward + half], axis=-1) / self.wheel_radius  # 4.17, 4.18


@subroutine
def _rotation(x: _Number, y: _Number, params: FloatArray) -> tuple[_Number, _Number, _Number]:
    """k [-], x_CR [m] and y_CR [m] for the CG ``x, y``: numbers, or arrays of one shape."""
    k_0, k_1, k_2, x_cr_0, x_cr_1 = params[0], params[1], params[2], params[3], params[4]
    c_0, c_1, c_2, s_0, s_1, s_2 = params[5], params[6], params[7], params[8], params[9], params[10]
    k = k_0 + (k_1 + k_2 * x) * x  # 4.21
    x_cr = x_cr_0 + x_cr_1 * x  # 4.22
    y_cr = c_0 + (c_1 + c_2 * x) * x + (s_0 + (s_1 + s_2 * x) * x) * y  # 4.23-4.25
    return k, x_cr, y_cr


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
    """See `Twist.from_kernel`; ``constants`` (2,) are the wheel radius and the track width."""
    r, d = constants[0], constants[1]
    k_1, k_2, x_cr_1 = params[1], params[2], params[4]
    c_1, c_2, s_0, s_1, s_2 = params[6], params[7], params[8], params[9], params[10]
    for i in range(wheels.shape[0]):
        q_l, q_r, x, y = wheels[i, 0], wheels[i, 1], cg[i, 0], cg[i, 1]
        k, x_cr, y_cr = _rotation(x, y, params)
        wz_per_k = r * (q_r - q_l) / d
        wz = k * wz_per_k  # 4.16
        value[i, 0] = r * (q_l + q_r) / 2.0 + wz * y_cr  # 4.14
        value[i, 1] = -wz * x_cr  # 4.15
        value[i, 2] = wz

        turn = k * r / d
        for j in range(2):
            wz_by_wheel = -turn if j == 0 else turn
            d_wheels[i, 0, j] = r / 2.0 + wz_by_wheel * y_cr
            d_wheels[i, 1, j] = -wz_by_wheel * x_cr
            d_wheels[i, 2, j] = wz_by_wheel

        wz_by_x = wz_per_k * (k_1 + 2.0 * k_2 * x)
        d_cg[i, 0, 0] = wz_by_x * y_cr + wz * (c_1 + 2.0 * c_2 * x + (s_1 + 2.0 * s_2 * x) * y)
        d_cg[i, 0, 1] = wz * (s_0 + (s_1 + s_2 * x) * x)
        d_cg[i, 1, 0] = -wz_by_x * x_cr - wz * x_cr_1
        d_cg[i, 2, 0] = wz_by_x

        power = 1.0
        for j in range(3):
            d_params[i, 0, j] = wz_per_k * power * y_cr
            d_params[i, 1, j] = -wz_per_k * power * x_cr
            d_params[i, 2, j] = wz_per_k * power
            if j < 2:
                d_params[i, 1, 3 + j] = -wz * power
            d_params[i, 0, 5 + j] = wz * power
            d_params[i, 0, 8 + j] = wz * power * y
            power *= x
