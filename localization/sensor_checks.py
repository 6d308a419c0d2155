"""Consistency of the sensors with each other: wheels, gyro and LiDAR each measure the same motion.

The turn rates of the three, and the direction of travel by wheels and LiDAR, are compared over windows of seconds. A sensor that
contradicts the two others in most windows of the last minutes is left out while that lasts; where only two can be compared, the covariance
takes both into account. Each fault gives a warning with sensor, time and remedy, and widens the published covariance by the difference that
it has made so far.

The LiDAR's motion is that of `lidar.scan_motion`, which uses neither the filter nor the other sensors.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.estimators import Estimate
from localization.events import ImuSample, Scan, Step
from localization.lidar import LidarConfig, Sweep
from localization.lidar.scan_motion import ScanOdometry
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.base import Motion
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

_BIN_S = 0.25
_WINDOW_BINS, _MIN_BINS = 24, 10
"""Bins that are compared (6 s), and the fewest (2.5 s)."""
_MAX_BIN_S = 1.0
"""How long a bin waits for a scan: LiDARs give 2 to 40 scans a second."""
_MIN_LASTING_S = 1.0
"""Time for which a comparison must give the same result before a sensor is declared faulty."""
_MEMORY_S, _SLIP_MEMORY_S, _MIN_CONTRADICTING = 3.0, 120.0, 2.0 / 3.0
"""A sensor is left out while at least this share of the comparisons of the last seconds contradict it. Signs and units are never off by
chance for so long (Husky, ACES, fr079, CSAIL: one of 8,964 comparisons); a direction of travel is, where the robot slides (fr079: 14 deg
for 7 s), and is compared over two minutes."""
_MAX_BIAS_RAD_S = 0.05
"""Gyro bias that is no contradiction; ten times the prior sigma of the shipped robots."""
_MAX_RATE_OFF_RAD_S, _MAX_RATE_OFF_SHARE = 2.0, 3.0
"""Difference of the gyro's rate from the wheels' that no slip explains, at least so large and so many times the wheels' rate. On the Husky
outdoors it is 0.22 rad/s at most."""
_MIN_RATE_RAD_S = 0.001
"""Root mean square of the slower turn rate, from where on signs are compared: none of 65 windows of the Husky outdoors, straight or not,
has a correlation below -0.3."""
_MIN_T = 4.0
"""Student's t of a correlation that is no chance."""
_MIN_EXCITED_RAD_S = 0.03
"""The same for the scale: above it all windows have correlations of 0.8 and more (Husky outdoors, 32 windows; simulated laps)."""
_OPPOSITE_CORRELATION, _EQUAL_CORRELATION = -0.6, 0.6
_REPEATED_RAD_S, _MIN_STUCK_WHEELS_RAD_S = 1e-7, 0.002
"""A gyro's mean rates never repeat to the last digit, but for its noise; over a whole window it is stuck if the wheels turn at all."""
_DEG_PER_RAD_RANGE = (12.0, 130.0)
"""Ratio of turn rates that only a wrong unit explains: 57.3, with the factor of 0.45 to 2.3 by which wheels may be off on loose floor, and
half of it while half of the window is of before the fault."""
_MAX_EQUAL_RATIO = 2.5
_MIN_TRAVEL_M = 0.05
"""Of wheels and LiDAR in a bin, for its direction to count."""
_MIN_TRAVEL_BINS = 6
_MAX_CURVATURE_RAD_M = 0.6
"""Sharper turns slide sideways."""
_MAX_DIRECTION_RAD, _MIN_COHERENCE = math.radians(12.0), 0.9
"""A robot on a side slope or in curves slides by a few degrees."""
_MAX_SLIDE_RAD = math.radians(20.0)
"""Directions that no slide explains are compared over `_MEMORY_S`: 99.9 % of the windows of CSAIL, fr079 and ACES are below 17 deg. Windows
of 3 s would take a time for a turned LiDAR in which the wheels of fr079 count backwards as forwards (6 s, ATE .13 -> .18 m)."""
_GROSS_DIRECTION = "gross direction"
_MIN_OWN_SHARE = 0.05
_STANDING_SPEED_M_S = 0.1
_SHAKE_M_S2, _SHAKE_SAMPLES = 0.4, 20
"""Standard deviation of the specific force over a second: Husky outdoors at rest 0.005 to 0.11, driving 0.51 to 1.6 (5 to 95 %)."""
_SHAKE_S = 2.0
_DISAGREEMENT_S, _MIN_DISAGREEING_SCANS = 5.0, 8
_MAX_SQUARE, _MAX_MEAN_SQUARE = 25.0, 10.0
"""Mean over 5 s of the squared distance between the wheels' motion and the estimate's, in sigmas, each at most 5 sigma; 3 is expected.
1.4 % of the time of CSAIL and 3.9 % of fr079 are above, none of ACES and simulated laps."""
_SCAN_NOISE = np.diag([0.02, 0.02, 0.01]) ** 2
"""Of the motion from scan to scan [m^2, m^2, rad^2]."""
_UNKNOWN_SPEED = np.array([0.5, 0.5, 0.5])
"""Sigma of a twist that no sensor measures [m/s, m/s, rad/s], as `StepConfig.lost_speed_m_s`."""
_BODY_BEARINGS = 360
_MAX_BODY_RANGE_M = 1.0
"""Parts of a robot of 1 m are nearer to its LiDAR."""
_SAME_RANGE_M = 0.03
_MIN_BODY_TRAVEL_M, _MIN_BODY_TURN_RAD = 1.5, 0.4
"""A wall keeps its range only while the robot drives along it without turning. On ACES, 0.15 rad leave 3 % of the beams on a wall at 0.9 m
that is hit at a right angle; 0.4 rad change these by 8 %."""
_MIN_BODY_SHARE = 0.01
_NS = 1e-9


