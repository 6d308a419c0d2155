"""URDFs: links with mass and centre of mass, and the joints between them.

Read with the standard library: of a URDF's content only names, origins, axes, limits, mimics and masses matter here, and the readers
that there are bring mesh loaders with them. Format: http://wiki.ros.org/urdf/XML. Errors are `RobotError`s that name file and element.
"""

from __future__ import annotations

import dataclasses
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from motion_models.errors import RobotError
from motion_models.input_files import read_text
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

_WORLDS = ("world", "map", "odom")
_MOVING = ("revolute", "continuous", "prismatic")
_OPTENV = re.compile(r"\$\(optenv \S+ ([^$()]*)\)")
_XACRO = "it is a xacro file, not a URDF; expand it first: xacro FILE.xacro > FILE.urdf"


@dataclass(frozen=True)
class Link:
    """A link with its mass and centre of mass."""

    name: str
    mass: float
    """[kg]; 0 where the link has no <inertial>."""
    com: FloatArray
    """(3,) centre of mass in the link's frame [m]."""


@dataclass(frozen=True)
class Mimic:
    """position = multiplier * position of ``joint`` + offset"""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A joint between two links."""

    name: str
    kind: str
    """fixed, revolute, continuous or prismatic."""
    parent: str
    child: str
    rotation: FloatArray
    """(3, 3) takes vectors of the child's frame, at position 0, into the parent's frame."""
    translation: FloatArray
    """(3,) origin of the child's frame in the parent's frame [m]."""
    axis: FloatArray
    """(3,) unit vector in the child's frame."""
    lower: float
    """Least position [rad or m]; -inf where there is none."""
    upper: float
    """Greatest position [rad or m]; inf where there is none."""
    mimic: Mimic | None

    @property
    def moves(self) -> bool:
        """Whether the joint can move."""
        return self.kind != "fixed"


@dataclass(frozen=True)
class Urdf:
    """A tree of links. ``joints`` are ordered depth first: every parent comes before its children, and an arm stays together."""

    source: str
    root: str
    links: Mapping[str, Link]
    joints: tuple[Joint, ...] = field(default_factory=tuple)

    def with_mass(self, link: str, mass: float, position: FloatArray) -> Urdf:
        """This tree with one more ``mass`` [kg] fixed at ``position`` (3,) [m] of ``link``. Raises `RobotError` for an unknown link."""
        if link not in self.links:
            raise RobotError(f"{self.source}: no link '{link}'; links are {', '.join(self.links)}.")
        old = self.links[link]
        total = old.mass + mass
        com = (old.mass * old.com + mass * np.asarray(position, dtype=float)) / total if total > 0.0 else old.com
        return dataclasses.replace(self, links={**self.links, link: Link(link, total, com)})


def load_urdf(path: str | Path) -> Urdf:
    """The URDF of a file. Raises `RobotError`."""
    return parse_urdf(read_urdf(Path(path)), source=str(path))


