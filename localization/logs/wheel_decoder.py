"""Readings of joints or of a driver's odometry, in order of time, to wheel samples: means of each side, angles unwrapped.

Angles are sums of increments: of a reading that wheels cannot reach (a reset encoder or odometry) only that increment is lost, and is
taken from the rates. An angle that wrapped loses nothing. Rates that wheels cannot reach are left out,
and with them a reading that has nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from localization.events import WheelSample
from localization.logs.decode import JointReading, MessageStats, Oddity, OdometryReading
from motion_models.robot import Driver
from motion_models.se2 import FloatArray

_MAX_SPEED_M_S = 5.0
_MAX_TURN_RATE_RAD_S = 10.0
_MIN_INTERVAL_S = 0.05  # stamps jitter by milliseconds: speeds over shorter times are noise
_STATIONARY_M, _STATIONARY_RAD = 1e-9, 1e-9
_MAX_WRAP_DEVIATION_RAD, _MAX_WRAPPED_STEP_WITHOUT_RATE_RAD = 0.3, 1.0


_MAX_PUBLISHER_GAP_NS = 1_000_000_000  # of a second publisher, after its reading before; drivers publish at 10 Hz and more


_MIN_SWAPS = 6
"""Changes from one publisher to the other and back, before one is left out."""
_VELOCITY_NOISE, _MAX_ACCELERATION = 0.05, 5.0
"""Of readings without angles, and of a driver's twist [m/s, m/s^2; rad/s, rad/s^2]. Robots of this size brake at up to 3 m/s^2."""
_FROZEN_AFTER_RAD = 0.5
"""Turned by another wheel of the same side; these are coupled by a chain or by the ground."""


@dataclass(frozen=True, eq=False)
class _PublisherState:
    """Readings that follow from each other: those of one publisher."""

    reading: JointReading
    """The last one."""
    angle: FloatArray
    """(n,) accumulated [rad]."""
    turned: float = 0.0
    """Sum of the wheels' steps since there are two publishers [rad]."""


class _Motion(NamedTuple):
    """Last reading of one publisher."""

    velocity: FloatArray
    """(n,) [m/s, or rad/s in the last entry of a twist]; NaN where absent."""
    pose: FloatArray
    """(3,) [m, m, rad], or (0,)."""


@dataclass
class _Publisher:
    stamp_ns: int
    motion: _Motion
    travelled: float = 0.0
    """Since there are two publishers [m]."""


class PublisherSeparator:
    """Separates the readings of two publishers that share a topic: velocities and poses alternate between them.

    The one whose wheels travel more is used. A single step to other values is a reset, a stop, or noise.
    """

    def __init__(self) -> None:
        self._current: _Publisher | None = None
        self._other: _Publisher | None = None
        self._swaps = 0

    def admit(self, stamp_ns: int, motion: _Motion, speed: float) -> bool:
        """Whether a reading of ``motion`` at ``speed`` [m/s] is to be used."""
        if self._other is not None and stamp_ns - self._other.stamp_ns > _MAX_PUBLISHER_GAP_NS:
            self._other, self._swaps = None, 0
        current = self._current
        if current is None:
            self._current = _Publisher(stamp_ns, motion)
            return True
        if not _may_follow(current, stamp_ns, motion):
            if self._other is not None and _may_follow(self._other, stamp_ns, motion):
                current, self._other = self._other, current
                self._swaps += 1
            else:
                current, self._other, self._swaps = _Publisher(stamp_ns, motion), replace(current, travelled=0.0), 0
        if math.isfinite(speed):
            current.travelled += speed * (stamp_ns - current.stamp_ns) * 1e-9
        current.stamp_ns, current.motion = stamp_ns, motion
        self._current = current
        return self._other is None or self._swaps < _MIN_SWAPS or current.travelled >= self._other.travelled


def _may_follow(publisher: _Publisher, stamp_ns: int, motion: _Motion) -> bool:
    """Whether a robot can have come from the publisher's last reading to ``motion``."""
    passed_s = max((stamp_ns - publisher.stamp_ns) * 1e-9, _MIN_INTERVAL_S)
    change = np.abs(motion.velocity - publisher.motion.velocity)
    moved = np.abs(motion.pose - publisher.motion.pose)[:2]
    is_too_fast = bool((change > _VELOCITY_NOISE + _MAX_ACCELERATION * passed_s).any() or (moved > _MAX_SPEED_M_S * passed_s).any())
    return not is_too_fast  # a comparison with NaN is false