class Fault:
    """Messages: what is wrong, and what to do. Each stands for its fault."""

    GYRO_OPPOSITE = "the gyro turns opposite to {others}. It is not used while that lasts. Correct the IMU's mount, or its driver's sign."
    GYRO_UNIT = (
        "the gyro's rates are {ratio:.2g} times those of {others} (deg/s?). It is not used while that lasts. Let its driver publish rad/s."
    )
    GYRO_RATE = (
        "the gyro turns by {rate:.1f} rad/s against the wheels, more than slip explains. It is not used for 3 s after each time. Check"
        " the units of the IMU's driver."
    )
    GYRO_STUCK = "the gyro repeats one value while {others} turn. It is not used as long as that lasts. Check the IMU and its driver."
    WHEELS_OPPOSITE = (
        "the wheels turn opposite to {others}. They are not used while that lasts. Swap left and right in the robot file's [joints]."
    )
    LIDAR_OPPOSITE = (
        "the LiDAR turns opposite to {others}. Its scans are not used while that lasts. It is mounted upside down, or left and right wheels"
        " are swapped: correct the roll of its frame in /tf_static or in the robot file's [mounts], or the robot file's [joints]."
    )
    LIDAR_DIRECTION = (
        "by the LiDAR the robot travels {degrees:.0f} deg to the {side} of where the wheels drive. Its scans are not used while that lasts."
        " Correct the yaw of its frame by {correction:+.0f} deg in /tf_static or in the robot file's [mounts]."
    )
    LIDAR_OWN_BODY = (
        "{percent:.0f} % of the LiDAR's points are the robot itself (same ranges while it drives and turns). They are left out"
        " from then on. Remove what covers the LiDAR, or filter these beams in its driver (laser_filters)."
    )
    DISAGREEMENT = (
        "for {seconds:.0f} s the motion by the scans and that by the wheels differ ({sigmas:.1f} sigma in the mean, {metres:.2f} m and"
        " {degrees:.0f} deg at the end{others}). Wheels slip, or the mount, the stamps or the scale of a sensor are wrong: run `skidloc"
        " diagnose` on the log."
    )
    WHEELS_STANDING = (
        "the wheels read zero while {others} moved. They count as unknown there. Check the encoders, the driver of the wheels and the"
        " joints' names in the robot file's [joints]."
    )


@dataclass(frozen=True)
class Found:
    """A fault with its time and numbers."""

    fault: str
    at_s: float
    """After the first step [s]."""
    message: str


class _Episode(NamedTuple):
    """A time in which scans and wheels disagree."""

    begin_s: float
    end_s: float
    difference: FloatArray
    """(3,) of the motion by the wheels from that by the estimate."""
    mean_square: float
    """Of the last 5 s, in sigmas."""

    @property
    def distance(self) -> float:
        """Length of the difference [m]."""
        return math.hypot(self.difference[0], self.difference[1])


class _Episodes(NamedTuple):
    """The largest of several times of disagreement, and their sum."""

    number: int = 0
    seconds: float = 0.0
    largest: _Episode | None = None

    def including(self, episode: _Episode) -> _Episodes:
        """These and ``episode``."""
        is_larger = self.largest is None or episode.distance > self.largest.distance
        return _Episodes(self.number + 1, self.seconds + episode.end_s - episode.begin_s, episode if is_larger else self.largest)

    def found(self) -> Found | None:
        """The largest; None without any."""
        if self.largest is None:
            return None
        message = Fault.DISAGREEMENT.format(
            seconds=self.largest.end_s - self.largest.begin_s,
            sigmas=math.sqrt(self.largest.mean_square),
            metres=self.largest.distance,
            degrees=abs(math.degrees(self.largest.difference[2])),
            others=f"; the largest of {self.number} such times, {self.seconds:.0f} s in all" if self.number > 1 else "",
        )
        return Found(Fault.DISAGREEMENT, self.largest.begin_s, message)


