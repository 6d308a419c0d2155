"""The extended Kalman filter: wheels predict, gyro and LiDAR correct, on the manifold.

The mean lives on SE(2); filterpy carries the covariance of the error state, whose mean is zero before every update.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.stats import chi2

from localization.errors import EstimatorError
from localization.estimators.account import Account
from localization.estimators.contradiction import admit_doubt
from localization.estimators.error_states import cloned, inverse, is_usable, motion_covariance, moved, symmetric
from localization.estimators.revisit_update import revisit_update
from localization.gyro import Turn
from localization.lidar import MapTie, Revisit
from localization.residuals import fill_motion_residual, turn_residual
from localization.settings import Positive, Probability, Settings
from localization.steps import Step
from motion_models import se2
from motion_models.base import Motion
from motion_models.corrections import Corrections
from motion_models.robot import GyroNoise
from motion_models.se2 import FloatArray, triple

# Error state: the pose now, at the start of this step, and at the last scan (stochastic cloning); then what is learned on the way:
# the gyro's bias, the wheels' clock, and from PARAMS on the corrections of the motion model's parameters.
POSE, START, ANCHOR = slice(0, 3), slice(3, 6), slice(6, 9)
BIAS, CLOCK, PARAMS = 9, 10, 11


@dataclass(frozen=True)
class EkfConfig(Settings):
    """What the filter believes before it has seen anything."""

    clock_sigma_s: float = 0.05
    """How far the clocks of wheels and LiDAR may be apart [s]; 0 takes them as one."""
    clock_walk_s_per_sqrt_s: float = 1e-4
    """Random walk of the clock offset."""
    nudge_m2_per_s: float = 1e-6
    """Variance of the position while the wheels stand, per second: a push, a slope [m^2/s]."""
    nudge_rad2_per_s: float = 1e-6
    """The same for the yaw [rad^2/s]."""
    standing_sigma_m: Positive = 2e-4
    """How still standing still is, per step: sigma of the zero-velocity update [m]."""
    standing_sigma_rad: Positive = 1e-4
    """The same for the yaw [rad]."""
    gate_probability: Probability = 0.9999
    """A measurement that is less likely than one in 1 / (1 - this) says that one of the witnesses is wrong."""


class Ekf:
    """State in, state out by `predict` and the `measure_...` methods; each returns the normalised innovation squared (NIS)."""

    def __init__(
        self,
        gyro: GyroNoise,
        corrected: Corrections,
        config: EkfConfig | None = None,
        pose: FloatArray | None = None,
        has_mark: bool = False,
    ) -> None:
        """``has_mark``: `mark` will be asked for."""
        self.config, self._has_mark = config or EkfConfig(), has_mark
        self._gyro, self._corrected = gyro, corrected
        self._size = size = PARAMS + len(corrected.names)
        self.pose = np.zeros(3) if pose is None else np.array(pose, dtype=float)
        self._start, self._anchor = self.pose.copy(), self.pose.copy()
        # Predicted motions up to now, at which the covariance was moved along. Relative measurements must take their Jacobians there too:
        # taken at the corrected poses, metres of common drift would leak into them as knowledge of the heading that nobody has (Huang,
        # Mourikis, Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators", IJRR 2010).
        self._since_start, self._since_anchor = np.zeros(3), np.zeros(3)
        self.bias, self.clock_offset = 0.0, 0.0
        self._gate = float(chi2.ppf(self.config.gate_probability, 3))
        self._still = np.diag(np.array([self.config.standing_sigma_m, self.config.standing_sigma_m, self.config.standing_sigma_rad]) ** 2)
        self._filter = _filter(np.zeros((size, size)))
        self._filter.P[BIAS, BIAS] = gyro.bias_sigma_rad_per_s**2
        self._filter.P[CLOCK, CLOCK] = self.config.clock_sigma_s**2
        self._filter.P[PARAMS:, PARAMS:] = corrected.cov
        self._walks = {is_standing: self._walk(is_standing) for is_standing in (False, True)}
        self._account: Account | None = None  # until a scan meets a map
        self._now_ns = 0
        self.correction = np.zeros(len(corrected.names))
        """(k,) what is added to the model's parameters along the corrections' directions."""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_filter": self._filter.P}  # all that filterpy's filter knows between two updates

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({**state, "_filter": _filter(state["_filter"])})

    @property
    def covariance(self) -> FloatArray:
        """(11 + k, 11 + k) of the error state, k corrections."""
        return np.asarray(self._filter.P)

    @property
    def errors(self) -> FloatArray:
        """(11 + k, 11 + k) of the errors that are really made (`Account`): `covariance`, unless scans share a map."""
        return self.covariance if self._account is None else self._account.covariance

    @property
    def anchor(self) -> FloatArray:
        """(3,) estimate of the pose at the last scan that could be used."""
        return self._anchor

    @property
    def start(self) -> FloatArray:
        """(3,) estimate of the pose at the start of this step."""
        return self._start

    @property
    def gate(self) -> float:
        """The NIS beyond which a measurement contradicts the prediction."""
        return self._gate

    def _walk(self, is_standing: bool) -> FloatArray:
        """(11 + k, 11 + k) by which the covariance grows in a second, but for the clock."""
        c, Q = self.config, np.zeros((self._size, self._size))
        Q[BIAS, BIAS] = self._gyro.bias_walk_rad_per_s_sqrt_s**2
        if is_standing:
            Q[POSE, POSE] = np.diag([c.nudge_m2_per_s, c.nudge_m2_per_s, c.nudge_rad2_per_s])
        else:
            Q[PARAMS:, PARAMS:] = self._corrected.walk_cov
        return Q

    def predict(self, step: Step) -> None:
        """Move by what the wheels say; the error follows

        e' = Ad(delta^-1) e + (d delta / d clock) e_clock + (d delta / d params) e_params + slip.
        """
        predicted = step.predicted
        D = np.empty((3, self._size - CLOCK))
        D[:, 0], D[:, PARAMS - CLOCK :] = step.d_clock, predicted.d_params @ self._corrected.directions
        Q = self._walks[step.is_standing] * step.duration
        if self._filter.P[CLOCK, CLOCK]:
            Q[CLOCK, CLOCK] = self.config.clock_walk_s_per_sqrt_s**2 * step.duration
        Q[POSE, POSE] += predicted.cov
        P = moved(cloned(self._filter.P, START.start), predicted.delta, D, Q)
        pose = se2.compose(self.pose, predicted.delta)
        _check(f"the motion that the wheels predict until stamp {step.end_ns} ns", pose, P)
        self._filter.P, self._now_ns = P, step.end_ns
        if self._account is not None:
            self._account.clone(START.start)
            self._account.move(predicted.delta, D, Q)
        self._start, self._since_start = self.pose, predicted.delta
        self._since_anchor = se2.compose(self._since_anchor, predicted.delta)
        self.pose = pose

    def meet_clock(self, sigma_s: float) -> None:
        """A second clock is heard for the first time, and the wheels' may be off it by ``sigma_s`` [s]."""
        self._filter.P[CLOCK, CLOCK] += sigma_s**2
        if self._account is not None:
            self._account.add(slice(CLOCK, CLOCK + 1), sigma_s**2)

    def measure_turn(self, turn: Turn) -> float:
        """The gyro's turn since the start of the step."""
        error = turn_residual(self._start, self.pose, turn.angle, self.bias, turn.duration)
        _check("the gyro's turn", np.array([error, turn.variance, turn.duration]))
        H = np.zeros((1, self._size))
        H[0, POSE.start + 2], H[0, START.start + 2], H[0, BIAS] = 1.0, -1.0, turn.duration
        return self._update(np.array([error]), H, np.array([[turn.variance]]))

    def measure_standing(self) -> float:
        """The robot did not move since the start of the step."""
        error, H = _relative(self._start, self.pose, np.zeros(3), self._since_start, START.start, self._size)
        return self._update(error, H, self._still)

    def measure_motion(self, measured: Motion, trust: float, tie: MapTie | None = None) -> float:
        """The LiDAR's motion since the last scan.

        Where it contradicts the prediction, it is right with the probability ``trust``, and the wheels slipped; else it is wrong: see
        `admit_doubt`. ``tie``: the map by which it was measured; without one, errors of scans are taken as independent.
        """
        error, H = _relative(self._anchor, self.pose, measured.delta, self._since_anchor, ANCHOR.start, self._size)
        d_pose = H[:, POSE].copy()
        cov = measured.cov
        R = d_pose @ cov @ d_pose.T
        S = H @ self._filter.P @ H.T + R
        _check("the motion that the LiDAR measured", error, S)
        nis = float(error @ inverse(S) @ error)
        if tie is not None and self._account is None:
            drawn = np.zeros((3, self._size))
            drawn[:, ANCHOR] = se2.adjoint(se2.inverse(self._since_anchor))
            self._account = Account(self._filter.P, drawn, self._gate, self._has_mark)
        if nis > self._gate:
            slip, cov = admit_doubt(error, nis, self._gate, trust, S, cov)
            self._filter.P[POSE, POSE] += slip
            if self._account is not None:
                self._account.add(POSE, slip)
            R = d_pose @ cov @ d_pose.T
        self._correct(error, H, R)
        if self._account is not None and tie is not None:
            self._account.see(self._filter.K, d_pose, measured.cov, tie, cov - measured.cov)
        elif self._account is not None:
            self._account.correct(self._filter.K, H, R)
        return nis

    def measure_revisit(self, known: Revisit) -> None:
        """A place seen again (`revisit_update`). START and ANCHOR move with the pose as one rigid body: the way since then stays."""
        start_T_now, anchor_T_now = se2.between(self._start, self.pose), se2.between(self._anchor, self.pose)
        tied = np.zeros((self._size, 3))
        tied[POSE], tied[START], tied[ANCHOR] = np.eye(3), se2.adjoint(start_T_now), se2.adjoint(anchor_T_now)
        shift, gain, self._filter.P = revisit_update(self.covariance, POSE, tied, known, self.pose)
        if self._account is not None:
            self._account.revisit(gain, tied, known, self._now_ns, self.pose)
        self.pose = se2.compose(self.pose, se2.exp(shift))
        self._start = se2.compose(self.pose, se2.inverse(start_T_now))
        self._anchor = se2.compose(self.pose, se2.inverse(anchor_T_now))

    def mark(self) -> FloatArray | None:
        """(3, 3) covariance of the motion since the pose that was last marked, at first that of the first scan, by the errors that are
        really made; the pose now is marked. None until scans share a map."""
        return None if self._account is None else self._account.mark()

    def set_anchor(self, is_drawn: bool = True) -> None:
        """From here on, the LiDAR measures from the pose as it is now. ``is_drawn``: its map has got the scan, too."""
        self._filter.P = cloned(self._filter.P, ANCHOR.start)
        if self._account is not None:
            self._account.draw(is_drawn)
            self._account.clone(ANCHOR.start)
            self._account.remember(self._now_ns, self.pose)
        self._anchor, self._since_anchor = self.pose, np.zeros(3)

    def motion_cov(self, delta: FloatArray) -> FloatArray:
        """(3, 3) of the motion of this step, which is ``delta`` (3,), by the errors that are really made."""
        return np.asarray(motion_covariance(self.errors, START.start, delta))

    def _update(self, error: FloatArray, H: FloatArray, R: FloatArray) -> float:
        """`_correct`, with errors R that have no part in a map."""
        nis = self._correct(error, H, R)
        if self._account is not None:
            self._account.correct(self._filter.K, H, R)
        return nis

    def _correct(self, error: FloatArray, H: FloatArray, R: FloatArray) -> float:
        """``error`` is prediction minus measurement; the error state's mean is zero, so the innovation is its negative."""
        f, before = self._filter, self._filter.P
        f.x = np.zeros((self._size, 1))
        try:
            f.update(-error[:, None], R, H)
            P = symmetric(f.P)
            _check("a measurement", f.x, P)
        except EstimatorError:
            f.P = before
            raise
        f.P, correction = P, f.x[:, 0]
        self.pose, self._start, self._anchor = _shifted(self.pose, self._start, self._anchor, correction)
        self.bias += float(correction[BIAS])
        self.clock_offset += float(correction[CLOCK])
        self.correction = self.correction + correction[PARAMS:]
        return float(error @ f.SI @ error)


