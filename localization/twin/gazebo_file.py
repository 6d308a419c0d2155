"""A robot of Gazebo as rigid bodies: links, wheels and contacts of an SDF, or of a URDF with its <gazebo> elements.

Read for what moves a wheeled robot alone: poses, masses, shapes that touch, friction. Joints that are no wheels stand at zero. Formats:
http://sdformat.org/spec, http://wiki.ros.org/urdf/XML.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from localization.errors import SimulationError
from localization.twin.robot_mjcf import HALF_WIDTH
from localization.twin.wheels import Hinge, Wheels, find_wheels
from localization.twin.xml_file import Element, XmlFile
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

DEFAULT_MU = 1.0
"""Friction of a shape whose file has none (sdformat's <mu>)."""
DEFAULT_STEP_S = 0.001
"""sdformat's <max_step_size> [s]."""
_TURNING = ("revolute", "continuous")


@dataclass(frozen=True)
class Pose:
    """Rotation (3, 3) and translation (3,) [m] of a frame in another."""

    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    translation: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.rotation @ other.rotation, self.translation + self.rotation @ other.translation)

    def inverse(self) -> Pose:
        """Pose of the other frame in this one."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)


@dataclass(frozen=True)
class Shape:
    """A collision shape of a link."""

    element: Element | None
    """<collision>; None for one by the robot file."""
    kind: str
    """cylinder, capsule, sphere, box, mesh ..."""
    radius: float
    """[m]; NaN where it is not round."""
    length: float
    pose: Pose
    """In the link's frame."""
    mu: float


@dataclass(frozen=True)
class Link:
    """A link with what it weighs and touches with."""

    name: str
    element: Element
    pose: Pose
    """In the model's frame, all joints at zero."""
    mass: float
    com: FloatArray
    """(3,) in the link's frame [m]."""
    inertia: FloatArray
    """(3, 3) about the centre of mass, along the link's axes [kg m^2]."""
    shapes: tuple[Shape, ...]


@dataclass(frozen=True)
class Joint:
    """A joint, in the model's frame."""

    name: str
    kind: str
    parent: str
    child: str
    position: FloatArray
    axis: FloatArray
    is_limited: bool


@dataclass(frozen=True)
class GazeboWheel:
    """A wheel with the shape that it rolls on."""

    joint: Joint
    link: Link
    shape: Shape


@dataclass(frozen=True)
class GazeboRobot:
    """Links of a model, and which of them are wheels."""

    file: XmlFile
    model: Element
    """<model>, or <robot> of a URDF."""
    links: Mapping[str, Link]
    base: str
    """The heaviest link that is no wheel."""
    driven: tuple[GazeboWheel, ...]
    """Left ones first."""
    wheels: Wheels
    time_step_s: float
    notes: tuple[str, ...]

    @property
    def mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return sum(link.mass for link in self.links.values())

    def rigid(self, links: Sequence[Link] | None = None) -> tuple[float, FloatArray, FloatArray]:
        """Mass, centre of mass (3,) and moments of inertia (3, 3) about it of ``links`` in the model's frame; None: all but the wheels."""
        wheels = {w.link.name for w in self.driven}
        chosen = [link for name, link in self.links.items() if name not in wheels] if links is None else links
        mass = sum(link.mass for link in chosen)
        places = [link.pose.rotation @ link.com + link.pose.translation for link in chosen]
        com = sum((link.mass * p for link, p in zip(chosen, places, strict=True)), np.zeros(3)) / max(mass, 1e-9)
        inertia = np.zeros((3, 3))
        for link, p in zip(chosen, places, strict=True):
            off = p - com
            inertia += link.pose.rotation @ link.inertia @ link.pose.rotation.T
            inertia += link.mass * (float(off @ off) * np.eye(3) - np.outer(off, off))
        return mass, com, inertia

    @property
    def ground_z(self) -> float:
        """Height of the wheels' lowest points in the model's frame [m]."""
        return min(float(wheel_centre(w)[2]) - w.shape.radius for w in self.driven)

    def center_of_mass(self) -> tuple[float, float, float]:
        """Centre of mass of the whole robot: ahead and left of the middle of the wheels, above their lowest points [m]."""
        _, com, _ = self.rigid(list(self.links.values()))
        off, f = com[:2] - self.wheels.origin, self.wheels.forward
        return float(off @ f), float(off @ np.array([-f[1], f[0]])), float(com[2] - self.ground_z)


