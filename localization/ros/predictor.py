"""Odometry between scans: the last estimate, moved as wheels and gyro have since."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from localization.core.twist import CHANGE_SHARE, SLIP_LASTS_S, TWIST_FLOOR
from localization.estimate import Estimate, GyroCalibration, WheelCalibration
from localization.events import Turn
from localization.inputs.step_config import StepConfig
from localization.inputs.wheel_buffer import WheelBuffer
from localization.inputs.wheel_gaps import UnknownVelocity
from motion_models.base import MotionModel
from motion_models.compiled import kernel, subroutine
from motion_models.linear_equations import assign
from motion_models.motion import Motion
from motion_models.online_calibration import WHEEL_RADIUS_SIGMA, make_corrections
from motion_models.preintegration import integrate, noise_vector
from motion_models.robot import Robot, WheelNoise
from motion_models.se2 import (
    FloatArray,
    fill_inverse_adjoint,
    fill_right_jacobian_inverse,
    retract,
    scalar_compose,
    scalar_exp,
    scalar_log,
    triple,
)

_NS = 1e-9
_JITTER = 0.25
"""Share of the period by which a wheel message may come early and still be predicted to."""
_MAX_HORIZON_NS = 5_000_000_000
"""From the last estimate to predictions that begin there, half of what a `WheelBuffer` keeps; later ones begin at the one before [ns].
Without LiDAR an estimate comes every 0.05 s, with a lost one every 0.3 s: it is a processor without time for the estimator."""

_NO_TURN = [math.nan] * 4
_NO_PARAMS, _NO_CG, _UNUSED_COV = np.zeros((3, 0)), np.zeros((3, 2)), np.zeros((3, 3))


class Predictor:
    """``odom_T_body`` at the rate of the wheels, with the turns of the gyro. It reads what the estimator's buffers hold and changes nothing
    there, so a replay gives the same numbers.

    `reset` with each estimate; `predict` at each wheel sample that `is_due` then gives the pose at the newest one. At an estimate the
    predicted pose changes by that estimate's correction and by nothing else, for the same motion of wheels and gyro is applied to both.
    """

    def __init__(self, model: MotionModel, robot: Robot, config: StepConfig, max_rate_hz: float = math.inf) -> None:
        """``config``: for how long the rates of the last wheel sample hold, and the unknown velocity after that. ``max_rate_hz``: more
        predictions are not made [Hz]."""
        self._model, self._slip, self._noise, self._config = model, robot.wheel_noise, noise_vector(robot.wheel_noise), config
        self._period_ns, self._due_ns = 1.0 / (max_rate_hz * _NS), -math.inf
        self._wheels = _prior(model)
        self.last: Estimate | None = None
        """What predictions begin at; None before the first estimate."""
        self._gyro: GyroCalibration | None = None
        self._clock_offset_ns = 0

    def is_due(self, stamp_ns: int) -> bool:
        """Whether a wheel sample can be predicted to, and a period has passed since the last one that was due, but for the jitter of its
        stamps; the mean rate is kept."""
        if self.last is None or stamp_ns < self._due_ns - _JITTER * self._period_ns:
            return False
        self._due_ns = (self._due_ns if stamp_ns - self._due_ns < self._period_ns else stamp_ns) + self._period_ns
        return True

    def reset(
        self, estimate: Estimate, wheels: WheelCalibration | None, clock_offset_s: float, gyro: GyroCalibration | None = None
    ) -> None:
        """Predict from ``estimate`` on, with ``wheels`` as they are calibrated (None: as before any drive).

        ``clock_offset_s``: the wheels' stamps are late by this much [s]. ``gyro``: None where it is not used.
        """
        self.last, self._gyro = estimate, gyro
        self._wheels = _prior(self._model) if wheels is None else wheels
        self._clock_offset_ns = round(clock_offset_s / _NS)

    def begin(self, stamp_ns: int) -> None:
        """The first wheel sample is of ``stamp_ns``: predict from the origin on, with the nominal parameters; or from the last estimate,
        moved by its twist until then, for at most as long as rates of the wheels hold."""
        if self.last is None:
            self.reset(Estimate(stamp_ns, np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))), None, 0.0)
            return
        held_ns = min(max(stamp_ns - self.last.stamp_ns, 0), round(self._config.max_hold_s / _NS))
        pose = retract(self.last.pose, held_ns * _NS * self.last.twist)
        self.advance(replace(self.last, stamp_ns=self.last.stamp_ns + held_ns, pose=pose))

    def advance(self, estimate: Estimate) -> None:
        """Predict from ``estimate`` on, with parameters and clocks as they are."""
        self.last = estimate

    def predict(
        self, wheels: WheelBuffer, measure_turn: Callable[[int, int], Turn | None] = lambda start_ns, end_ns: None
    ) -> Estimate | None:
        """The estimate at the newest sample of ``wheels``; None where that is not newer than the last estimate. A gap of the wheels since
        has the covariance of an unknown velocity.

        ``measure_turn``: the gyro's turn between two stamps [ns].
        """
        if self.last is None or wheels.rates_known_until_ns is None:
            return None
        begin_ns, end_ns = self.last.stamp_ns + self._clock_offset_ns, wheels.rates_known_until_ns
        if end_ns <= begin_ns:
            return None
        dt, rates, cg, _, missing = wheels.window(begin_ns, end_ns, self._config.max_hold_s)
        if not len(dt):
            return None
        by_model, calibration = self._model.twist(rates, cg, self._wheels.params), self._wheels
        twists = calibration.correct(by_model.value)
        turn = None if self._gyro is None or not rates.any() else measure_turn(self.last.stamp_ns, end_ns - self._clock_offset_ns)
        by_gyro = _NO_TURN
        if turn is not None and self._gyro is not None:
            by_gyro = [*self._gyro.correct_angle(turn), *_NO_TURN[2:]]
            if (rate := self._gyro.correct_rate(turn)) is not None:
                change, variance = _change_of_rate(dt, twists[:, 2], turn.rate_age_s)
                by_gyro[2:] = rate[0] + change, rate[1] + variance + _slip_change(self._slip, twists[-1], turn.rate_age_s)
        motion, twist, twist_cov = predicted_motion(dt, twists, self._noise, np.array(by_gyro))
        by_params = by_model.d_params[-1].copy()
        if turn is not None:  # a turn by the gyro has no error of the wheels
            by_params[2] = 0.0
        of_wheels = calibration.cov_of(twist, by_params)
        motion, twist_cov = replace(motion, cov=motion.cov + float(dt.sum()) ** 2 * of_wheels), twist_cov + of_wheels
        if missing:
            unknown = UnknownVelocity(self._config.unknown_sigma)
            unknown.measured = self.last.twist
            motion = replace(motion, cov=motion.cov + unknown.increment(missing, has_turn=turn is not None))
        predicted = _propagated(self.last, motion, twist, twist_cov, end_ns - self._clock_offset_ns)
        if end_ns - begin_ns > _MAX_HORIZON_NS:
            self.advance(predicted)
        return predicted


def _prior(model: MotionModel) -> WheelCalibration:
    """The wheels before a drive has shown anything of them."""
    found = make_corrections(model, "constant")
    return WheelCalibration(model.nominal, found.directions @ found.cov @ found.directions.T, 1.0, WHEEL_RADIUS_SIGMA**2)


def extrapolate(estimate: Estimate, stamp_ns: int) -> Estimate:
    """``estimate`` at another stamp, by its twist; the covariance grows by that of the twist times the time."""
    seconds = (stamp_ns - estimate.stamp_ns) * _NS
    twist_cov = np.zeros((3, 3)) if estimate.twist_covariance is None else estimate.twist_covariance
    motion = Motion(np.array(scalar_exp(triple(seconds * estimate.twist))), seconds**2 * twist_cov, _NO_PARAMS, _NO_CG)
    return _propagated(estimate, motion, estimate.twist, twist_cov, stamp_ns)


def predicted_motion(dt: FloatArray, twists: FloatArray, noise: FloatArray, turn: FloatArray) -> tuple[Motion, FloatArray, FloatArray]:
    """The motion by ``twists`` (n, 3) over intervals ``dt`` (n,) [s] with ``noise`` (8,), the twist at its end (3,), its covariance.

    ``turn`` (4,): angle and rate at the end by the gyro, each before its variance; NaN where not measured. These are `integrate_twists`,
    `twist_at_end` and `fuse_turn` of the estimators, in one compiled function: numpy takes sixty calls for them.
    """
    delta, cov, twist, twist_cov = np.zeros(3), np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    _predict(np.ascontiguousarray(dt), twists, noise, turn, delta, cov, twist, twist_cov)
    return Motion(delta, cov, _NO_PARAMS, _NO_CG), twist, twist_cov


@kernel
def _predict(
    dt: FloatArray,
    twists: FloatArray,
    noise: FloatArray,
    turn: FloatArray,
    delta: FloatArray,
    cov: FloatArray,
    twist: FloatArray,
    twist_cov: FloatArray,
) -> None:
    """Into the last four, of which the first two start at zero."""
    n, duration = len(dt), dt.sum()
    integrate(dt, twists, np.empty((n, 3, 0)), noise, delta, cov, np.empty((3, 0)))
    way, J = np.array(scalar_log(triple(delta))), np.empty((3, 3))
    fill_right_jacobian_inverse(triple(way), J)
    for i in range(3):
        assign(twist_cov[i], TWIST_FLOOR[i])
    _add_transformed(J, cov, min(duration / SLIP_LASTS_S, 1.0) / duration**2, twist_cov)
    for i in range(3):
        twist[i] = twists[n - 1, i]
        twist_cov[i, i] += (CHANGE_SHARE * (twist[i] - way[i] / duration)) ** 2
    if math.isfinite(turn[0]):
        _fuse_turn(way, cov, turn[0], turn[1])
        delta[0], delta[1], delta[2] = scalar_exp(triple(way))
    if math.isfinite(turn[2]):
        _fuse_turn(twist, twist_cov, turn[2], turn[3])


@subroutine
def _fuse_turn(way: FloatArray, cov: FloatArray, turn: float, variance: float) -> None:
    """`fuse_turn` of the estimators, in place; the last row, which the others need, comes last."""
    residual, S = turn - way[2], cov[2, 2] + variance
    for i in range(3):
        gain = cov[i, 2] / S
        way[i] += gain * residual
        for j in range(3):
            cov[i, j] -= gain * cov[2, j]


def _change_of_rate(dt: FloatArray, rates: FloatArray, age_s: float) -> tuple[float, float]:
    """How much turn ``rates`` (n,) [rad/s] of intervals ``dt`` (n,) [s] change in the last ``age_s`` [s], since the gyro's newest sample;
    and its variance, by the second differences of the rates, which are 6 times that of one."""
    if age_s < dt[-1] or len(rates) == 1:
        return 0.0, 0.0
    at = min(int(np.searchsorted(np.cumsum(dt[::-1]), age_s, side="right")), len(rates) - 1)
    change = float(rates[-1] - rates[-1 - at])
    scatter = float(np.mean(np.diff(rates, 2) ** 2)) / 3.0 if len(rates) > 2 else change**2
    return change, scatter + (CHANGE_SHARE * change) ** 2


def _slip_change(noise: WheelNoise, twist: FloatArray, age_s: float) -> float:
    """Variance by which the turn rate by slip has changed in ``age_s`` [s] at ``twist`` (3,) [rad^2/s^2]: of a Gauss-Markov process of
    density q and time constant tau, q / tau (1 - exp(-age / tau))."""
    density = noise.yaw_rad2_per_m * abs(twist[0]) + noise.yaw_rad2_per_rad * abs(twist[2]) + noise.floor_rad2_per_s
    return float(-2.0 * density / SLIP_LASTS_S * math.expm1(-2.0 * max(age_s, 0.0) / SLIP_LASTS_S))


def _propagated(last: Estimate, motion: Motion, twist: FloatArray, twist_cov: FloatArray, stamp_ns: int) -> Estimate:
    """``last`` moved by ``motion``."""

    def moved(pose: FloatArray, cov: FloatArray | None) -> tuple[FloatArray, FloatArray | None]:
        there, there_cov = np.empty(3), np.empty((3, 3))
        _move(pose, _UNUSED_COV if cov is None else cov, motion.delta, motion.cov, there, there_cov)
        return there, None if cov is None else there_cov

    pose, cov = moved(last.pose, last.covariance)
    odometry = None if last.odometry is None else moved(*last.odometry)
    in_space, in_map = (None if at is None else at.moved(motion.delta, motion.cov) for at in (last.in_space, last.in_map))
    return Estimate(stamp_ns, pose, cov, twist, twist_cov, None, odometry, last.map_T_odom, in_space, in_map)


@kernel
def _move(pose: FloatArray, cov: FloatArray, delta: FloatArray, Q: FloatArray, there: FloatArray, there_cov: FloatArray) -> None:
    """Right perturbations, P' = Ad(delta^-1) P Ad(delta^-1)^T + Q (Solà et al. 2018, eq. 55), into the last two."""
    A = np.empty((3, 3))
    fill_inverse_adjoint(triple(delta), A)
    there[0], there[1], there[2] = scalar_compose(triple(pose), triple(delta))
    for i in range(3):
        assign(there_cov[i], Q[i])
    _add_transformed(A, cov, 1.0, there_cov)


@subroutine
def _add_transformed(A: FloatArray, P: FloatArray, scale: float, out: FloatArray) -> None:
    """``scale`` A P A^T, of (3, 3), to ``out``."""
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += scale * A[i, k] * (P[k, 0] * A[j, 0] + P[k, 1] * A[j, 1] + P[k, 2] * A[j, 2])
