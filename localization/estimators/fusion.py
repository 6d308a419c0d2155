"""Odometry: wheels, gyro and LiDAR in the filter, and the submap that the filter's poses draw. Poses are ``odom_T_body``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from localization.estimators.base import (
    NO_POINTS,
    Estimate,
    Estimator,
    GyroCalibration,
    LearnedParameter,
    Residuals,
    fuse_turn,
    mean_twist,
    twist_at_end,
)
from localization.estimators.filter import BIAS, CLOCK, MAP, PARAMS, POSE, RADIUS, SCALE, START, Filter, FilterConfig
from localization.events import Step
from localization.lidar import FORGETTING, OUTLIER_SIGMAS, LostScans, ScanMatchingSensor
from motion_models import se2
from motion_models.base import Motion, MotionModel
from motion_models.online_calibration import Corrections
from motion_models.robot import Robot
from motion_models.se2 import Cov3, FloatArray, Points2, Tangent2, Twist2

_PRIOR_SCANS = 0.2
"""Weight of white slip, as the wheels' noise model has it, in scans: the first key scans are drawn by then, and their error stays (NEES of
simulated rooms with weight 1: 1.6, with 0.2: 1.9; with white slip 4.7 and 4.8)."""

_MOVED_COV = np.diag([3.0, 3.0, 1.5]) ** 2
"""Covariance of the pose of a robot that was moved by other than its wheels: carried across a room, and turned to any side [m^2, m^2,
rad^2]."""
_MIN_CLOCK_OFFSET_S = 0.05
"""Smallest offset of the wheels' clock with a warning [s]: at 1 m/s and 1 rad/s, 5 cm and 3 deg."""


