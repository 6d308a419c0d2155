"""Prediction between scans: the last estimate, propagated by the wheels to their newest message."""

from __future__ import annotations

from dataclasses import replace

from localization.estimators import Estimate
from localization.estimators.base import mean_twist
from localization.events import CgSample, Event, WheelSample
from localization.wheel_buffer import WheelBuffer
from motion_models import se2
from motion_models.base import Motion, MotionModel
from motion_models.preintegration import preintegrate
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_NS = 1e-9
_KEEP_S = 2.0
"""Wheel samples are stored for this long [s]."""
_MAX_HORIZON_S = 1.0
"""No prediction is published farther ahead of the last estimate [s]: without LiDAR one comes every 0.05 s, with a lost one every 0.3 s."""


class Predictor:
    """``odom_T_body`` at the wheels' rate. It holds copies: nothing that it does reaches the estimator, so a replay gives the same numbers.

    `insert` each event and `reset` with each estimate; `predict` then gives the pose at the newest wheel sample. At an estimate the
    predicted pose changes by that estimate's correction and by nothing else, for the same wheel motion is applied to both.
    """

    def __init__(self, model: MotionModel, robot: Robot, max_hold_s: float) -> None:
        """``max_hold_s``: gaps between wheel samples that are longer end the prediction [s]."""
        self._model, self._noise, self._max_hold_s = model, robot.wheel_noise, max_hold_s
        self._params = model.nominal
        self._wheels = WheelBuffer(robot.center_of_gravity, _KEEP_S)
        self._last: Estimate | None = None
        self._clock_offset_ns = 0

    def insert(self, event: Event) -> bool:
        """Store what ``event`` contributes; returns whether a new prediction is possible."""
        if isinstance(event, CgSample):
            self._wheels.set_cg(event)
        if not isinstance(event, WheelSample):
            return False
        self._wheels.insert(event)
        return self._last is not None

    def reset(self, estimate: Estimate, params: FloatArray | None, clock_offset_s: float) -> None:
        """Predict from ``estimate`` on, with ``params`` (k,) of the motion model (None: the nominal ones).

        ``clock_offset_s``: the wheels' stamps are late by this much [s].
        """
        self._last = estimate
        self._params = self._model.nominal if params is None else params
        self._clock_offset_ns = round(clock_offset_s / _NS)

    def stop(self) -> None:
        """Predict nothing until the next estimate."""
        self._last = None

    def predict(self) -> Estimate | None:
        """The estimate at the newest wheel sample; None where that is not newer than the last estimate, or the wheels have a gap since."""
        if self._last is None or self._wheels.rates_known_until_ns is None:
            return None
        begin_ns, end_ns = self._last.stamp_ns + self._clock_offset_ns, self._wheels.rates_known_until_ns
        if not 0 < end_ns - begin_ns <= _MAX_HORIZON_S / _NS:
            return None
        dt, rates, cg, missing = self._wheels.window(begin_ns, end_ns, self._max_hold_s)
        if missing or not len(dt):
            return None
        motion = preintegrate(self._model, dt, rates, cg, self._params, self._noise)
        return _propagated(self._last, motion, end_ns - self._clock_offset_ns)


def _propagated(last: Estimate, motion: Motion, stamp_ns: int) -> Estimate:
    """``last`` moved by ``motion``: right perturbations, P' = Ad(delta^-1) P Ad(delta^-1)^T + Q (Solà et al. 2018, eq. 55)."""
    twist, twist_cov = mean_twist(motion.delta, motion.cov, (stamp_ns - last.stamp_ns) * _NS)
    A = se2.adjoint(se2.inverse(motion.delta))

    def moved(pose: FloatArray, cov: FloatArray | None) -> tuple[FloatArray, FloatArray | None]:
        return se2.compose(pose, motion.delta), None if cov is None else A @ cov @ A.T + motion.cov

    pose, cov = moved(last.pose, last.covariance)
    odometry = None if last.odometry is None else moved(*last.odometry)
    return replace(last, stamp_ns=stamp_ns, pose=pose, covariance=cov, twist=twist, twist_covariance=twist_cov, nis=None, odometry=odometry)
