"""Wheels that read zero while the LiDAR moves, the IMU shakes or the gyro turns."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from localization.events import ImuSample, Step
from localization.inputs.step_config import StepConfig
from localization.inputs.wheel_gaps import UnknownVelocity
from localization.messages import phrase
from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.window import Bins, Window
from motion_models.se2 import FloatArray

Motion = Literal["", "lidar_moved", "imu_shakes"]
"""Sensor that shows that the robot drives; empty where none does."""
WHEELS_STANDING = SensorFault(
    "standing_wheels.while_moving",
)

_RECENT_BINS, _MIN_LIDAR_S = 8, 1.0
"""Bins in which the LiDAR's speed is measured while the wheels read zero, and the least time in them [s]."""
_STANDING_SPEED_M_S = 0.1
_MAX_STANDING_RATE_RAD_S, _SIGMAS = 0.1, 5.0
"""Rate of a gyro at rest at most, beside its noise: twenty times the prior sigma of the shipped robots' bias."""
_MIN_RATE_SIGMA_RAD_S, _REPEATED_RAD_S = 0.02, 1e-7
"""Standard deviation of a gyro's rates in the recent bins: at rest 0.004 for a cheap one (0.002 rad/s/sqrt(Hz)), and never zero."""
_MIN_TURNING_S = 1.0
"""Time for which the gyro must turn to be reported: with clocks 0.1 s apart it does for a moment at the end of each turn."""
_SHAKE_M_S2, _SHAKE_SAMPLES, _SHAKE_PARTS = 0.4, 20, 5
"""Standard deviation of the specific force in a second, the median of its fifths, as a knock is in two of them at most: Husky outdoors at
rest 0.005 to 0.10, driving 0.51 to 1.5 (5 to 95 %). Another Husky (BorealTC) has more in all seconds but those on snow (82 %)."""
_SHAKE_FACTOR = 3.0
"""Shaking on a robot that drives over that of the calmest second so far, beside no other sensor: a fan or a motor shakes at rest."""
_SHAKE_S = 2.0
_NS = 1e-9


@dataclass
class _Stop:
    """A time for which the wheels read zero [s]."""

    stood_s: float = 0.0
    """All of it."""
    turned_s: float = 0.0
    """Its end, while the gyro turns."""
    rested_s: float = 0.0
    """Its end, while gyro and IMU are at rest too."""
    trusted_s: float = 0.0
    """Part of it that counted as standing while no scan has measured the pose since."""
    is_confirmed: bool = False
    """Gyro or IMU have shown that the robot moved meanwhile."""


