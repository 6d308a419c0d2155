"""Readings of joints or of a driver's odometry, in order of time, to wheel samples: side means, and angles that lose nothing.

Angles are sums of increments, so that a reading that the wheels cannot have made (an encoder or an odometry that was reset) costs its
own increment only, which is then taken from the rates. An angle that wrapped costs nothing. Rates that wheels cannot reach are left out,
and with them a reading that says nothing else.
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

_FASTEST_M_PER_S = 5.0
_FASTEST_RAD_PER_S = 10.0
_SHORTEST_S = 0.05  # stamps jitter: over shorter times than this a speed means nothing
_STILL_M, _STILL_RAD = 1e-9, 1e-9
_WRAP_RAD, _WRAP_WITHOUT_RATE_RAD = 0.3, 1.0


_LATEST_NS = 1_000_000_000  # of a second publisher, after its reading before; drivers publish at 10 Hz and more


@dataclass(frozen=True, eq=False)
class _Chain:
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
        self._chain: _Chain | None = None
        self._other: _Chain | None = None

    def __call__(self, reading: JointReading) -> Iterator[WheelSample]:
        has_angles = all(map(math.isfinite, reading.position.tolist()))
        velocity = reading.velocity
        if any(abs(rate) * self._radius > _FASTEST_M_PER_S for rate in velocity.tolist()):
            self._stats.count(self._topic, Oddity.WHEEL_RATE)
            if not has_angles:
                return
            velocity = np.where(np.abs(velocity) * self._radius > _FASTEST_M_PER_S, np.nan, velocity)
        if not has_angles:
            yield WheelSample(reading.stamp_ns, self._side_means(velocity), np.full(2, np.nan))
            return
        chain = self._chain
        if chain is None:
            chain = self._chain = _Chain(reading, reading.position)
        elif self._reaches(chain, reading):
            chain = self._chain = self._follow(chain, reading, reading.position - chain.reading.position)
        elif self._other is not None and self._reaches(self._other, reading):
            chain, self._other = self._follow(self._other, reading, reading.position - self._other.reading.position), chain
            self._chain = chain
            if chain.turned < self._other.turned:
                self._stats.count(self._topic, Oddity.SECOND_PUBLISHER)
                return
        else:
            step, is_reset = self._mended_step(chain.reading, reading, velocity)
            if is_reset:
                self._stats.count(self._topic, Oddity.WHEEL_JUMP)
                self._other = replace(chain, turned=0.0)
                chain = replace(chain, turned=0.0)
            chain = self._chain = self._follow(chain, reading, step)
        yield WheelSample(reading.stamp_ns, self._side_means(velocity), self._side_means(chain.angle))

    def _reaches(self, chain: _Chain, reading: JointReading) -> bool:
        """Whether wheels can have turned from the last reading of ``chain`` to ``reading``."""
        passed_ns = reading.stamp_ns - chain.reading.stamp_ns
        if chain is self._other and passed_ns > _LATEST_NS:
            return False
        step = max(map(abs, (reading.position - chain.reading.position).tolist()))  # quicker than numpy's, on a handful
        return bool(step * self._radius <= _FASTEST_M_PER_S * max(passed_ns * 1e-9, _SHORTEST_S))

    def _follow(self, chain: _Chain, reading: JointReading, step: FloatArray) -> _Chain:
        turned = chain.turned if self._other is None else chain.turned + sum(map(abs, step.tolist()))
        return _Chain(reading, chain.angle + step, turned)

    def _mended_step(self, known: JointReading, reading: JointReading, velocity: FloatArray) -> tuple[FloatArray, bool]:
        """(n,) increments where some are too large: of an angle that wrapped, or from the rates for one that was reset; whether one was."""
        dt = (reading.stamp_ns - known.stamp_ns) * 1e-9
        step = reading.position - known.position
        jumped = np.abs(step) * self._radius > _FASTEST_M_PER_S * max(dt, _SHORTEST_S)
        expected = np.nan_to_num(velocity) * dt
        wrapped = np.remainder(step + math.pi, math.tau) - math.pi
        is_wrap = np.abs(wrapped - expected) < np.where(np.isfinite(velocity), _WRAP_RAD, _WRAP_WITHOUT_RATE_RAD)
        return np.where(jumped, np.where(is_wrap, wrapped, expected), step), bool((jumped & ~is_wrap).any())

    def _side_means(self, values: FloatArray) -> FloatArray:
        numbers = values.tolist()
        return np.array([sum(numbers[: self._left]) / self._left, sum(numbers[self._left :]) / self._right])


class OdometryToWheels:
    """Converter by the driver's own geometry, inverted: q = (vx -+ wz w_s d/2)/r (Ebersole 2016, eq. 1.4-1.8).

    Angles come from the pose, of which messages that were lost take nothing away, rates from the twist. A driver that fills only
    one of the two is understood.
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
        is_wild = abs(vx) > _FASTEST_M_PER_S or abs(wz) > _FASTEST_RAD_PER_S
        if is_wild:
            self._stats.count(self._topic, Oddity.WHEEL_RATE)
            if not math.isfinite(sum(reading.pose)) or (self._twist_has_moved and not self._pose_has_moved):
                return  # only the twist would have told, and the next message tells of this time too
        twist_is_known = math.isfinite(vx) and math.isfinite(wz) and not is_wild
        self._twist_has_moved |= twist_is_known and bool(vx != 0.0 or wz != 0.0)
        rate = self._wheels(vx, wz) if twist_is_known else np.full(2, np.nan)
        previous = self._previous
        if previous is not None:
            dt = (reading.stamp_ns - previous.stamp_ns) * 1e-9
            forward, turn = arc(previous.pose, reading.pose)
            from_twist = (vx * dt, wz * dt) if twist_is_known else (0.0, 0.0)
            moved = abs(forward) > _STILL_M or abs(turn) > _STILL_RAD
            longest = max(dt, _SHORTEST_S)
            if not (abs(forward) <= _FASTEST_M_PER_S * longest and abs(turn) <= _FASTEST_RAD_PER_S * longest):
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