@dataclass(frozen=True, eq=False)
class _Bin:
    """Motion over a quarter of a second or more."""

    duration_s: float
    wheels: FloatArray
    """(3,) by the wheels; NaN where they were missing."""
    gyro: float
    """Turn [rad]; NaN where it was missing."""
    lidar: FloatArray
    """(3,) by the scans; NaN where unknown, translation where the scene does not show it."""
    is_standing: bool


class _Relation(NamedTuple):
    """How the turn rates of two sensors relate: correlation, and ratio of the second to the first."""

    correlation: float
    ratio: float
    is_excited: bool
    """Both turn enough for a scale."""
    is_opposite: bool
    unit_ratio: float
    """Ratio of the second to the first that only a wrong unit explains; 0 where there is none."""

    @property
    def is_equal(self) -> bool:
        return self.is_excited and self.correlation >= _EQUAL_CORRELATION and 1.0 / _MAX_EQUAL_RATIO <= self.ratio <= _MAX_EQUAL_RATIO


_NO_RELATION = _Relation(0.0, 1.0, False, False, 0.0)


class SensorChecks:
    """`apply` to each step before the estimator, `widen` its estimate afterwards."""

    def __init__(self, mounts: Mapping[str, Mount], config: LidarConfig) -> None:
        self._mounts, self._config = mounts, config
        self._scans, self._own_body = ScanOdometry(), OwnBodyFilter()
        self._bins: deque[_Bin] = deque(maxlen=_WINDOW_BINS)
        self._open = _Accumulator()
        self._is_gyro_stuck = self._has_scans = False
        self._impossible_s = -math.inf  # when the gyro's rate was last one that no slip explains
        self._shaking, self._disagreement = ShakeDetector(), _Disagreement()
        self._step: Step | None = None
        self._suspected: dict[str, tuple[float, float]] = {}  # when first found, and start of the bins then [s]
        self._comparisons: dict[str, _Comparisons] = {}  # by fault
        self._declared: dict[str, Found] = {}
        self._start_ns: int | None = None
        self._stood_s = 0.0  # time for which the wheels read zero
        self._standing_s = 0.0  # the same, while that is contradicted
        self._pose: FloatArray | None = None
        self._estimated, self._by_wheels, self._by_gyro = np.zeros(3), np.zeros(3), np.zeros(3)  # motion since the sensors last agreed
        self._episodes = _Episodes()  # that have ended
        self._episode: _Episode | None = None
        self._pending = np.zeros((3, 3))
        self._spread = np.zeros((3, 3))
        self._spread_since_ns: int | None = None

    def insert_imu(self, sample: ImuSample) -> None:
        """Specific force shows whether the robot moves."""
        self._shaking.insert(sample)

    def apply(self, step: Step) -> Step:
        """``step`` without the sensors that are faulty, and with the motion of uncertain wheels widened."""
        if not np.isfinite(step.predicted.delta).all():
            return step  # the estimator refuses it
        if self._start_ns is None:
            self._start_ns = step.start_ns
        step = self._without_own_body(step)
        self._record(step)
        self._step = self._check_standstill(self._without_faulty(step))
        return self._step

    def widen(self, estimate: Estimate) -> Estimate:
        """``estimate`` with the covariance of what faulty sensors have done to it; unchanged without one (LiDAR alone)."""
        if estimate.covariance is None:
            return estimate
        own = estimate.pose if estimate.odometry is None else estimate.odometry[0]
        delta = np.zeros(3) if self._pose is None else se2.between(self._pose, own)
        if self._pose is not None:
            self._check_disagreement(delta, estimate.nis)
        self._pose, self._estimated = own, se2.compose(self._estimated, delta)
        A = se2.adjoint(se2.inverse(delta))
        self._spread = A @ self._spread @ A.T + self._pending
        self._pending = np.zeros((3, 3))
        spread = self._total_spread()
        if not spread.any():
            return estimate
        if self._spread_since_ns is None:
            self._spread_since_ns = estimate.stamp_ns
        odometry = estimate.odometry
        if odometry is not None and odometry[1] is not None:
            odometry = odometry[0], odometry[1] + spread
        return replace(estimate, covariance=estimate.covariance + spread, odometry=odometry)

    def _total_spread(self) -> FloatArray:
        """Covariance (3, 3) of what past faults have done to the pose, and of how far a lasting disagreement has taken it."""
        off = self._disagreement.difference
        return self._spread if off is None else self._spread + np.outer(off, off)

    def widen_trajectory(self, smoothed: Trajectory) -> Trajectory:
        """``smoothed`` with the same covariance at its end, from the first fault on, in the world's axes."""
        if self._spread_since_ns is None or smoothed.covariances is None:
            return smoothed
        covariances = smoothed.covariances.copy()
        world = _turned(self._total_spread(), float(smoothed.poses[-1, 2]))
        for i in np.flatnonzero(smoothed.stamps_ns >= self._spread_since_ns):
            covariances[i] += _turned(world, -float(smoothed.poses[i, 2]))
        return Trajectory(smoothed.stamps_ns, smoothed.poses, covariances)

    def warnings(self) -> list[str]:
        """Faults so far."""
        return [f"at t = {found.at_s:.1f} s: {found.message}" for found in self.found.values()]

    @property
    def found(self) -> dict[str, Found]:
        """Faults so far, by their messages in `Fault`."""
        episodes = self._episodes if self._episode is None else self._episodes.including(self._episode)
        disagreement = episodes.found()
        return self._declared if disagreement is None else {**self._declared, Fault.DISAGREEMENT: disagreement}

    def _without_own_body(self, step: Step) -> Step:
        self._own_body.add_motion(step.predicted.delta)
        if step.scan is None:
            return step
        scan = self._own_body.filter(step.scan)
        if self._own_body.share > _MIN_OWN_SHARE:
            self._declare(Fault.LIDAR_OWN_BODY, self._now_s(step), {"percent": 100.0 * self._own_body.share})
        return replace(step, scan=scan)

    def _without_faulty(self, step: Step) -> Step:
        if self._is_gyro_impossible(step):
            step = replace(step, turn=None)
        faults = {fault for fault in self._declared if self._is_contradicted(fault)}
        if faults & {Fault.GYRO_OPPOSITE, Fault.GYRO_UNIT} or (self._is_gyro_stuck and Fault.GYRO_STUCK in faults):
            step = replace(step, turn=None)
        if faults & {Fault.LIDAR_OPPOSITE, Fault.LIDAR_DIRECTION}:
            step = replace(step, scan=None)
        if Fault.WHEELS_OPPOSITE in faults:
            step = self._with_unknown_motion(step, step.duration**2)
        return step

    def _is_gyro_impossible(self, step: Step) -> bool:
        """Whether the gyro's rate is one that no slip explains, or was within the last `_MEMORY_S`."""
        now_s = self._now_s(step)
        if step.turn is not None and step.has_wheels and step.duration > 0.0 and not step.is_standing:
            by_wheels = float(step.predicted.delta[2]) / step.duration
            off = abs(step.turn.angle / step.duration - by_wheels)
            if off > max(_MAX_RATE_OFF_RAD_S, _MAX_RATE_OFF_SHARE * abs(by_wheels)):
                self._impossible_s = now_s
                if Fault.GYRO_UNIT not in self._declared:
                    self._declare(Fault.GYRO_RATE, now_s, {"rate": off})
        return now_s - self._impossible_s < _MEMORY_S

    def _check_standstill(self, step: Step) -> Step:
        """Wheels that read zero while LiDAR or IMU show motion count as unknown, for as long as that lasts."""
        if not step.is_standing:
            self._standing_s = self._stood_s = 0.0
            return step
        self._stood_s += step.duration
        travelled = sum(math.hypot(b.lidar[0], b.lidar[1]) for b in self._recent() if b.is_standing and np.isfinite(b.lidar[0]))
        lasted = sum(b.duration_s for b in self._recent() if b.is_standing and np.isfinite(b.lidar[0]))
        is_lidar_moving = lasted >= 1.0 and travelled >= _STANDING_SPEED_M_S * lasted
        has_lidar = lasted > 0.0
        if not is_lidar_moving and (has_lidar or min(self._shaking.lasted_s, self._stood_s) < _SHAKE_S):
            self._standing_s = 0.0
            return step
        before = self._standing_s
        self._standing_s = self._stood_s
        others = "the LiDAR" if is_lidar_moving else "the IMU shakes as if it"
        self._declare(Fault.WHEELS_STANDING, self._now_s(step) - self._standing_s, {"others": others})
        return self._with_unknown_motion(step, self._standing_s**2 - before**2)

    def _check_disagreement(self, delta: FloatArray, nis: float | None) -> None:
        """Compare ``delta`` (3,), the last step by the estimate, with the wheels' motion."""
        step = self._step
        if step is None or step.duration == 0.0:
            return
        self._disagreement.add(step, delta, nis)
        off = self._disagreement.difference
        if off is not None:
            begin_s = self._disagreement.began_s - (self._start_ns or 0) * _NS
            self._episode = _Episode(begin_s, self._now_s(step), off, self._disagreement.mean_square)
        elif self._episode is not None:
            self._pending = self._pending + np.outer(self._episode.difference, self._episode.difference)
            self._episodes, self._episode = self._episodes.including(self._episode), None

    def _with_unknown_motion(self, step: Step, seconds2: float) -> Step:
        """``step`` with the covariance of a lasting unknown twist, which grows by ``seconds2`` [s^2]."""
        motion = step.predicted
        cov = motion.cov + np.diag(_UNKNOWN_SPEED**2) * seconds2
        return replace(step, predicted=Motion(motion.delta, cov, motion.d_params), is_standing=False, has_wheels=False)

    def _recent(self) -> list[_Bin]:
        return list(self._bins)[-8:]

    def _now_s(self, step: Step) -> float:
        return (step.end_ns - (self._start_ns or 0)) * _NS

    def _record(self, step: Step) -> None:
        """Add ``step`` to the open bin; close it where it is long enough, at a scan if there are any."""
        self._by_wheels = se2.compose(self._by_wheels, step.predicted.delta)
        turned = step.predicted.delta.copy()
        if step.turn is not None:
            turned[2] = step.turn.angle
        self._by_gyro = se2.compose(self._by_gyro, turned)
        self._open.add(step)
        self._has_scans |= step.scan is not None
        waits_for_scan = self._has_scans and step.scan is None
        if self._open.duration_s < (_MAX_BIN_S if waits_for_scan else _BIN_S):
            return
        lidar = np.full(3, np.nan)
        if step.scan is not None:
            mount = self._mounts.get(step.scan.frame_id, Mount())
            sweep = Sweep.from_scan(step.scan, mount).within(self._config.min_range_m, self._config.max_range_m)
            motion = self._scans.register(sweep.project(sweep.points), np.array([mount.x, mount.y]))
            if motion is not None and self._open.has_scan_at_start:
                lidar = motion.delta if motion.has_translation else np.array([np.nan, np.nan, motion.delta[2]])
        self._bins.append(self._open.close(lidar))
        self._open = _Accumulator(has_scan_at_start=step.scan is not None)
        if len(self._bins) >= _MIN_BINS:
            self._evaluate(self._now_s(step))

    def _evaluate(self, now_s: float) -> None:
        """Compare the sensors over the last bins."""
        seconds = np.array([b.duration_s for b in self._bins])
        rates = np.array([[b.wheels[2], b.gyro, b.lidar[2]] for b in self._bins]) / seconds[:, None]
        wheels_gyro, wheels_lidar, lidar_gyro = (_relate(rates[:, i], rates[:, j]) for i, j in ((0, 1), (0, 2), (2, 1)))
        suspects = dict(_find_turn_faults(wheels_gyro, wheels_lidar, lidar_gyro))
        self._is_gyro_stuck = _is_constant(rates[:, 1], rates[:, 0])
        if self._is_gyro_stuck:
            suspects[Fault.GYRO_STUCK] = {"others": "the wheels"}
        direction = _travel_direction(list(self._bins))
        if direction is not None and abs(direction) > _MAX_DIRECTION_RAD:
            degrees = math.degrees(direction)
            side = "left" if degrees > 0.0 else "right"
            suspects[Fault.LIDAR_DIRECTION] = {"degrees": abs(degrees), "side": side, "correction": -degrees}
        first = now_s, max(now_s - float(seconds.sum()), 0.0)
        self._compare(now_s, suspects.keys(), _excluded_faults(wheels_gyro, wheels_lidar, lidar_gyro, direction))
        if direction is not None:
            self._comparisons.setdefault(_GROSS_DIRECTION, _Comparisons(_MEMORY_S)).add(now_s, abs(direction) > _MAX_SLIDE_RAD)
        self._suspected = {fault: self._suspected.get(fault, first) for fault in suspects}
        for fault, (first_s, since_s) in self._suspected.items():
            if now_s - first_s >= _MIN_LASTING_S and self._is_contradicted(fault):
                self._declare(fault, since_s, suspects[fault])
        is_turn_confirmed = wheels_gyro.is_equal or wheels_lidar.is_equal or lidar_gyro.is_equal
        if not suspects and is_turn_confirmed and (direction is not None or not self._has_scans):
            self._estimated, self._by_wheels, self._by_gyro = np.zeros(3), np.zeros(3), np.zeros(3)

    def _compare(self, now_s: float, present: AbstractSet[str], excluded: AbstractSet[str]) -> None:
        """Store which faults a window shows, and which it excludes."""
        for fault in present | excluded:
            memory_s = _SLIP_MEMORY_S if fault == Fault.LIDAR_DIRECTION else _MEMORY_S
            self._comparisons.setdefault(fault, _Comparisons(memory_s)).add(now_s, fault in present)

    def _is_contradicted(self, fault: str) -> bool:
        """Whether most comparisons of the last seconds show ``fault``."""
        keys = (fault, _GROSS_DIRECTION) if fault == Fault.LIDAR_DIRECTION else (fault,)
        return any(self._comparisons[key].is_majority for key in keys if key in self._comparisons)

    def _declare(self, fault: str, at_s: float, numbers: Mapping[str, float | str]) -> None:
        """Report ``fault`` once, and widen the covariance by how far the estimate is from the other sensors' dead reckoning."""
        if fault in self._declared:
            return
        self._declared[fault] = Found(fault, max(at_s, 0.0), fault.format(**numbers))
        if fault == Fault.GYRO_UNIT:
            self._declared.pop(Fault.GYRO_RATE, None)  # it is explained
        if fault == Fault.WHEELS_STANDING:
            return
        is_gyro = fault in (Fault.GYRO_OPPOSITE, Fault.GYRO_STUCK, Fault.GYRO_UNIT, Fault.GYRO_RATE)
        difference = se2.log(se2.between(self._estimated, self._by_wheels if is_gyro else self._by_gyro))
        self._pending = self._pending + np.outer(difference, difference)


