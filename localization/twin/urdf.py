"""A URDF as MJCF, by MuJoCo's own reader: links, joints, masses and collision shapes; what a URDF has of contacts and motors is Gazebo's.

MuJoCo welds the root of a URDF to the world. A link without mass and a floating joint before it let the robot move.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from localization.errors import SimulationError
from localization.twin.mjcf import Mjcf, parse
from localization.twin.mujoco_engine import converted
from localization.twin.robot_mjcf import HALF_WIDTH
from motion_models.center_of_gravity.urdf import load_urdf, urdf_root
from motion_models.input_files import read_bytes, read_text
from motion_models.robot import Robot

_WORLD = "skidloc_world"
_QUARTER = 0.5 * math.pi


def mjcf_of_urdf(path: Path, robot: Robot) -> tuple[Mjcf, tuple[str, ...]]:
    """MJCF of the URDF at ``path``, and what of it is not in it. Raises `SimulationError`, and `RobotError` for what is no URDF.

    Joints that are no wheels are fixed at zero: the log's centre of gravity takes the place of the arms' postures.
    """
    root_link = load_urdf(path).root
    root = urdf_root(read_text(path), str(path))
    notes = []
    meshes = 0
    for link in root.iter("link"):
        for shape in link.findall("visual"):
            link.remove(shape)
        for shape in [c for c in link.findall("collision") if c.find("geometry/mesh") is not None]:
            link.remove(shape)
            meshes += 1
    added = _turn_wheels_alone(root, robot)
    if added:
        notes.append(f"{path.name}: {', '.join(added)} have no shape to touch with; they got cylinders of the robot file's radius.")
    if meshes:
        notes.append(f"{path.name}: {meshes} collision meshes are left out, only boxes, cylinders and spheres touch.")
    dropped = sorted({child.tag for child in root if child.tag in ("gazebo", "transmission", "ros2_control")})
    if dropped:
        notes.append(f"{path.name}: <{'>, <'.join(dropped)}> are not converted: contacts are MuJoCo's defaults, servos are added.")
    for element in [child for child in root if child.tag in ("gazebo", "transmission", "ros2_control", "mujoco")]:
        root.remove(element)
    extension = ET.SubElement(root, "mujoco")
    ET.SubElement(extension, "compiler", balanceinertia="true", boundmass="1e-4", boundinertia="1e-6")
    ET.SubElement(root, "link", name=_WORLD)
    joint = ET.SubElement(root, "joint", name="skidloc_free", type="floating")
    ET.SubElement(joint, "parent", link=_WORLD)
    ET.SubElement(joint, "child", link=root_link)
    text = converted(ET.tostring(root, encoding="unicode"), path)
    name = f"{path.stem}.xml"
    return parse({name: text.encode()}, path.with_name(name)), tuple(notes)


def _turn_wheels_alone(root: ET.Element, robot: Robot) -> list[str]:
    """Fix all joints but the wheels', which get a cylinder where they have no shape; returns those that did."""
    links = {link.get("name"): link for link in root.iter("link")}
    radius, added = robot.geometry.wheel_radius_m, []
    for joint in root.findall("joint"):
        name, child = joint.get("name", ""), joint.find("child")
        if joint.get("type") != "continuous" and name not in (*robot.joints.left, *robot.joints.right):
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
            continue
        link = links.get(child.get("link")) if child is not None else None
        if link is None or link.find("collision") is not None:
            continue
        axis = joint.find("axis")
        x, y, _ = (float(v) for v in (axis.get("xyz", "1 0 0") if axis is not None else "1 0 0").split())
        collision = ET.SubElement(link, "collision")
        ET.SubElement(collision, "origin", xyz="0 0 0", rpy=f"{_QUARTER if abs(y) > 0.5 else 0.0} {_QUARTER if abs(x) > 0.5 else 0.0} 0")
        geometry = ET.SubElement(collision, "geometry")
        ET.SubElement(geometry, "cylinder", radius=f"{radius:g}", length=f"{2.0 * HALF_WIDTH * radius:g}")
        added.append(name)
    return added


def is_urdf(path: Path) -> bool:
    """Whether the file's root is <robot>."""
    try:
        return ET.fromstring(read_bytes(path)).tag == "robot"
    except ET.ParseError:
        return path.suffix.lower() == ".urdf"
    except OSError as error:
        raise SimulationError(f"simulator '{path}' cannot be read: {error.strerror}.") from error
