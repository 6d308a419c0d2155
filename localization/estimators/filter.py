"""Error-state extended Kalman filter on SE(2): wheels predict, gyro and scan matching update. One covariance.

The mean pose lives on the manifold; the error state's mean is zero (Sola 2017, "Quaternion kinematics for the error-state Kalman filter"),
with right perturbations: true pose = pose * exp(error).

    e = [ pose, start, map, key, gyro bias, gyro scale, clock offset, wheel radius, corrections ]

`start` and `key` are clones of the pose (Roumeliotis & Burdick 2002, stochastic cloning) at the start of the step and at the last
keyframe. `map` is the error of the submap around the robot, as a right perturbation of the pose. Scans that are matched to one submap
share that error, so it is a consider state (Schmidt 1966): its covariance and correlations count, its gain is zero, as the submap stays
where it is drawn. So is `key`: motions from keyframe to keyframe then add up to the filter's own trajectory. `wheel radius` is one while
scans leave the way open, as along a bare corridor, where noise of normals would be taken for a measurement of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import predict as predict_linear

from localization.errors import EstimatorError
from localization.estimators.measurement_models import predict_turn, submap_residual
from localization.events import Step, Turn
from localization.lidar import FORGETTING, OUTLIER_SIGMAS, KeyScanError
from localization.settings import Settings
from motion_models import se2
from motion_models.online_calibration import PRIOR_RETURNS_AFTER_S, Corrections
from motion_models.robot import GyroNoise
from motion_models.se2 import Cov3, FloatArray, Pose2

POSE, START, MAP, KEY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
BIAS, SCALE, CLOCK, RADIUS, PARAMS = 12, 13, 14, 15, 16
_MIN_VARIANCE = 1e-14
"""Variance of a relative motion, at least: a tenth of a micrometre or microradian [m^2, rad^2]."""
_MAX_NUMBER = 1e12
"""No state or covariance of a robot on Earth is larger, in SI units."""
_MIN_INFORMATION = 30.0
"""Information about the factor on the wheels' noise, at least: that of ten scans."""
_MAX_NOISE_SCALE = 20.0
"""Largest factor on the wheels' noise, as of `calibrate`. The least is 1: slip lasts, and what fits the innovation of one scan is too small
for the sum of many (ACES with a least scale of 1/4 for each axis: 0.099 -> 0.138 m)."""


@dataclass(frozen=True)
class FilterConfig(Settings):
    """Prior and process noise of the filter."""

    clock_sigma_s: float = 0.1
    """Sigma of the offset between the clocks of the wheels and of LiDAR or gyro at first [s]; 0 takes them as one."""
    clock_walk_s_per_sqrt_s: float = 1e-4
    """Random walk of the clock offset."""
    wheel_radius_sigma: float = 0.03
    """Prior sigma of the radius of all wheels, relative: wear, pressure and load of tyres; 0 takes the robot file's. It takes a LiDAR."""
    standstill_m2_per_s: float = 1e-6
    """Variance of the position while no wheel moves, per second: a push, a slope [m^2/s]."""
    standstill_rad2_per_s: float = 1e-6
    """Variance of the yaw while no wheel moves, per second: a push, a slope [rad^2/s]."""


