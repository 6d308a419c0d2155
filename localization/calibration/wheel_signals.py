"""Rates of each wheel, as the log has them, and of every other sensor of the same motion, over the same intervals.

Nothing is clipped and no side is averaged: signs, units and sides are what is in question.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from localization.events import ImuSample, Scan
from localization.gyro import GRAVITY_SAMPLES, MAX_MOUNT_ERROR_RAD, is_gravity
from localization.lidar import LidarConfig
from localization.logs import Log
from localization.logs.decode import JointReading, OdometryReading, decode_imu, decode_odometry
from localization.logs.event_decoder import TopicDecoder, arc, late_ns
from localization.logs.topic_names import is_other_estimate
from localization.logs.topic_roles import TYPES
from localization.logs.wheel_messages import odometry_decoder, wheel_decoder
from localization.sensor_checks.scan_motion import ScanOdometry, profile_of
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

STEP_S = 0.5
"""Length of an interval [s]: latencies of drivers (up to 0.1 s) are small against it."""
_MAX_MOVING_S, _MAX_READ_S = 120.0, 900.0
"""Time after the wheels' first motion, and in all, that is read [s]."""
_MIN_COMPARED = 12
"""Intervals: six seconds."""
MIN_TURN_RAD_S = 0.03
"""Root mean square of turns that are compared."""
MAX_BIAS_RAD_S = 0.05
"""Rate of a gyro at rest, at most [rad/s]."""
_MIN_SCAN_INTERVALS = 12
"""With a motion from scan to scan; fewer are of scans that do not match."""
_MOVED = 0.02
"""Change of an angle, or rate, from where on wheels have moved, in any unit that practice has: above the noise of rates at standstill."""
_MAX_LIDAR_S = 60.0
"""Time from the wheels' first motion in which scans are used [s]; registering one takes some milliseconds."""
_MIN_SCAN_STEP_S = 0.18
"""From scan to scan, at least: over 0.08 s speeds are 3 % low (2.9, 3.3 and 2.0 % in three simulated drives), over 0.24 s 1.3 %."""
MIN_COHERENCE = 0.9
"""Least coherence of the directions of travel by LiDAR and wheels, for a LiDAR to be turned."""
MAX_SLIDE_RAD = math.radians(20.0)
"""Largest angle between the ways by wheels and LiDAR that a slide explains [rad], as in the sensor check of the direction of travel: no
slide of 99.9 % of the windows of three buildings is larger."""
_DEG_PER_RAD = 180.0 / math.pi
_JUMP_FACTOR = 8.0
"""Increment of a position over the 97th percentile of all, from which on it is a reset or a counter that wrapped."""


@dataclass(frozen=True, eq=False)
class WheelSignals:
    """Signals over n intervals of `STEP_S`; NaN where unknown."""

    joints: tuple[str, ...]
    """Left wheels, then right ones; empty where the wheels are a driver's odometry."""
    left: int
    """How many of ``joints`` are left."""
    rates: FloatArray
    """(n, joints) mean of the velocities [rad/s by the robot file]."""
    angle_rates: FloatArray
    """(n, joints) by the positions [rad/s by the robot file]."""
    turns: Mapping[str, FloatArray]
    """(n,) yaw rates by source [rad/s]: "gyro", topics of odometry, "LiDAR"."""
    speeds: Mapping[str, FloatArray]
    """(n,) forward speeds by source [m/s]."""
    is_gyro_upright: bool = True
    """The IMU's mount agrees with gravity; else the sign of its yaw rate is unknown."""
    jumps: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """(m, 2) message and size of sudden changes of positions, in the unit of the log."""
    first_ns: int = 0
    start_s: float = 0.0

    @property
    def joint_rates(self) -> FloatArray:
        """(n, joints) by the velocities, else by the positions [rad/s by the robot file]."""
        return np.where(np.isfinite(self.rates), self.rates, self.angle_rates)


@dataclass(frozen=True)
class _Tagged:
    """A payload with its topic."""

    stamp_ns: int
    topic: str
    reading: Any


