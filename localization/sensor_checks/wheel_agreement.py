"""Do the motions by the wheels and by the estimate agree, since when not, and by how much?

Moments are pairs of poses (2, 3): by the wheels with the gyro's turns, and by the estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from motion_models import se2
from motion_models.compiled import kernel
from motion_models.se2 import FloatArray, Pose2, Tangent2, triple

_MAX_WAY_M, _MAX_TURN_RAD = 0.6, 0.6
"""Largest motion since a view that is compared: farther away, surfaces are hidden by others [m, rad]."""
_MAX_SLIP_M, _MAX_TURN_SLIP_RAD = 0.15, 0.2
"""Distance of the estimate from the motion by the wheels since that view, up to which the wheels slip as they do without moving objects
[m, rad]: a way of .6 m, along which fr079's robot slides by up to 14 deg."""
_STILL_M, _SLIP_SHARE, _SLIP_M_PER_RAD = 0.03, 0.25, 0.1
"""Distance from the motion by the wheels up to which they slip as usual on short ways: noise of two scans [m], share of the way, and of
turns, in which the centre of rotation is elsewhere by 10 cm [m/rad]."""
CALM_S = 1.0
"""Time without moving objects after which all beams are matched again [s]."""
_CALM_M, _CALM_M_PER_RAD = 0.3, 0.4
"""Distance of the wheels' pose from where wheels and estimate last disagreed, and what the turn since then adds to it [m/rad], from which
on what they differed by is slip that has ended [m]: a LiDAR that travels elsewhere by its scans agrees with wheels that stand, turn in
place, or drive tight curves, in which ways are compared over .6 rad at most."""


def difference(since: FloatArray, now: FloatArray) -> Tangent2:
    """(3,) of the motion by the wheels from that by the estimate, between the moments ``since`` and ``now`` (2, 3)."""
    by_wheels, by_estimate = se2.between(since, now)
    return se2.local(by_estimate, by_wheels)


def agree(since: FloatArray, now: FloatArray) -> bool:
    """Whether wheels and estimate have moved alike between two moments (2, 3), but for slip."""
    off, (x, y, yaw) = difference(since, now), se2.between(since[0], now[0]).tolist()
    slip = min(_MAX_SLIP_M, _STILL_M + _SLIP_SHARE * math.hypot(x, y) + _SLIP_M_PER_RAD * abs(yaw))
    return bool(math.hypot(off[0], off[1]) < slip and abs(off[2]) < _MAX_TURN_SLIP_RAD)


@kernel
def compare_motions(since: FloatArray, now: FloatArray) -> tuple[bool, float]:
    """Whether a scan at the moment ``now`` is compared with one at ``since`` (2, 3), for both are near; and the distance of the motion by
    the estimate from that by the wheels [m]."""
    by_wheels = se2.scalar_between(triple(since[0]), triple(now[0]))
    by_estimate = se2.scalar_between(triple(since[1]), triple(now[1]))
    off = se2.scalar_log(se2.scalar_between(by_estimate, by_wheels))
    way = max(math.hypot(by_wheels[0], by_wheels[1]), math.hypot(by_estimate[0], by_estimate[1]))
    turn = max(abs(by_wheels[2]), abs(by_estimate[2]))
    return way < _MAX_WAY_M and turn < _MAX_TURN_RAD, math.hypot(off[0], off[1])


@dataclass(frozen=True, eq=False)
class Suspicion:
    """Objects may move in the scans, or the wheels slip."""

    begin: FloatArray
    """(2, 3) moment before the first sign of it."""
    last_s: float
    """Time of the last sign [s]."""
    place: Pose2
    """(3,) by the wheels at the last sign."""

    def add_sign(self, now_s: float, now: FloatArray) -> Suspicion:
        """With another sign at ``now_s`` [s] and the moment ``now`` (2, 3)."""
        return replace(self, last_s=now_s, place=now[0])

    def is_over(self, now_s: float, now: FloatArray) -> bool:
        """Whether the robot has driven on for some time without a sign."""
        x, y, yaw = se2.between(self.place, now[0]).tolist()
        return now_s - self.last_s >= CALM_S and math.hypot(x, y) >= _CALM_M + _CALM_M_PER_RAD * abs(yaw)


@dataclass(frozen=True, eq=False)
class Departure:
    """Where the estimate may have left the motion by the wheels while objects move."""

    since: FloatArray
    """(2, 3) moment at which both last agreed."""
    is_led_away: bool
    """Scans have led the estimate away from where the wheels lead."""
    is_apart: bool = False
    """Both have been apart by more than wheels slip since then."""

    def remainder(self, now: FloatArray) -> Tangent2 | None:
        """(3,) what the estimate is off by, and stays so; None where it is no more than wheels slip."""
        return difference(self.since, now) if self.is_apart or not agree(self.since, now) else None


class Jump:
    """`add` each moment: a robot that was carried, or whose LiDAR was turned, is elsewhere at once by the estimate."""

    def __init__(self) -> None:
        self._last = np.zeros((2, 3))
        self.begin: FloatArray | None = None
        """(2, 3) moment before the estimate went elsewhere; None where it did not, or the robot was carried."""

    def add(self, now: FloatArray, *, is_off: bool, is_unclear: bool) -> None:
        """Add the moment ``now`` (2, 3), at which the estimate ``is_off`` the motion by the wheels.

        A robot that has driven on by the wheels was carried, unless it ``is_unclear`` whether objects move.
        """
        before, self._last = self._last, now
        if self.begin is None:
            self.begin = before if is_off and not compare_motions(before, now)[0] else None
        elif not is_unclear:
            x, y, yaw = se2.between(self.begin[0], now[0])
            if math.hypot(x, y) >= _MAX_WAY_M or abs(yaw) >= _MAX_TURN_RAD:
                self.begin = None
