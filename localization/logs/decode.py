"""Messages to events: a driver's message in this project's types. Stateless; what needs the message before is in `event_decoder`.

`MessageStats` counts messages that were dropped or corrected on the way, by topic and `Oddity`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localization.events import CgSample, ImuSample, Scan
from localization.messages import Message, message, phrase
from motion_models.se2 import FloatArray

MAX_SCAN_DURATION_S = 2.0
MAX_PERIODS = 1.5
"""Length of a sweep in periods: some overlap a little, and drivers join packets by whole ones."""
_MAX_SWEEP = 1e9  # of the longest sweep, in nanoseconds
_MIN_SWEEP = 0.05  # of the longest sweep, a field of view of 27 degrees: times in milliseconds are known from times that are wrong
MAX_RATE_RAD_S = math.radians(2000.0)
"""Full scale of gyros on robots [rad/s]."""
_MAX_SPECIFIC_FORCE_M_S2 = 1e5  # m/s^2; drivers use other units, in which this may be 100 g (cm/s^2)
_MAX_ORIENTATION_GAP_NS = 500_000_000  # as `rate_series` has it: over more, no turn is interpolated
_MIN_SQUARED_NORM = 0.01  # of a rotation, as its quaternion need not be normalised; a smaller one was not filled in
_MAX_BEAMS = 1_000_000  # of a planar scan; the finest scanners have 20,000
_MAX_FIELD_OF_VIEW_RAD = math.tau * 1.1  # from first to last beam; scanners that turn on a little overlap their first beam
_MAX_CACHED_NAMES = 100  # of joint lists; bounds the memory where they change with every message


class Oddity(Enum):
    """Defects of messages; the value is that of what is reported of them."""

    UNDECODABLE = "odd_messages.undecodable"
    MALFORMED = "odd_messages.malformed"
    NO_ANGLES = "odd_messages.no_angles"
    BEAM_TIME_UNIT = "odd_messages.beam_time_unit"
    BEAM_TIMES = "odd_messages.beam_times"
    NOT_FINITE = "odd_messages.not_finite"
    BEYOND = "odd_messages.beyond"
    NO_FIX = "odd_messages.no_fix"
    NO_RATES = "odd_messages.no_rates"
    RATES_OF_ORIENTATION = "odd_messages.rates_of_orientation"
    NO_STAMP = "odd_messages.no_stamp"
    FOREIGN_CLOCK = "odd_messages.foreign_clock"
    OUT_OF_ORDER = "odd_messages.out_of_order"
    REPEATED = "odd_messages.repeated"
    SECOND_FRAME = "odd_messages.second_frame"
    LATE = "odd_messages.late"
    LATE_LIVE = "odd_messages.late_live"
    OVERTAKEN = "odd_messages.overtaken"
    OLD = "odd_messages.old"
    OUTLIER = "odd_messages.outlier"
    REBASED = "odd_messages.rebased"
    RATE_OF_CLOCK = "odd_messages.rate_of_clock"
    POSE_JUMP = "odd_messages.pose_jump"
    NO_POSE = "odd_messages.no_pose"
    NO_TWIST = "odd_messages.no_twist"
    TIPPING = "odd_messages.tipping"
    TIPPING_CG = "odd_messages.tipping_cg"
    WHEEL_RATE = "odd_messages.wheel_rate"
    SECOND_PUBLISHER = "odd_messages.second_publisher"
    FROZEN_WHEEL = "odd_messages.frozen_wheel"
    CONSTANT_ANGLES = "odd_messages.constant_angles"
    WHEEL_JUMP = "odd_messages.wheel_jump"

    def describe(self, topic: str, n: int) -> Message:
        """``n`` messages of ``topic`` with this defect."""
        if self is Oddity.OLD:
            messages = phrase("odd_messages.old_many", count=n) if n > 1 else phrase("odd_messages.old_one")
        else:
            messages = phrase("odd_messages.many", count=n) if n > 1 else phrase("odd_messages.one")
        return message(self.value, topic=topic, messages=messages)


class UnusableError(Exception):
    """A message without usable content. Raised and caught within this package. ``oddity`` is what it is counted as."""

    def __init__(self, oddity: Oddity) -> None:
        super().__init__(oddity.value)
        self.oddity = oddity


class MessageStats:
    """Counts by topic and oddity."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, Oddity]] = Counter()

    def count(self, topic: str, oddity: Oddity, n: int = 1) -> None:
        """Count ``n`` messages of ``topic``."""
        self._counts[topic, oddity] += n

    def clear(self) -> None:
        """Forget all counts."""
        self._counts.clear()

    def of(self, topic: str, oddity: Oddity) -> int:
        """Count of ``topic`` and ``oddity``."""
        return self._counts[topic, oddity]

    def parts(self, topic: str) -> list[str]:
        """``topic`` and the parts of it that are counted apart (a joint, two frames)."""
        return [topic, *sorted({name for name, _ in self._counts if name.startswith(f"{topic}, ")})]

    def describe(self) -> list[Message]:
        """A message for each topic and oddity."""
        ordered = sorted(self._counts.items(), key=lambda entry: (entry[0][0], list(Oddity).index(entry[0][1])))
        return [oddity.describe(topic, n) for (topic, oddity), n in ordered if n]