class EkfFusion(Estimator):
    """`step` after `step`: predict by the wheels, update by the gyro, match the scan, update by it; the submap grows afterwards."""

    def __init__(self, model: MotionModel, corrections: Corrections, robot: Robot, sensor: ScanMatchingSensor | None, config: FilterConfig):
        """``sensor``: None without a LiDAR; then there is no second clock until the gyro's first reading."""
        self._clock_sigma_s = config.clock_sigma_s if sensor is None else 0.0
        self.wheel_radius_sigma = 0.0 if "wheel_radius_scale" in corrections.names else config.wheel_radius_sigma
        """Prior sigma of the wheels' radius, which positions show to a graph without a LiDAR too; 0 where it is one of the corrections."""
        config = replace(config, wheel_radius_sigma=self.wheel_radius_sigma)
        if sensor is None:  # nothing measures ways
            config = replace(config, clock_sigma_s=0.0, wheel_radius_sigma=0.0)
        self.filter = Filter(robot.gyro_noise, corrections, config)
        self._sensor, self.model, self.corrections = sensor, model, corrections
        self._track_m = robot.geometry.track_width_m
        self._twist, self._slip = np.zeros(3), np.zeros(3)  # of the last step, and less that of the wheels
        self._slip_changes, self._file_delta = _SlipChanges(), np.zeros(3)
        self._is_slip_measured = self._has_gyro = self._is_scan_pending = False
        self.wheel_motion, self.is_turning = Motion(np.zeros(3), np.zeros((3, 3))), True
        """Motion of the last step by the wheels, with its scaled and outlier covariance; whether it excites the corrections."""
        self.used_corrections = self.filter.corrections
        """(k,) with which it was predicted."""
        self.counts_by_name = dict.fromkeys(("scans", "matched", "standing", "prior_outliers"), 0)

    @property
    def clock_offset_s(self) -> float:
        """Estimated offset of the wheels' clock [s]."""
        return self.filter.clock_offset

    @property
    def params(self) -> FloatArray:
        """Parameters of the motion model with their corrections."""
        return np.asarray(self.model.nominal + self.corrections.directions @ self.filter.corrections)

    @property
    def scan_points(self) -> Points2:
        """(M, 2) the last scan in the body frame [m], or (0, 2)."""
        return NO_POINTS if self._sensor is None else self._sensor.scan_points()

    @property
    def lidar_position(self) -> FloatArray:
        """(2,) where the LiDAR of the last scan is in the body frame [m]; zero without a LiDAR."""
        return np.zeros(2) if self._sensor is None else self._sensor.lidar_position()

    @property
    def cell(self) -> float:
        """Edge of the submap's voxels [m]; 0 before the first scan."""
        return 0.0 if self._sensor is None else self._sensor.cell

    @property
    def lost(self) -> LostScans | None:
        """Scans that could not be matched; None without a LiDAR."""
        return None if self._sensor is None else self._sensor.lost

    def step(self, step: Step) -> Estimate:
        """Predict, update by the gyro, update by the scan."""
        self.run_deferred()
        ekf, nis = self.filter, None
        self.used_corrections = ekf.corrections
        self.counts_by_name["standing"] += step.is_standing
        self.wheel_motion, self.is_turning = replace(step.predicted, cov=ekf.wheel_cov(step)), self._is_turning(step.predicted)
        by_corrections = step.predicted.d_params @ self.corrections.directions @ ekf.corrections
        self._file_delta = se2.compose(step.predicted.delta, se2.exp(-by_corrections))
        ekf.predict(step, self.is_turning)
        if step.turn is not None:
            self._start_gyro()
            ekf.update_turn(step.turn)
        if self._sensor is not None:
            nis = self._update_scan(step, self._sensor)
        twist, twist_cov = step.twist, None
        if step.duration > 0.0:
            twist, twist_cov = mean_twist(*ekf.motion_since(START), step.duration)
            self._twist, self._slip, self._is_slip_measured = twist, twist - step.mean_twist, nis is not None
            twist, twist_cov = self._twist_at_end(step, twist, twist_cov, is_measured=nis is not None)
        return Estimate(step.end_ns, ekf.pose, ekf.P[POSE, POSE].copy(), twist, twist_cov, nis)

    def _twist_at_end(self, step: Step, mean: Twist2, cov: Cov3, *, is_measured: bool) -> tuple[Twist2, Cov3]:
        """Twist (3,) at the stamp, by the ``mean`` of the step with its ``cov``, and by the gyro."""
        twist, cov = twist_at_end(mean, cov, step.twist_change, math.inf if is_measured or not step.has_wheels else step.duration)
        gyro = self.gyro_calibration
        rate = None if gyro is None or step.turn is None or step.is_standing else gyro.correct_rate(step.turn)
        return (twist, cov) if rate is None else fuse_turn(twist, cov, *rate)

    def run_deferred(self) -> None:
        """The last scan enters the submap, if it is a key scan. Deferred until its estimate is out."""
        if not self._is_scan_pending or self._sensor is None:
            return
        self._is_scan_pending = False
        ekf = self.filter
        if self._sensor.is_key(ekf.pose):
            ekf.insert_key_scan(self._sensor.insert_key_scan(ekf.pose, ekf.P[MAP, MAP].copy()))

    def _update_scan(self, step: Step, sensor: ScanMatchingSensor) -> float | None:
        """Match the scan of ``step`` and update by it; its NIS, or None where there is no scan or no match."""
        if step.scan is None:
            sensor.add_no_scan(step.end_ns, step.is_scan_excluded)
            return None
        ekf, duration = self.filter, step.duration
        self.counts_by_name["scans"] += 1
        prior, cov = ekf.pose, ekf.map_relative_cov()
        as_before = se2.exp(duration * self._twist)  # where wheels stall and catch up, the robot goes on as before
        match = sensor.measure(step, prior, cov, step.twist + self._slip, se2.log(se2.between(step.predicted.delta, as_before)))
        self._is_scan_pending = True
        if match is None:
            if sensor.moved_at_s == step.end_ns * 1e-9:
                ekf.P[POSE, POSE] += _MOVED_COV
                self.wheel_motion = replace(self.wheel_motion, cov=self.wheel_motion.cov + _MOVED_COV)
            return None
        R = match.cov
        if duration > 0.0:
            if self._is_slip_measured:  # else the pose at the start was not measured: its error would look like motion
                slip = se2.log(se2.between(ekf.start, match.pose)) / duration - step.mean_twist
                match = sensor.refine(match, step.twist + slip)
                self._slip_changes.add(slip - self._slip, match.cov, step, sensor.sweep_s)
            R = match.cov + sensor.intra_scan_slip_cov(match, self._slip_changes.rate(step))
        self.counts_by_name["matched"] += 1
        self.counts_by_name["prior_outliers"] += bool(match.outlier_cov.any())
        self.wheel_motion = replace(self.wheel_motion, cov=self.wheel_motion.cov + match.outlier_cov)
        return ekf.update_scan(match.measured, R, match.outlier_cov)

    def _is_turning(self, motion: Motion) -> bool:
        """Whether ``motion`` turns enough to excite the corrections."""
        d = motion.delta
        return bool(abs(d[2]) * self._track_m >= self.corrections.min_track_over_radius * math.hypot(d[0], d[1]))

    def _start_gyro(self) -> None:
        """With the gyro's first reading there is a second clock, from which the wheels' may be off."""
        if not self._has_gyro:
            self._has_gyro = True
            self.filter.P[CLOCK, CLOCK] += self._clock_sigma_s**2

    @property
    def gyro_calibration(self) -> GyroCalibration | None:
        """Bias and scale of the gyro by the filter; None where it was not used in the last step."""
        ekf = self.filter
        if ekf.turn_innovation is None:
            return None
        return GyroCalibration(ekf.bias, ekf.scale, float(ekf.P[BIAS, BIAS]), float(ekf.P[SCALE, SCALE]))

    @property
    def residuals(self) -> Residuals:
        """Residuals of the last step."""
        if self.filter.scan_innovation is None:
            return Residuals(self.filter.turn_innovation, self._file_delta)
        y, S = self.filter.scan_innovation
        way, turn = ((float(y[i]), float(S[i, i])) for i in (0, 2))
        return Residuals(self.filter.turn_innovation, self._file_delta, turn, way)

    def learned_parameters(self) -> Sequence[LearnedParameter]:
        """The motion model's parameters that are corrected, against the robot file."""
        ekf, nominal = self.filter, dict(zip(self.model.param_names, self.model.nominal, strict=True))
        sigmas, priors = np.sqrt(np.diagonal(ekf.P)[PARAMS:]), self.corrections.sigmas
        radius = LearnedParameter("wheel_radius_scale", ekf.radius_scale, math.sqrt(ekf.P[RADIUS, RADIUS]), 0.0, self.wheel_radius_sigma)
        return [radius] * (self._sensor is not None and self.wheel_radius_sigma > 0.0) + [
            LearnedParameter(name, nominal.get(name, 0.0) + change, sigma, nominal.get(name, 0.0), prior)
            for name, change, sigma, prior in zip(
                self.corrections.names, ekf.corrections.tolist(), sigmas.tolist(), priors.tolist(), strict=True
            )
        ]

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Mean and sigma of what the filter estimated besides the pose, by name."""
        ekf, found = self.filter, {}
        sigmas = np.sqrt(np.diagonal(ekf.P))
        if self._has_gyro:
            found["gyro_bias_rad_per_s"] = ekf.bias, float(sigmas[BIAS])
            found["gyro_scale"] = ekf.scale, float(sigmas[SCALE])
        if self._sensor is not None or self._has_gyro:
            found["wheel_clock_offset_s"] = ekf.clock_offset, float(sigmas[CLOCK])
        if sigmas[RADIUS]:
            found["wheel_radius_scale"] = ekf.radius_scale, float(sigmas[RADIUS])
        nominal = dict(zip(self.model.param_names, self.model.nominal, strict=True))
        for i, name in enumerate(self.corrections.names):
            found[name] = float(nominal.get(name, 0.0) + ekf.corrections[i]), float(sigmas[PARAMS + i])
        return found

    def counts(self) -> Mapping[str, int]:
        """Number of occurrences by name: scans, matched, searched, and those of lost scans by cause."""
        return self.counts_by_name if self._sensor is None else {**self.counts_by_name, **self._sensor.lost.causes}

    def warnings(self) -> list[str]:
        """A clock offset that is large and certain."""
        offset, sigma = self.filter.clock_offset, math.sqrt(self.filter.P[CLOCK, CLOCK])
        if abs(offset) < max(_MIN_CLOCK_OFFSET_S, OUTLIER_SIGMAS * sigma):
            return []
        others = "LiDAR" if not self._has_gyro else "gyro" if self._sensor is None else "LiDAR or gyro"
        direction = "later" if offset > 0.0 else "earlier"
        return [
            f"the wheels' stamps are {abs(offset):.2f} s {direction} than those of {others}, whose clock the poses have. Synchronize the"
            " clocks, or correct them by [clock] in the robot file: `skidloc diagnose` estimates each."
        ]

    def map_points(self) -> Points2:
        """(M, 2) points of the map in the world [m]; none without a LiDAR."""
        return NO_POINTS if self._sensor is None else self._sensor.map_points()


class FilteredOdometry(Estimator):
    """An estimator of poses in a map, whose odometry and learned states are those of an `EkfFusion`."""

    odometry: EkfFusion

    @property
    def clock_offset_s(self) -> float:
        """Estimated offset of the wheels' clock [s]."""
        return self.odometry.clock_offset_s

    @property
    def params(self) -> FloatArray:
        """Parameters of the motion model with their corrections."""
        return self.odometry.params

    @property
    def gyro_calibration(self) -> GyroCalibration | None:
        """See `EkfFusion.gyro_calibration`."""
        return self.odometry.gyro_calibration

    @property
    def residuals(self) -> Residuals:
        """See `EkfFusion.residuals`."""
        return self.odometry.residuals

    def learned_parameters(self) -> Sequence[LearnedParameter]:
        """See `EkfFusion.learned_parameters`."""
        return self.odometry.learned_parameters()

    @property
    def lost(self) -> LostScans | None:
        """See `EkfFusion.lost`."""
        return self.odometry.lost