def read_signals(log: Log) -> WheelSignals | None:
    """Signals of ``log`` besides its LiDAR; None where it has no wheels."""
    wheels = log.sources.wheels
    if wheels is None:
        return None
    sources = _decoders(log)
    gathered: dict[str, list[Any]] = {}
    first_ns = moving_ns = first = None
    late = {source.topic: late_ns(source.kind, log.robot.clock) for source in log.sources.used()}
    for payload in log.readings({t: TopicDecoder(0, _tag(t, decode), late.get(t, 0)) for t, decode in sources.items()}):
        first_ns = payload.stamp_ns if first_ns is None else first_ns
        gathered.setdefault(payload.topic, []).append(payload.reading)
        if moving_ns is None and payload.topic == wheels.topic:
            first = payload.reading if first is None else first
            moving_ns = payload.stamp_ns if _has_moved(first, payload.reading) else None
        until = first_ns + _MAX_READ_S * 1e9 if moving_ns is None else moving_ns + _MAX_MOVING_S * 1e9
        if payload.stamp_ns > until:
            break
    return None if first_ns is None else _signals(log, gathered, first_ns, first_ns if moving_ns is None else moving_ns)


def _decoders(log: Log) -> dict[str, Callable[[Any, int], Any]]:
    """By topic: wheels, IMU, and odometry of the driver that is not used."""
    found: dict[str, Callable[[Any, int], Any]] = {}
    of_wheels = wheel_decoder((*log.joints[0], *log.joints[1]), log.robot.joints)
    for source in log.sources.all_wheels:
        if source.kind == "joint_states":
            found[source.topic] = of_wheels
        else:
            found[source.topic] = odometry_decoder(source.type, log.robot.driver.length_unit_m)
    if log.sources.imu is not None:
        found[log.sources.imu.topic] = partial(_decode_fast_imu, unit=log.robot.imu.rate_unit_rad_s)
    reserved = {log.reference_topic, log.robot.topics.reference}
    for topic, kind in log.types.items():
        if kind == TYPES["odometry"] and topic not in reserved and not is_other_estimate(topic):
            found.setdefault(topic, decode_odometry)
    return found


def _decode_fast_imu(message: Any, stamp: int, unit: float) -> ImuSample:
    """Decode an IMU message (`decode_imu`) whose rates only another unit than rad/s explains."""
    sample = decode_imu(message, stamp, unit / _DEG_PER_RAD)
    return replace(sample, angular_velocity=_DEG_PER_RAD * sample.angular_velocity)


def _tag(topic: str, decode: Callable[[Any, int], Any]) -> Callable[[Any, int], _Tagged | None]:
    def tagged(message: Any, stamp: int) -> _Tagged | None:
        reading = decode(message, stamp)
        return None if reading is None else _Tagged(reading.stamp_ns, topic, reading)

    return tagged


def _has_moved(first: Any, reading: Any) -> bool:
    """Whether the wheels have turned since their ``first`` reading, in any unit."""
    if isinstance(reading, JointReading):
        return bool((np.abs(reading.velocity) > _MOVED).any() or (np.abs(reading.position - first.position) > _MOVED).any())
    return bool((np.abs(reading.twist) > _MOVED).any() or (np.abs(reading.pose - first.pose) > _MOVED).any())