class _Comparisons:
    """Which of the comparisons of the last ``memory_s`` [s] show a fault."""

    def __init__(self, memory_s: float) -> None:
        self._memory_s = memory_s
        self._results: deque[tuple[float, bool]] = deque()

    def add(self, now_s: float, is_there: bool) -> None:
        """Result of a comparison at ``now_s`` [s]."""
        self._results.append((now_s, is_there))
        while self._results[0][0] < now_s - self._memory_s:
            self._results.popleft()

    @property
    def is_majority(self) -> bool:
        """Whether the fault is there in `_MIN_CONTRADICTING` of them or more."""
        return sum(is_there for _, is_there in self._results) >= _MIN_CONTRADICTING * max(len(self._results), 1)


@dataclass
class _Accumulator:
    """The open bin."""

    has_scan_at_start: bool = False
    duration_s: float = 0.0
    _wheels: FloatArray | None = None
    _gyro: float = 0.0
    _is_standing: bool = True
    _has_wheels: bool = True

    def add(self, step: Step) -> None:
        if step.duration == 0.0:
            return
        self.duration_s += step.duration
        self._has_wheels &= step.has_wheels and bool(np.isfinite(step.predicted.delta).all())
        if self._has_wheels:
            self._wheels = step.predicted.delta if self._wheels is None else se2.compose(self._wheels, step.predicted.delta)
        self._gyro += math.nan if step.turn is None else step.turn.angle
        self._is_standing &= step.is_standing

    def close(self, lidar: FloatArray) -> _Bin:
        wheels = self._wheels if self._wheels is not None and self._has_wheels else np.full(3, np.nan)
        return _Bin(self.duration_s, wheels, self._gyro, lidar, self._is_standing)


