"""Odometry between scans: the last estimate, moved as wheels and gyro have since."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from localization.core.twist import CHANGE_SHARE, fuse_turn, mean_twist, twist_at_end
from localization.estimators import Estimate
from localization.estimators.estimator import GyroCalibration
from localization.events import CgSample, Event, Turn, WheelSample
from localization.wheel_buffer import WheelBuffer
from motion_models import se2
from motion_models.base import Motion, MotionModel
from motion_models.preintegration import integrate_twists, noise_vector
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_NS = 1e-9
_JITTER = 0.25
"""Share of the period by which a wheel message may come early and still be predicted to."""
_KEEP_S = 2.0
"""Wheel samples are stored for this long [s]."""
_MAX_HORIZON_S = 1.0
"""No prediction is published farther ahead of the last estimate [s]: without LiDAR one comes every 0.05 s, with a lost one every 0.3 s."""


class Predictor:
    """``odom_T_body`` at the rate of the wheels, with the turns of the gyro. It holds copies: nothing that it does reaches the estimator,
    so a replay gives the same numbers.

    `insert` each event and `reset` with each estimate; `predict` then gives the pose at the newest wheel sample. At an estimate the
    predicted pose changes by that estimate's correction and by nothing else, for the same motion of wheels and gyro is applied to both.
    """

    def __init__(self, model: MotionModel, robot: Robot, max_hold_s: float, max_rate_hz: float = math.inf) -> None:
        """``max_hold_s``: gaps between wheel samples that are longer end the prediction [s]. ``max_rate_hz``: more are not made [Hz]."""
        self._model, self._noise, self._max_hold_s = model, noise_vector(robot.wheel_noise), max_hold_s
        self._period_ns, self._due_ns = 1.0 / (max_rate_hz * _NS), -math.inf
        self._params = model.nominal
        self._wheels = WheelBuffer(robot.center_of_gravity, _KEEP_S)
        self._last: Estimate | None = None
        self._gyro: GyroCalibration | None = None
        self._clock_offset_ns = 0

    def insert(self, event: Event) -> bool:
        """Store what ``event`` contributes; returns whether a new prediction is possible, and due."""
        if isinstance(event, CgSample):
            self._wheels.set_cg(event)
        if not isinstance(event, WheelSample):
            return False
        self._wheels.insert(event)
        return self._last is not None and self._is_due(event.stamp_ns)

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether a period has passed, but for the jitter of the wheels' stamps; the mean rate is kept."""
        if stamp_ns < self._due_ns - _JITTER * self._period_ns:
            return False
        self._due_ns = (self._due_ns if stamp_ns - self._due_ns < self._period_ns else stamp_ns) + self._period_ns
        return True

    def reset(self, estimate: Estimate, params: FloatArray | None, clock_offset_s: float, gyro: GyroCalibration | None = None) -> None:
        """Predict from ``estimate`` on, with ``params`` (k,) of the motion model (None: the nominal ones).

        ``clock_offset_s``: the wheels' stamps are late by this much [s]. ``gyro``: None where it is not used.
        """
        self._last, self._gyro = estimate, gyro
        self._params = self._model.nominal if params is None else params
        self._clock_offset_ns = round(clock_offset_s / _NS)

    def begin(self, stamp_ns: int) -> None:
        """Predict from the origin on, where the robot is at ``stamp_ns``, with the nominal parameters."""
        self.reset(Estimate(stamp_ns, np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))), None, 0.0)

    def stop(self) -> None:
        """Predict nothing until the next estimate."""
        self._last = None

    def predict(self, measure_turn: Callable[[int, int], Turn | None] = lambda start_ns, end_ns: None) -> Estimate | None:
        """The estimate at the newest wheel sample; None where that is not newer than the last estimate, or the wheels have a gap since.

        ``measure_turn``: the gyro's turn between two stamps [ns].
        """
        if self._last is None or self._wheels.rates_known_until_ns is None:
            return None
        begin_ns, end_ns = self._last.stamp_ns + self._clock_offset_ns, self._wheels.rates_known_until_ns
        if not 0 < end_ns - begin_ns <= _MAX_HORIZON_S / _NS:
            return None
        dt, rates, cg, missing = self._wheels.window(begin_ns, end_ns, self._max_hold_s)
        if missing or not len(dt):
            return None
        by_model = self._model.twist(rates, cg, self._params)
        motion, duration = integrate_twists(dt, by_model, self._noise), (end_ns - begin_ns) * _NS
        mean, cov = mean_twist(motion.delta, motion.cov, duration)
        twist, twist_cov = twist_at_end(mean, cov, by_model.value[-1] - mean, duration)
        turn = None if self._gyro is None or not rates.any() else measure_turn(self._last.stamp_ns, end_ns - self._clock_offset_ns)
        if turn is not None and self._gyro is not None:
            way, way_cov = fuse_turn(se2.log(motion.delta), motion.cov, *self._gyro.correct_angle(turn))
            motion = Motion(se2.exp(way), way_cov)
            if (rate := self._gyro.correct_rate(turn)) is not None:
                change, variance = _change_of_rate(dt, by_model.value[:, 2], turn.rate_age_s)
                twist, twist_cov = fuse_turn(twist, twist_cov, rate[0] + change, rate[1] + variance)
        return _propagated(self._last, motion, twist, twist_cov, end_ns - self._clock_offset_ns)


def _change_of_rate(dt: FloatArray, rates: FloatArray, age_s: float) -> tuple[float, float]:
    """How much turn ``rates`` (n,) [rad/s] of intervals ``dt`` (n,) [s] change in the last ``age_s`` [s], since the gyro's newest sample;
    and its variance, by the second differences of the rates, which are 6 times that of one."""
    at = min(int(np.searchsorted(np.cumsum(dt[::-1]), age_s, side="right")), len(rates) - 1)
    change = float(rates[-1] - rates[-1 - at])
    if at == 0:
        return 0.0, 0.0
    scatter = float(np.mean(np.diff(rates, 2) ** 2)) / 3.0 if len(rates) > 2 else change**2
    return change, scatter + (CHANGE_SHARE * change) ** 2


def _propagated(last: Estimate, motion: Motion, twist: FloatArray, twist_cov: FloatArray, stamp_ns: int) -> Estimate:
    """``last`` moved by ``motion``: right perturbations, P' = Ad(delta^-1) P Ad(delta^-1)^T + Q (Solà et al. 2018, eq. 55)."""
    A = se2.adjoint(se2.inverse(motion.delta))

    def moved(pose: FloatArray, cov: FloatArray | None) -> tuple[FloatArray, FloatArray | None]:
        return se2.compose(pose, motion.delta), None if cov is None else A @ cov @ A.T + motion.cov

    pose, cov = moved(last.pose, last.covariance)
    odometry = None if last.odometry is None else moved(*last.odometry)
    in_space, in_map = (None if at is None else at.moved(motion.delta, motion.cov) for at in (last.in_space, last.in_map))
    return Estimate(stamp_ns, pose, cov, twist, twist_cov, None, odometry, last.map_T_odom, in_space, in_map)