class JointsToWheels:
    """Converter of readings whose first ``left`` joints are the left side's and the next ``right`` the right side's.

    Where two publishers share the topic, angles alternate between theirs. The one whose wheels turn more is used: the other is mostly a
    `joint_state_publisher` that publishes zeros.
    """

    def __init__(self, left: Sequence[str], right: Sequence[str], wheel_radius_m: float, topic: str, stats: MessageStats) -> None:
        """``left`` and ``right``: names of the joints."""
        self._left, self._names = len(left), (*left, *right)
        self._radius, self._topic, self._stats = wheel_radius_m, topic, stats
        self._publisher: _PublisherState | None = None
        self._second_publisher: _PublisherState | None = None
        self._rates = PublisherSeparator()
        self._turned = np.zeros(len(self._names))  # by each joint so far [rad]
        self._is_working = np.ones(len(self._names), dtype=bool)

    def __call__(self, reading: JointReading) -> Iterator[WheelSample]:
        """The wheel sample of the next reading; none where it is not used."""
        has_angles = all(map(math.isfinite, reading.position.tolist()))
        velocity = reading.velocity
        if any(abs(rate) * self._radius > _MAX_SPEED_M_S for rate in velocity.tolist()):
            self._stats.count(self._topic, Oddity.WHEEL_RATE)
            if not has_angles:
                return
            velocity = np.where(np.abs(velocity) * self._radius > _MAX_SPEED_M_S, np.nan, velocity)
        if not has_angles:
            yield from self._convert_rates(reading.stamp_ns, velocity)
            return
        publisher = self._publisher
        if publisher is None:
            publisher = self._publisher = _PublisherState(reading, reading.position)
        elif self._is_reachable(publisher, reading):
            publisher = self._publisher = self._accumulate(publisher, reading, reading.position - publisher.reading.position)
        elif self._second_publisher is not None and self._is_reachable(self._second_publisher, reading):
            publisher, self._second_publisher = (
                self._accumulate(self._second_publisher, reading, reading.position - self._second_publisher.reading.position),
                publisher,
            )
            self._publisher = publisher
            if publisher.turned < self._second_publisher.turned:
                self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)
                return
        else:
            step, is_reset = self._corrected_step(publisher.reading, reading, velocity)
            if is_reset:
                self._stats.count(self._topic, Oddity.WHEEL_JUMP)
                self._second_publisher = replace(publisher, turned=0.0)
                publisher = replace(publisher, turned=0.0)
            publisher = self._publisher = self._accumulate(publisher, reading, step)
        self._find_frozen(publisher)
        yield WheelSample(reading.stamp_ns, self._side_means(velocity), self._side_means(publisher.angle))

    def _convert_rates(self, stamp_ns: int, velocity: FloatArray) -> Iterator[WheelSample]:
        """A reading without angles, unless it is of a second publisher."""
        angles = self._publisher
        if angles is not None and stamp_ns - angles.reading.stamp_ns <= _MAX_PUBLISHER_GAP_NS and self._turned.any():
            self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)  # wheels that have turned by their angles have these
            return
        speed = velocity * self._radius
        travel_m_s = float(np.nanmax(np.abs(speed))) if np.isfinite(speed).any() else 0.0
        if not self._rates.admit(stamp_ns, _Motion(speed, np.zeros(0)), travel_m_s):
            self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)
            return
        yield WheelSample(stamp_ns, self._side_means(velocity), np.full(2, np.nan))

    def _find_frozen(self, publisher: _PublisherState) -> None:
        """Leave out a wheel that never turns while others of its side do; its encoder has failed."""
        for side in (slice(None, self._left), slice(self._left, None)):
            turned = self._turned[side]
            if len(turned) > 1 and turned.max() > _FROZEN_AFTER_RAD:
                self._is_working[side] = turned > _STATIONARY_RAD
        for i in np.flatnonzero(~self._is_working) if not self._is_working.all() else ():
            self._stats.count(f"{self._topic}, joint '{self._names[i]}'", Oddity.FROZEN_WHEEL)

    def _is_reachable(self, publisher: _PublisherState, reading: JointReading) -> bool:
        """Whether wheels can have turned from the last reading of ``publisher`` to ``reading``."""
        passed_ns = reading.stamp_ns - publisher.reading.stamp_ns
        if publisher is self._second_publisher and passed_ns > _MAX_PUBLISHER_GAP_NS:
            return False
        step = max(map(abs, (reading.position - publisher.reading.position).tolist()))  # faster than numpy on four numbers
        return bool(step * self._radius <= _MAX_SPEED_M_S * max(passed_ns * 1e-9, _MIN_INTERVAL_S))

    def _accumulate(self, publisher: _PublisherState, reading: JointReading, step: FloatArray) -> _PublisherState:
        turned = publisher.turned if self._second_publisher is None else publisher.turned + sum(map(abs, step.tolist()))
        self._turned += np.abs(step)
        return _PublisherState(reading, publisher.angle + step, turned)

    def _corrected_step(self, known: JointReading, reading: JointReading, velocity: FloatArray) -> tuple[FloatArray, bool]:
        """(n,) increments where some are too large: of an angle that wrapped, or from the rates for one that was reset; whether one was."""
        dt = (reading.stamp_ns - known.stamp_ns) * 1e-9
        step = reading.position - known.position
        jumped = np.abs(step) * self._radius > _MAX_SPEED_M_S * max(dt, _MIN_INTERVAL_S)
        expected = np.nan_to_num(velocity) * dt
        wrapped = np.remainder(step + math.pi, math.tau) - math.pi
        is_wrap = np.abs(wrapped - expected) < np.where(np.isfinite(velocity), _MAX_WRAP_DEVIATION_RAD, _MAX_WRAPPED_STEP_WITHOUT_RATE_RAD)
        return np.where(jumped, np.where(is_wrap, wrapped, expected), step), bool((jumped & ~is_wrap).any())

    def _side_means(self, values: FloatArray) -> FloatArray:
        if not self._is_working.all():
            left, right = self._is_working[: self._left], self._is_working[self._left :]
            return np.array([values[: self._left][left].mean(), values[self._left :][right].mean()])
        numbers = values.tolist()
        return np.array([sum(numbers[: self._left]) / self._left, sum(numbers[self._left :]) / (len(numbers) - self._left)])