def read_urdf(path: Path) -> str:
    """Text of a URDF. Raises `RobotError`."""
    if path.suffix == ".xacro":
        raise RobotError(f"'{path}' cannot be used: {_XACRO}.")
    try:
        return read_text(path)
    except OSError as error:
        raise RobotError(f"URDF '{path}' cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise RobotError(f"URDF '{path}' is not text (byte {error.start} is not UTF-8).") from error


def urdf_root(text: str, source: str) -> ET.Element:
    """<robot> of an XML text. Of $(optenv NAME DEFAULT), which xacro may leave, the default counts. Raises `RobotError`."""
    try:
        # ElementTree takes bytes where the XML declares an encoding; a file may start with a mark of its byte order.
        root = ET.fromstring(_OPTENV.sub(r"\1", text).lstrip("\ufeff \t\r\n").encode())
    except ET.ParseError as error:
        # An old xacro file may not declare its namespace, which is an error of XML already.
        is_none = "<" not in text
        what = "no URDF, which begins with <robot>" if is_none else _XACRO if "<xacro:" in text else f"not valid XML: {error}"
        raise RobotError(f"{source}: {what}{' (init takes a controller YAML as --controller)' if is_none else ''}.") from error
    if root.tag != "robot":
        raise RobotError(f"{source}: the outermost element is <{root.tag}>; a URDF has <robot>.")
    if any("xacro}" in e.tag for e in root.iter()):
        raise RobotError(f"{source}: {_XACRO}.")
    # Meshes and plugins are not read: what is left of xacro in them does not matter.
    unread = {id(e) for kind in ("mesh", "texture", "plugin", "gazebo") for top in root.iter(kind) for e in top.iter()}
    read = (e for e in root.iter() if id(e) not in unread)
    left = next((v for e in read for v in e.attrib.values() if "${" in v or "$(" in v), None)
    if left is not None:
        raise RobotError(f"{source}: {_XACRO} ('{left}' is in it).")
    return root


def parse_urdf(text: str, source: str) -> Urdf:
    """The URDF of an XML text; ``source`` names it in errors. Raises `RobotError`."""
    root = urdf_root(text, source)
    links: dict[str, Link] = {}
    for element in root.findall("link"):
        link = _link(element, source)
        if link.name in links:
            raise RobotError(f"{source}: two links are called '{link.name}'.")
        links[link.name] = link
    if not links:
        raise RobotError(f"{source}: no <link> in it.")
    joints = [_joint(element, source, links) for element in root.findall("joint")]
    return Urdf(source, *_tree(links, joints, source))


def _tree(links: dict[str, Link], joints: list[Joint], source: str) -> tuple[str, dict[str, Link], tuple[Joint, ...]]:
    """Root, links, and joints with parents first; refuses what is not one tree, and mimics that lead nowhere."""
    by_name: dict[str, Joint] = {}
    by_child: dict[str, Joint] = {}
    for joint in joints:
        if joint.name in by_name:
            raise RobotError(f"{source}: two joints are called '{joint.name}'.")
        if joint.child in by_child:
            raise RobotError(f"{source}: link '{joint.child}' has two parents: joints '{by_child[joint.child].name}' and '{joint.name}'.")
        by_name[joint.name] = by_child[joint.child] = joint
    roots = [name for name in links if name not in by_child]
    if len(roots) > 1:
        raise RobotError(f"{source}: links {', '.join(roots)} hang on no joint; only one link, the root, may.")

    children: dict[str, list[Joint]] = {name: [] for name in links}
    for joint in joints:
        children[joint.parent].append(joint)
    order: list[Joint] = []
    stack = [joint for name in roots for joint in reversed(children[name])]
    while stack:
        order.append(stack.pop())
        stack += reversed(children[order[-1].child])
    if len(order) < len(joints):
        loop = sorted(set(by_name) - {joint.name for joint in order})
        raise RobotError(f"{source}: joints {', '.join(loop)} form a loop; a URDF is a tree.")

    for joint in joints:
        visited, follower = {joint.name}, joint
        while follower.mimic is not None:
            if follower.mimic.joint not in by_name or not by_name[follower.mimic.joint].moves:
                raise RobotError(f"{source}: joint '{follower.name}' mimics '{follower.mimic.joint}', which is not a moving joint of it.")
            follower = by_name[follower.mimic.joint]
            if follower.name in visited:
                raise RobotError(f"{source}: joint '{joint.name}' mimics itself, by way of '{follower.name}'.")
            visited.add(follower.name)
    return roots[0], links, tuple(order)


def _link(element: ET.Element, source: str) -> Link:
    name = _name(element, source)
    inertial = element.find("inertial")
    if inertial is None:
        return Link(name, 0.0, np.zeros(3))
    where = f"{source}: <inertial> of link '{name}'"
    mass_element = inertial.find("mass")
    if mass_element is None:
        raise RobotError(f"{where} has no <mass>.")
    mass = _numbers(mass_element, "value", 1, None, where)[0]
    if mass < 0.0:
        raise RobotError(f"{where}: mass is {mass} kg; it cannot be negative.")
    return Link(name, mass, _origin(inertial, where)[1])


def _joint(element: ET.Element, source: str, links: Mapping[str, Link]) -> Joint:
    name, kind = _name(element, source), element.get("type", "")
    where = f"{source}: joint '{name}'"
    if kind not in (*_MOVING, "fixed"):
        raise RobotError(f"{where} is of type '{kind}'; the types that are known here are fixed, {', '.join(_MOVING)}.")
    ends: list[str] = []
    for end in ("parent", "child"):
        reference = element.find(end)
        link = "" if reference is None else reference.get("link", "")
        if link not in links:
            raise RobotError(f"{where}: its {end} is {f'link {link!r}, which is not there' if link else 'not given'}.")
        ends.append(link)
    rotation, translation = _origin(element, where)

    axis = np.array([1.0, 0.0, 0.0])
    given = element.find("axis")
    if given is not None and kind != "fixed":
        axis = np.array(_numbers(given, "xyz", 3, "1 0 0", where))
        if np.linalg.norm(axis) < 1e-9:
            raise RobotError(f"{where}: its axis has no length.")
        axis /= np.linalg.norm(axis)

    lower, upper = -math.inf, math.inf
    limit = element.find("limit")
    if limit is not None and kind in ("revolute", "prismatic"):
        # The format's default of a missing bound is 0; a limit with neither bound is of effort and velocity only.
        if "lower" in limit.attrib or "upper" in limit.attrib:
            lower, upper = (_numbers(limit, bound, 1, "0", where)[0] for bound in ("lower", "upper"))
        if lower > upper:
            raise RobotError(f"{where}: its lower limit {lower} is above the upper {upper}.")

    mimic = None
    follows = element.find("mimic")
    if follows is not None and kind != "fixed":
        multiplier, offset = (_numbers(follows, key, 1, default, where)[0] for key, default in (("multiplier", "1"), ("offset", "0")))
        mimic = Mimic(follows.get("joint", ""), multiplier, offset)
    return Joint(name, kind, ends[0], ends[1], rotation, translation, axis, lower, upper, mimic)


def _name(element: ET.Element, source: str) -> str:
    name = element.get("name")
    if not name:
        raise RobotError(f"{source}: a <{element.tag}> has no name.")
    return name


def _origin(element: ET.Element, where: str) -> tuple[FloatArray, FloatArray]:
    """(3, 3) rotation and (3,) translation of the element's <origin>; identity where it has none."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    roll, pitch, yaw = _numbers(origin, "rpy", 3, "0 0 0", where)
    return Mount(roll=roll, pitch=pitch, yaw=yaw).rotation, np.array(_numbers(origin, "xyz", 3, "0 0 0", where))


def _numbers(element: ET.Element, attribute: str, count: int, default: str | None, where: str) -> list[float]:
    text = element.get(attribute, default)
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        raise RobotError(f"{where}: {attribute} of <{element.tag}> must be {expected}, found {text!r}.")
    return numbers


def link_poses(urdf: Urdf, base_link: str = "base_link") -> dict[str, tuple[FloatArray, FloatArray]]:
    """Rotation (3, 3) and translation (3,) of each link in ``base_link``, all joints at 0. Raises `RobotError` without such a link."""
    poses: dict[str, tuple[FloatArray, FloatArray]] = {urdf.root: (np.eye(3), np.zeros(3))}
    for joint in urdf.joints:
        rotation, translation = poses[joint.parent]
        poses[joint.child] = rotation @ joint.rotation, translation + rotation @ joint.translation
    base_R, base_t = poses[_body_link(urdf, base_link)]
    return {name: (base_R.T @ rotation, base_R.T @ (translation - base_t)) for name, (rotation, translation) in poses.items()}


def round_shapes(text: str, source: str) -> dict[str, tuple[float, FloatArray]]:
    """Largest radius [m] of the cylinders or spheres of each link of a URDF ``text``, and their centre (3,) in the link's frame.

    Raises `RobotError` for lengths that are no numbers; ``source`` names the text.
    """
    found: dict[str, tuple[float, FloatArray]] = {}
    for link in urdf_root(text, source).findall("link"):
        name = link.get("name", "")
        for shape in (*link.findall("collision"), *link.findall("visual")):
            cylinder, sphere = shape.find("geometry/cylinder"), shape.find("geometry/sphere")
            round_shape = sphere if cylinder is None else cylinder
            if round_shape is None:
                continue
            where = f"{source}: link '{name}'"
            radius = _numbers(round_shape, "radius", 1, None, where)[0]
            if radius > found.get(name, (0.0, None))[0]:
                found[name] = radius, _origin(shape, where)[1]
    return found


def body_link(urdf: Urdf) -> str:
    """Link of the body frame by its name: base_link, base_footprint, or such a name behind a prefix; else the root, or what
    a world carries.

    A root is whatever link hangs on no joint, whatever its name.
    """
    for name in ("base_link", "base_footprint"):
        found = [link for link in urdf.links if link == name or re.search(rf"[_/\-]{name}$", link)]
        if name in found or len(found) == 1:
            return name if name in found else found[0]
    carried = [joint.child for joint in urdf.joints if joint.parent == urdf.root]
    return carried[0] if urdf.root in _WORLDS and len(carried) == 1 else urdf.root


def _body_link(urdf: Urdf, base_link: str) -> str:
    """The link ``base_link``, or the only one whose name is a prefix and it (xacro's prefixes). Raises `RobotError`."""
    if base_link in urdf.links:
        return base_link
    ends = [name for name in urdf.links if re.search(rf"[_/\-]{re.escape(base_link)}$", name)]
    if len(ends) == 1:
        return ends[0]
    raise RobotError(f"{urdf.source}: no link '{base_link}'; links are {first_names(urdf.links)}. Name the body's with --base-link.")


def first_names(names: Iterable[str], count: int = 12) -> str:
    """At most ``count`` names, and how many more there are."""
    names = list(names)
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return ", ".join(names[:count]) + more