def wheel_centre(wheel: GazeboWheel) -> FloatArray:
    """(3,) centre of the wheel's shape in the model's frame [m]."""
    return (wheel.link.pose @ wheel.shape.pose).translation


def read_gazebo(file: XmlFile, robot: Robot) -> GazeboRobot:
    """The robot of an SDF or URDF. Raises `SimulationError`: no model, no wheels, numbers that are none."""
    model = _model(file)
    notes = [f"{file.path.name}: <{e.tag}> is not read." for e in model.own("include", "model")]
    if file.root.tag == "sdf":
        links, joints = _SdfReader(file, model).read()
    else:
        links, joints = _read_urdf(file, model)
    hinges = [_hinge(i, j, joints, links) for i, j in enumerate(joints) if j.kind in _TURNING]
    turning = [j for j in joints if j.kind in _TURNING]
    wheels = find_wheels([replace(h, index=i) for i, h in enumerate(hinges)], robot, str(file.path))
    driven = []
    for i in (*wheels.left, *wheels.right):
        link = links[turning[i].child]
        shapes = [s for s in link.shapes if math.isfinite(s.radius)] or [_tyre(link, turning[i], robot)]
        driven.append(GazeboWheel(turning[i], link, max(shapes, key=lambda s: s.radius)))
    bare = [w.link.name for w in driven if w.shape.element is None]
    if bare:
        notes.append(f"{file.path.name}: {', '.join(bare)} have no round shape to touch with: cylinders of the robot file's radius do.")
    base = max((name for name in links if name not in {w.link.name for w in driven}), key=lambda name: links[name].mass, default="")
    if not base or links[base].mass <= 0.0:
        raise SimulationError(f"simulator '{file.path}': no link besides the wheels has a mass. Add its <inertial>.")
    steps = [_number(e, file) for e in file.elements("max_step_size")]
    return GazeboRobot(file, model, links, base, tuple(driven), wheels, steps[0] if steps else DEFAULT_STEP_S, tuple(notes))


def _model(file: XmlFile) -> Element:
    if file.root.tag == "robot":
        return file.root
    models = [m for m in file.elements("model") if sum(j.attributes.get("type") in _TURNING for j in m.own("joint")) >= 2]
    if not models:
        found = ", ".join(m.attributes.get("name", "?") for m in file.elements("model")) or "none"
        raise SimulationError(
            f"simulator '{file.path}': no model with two revolute joints (models: {found}). Name the robot's own SDF:"
            " what a world includes is not read."
        )
    return models[0]


def _hinge(index: int, joint: Joint, joints: Sequence[Joint], links: Mapping[str, Link]) -> Hinge:
    link = links[joint.child]
    centres = [(link.pose @ s.pose).translation for s in link.shapes]
    radii = [s.radius if math.isfinite(s.radius) else 0.0 for s in link.shapes]
    lowest = min((float(c[2]) - r for c, r in zip(centres, radii, strict=True)), default=math.inf)
    carries = any(other.parent == joint.child and other.kind != "fixed" for other in joints)
    return Hinge(index, joint.name, centres[0] if centres else joint.position, joint.axis, lowest, joint.is_limited, carries)


def _tyre(link: Link, joint: Joint, robot: Robot) -> Shape:
    """Cylinder of the robot file's radius about the joint's axis, for a wheel that has none."""
    radius = robot.geometry.wheel_radius_m
    axis = link.pose.rotation.T @ joint.axis
    rotation = Rotation.align_vectors([axis], [[0.0, 0.0, 1.0]])[0].as_matrix()
    mu = next((s.mu for s in link.shapes), DEFAULT_MU)
    return Shape(None, "cylinder", radius, 2.0 * HALF_WIDTH * radius, Pose(rotation, np.zeros(3)), mu)


