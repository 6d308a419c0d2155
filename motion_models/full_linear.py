"""The full linear model, with optional nonlinear slip terms.

Sources of the linear part: G. Anousaki, K. J. Kyriakopoulos, "A dead-reckoning scheme for skid-steered vehicles in outdoor
environments", ICRA 2004; T. Okawara et al., "Tightly-coupled LiDAR-IMU-wheel odometry with online calibration of a kinematic model for
skid-steering robots", IEEE Access 2024. The lateral slip by v wz is that of D. Baril et al., "DRIVE: data-driven robot input vector
exploration", ICRA 2024; the share of turning, with which a loss depends on the arc and not on
the speed, is of this project.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from motion_models.base import ModelBase
from motion_models.compiled import kernel, subroutine
from motion_models.errors import ModelError
from motion_models.motion import Twist
from motion_models.param import CENTRE_X_SIGMA_M, TURNING_SIGMA, Free, JointCorrection, Param, Scale, Traits
from motion_models.prior import slip_at_speed
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.se2 import FloatArray

_NEWTON_STEPS = 50
"""Most Newton steps of the inverse; commands that have a solution take under ten."""
_CONVERGED = 1e-12
"""Error of the inverse [m/s, rad/s], over 1 + the command: rounding."""
_LATERAL_SLIP_S, _ROTATION_SLIP_S_PER_M = 0.05, 0.01
"""Prior sigmas where there is none of the robot's own (`motion_models.prior.slip_at_speed`: 0.02 to 0.09 s, and under 0.01 s/m)."""
_DIRECTIONS = (
    # both columns by one factor: separate ones would turn a robot that drives straight, as a gyro bias does
    JointCorrection(
        "rotation_scale",
        *("1", "yaw rate of given wheel rates, relative", TURNING_SIGMA),
        {"wz_left": ("wz_left", 1.0), "wz_right": ("wz_right", 1.0)},
    ),
    JointCorrection(
        "x_cr",
        *("m", "centre of rotation ahead of the middle", CENTRE_X_SIGMA_M),
        {"vy_left": ("wz_left", -1.0), "vy_right": ("wz_right", -1.0)},
    ),
)