class Standstill:
    """Such wheels count as unknown, for as long as that lasts.

    Objects that move around a standing robot look like its own motion. Where there is a gyro or an IMU, one must confirm the LiDAR, once
    until the wheels turn again. Wheels that have never turned, though gyro or LiDAR showed motion, are unknown until they do: encoders that
    count nothing show no standstill either.
    """

    def __init__(self, faults: FaultLog, window: Window, config: StepConfig) -> None:
        self._faults, self._window, self._velocity = faults, window, UnknownVelocity(config.unknown_sigma)
        self._shaking: dict[str, ShakeDetector] = {}  # by the IMU's frame
        self._stop = _Stop()
        self._have_turned = False  # the wheels, so far
        self._is_dead = False  # wheels that have not, while the robot moved

    def insert_imu(self, sample: ImuSample) -> None:
        """Specific force shows whether the robot moves."""
        if sample.frame_id not in self._shaking:
            self._shaking[sample.frame_id] = ShakeDetector()
        self._shaking[sample.frame_id].insert(sample)

    def apply(self, step: Step, *, is_contradicted: bool) -> Step:
        """``step`` with unknown wheels where these ``is_contradicted``, or stand while another sensor shows motion."""
        if not step.is_standing:
            self._have_turned |= step.has_wheels and bool(step.predicted.delta.any())
            self._is_dead &= not self._have_turned
            self._stop = _Stop()
            if is_contradicted and step.has_wheels:
                return step.without_wheels(self._velocity.increment(step.duration, has_turn=step.turn is not None))
            self._velocity.lasted_s = 0.0
            if step.has_wheels:
                self._velocity.measured = step.twist
            return step
        stop = self._stop
        stop.stood_s += step.duration
        stop.turned_s = stop.turned_s + step.duration if _is_turning(step) else 0.0
        moving = self._moving()
        contradicted_s = stop.stood_s if moving else stop.turned_s
        if moving or stop.turned_s >= _MIN_TURNING_S:
            is_unsure = moving == "lidar_moved" and not stop.is_confirmed
            besides = phrase("standing_wheels.or_objects") if is_unsure else ""
            numbers = {"others": _describe_motion(moving), "besides": besides}
            self._faults.declare(WHEELS_STANDING, self._faults.now_s - contradicted_s, numbers)
            self._is_dead |= not self._have_turned and (stop.is_confirmed or stop.turned_s >= _MIN_TURNING_S)
        if not contradicted_s and not self._is_dead:
            stop.trusted_s += step.duration
            self._velocity.lasted_s = 0.0
            stop.rested_s = stop.rested_s + step.duration if self._is_at_rest(step) else 0.0
            return replace(step, rested_s=stop.rested_s) if stop.rested_s else step
        stop.rested_s = 0.0
        unknown_s = step.duration
        if moving:
            unknown_s, stop.trusted_s = unknown_s + stop.trusted_s, 0.0
        return step.without_wheels(self._velocity.increment(unknown_s, has_turn=step.turn is not None))

    def restart(self) -> None:
        """A matched scan measured the pose: what is unknown counts from here on."""
        self._velocity.lasted_s = self._stop.trusted_s = 0.0

    def _is_at_rest(self, step: Step) -> bool:
        """Whether wheels, gyro and IMU measure in ``step`` what they do on a robot at rest."""
        has_imu = any(detector.has_noise and not detector.lasted_s for detector in self._shaking.values())
        return step.is_standing and step.has_wheels and step.turn is not None and not _is_turning(step) and has_imu

    def _moving(self) -> Motion:
        """What shows that the robot drives; "" where nothing does."""
        recent = self._window.bins
        is_compared = (recent.is_standing > 0.0) & np.isfinite(recent.lidar[:, 0])
        bins = Bins.of(recent.rows[-_RECENT_BINS:][is_compared[-_RECENT_BINS:]])
        travelled, lasted = float(np.hypot(*bins.lidar[:, :2].T).sum()), float(bins.durations_s.sum())
        shaking = [d for d in self._shaking.values() if min(d.lasted_s, self._stop.stood_s) >= _SHAKE_S]
        is_shaking = bool(shaking)
        if lasted >= _MIN_LIDAR_S and travelled >= _STANDING_SPEED_M_S * lasted:
            rates = bins.gyro / bins.durations_s
            self._stop.is_confirmed |= is_shaking or _has_turned(rates)
            has_second = _is_working(rates) or any(detector.has_noise for detector in self._shaking.values())
            return "lidar_moved" if self._stop.is_confirmed or not has_second else ""
        is_alone = not len(bins.rows) and any(detector.is_unusual for detector in shaking)
        return "imu_shakes" if is_alone else ""


def _describe_motion(moving: Motion) -> str:
    """What ``moving`` is, as part of the sentence."""
    if moving == "lidar_moved":
        return phrase("standing_wheels.lidar_moved")
    return phrase("standing_wheels.imu_shakes") if moving else phrase("standing_wheels.gyro_turned")


def _is_turning(step: Step) -> bool:
    """Whether the gyro turns by more than its noise and bias."""
    turn = step.turn
    return turn is not None and abs(turn.angle) > _MAX_STANDING_RATE_RAD_S * turn.duration + _SIGMAS * math.sqrt(turn.variance)


def _is_working(rates: FloatArray) -> bool:
    """Whether a gyro measured ``rates`` (n,) [rad/s]: noise alone changes them."""
    return bool(np.isfinite(rates).all() and np.ptp(rates) > _REPEATED_RAD_S)


def _has_turned(rates: FloatArray) -> bool:
    """Whether a gyro's ``rates`` (n,) [rad/s] are those of a robot that moves."""
    return _is_working(rates) and bool(rates.std() > _MIN_RATE_SIGMA_RAD_S or abs(rates.mean()) > _MAX_STANDING_RATE_RAD_S)


def _shake(forces: FloatArray) -> float:
    """How much specific ``forces`` (n, 3) of a second vary [m/s^2]; nan of too few."""
    if len(forces) < _SHAKE_SAMPLES:
        return math.nan
    parts = np.array_split(forces, _SHAKE_PARTS)
    return float(np.median([np.linalg.norm(part.std(axis=0, ddof=1)) for part in parts]))


class ShakeDetector:
    """How long an IMU's specific force has varied as it does on a robot that drives."""

    def __init__(self) -> None:
        self._forces: deque[tuple[int, FloatArray]] = deque(maxlen=400)
        self._since_ns: int | None = None
        self._now_ns = 0
        self._least = self._shake = math.inf
        self.has_noise = False
        """Whether the specific force has ever changed: some drivers leave it at zero."""

    @property
    def is_unusual(self) -> bool:
        """It shakes far more than in the calmest second so far."""
        return self._shake > _SHAKE_FACTOR * self._least

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
        self.has_noise |= bool(np.ptp(forces, axis=0).any())
        self._shake = _shake(forces)
        self._least = min(self._least, self._shake)
        if not self._shake > _SHAKE_M_S2:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = start_ns
