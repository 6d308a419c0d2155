"""Readings of joints or of a driver's odometry, in order of time, to wheel samples: side means, and angles that lose nothing.

Angles are sums of increments, so that a reading that the wheels cannot have made (an encoder or an odometry that was reset) costs its
own increment only, which is then taken from the rates. An angle that wrapped costs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from localization.events import WheelSample
from localization.logs.decode import JointReading, OdometryReading
from localization.logs.tally import Oddity, Tally
from motion_models.robot import Driver
from motion_models.se2 import FloatArray

_FASTEST_M_PER_S = 5.0
_FASTEST_RAD_PER_S = 10.0
_SHORTEST_S = 0.05  # stamps jitter: over shorter times than this a speed means nothing
_STILL_M, _STILL_RAD = 1e-9, 1e-9
_WRAP_RAD, _WRAP_WITHOUT_RATE_RAD = 0.3, 1.0


def joints_to_wheels(left: int, right: int, wheel_radius_m: float, topic: str, tally: Tally) -> Callable[[JointReading], WheelSample]:
    """Converter of readings whose first ``left`` joints are the left side's and the next ``right`` the right side's."""
    known: JointReading | None = None
    angle = np.full(left + right, np.nan)

    def side_means(values: FloatArray) -> FloatArray:
        numbers = values.tolist()
        return np.array([sum(numbers[:left]) / left, sum(numbers[left:]) / right])

    def convert(reading: JointReading) -> WheelSample:
        nonlocal known, angle
        if not np.isfinite(reading.position).all():
            return WheelSample(reading.stamp_ns, side_means(reading.velocity), np.full(2, np.nan))
        if known is None:
            angle = reading.position
        else:
            dt = (reading.stamp_ns - known.stamp_ns) * 1e-9
            step = reading.position - known.position
            jumped = np.abs(step) * wheel_radius_m > _FASTEST_M_PER_S * max(dt, _SHORTEST_S)
            if jumped.any():
                expected = np.nan_to_num(reading.velocity) * dt
                wrapped = np.remainder(step + math.pi, math.tau) - math.pi
                is_wrap = np.abs(wrapped - expected) < np.where(np.isfinite(reading.velocity), _WRAP_RAD, _WRAP_WITHOUT_RATE_RAD)
                if (jumped & ~is_wrap).any():
                    tally.count(topic, Oddity.WHEEL_JUMP)
                step = np.where(jumped, np.where(is_wrap, wrapped, expected), step)
            angle = angle + step
        known = reading
        return WheelSample(reading.stamp_ns, side_means(reading.velocity), side_means(angle))

    return convert


def odometry_to_wheels(driver: Driver, topic: str, tally: Tally) -> Callable[[OdometryReading], WheelSample]:
    """Converter by the driver's own geometry, inverted: q = (vx -+ wz w_s d/2)/r (Ebersole 2016, eq. 1.4-1.8).

    Angles come from the pose, of which messages that were lost take nothing away, rates from the twist. A driver that fills only
    one of the two is understood.
    """
    radius = driver.wheel_radius_m
    half_track = 0.5 * driver.wheel_separation_multiplier * driver.track_width_m
    previous: OdometryReading | None = None
    angle = np.zeros(2)
    pose_has_moved = twist_has_moved = False

    def wheels(forward: float, turn: float) -> FloatArray:
        return np.array([forward - turn * half_track, forward + turn * half_track]) / radius

    def convert(reading: OdometryReading) -> WheelSample:
        nonlocal previous, angle, pose_has_moved, twist_has_moved
        vx, _, wz = reading.twist
        twist_is_known = math.isfinite(vx) and math.isfinite(wz)
        twist_has_moved |= twist_is_known and (vx != 0.0 or wz != 0.0)
        rate = wheels(vx, wz) if twist_is_known else np.full(2, np.nan)
        if previous is not None:
            dt = (reading.stamp_ns - previous.stamp_ns) * 1e-9
            forward, turn = arc(previous.pose, reading.pose)
            from_twist = (vx * dt, wz * dt) if twist_is_known else (0.0, 0.0)
            moved = abs(forward) > _STILL_M or abs(turn) > _STILL_RAD
            longest = max(dt, _SHORTEST_S)
            if not (abs(forward) <= _FASTEST_M_PER_S * longest and abs(turn) <= _FASTEST_RAD_PER_S * longest):
                tally.count(topic, Oddity.POSE_JUMP)
                forward, turn = from_twist
            elif moved:
                pose_has_moved = True
            elif not pose_has_moved and twist_has_moved:
                if from_twist != (0.0, 0.0):
                    tally.count(topic, Oddity.NO_POSE)
                forward, turn = from_twist
            increment = wheels(forward, turn)
            if not twist_has_moved and moved and dt > 0.0:
                tally.count(topic, Oddity.NO_TWIST)
                rate = increment / dt
            angle = angle + increment
        previous = reading
        return WheelSample(reading.stamp_ns, rate, angle)

    return convert


def arc(world_T_a: FloatArray, world_T_b: FloatArray) -> tuple[float, float]:
    """Signed length [m] and angle [rad] of the circular arc from a to b; backwards is negative."""
    dx, dy = world_T_b[0] - world_T_a[0], world_T_b[1] - world_T_a[1]
    turn = math.remainder(world_T_b[2] - world_T_a[2], math.tau)
    middle = world_T_a[2] + 0.5 * turn
    chord = math.copysign(math.hypot(dx, dy), dx * math.cos(middle) + dy * math.sin(middle))
    half = 0.5 * turn
    return chord * (half / math.sin(half) if abs(half) > 1e-8 else 1.0), turn