class _Disagreement:
    """Distance of the estimate's motion from the wheels', over the last seconds."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, float, FloatArray, FloatArray]] = deque()  # time [s], square, motion by wheels and estimate
        self._motions: tuple[FloatArray, FloatArray] | None = None
        self.mean_square = 0.0
        self.began_s = 0.0
        """Time of the first step at which they differ [s]."""

    @property
    def difference(self) -> FloatArray | None:
        """Of the motion by the wheels from that by the estimate (3,), since they began to disagree; None where they agree."""
        return None if self._motions is None else se2.log(se2.between(self._motions[1], self._motions[0]))

    def add(self, step: Step, delta: FloatArray, nis: float | None) -> None:
        """``delta`` (3,) of ``step`` by the estimate, and its NIS. Steps without scans or moving wheels are not compared."""
        wheels = step.predicted.delta if step.has_wheels else delta
        if self._motions is not None:
            self._motions = se2.compose(self._motions[0], wheels), se2.compose(self._motions[1], delta)
        if step.scan is None or not step.has_wheels or step.is_standing:
            return
        off = se2.log(se2.between(wheels, delta))
        square = max(float(off @ np.linalg.solve(step.predicted.cov + _SCAN_NOISE, off)), nis or 0.0)
        self._rows.append((step.end_ns * _NS, min(square, _MAX_SQUARE), wheels, delta))
        while self._rows[0][0] < self._rows[-1][0] - _DISAGREEMENT_S:
            self._rows.popleft()
        self.mean_square = sum(row[1] for row in self._rows) / len(self._rows)
        is_short = self._rows[-1][0] - self._rows[0][0] < 0.9 * _DISAGREEMENT_S or len(self._rows) < _MIN_DISAGREEING_SCANS
        if is_short or self.mean_square <= _MAX_MEAN_SQUARE:
            self._motions = None
        elif self._motions is None:
            wheels, estimated = (functools.reduce(se2.compose, (row[i] for row in self._rows), np.zeros(3)) for i in (2, 3))
            self._motions = wheels, estimated
            self.began_s = next(row[0] for row in self._rows if row[1] > _MAX_MEAN_SQUARE)


class OwnBodyFilter:
    """Removes points of the robot itself from scans: their beams have the same range while the robot drives and turns."""

    def __init__(self) -> None:
        self._range = np.full(_BODY_BEARINGS, np.nan)
        self._travel = np.zeros(_BODY_BEARINGS)
        self._headings = np.zeros((2, _BODY_BEARINGS))  # least and greatest since the range is the same [rad]
        self._is_own = np.zeros(_BODY_BEARINGS, dtype=bool)
        self._travelled = self._heading = 0.0
        self.share = 0.0
        """Largest share of a scan's points that were the robot itself, 0 to 1."""

    def add_motion(self, delta: FloatArray) -> None:
        """Motion (3,) of the body since the last call."""
        self._travelled += math.hypot(delta[0], delta[1])
        self._heading += float(delta[2])

    def filter(self, scan: Scan) -> Scan:
        """``scan`` without the points that were recognized as the robot itself. Only planar scans are examined."""
        points = scan.points
        if not scan.is_planar or not len(points):
            return scan
        r2 = points[:, 0] ** 2 + points[:, 1] ** 2
        near = np.flatnonzero(r2 < _MAX_BODY_RANGE_M**2)  # no point that is not finite
        if not len(near):
            self._range, self._travelled = np.full(_BODY_BEARINGS, np.nan), 0.0
            return scan
        r = np.sqrt(r2[near])
        bins = np.floor(np.arctan2(points[near, 1], points[near, 0]) * (_BODY_BEARINGS / (2.0 * math.pi))).astype(np.intp) % _BODY_BEARINGS
        nearest = np.full(_BODY_BEARINGS, np.inf)
        np.minimum.at(nearest, bins, r)
        nearest[np.isinf(nearest)] = np.nan
        is_same = np.abs(nearest - self._range) <= _SAME_RANGE_M
        self._travel = np.where(is_same, self._travel + self._travelled, 0.0)
        least, greatest = self._headings
        self._headings = np.where(is_same, [np.minimum(least, self._heading), np.maximum(greatest, self._heading)], self._heading)
        self._range = np.where(is_same, self._range, nearest)
        self._travelled = 0.0
        has_turned = self._headings[1] - self._headings[0] >= _MIN_BODY_TURN_RAD
        self._is_own = is_same & (self._is_own | ((self._travel >= _MIN_BODY_TRAVEL_M) & has_turned))
        is_own = np.zeros(len(points), dtype=bool)
        is_own[near] = self._is_own[bins] & (np.abs(r - self._range[bins]) <= _SAME_RANGE_M)
        share = float(is_own.mean())
        if share < _MIN_BODY_SHARE:
            return scan
        self.share = max(self.share, share)
        return replace(scan, points=points[~is_own], offsets=scan.offsets[~is_own] if len(scan.offsets) else scan.offsets)


