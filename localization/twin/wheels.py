"""The wheels of a simulated robot: which joints drive, on which side, and where the body frame is between them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from localization.errors import SimulationError
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_WHEEL = re.compile(r"wheel|tire|tyre|whl", re.IGNORECASE)
_PASSIVE = re.compile(r"caster|castor|swivel|steer(?!.*skid)", re.IGNORECASE)
_LEFT = re.compile(r"left|(^|[_\-/])(l|fl|rl|bl|ml|lf|lr|lb|lm)([_\-/]|$)", re.IGNORECASE)
_RIGHT = re.compile(r"right|(^|[_\-/])(r|fr|rr|br|mr|rf|rb|rm)([_\-/]|$)", re.IGNORECASE)
_ALONG = 0.9
"""Component of a unit axis from which it lies along another: cambered wheels count."""
_GROUND_M = 0.03
"""Height above the robot's lowest point up to which the lowest point of a body is on the ground [m]."""


@dataclass(frozen=True)
class Hinge:
    """A joint that turns, in the frame of the body that moves freely."""

    index: int
    name: str
    position: FloatArray
    """(3,) [m]"""
    axis: FloatArray
    """(3,)"""
    lowest_m: float
    """Height of the lowest point of what it turns."""
    is_limited: bool
    has_children: bool
    """Whether another joint moves behind it."""


@dataclass(frozen=True)
class Wheels:
    """Wheels by index of `Hinge`, and the body frame."""

    left: tuple[int, ...]
    right: tuple[int, ...]
    signs: FloatArray
    """(n,) +1 where a positive rate drives ahead, left wheels first."""
    origin: FloatArray
    """(2,) middle of the wheels in the frame of the free body [m]."""
    forward: FloatArray
    """(2,) unit vector ahead in that frame."""
    track_m: float
    wheelbase_m: float


def find_wheels(hinges: Sequence[Hinge], robot: Robot, file: str) -> Wheels:
    """Wheels among ``hinges``: by the robot file's names, by their own, or by what they are. Raises `SimulationError`."""
    chosen = _by_names(hinges, robot) or [h for h in hinges if _WHEEL.search(h.name) and not _PASSIVE.search(h.name)] or _by_shape(hinges)
    if len(chosen) < 2:
        names = ", ".join(h.name or "(without a name)" for h in hinges) or "none"
        raise SimulationError(
            f"simulator '{file}': no wheels found. Joints that turn on the robot: {names}. Name them as in [joints] of the robot file:"
            f" {', '.join((*robot.joints.left, *robot.joints.right))}."
        )
    positions = np.array([h.position for h in chosen])
    lateral = _lateral(chosen, positions, file)
    forward = np.array([lateral[1], -lateral[0]])
    across = positions[:, :2] @ lateral
    middle = 0.5 * (across.max() + across.min())
    left = [h for h, y in zip(chosen, across, strict=True) if y > middle]
    right = [h for h, y in zip(chosen, across, strict=True) if y <= middle]
    if not left or not right:
        raise SimulationError(f"simulator '{file}': all of the wheels {', '.join(h.name for h in chosen)} are on one side of the robot.")
    along = positions[:, :2] @ forward
    ahead = 0.5 * (along.max() + along.min())
    signs = np.array([1.0 if h.axis[:2] @ lateral > 0.0 else -1.0 for h in (*left, *right)])
    track = float(np.mean([h.position[:2] @ lateral for h in left]) - np.mean([h.position[:2] @ lateral for h in right]))
    return Wheels(
        tuple(h.index for h in left),
        tuple(h.index for h in right),
        signs,
        ahead * forward + middle * lateral,
        forward,
        track,
        float(along.max() - along.min()),
    )


def _by_names(hinges: Sequence[Hinge], robot: Robot) -> list[Hinge]:
    wanted = {_plain(name) for name in (*robot.joints.left, *robot.joints.right)}
    found = [h for h in hinges if _plain(h.name) in wanted]
    return found if len(found) >= 2 else []


def _plain(name: str) -> str:
    """Name without namespace and the word joint."""
    return re.sub(r"_?joint_?", "", name.rsplit("/", 1)[-1].lower())


def _by_shape(hinges: Sequence[Hinge]) -> list[Hinge]:
    """Hinges without limits about level axes whose bodies touch the ground."""
    free = [h for h in hinges if not h.is_limited and not h.has_children and abs(h.axis[2]) < 1.0 - _ALONG]
    lowest = min((h.lowest_m for h in free), default=0.0)
    return [h for h in free if h.lowest_m < lowest + _GROUND_M]


def _lateral(wheels: Sequence[Hinge], positions: FloatArray, file: str) -> FloatArray:
    """(2,) unit vector to the left: along the wheels' axes, to the side of wheels that are called left, else of +y or -x."""
    axis = wheels[0].axis[:2] / max(float(np.linalg.norm(wheels[0].axis[:2])), 1e-9)
    tilted = [h.name for h in wheels if abs(h.axis[:2] @ axis) < _ALONG]
    if tilted or abs(wheels[0].axis[2]) > 1.0 - _ALONG:
        raise SimulationError(
            f"simulator '{file}': the axes of the wheels are not parallel and level: {', '.join(tilted) or wheels[0].name}."
        )
    left = [p for h, p in zip(wheels, positions, strict=True) if _LEFT.search(h.name) and not _RIGHT.search(h.name)]
    right = [p for h, p in zip(wheels, positions, strict=True) if _RIGHT.search(h.name) and not _LEFT.search(h.name)]
    if left and right:
        across = (np.mean(left, axis=0) - np.mean(right, axis=0))[:2] @ axis
    else:
        across = axis[1] if abs(axis[1]) > abs(axis[0]) else -axis[0]
    return np.asarray(axis * (1.0 if across > 0.0 else -1.0))
