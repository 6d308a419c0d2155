"""Odometry: wheels, gyro and LiDAR in the filter, and the submap that the filter's poses draw. Poses are ``odom_T_body``."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from localization.core.filter import (
    Innovation,
    Measurement,
    add_change,
    augment,
    clone,
    inflate,
    inflate_both,
    propagate,
    set_marginal,
    update,
    widen,
)
from localization.core.measurements.scan import key_scan_transition, measure_scan
from localization.core.measurements.standstill import measure_bias, measure_standstill
from localization.core.measurements.turn import measure_turn
from localization.core.motion import FilterConfig, NoiseModel, initial_state, wheel_transition
from localization.core.policies.clock_offset import ClocksApart, clock_warnings, find_clocks_apart, unmeasured_start
from localization.core.policies.continuous_pose import ContinuousPose
from localization.core.policies.excitation import Excitation
from localization.core.policies.open_way import OpenWay
from localization.core.policies.outlier import NOTHING_MISSED, PriorOutlier
from localization.core.policies.slip import SweepSlip
from localization.core.policies.standstill import BIAS_CHANGE_COV, BiasChange, StandstillTest
from localization.core.policies.wheel_noise import WheelNoiseScale
from localization.core.state import State, Vector
from localization.core.twist import fuse_turn, mean_twist, slip_change_cov, twist_at_end, wheel_twist_cov
from localization.estimate import Estimate, GyroCalibration, WheelCalibration
from localization.estimators.estimator import NO_POINTS, Estimator, LearnedParameter, Residuals
from localization.events import Step
from localization.lidar import LostScans, ScanMatchingSensor
from localization.messages import Message
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.motion import Motion
from motion_models.online_calibration import Corrections
from motion_models.robot import Robot
from motion_models.se2 import Cov3, FloatArray, Points2, Twist2

_REPEATED_S = 0.5
"""Scans from one place have the same errors: those of a robot at rest count no more from about this time on [s]."""


@dataclass(frozen=True, eq=False)
class LastStep:
    """What wheels, gyro and scan have measured in the last step."""

    motion: Motion
    """Predicted by the wheels; its covariance includes the noise scale and outliers."""
    corrections: FloatArray
    """(k,) of the motion model, with which it was predicted."""
    is_turning: bool
    """Whether it excites the corrections."""
    turn: Innovation | None = None
    """Innovation of the gyro."""
    scan: Innovation | None = None
    """Innovation of the matched scan, as if the prior were no outlier."""


@dataclass(eq=False)
class Policies:
    """What is not nominal about a step, one object each."""

    excitation: Excitation
    standstill: StandstillTest
    continuous: ContinuousPose | None
    """None where scans hold the pose."""
    wheel_noise: WheelNoiseScale = field(default_factory=WheelNoiseScale)
    slip: SweepSlip = field(default_factory=SweepSlip)
    outlier: PriorOutlier = field(default_factory=PriorOutlier)
    open_way: OpenWay = field(default_factory=OpenWay)


class EkfFusion(Estimator):
    """`step` after `step`: predict by the wheels, update by the gyro, match the scan, update by it; the submap grows afterwards."""

    def __init__(self, model: MotionModel, corrections: Corrections, robot: Robot, sensor: ScanMatchingSensor | None, config: FilterConfig):
        """``sensor``: None without a LiDAR."""
        if "wheel_radius_scale" in corrections.names:  # one variable for it
            config = replace(config, wheel_radius_sigma=0.0)
        self.model, self._sensor = model, sensor
        self.noise = NoiseModel(robot.wheel_noise, robot.gyro_noise, corrections, config)
        state = initial_state(self.noise, has_lidar=sensor is not None)
        self.state = augment(state, "bias_change", Vector(2), np.zeros(2), BIAS_CHANGE_COV)
        """Means and covariance at the end of the last step."""
        excitation = Excitation(robot.geometry.track_width_m, corrections.min_track_over_radius, ("bias_change",))
        standstill = StandstillTest(robot.gyro_noise.bias_sigma_rad_per_s)
        self._policies = Policies(excitation, standstill, ContinuousPose() if sensor is None else None)
        self.last = LastStep(Motion(np.zeros(3), np.zeros((3, 3))), self.state["corrections"], is_turning=True)
        self._has_gyro = self._is_scan_pending = False
        self.counts_by_name = dict.fromkeys(("scans", "matched", "standing"), 0)

    def step(self, step: Step) -> Estimate:
        """Predict, update by the gyro, update by the scan."""
        self.run_deferred()
        policies = self._policies
        motion, unseen = replace(step.predicted, cov=policies.wheel_noise.start_step(self.state, step)), policies.open_way.cov(step)
        policies.excitation.start_step(motion)
        if step.restarts_calibration:
            self._restart_calibration()
        if step.restarts_map and self._sensor is not None:
            self._sensor.begin_submap()
        step, bias = policies.standstill.add(self.state, step)
        if bias is not None:
            self.state = widen(self.state, "gyro_bias", bias.prior_variance)
            self.state = add_change(self.state, "gyro_bias", bias.change_variance, "bias_change", policies.standstill.since_rest_s)
            self.state, _ = update(self.state, measure_bias(self.state, bias.rate, bias.variance), policies.excitation.considered())
        state = clone(self.state, "pose", "start")
        by_wheels = state = propagate(state, wheel_transition(state, step, motion, self.noise))
        if unseen.any():  # the submap moves along
            state = inflate_both(state, ("pose", "map"), unseen)
        state, turn = self._update_turn(state, step)
        state, scan, missed = self._update_scan(state, step)
        motion = replace(motion, cov=motion.cov + unseen + missed)
        innovation = None if scan is None else replace(scan, S=scan.S - missed)
        self.last = LastStep(motion, self.state["corrections"], policies.excitation.is_turning, turn, innovation)
        self.state = state
        self.counts_by_name["standing"] += step.is_standing
        twist, twist_cov = self._estimate_twist(step, by_wheels, motion.cov, is_measured=scan is not None)
        odometry = None if policies.continuous is None else policies.continuous.add(state)
        return Estimate(step.end_ns, state["pose"], state.cov("pose"), twist, twist_cov, None if scan is None else scan.nis, odometry)

    def run_deferred(self) -> bool:
        """The last scan enters the submap, if it is a key scan. Deferred until its estimate is out."""
        is_pending, self._is_scan_pending = self._is_scan_pending, False
        if is_pending and self._sensor is not None and self._sensor.is_key(self.state["pose"]):
            error = self._sensor.insert_key_scan(self.state["pose"], self.state.cov("map"))
            self.state = propagate(self.state, key_scan_transition(self.state, error))
        return False

    def start_key(self) -> None:
        """Clone the pose as "key": motions since the last keyframe count from here on."""
        self.state = clone(self.state, "pose", "key")

    def set_corrections(self, mean: FloatArray, cov: FloatArray) -> None:
        """Take the corrections from an estimator that has used this filter's measurements and others: mean (k,), covariance (k, k)."""
        self.state = set_marginal(self.state, "corrections", mean, cov)

    def _restart_calibration(self) -> None:
        """Reset all calibration variables and the wheel noise to their priors; the pose is kept."""
        self._policies.standstill = StandstillTest(self.noise.gyro.bias_sigma_rad_per_s)
        prior, self._policies.wheel_noise = initial_state(self.noise, has_lidar=self._sensor is not None), WheelNoiseScale()
        for name in ("gyro_bias", "gyro_scale", "clock", "radius", "corrections"):
            self.state = set_marginal(self.state, name, prior[name], prior.cov(name))

    def _update_turn(self, state: State, step: Step) -> tuple[State, Innovation | None]:
        """Update by the gyro's turn, if there is one, and by a standstill. With the first turn there is a second clock, from which the
        wheels' may be off."""
        if step.turn is None:
            return state, None
        if not self._has_gyro:
            self._has_gyro = True
            if self._sensor is None:
                state = inflate(state, "clock", np.array([[self.noise.config.clock_sigma_s**2]]))
        standstill, considered = self._policies.standstill, self._policies.excitation.considered()
        of_step, before = standstill.unknown_turns(step)
        if of_step:
            state = inflate_both(state, ("start", "pose"), np.diag([0.0, 0.0, before]))
            state = inflate(state, "pose", np.diag([0.0, 0.0, of_step]))
        open_bias = {"gyro_bias"} if standstill.is_bias_open else set()
        state, innovation = _update(state, measure_turn(state, step.turn, standstill.since_rest_s), considered | open_bias)
        self._policies.wheel_noise.learn(innovation)
        if standstill.is_at_rest:
            state, _ = update(state, measure_standstill(state), considered)
            state = set_marginal(state, "bias_change", np.zeros(2), BIAS_CHANGE_COV)
        return state, innovation

    def _update_scan(self, state: State, step: Step) -> tuple[State, Innovation | None, Cov3]:
        """Match the scan of ``step`` and update by it, if there is one and it can be matched; with the covariance (3, 3) of what the wheels
        missed."""
        sensor = self._sensor
        if sensor is None:
            return state, None, NOTHING_MISSED
        if step.scan is None:
            sensor.add_no_scan(step)
            return state, None, NOTHING_MISSED
        self.counts_by_name["scans"] += 1
        self._is_scan_pending = True
        if self._policies.outlier.has_scene_moved and not step.rested_s:
            sensor.begin_submap()
            self._policies.outlier.has_scene_moved = False
        swept, offset = self._policies.slip.start_step(step)
        match = sensor.measure(swept, state["pose"], state.difference_cov("pose", "map"), offset)
        match, missed = self._policies.outlier.apply(step, match, None if match is not None else sensor.moved.cov(step))
        state = inflate(state, "pose", missed) if missed.any() else state
        if match is None:
            return state, None, missed
        match, R = self._policies.slip.refine(sensor, step, state["start"], match)
        R = R * (1.0 + step.rested_s / _REPEATED_S) ** 4
        self.counts_by_name["matched"] += 1
        self._policies.open_way.add_scan(R, step)
        state, innovation = _update(state, measure_scan(state, match.measured, R), self._policies.excitation.considered_by_scan(state, R))
        self._policies.wheel_noise.learn(innovation)
        return state, innovation, missed

    def _estimate_twist(self, step: Step, by_wheels: State, slip: Cov3, *, is_measured: bool) -> tuple[Twist2, Cov3 | None]:
        """Twist (3,) at the stamp and its covariance. Each measurement counts once: velocities by the state after the step, which has the
        scan; the turn rate by that of the wheels alone, ``by_wheels``, updated by the gyro's rate, or without a gyro by the state.

        ``slip`` (3, 3): covariance of the wheels' motion in ``step``.
        """
        dt = step.duration
        if dt == 0.0:
            return step.twist, None
        change = step.twist - step.mean_twist
        mean, mean_cov = mean_twist(*self.state.between("start", "pose"), dt)
        self._policies.slip.end_step(step, mean, is_measured)
        gyro = None if step.turn is None or step.is_standing else self.gyro_calibration
        rate = None if gyro is None or step.turn is None else gyro.correct_rate(step.turn)
        twist, cov = twist_at_end(mean, mean_cov + slip_change_cov(slip, dt), change, math.inf)
        if is_measured and rate is None:
            return twist, cov
        wheels, wheels_cov = mean_twist(*by_wheels.between("start", "pose"), dt)
        if step.has_wheels:
            wheels_cov = wheel_twist_cov(wheels_cov, slip, dt)
        wheels, wheels_cov = twist_at_end(wheels, wheels_cov, change, math.inf)
        if rate is not None:
            per_s = step.d_clock / dt
            wheels, wheels_cov = fuse_turn(wheels, wheels_cov, *rate, by_wheels.cov("clock") * np.outer(per_s, per_s))
        if not is_measured:
            return wheels, wheels_cov
        cov[2, :], cov[:, 2], cov[2, 2] = 0.0, 0.0, wheels_cov[2, 2]
        return np.append(twist[:2], wheels[2]), cov

    @property
    def clock_offset_s(self) -> float:
        """Estimated offset of the wheels' clock [s]."""
        return self.state.number("clock")

    @property
    def clocks_apart(self) -> ClocksApart | None:
        """See `Estimator.clocks_apart`."""
        return find_clocks_apart(self.state, self._has_gyro, self._sensor is not None)

    @property
    def bias_change(self) -> BiasChange | None:
        """See `Estimator.bias_change`."""
        return self._policies.standstill.change

    @property
    def params(self) -> FloatArray:
        """Parameters of the motion model with their corrections."""
        return np.asarray(self.model.nominal + self.noise.corrections.directions @ self.state["corrections"])

    @property
    def wheel_calibration(self) -> WheelCalibration:
        """See `Estimator.wheel_calibration`."""
        directions, state = self.noise.corrections.directions, self.state
        params_cov = directions @ state.cov("corrections") @ directions.T
        return WheelCalibration(self.params, params_cov, 1.0 + state.number("radius"), state.variance("radius"))

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

    @property
    def gyro_calibration(self) -> GyroCalibration | None:
        """Bias and scale of the gyro by the filter; None where it was not used in the last step."""
        state = self.state
        if self.last.turn is None:
            return None
        variances = state.variance("gyro_bias"), state.variance("gyro_scale")
        return GyroCalibration(state.number("gyro_bias"), state.number("gyro_scale"), *variances)

    @property
    def residuals(self) -> Residuals:
        """Residuals of the last step."""
        last = self.last
        by_corrections = last.motion.d_params @ self.noise.corrections.directions @ last.corrections
        file_delta = se2.retract(last.motion.delta, -by_corrections)
        scan_turn, scan_way = (None, None) if last.scan is None else (last.scan.component(2), last.scan.component(0))
        if last.turn is None:
            return Residuals(None, file_delta, scan_turn, scan_way)
        bias_sigma = math.hypot(self._policies.standstill.bias_sigma, math.sqrt(self.state.variance("gyro_bias")))
        return Residuals(last.turn.component(0), file_delta, scan_turn, scan_way, bias_sigma)

    def learned_parameters(self) -> Sequence[LearnedParameter]:
        """The motion model's parameters that are corrected, and the wheels' radius where scans measure it, against the robot file."""
        state, nominal = self.state, dict(zip(self.model.param_names, self.model.nominal, strict=True))
        changes, sigmas = state["corrections"], np.sqrt(np.diagonal(state.cov("corrections")))
        radius = state.number("radius"), math.sqrt(state.variance("radius")), 0.0, self.noise.config.wheel_radius_sigma
        found = [LearnedParameter("wheel_radius_scale", *radius)] if self._sensor is not None and state.variance("radius") else []
        for name, change, sigma, prior in zip(
            self.noise.corrections.names, changes.tolist(), sigmas.tolist(), self.noise.corrections.sigmas.tolist(), strict=True
        ):
            value = nominal.get(name, 0.0)
            found.append(LearnedParameter(name, float(value + change), sigma, value, prior, self.model.name))
        return found

    def parameters(self) -> Mapping[str, tuple[float, float]]:
        """Mean and sigma of what the filter estimated besides the pose, by name."""
        names = {"gyro_bias_rad_per_s": "gyro_bias", "gyro_scale": "gyro_scale"} if self._has_gyro else {}
        if self._sensor is not None or self._has_gyro:
            names["wheel_clock_offset_s"] = "clock"
        found = {name: (self.state.number(key), math.sqrt(self.state.variance(key))) for name, key in names.items()}
        of_mounts = {} if self._sensor is None else self._sensor.merged.parameters()
        return {**found, **{learned.name: (learned.value, learned.sigma) for learned in self.learned_parameters()}, **of_mounts}

    def counts(self) -> Mapping[str, int]:
        """Number of occurrences by name: scans, matched, searched, and those of lost scans by cause."""
        found = {**self.counts_by_name, "prior_outliers": self._policies.outlier.count}
        return found if self._sensor is None else {**found, **self._sensor.lost.causes}

    def warnings(self) -> list[Message]:
        """A long way by wheels alone, and a clock offset that is large and certain."""
        return [*self._policies.open_way.warnings(), *clock_warnings(self.clocks_apart, self._has_gyro, self._sensor is not None)]

    def map_points(self) -> Points2:
        """(M, 2) points of the map in the world [m]; none without a LiDAR."""
        return NO_POINTS if self._sensor is None else self._sensor.map_points()


def _update(state: State, measurement: Measurement, considered: Collection[str]) -> tuple[State, Innovation]:
    """`update` by a sensor of the motion, of which late wheels may have missed the start; with the innovation as if they had not."""
    updated, innovation = update(state, measurement, considered)
    missed = unmeasured_start(state, innovation)
    if missed is not None:
        updated, _ = update(inflate(state, "pose", missed), measurement, considered)
    return updated, innovation