class _SdfReader:
    """Poses of an SDF: each is relative to the frame that it names, else to its default (sdformat 1.7)."""

    def __init__(self, file: XmlFile, model: Element) -> None:
        self._file, self._model = file, model
        self._named = {e.attributes.get("name", ""): e for e in model.own("link", "joint", "frame")}

    def read(self) -> tuple[dict[str, Link], list[Joint]]:
        links = {e.attributes.get("name", ""): self._link(e) for e in self._model.own("link")}
        return links, [self._joint(e, links) for e in self._model.own("joint")]

    def _pose(self, element: Element, depth: int = 0) -> Pose:
        """Pose of a link, joint or frame in the model's frame."""
        if depth > len(self._named):
            raise SimulationError(f"simulator '{self._file.path}': the poses of its frames go round in a circle.")
        poses = element.own("pose")
        own = _pose(poses[0], self._file) if poses else Pose()
        relative = poses[0].attributes.get("relative_to", "") if poses else ""
        if not relative and element.tag == "joint":
            relative = _text(element, "child", self._file)
        if not relative and element.tag == "frame":
            relative = element.attributes.get("attached_to", "")
        if relative in ("", "__model__"):
            return own
        other = self._named.get(relative)
        if other is None:
            raise SimulationError(f"simulator '{self._file.path}': no frame '{relative}', to which a pose is relative.")
        return self._pose(other, depth + 1) @ own

    def _link(self, element: Element) -> Link:
        mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
        for inertial in element.own("inertial"):
            pose = next((_pose(p, self._file) for p in inertial.own("pose")), Pose())
            mass = next((_number(m, self._file) for m in inertial.own("mass")), 1.0)
            moments = {e.tag: _number(e, self._file) for i in inertial.own("inertia") for e in i.children}
            com, inertia = pose.translation, pose.rotation @ _matrix(moments) @ pose.rotation.T
        shapes = tuple(self._shape(c) for c in element.own("collision"))
        return Link(element.attributes.get("name", ""), element, self._pose(element), mass, com, inertia, shapes)

    def _shape(self, element: Element) -> Shape:
        pose = next((_pose(p, self._file) for p in element.own("pose")), Pose())
        geometry = next((g for e in element.own("geometry") for g in e.children), None)
        sizes = {} if geometry is None else {e.tag: e for e in geometry.children if e.tag in ("radius", "length")}
        radius, length = (_number(sizes[n], self._file) if n in sizes else math.nan for n in ("radius", "length"))
        mus = [e for e in element.walk() if e.tag == "mu" and e.parent is not None and e.parent.tag == "ode"]
        mu = _number(mus[0], self._file) if mus else DEFAULT_MU
        return Shape(element, "" if geometry is None else geometry.tag, radius, length, pose, mu)

    def _joint(self, element: Element, links: Mapping[str, Link]) -> Joint:
        pose = self._pose(element)
        axes = element.own("axis")
        xyz = next((_vector(e, self._file) for a in axes for e in a.own("xyz")), np.array([0.0, 0.0, 1.0]))
        frame = next((e.attributes.get("expressed_in", "") for a in axes for e in a.own("xyz")), "")
        rotation = pose.rotation
        if frame == "__model__" or any(_flag(e, self._file) for a in axes for e in a.own("use_parent_model_frame")):
            rotation = np.eye(3)
        elif frame in self._named:
            rotation = self._pose(self._named[frame]).rotation
        limits = {e.tag: _number(e, self._file) for a in axes for limit in a.own("limit") for e in limit.children}
        is_limited = abs(limits.get("lower", -math.inf)) < 1e3 and abs(limits.get("upper", math.inf)) < 1e3
        kind = element.attributes.get("type", "")
        parent, child = (_text(element, tag, self._file) for tag in ("parent", "child"))
        if child not in links:
            raise SimulationError(
                f"simulator '{self._file.path}': joint '{element.attributes.get('name')}' has the child '{child}', no link."
            )
        return Joint(element.attributes.get("name", ""), kind, parent, child, pose.translation, rotation @ xyz, is_limited)


