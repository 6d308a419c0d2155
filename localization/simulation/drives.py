"""Commands of a drive: phases, one after the other, of which two are steered by the true pose."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np

from motion_models import se2
from motion_models.se2 import FloatArray

Profile = Callable[[FloatArray], FloatArray]
"""Commands (n, 2), vx [m/s] and wz [rad/s], at times (n,) since the start of the phase [s]."""


@dataclass(frozen=True)
class Rest:
    """Stand still."""

    duration_s: float


@dataclass(frozen=True, eq=False)
class MoveArms:
    """Bring the arms to a named posture, or the nominal CG to a place, while standing."""

    target: str | FloatArray
    duration_s: float | None = None
    """None: as long as the joints take."""


@dataclass(frozen=True)
class PickUp:
    """Take a mass into the gripper; 0 puts it down."""

    mass_kg: float


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """Follow a profile open loop, as the thesis's drives did, and stop. This is a run: it is recorded under its name."""

    name: str
    profile: Profile
    duration_s: float
    controller: str = "diff_drive"
    """Motion model whose inverse makes wheel rates of the commands."""


@dataclass(frozen=True, eq=False)
class Route:
    """Drive along way points, steered by the true pose, as by a navigation stack or a person with a joystick."""

    points: FloatArray
    """(n, 2) [m]; from where the robot is to the first of them, and so on."""
    speed_m_s: float = 0.6
    name: str = ""


@dataclass(frozen=True)
class TurnTo:
    """Turn on the spot to a heading in the world [rad]."""

    heading: float


Phase = Rest | MoveArms | PickUp | OpenLoop | Route | TurnTo


def constant(vx: float, wz: float) -> Profile:
    """An arc, or a rotation in place."""
    return lambda t: np.column_stack([np.full(len(t), vx), np.full(len(t), wz)])


def sine(vx: float, wz: float, period_s: float) -> Profile:
    """An s-curve: vx, and wz sin(2 pi t / period)."""
    return lambda t: np.column_stack([np.full(len(t), vx), wz * np.sin(2.0 * math.pi * t / period_s)])


class Pursuit:
    """Pure pursuit (Coulter, 1992) of a polyline."""

    def __init__(self, start: FloatArray, route: Route, look_ahead_m: float = 0.8, turn_limit: float = 0.6) -> None:
        points = np.vstack([start[:2], route.points])
        keep = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6])
        self._points = np.ascontiguousarray(points[keep])
        lengths = np.linalg.norm(np.diff(self._points, axis=0), axis=1)
        self._along = np.concatenate([[0.0], np.cumsum(lengths)])
        self._speed, self._ahead, self._limit = route.speed_m_s, look_ahead_m, turn_limit
        self._done = 0.0

    @property
    def length(self) -> float:
        """Of the route [m]."""
        return float(self._along[-1])

    def command(self, pose: FloatArray) -> FloatArray | None:
        """vx, wz from ``pose`` (3,); None at the end."""
        if len(self._points) < 2:
            return None
        self._done, vx, wz = _pursue(pose, self._points, self._along, self._done, self._speed, self._ahead, self._limit)
        return None if math.isnan(vx) else np.array([vx, wz])


@numba.njit(cache=True)
def _pursue(
    pose: FloatArray, points: FloatArray, along: FloatArray, done: float, speed: float, ahead: float, limit: float
) -> tuple[float, float, float]:
    """Distance driven along the route, and vx and wz; NaN at its end."""
    length = along[-1]
    reach, best, here = min(1.0, length - done), math.inf, done
    for i in range(21):  # the nearest point of the route's next metre
        x, y = _point_on_route(done + reach * i / 20.0, points, along)
        off = math.hypot(x - pose[0], y - pose[1])
        if off < best:
            best, here = off, done + reach * i / 20.0
    left = length - here
    c, s = math.cos(pose[2]), math.sin(pose[2])
    past = c * (points[-1, 0] - pose[0]) + s * (points[-1, 1] - pose[1]) < 0.02
    if left < 0.05 or (left < 0.4 and past):
        return here, math.nan, math.nan
    x, y = _point_on_route(here + ahead, points, along)
    gx, gy = c * (x - pose[0]) + s * (y - pose[1]), -s * (x - pose[0]) + c * (y - pose[1])
    bearing = math.atan2(gy, gx)
    if abs(bearing) > 1.0:  # turn first
        return here, 0.0, math.copysign(limit, bearing)
    vx = min(speed, 0.15 + 0.8 * left)
    wz = 2.0 * vx * math.sin(bearing) / max(math.hypot(gx, gy), 0.2)
    if abs(wz) > limit:
        vx, wz = vx * limit / abs(wz), math.copysign(limit, wz)
    return here, vx, wz


@numba.njit(cache=True)
def _point_on_route(at: float, points: FloatArray, along: FloatArray) -> tuple[float, float]:
    """The point ``at`` [m] along the route; beyond its end it goes straight on."""
    k = 0
    while k < len(along) - 2 and along[k + 1] < at:
        k += 1
    f = (at - along[k]) / (along[k + 1] - along[k])
    return points[k, 0] + f * (points[k + 1, 0] - points[k, 0]), points[k, 1] + f * (points[k + 1, 1] - points[k, 1])


def turn_command(pose: FloatArray, heading: float, limit: float = 0.4) -> FloatArray | None:
    """vx, wz that turn the robot towards ``heading``; None where it is there."""
    error = float(se2.wrap_angle(heading - pose[2]))
    if abs(error) < 0.01:
        return None
    return np.array([0.0, max(-limit, min(limit, 1.5 * error + math.copysign(0.03, error)))])
