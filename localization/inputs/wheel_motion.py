"""The wheels' motion over an interval: their buffer, through the motion model, with gravity on slopes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from localization.inputs.attitude import Tilt
from localization.inputs.motion_on_slopes import MotionOnSlopes
from localization.inputs.wheel_buffer import WheelBuffer, WheelWindow
from localization.inputs.wheel_gaps import VelocityWithinIntervals
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.extended_model import horizon_s, in_series, needs_series
from motion_models.motion import Motion, Twist
from motion_models.preintegration import integrate_twists, noise_vector
from motion_models.robot import Robot
from motion_models.se2 import FloatArray, Twist2
from motion_models.term_memory import SampleSeries


class WheelMotion:
    """Wheel samples of the last seconds, and the motion that they make by a motion model at its present parameters."""

    def __init__(self, model: MotionModel, robot: Robot, max_hold_s: float, unknown_sigma: Twist2, has_slopes: bool) -> None:
        """``max_hold_s``: how long the last rates are held [s]; ``unknown_sigma`` (3,): of the twist where no wheel shows it;
        ``has_slopes``: gravity acts where the ground tilts."""
        self.model, self.params, self._needs_series = model, model.nominal, needs_series(model)
        self._horizon_ns = round(horizon_s(model) * 1e9)
        self.buffer = WheelBuffer(robot.center_of_gravity)
        self._noise, self._max_hold_s = noise_vector(robot.wheel_noise), max_hold_s
        self._within = VelocityWithinIntervals(unknown_sigma)
        self.on_slopes = MotionOnSlopes(robot, self._noise, unknown_sigma) if has_slopes else None

    def twist_at(self, stamp_ns: int) -> tuple[FloatArray, Twist2]:
        """Rates (n, 2) at ``stamp_ns`` and the twist (3,) that they make; n = 0 and no twist where none is near."""
        rates, cg = self.buffer.at(stamp_ns, self._max_hold_s)
        return rates, self.model.twist(rates, cg, self.params).value.sum(axis=0)

    def integrate(self, start_ns: int, window: WheelWindow, tilt: Tilt | None) -> tuple[Motion, FloatArray, FloatArray]:
        """Motion of the wheels over the ``window`` from ``start_ns`` on, its derivative by their clock (3,), and the twist (3,) at the end.

        A window that is late by c has motion exp(-c twist_before) delta exp(c twist_end): the derivative is the twist just before the end
        less that just before the start, expressed in the body frame at the end. It is not zero where each window has one wheel sample.
        """
        dt, rates, cg = window.dt, window.rates, window.cg
        if not len(dt):
            return Motion(np.zeros(3), np.zeros((3, 3)), np.zeros((3, len(self.params)))), np.zeros(3), np.zeros(3)
        before, before_cg = self.buffer.at(start_ns - 1, self._max_hold_s)
        ago = np.zeros(len(before))
        if self._horizon_ns:  # samples within the memory of the model's terms
            past = self.buffer.window(start_ns - self._horizon_ns, start_ns, self._max_hold_s)
            ago, before, before_cg = (past.dt, past.rates, past.cg) if len(past.dt) else (ago, before, before_cg)
        n = len(ago)
        rates, cg = np.vstack([before, rates]), np.vstack([before_cg, cg])
        model = self.model
        if self._needs_series:
            since = np.cumsum(np.r_[ago, dt]) - np.r_[ago, dt] - ago.sum() + (start_ns - (self.buffer.first_ns or start_ns)) * 1e-9
            model = in_series(model, SampleSeries(np.r_[ago, dt], since))
        if tilt is None or self.on_slopes is None:
            twist = model.twist(rates, cg, self.params)
            inside = Twist(twist.value[n:], twist.d_wheels[n:], twist.d_cg[n:], twist.d_params[n:])
            motion = integrate_twists(dt, inside, self._noise)
        else:
            twist, motion = self.on_slopes.integrate(model, self.params, dt, rates, cg, tilt)
        motion = replace(motion, cov=motion.cov + self._within.add(window, twist.value[n:]))
        first, last = twist.value[max(n - 1, 0)], twist.value[-1]
        return motion, last - se2.adjoint(se2.inverse(motion.delta)) @ first, last
