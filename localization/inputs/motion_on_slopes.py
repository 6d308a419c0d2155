"""The wheels' motion where the ground tilts, with what is uncertain about the slope, the loads and the tyres in its covariance."""

from __future__ import annotations

import numpy as np

from localization.inputs.attitude import Tilt
from localization.inputs.tyre_friction import TyreFriction
from motion_models.base import MotionModel
from motion_models.friction.slope_effect import SlopeEffect
from motion_models.motion import Motion, Twist
from motion_models.preintegration import integrate_twists
from motion_models.robot import Robot
from motion_models.se2 import FloatArray, Twist2

_SLOPE_ERROR_S = 5.0
"""Correlation time of errors of the slope's effect [s]."""


class MotionOnSlopes:
    """`integrate` each step on a slope; slip stiffness and mu of the tyres are estimated on the way."""

    def __init__(self, robot: Robot, noise: FloatArray, unknown_sigma: Twist2) -> None:
        """``noise`` of the wheels (`motion_models.preintegration.noise_vector`); ``unknown_sigma`` (3,) of a twist that no wheel shows."""
        self._effect, self.tyres = SlopeEffect.from_robot(robot), TyreFriction()
        self._noise, self._unknown_sigma = noise, unknown_sigma

    def integrate(
        self, model: MotionModel, params: FloatArray, dt: FloatArray, rates: FloatArray, cg: FloatArray, tilt: Tilt
    ) -> tuple[Twist, Motion]:
        """Twists of ``model`` at ``params`` for ``rates`` (m + n, 2) and ``cg`` (m + n, 2), of m samples before the step and n in it, and
        the motion over its intervals ``dt`` (n,)."""
        whole, k, m = float(dt.sum()), len(params), len(rates) - len(dt)
        downhill = np.vstack([np.tile(tilt.before, (m, 1)), tilt.at((np.cumsum(dt) - 0.5 * dt) / whole)])
        warp = self._effect.warp_of(tilt.twist[0]), self._effect.warp_of(tilt.twist[1])
        twist, d_downhill, by_tyres, by_warp, limited = self._effect.twist(model, rates, cg, params, downhill, warp, self.tyres.logs)
        by = np.concatenate([twist.d_params, d_downhill, by_tyres, by_warp], axis=-1)
        motion = integrate_twists(dt, Twist(twist.value[m:], twist.d_wheels[m:], twist.d_cg[m:], by[m:]), self._noise)
        D, S, B = np.split(motion.d_params[:, k:], [2, 4], axis=1)
        lasting = max(1.0, _SLOPE_ERROR_S / whole)
        cov = motion.cov + lasting * (D @ tilt.cov @ D.T + B @ B.T)
        known = float(cov[2, 2])
        cov = cov + lasting * S @ self.tyres.cov @ S.T
        limited_s = float(dt[limited[m:]].sum())
        if limited_s:  # tipping or sliding by itself: no wheel shows the motion
            cov = cov + np.diag(self._unknown_sigma**2) * limited_s * max(1.0, limited_s)
        elif tilt.turn is not None:
            nominal = float(motion.delta[2] - motion.d_params[2, :k] @ (params - model.nominal))
            row = np.array([*S[2], nominal, tilt.turn.duration])
            self.tyres.update(tilt.turn.angle - nominal, row, known + tilt.turn.variance)
        return twist, Motion(motion.delta, cov, motion.d_params[:, :k], motion.d_cg)
