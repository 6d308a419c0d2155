"""What a log measures of its wheels: the side and sign of each, their radius, and the track by which rates turn the robot.

Rolling wheels obey w_j = (vx + s_j (B / 2) wz) / r with s_j = +1 on the right and -1 on the left, and B the effective track (track over
k). Each wheel is regressed on both motions, so that neither names nor positions are needed; a wheel that counts backwards has a negative
coefficient of vx. The yaw rate is the gyro's where there is one: it does not depend on which wheels a driver takes for left.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from localization.logs.chunks import merge_channels
from localization.logs.decode import UnusableError, stamp_ns
from localization.logs.reader import open_source
from localization.logs.serialization import LogDeserializer
from motion_models.se2 import FloatArray

MIN_R2 = 0.9
"""Least share of a motion's mean square that a fit must explain; drivers' own odometry reaches 0.99, a wrong side or sign less than 0.5."""
RATE_UNITS = {"revolutions per minute": math.pi / 30.0, "degrees per second": math.pi / 180.0, "revolutions per second": 2.0 * math.pi}
"""Rad/s per unit of wheel rates in which drivers report besides."""
_SAME_UNIT, _NEAREST_UNIT = 0.1, 0.8
"""Largest logarithm of a measured unit over one of these: for a radius that could be, and for one that cannot (units differ by 1.8)."""
_RADII_PER_TRACK = (0.06, 0.9)
"""Wheels' radius over the track: from robots with a wide body (Roomba, 0.15; half of it by k) to monster trucks."""
_PAIRS = 4000
"""Joint states and odometry messages that are used."""
_MIN_MESSAGES = 10
_MIN_MOTION = 0.05
"""Least root mean square of speed [m/s] and yaw rate [rad/s] by which constants are fitted."""


@dataclass(frozen=True)
class WheelMotion:
    """Wheels' rates and the robot's motion at the same instants."""

    joints: tuple[str, ...]
    rates: FloatArray
    """(n, joints) [rad/s]"""
    vx: FloatArray
    """(n,) forward speed [m/s]."""
    wz: FloatArray
    """(n,) yaw rate of the same message [rad/s]."""
    gyro: FloatArray | None
    """(n,) yaw rate by the gyro [rad/s]; None where the log has none."""


@dataclass(frozen=True)
class WheelSides:
    """Wheels as the log's motion has them."""

    left: tuple[str, ...]
    right: tuple[str, ...]
    reversed: tuple[str, ...]
    """Wheels of both sides whose rates are negative when driving forward."""


@dataclass(frozen=True)
class DriverFit:
    """Constants by which wheel rates become the log's motion."""

    wheel_radius_m: float
    effective_track_m: float
    """Track over k; for a driver's odometry: its track times its multiplier."""
    r2: tuple[float, float]
    """Share of the mean square of speed and yaw rate that both regressors explain."""
    residuals: tuple[float, float]
    """Root mean square of what remains [m/s, rad/s]."""


def read_motion(path: Path, states: str, odometry: str, imu: tuple[str, FloatArray] | None, joints: Sequence[str]) -> WheelMotion | None:
    """Motion of a log by its topics of joint ``states`` and ``odometry``, on the latter's stamps; None with less than ten messages.

    ``imu``: topic, and (3,) the body's z axis in its frame. Wheels may come in one message or in one each.
    """
    source = open_source(path)
    decode = LogDeserializer(merge_channels(source.channels), is_ros1=source.is_ros1)
    rates: dict[str, list[tuple[float, float]]] = {name: [] for name in joints}
    twists: list[tuple[float, float, float]] = []
    gyro: list[tuple[float, float]] = []
    for raw in source.messages([states, odometry, *([] if imu is None else [imu[0]])]):
        try:
            message = decode(raw)
        except UnusableError:
            continue
        stamp = (stamp_ns(message) - source.start_ns) * 1e-9
        if raw.topic == odometry:
            twists.append((stamp, message.twist.twist.linear.x, message.twist.twist.angular.z))
        elif raw.topic == states:
            _append_rates(rates, message, stamp)
        elif imu is not None:
            w = message.angular_velocity
            gyro.append((stamp, float(imu[1] @ (w.x, w.y, w.z))))
        if len(twists) >= _PAIRS and max(map(len, rates.values()), default=0) >= _PAIRS:
            break
    moved = {name: series for name, series in rates.items() if len(series) >= _MIN_MESSAGES}
    if len(twists) < _MIN_MESSAGES or not moved:
        return None
    t, vx, wz = np.array(twists).T
    first, last = max(s[0][0] for s in moved.values()), min(s[-1][0] for s in moved.values())
    use = (t >= first) & (t <= last) & np.isfinite(vx) & np.isfinite(wz)
    at = t[use]
    wheels = np.stack([_at(at, series) for series in moved.values()], axis=-1)
    yaw = _at(at, gyro) if len(gyro) >= _MIN_MESSAGES and np.isfinite(gyro).all() else None
    return WheelMotion(tuple(moved), wheels, vx[use], wz[use], yaw)