def _signals(log: Log, gathered: Mapping[str, Sequence[Any]], first_ns: int, moving_ns: int) -> WheelSignals | None:
    wheels = log.sources.wheels
    assert wheels is not None
    # readings of wheels on several topics come from the one that completes them
    of_wheels = [r for source in log.sources.all_wheels for r in gathered.get(source.topic, ())]
    of_wheels.sort(key=lambda reading: reading.stamp_ns)
    if len(of_wheels) < 3:
        return None
    start, end = (moving_ns - first_ns) * 1e-9 - 1.0, (of_wheels[-1].stamp_ns - first_ns) * 1e-9
    edges = np.arange(max(start, 0.0), end, STEP_S)
    if len(edges) < 3:
        return None
    n = len(edges) - 1
    turns: dict[str, FloatArray] = {}
    speeds: dict[str, FloatArray] = {}
    is_upright = True
    for topic, readings in gathered.items():
        if log.sources.imu is not None and topic == log.sources.imu.topic:
            turns["gyro"], is_upright = _gyro(readings, log.mounts, edges, first_ns)
        elif isinstance(readings[0], OdometryReading):
            speeds[topic], turns[topic] = _odometry(readings, edges, first_ns)
    joints, left = (*log.joints[0], *log.joints[1]), len(log.joints[0])
    rates = angle_rates = np.full((n, len(joints)), np.nan)
    jumps = np.zeros((0, 2))
    if joints:
        t = _seconds(of_wheels, first_ns)
        rates = _mean_rates(t, np.array([r.velocity for r in of_wheels]), edges)
        angles, jumps = _continuous(np.array([r.position for r in of_wheels]))
        angle_rates = _differences(t, angles, edges)
        jumps = jumps / [1.0, log.robot.joints.angle_unit_rad]
    return WheelSignals(joints, left, rates, angle_rates, turns, speeds, is_upright, jumps, first_ns, float(edges[0]))


def signals_of_readings(
    wheels: Sequence[JointReading], gyro: Sequence[ImuSample], mounts: Mapping[str, Mount], joints: tuple[tuple[str, ...], tuple[str, ...]]
) -> WheelSignals | None:
    """Signals of live readings of the ``joints`` (left, right) and the gyro; None for too short a time."""
    first_ns = wheels[0].stamp_ns
    t = _seconds(wheels, first_ns)
    edges = np.arange(0.0, t[-1], STEP_S)
    if len(edges) < 3:
        return None
    rates = _mean_rates(t, np.array([reading.velocity for reading in wheels]), edges)
    angles, _ = _continuous(np.array([reading.position for reading in wheels]))
    turns: dict[str, FloatArray] = {}
    is_upright = True
    if gyro:
        turns["gyro"], is_upright = _gyro(gyro, mounts, edges, first_ns)
    of_angles = _differences(t, angles, edges)
    return WheelSignals((*joints[0], *joints[1]), len(joints[0]), rates, of_angles, turns, {}, is_upright, first_ns=first_ns)


def signals_of_odometry(
    topic: str, readings: Sequence[OdometryReading], gyro: Sequence[ImuSample], mounts: Mapping[str, Mount]
) -> WheelSignals | None:
    """Signals of live readings of the driver's odometry on ``topic`` and the gyro; None for too short a time."""
    first_ns = readings[0].stamp_ns
    edges = np.arange(0.0, (readings[-1].stamp_ns - first_ns) * 1e-9, STEP_S)
    if len(edges) < 3:
        return None
    speed, turn = _odometry(readings, edges, first_ns)
    turns, is_upright = {topic: turn}, True
    if gyro:
        turns["gyro"], is_upright = _gyro(gyro, mounts, edges, first_ns)
    none = np.empty((len(edges) - 1, 0))
    return WheelSignals((), 0, none, none, turns, {topic: speed}, is_upright, first_ns=first_ns)


def _seconds(readings: Sequence[Any], first_ns: int) -> FloatArray:
    return np.array([reading.stamp_ns - first_ns for reading in readings], dtype=float) * 1e-9


def _differences(t: FloatArray, cumulative: FloatArray, edges: FloatArray) -> FloatArray:
    """Mean rates (n, k) of what grows to ``cumulative`` (m, k) over the intervals; NaN outside of the data and in gaps."""
    cumulative = cumulative.reshape(len(t), -1)
    found = np.stack([np.diff(np.interp(edges, t, column)) for column in cumulative.T], axis=-1) / STEP_S
    counts = np.diff(np.searchsorted(t, edges))
    unknown = (counts == 0) | (edges[:-1] < t[0]) | (edges[1:] > t[-1])
    found[unknown] = np.nan
    return np.asarray(found)