class Filter:
    """State inside; `predict` and `update_...` advance it. All covariances are of right perturbations [m, m, rad]."""

    def __init__(self, gyro: GyroNoise, corrections: Corrections, config: FilterConfig) -> None:
        self._gyro, self._corrections, self._config = gyro, corrections, config
        n = PARAMS + len(corrections.names)
        self.pose, self.start, self.key = np.zeros(3), np.zeros(3), np.zeros(3)
        """(3,) estimates of the pose, and of its clones."""
        self.bias, self.scale, self.clock_offset, self.radius_scale = 0.0, 0.0, 0.0, 0.0
        self.corrections = np.zeros(len(corrections.names))
        """(k,) added to the motion model's parameters along the corrections' directions."""
        self.P = np.zeros((n, n))
        self.P[BIAS, BIAS], self.P[SCALE, SCALE] = gyro.bias_sigma_rad_per_s**2, gyro.scale_sigma**2
        self.P[CLOCK, CLOCK] = config.clock_sigma_s**2
        self.P[RADIUS, RADIUS] = config.wheel_radius_sigma**2
        self.P[PARAMS:, PARAMS:] = corrections.cov
        self.is_considered = np.zeros(n, dtype=bool)
        """(n,) states that have no gain."""
        self.is_considered[MAP] = self.is_considered[KEY] = True
        self.turn_innovation: tuple[float, float] | None = None
        """Innovation of the gyro in the last step and its variance [rad, rad^2]; None without a gyro."""
        self.scan_innovation: tuple[FloatArray, Cov3] | None = None
        """Innovation (3,) of the scan in the last step and its covariance (3, 3), where the prior is no outlier; None without a scan."""
        self.wheel_noise_scale = 1.0
        """Factor on the robot file's wheel noise, estimated from the innovations."""
        self._scale_information, self._slip_cov = 0.0, np.zeros((n, n))  # Fisher information; the part of P that is this step's slip

    def predict(self, step: Step, is_turning: bool = True) -> None:
        """Move by the wheels' motion (delta, covariance, derivatives) of ``step``:

        e_pose' = Ad(delta^-1) e_pose + (d delta / d clock) e_clock + (d delta / d radius) e_radius + (d delta / d params) e_params + slip.

        Ways scale with the wheels' radius; turns have a scale of their own among the parameters.

        Motion that is not ``is_turning`` does not excite the corrections: until the next step, they are consider states.
        """
        motion, dt = step.predicted, step.duration
        delta = motion.delta * [1.0 + self.radius_scale, 1.0 + self.radius_scale, 1.0]
        A = se2.adjoint(se2.inverse(delta))
        F = np.eye(len(self.P))
        F[POSE, POSE] = A
        F[POSE, CLOCK] = step.d_clock
        F[POSE, RADIUS] = np.append(-se2.inverse(motion.delta)[:2], 0.0)  # R^T (x, y)
        F[POSE, PARAMS:] = motion.d_params @ self._corrections.directions
        F[START, START], F[START, POSE] = 0.0, np.eye(3)  # the clone of the pose as it was
        F[MAP, MAP] = A  # the same error of the submap, as a perturbation of the present pose
        Q = np.zeros_like(self.P)
        Q[POSE, POSE] = self.wheel_cov(step)
        self._slip_cov = Q * (step.has_wheels and not step.is_standing)
        Q[BIAS, BIAS] = self._gyro.bias_walk_rad_per_s_sqrt_s**2 * dt
        if self.P[CLOCK, CLOCK]:  # else there is one clock
            Q[CLOCK, CLOCK] = self._config.clock_walk_s_per_sqrt_s**2 * dt
        if step.is_standing:
            c = self._config
            Q[POSE, POSE] += np.diag([c.standstill_m2_per_s, c.standstill_m2_per_s, c.standstill_rad2_per_s]) * dt
        else:
            Q[PARAMS:, PARAMS:] = self._corrections.process_noise * dt
            Q[RADIUS, RADIUS] = self._config.wheel_radius_sigma**2 / PRIOR_RETURNS_AFTER_S * dt
        _, P = predict_linear(np.zeros(len(F)), self.P, F=F, Q=Q)  # P = F P F^T + Q
        pose = se2.compose(self.pose, delta)
        _check(f"the motion of the wheels until stamp {step.end_ns} ns", pose, P)
        self.start, self.pose, self.P = self.pose, pose, P
        self.turn_innovation = self.scan_innovation = None
        self.is_considered[PARAMS:] = not is_turning

    def wheel_cov(self, step: Step) -> Cov3:
        """(3, 3) of the wheels' motion in ``step``, with the estimated scale."""
        return step.cov * (self.wheel_noise_scale if step.has_wheels and not step.is_standing else 1.0)

    def update_turn(self, turn: Turn) -> float:
        """The gyro's turn since the start of the step. Returns the normalised innovation squared (NIS, 1 degree of freedom)."""
        predicted, by_pose, by_start, by_bias, by_scale = predict_turn(self.start, self.pose, turn, self.bias, self.scale)
        H = np.zeros((1, len(self.P)))
        H[:, POSE], H[:, START], H[0, BIAS], H[0, SCALE] = by_pose, by_start, by_bias, by_scale
        innovation = se2.wrap_angle(np.array([turn.angle - predicted]))
        self.turn_innovation = float(innovation[0]), float((H @ self.P @ H.T)[0, 0]) + turn.variance
        return self._update(innovation, H, np.array([[turn.variance]]))

    def update_scan(self, measured: Pose2, R: Cov3, outlier_cov: Cov3) -> float:
        """The pose (3,) that a scan has in the submap, with the scan's covariance ``R`` (3, 3). Returns its NIS (3 degrees of freedom).

        ``outlier_cov`` (3, 3): what the wheels' motion is worse by than predicted.
        """
        innovation, by_pose, by_map = submap_residual(self.pose, measured)
        H = np.zeros((3, len(self.P)))
        H[:, POSE], H[:, MAP] = by_pose, by_map
        self.scan_innovation = innovation, H @ self.P @ H.T + R
        self.P[POSE, POSE] += outlier_cov
        self.is_considered[RADIUS] = R[0, 0] > H[0] @ self.P @ H[0]  # the scene leaves the way open
        return self._update(innovation, H, R, is_of_map=True)

    def insert_key_scan(self, error: KeyScanError) -> None:
        """The last scan is drawn into the submap from the pose as it is: e_map' = (1 - s) e_map + s e_pose + m."""
        G = np.eye(len(self.P))
        G[MAP, MAP], G[MAP, POSE] = (1.0 - error.share) * np.eye(3), error.share * np.eye(3)
        self.P = G @ self.P @ G.T
        self.P[MAP, MAP] += error.new_cov

    def start_key(self) -> None:
        """Clone the pose: `motion_since` (KEY) counts from here on."""
        F = np.eye(len(self.P))
        F[KEY, KEY], F[KEY, POSE] = 0.0, np.eye(3)
        self.key, self.P = self.pose, F @ self.P @ F.T

    def set_corrections(self, mean: FloatArray, cov: FloatArray) -> None:
        """Take the corrections from an estimator that has used this filter's measurements and others: mean (k,), covariance (k, k)."""
        self.corrections = mean
        self.P[PARAMS:, :] = self.P[:, PARAMS:] = 0.0
        self.P[PARAMS:, PARAMS:] = cov

    def map_relative_cov(self) -> Cov3:
        """(3, 3) covariance of the pose against the submap around the robot: that of the prior of a match."""
        P = self.P
        return _clip_eigenvalues(P[POSE, POSE] + P[MAP, MAP] - P[POSE, MAP] - P[MAP, POSE])

    def motion_since(self, clone: slice) -> tuple[Pose2, Cov3]:
        """Motion (3,) since the clone `START` or `KEY`, and its covariance (3, 3)."""
        delta = se2.between(self.start if clone == START else self.key, self.pose)
        A, P = se2.adjoint(se2.inverse(delta)), self.P
        cross = P[POSE, clone] @ A.T
        return delta, _clip_eigenvalues(P[POSE, POSE] - cross - cross.T + A @ P[clone, clone] @ A.T)

    def _update(self, innovation: FloatArray, H: FloatArray, R: FloatArray, is_of_map: bool = False) -> float:
        """Kalman update with consider states, in Joseph's form. Returns the NIS. Raises `EstimatorError`.

        Joseph's form is the covariance for any gain, and each row of K has an aim of its own: K_i = P_i H^T S^-1 minimises E (e_i - K_i
        y)^2 for innovation y, whatever the other rows are (bias, clock, clone `start`, radius, corrections). Consider states have K_i = 0
        (Schmidt 1966). For a measurement that ``is_of_map`` the pose's rows minimise the covariance of the pose relative to the submap,
        which has no gain: E |e_pose - e_map - K y|^2 is least at K = (P_pose - P_map) H^T S^-1, the difference of both optimal gains.
        With the pose's own optimal gain, a pose that is better known than the submap would stay off it, and later scans be matched from a
        wide prior.
        """
        P = self.P
        S = H @ P @ H.T + R
        _check("a measurement", innovation, S)
        K = np.asarray(np.linalg.solve(S, H @ P).T, dtype=float)  # P H^T S^-1
        if is_of_map:
            K[POSE] -= K[MAP]
        K[self.is_considered] = 0.0
        A = np.eye(len(P)) - K @ H
        self.P = _symmetric(A @ P @ A.T + K @ R @ K.T)
        _check("a measurement", self.P)
        self._adapt_wheel_noise_scale(innovation, np.asarray(np.linalg.inv(S), dtype=float), H @ self._slip_cov @ H.T)
        self._slip_cov = A @ self._slip_cov @ A.T
        self._move(K @ innovation)
        return float(innovation @ np.linalg.solve(S, innovation))

    def _adapt_wheel_noise_scale(self, innovation: FloatArray, S_inv: FloatArray, slip_cov: FloatArray) -> None:
        """One step of Fisher scoring for log a, where S = a dS/da + ..., ``slip_cov`` = a dS/da (maximum likelihood; Mehra 1970):

        2 d log p / d log a = y^T S^-1 (a dS/da) S^-1 y - tr(S^-1 a dS/da), twice the information tr((S^-1 a dS/da)^2), innovation y.

        Where slip has little share in S (wide priors, directions that the scene leaves open), there is little information.
        """
        share, gain = S_inv @ slip_cov, S_inv @ innovation
        expected = float(np.trace(share))
        score = min(float(gain @ slip_cov @ gain), OUTLIER_SIGMAS**2 * expected) - expected
        self._scale_information = FORGETTING * self._scale_information + float(np.trace(share @ share))
        step = score / max(self._scale_information, _MIN_INFORMATION)
        self.wheel_noise_scale = min(max(self.wheel_noise_scale * math.exp(step), 1.0), _MAX_NOISE_SCALE)

    def _move(self, error: FloatArray) -> None:
        """Move the means by the estimated ``error`` (n,)."""
        self.pose = se2.compose(self.pose, se2.exp(error[POSE]))
        self.start = se2.compose(self.start, se2.exp(error[START]))
        self.bias += float(error[BIAS])
        self.scale += float(error[SCALE])
        self.clock_offset += float(error[CLOCK])
        self.radius_scale += float(error[RADIUS])
        self.corrections = self.corrections + error[PARAMS:]


def _clip_eigenvalues(cov: FloatArray) -> Cov3:
    """``cov`` (n, n), a difference of large covariances, with eigenvalues of at least `_MIN_VARIANCE`: rounding leaves negative ones."""
    values, vectors = np.linalg.eigh(_symmetric(cov))
    return np.asarray((vectors * np.maximum(values, _MIN_VARIANCE)) @ vectors.T, dtype=float)


def _symmetric(P: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (P + P.T))


def _check(what: str, *arrays: FloatArray) -> None:
    """Raises `EstimatorError` for numbers that would spoil the state for good."""
    for array in arrays:
        if not (np.abs(array) < _MAX_NUMBER).all():
            raise EstimatorError(
                f"{what} has numbers that are not finite, or too large to compute with. Check that sensor's messages in the log."
            )