class ShakeDetector:
    """How long the IMU's specific force has varied as it does on a robot that drives."""

    def __init__(self) -> None:
        self._forces: deque[tuple[int, FloatArray]] = deque(maxlen=400)
        self._since_ns: int | None = None
        self._now_ns = 0

    @property
    def lasted_s(self) -> float:
        """Duration of the fault so far [s]."""
        return 0.0 if self._since_ns is None else (self._now_ns - self._since_ns) * _NS

    def insert(self, sample: ImuSample) -> None:
        """Evaluated once for each second of samples."""
        self._now_ns = sample.stamp_ns
        self._forces.append((sample.stamp_ns, sample.linear_acceleration))
        start_ns = self._forces[0][0]
        if sample.stamp_ns - start_ns < 1 / _NS:
            return
        forces = np.array([force for _, force in self._forces])
        self._forces.clear()
        is_shaking = len(forces) >= _SHAKE_SAMPLES and float(np.linalg.norm(forces.std(axis=0))) > _SHAKE_M_S2
        if not is_shaking:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = start_ns


def _relate(a: FloatArray, b: FloatArray) -> _Relation:
    """Relation of two turn rates (n,), up to a bias of the second [rad/s]."""
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < _MIN_BINS:
        return _NO_RELATION
    a, b = a[both], b[both]
    bias = float((b - a).mean())
    b = b - min(max(bias, -_MAX_BIAS_RAD_S), _MAX_BIAS_RAD_S)
    size_a, size_b = math.sqrt(float(a @ a) / len(a)), math.sqrt(float(b @ b) / len(b))
    if min(size_a, size_b) < _MIN_RATE_RAD_S:
        return _NO_RELATION
    r = float(a @ b) / len(a) / (size_a * size_b)
    is_opposite = _is_opposite(a, b) if abs(bias) > _MAX_BIAS_RAD_S else _is_opposite(a - a.mean(), b - b.mean())
    unit_ratio = _unit_ratio(a, b) or _unit_ratio(a - a.mean(), b - b.mean())
    return _Relation(r, size_b / size_a, min(size_a, size_b) >= _MIN_EXCITED_RAD_S, is_opposite, unit_ratio)