@dataclass(frozen=True)
class FullLinear(ModelBase):
    """A 3x2 matrix from wheel rates to twist, then six optional terms, all 0 unless the robot's file or a fit sets them.

    u = vx_left q_l + vx_right q_r     b = vy_left q_l + vy_right q_r     w = wz_left q_l + wz_right q_r
    vx = u (1 - longitudinal_slip_turning |w| - longitudinal_slip_curvature T)
    vy = b + lateral_slip_speed u w
    wz = w (1 - rotation_slip_speed |u| - rotation_slip_rate |w| - rotation_slip_curvature (1 - T))
    T  = (q_r - q_l)^2 / (2 (q_l^2 + q_r^2))

    T is the share of turning in the wheels' motion: 0 straight ahead, 1/2 with one side standing, 1 turning in place; it is free of
    scale. So the `_curvature` losses do not depend on speed, as Coulomb friction; the others grow with it. Units: m for
    the rows of vx and vy, 1 for those of wz; s for `_turning`, `_rate` and lateral_slip_speed; s/m for rotation_slip_speed.

    |u| and |w| have no derivative at 0; the mean of both sides (0) is returned there. At standstill T = 0 and the derivative is
    the matrix's, although with `_curvature` terms it depends on the direction in which the wheels set off. The terms are the first of
    a series: they hold where the brackets stay well above 0.
    """

    nominal: FloatArray
    """(12,) the matrix by rows, then the terms, in the order of `param_names`."""
    sigmas: FloatArray = field(default_factory=lambda: np.zeros(12))
    """(12,) standard deviations of terms of which only the size is known, from the robot's geometry (`motion_models.prior`); else 0."""
    name: ClassVar[str] = "full_linear"
    params: ClassVar[tuple[Param, ...]] = (
        Param("vx_left", "m/rad", "forward motion by the left wheels", Scale(0.3, wheel_radius=1), free=Free(logs=2, rotations=3)),
        Param(
            "vx_right",
            "m/rad",
            "forward motion by the right wheels",
            Scale(0.3, wheel_radius=1),
            free=Free(logs=6, rotations=5),
            mirror=("vx_left", 1.0),
        ),
        Param("vy_left", "m/rad", "sideways motion by the left wheels", Scale(0.1, wheel_radius=1), free=Free(logs=3, rotations=2)),
        Param(
            "vy_right",
            "m/rad",
            "sideways motion by the right wheels",
            Scale(0.1, wheel_radius=1),
            free=Free(logs=7, rotations=6),
            mirror=("vy_left", -1.0),
        ),
        Param(
            "wz_left",
            "rad/rad",
            "turning by the left wheels",
            Scale(0.3, wheel_radius=1, track_width=-1),
            free=Free(logs=1, turns=1, rotations=1),
        ),
        Param(
            "wz_right",
            "rad/rad",
            "turning by the right wheels",
            Scale(0.3, wheel_radius=1, track_width=-1),
            free=Free(logs=5, turns=2, rotations=4),
            mirror=("wz_left", -1.0),
        ),
        Param("lateral_slip_speed", "s", "sideways speed v wz times this", Scale(0.1), _LATERAL_SLIP_S, forms=()),
        Param("longitudinal_slip_turning", "s", "share of the forward speed lost per yaw rate", Scale(0.1)),
        Param("longitudinal_slip_curvature", "1", "forward speed lost to turning, at its most", Scale(0.1), free=Free(logs=4)),
        Param("rotation_slip_speed", "s/m", "share of the yaw rate lost per speed", Scale(0.1), _ROTATION_SLIP_S_PER_M, forms=()),
        Param("rotation_slip_rate", "s", "share of the yaw rate lost per yaw rate", Scale(0.1)),
        Param("rotation_slip_curvature", "1", "share of the yaw rate lost in straight driving, against turning in place", Scale(0.1)),
    )
    traits: ClassVar[Traits] = Traits(directions=_DIRECTIONS)

    @classmethod
    def from_robot(cls, robot: Robot) -> FullLinear:
        """For what [models.full_linear] does not name, the matrix of the robot's own diff-drive driver."""
        driver = robot.driver
        half = driver.wheel_radius_m / 2.0
        turn = driver.wheel_radius_m / (driver.wheel_separation_multiplier * driver.track_width_m)
        defaults = np.array([half, half, 0.0, 0.0, -turn, turn, *(0.0,) * 6])
        sigmas, own = np.zeros(12), robot.models.get(cls.name, {})
        if robot.drive != DIFF_DRIVE and not {"lateral_slip_speed", "rotation_slip_speed"} <= own.keys():
            sigmas[[6, 9]] = np.abs(slip_at_speed(robot))
            sigmas[[name in own for name in cls.param_names]] = 0.0
        return cls(robot.coefficients(cls.name, cls.param_names, defaults), sigmas)

    def twist(self, wheels: FloatArray, cg: FloatArray, params: FloatArray) -> Twist:
        """See `MotionModel.twist`."""
        return Twist.from_kernel(_twist, np.empty(0), wheels, cg, params)

    def wheels(self, command: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        """See `MotionModel.wheels`; a linear solve, then Newton steps for the terms.

        Raises `ModelError` for a command that no wheel rates give, which the losses make possible.
        """
        command, cg = np.broadcast_arrays(command, cg)
        wanted = command.reshape(-1, 2)
        cgs = cg.reshape(-1, 2)
        matrix = params[[0, 1, 4, 5]].reshape(2, 2)
        if abs(np.linalg.det(matrix)) < 1e-12:
            raise ModelError("full_linear: the rows of vx and wz are the same direction, so that no wheel rates steer the robot.")
        rates: FloatArray = np.asarray(np.linalg.solve(matrix, wanted.T).T, dtype=np.float64)
        error = self._residual(rates, wanted, cgs, params)
        for _ in range(_NEWTON_STEPS):
            if np.all(np.abs(error) <= _CONVERGED * (1.0 + np.abs(wanted))):
                # Losses beyond 100 %: by the formulas, wheels that turn backwards drive forward.
                against = np.any((rates @ matrix.T) * wanted < -1e-9, axis=1)
                if against.any():
                    raise self._no_rates(wanted[np.argmax(against)])
                return rates.reshape(command.shape)
            jacobian = self.twist(rates, cgs, params).d_wheels[:, [0, 2], :]
            step = np.linalg.pinv(jacobian) @ error[..., None]
            # Halve the step of each command until its error shrinks.
            scale = np.ones((len(rates), 1))
            for _ in range(30):
                tried = rates - scale * step[..., 0]
                off = self._residual(tried, wanted, cgs, params)
                worse = np.linalg.norm(off, axis=1) > np.linalg.norm(error, axis=1)
                if not worse.any():
                    break
                scale[worse] /= 2.0
            rates, error = tried, off
        raise self._no_rates(wanted[np.argmax(np.abs(error).max(axis=1))])

    @staticmethod
    def _no_rates(wanted: FloatArray) -> ModelError:
        return ModelError(
            f"full_linear: no wheel rates give vx = {wanted[0]:.4g} m/s with wz = {wanted[1]:.4g} rad/s; ask for a gentler arc."
        )

    def _residual(self, rates: FloatArray, wanted: FloatArray, cg: FloatArray, params: FloatArray) -> FloatArray:
        return np.asarray(self.twist(rates, cg, params).value[:, [0, 2]] - wanted)


@subroutine
def _sign(value: float) -> float:
    return 1.0 if value > 0.0 else (-1.0 if value < 0.0 else 0.0)


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
    """See `Twist.from_kernel`; ``constants`` is empty."""
    lateral, loss_w, loss_t = params[6], params[7], params[8]
    slip_u, slip_w, slip_t = params[9], params[10], params[11]
    for i in range(wheels.shape[0]):
        q_l, q_r = wheels[i, 0], wheels[i, 1]
        u = params[0] * q_l + params[1] * q_r
        b = params[2] * q_l + params[3] * q_r
        w = params[4] * q_l + params[5] * q_r
        difference, energy = q_r - q_l, 2.0 * (q_l * q_l + q_r * q_r)
        moving = energy > 0.0
        turning = difference * difference / energy if moving else 0.0

        forward = 1.0 - loss_w * abs(w) - loss_t * turning
        rotation = 1.0 - slip_u * abs(u) - slip_w * abs(w) - slip_t * (1.0 - turning)
        value[i, 0] = u * forward
        value[i, 1] = b + lateral * u * w
        value[i, 2] = w * rotation

        sign_u, sign_w = _sign(u), _sign(w)
        vx_by_u, vx_by_w = forward, -u * loss_w * sign_w
        wz_by_u, wz_by_w = -w * slip_u * sign_u, rotation - w * slip_w * sign_w
        for j in range(2):
            u_j, b_j, w_j, q_j = params[j], params[2 + j], params[4 + j], wheels[i, j]
            side = -1.0 if j == 0 else 1.0
            t_j = (2.0 * side * difference - 4.0 * q_j * turning) / energy if moving else 0.0
            d_wheels[i, 0, j] = vx_by_u * u_j + vx_by_w * w_j - u * loss_t * t_j
            d_wheels[i, 1, j] = b_j + lateral * (u_j * w + u * w_j)
            d_wheels[i, 2, j] = wz_by_u * u_j + wz_by_w * w_j + w * slip_t * t_j

            d_params[i, 0, j] = vx_by_u * q_j
            d_params[i, 1, j] = lateral * w * q_j
            d_params[i, 2, j] = wz_by_u * q_j
            d_params[i, 1, 2 + j] = q_j
            d_params[i, 0, 4 + j] = vx_by_w * q_j
            d_params[i, 1, 4 + j] = lateral * u * q_j
            d_params[i, 2, 4 + j] = wz_by_w * q_j
        d_params[i, 1, 6] = u * w
        d_params[i, 0, 7] = -u * abs(w)
        d_params[i, 0, 8] = -u * turning
        d_params[i, 2, 9] = -w * abs(u)
        d_params[i, 2, 10] = -w * abs(w)
        d_params[i, 2, 11] = -w * (1.0 - turning)
