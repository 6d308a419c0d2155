"""The skid-steer model with a moving centre of gravity: rotation scaling k and centre of rotation (CoR), both functions of the CG."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeVar

import numpy as np

from motion_models.base import FieldPrior, ModelBase
from motion_models.compiled import kernel, subroutine
from motion_models.motion import Twist
from motion_models.param import CENTRE_X_SIGMA_M, CENTRE_Y_SIGMA_M, TURNING_SIGMA, Free, Param, Scale, Traits
from motion_models.prior import skid_prior
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_Number = TypeVar("_Number", float, FloatArray)
_IN_PLACE = 0.25
"""`Traits.min_track_over_radius`: on gentler arcs tyres creep, which regressions of rotations in place do not cover."""

# The rotations of Ebersole 2016, Ch. 4, to which the coefficients were fitted: positions of the CG [m], and the scatter
# about the fits of k [-], x_CR and y_CR [m] (`regressions.skid_steer_fit`). They give the covariance of the fits.
_GRID_X, _GRID_Y = np.arange(-3, 7) * 0.02, np.arange(-3, 4) * 0.01
_SCATTER_K, _SCATTER_X_CR, _SCATTER_Y_CR = 0.014517, 0.011514, 0.0059057
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
class SkidSteer(ModelBase):
    """Ebersole 2016, eqs. 4.6-4.18, with the regressions on the CG as parameters:

    k    = k_0 + k_1 x_G + k_2 x_G^2, at most 1 where k_0 is less                      (4.21)
    x_CR = x_cr_0 + x_cr_1 x_G                                                         (4.22)
    y_CR = y_cr_0 + y_cr_1 x_G + y_cr_2 x_G^2 + (y_cr_s0 + y_cr_s1 x_G + y_cr_s2 x_G^2) y_G   (4.23-4.25)

    Above an axle the wheels of that axle carry all of the robot and do not slide sideways: it turns as without slip, k = 1, which the
    parabola passes. A robot that does not skid at all (k_0 of 1 and more) has no such limit.

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
    params: ClassVar[tuple[Param, ...]] = (
        Param(
            "k_0",
            *("1", "k, yaw rate over that of wheels without slip, at CG x = 0", Scale(0.3), TURNING_SIGMA, "k_0"),
            free=Free(logs=1, moving_cg=1, turns=1),
        ),
        Param("k_1", "1/m", "change of k with the CG ahead", Scale(0.5, wheelbase=-1), free=Free(moving_cg=6)),
        Param("k_2", "1/m^2", "how k grows when the CG leaves the middle", Scale(5.0, wheelbase=-2), free=Free(moving_cg=5)),
        Param(
            "x_cr_0",
            *("m", "centre of rotation ahead of the middle, at CG x = 0", Scale(0.1, wheelbase=1), CENTRE_X_SIGMA_M),
            free=Free(logs=2, moving_cg=2),
        ),
        Param("x_cr_1", "1", "change of the centre of rotation ahead with the CG ahead", Scale(1.0), free=Free(moving_cg=4)),
        Param(
            "y_cr_0",
            *("m", "centre of rotation left of the middle, at CG (0, 0)", Scale(0.05, track_width=1), CENTRE_Y_SIGMA_M),
            free=Free(logs=3, moving_cg=3),
        ),
        Param("y_cr_1", "1", "change of the centre of rotation to the left with the CG ahead", Scale(1.0)),
        Param("y_cr_2", "1/m", "curvature of y_CR over the CG ahead", Scale(5.0, wheelbase=-1)),
        Param("y_cr_s0", "1", "change of the centre of rotation to the left with the CG left", Scale(1.0), free=Free(moving_cg=7)),
        Param("y_cr_s1", "1/m", "change of y_cr_s0 with the CG ahead", Scale(5.0, wheelbase=-1)),
        Param("y_cr_s2", "1/m^2", "curvature of y_cr_s0 over the CG ahead", Scale(10.0, wheelbase=-2)),
    )
    traits: ClassVar[Traits] = Traits(is_level=True, min_track_over_radius=_IN_PLACE)

    @classmethod
    def from_robot(cls, robot: Robot) -> SkidSteer:
        """The coefficients of [models.skid_steer]; what it does not name comes from the robot's geometry (`motion_models.prior`)."""
        radius, track, own = robot.geometry.wheel_radius_m, robot.geometry.track_width_m, robot.models.get(cls.name, {})
        if all(name in own for name in cls.param_names):
            return cls(radius, track, robot.coefficients(cls.name, cls.param_names, np.zeros(len(cls.param_names))))
        prior = skid_prior(robot)
        sigmas = np.array([0.0 if name in own else s for name, s in zip(cls.param_names, prior.sigmas, strict=True)])
        return cls(radius, track, robot.coefficients(cls.name, cls.param_names, prior.coefficients), sigmas)

    def field_prior(self) -> FieldPrior:
        """See `MotionModel.field_prior`: every coefficient of the regressions on the CG.

        Floors and loads drift; the misfit of the regressions does not change.
        """
        n = len(self.nominal)
        floor = np.zeros((n, 3))
        sigma_k = float(self.sigmas[0])
        turning = sigma_k / self.nominal[0] if sigma_k else TURNING_SIGMA
        floor[0:3, 0] = turning * self.nominal[0:3]  # another floor scales k at every CG
        floor[3, 1], floor[5, 2] = CENTRE_X_SIGMA_M, CENTRE_Y_SIGMA_M
        spread = floor @ floor.T
        return FieldPrior(_regression_cov() + spread, spread)

    def rotation(self, cg: FloatArray, params: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """k [-], x_CR [m] and y_CR [m], each (...,), for ``cg`` (..., 2)."""
        return _rotation(cg[..., 0], cg[..., 1], params)

    def rotation_by_cg(self, cg: FloatArray, params: FloatArray) -> FloatArray:
        """(3, 2) derivative of k, x_CR and y_CR by ``cg`` (2,)."""
        k_0, k_1, k_2, _, x_cr_1, _, c_1, c_2, s_0, s_1, s_2 = params
        x, y = cg
        k_by_x = k_1 + 2 * k_2 * x if self.rotation(cg, params)[0] < 1.0 or k_0 >= 1.0 else 0.0
        return np.array([[k_by_x, 0.0], [x_cr_1, 0.0], [c_1 + 2 * c_2 * x + (s_1 + 2 * s_2 * x) * y, s_0 + (s_1 + s_2 * x) * x]])

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


def _regression_cov() -> FloatArray:
    """(11, 11) covariance of the coefficients by the thesis's rotations: s^2 (X^T X)^-1 n / p for each regression.

    A CG position is off its regression by the scatter s systematically, not by noise that more rotations average out. The n samples over
    p coefficients give predictions that variance s^2, on the mean over the grid.
    """
    x, y = (a.ravel() for a in np.meshgrid(_GRID_X, _GRID_Y))
    reached = ~((x > 0.11) & (np.abs(y) > 0.025))  # without the two front corners, which the arms did not reach
    x, y = x[reached], y[reached]
    powers = np.stack([np.ones_like(x), x, x**2], axis=-1)
    designs = (_SCATTER_K, powers), (_SCATTER_X_CR, powers[:, :2]), (_SCATTER_Y_CR, np.hstack([powers, powers * y[:, None]]))
    cov, at = np.zeros((11, 11)), 0
    for scatter, design in designs:
        own = slice(at, at + design.shape[1])
        cov[own, own] = len(x) / design.shape[1] * scatter**2 * np.linalg.inv(design.T @ design)
        at = own.stop
    return cov


@subroutine
def _rotation(x: _Number, y: _Number, params: FloatArray) -> tuple[_Number, _Number, _Number]:
    """k [-], x_CR [m] and y_CR [m] for the CG ``x, y``: numbers, or arrays of one shape."""
    k_0, k_1, k_2, x_cr_0, x_cr_1 = params[0], params[1], params[2], params[3], params[4]
    c_0, c_1, c_2, s_0, s_1, s_2 = params[5], params[6], params[7], params[8], params[9], params[10]
    k = np.minimum(k_0 + (k_1 + k_2 * x) * x, 1.0 if k_0 < 1.0 else np.inf)  # 4.21
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

        is_below = k < 1.0 or params[0] >= 1.0  # else k is the limit, which no coefficient moves
        wz_by_x = wz_per_k * (k_1 + 2.0 * k_2 * x) if is_below else 0.0
        d_cg[i, 0, 0] = wz_by_x * y_cr + wz * (c_1 + 2.0 * c_2 * x + (s_1 + 2.0 * s_2 * x) * y)
        d_cg[i, 0, 1] = wz * (s_0 + (s_1 + s_2 * x) * x)
        d_cg[i, 1, 0] = -wz_by_x * x_cr - wz * x_cr_1
        d_cg[i, 2, 0] = wz_by_x

        power = 1.0
        for j in range(3):
            wz_by_k = wz_per_k * power if is_below else 0.0
            d_params[i, 0, j] = wz_by_k * y_cr
            d_params[i, 1, j] = -wz_by_k * x_cr
            d_params[i, 2, j] = wz_by_k
            if j < 2:
                d_params[i, 1, 3 + j] = -wz * power
            d_params[i, 0, 5 + j] = wz * power
            d_params[i, 0, 8 + j] = wz * power * y
            power *= x