@dataclass(frozen=True)
class JointReading:
    """Wheel joints at one instant."""

    stamp_ns: int
    position: FloatArray
    """(n,) [rad], NaN where absent."""
    velocity: FloatArray
    """(n,) [rad/s], NaN where absent."""


@dataclass(frozen=True)
class ArmReading:
    """Joints of the arms in one message."""

    stamp_ns: int
    names: tuple[str, ...]
    position: FloatArray
    """(n,) [rad or m], NaN where absent."""
    wheels: JointReading | None = None
    """Wheel joints of the same message; this reading's stamp is used."""


@dataclass(frozen=True)
class OdometryReading:
    """A driver's odometry at one instant."""

    stamp_ns: int
    pose: FloatArray
    """(3,) x, y, yaw."""
    twist: FloatArray
    """(3,) vx, vy, wz in the body frame."""


def stamp_ns(message: Any) -> int:
    """Header stamp [ns], 0 where the driver did not set it."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def frame_name(frame_id: str) -> str:
    """A frame's name without the slash that tf (1) put before it."""
    return frame_id.strip().lstrip("/")


def imu_decoder(
    rate_unit_rad_s: float = 1.0, max_rate_rad_s: float = MAX_RATE_RAD_S, count: Callable[[Oddity], None] = lambda oddity: None
) -> Callable[[Any, int], ImuSample | None]:
    """Decoder of sensor_msgs/Imu, with its angular velocities in ``rate_unit_rad_s``, up to ``max_rate_rad_s``. It raises `UnusableError`.

    An AHRS or a receiver with two antennas may have no gyro: the first covariance of the angular velocity is -1, and the rates are zero.
    Rates are then those of the orientation, log(R_a^T R_b) / dt from one message to the next, at the middle of both; the sum of the turns
    is the orientation's. ``count`` is called with each of these.
    """
    last: tuple[int, FloatArray] | None = None

    def decode(message: Any, stamp: int) -> ImuSample | None:
        nonlocal last
        w, a = message.angular_velocity, message.linear_acceleration
        has_gyro = message.angular_velocity_covariance[0] != -1.0 or w.x != 0.0 or w.y != 0.0 or w.z != 0.0
        if not math.isfinite(w.x + w.y + w.z + a.x + a.y + a.z):  # faster than numpy on six numbers
            raise UnusableError(Oddity.NOT_FINITE)
        fastest = max(abs(w.x), abs(w.y), abs(w.z)) * abs(rate_unit_rad_s)
        if fastest > max_rate_rad_s or max(abs(a.x), abs(a.y), abs(a.z)) > _MAX_SPECIFIC_FORCE_M_S2:
            raise UnusableError(Oddity.BEYOND)
        frame, force = frame_name(message.header.frame_id), np.array([a.x, a.y, a.z])
        if has_gyro:
            return ImuSample(stamp, rate_unit_rad_s * np.array([w.x, w.y, w.z]), force, frame)
        before, last = last, (stamp, _unit_quaternion(message))
        count(Oddity.RATES_OF_ORIENTATION)
        if before is None or not 0 < stamp - before[0] < _MAX_ORIENTATION_GAP_NS:
            return None
        turn = _turn_between(before[1], last[1]) / ((stamp - before[0]) * 1e-9)
        return ImuSample((before[0] + stamp) // 2, turn, force, frame)

    return decode


def _unit_quaternion(message: Any) -> FloatArray:
    """(4,) x, y, z, w of the orientation of a message. Raises `UnusableError` where it has none."""
    q = np.array([message.orientation.x, message.orientation.y, message.orientation.z, message.orientation.w])
    norm = float(np.linalg.norm(q))
    if message.orientation_covariance[0] == -1.0 or not norm * norm >= _MIN_SQUARED_NORM:
        raise UnusableError(Oddity.NO_RATES)
    return q / norm


def _turn_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """(3,) rotation vector from orientation ``a`` to ``b``, in the axes of ``a``; unit quaternions (4,) x, y, z, w."""
    vector = a[3] * b[:3] - b[3] * a[:3] - np.cross(a[:3], b[:3])
    sine, cosine = float(np.linalg.norm(vector)), float(a @ b)
    angle = 2.0 * math.atan2(sine, abs(cosine))
    return np.zeros(3) if sine == 0.0 else vector * math.copysign(angle / sine, cosine)


def decode_cg(message: Any, stamp: int) -> CgSample:
    """geometry_msgs/PointStamped. Raises `UnusableError`."""
    x, y = message.point.x, message.point.y
    if not math.isfinite(x + y):
        raise UnusableError(Oddity.NOT_FINITE)
    return CgSample(stamp, np.array([x, y]))


def yaw_of(q: Any) -> float:
    """Heading of a quaternion [rad]; NaN if it is no rotation (drivers that do not fill it in publish zeros)."""
    if not q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w >= _MIN_SQUARED_NORM:
        return math.nan
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def decode_odometry(message: Any, stamp: int) -> OdometryReading:
    """nav_msgs/Odometry. Raises `UnusableError`."""
    pose, twist = message.pose.pose, message.twist.twist
    where = pose.position.x, pose.position.y, yaw_of(pose.orientation)
    rate = twist.linear.x, twist.linear.y, twist.angular.z
    if not (math.isfinite(sum(where)) or math.isfinite(sum(rate))):
        raise UnusableError(Oddity.NOT_FINITE)
    return OdometryReading(stamp, np.array(where), np.array(rate))


def joint_decoder(joints: tuple[str, ...]) -> Callable[[Any, int], JointReading | None]:
    """Decoder of joint states for these joints; None for a message that has none of them (an arm's)."""

    @lru_cache(_MAX_CACHED_NAMES)
    def place_of(names: tuple[str, ...]) -> list[int] | None:
        return [names.index(joint) for joint in joints] if set(joints) <= set(names) else None

    def decode(message: Any, stamp: int) -> JointReading | None:
        place = place_of(tuple(message.name))
        if place is None:
            return None
        position, velocity = _at(message.position, place), _at(message.velocity, place)
        if not any(map(math.isfinite, (*position, *velocity))):
            raise UnusableError(Oddity.NOT_FINITE)
        return JointReading(stamp, np.array(position), np.array(velocity))

    return decode


def arm_decoder(
    joints: frozenset[str], wheels: Callable[[Any, int], JointReading | None] | None
) -> Callable[[Any, int], ArmReading | JointReading | None]:
    """Decoder of joint states for the arms' ``joints``, and by ``wheels`` for those of the wheels where one topic has both.

    A message without positions, which ROS allows, has no arm reading.
    """

    @lru_cache(_MAX_CACHED_NAMES)
    def columns_of(names: tuple[str, ...]) -> tuple[NDArray[np.intp], tuple[str, ...]]:
        found = [i for i, name in enumerate(names) if name in joints]
        return np.array(found, dtype=np.intp), tuple(names[i] for i in found)

    def decode(message: Any, stamp: int) -> ArmReading | JointReading | None:
        reading = None if wheels is None else wheels(message, stamp)
        names = tuple(message.name)
        columns, found = columns_of(names)
        position = np.asarray(message.position, dtype=float)
        if not found or not len(position):
            return reading
        if len(position) != len(names):
            if reading is None:
                raise UnusableError(Oddity.MALFORMED)
            return reading
        return ArmReading(stamp, found, position[columns], reading)

    return decode


def _at(values: Any, place: Sequence[int]) -> list[float]:
    """Plain numbers: numpy takes longer on those of some wheels."""
    numbers = np.asarray(values, dtype=float).tolist()
    try:
        return [numbers[i] for i in place]
    except IndexError:
        return [math.nan] * len(place)


def scan_decoder(period_s: float | None = None, count: Callable[[Oddity], None] = lambda oddity: None) -> Callable[[Any, int], Scan]:
    """Decoder of LaserScans that are ``period_s`` apart [s] (None: unknown); it keeps the beams' directions between scans.

    ``count`` is called with what was corrected. The decoder raises `UnusableError`.
    """
    directions: dict[tuple[int, float, float], FloatArray] = {}

    def decode(message: Any, stamp: int) -> Scan:
        with np.errstate(invalid="ignore"):  # signalling NaNs
            ranges = np.asarray(message.ranges, dtype=float)
        first, step = float(message.angle_min), float(message.angle_increment)
        if step == 0.0 and len(ranges) > 1:
            step = (float(message.angle_max) - first) / (len(ranges) - 1)
        n = len(ranges)
        if not (math.isfinite(first) and math.isfinite(step)) or n > _MAX_BEAMS:
            raise UnusableError(Oddity.MALFORMED)
        if n > 1 and not 0.0 < abs(step) * (n - 1) <= _MAX_FIELD_OF_VIEW_RAD:
            raise UnusableError(Oddity.NO_ANGLES)
        key = (len(ranges), first, step)
        direction = directions.get(key)
        if direction is None:
            angle = first + step * np.arange(len(ranges))
            direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(ranges))], axis=1)
            directions.clear()  # bounds the memory where the beams change with every scan
            directions[key] = direction
        # A comparison with NaN is false. A range at the maximum is a beam without a return.
        shortest, longest = float(message.range_min), float(message.range_max)
        hit = (ranges > 0.0) & ~(ranges < shortest) & (ranges < (longest if longest > 0.0 else np.inf))
        kept = np.flatnonzero(hit)
        points = direction.take(kept, axis=0)
        points *= ranges.take(kept)[:, None]
        beam_s, oddity = _seconds_per_beam(float(message.time_increment), n, period_s)
        if oddity is not None:
            count(oddity)
        offsets: FloatArray = np.empty(0) if beam_s == 0.0 else np.asarray(kept * beam_s, dtype=float)
        return Scan(stamp, points, offsets, frame_name(message.header.frame_id), is_planar=True)

    return decode


def _seconds_per_beam(increment: float, beams: int, period_s: float | None) -> tuple[float, Oddity | None]:
    """Time from beam to beam [s], 0 where it is not known, and what is odd about the ``increment`` of a scan.

    A sweep does not last longer than from scan to scan: one that does is in another unit, or is none. Raises `UnusableError` for no time.
    """
    sweep = abs(increment) * beams
    longest = MAX_SCAN_DURATION_S if period_s is None else min(MAX_PERIODS * period_s, MAX_SCAN_DURATION_S)
    if math.isnan(sweep) or sweep == 0.0:
        return 0.0, None
    if sweep > _MAX_SWEEP * longest:
        raise UnusableError(Oddity.MALFORMED)
    if sweep <= longest:
        return increment, None
    unit_s = next((unit for unit in (1e-3, 1e-6, 1e-9) if _MIN_SWEEP * longest <= sweep * unit <= longest), None)
    return (0.0, Oddity.BEAM_TIMES) if unit_s is None else (increment * unit_s, Oddity.BEAM_TIME_UNIT)