def _read_urdf(file: XmlFile, root: Element) -> tuple[dict[str, Link], list[Joint]]:
    """Links and joints of a URDF; friction is that of <gazebo reference="LINK">."""
    elements = {e.attributes.get("name", ""): e for e in root.own("link")}
    joints = {e.attributes.get("name", ""): e for e in root.own("joint")}
    ends = {n: tuple(next((c.attributes.get("link", "") for c in j.own(t)), "") for t in ("parent", "child")) for n, j in joints.items()}
    poses = {name: Pose() for name in elements if name not in {child for _, child in ends.values()}}
    for _ in joints:
        for name, (parent, child) in ends.items():
            if parent in poses and child not in poses:
                poses[child] = poses[parent] @ _origin(joints[name], file)
    mus = {}
    for e in root.own("gazebo"):
        for mu in e.own("mu1"):
            mus[e.attributes.get("reference", "")] = _number(mu, file)
    links = {}
    for name, e in elements.items():
        mass, com, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
        for inertial in e.own("inertial"):
            pose = _origin(inertial, file)
            mass = next((_float(m.attributes.get("value", ""), file, "mass") for m in inertial.own("mass")), 0.0)
            moments = {k: _float(v, file, k) for i in inertial.own("inertia") for k, v in i.attributes.items()}
            com, inertia = pose.translation, pose.rotation @ _matrix(moments) @ pose.rotation.T
        shapes = tuple(_urdf_shape(c, file, mus.get(name, DEFAULT_MU)) for c in e.own("collision"))
        links[name] = Link(name, e, poses.get(name, Pose()), mass, com, inertia, shapes)
    found = []
    for name, e in joints.items():
        parent, child = ends[name]
        if child not in links or parent not in links:
            raise SimulationError(f"simulator '{file.path}': joint '{name}' is between '{parent}' and '{child}', which are no links of it.")
        axis = next((a.attributes.get("xyz", "1 0 0") for a in e.own("axis")), "1 0 0")
        kind = e.attributes.get("type", "")
        pose = links[child].pose
        found.append(Joint(name, kind, parent, child, pose.translation, pose.rotation @ _floats(axis, 3, file, "axis"), kind == "revolute"))
    return links, found


def _urdf_shape(element: Element, file: XmlFile, mu: float) -> Shape:
    geometry = next((g for e in element.own("geometry") for g in e.children), None)
    sizes = {} if geometry is None else geometry.attributes
    radius, length = (_float(sizes[n], file, n) if n in sizes else math.nan for n in ("radius", "length"))
    return Shape(element, "" if geometry is None else geometry.tag, radius, length, _origin(element, file), mu)


def _origin(element: Element, file: XmlFile) -> Pose:
    for e in element.own("origin"):
        xyz, rpy = (_floats(e.attributes.get(n, "0 0 0"), 3, file, "origin") for n in ("xyz", "rpy"))
        return Pose(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)
    return Pose()


def _pose(element: Element, file: XmlFile) -> Pose:
    numbers = _floats(file.content(element) or "0 0 0 0 0 0", 6, file, "pose")
    angles = np.radians(numbers[3:]) if element.attributes.get("degrees") == "true" else numbers[3:]
    return Pose(Rotation.from_euler("xyz", angles).as_matrix(), numbers[:3])


def _vector(element: Element, file: XmlFile) -> FloatArray:
    return _floats(file.content(element), 3, file, element.tag)


def _number(element: Element, file: XmlFile) -> float:
    return _float(file.content(element), file, element.tag)


def _flag(element: Element, file: XmlFile) -> bool:
    return file.content(element) in ("1", "true")


def _text(element: Element, tag: str, file: XmlFile) -> str:
    return next((file.content(e) for e in element.own(tag)), "")


def _float(text: str, file: XmlFile, what: str) -> float:
    return float(_floats(text, 1, file, what)[0])


def _floats(text: str, count: int, file: XmlFile, what: str) -> FloatArray:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    is_limit = what in ("lower", "upper", "effort", "velocity")  # which may be inf
    if len(numbers) != count or not all(math.isfinite(n) or is_limit for n in numbers):
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        raise SimulationError(f"simulator '{file.path}': <{what}> must be {expected}, found {text.strip()!r}.")
    return np.array(numbers)


def _matrix(moments: Mapping[str, float]) -> FloatArray:
    xx, yy, zz, xy, xz, yz = (
        moments.get(n, 1.0 if n in ("ixx", "iyy", "izz") else 0.0) for n in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
