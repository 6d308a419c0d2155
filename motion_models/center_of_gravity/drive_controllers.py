"""What drive controllers and simulator plugins have of a robot: track, radius, multiplier, joints, and the kind of drive by its names."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

_LEFT_KEYS = ("left_wheel_names", "left_wheel", "left_joint", "leftjoint", "leftfrontjoint", "leftrearjoint")
_RIGHT_KEYS = ("right_wheel_names", "right_wheel", "right_joint", "rightjoint", "rightfrontjoint", "rightrearjoint")
"""Keys of controllers and plugins (lower case) that name the wheels' joints."""
MECANUM, OMNI, TRACKS, STEERED, CASTERS = "mecanum wheels", "omnidirectional wheels", "tracks", "steered wheels", "casters"
_KINDS = {
    MECANUM: re.compile(r"mecanum", re.IGNORECASE),
    OMNI: re.compile(r"omni.*(wheel|roller|drive|direction)|(wheel|roller).*omni|swerve|planar_move", re.IGNORECASE),
    TRACKS: re.compile(
        r"(^|[_\-/])(l|r|left|right)_?(track|crawler|tread|belt)s?([_\-/.]|$)|(^|[_\-/])(track|crawler|tread|belt)s?_?(l|r|left|right)([_\-/.]|$)"
        r"|track(ed_?vehicle|_?controller)|sprocket",
        re.IGNORECASE,
    ),
    STEERED: re.compile(r"(?<!skid)(?<!skid[_\-])steer|ackermann|tricycle", re.IGNORECASE),
    CASTERS: re.compile(r"(?:(?<![A-Za-z])|(?<=[a-z0-9])(?=[A-Z]))(?i:cast[eo]r)"),  # a word: joint_state_broadcaster has none
}


@dataclass(frozen=True)
class ControllerValues:
    """What the parameters of one drive controller or simulator plugin contain; NaN and empty for what they do not."""

    source: str
    track_width_m: float = math.nan
    wheel_radius_m: float = math.nan
    wheel_separation_multiplier: float = math.nan
    left: tuple[str, ...] = ()
    right: tuple[str, ...] = ()


def drive_kinds(names: Iterable[str]) -> tuple[str, ...]:
    """Kinds of wheels and tracks by the ``names`` of links, joints, meshes, plugins or controllers.

    >>> drive_kinds(["front_left_wheel", "mecanum_drive_controller/MecanumDriveController", "skid_steer_drive", "joint_state_broadcaster"])
    ('mecanum wheels',)
    >>> drive_kinds(["rearCaster_joint"])
    ('casters',)
    """
    names = tuple(names)
    return tuple(kind for kind, pattern in _KINDS.items() if any(pattern.search(name) for name in names))


def urdf_controllers(root: ET.Element) -> tuple[ControllerValues, ...]:
    """Values of <plugin>s (Gazebo's of ROS 1, ROS 2 and gz) and <ros2_control> that have a track or a radius."""
    found = []
    for element in (*root.iter("plugin"), *root.iter("ros2_control")):
        values = {(e.get("name", "") if e.tag == "param" else e.tag): (e.text or "").strip() for e in element.iter()}
        where = f"<{element.tag}> {element.get('name', '')}".strip()
        lists = {key: [e.text or "" for e in element.iter() if e.tag.lower() == key] for key in (*_LEFT_KEYS, *_RIGHT_KEYS)}
        controller = controller_values({**values, **{key: names for key, names in lists.items() if names}}, where)
        if controller is not None:
            found.append(controller)
    return tuple(found)


def velocity_joints(root: ET.Element) -> frozenset[str]:
    """Joints that <ros2_control> commands by velocity."""
    return frozenset(
        joint.get("name", "")
        for joint in root.findall("ros2_control/joint")
        if any(command.get("name") == "velocity" for command in joint.findall("command_interface"))
    )


def controller_values(values: Mapping[str, object], source: str) -> ControllerValues | None:
    """Track, radius, multiplier and joints among the parameters ``values`` of a controller or plugin; None where it has none of them.

    Names: diff_drive_controller (ROS 1 and 2), libgazebo_ros_diff_drive, _skid_steer_drive, gz::sim::systems::DiffDrive.
    """
    by_key = {key.lower(): value for key, value in values.items()}

    def number(*keys: str, scale: float = 1.0) -> float:
        for key in keys:
            try:
                value = float(str(by_key[key])) * scale
            except (KeyError, ValueError):
                continue
            if math.isfinite(value) and value > 0.0:
                return value
        return math.nan

    def joints(keys: Sequence[str]) -> tuple[str, ...]:
        names: list[str] = []
        for key in keys:
            value = by_key.get(key, ())
            names += [str(v) for v in value] if isinstance(value, list | tuple) else re.split(r"[\s,]+", str(value))
        return tuple(dict.fromkeys(name.strip() for name in names if name.strip()))

    radius = number("wheel_radius", "wheelradius")
    diameter = number("wheel_diameter", "wheeldiameter", scale=0.5)
    found = ControllerValues(
        source,
        number("wheel_separation", "wheelseparation", "track_width", "trackwidth", "tracks_separation"),
        radius if math.isfinite(radius) else diameter,
        number("wheel_separation_multiplier"),
        joints(_LEFT_KEYS),
        joints(_RIGHT_KEYS),
    )
    has_any = math.isfinite(found.track_width_m) or math.isfinite(found.wheel_radius_m)
    return found if has_any else None