class _SlipChanges:
    """How much of the wheels' noise is white, along each axis, by the slip of successive scans.

    Slip that lasts is in the twist that a sweep is deskewed with. White slip is not: it bends the scan.
    """

    def __init__(self) -> None:
        self._sum, self._weight = np.full(3, _PRIOR_SCANS), np.full(3, _PRIOR_SCANS)  # white, until measured
        self._last: Tangent2 | None = None  # change before the last scan [m, m, rad]

    def add(self, change: Twist2, scan_cov: Cov3, step: Step, sweep_s: float) -> None:
        """``change`` (3,) of the slip since the last scan [m/s, m/s, rad/s]; ``scan_cov`` (3, 3) of the scans that measured it.

        Changes c of the motion's error from step to step have E[c_k c_k+1] = -q for white slip with variance q a step, and hardly any
        covariance where slip lasts. Scans with noise n add -4 n. As a scan gives the mean over its sweep of T, it is -(1 - 2/3 T / dt) q.
        """
        if not step.has_wheels or step.is_standing:
            self._last = None
            return
        last, self._last = self._last, change * step.duration
        if last is None:
            return
        white = (1.0 - min(sweep_s / step.duration, 1.0) * 2.0 / 3.0) * np.diagonal(step.cov)
        scans = np.diagonal(scan_cov)
        is_inlier = np.maximum(last**2, self._last**2) < OUTLIER_SIGMAS**2 * (
            2.0 * white + 6.0 * scans
        )  # else wheels or scans are outliers
        excess = (-last * self._last - 4.0 * scans) / white
        self._sum = np.where(is_inlier, FORGETTING * self._sum + excess, self._sum)
        self._weight = np.where(is_inlier, FORGETTING * self._weight + 1.0, self._weight)

    def rate(self, step: Step) -> Cov3:
        """(3, 3) covariance a second of the slip in ``step`` that changes within a sweep, as a random walk."""
        if not step.has_wheels or step.is_standing:
            return np.zeros((3, 3))
        root = np.sqrt(np.maximum(self._sum / self._weight, 0.0))
        return np.asarray(root[:, None] * step.cov * root / step.duration)