@numba.njit(cache=True)
def _relative(
    earlier: FloatArray, pose: FloatArray, measured: FloatArray, since: FloatArray, at: int, size: int
) -> tuple[FloatArray, FloatArray]:  # pragma: no cover
    """`motion_residual` (3,) from a pose ``earlier``, whose states begin at ``at``, to the pose now, and its H (3, size).

    ``since`` (3,): the motion in between as it was predicted.
    """
    d_earlier, d_pose, A, H = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, size))
    error = fill_motion_residual(triple(earlier), triple(pose), triple(measured), d_earlier, d_pose)
    se2.fill_adjoint(se2.scalar_inverse(triple(since)), A)
    for i in range(3):
        for j in range(3):
            H[i, j] = d_pose[i, j]
            for k in range(3):
                H[i, at + j] -= d_pose[i, k] * A[k, j]
    return np.array(error), H


@numba.njit(cache=True)
def _shifted(pose: FloatArray, start: FloatArray, anchor: FloatArray, error: FloatArray) -> FloatArray:  # pragma: no cover
    """(3, 3) the poses, moved by what was found of their ``error``, in the order of the states."""
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = se2.scalar_compose(triple(pose), se2.scalar_exp((error[0], error[1], error[2])))
    out[1, 0], out[1, 1], out[1, 2] = se2.scalar_compose(triple(start), se2.scalar_exp((error[3], error[4], error[5])))
    out[2, 0], out[2, 1], out[2, 2] = se2.scalar_compose(triple(anchor), se2.scalar_exp((error[6], error[7], error[8])))
    return out


def _filter(P: FloatArray) -> KalmanFilter:
    """Of the error state, in which all is linear."""
    found = KalmanFilter(dim_x=len(P), dim_z=3)
    found.P, found.inv = P, _inverse
    return found


def _inverse(S: FloatArray) -> FloatArray:
    """Of an innovation's covariance, by filterpy, before it changes anything. Raises `EstimatorError`."""
    _check("a measurement", S)
    return inverse(S)


def _check(what: str, *arrays: FloatArray) -> None:
    """A state that is not finite is never taken over: everything after it would be lost without a word."""
    for array in arrays:
        if not is_usable(array.ravel()):
            raise EstimatorError(f"{what} has numbers that are not finite, or too large to compute with. Look at its source in the log.")
