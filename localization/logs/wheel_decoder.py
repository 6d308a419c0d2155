"""Readings of joints or of a driver's odometry, in order of time, to wheel samples: side means, and angles that lose nothing.

Angles are sums of increments, so that a reading that the wheels cannot have made (an encoder or an odometry that was reset) costs its
own increment only, which is then taken from the rates. An angle that wrapped costs nothing. Rates that wheels cannot reach are left out,
and with them a reading that has nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from localization.events import WheelSample
from localization.logs.decode import JointReading, OdometryReading
from localization.logs.message_stats import MessageStats, Oddity
from motion_models.robot import Driver
from motion_models.se2 import FloatArray

_MAX_SPEED_M_S = 5.0
_MAX_TURN_RATE_RAD_S = 10.0
_MIN_INTERVAL_S = 0.05  # stamps jitter by milliseconds: speeds over shorter times are noise
_STATIONARY_M, _STATIONARY_RAD = 1e-9, 1e-9
_WRAP_RAD, _WRAP_WITHOUT_RATE_RAD = 0.3, 1.0


_MAX_PUBLISHER_GAP_NS = 1_000_000_000  # of a second publisher, after its reading before; drivers publish at 10 Hz and more


@dataclass(frozen=True, eq=False)
class _PublisherState:
    """Readings that follow from each other: those of one publisher."""

    reading: JointReading
    """The last one."""
    angle: FloatArray
    """(n,) accumulated [rad]."""
    turned: float = 0.0
    """Sum of the wheels' steps since there are two publishers [rad]."""


class JointsToWheels:
    """Converter of readings whose first ``left`` joints are the left side's and the next ``right`` the right side's.

    Where two publishers share the topic, angles leap to and fro between what either of them publishes. The one whose wheels turn more is
    used: a second one is mostly a `joint_state_publisher` that fills in zeros.
    """

    def __init__(self, left: int, right: int, wheel_radius_m: float, topic: str, stats: MessageStats) -> None:
        self._left, self._right, self._radius, self._topic, self._stats = left, right, wheel_radius_m, topic, stats
        self._publisher: _PublisherState | None = None
        self._second_publisher: _PublisherState | None = None

    def __call__(self, reading: JointReading) -> Iterator[WheelSample]:
        has_angles = all(map(math.isfinite, reading.position.tolist()))
        velocity = reading.velocity
        if any(abs(rate) * self._radius > _MAX_SPEED_M_S for rate in velocity.tolist()):
            self._stats.count(self._topic, Oddity.WHEEL_RATE)
            if not has_angles:
                return
            velocity = np.where(np.abs(velocity) * self._radius > _MAX_SPEED_M_S, np.nan, velocity)
        if not has_angles:
            yield WheelSample(reading.stamp_ns, self._side_means(velocity), np.full(2, np.nan))
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
        yield WheelSample(reading.stamp_ns, self._side_means(velocity), self._side_means(publisher.angle))

    def _is_reachable(self, publisher: _PublisherState, reading: JointReading) -> bool:
        """Whether wheels can have turned from the last reading of ``publisher`` to ``reading``."""
        passed_ns = reading.stamp_ns - publisher.reading.stamp_ns
        if publisher is self._second_publisher and passed_ns > _MAX_PUBLISHER_GAP_NS:
            return False
        step = max(map(abs, (reading.position - publisher.reading.position).tolist()))  # faster than numpy on four numbers
        return bool(step * self._radius <= _MAX_SPEED_M_S * max(passed_ns * 1e-9, _MIN_INTERVAL_S))

    def _accumulate(self, publisher: _PublisherState, reading: JointReading, step: FloatArray) -> _PublisherState:
        turned = publisher.turned if self._second_publisher is None else publisher.turned + sum(map(abs, step.tolist()))
        return _PublisherState(reading, publisher.angle + step, turned)

    def _corrected_step(self, known: JointReading, reading: JointReading, velocity: FloatArray) -> tuple[FloatArray, bool]:
        """(n,) increments where some are too large: of an angle that wrapped, or from the rates for one that was reset; whether one was."""
        dt = (reading.stamp_ns - known.stamp_ns) * 1e-9
        step = reading.position - known.position
        jumped = np.abs(step) * self._radius > _MAX_SPEED_M_S * max(dt, _MIN_INTERVAL_S)
        expected = np.nan_to_num(velocity) * dt
        wrapped = np.remainder(step + math.pi, math.tau) - math.pi
        is_wrap = np.abs(wrapped - expected) < np.where(np.isfinite(velocity), _WRAP_RAD, _WRAP_WITHOUT_RATE_RAD)
        return np.where(jumped, np.where(is_wrap, wrapped, expected), step), bool((jumped & ~is_wrap).any())

    def _side_means(self, values: FloatArray) -> FloatArray:
        numbers = values.tolist()
        return np.array([sum(numbers[: self._left]) / self._left, sum(numbers[self._left :]) / self._right])


class OdometryToWheels:
    """Converter by the driver's own geometry, inverted: q = (vx -+ wz w_s d/2)/r (Ebersole 2016, eq. 1.4-1.8).

    Angles come from the pose, of which messages that were lost take nothing away, rates from the twist. A driver may fill only
    one of the two.
    """

    def __init__(self, driver: Driver, topic: str, stats: MessageStats) -> None:
        self._radius = driver.wheel_radius_m
        self._half_track = 0.5 * driver.wheel_separation_multiplier * driver.track_width_m
        self._topic, self._stats = topic, stats
        self._previous: OdometryReading | None = None
        self._angle = np.zeros(2)
        self._pose_has_moved = self._twist_has_moved = False

    def __call__(self, reading: OdometryReading) -> Iterator[WheelSample]:
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
