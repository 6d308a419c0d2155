"""URDFs: links with mass and centre of mass, the joints between them, and the wheels: which joints drive, their radius and distances.

Read with the standard library: of a URDF's content only names, origins, axes, limits, mimics and masses matter here, and the readers
that there are bring mesh loaders with them. Format: http://wiki.ros.org/urdf/XML. Errors are `RobotError`s that name file and element.
"""

from __future__ import annotations

import dataclasses
import math
import re
import statistics
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from motion_models.errors import RobotError
from motion_models.robot import Mount
from motion_models.se2 import FloatArray
from motion_models.text_files import read_text

_MOVING = ("revolute", "continuous", "prismatic")
_XACRO = "it is a xacro file, not a URDF; expand it first: xacro FILE.xacro > FILE.urdf"

_WHEEL = re.compile(r"wheel|tire|tyre|whl|sprocket", re.IGNORECASE)
_PASSIVE = re.compile(r"caster|castor|swivel|steer", re.IGNORECASE)
_LEFT = re.compile(r"left|(^|[_\-/])(l|fl|rl|bl|ml|cl|lf|lr|lb|lm)([_\-/]|$)", re.IGNORECASE)
_RIGHT = re.compile(r"right|(^|[_\-/])(r|fr|rr|br|mr|cr|rf|rb|rm)([_\-/]|$)", re.IGNORECASE)
_LEFT_KEYS = ("left_wheel_names", "left_wheel", "left_joint", "leftjoint", "leftfrontjoint", "leftrearjoint")
_RIGHT_KEYS = ("right_wheel_names", "right_wheel", "right_joint", "rightjoint", "rightfrontjoint", "rightrearjoint")
"""Keys of controllers and plugins (lower case) that name the wheels' joints."""
_KINDS = {
    "mecanum wheels": re.compile(r"mecanum", re.IGNORECASE),
    "omnidirectional wheels": re.compile(r"omni.*(wheel|roller)|(wheel|roller).*omni|swerve|planar_move", re.IGNORECASE),
    "tracks": re.compile(
        r"(^|[_\-/])(l|r|left|right)_?(track|crawler|tread|belt)s?([_\-/.]|$)|(^|[_\-/])(track|crawler|tread|belt)s?_?(l|r|left|right)([_\-/.]|$)"
        r"|track(ed_?vehicle|_?controller)|sprocket",
        re.IGNORECASE,
    ),
    "steered wheels": re.compile(r"steer(ing)?|ackermann", re.IGNORECASE),
    "casters": re.compile(r"caster|castor", re.IGNORECASE),
}
_TURNING = ("revolute", "continuous")
_ALONG = 0.9
"""Component of a unit axis from which it lies along a coordinate axis (25 degrees: cambered wheels count)."""
_SAME_M = 0.02
"""Wheels whose x differs by less stand on one axle [m]."""


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
    path = Path(path)
    if path.suffix == ".xacro":
        raise RobotError(f"'{path}' cannot be used: {_XACRO}.")
    try:
        text = read_text(path)
    except OSError as error:
        raise RobotError(f"URDF '{path}' cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise RobotError(f"URDF '{path}' is not text (byte {error.start} is not UTF-8).") from error
    return parse_urdf(text, source=str(path))


def parse_urdf(text: str, source: str) -> Urdf:
    """The URDF of an XML text; ``source`` names it in errors. Raises `RobotError`."""
    try:
        # ElementTree takes bytes where the XML declares an encoding.
        root = ET.fromstring(text.encode())
    except ET.ParseError as error:
        # An old xacro file may not declare its namespace, which is an error of XML already.
        raise RobotError(f"{source}: {_XACRO if '<xacro:' in text else f'not valid XML: {error}'}.") from error
    if root.tag != "robot":
        raise RobotError(f"{source}: the outermost element is <{root.tag}>; a URDF has <robot>.")
    if any("xacro}" in e.tag or any("${" in v or "$(" in v for v in e.attrib.values()) for e in root.iter()):
        raise RobotError(f"{source}: {_XACRO}.")

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
        raise RobotError(f"{where} is of type '{kind}'; a centre of gravity can be had for fixed, {', '.join(_MOVING)}.")
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
    return Mount(roll=roll, pitch=pitch, yaw=yaw).rotation(), np.array(_numbers(origin, "xyz", 3, "0 0 0", where))


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


@dataclass(frozen=True)
class ControllerValues:
    """What the parameters of one drive controller or simulator plugin contain; NaN and empty for what they do not."""

    source: str
    track_width_m: float = math.nan
    wheel_radius_m: float = math.nan
    wheel_separation_multiplier: float = math.nan
    left: tuple[str, ...] = ()
    right: tuple[str, ...] = ()


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
    cg: tuple[float, float] = (math.nan, math.nan)
    """x, y of the centre of gravity of all links from the middle of the wheels, joints at 0 [m]."""
    controllers: tuple[ControllerValues, ...] = ()
    """Of <plugin> and <ros2_control>."""
    has_shapes: bool = True
    """Whether the wheels' cylinders or spheres give radius and contacts; else both are of joints alone."""
    radii: tuple[float, ...] = ()
    """Different radii of the wheels' shapes [m]."""
    axes: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Axis of each wheel in the body frame."""
    kinds: tuple[str, ...] = ()
    """Words for what no differential drive of wheels is: mecanum, omni, tracks, casters, steered wheels."""


def is_wheel(name: str) -> bool:
    """Whether a joint is a driven wheel by its spelling."""
    return bool(_WHEEL.search(name)) and not _PASSIVE.search(name)


def sides(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the left and right wheels among joint ``names``, by their spelling. Either may be empty.

    >>> sides(["front_left_wheel", "rear_right_wheel", "arm_joint", "wheel_FL_joint"])
    (('front_left_wheel', 'wheel_FL_joint'), ('rear_right_wheel',))
    """
    wheels = [name for name in names if is_wheel(name)]
    left = tuple(name for name in wheels if _LEFT.search(name) and not re.search("right", name, re.IGNORECASE))
    return left, tuple(name for name in wheels if name not in left and _RIGHT.search(name))


def wheel_geometry(text: str, source: str, base_link: str = "base_link") -> WheelGeometry:
    """Wheels of a URDF ``text``; ``source`` names it in errors. Contacts are taken below the wheels' shapes, or their joints.

    Without wheels on both sides, a controller or plugin with a track counts alone (tracked vehicles). Raises `RobotError` for a text that
    is no URDF, a missing ``base_link``, and for one with neither.
    """
    urdf = parse_urdf(text, source)
    base_link = _body(urdf, base_link)
    root = ET.fromstring(text.encode())
    shapes = _shapes(root)
    poses = _poses(urdf)
    base_R, base_t = poses[base_link]
    wheels: dict[str, tuple[float, float]] = {}
    axes: dict[str, FloatArray] = {}
    radii = []
    for joint in _wheel_joints(urdf, poses, base_R):
        rotation, translation = poses[joint.child]
        radius, center = shapes.get(joint.child, (math.nan, np.zeros(3)))
        x, y, _ = base_R.T @ (translation + rotation @ center - base_t)
        wheels[joint.name] = (float(x), float(y))
        axes[joint.name] = base_R.T @ rotation @ joint.axis
        radii.append(radius)
    finite = [radius for radius in radii if math.isfinite(radius) and radius > 0.0]
    # A body frame may lie at a corner: then the middle of the wheels divides the sides.
    ys = [y for _, y in wheels.values()]
    middle = 0.0 if not ys or (min(ys) < -_SAME_M / 2 and max(ys) > _SAME_M / 2) else (min(ys) + max(ys)) / 2.0
    left = tuple(name for name, (_, y) in wheels.items() if y - middle > _SAME_M / 2)
    right = tuple(name for name, (_, y) in wheels.items() if y - middle < -_SAME_M / 2)
    wheels = {name: wheels[name] for name in wheels if name in (*left, *right)}
    controllers, kinds = _controllers(root), _kinds(urdf, root)
    if not left or not right:
        known = next((c for c in controllers if math.isfinite(c.track_width_m)), None)
        if known is None:
            raise RobotError(
                f"{source}: no driven wheels on both sides{_instead(urdf, kinds)}; give lengths and joints by options instead."
            )
        return WheelGeometry((), (), math.nan, math.nan, math.nan, _mass(urdf), {}, controllers=controllers, has_shapes=False, kinds=kinds)
    along = max(x for x, _ in wheels.values()) - min(x for x, _ in wheels.values())
    return WheelGeometry(
        left=left,
        right=right,
        wheel_radius_m=statistics.median(finite) if finite else math.nan,
        track_width_m=statistics.mean(wheels[name][1] for name in left) - statistics.mean(wheels[name][1] for name in right),
        wheelbase_m=along if along > _SAME_M else math.nan,
        mass_kg=_mass(urdf),
        positions=wheels,
        cg=_center_of_gravity(urdf, poses, base_link, wheels),
        controllers=controllers,
        has_shapes=bool(finite),
        kinds=kinds,
        radii=tuple(sorted(set(finite))),
        axes={name: (float(a[0]), float(a[1]), float(a[2])) for name, a in axes.items() if name in wheels},
    )


def _body(urdf: Urdf, base_link: str) -> str:
    """The link ``base_link``, or the only one whose name is a prefix and it (xacro's prefixes). Raises `RobotError`."""
    if base_link in urdf.links:
        return base_link
    ends = [name for name in urdf.links if re.search(rf"[_/\-]{re.escape(base_link)}$", name)]
    if len(ends) == 1:
        return ends[0]
    raise RobotError(f"{urdf.source}: no link '{base_link}'; links are {_first(urdf.links)}. Name the body's with --base-link.")


def _first(names: Iterable[str], count: int = 12) -> str:
    """At most ``count`` names, and how many more there are."""
    names = list(names)
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return ", ".join(names[:count]) + more


def _instead(urdf: Urdf, kinds: Sequence[str]) -> str:
    """What a URDF has instead of wheels, for an error."""
    moving = [joint.name for joint in urdf.joints if joint.moves]
    has = f"; it has {', '.join(kinds)}" if kinds else ""
    return f"{has}; its moving joints are {_first(moving) or 'none'}"


def _mass(urdf: Urdf) -> float:
    return sum(link.mass for link in urdf.links.values()) or math.nan


def _center_of_gravity(
    urdf: Urdf, poses: Mapping[str, tuple[FloatArray, FloatArray]], base_link: str, wheels: Mapping[str, tuple[float, float]]
) -> tuple[float, float]:
    """x, y [m] of all links' masses in the body frame, from the middle of the wheels; NaN without masses."""
    masses = {name: link.mass for name, link in urdf.links.items() if link.mass > 0.0}
    if not masses:
        return math.nan, math.nan
    moment = sum((m * (poses[n][1] + poses[n][0] @ urdf.links[n].com) for n, m in masses.items()), start=np.zeros(3))
    base_R, base_t = poses[base_link]
    com = base_R.T @ (moment / sum(masses.values()) - base_t)
    middle = np.mean([[min(v), max(v)] for v in zip(*wheels.values(), strict=True)], axis=1)
    return float(com[0] - middle[0]), float(com[1] - middle[1])


def _controllers(root: ET.Element) -> tuple[ControllerValues, ...]:
    """Values of <plugin>s (Gazebo's of ROS 1, ROS 2 and gz) and <ros2_control> that have a track or a radius."""
    found = []
    for element in (*root.iter("plugin"), *root.iter("ros2_control")):
        values = {(e.get("name", "") if e.tag == "param" else e.tag): (e.text or "").strip() for e in element.iter()}
        where = f"<{element.tag}> {element.get('name', '')}".strip()
        lists = {key: [e.text or "" for e in element.iter(key)] for key in (*_LEFT_KEYS, *_RIGHT_KEYS)}
        controller = controller_values({**values, **{key: names for key, names in lists.items() if names}}, where)
        if controller is not None:
            found.append(controller)
    return tuple(found)


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


def _kinds(urdf: Urdf, root: ET.Element) -> tuple[str, ...]:
    """Kinds of wheels and tracks by the names of links, joints and meshes."""
    meshes = [e.get("filename", "").rsplit("/", 1)[-1] for e in root.iter("mesh")]
    names = [*urdf.links, *(joint.name for joint in urdf.joints), *meshes, *(p.get("filename", "") for p in root.iter("plugin"))]
    return tuple(kind for kind, pattern in _KINDS.items() if any(pattern.search(name) for name in names))


def _wheel_joints(urdf: Urdf, poses: Mapping[str, tuple[FloatArray, FloatArray]], base_R: FloatArray) -> list[Joint]:
    """Joints of driven wheels: continuous ones (or of more than a turn) by name; where no name has a wheel in it, by a lateral axis.

    What hangs on a joint that turns about the vertical is a caster or is steered; both are left out, as are such joints themselves.
    """
    by_child = {joint.child: joint for joint in urdf.joints}

    def axis(joint: Joint) -> FloatArray:
        return np.abs(base_R.T @ poses[joint.child][0] @ joint.axis)

    def is_steered(joint: Joint) -> bool:
        above: Joint | None = joint
        while above is not None:
            if above.kind in _TURNING and axis(above)[2] > _ALONG:
                return True
            above = by_child.get(above.parent)
        return False

    turning = [
        j
        for j in urdf.joints
        if (j.kind == "continuous" or (j.kind == "revolute" and not j.upper - j.lower < 2.0 * math.pi))
        and j.mimic is None
        and not _PASSIVE.search(j.name + j.child)
        and not is_steered(j)
    ]
    return [j for j in turning if _WHEEL.search(j.name + j.child)] or [j for j in turning if axis(j)[1] > _ALONG]


def link_poses(urdf: Urdf, base_link: str = "base_link") -> dict[str, tuple[FloatArray, FloatArray]]:
    """Rotation (3, 3) and translation (3,) of each link in ``base_link``, all joints at 0."""
    poses = _poses(urdf)
    base_R, base_t = poses[_body(urdf, base_link)]
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
