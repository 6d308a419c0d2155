"""Wheels of a URDF: which joints drive, their radius, and the distances between their contacts."""

from __future__ import annotations

import math
import re
import statistics
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from motion_models.center_of_gravity.urdf import Joint, Urdf, parse_urdf
from motion_models.errors import RobotError
from motion_models.se2 import FloatArray

_WHEEL = re.compile(r"wheel|tire|tyre", re.IGNORECASE)
_PASSIVE = re.compile(r"caster|castor|swivel|steer", re.IGNORECASE)
_LEFT = re.compile(r"left|(^|[_\-/])(l|fl|rl|bl|ml|lf|lr|lb)([_\-/]|$)", re.IGNORECASE)
_RIGHT = re.compile(r"right|(^|[_\-/])(r|fr|rr|br|mr|rf|rb)([_\-/]|$)", re.IGNORECASE)
_SAME_M = 0.02
"""Wheels whose x differs by less stand on one axle [m]."""


@dataclass(frozen=True)
class WheelGeometry:
    """What a URDF has of its wheels; NaN for what it does not have."""

    left: tuple[str, ...]
    """Joints of the left wheels."""
    right: tuple[str, ...]
    wheel_radius_m: float
    track_width_m: float
    wheelbase_m: float
    mass_kg: float
    """Of all links."""
    positions: Mapping[str, tuple[float, float]]
    """x, y of each wheel's joint in the body frame [m]."""


def sides(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the left and right wheels among joint ``names``, by their spelling. Either may be empty.

    >>> sides(["front_left_wheel", "rear_right_wheel", "arm_joint", "wheel_FL_joint"])
    (('front_left_wheel', 'wheel_FL_joint'), ('rear_right_wheel',))
    """
    wheels = [name for name in names if _WHEEL.search(name) and not _PASSIVE.search(name)]
    left = tuple(name for name in wheels if _LEFT.search(name) and not re.search("right", name, re.IGNORECASE))
    return left, tuple(name for name in wheels if name not in left and _RIGHT.search(name))


def wheel_geometry(text: str, source: str, base_link: str = "base_link") -> WheelGeometry:
    """Wheels of a URDF ``text``; ``source`` names it in errors. Contacts are taken below the wheels' shapes, or their joints.

    Raises `RobotError` for a text that is no URDF, a missing ``base_link``, and for one without wheels on both sides.
    """
    urdf = parse_urdf(text, source)
    if base_link not in urdf.links:
        raise RobotError(f"{source}: no link '{base_link}'; links are {', '.join(urdf.links)}. Name the body's with --base-link.")
    shapes = _shapes(ET.fromstring(text.encode()))
    poses = _poses(urdf)
    base_R, base_t = poses[base_link]
    wheels: dict[str, tuple[float, float]] = {}
    radii = []
    for joint in _wheel_joints(urdf):
        rotation, translation = poses[joint.child]
        radius, center = shapes.get(joint.child, (math.nan, np.zeros(3)))
        x, y, _ = base_R.T @ (translation + rotation @ center - base_t)
        wheels[joint.name] = (float(x), float(y))
        radii.append(radius)
    left = tuple(name for name, (_, y) in wheels.items() if y > 0.0)
    right = tuple(name for name, (_, y) in wheels.items() if y < 0.0)
    if not left or not right:
        found = ", ".join(wheels) or "none"
        raise RobotError(f"{source}: no driven wheels on both sides (continuous joints with 'wheel' in their names: {found}).")
    across = statistics.mean(wheels[name][1] for name in left) - statistics.mean(wheels[name][1] for name in right)
    along = max(x for x, _ in wheels.values()) - min(x for x, _ in wheels.values())
    finite = [radius for radius in radii if math.isfinite(radius)]
    return WheelGeometry(
        left=left,
        right=right,
        wheel_radius_m=statistics.median(finite) if finite else math.nan,
        track_width_m=across,
        wheelbase_m=along if along > _SAME_M else math.nan,
        mass_kg=sum(link.mass for link in urdf.links.values()) or math.nan,
        positions=wheels,
    )


def _wheel_joints(urdf: Urdf) -> list[Joint]:
    return [
        joint
        for joint in urdf.joints
        if joint.kind == "continuous" and _WHEEL.search(joint.name + joint.child) and not _PASSIVE.search(joint.name + joint.child)
    ]


def link_poses(urdf: Urdf, base_link: str = "base_link") -> dict[str, tuple[FloatArray, FloatArray]]:
    """Rotation (3, 3) and translation (3,) of each link in ``base_link``, all joints at 0."""
    poses = _poses(urdf)
    base_R, base_t = poses[base_link]
    return {name: (base_R.T @ rotation, base_R.T @ (translation - base_t)) for name, (rotation, translation) in poses.items()}


def _poses(urdf: Urdf) -> dict[str, tuple[FloatArray, FloatArray]]:
    """The same in the root's frame."""
    poses: dict[str, tuple[FloatArray, FloatArray]] = {urdf.root: (np.eye(3), np.zeros(3))}
    for joint in urdf.joints:
        rotation, translation = poses[joint.parent]
        poses[joint.child] = rotation @ joint.rotation, translation + rotation @ joint.translation
    return poses


def _shapes(root: ET.Element) -> dict[str, tuple[float, FloatArray]]:
    """Largest radius [m] of the cylinders or spheres of each link, and their centre (3,) in the link's frame."""
    found: dict[str, tuple[float, FloatArray]] = {}
    for link in root.findall("link"):
        for shape in (*link.findall("collision"), *link.findall("visual")):
            round_shape = shape.find("geometry/cylinder")
            round_shape = shape.find("geometry/sphere") if round_shape is None else round_shape
            if round_shape is None:
                continue
            origin = shape.find("origin")
            xyz = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
            radius = float(round_shape.get("radius", "nan"))
            name = link.get("name", "")
            if radius > found.get(name, (0.0, None))[0]:
                found[name] = radius, np.array([float(word) for word in xyz.split()])
    return found