def _unit_ratio(a: FloatArray, b: FloatArray) -> float:
    """Ratio of turn rate ``b`` to ``a`` (n,) where they agree but for a factor as between degrees and radians; else 0."""
    size_a, size_b = math.sqrt(float(a @ a)), math.sqrt(float(b @ b))
    if min(size_a, size_b) < _MIN_RATE_RAD_S * math.sqrt(len(a)) or float(a @ b) < _EQUAL_CORRELATION * size_a * size_b:
        return 0.0
    low, high = _DEG_PER_RAD_RANGE
    return size_b / size_a if low <= max(size_b / size_a, size_a / size_b) <= high else 0.0


def _is_opposite(a: FloatArray, b: FloatArray) -> bool:
    """Whether two turn rates (n,) have opposite signs, and not by chance. Means that a bias explains must be taken out before."""
    r = min(max(float(a @ b) / max(math.sqrt(float(a @ a) * float(b @ b)), 1e-12), -1.0), 1.0)
    t = r * math.sqrt((len(a) - 2) / max(1.0 - r * r, 1e-9))
    return r <= _OPPOSITE_CORRELATION and t <= -_MIN_T


def _find_turn_faults(wheels_gyro: _Relation, wheels_lidar: _Relation, lidar_gyro: _Relation) -> list[tuple[str, dict[str, float | str]]]:
    """Faults by the relations of the turn rates: the sensor that contradicts the two others, or one of two."""
    found: list[tuple[str, dict[str, float | str]]] = []
    if wheels_gyro.is_opposite and lidar_gyro.is_equal:
        found.append((Fault.WHEELS_OPPOSITE, {"others": "gyro and LiDAR"}))
    elif wheels_gyro.is_opposite:
        found.append((Fault.GYRO_OPPOSITE, {"others": "wheels and LiDAR" if wheels_lidar.is_equal else "the wheels"}))
    elif wheels_lidar.is_opposite:
        found.append((Fault.LIDAR_OPPOSITE, {"others": "wheels and gyro" if wheels_gyro.is_equal else "the wheels"}))
    for relation, others in ((wheels_gyro, "the wheels"), (lidar_gyro, "the LiDAR")):
        if relation.unit_ratio:
            found.append((Fault.GYRO_UNIT, {"others": others, "ratio": relation.unit_ratio}))
            break
    return found