def _mean_rates(t: FloatArray, rates: FloatArray, edges: FloatArray) -> FloatArray:
    """Means (n, k) over the intervals of ``rates`` (m, k) at times ``t`` (m,)."""
    rates = rates.reshape(len(t), -1)
    steps = np.diff(t)[:, None] * 0.5 * (rates[1:] + rates[:-1])
    return _differences(t, np.vstack([np.zeros((1, rates.shape[1])), np.cumsum(steps, axis=0)]), edges)


def _continuous(positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``positions`` (m, k) without jumps, over which the increment before holds, and (n, 2) rows and sizes of the jumps. Joints stand
    where they are NaN."""
    steps = np.nan_to_num(np.diff(positions, axis=0))
    sizes = np.abs(steps)
    finite = sizes[np.isfinite(sizes) & (sizes > 0.0)]
    if not len(finite):
        return positions, np.zeros((0, 2))
    is_jump = sizes > _JUMP_FACTOR * float(np.percentile(finite, 97.0))
    found = []
    for i, j in zip(*np.nonzero(is_jump), strict=True):
        before = steps[i - 1, j] if i else 0.0
        found.append((i, steps[i, j] - before))
        steps[i, j] = before
    return np.vstack([positions[:1], positions[:1] + np.cumsum(steps, axis=0)]), np.array(found).reshape(-1, 2)


def _gyro(samples: Sequence[ImuSample], mounts: Mapping[str, Mount], edges: FloatArray, first_ns: int) -> tuple[FloatArray, bool]:
    """Yaw rate (n,) about the body's z axis, or about gravity where the mount contradicts it; whether it does not."""
    frame = samples[0].frame_id
    samples = [sample for sample in samples if sample.frame_id == frame]
    up = mounts.get(frame, Mount()).rotation[2]
    force = np.mean([sample.linear_acceleration for sample in samples[:GRAVITY_SAMPLES]], axis=0)
    size = float(np.linalg.norm(force))
    is_upright = not is_gravity(size) or float(force @ up) / size >= math.cos(MAX_MOUNT_ERROR_RAD)
    axis = up if is_upright else force / size
    rates = np.array([sample.angular_velocity for sample in samples]) @ axis
    return _mean_rates(_seconds(samples, first_ns), rates, edges)[:, 0], is_upright


def _odometry(readings: Sequence[OdometryReading], edges: FloatArray, first_ns: int) -> tuple[FloatArray, FloatArray]:
    """Speed and yaw rate (n,) by the poses, else by the twists."""
    t, poses = _seconds(readings, first_ns), np.array([reading.pose for reading in readings])
    if np.isfinite(poses).all() and np.ptp(poses, axis=0).any():
        steps = np.array([arc(a, b) for a, b in itertools.pairwise(poses)])
        is_jump = np.abs(steps[:, 0]) > _JUMP_FACTOR * max(float(np.percentile(np.abs(steps[:, 0]), 97.0)), 1e-3)
        steps[is_jump] = 0.0
        found = _differences(t, np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), edges)
    else:
        found = _mean_rates(t, np.array([reading.twist for reading in readings])[:, [0, 2]], edges)
    return found[:, 0], found[:, 1]


class LidarMotion(NamedTuple):
    """Motion by consecutive scans over n intervals; NaN where unknown."""

    speed: FloatArray
    """(n,) forward [m/s]."""
    turn: FloatArray
    """(n,) [rad/s]"""
    side: FloatArray
    """(n,) to the left [m/s]."""


def bias_at_rest(wheels: FloatArray, other: FloatArray, largest: float) -> float:
    """Mean of another rate (n,) while the ``wheels`` (n,) stand, up to ``largest``; 0 where they stand for fewer than three intervals."""
    still = np.abs(wheels) <= 1e-3 * max(float(np.abs(wheels).max()), 1e-9)
    bias = float(other[still].mean()) if still.sum() >= 3 else 0.0
    return min(max(bias, -largest), largest)


