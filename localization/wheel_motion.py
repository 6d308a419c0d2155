"""The wheels' motion over an interval: their buffer, through the motion model, with gravity on slopes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from localization.attitude import Tilt
from localization.wheel_buffer import WheelBuffer
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.extended_model import SampleSeries, in_series, needs_series
from motion_models.friction.slope_effect import SlopeEffect, SlopeMotion
from motion_models.motion import Motion, Twist
from motion_models.preintegration import integrate_twists, noise_vector
from motion_models.robot import Robot
from motion_models.se2 import FloatArray, Twist2

_SLOPE_ERROR_S = 5.0
"""Correlation time of errors of the slope's effect [s]."""


class WheelMotion:
    """Wheel samples of the last seconds, and the motion that they make by a motion model at its present parameters."""

    def __init__(self, model: MotionModel, robot: Robot, max_hold_s: float, unknown_sigma: Twist2, has_slopes: bool) -> None:
        """``max_hold_s``: how long the last rates are held [s]; ``unknown_sigma`` (3,): of the twist where no wheel shows it;
        ``has_slopes``: gravity acts where the ground tilts."""
        self.model, self.params, self._needs_series = model, model.nominal, needs_series(model)
        self.buffer = WheelBuffer(robot.center_of_gravity)
        self._noise, self._max_hold_s, self._unknown_sigma = noise_vector(robot.wheel_noise), max_hold_s, unknown_sigma
        self._slope_effect = SlopeEffect.from_robot(robot) if has_slopes else None

    def twist_at(self, stamp_ns: int) -> tuple[FloatArray, Twist2]:
        """Rates (n, 2) at ``stamp_ns`` and the twist (3,) that they make; n = 0 and no twist where none is near."""
        rates, cg = self.buffer.at(stamp_ns, self._max_hold_s)
        return rates, self.model.twist(rates, cg, self.params).value.sum(axis=0)

    def integrate(
        self, start_ns: int, dt: FloatArray, rates: FloatArray, cg: FloatArray, tilt: Tilt | None
    ) -> tuple[Motion, FloatArray, FloatArray]:
        """Motion of the wheels over the intervals, its derivative by the wheels' clock (3,), and the twist (3,) at the end.

        A window that is late by c has motion exp(-c twist_before) delta exp(c twist_end): the derivative is the twist just before the end
        less that just before the start, expressed in the body frame at the end. It is not zero where each window has one wheel sample.
        """
        if not len(dt):
            return Motion(np.zeros(3), np.zeros((3, 3)), np.zeros((3, len(self.params)))), np.zeros(3), np.zeros(3)
        before, before_cg = self.buffer.at(start_ns - 1, self._max_hold_s)
        n = len(before)
        rates, cg = np.vstack([before, rates]), np.vstack([before_cg, cg])
        model = self.model
        if self._needs_series:
            since = np.r_[np.zeros(n), np.cumsum(dt) - dt] + (start_ns - (self.buffer.first_ns or start_ns)) * 1e-9
            model = in_series(model, SampleSeries(np.r_[np.zeros(n), dt], since))
        if tilt is None or self._slope_effect is None:
            twist = model.twist(rates, cg, self.params)
            inside = Twist(twist.value[n:], twist.d_wheels[n:], twist.d_cg[n:], twist.d_params[n:])
            motion = integrate_twists(dt, inside, self._noise)
        else:
            warp = self._slope_effect.warp_of(tilt.twist[0]), self._slope_effect.warp_of(tilt.twist[1])
            found = partial(self._slope_effect.twist, model, rates, cg, self.params, warp=warp)
            twist, motion = self._integrate_on_slope(found, dt, n, tilt)
        first, last = twist.value[0], twist.value[-1]
        return motion, last - se2.adjoint(se2.inverse(motion.delta)) @ first, last

    def _integrate_on_slope(self, effect: Callable[[FloatArray], SlopeMotion], dt: FloatArray, m: int, tilt: Tilt) -> tuple[Twist, Motion]:
        """Twists by ``effect`` at ``m`` samples before and n in the step, and the motion over its intervals ``dt`` (n,), with what is
        uncertain about the slope and the load on the diagonals in its covariance."""
        whole, k = float(dt.sum()), len(self.params)
        downhill = np.vstack([np.tile(tilt.before, (m, 1)), tilt.at((np.cumsum(dt) - 0.5 * dt) / whole)])
        twist, d_downhill, by_warp, limited = effect(downhill)
        by = np.concatenate([twist.d_params, d_downhill, by_warp], axis=-1)
        motion = integrate_twists(dt, Twist(twist.value[m:], twist.d_wheels[m:], twist.d_cg[m:], by[m:]), self._noise)
        D, B = motion.d_params[:, k : k + 2], motion.d_params[:, k + 2 :]
        cov = motion.cov + max(1.0, _SLOPE_ERROR_S / whole) * (D @ tilt.cov @ D.T + B @ B.T)
        limited_s = float(dt[limited[m:]].sum())
        if limited_s:  # tipping or sliding by itself: no wheel shows the motion
            cov = cov + np.diag(self._unknown_sigma**2) * limited_s * max(1.0, limited_s)
        return twist, Motion(motion.delta, cov, motion.d_params[:, :k], motion.d_cg)
