"""Steps from an independent generator: a true robot whose parameters, noise and sensors are drawn from the priors of the estimators.

Nothing here uses the estimators' own prediction: the truth is composed from small intervals with slip drawn in each, and what a Step says
comes from `Synchronizer`'s own parts (`integrate_twists`) at the parameters that the estimator hands back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from localization.core.motion import FilterConfig
from localization.estimators.estimator import Estimator
from localization.estimators.fusion import EkfFusion
from localization.events import Scan, Step, Turn
from localization.lidar import LidarConfig, LostScans, ScanMatch
from localization.lidar.merged_sweep import MergedSweeps
from localization.lidar.scan_policies import MovedRobot
from motion_models import se2
from motion_models.motion import Motion
from motion_models.online_calibration import Corrections, make_corrections
from motion_models.preintegration import integrate_twists, noise_vector
from motion_models.registry import make_model
from motion_models.robot import GyroNoise, Robot, WheelNoise
from motion_models.robot_file import load_robot

DT = 0.1
_SUB = 4
NO_POINTS = np.empty((0, 2))


@dataclass(frozen=True)
class Noise:
    """All noise of the synthetic robot."""

    wheels: WheelNoise = field(default_factory=WheelNoise)
    gyro: GyroNoise = field(default_factory=GyroNoise)
    lidar_m: float = 0.005
    lidar_rad: float = 0.001

    def scaled(self, factor: float) -> Noise:
        """Sigmas of wheels and LiDAR times ``factor``."""
        w = WheelNoise(**{name: value * factor**2 for name, value in vars(self.wheels).items()})
        return replace(self, wheels=w, lidar_m=self.lidar_m * factor, lidar_rad=self.lidar_rad * factor)


class PoseSensor:
    """In place of `ScanMatchingSensor`: poses with noise of a given covariance, in an exact submap."""

    cell = 0.0  # no voxels, and so no loops
    sweep_s = 0.0  # poses at one instant

    def __init__(self) -> None:
        self.next: ScanMatch | None = None
        self.lost, self.moved = LostScans(), MovedRobot(LidarConfig())
        self.merged = MergedSweeps({}, LidarConfig())

    def measure(self, step, prior, cov, offset):
        return self.next

    def refine(self, match, twist):
        return match

    def intra_scan_slip_cov(self, match, slip_rate):
        return np.zeros((3, 3))

    def add_no_scan(self, step):
        self.lost.add_no_scan(step.end_ns)

    def is_key(self, pose):
        return False

    def scan_points(self):
        return NO_POINTS

    def map_points(self):
        return NO_POINTS


def match_at(pose: np.ndarray, cov: np.ndarray) -> ScanMatch:
    """What `PoseSensor` measures next: ``pose`` (3,), with noise of ``cov`` (3, 3)."""
    return ScanMatch(pose, pose, cov, 1.0, np.zeros((3, 3)))


def weave(t: float) -> tuple[float, float]:
    """Wheel rates of a drive that turns both ways and changes speed."""
    forward, turning = 3.0 + 1.5 * math.sin(0.31 * t), 2.5 * math.sin(0.7 * t) + 1.5 * math.sin(0.13 * t)
    return forward - turning, forward + turning


def straight(t: float) -> tuple[float, float]:
    return 4.0, 4.0


class World:
    """The truth, and the steps that it gives to an estimator."""

    def __init__(
        self,
        model,
        corrected: Corrections,
        noise: Noise,
        rng,
        has_lidar=True,
        belief=None,
        wheels=weave,
        cg=lambda t: (0.0, 0.0),
    ):
        self.model, self.corrected, self.noise, self.rng = model, corrected, noise, rng
        self.has_lidar, self.wheels, self.cg = has_lidar, wheels, cg
        self.pose, self.t, self.k = np.zeros(3), 0.0, 0
        self.bias = rng.normal(0.0, noise.gyro.bias_sigma_rad_per_s)
        self.clock = rng.normal(0.0, belief.clock_sigma_s) if belief is not None else 0.0
        self.belief, self.scale = belief, rng.normal(0.0, noise.gyro.scale_sigma)
        has_radius = belief is not None and "wheel_radius_scale" not in corrected.names
        self.radius = rng.normal(0.0, belief.wheel_radius_sigma) if has_radius else 0.0
        k = len(corrected.names)
        self.correction = rng.multivariate_normal(np.zeros(k), corrected.cov) if k else np.zeros(0)
        self._walk = np.linalg.cholesky(corrected.process_noise + 1e-18 * np.eye(k))

    @property
    def slow(self) -> np.ndarray:
        """(4 + k,) true gyro bias and scale, clock offset, scale of the wheels' radius, corrections."""
        return np.concatenate([[self.bias, self.scale, self.clock, self.radius], self.correction])

    def first(self) -> Step:
        none = Motion(np.zeros(3), np.zeros((3, 3)), np.zeros((3, len(self.model.param_names))))
        return Step(0, 0, none, np.zeros(3), np.zeros(3), False, True, None, self.scan_at(0))

    def scan_at(self, stamp_ns: int) -> Scan | None:
        """A scan without points; None for a robot without a LiDAR."""
        return Scan(stamp_ns, np.zeros((0, 3))) if self.has_lidar else None

    def _rates(self, begin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        times = begin + (np.arange(_SUB) + 0.5) * DT / _SUB
        return np.full(_SUB, DT / _SUB), np.array([self.wheels(t) for t in times]), np.array([self.cg(t) for t in times])

    def step(self, params: np.ndarray, clock_offset: float) -> tuple[Step, ScanMatch]:
        """The next step as an estimator with these parameters would be given it, and the LiDAR's pose."""
        rng, noise = self.rng, self.noise
        # the wheels' stamps are early by the offset: what really happens at t stands in the log at t + clock (as Synchronizer reads it)
        dt, rates, cg = self._rates(self.t)
        true_params = self.model.nominal + self.corrected.directions @ self.correction
        twists = self.model.twist(rates, cg, true_params).value * [1.0 + self.radius, 1.0 + self.radius, 1.0]
        delta = np.zeros(3)
        w = noise.wheels
        for h, xi in zip(dt, twists, strict=True):
            driven, turned = math.hypot(*(xi[:2] * h)), abs(xi[2] * h)
            var = np.array(
                [
                    w.longitudinal_m2_per_m * driven + w.longitudinal_m2_per_rad * turned + w.floor_m2_per_s * h,
                    w.lateral_m2_per_m * driven + w.lateral_m2_per_rad * turned + w.floor_m2_per_s * h,
                    w.yaw_rad2_per_m * driven + w.yaw_rad2_per_rad * turned + w.floor_rad2_per_s * h,
                ]
            )
            delta = se2.compose(delta, se2.compose(se2.exp(xi * h), se2.exp(rng.normal(size=3) * np.sqrt(var))))
        self.pose = se2.compose(self.pose, delta)

        # the log's wheels: at stamp s they have the rates of true time s - clock; the reader adds its own estimate
        shifted = self.t + clock_offset - self.clock
        dt, rates, cg = self._rates(shifted)
        twist = self.model.twist(rates, cg, params)
        predicted = integrate_twists(dt, twist, noise_vector(noise.wheels))
        ends = shifted + np.array([0.0, DT])  # the very ends: the middles of the intervals would leave out a part of the change
        first, last = self.model.twist(np.array([self.wheels(s) for s in ends]), np.array([self.cg(s) for s in ends]), params).value
        d_clock = last - se2.adjoint(se2.inverse(predicted.delta)) @ first

        g = noise.gyro
        turned = float(delta[2])
        variance = g.white_rad_per_sqrt_s**2 * DT
        turn = Turn((1.0 + self.scale) * turned + self.bias * DT + rng.normal(0.0, math.sqrt(variance)), variance, DT)
        sigmas = np.array([noise.lidar_m, noise.lidar_m, noise.lidar_rad])
        match = match_at(se2.compose(self.pose, se2.exp(sigmas * rng.normal(size=3))), np.diag(sigmas**2))

        start, self.k = self.k, self.k + 1
        self.t = self.k * DT
        stamps = round(start * DT * 1e9), round(self.k * DT * 1e9)
        self.bias += rng.normal(0.0, g.bias_walk_rad_per_s_sqrt_s * math.sqrt(DT))
        self.correction = self.correction + self._walk @ rng.normal(size=len(self.correction)) * math.sqrt(DT)
        if self.belief is not None:
            self.clock += rng.normal(0.0, self.belief.clock_walk_s_per_sqrt_s * math.sqrt(DT))
        return Step(*stamps, predicted, d_clock, twist.value[-1], False, True, turn, self.scan_at(stamps[1])), match


def drive(world: World, estimator: Estimator, sensor: PoseSensor, steps: int):
    """Yield (estimate, true pose) after each step."""
    if world.has_lidar:
        estimator.step(world.first())
    for _ in range(steps):
        params = world.model.nominal if estimator.params is None else estimator.params
        step, sensor.next = world.step(params, estimator.clock_offset_s)
        yield estimator.step(step), world.pose


def make_filter(
    sensor: PoseSensor, model="skid_steer", form="constant", noise=None, has_lidar=True, robot: Robot | None = None
) -> EkfFusion:
    """The filter with the noise of the synthetic robot. ``model``: a name, or a model."""
    noise = noise or Noise()
    robot = replace(robot or load_robot("husky_a200"), wheel_noise=noise.wheels, gyro_noise=noise.gyro)
    made = make_model(model, robot) if isinstance(model, str) else model
    return EkfFusion(made, make_corrections(made, form), robot, sensor if has_lidar else None, FilterConfig())


def make_world(estimator, seed, noise=None, has_lidar=True, wheels=weave, **more) -> World:
    """A robot whose parameters and noise are drawn from the priors of ``estimator``."""
    rng = np.random.default_rng(seed)
    return World(estimator.model, estimator.noise.corrections, noise or Noise(), rng, has_lidar, FilterConfig(), wheels, **more)


def run(estimator, sensor, seed=0, steps=60, **world):
    """All estimates of a drive, and the true poses (steps, 3)."""
    found, truth = [], []
    for estimate, pose in drive(make_world(estimator, seed, **world), estimator, sensor, steps):
        found.append(estimate)
        truth.append(pose)
    return found, np.array(truth)


def slow_states(estimator: EkfFusion) -> tuple[np.ndarray, np.ndarray]:
    """Means (m,) of gyro bias and scale, clock offset, radius, corrections, and the joint covariance (3 + m, 3 + m) of pose and these."""
    names = "gyro_bias", "gyro_scale", "clock", "radius", "corrections"
    return np.concatenate([estimator.state[name] for name in names]), estimator.state.cov("pose", *names)


def squared_errors(seed, steps, noise, model="skid_steer", form="constant"):
    """Normalised squared errors of the pose, of the slow states and of all, and which slow states are inside their 90 % intervals."""
    sensor = PoseSensor()
    estimator = make_filter(sensor, model, form, noise)
    world = make_world(estimator, seed, noise)
    *_, (estimate, truth) = drive(world, estimator, sensor, steps)
    slow, P = slow_states(estimator)
    error = np.concatenate([se2.log(se2.between(estimate.pose, truth)), world.slow - slow])
    inside = np.abs(error[3:]) < 1.6449 * np.sqrt(np.diag(P)[3:])
    parts = (slice(0, 3), slice(3, None), slice(0, None))
    return [float(error[p] @ np.linalg.solve(P[p, p], error[p])) for p in parts], inside, [len(error[p]) for p in parts]