def correlation(a: FloatArray, b: FloatArray, least: float, max_bias: float) -> float | None:
    """Correlation about zero of two rates (n,), up to a bias of ``b``; None where ``b``'s root mean square is below ``least``, or with too
    few values."""
    both = np.isfinite(a) & np.isfinite(b)
    if both.sum() < _MIN_COMPARED:
        return None
    a, b = a[both], b[both]
    b = b - bias_at_rest(a, b, max_bias)
    size_a, size_b = math.sqrt(float(a @ a)), math.sqrt(float(b @ b))
    if size_b < least * math.sqrt(len(b)) or size_a == 0.0:
        return None
    return float(a @ b) / (size_a * size_b)


class ScanSource(Protocol):
    """A log, or what a live LiDAR has measured so far."""

    @property
    def mounts(self) -> Mapping[str, Mount]:
        """By frame."""

    def scans(self) -> Iterable[Scan]:
        """In order; none without a LiDAR."""


def lidar_motion(source: ScanSource, signals: WheelSignals) -> LidarMotion | None:
    """Motion by consecutive scans, on the intervals of ``signals``; None without a LiDAR whose scans can be matched."""
    n = len(signals.rates)
    edges = np.asarray(signals.start_s + STEP_S * np.arange(n + 1), dtype=float)
    rows = [row for row in _scan_steps(source, signals.first_ns, signals.start_s) if np.isfinite(row).all()]
    table = np.array(rows).reshape(-1, 5)
    place = np.searchsorted(edges, 0.5 * (table[:, 0] + table[:, 1])) - 1
    rates = np.full((n, 3), np.nan)
    for i in np.unique(place[(place >= 0) & (place < n)]):
        inside = table[place == i]
        rates[i] = inside[:, 2:].sum(axis=0) / (inside[:, 1] - inside[:, 0]).sum()
    if np.isfinite(rates[:, 0]).sum() < _MIN_SCAN_INTERVALS:
        return None
    return LidarMotion(rates[:, 0], rates[:, 1], rates[:, 2])


def with_lidar(source: ScanSource, signals: WheelSignals) -> WheelSignals:
    """``signals`` with the motion by scans, where there are any; its speed along the wheels' where the LiDAR is turned to the side."""
    if "LiDAR" in signals.turns:
        return signals
    motion = lidar_motion(source, signals)
    if motion is None:
        return signals
    speed = _along(motion, signals.joint_rates.mean(axis=1) if signals.joints else next(iter(signals.speeds.values()), motion.speed))
    return replace(signals, speeds={**signals.speeds, "LiDAR": speed}, turns={**signals.turns, "LiDAR": motion.turn})


def _along(motion: LidarMotion, by_wheels: FloatArray) -> FloatArray:
    """Speed (n,) by scans in the direction of travel where that is to the side of the LiDAR's mount, which its own check corrects; else
    forward."""
    way = motion.speed + 1j * motion.side
    product = np.nan_to_num(way * by_wheels)
    total = complex(product.sum())
    angle = math.atan2(total.imag, total.real)
    is_coherent = abs(total) > MIN_COHERENCE * float(np.abs(product).sum()) > 0.0
    is_aside = is_coherent and MAX_SLIDE_RAD < abs(angle) < math.pi - MAX_SLIDE_RAD
    return np.asarray((way * np.exp(-1j * angle)).real) if is_aside else motion.speed


def _scan_steps(source: ScanSource, first_ns: int, start_s: float) -> Iterator[FloatArray]:
    """Begin, end [s], way forward [m], turn [rad] and way to the left [m] from scan to scan."""
    odometry, config, last = ScanOdometry(), LidarConfig(), None
    for scan in source.scans():
        at = (scan.middle_ns - first_ns) * 1e-9
        if at < start_s:
            continue
        if at > start_s + _MAX_LIDAR_S:
            return
        if last is not None and at - last < _MIN_SCAN_STEP_S:
            continue
        motion = odometry.register(profile_of(scan, source.mounts.get(scan.frame_id, Mount()), config))
        if motion is not None and last is not None and motion.has_translation:
            yield np.array([last, at, motion.delta[0], motion.delta[2], motion.delta[1]])
        last = at
