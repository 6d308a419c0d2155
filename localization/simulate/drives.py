"""What the robot is told to do: phases, one after the other, and the two that look where they are going."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

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
    """Follow a profile blindly, as the thesis's drives did, and stop. This is a run: it is recorded under its name."""

    name: str
    profile: Profile
    duration_s: float
    controller: str = "diff_drive"
    """Motion model whose inverse makes wheel rates of the commands."""


@dataclass(frozen=True, eq=False)
class Route:
    """Drive along way points, looking where the robot really is: what a navigation stack, or a person with a joystick, does."""

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
        self._points = points[keep]
        lengths = np.linalg.norm(np.diff(self._points, axis=0), axis=1)
        self._along = np.concatenate([[0.0], np.cumsum(lengths)])
        self._speed, self._ahead, self._limit = route.speed_m_s, look_ahead_m, turn_limit
        self._done = 0.0

    @property
    def length(self) -> float:
        """Of the way [m]."""
        return float(self._along[-1])

    def command(self, pose: FloatArray) -> FloatArray | None:
        """vx, wz from ``pose`` (3,); None at the end."""
        span = np.linspace(self._done, min(self._done + 1.0, self.length), 21)
        off = np.hypot(*(self._at(span) - pose[:2]).T)
        self._done = float(span[int(np.argmin(off))])
        left = self.length - self._done
        if left < 0.05 or (left < 0.4 and se2.transform(se2.inverse(pose), self._points[-1])[0] < 0.02):
            return None
        goal = se2.transform(se2.inverse(pose), self._at(np.array([self._done + self._ahead]))[0])
        bearing = math.atan2(goal[1], goal[0])
        if abs(bearing) > 1.0:  # turn first
            return np.array([0.0, math.copysign(self._limit, bearing)])
        speed = min(self._speed, 0.15 + 0.8 * left)
        wz = 2.0 * speed * math.sin(bearing) / max(math.hypot(*goal), 0.2)
        if abs(wz) > self._limit:
            speed, wz = speed * self._limit / abs(wz), math.copysign(self._limit, wz)
        return np.array([speed, wz])

    def _at(self, along: FloatArray) -> FloatArray:
        """(n, 2) points of the way; beyond its end it goes straight on."""
        x, y = (np.interp(along, self._along, self._points[:, k]) for k in range(2))
        over = np.maximum(along - self.length, 0.0)[:, None]
        last = self._points[-1] - self._points[-2]
        return np.column_stack([x, y]) + over * last / np.linalg.norm(last)


def turning(pose: FloatArray, heading: float, limit: float = 0.4) -> FloatArray | None:
    """vx, wz that turn the robot towards ``heading``; None where it is there."""
    error = float(se2.wrap_angle(heading - pose[2]))
    if abs(error) < 0.01:
        return None
    return np.array([0.0, max(-limit, min(limit, 1.5 * error + math.copysign(0.03, error)))])