class OdometryToWheels:
    """Converter by the driver's own geometry, inverted: q = (vx -+ wz w_s d/2)/r (Ebersole 2016, eq. 1.4-1.8).

    Angles come from the pose, which has all the motion though messages were lost, rates from the twist. A driver may fill only
    one of the two.
    """

    def __init__(self, driver: Driver, topic: str, stats: MessageStats) -> None:
        self._radius = driver.wheel_radius_m
        self._half_track = 0.5 * driver.wheel_separation_multiplier * driver.track_width_m
        self._topic, self._stats = topic, stats
        self._previous: OdometryReading | None = None
        self._angle = np.zeros(2)
        self._pose_has_moved = self._twist_has_moved = False
        self._publishers = PublisherSeparator()

    def __call__(self, reading: OdometryReading) -> Iterator[WheelSample]:
        """The wheel sample of the next reading; none where it is not used."""
        if not self._publishers.admit(reading.stamp_ns, _Motion(reading.twist, reading.pose), float(np.hypot(*reading.twist[:2]))):
            self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)
            return
        vx, _, wz = reading.twist
        is_out_of_range = abs(vx) > _MAX_SPEED_M_S or abs(wz) > _MAX_TURN_RATE_RAD_S
        if is_out_of_range:
            self._stats.count(self._topic, Oddity.WHEEL_RATE)
            if not math.isfinite(sum(reading.pose)) or (self._twist_has_moved and not self._pose_has_moved):
                return  # the next message covers this time too
        twist_is_known = math.isfinite(vx) and math.isfinite(wz) and not is_out_of_range
        self._twist_has_moved |= twist_is_known and bool(vx != 0.0 or wz != 0.0)
        rate = self._wheels(vx, wz) if twist_is_known else np.full(2, np.nan)
        previous = self._previous
        if previous is not None:
            dt = (reading.stamp_ns - previous.stamp_ns) * 1e-9
            forward, turn = arc(previous.pose, reading.pose)
            from_twist = (vx * dt, wz * dt) if twist_is_known else (0.0, 0.0)
            moved = abs(forward) > _STATIONARY_M or abs(turn) > _STATIONARY_RAD
            longest = max(dt, _MIN_INTERVAL_S)
            if not (abs(forward) <= _MAX_SPEED_M_S * longest and abs(turn) <= _MAX_TURN_RATE_RAD_S * longest):
                self._stats.count(self._topic, Oddity.POSE_JUMP)
                forward, turn = from_twist
            elif moved:
                self._pose_has_moved = True
            elif not self._pose_has_moved and self._twist_has_moved:
                if from_twist != (0.0, 0.0):
                    self._stats.count(self._topic, Oddity.NO_POSE)
                forward, turn = from_twist
            increment = self._wheels(forward, turn)
            if not self._twist_has_moved and moved and dt > 0.0:
                self._stats.count(self._topic, Oddity.NO_TWIST)
                rate = increment / dt
            self._angle = self._angle + increment
        self._previous = reading
        yield WheelSample(reading.stamp_ns, rate, self._angle)

    def _wheels(self, forward: float, turn: float) -> FloatArray:
        return np.array([forward - turn * self._half_track, forward + turn * self._half_track]) / self._radius


def arc(world_T_a: FloatArray, world_T_b: FloatArray) -> tuple[float, float]:
    """Signed length [m] and angle [rad] of the circular arc from a to b; backwards is negative."""
    dx, dy = world_T_b[0] - world_T_a[0], world_T_b[1] - world_T_a[1]
    turn = math.remainder(world_T_b[2] - world_T_a[2], math.tau)
    middle = world_T_a[2] + 0.5 * turn
    chord = math.copysign(math.hypot(dx, dy), dx * math.cos(middle) + dy * math.sin(middle))
    half = 0.5 * turn
    return chord * (half / math.sin(half) if abs(half) > 1e-8 else 1.0), turn