def _excluded_faults(wheels_gyro: _Relation, wheels_lidar: _Relation, lidar_gyro: _Relation, direction: float | None) -> set[str]:
    """Faults of installation that a window excludes."""
    found: set[str] = set()
    if wheels_gyro.is_equal or lidar_gyro.is_equal:
        found |= {Fault.GYRO_OPPOSITE, Fault.GYRO_UNIT}
    if wheels_gyro.is_equal or wheels_lidar.is_equal:
        found.add(Fault.WHEELS_OPPOSITE)
    if wheels_lidar.is_equal:
        found.add(Fault.LIDAR_OPPOSITE)
    if direction is not None and abs(direction) <= _MAX_DIRECTION_RAD:
        found.add(Fault.LIDAR_DIRECTION)
    return found


def _is_constant(gyro: FloatArray, wheels: FloatArray) -> bool:
    """Whether the gyro's rates (n,) are one and the same value while the wheels' (n,) turn by something else."""
    both = np.isfinite(gyro) & np.isfinite(wheels)
    n = int(both.sum())
    if n < _MIN_BINS or float(np.ptp(gyro[both])) > _REPEATED_RAD_S:
        return False
    off = wheels[both] - gyro[both]
    is_turning = math.sqrt(float(off @ off) / n) > _MAX_BIAS_RAD_S or float(wheels[both].std()) > _MIN_EXCITED_RAD_S
    return is_turning or (n == _WINDOW_BINS and float(wheels[both].std()) > _MIN_STUCK_WHEELS_RAD_S)


def _travel_direction(bins: list[_Bin]) -> float | None:
    """Direction [rad] of the LiDAR's travel against the wheels', where both agree among themselves; None where it is not known."""
    rows = np.array([(*b.wheels, *b.lidar) for b in bins])
    rows = rows[np.isfinite(rows).all(axis=1)]
    wheels, turned, lidar = rows[:, 0] + 1j * rows[:, 1], np.abs(rows[:, 2]), rows[:, 3] + 1j * rows[:, 4]
    is_long = (np.abs(wheels) >= _MIN_TRAVEL_M) & (np.abs(lidar) >= _MIN_TRAVEL_M) & (turned <= _MAX_CURVATURE_RAD_M * np.abs(wheels))
    if is_long.sum() < _MIN_TRAVEL_BINS:
        return None
    offset = lidar[is_long] * np.conj(wheels[is_long])
    unit = offset / np.abs(offset)
    return float(np.angle(offset.sum())) if abs(unit.mean()) >= _MIN_COHERENCE else None


def _turned(cov: FloatArray, angle: float) -> FloatArray:
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R @ cov @ R.T)