def _append_rates(rates: Mapping[str, list[tuple[float, float]]], message: Any, stamp: float) -> None:
    for name, velocity in zip(message.name, message.velocity, strict=False):
        if name in rates and math.isfinite(velocity):
            rates[name].append((stamp, float(velocity)))


def _at(at: FloatArray, series: Sequence[tuple[float, float]]) -> FloatArray:
    t, value = np.array(series).T
    order = np.argsort(t, kind="stable")
    return np.asarray(np.interp(at, t[order], value[order]))


def is_moving(motion: WheelMotion) -> bool:
    """Whether speed and yaw rate are large enough, and different enough, to fit constants to them."""
    moves = len(motion.vx) >= _MIN_MESSAGES and min(math.sqrt(np.mean(v**2)) for v in (motion.vx, motion.wz)) >= _MIN_MOTION
    return bool(moves and np.linalg.matrix_rank(np.stack([motion.vx, motion.wz])) == 2)


def rate_unit(measured: float, known: float, track: float) -> tuple[str, float] | None:
    """Name and rad/s of the unit of rates by which a ``measured`` radius [m] is the ``known`` one; None for rad/s or no unit at all.

    ``track`` [m] decides how near the two must be: wheels of a few millimetres carry no robot, whatever a description has.
    """
    if not is_plausible(known, track):
        return None
    limit = _SAME_UNIT if is_plausible(measured, track) else _NEAREST_UNIT
    return next((unit for unit in RATE_UNITS.items() if abs(math.log(measured / known / unit[1])) <= limit), None)


def is_plausible(radius: float, track: float) -> bool:
    """Whether wheels of such a ``radius`` [m] can carry a robot of such a ``track`` [m]."""
    return _RADII_PER_TRACK[0] * track <= radius <= _RADII_PER_TRACK[1] * track


def wheel_sides(motion: WheelMotion) -> WheelSides | None:
    """Side and sign of each wheel; None where the robot hardly moves or a wheel does not follow both motions (R^2 below `MIN_R2`)."""
    yaw = motion.wz if motion.gyro is None else motion.gyro
    if not is_moving(motion):
        return None
    regressors = np.stack([motion.vx, yaw], axis=-1)
    left: list[str] = []
    right: list[str] = []
    backwards: list[str] = []
    for name, rate in zip(motion.joints, motion.rates.T, strict=True):
        (by_speed, by_turning), r2, _ = _regress(regressors, rate)
        if r2 < MIN_R2 or by_speed == 0.0:
            return None
        (right if by_turning / by_speed > 0.0 else left).append(name)
        if by_speed < 0.0:
            backwards.append(name)
    return WheelSides(tuple(left), tuple(right), tuple(backwards)) if left and right else None


def fit_wheels(motion: WheelMotion, left: Sequence[str], right: Sequence[str], backwards: Sequence[str] = ()) -> DriverFit | None:
    """Radius and effective track with the given sides; None where they do not give the motion: R^2 below `MIN_R2`, or a wrong sign.

    Speed and yaw rate are regressed on both the mean and the difference of the sides. The share of the other one must be small, too: a
    side with a wrong sign makes the speed follow the difference.
    """
    if not is_moving(motion) or not {*left, *right} <= set(motion.joints):
        return None
    signed = {n: (-1.0 if n in backwards else 1.0) * rate for n, rate in zip(motion.joints, motion.rates.T, strict=True)}
    of_left, of_right = (np.mean([signed[n] for n in side], axis=0) for side in (left, right))
    regressors = np.stack([(of_left + of_right) / 2.0, of_right - of_left], axis=-1)
    by_speed, r2_speed, e_speed = _regress(regressors, motion.vx)
    by_yaw, r2_yaw, e_yaw = _regress(regressors, motion.wz)
    alone = [_regress(regressors[:, [i]], motion_)[1] for i, motion_ in enumerate((motion.vx, motion.wz))]
    if min(r2_speed, r2_yaw, *alone) < MIN_R2 or by_speed[0] <= 0.0 or by_yaw[1] <= 0.0:
        return None
    # One regressor each: a driver's equations have no other, and a sensor's noise would be fitted by a second.
    radius, per_difference = (_regress(regressors[:, [i]], m)[0][0] for i, m in enumerate((motion.vx, motion.wz)))
    return DriverFit(float(radius), float(radius / per_difference), (r2_speed, r2_yaw), (e_speed, e_yaw))


def _regress(regressors: FloatArray, values: FloatArray) -> tuple[FloatArray, float, float]:
    """Coefficients, R^2 about zero and root mean square of the residuals."""
    found = np.asarray(np.linalg.lstsq(regressors, values, rcond=None)[0], dtype=float)
    residual, total = float(np.mean((values - regressors @ found) ** 2)), float(np.mean(values**2))
    return found, 1.0 - residual / total if total > 0.0 else 0.0, math.sqrt(residual)
