"""The wheels of a URDF: which joints drive, their radius, distances and axes, and what a robot has besides or instead of driven wheels.

Makers' files differ in names, frames and meshes, so that a wheel is found by its name, by the controller that drives it, or by what it
is: a joint that turns without end about the lateral axis, at the ground, with nothing that moves behind it.
"""

from __future__ import annotations

import dataclasses
import math
import re
import statistics
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from motion_models.center_of_gravity.drive_controllers import (
    CASTERS,
    MECANUM,
    OMNI,
    STEERED,
    TRACKS,
    ControllerValues,
    drive_kinds,
    urdf_controllers,
    velocity_joints,
)
from motion_models.center_of_gravity.urdf import Joint, Urdf, first_names, link_poses, parse_urdf, round_shapes, urdf_root
from motion_models.errors import RobotError
from motion_models.se2 import FloatArray

FORWARD = "skidloc_forward"
"""Link that `with_forward_base` adds: the body frame with x forward."""
_WHEEL = re.compile(r"wheel|tire|tyre|whl|sprocket", re.IGNORECASE)
_CASTER = re.compile(r"caster|castor|swivel|ball_?wheel", re.IGNORECASE)
_STEER = re.compile(r"(?<!skid)(?<!skid[_\-])steer", re.IGNORECASE)
_PASSIVE = re.compile(rf"{_CASTER.pattern}|roller|{_STEER.pattern}", re.IGNORECASE)
_LIMB = re.compile(r"shoulder|elbow|wrist|ankle|flipper|gripper|finger|propell|(^|[_\-/])(arm|hip|knee|leg|head|neck)", re.IGNORECASE)
"""Joints that turn about lateral axes and are no wheels."""
_LEFT = re.compile(r"left|(^|[_\-/])(l|fl|rl|bl|ml|cl|lf|lr|lb|lm)([_\-/]|$)", re.IGNORECASE)
_RIGHT = re.compile(r"right|(^|[_\-/])(r|fr|rr|br|mr|cr|rf|rb|rm)([_\-/]|$)", re.IGNORECASE)
_TURNING = ("revolute", "continuous")
_ALONG = 0.9
"""Component of a unit axis from which it lies along a coordinate axis (25 degrees: cambered wheels count)."""
_SAME_M = 0.02
"""Wheels whose x differs by less stand on one axle, and within half of it of the middle plane on no side [m]."""
_ECCENTRIC = 0.5
"""Distance of a shape's centre from its joint's axis over its radius beyond which it is no wheel there: its place is a mistake."""
_SMALL = 0.6
"""Radius over that of the largest wheels below which wheels are casters; driven wheels of one robot reach 0.7 (tractors)."""
_SAME_RADIUS = 1.1
"""Ratio of radii up to which wheels are alike."""
_ROLLERS = 3
"""Least number of turning joints behind a wheel that are its rollers, not a wheel behind its suspension."""
_OFF_MIDDLE = 0.05
"""Distance of a centre of gravity from the middle over the track from which its masses are named: a battery on one side reaches 0.03."""
_FULL_TURN = 6.2
"""Range [rad] from which a joint turns without end: 3.14 to each side is meant so."""
_LONGEST_M = 20.0
"""Lengths above are not metres: the largest mining trucks are 15 m long."""
_LONGEST_IN_INCHES = 100.0
"""Track of 2.5 m; as millimetres, the least of a robot."""


class _Wheel(NamedTuple):
    """A wheel, or what stands on the ground like one."""

    name: str
    position: FloatArray
    """(3,) centre in the body frame [m]."""
    radius: float
    """[m]; NaN without a cylinder or sphere."""
    axis: FloatArray
    """(3,) in the body frame."""
    is_off_axis: bool
    """Whether its shape does not turn about its middle: its place is that of the joint."""


@dataclass(frozen=True)
class WheelGeometry:
    """What a URDF has of its wheels; NaN for what it does not have."""

    left: tuple[str, ...]
    """Joints of the left wheels."""
    right: tuple[str, ...]
    wheel_radius_m: float
    """NaN where the wheels' radii differ."""
    track_width_m: float
    wheelbase_m: float
    """Between the outermost axles; with one, from there to the casters."""
    mass_kg: float
    """Mass of all links [kg]; NaN where what is fixed to the body has none."""
    positions: Mapping[str, tuple[float, float]]
    """x, y of each wheel's contact in the body frame [m]."""
    cg: tuple[float, float] = (math.nan, math.nan)
    """x, y of the body's centre of gravity, wheels included and arms not, from the middle of the wheels [m]."""
    arms_kg: float = 0.0
    """Mass of links that move and are no wheels, which are not in ``cg``."""
    controllers: tuple[ControllerValues, ...] = ()
    """Values of controllers in <plugin> and <ros2_control>."""
    has_shapes: bool = True
    """Whether the wheels' cylinders or spheres give radius and contacts; else both are of joints alone."""
    radii: tuple[float, ...] = ()
    """Different radii of the wheels' shapes [m]."""
    axes: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Axis of each wheel that turns in the body frame."""
    off_axis: tuple[str, ...] = ()
    """Wheels whose shapes do not turn about their middles; their contacts are taken below their joints."""
    kinds: tuple[str, ...] = ()
    """Words for what no differential drive of wheels is: mecanum, omni, tracks, casters, steered wheels."""
    casters: tuple[str, ...] = ()
    """What stands on the ground and is not driven."""
    has_names: bool = True
    """Whether the wheels are called so; else they were found by their controller or their axes."""

    def renamed(self, names: Mapping[str, str]) -> WheelGeometry:
        """Rename the wheels: ``names`` has the new name of each by the present one."""
        return dataclasses.replace(
            self,
            left=tuple(names[joint] for joint in self.left),
            right=tuple(names[joint] for joint in self.right),
            positions={names[joint]: place for joint, place in self.positions.items()},
            axes={names[joint]: axis for joint, axis in self.axes.items()},
            off_axis=tuple(names[joint] for joint in self.off_axis),
        )

    @property
    def has_one_axle(self) -> bool:
        """Whether the wheels that are driven stand on one axle."""
        xs = [x for x, _ in self.positions.values()]
        return bool(xs) and max(xs) - min(xs) <= _SAME_M and TRACKS not in self.kinds

    @property
    def middle(self) -> tuple[float, float]:
        """x, y of the middle of the driven wheels in the body frame [m]."""
        x, y = zip(*self.positions.values(), strict=True)
        return (min(x) + max(x)) / 2.0, (min(y) + max(y)) / 2.0

    @property
    def cg_off_middle_m(self) -> float:
        """Distance of the centre of gravity from the middle of symmetric wheels where the masses are named as uncertain, else 0."""
        ys = sorted(y for _, y in self.positions.values())
        is_symmetric = bool(ys) and all(abs(a + b - ys[0] - ys[-1]) < _SAME_M for a, b in zip(ys, reversed(ys), strict=True))
        return abs(self.cg[1]) if is_symmetric and abs(self.cg[1]) > _OFF_MIDDLE * self.track_width_m else 0.0


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


def with_forward_base(text: str, source: str, base_link: str) -> tuple[str, str]:
    """Text and body link of a URDF whose body frame has x forward (REP 103): as given, or with a link `FORWARD` that is turned by 90 deg.

    Wheels roll across their axes: along y where all axes lie along x, and the joints' names have left and right apart along x as well.
    Raises `RobotError` for a text that is no URDF, and a missing ``base_link``.
    """
    urdf, root = parse_urdf(text, source), urdf_root(text, source)
    driven = _Finder(urdf, link_poses(urdf, base_link), round_shapes(text, source)).find(velocity_joints(root)).driven
    left, right = sides([wheel.name for wheel in driven])
    if not (left and right and all(abs(wheel.axis[0]) > _ALONG for wheel in driven)):
        return text, base_link
    places = {wheel.name: wheel.position[:2] for wheel in driven}
    to_left = np.mean([places[name] for name in left], axis=0) - np.mean([places[name] for name in right], axis=0)
    if abs(to_left[0]) <= abs(to_left[1]):
        return text, base_link
    turned = ET.SubElement(root, "joint", name=f"{FORWARD}_joint", type="fixed")
    ET.SubElement(turned, "parent", link=base_link)
    ET.SubElement(turned, "child", link=FORWARD)
    ET.SubElement(turned, "origin", rpy=f"0 0 {-math.copysign(math.pi / 2.0, to_left[0])!r}")
    ET.SubElement(root, "link", name=FORWARD)
    return ET.tostring(root, encoding="unicode"), FORWARD


def wheel_geometry(text: str, source: str, base_link: str = "base_link") -> WheelGeometry:
    """Wheels of a URDF ``text``; ``source`` names it in errors. Contacts are taken below the wheels' shapes, or their joints.

    Without wheels on both sides, a controller or plugin with a track counts alone (tracked vehicles). Raises `RobotError` for a text that
    is no URDF, a missing ``base_link``, for one with neither, and for lengths that are not metres.
    """
    urdf = parse_urdf(text, source)
    root = urdf_root(text, source)
    poses = link_poses(urdf, base_link)
    found = _Finder(urdf, poses, round_shapes(text, source)).find(velocity_joints(root))
    controllers, kinds = urdf_controllers(root), _kinds(urdf, root, found)
    left, right, others = _by_side(found.driven)
    mass = _mass(urdf)
    if not left or not right:
        if not any(math.isfinite(c.track_width_m) for c in controllers):
            raise RobotError(
                f"{source}: no driven wheels on both sides{_instead(urdf, kinds)}; give lengths and joints by options instead of --urdf."
            )
        return WheelGeometry((), (), math.nan, math.nan, math.nan, mass, {}, controllers=controllers, has_shapes=False, kinds=kinds)
    driven, passive = [*left, *right], [*found.passive, *others]
    radii = [wheel.radius for wheel in driven if wheel.radius > 0.0]
    positions = {wheel.name: (float(wheel.position[0]), float(wheel.position[1])) for wheel in found.driven if wheel in driven}
    wheelbase = _extent(wheel.position[0] for wheel in driven)
    if wheelbase <= _SAME_M:
        wheelbase = _extent(wheel.position[0] for wheel in (*driven, *passive))
    geometry = WheelGeometry(
        left=tuple(wheel.name for wheel in left),
        right=tuple(wheel.name for wheel in right),
        wheel_radius_m=statistics.median(radii) if radii and max(radii) <= _SAME_RADIUS * min(radii) else math.nan,
        track_width_m=float(np.mean([w.position[1] for w in left]) - np.mean([w.position[1] for w in right])),
        wheelbase_m=wheelbase if wheelbase > _SAME_M else math.nan,
        mass_kg=mass,
        positions=positions,
        controllers=controllers,
        has_shapes=bool(radii),
        radii=tuple(sorted(set(radii))),
        axes={w.name: (float(w.axis[0]), float(w.axis[1]), float(w.axis[2])) for w in driven if np.isfinite(w.axis).all()},
        off_axis=tuple(wheel.name for wheel in driven if wheel.is_off_axis),
        kinds=tuple(dict.fromkeys((*kinds, *([CASTERS] if passive else [])))),
        casters=tuple(wheel.name for wheel in passive),
        has_names=found.has_names,
    )
    _check_metres(geometry, source)
    if not math.isfinite(mass):
        return geometry
    body = _body_links(urdf, [wheel.name for wheel in (*driven, *passive)])
    arms = sum(link.mass for name, link in urdf.links.items() if name not in body)
    return dataclasses.replace(geometry, cg=_center_of_gravity(urdf, poses, body, geometry.middle), arms_kg=arms)


def _check_metres(geometry: WheelGeometry, source: str) -> None:
    """Raise `RobotError` for lengths that no robot has."""
    lengths = {"track": geometry.track_width_m, "wheelbase": geometry.wheelbase_m, "wheel radius": geometry.wheel_radius_m}
    for name, length in lengths.items():
        if length > _LONGEST_M:
            unit = "millimetres" if length > _LONGEST_IN_INCHES else "inches (0.0254 m)"
            raise RobotError(
                f"{source}: its {name} is {length:.4g} m; a URDF has metres, and these may be {unit}: scale it, "
                "or give lengths by options instead of --urdf."
            )


def _by_side(wheels: Sequence[_Wheel]) -> tuple[list[_Wheel], list[_Wheel], list[_Wheel]]:
    """Wheels on the left, on the right, and in the middle. A body frame may lie at a corner: then the wheels' middle divides the sides."""
    ys = [float(wheel.position[1]) for wheel in wheels]
    middle = 0.0 if not ys or (min(ys) < -_SAME_M / 2 and max(ys) > _SAME_M / 2) else (min(ys) + max(ys)) / 2.0
    left = [wheel for wheel, y in zip(wheels, ys, strict=True) if y - middle > _SAME_M / 2]
    right = [wheel for wheel, y in zip(wheels, ys, strict=True) if y - middle < -_SAME_M / 2]
    others = [wheel for wheel, y in zip(wheels, ys, strict=True) if abs(y - middle) <= _SAME_M / 2]
    return left, right, others


def _extent(values: Iterable[float]) -> float:
    numbers = list(values)
    return float(max(numbers) - min(numbers))


class _Found(NamedTuple):
    """Wheels of a URDF by what they are."""

    driven: list[_Wheel]
    passive: list[_Wheel]
    kinds: list[str]
    has_names: bool


class _Finder:
    """Looks for wheels in one URDF."""

    def __init__(
        self, urdf: Urdf, poses: Mapping[str, tuple[FloatArray, FloatArray]], shapes: Mapping[str, tuple[float, FloatArray]]
    ) -> None:
        self._urdf, self._poses, self._shapes = urdf, poses, shapes
        self._above: dict[str, tuple[Joint, ...]] = {}
        """Joints between each joint and the root, by name."""
        by_child: dict[str, Joint] = {}
        for joint in urdf.joints:  # parents come first
            parent = by_child.get(joint.parent)
            self._above[joint.name] = () if parent is None else (parent, *self._above[parent.name])
            by_child[joint.child] = joint
        self._behind: dict[str, list[Joint]] = {joint.name: [] for joint in urdf.joints}
        """Moving joints that hang on each joint, by its name."""
        for joint in urdf.joints:
            for above in self._above[joint.name] if joint.moves else ():
                self._behind[above.name].append(joint)

    def find(self, commanded: frozenset[str]) -> _Found:
        """Driven and passive wheels; ``commanded`` joints are driven by velocity."""
        joints, has_names = self._candidates(commanded)
        kinds: list[str] = []
        rollers = {j.name for wheel in joints for j in self._rollers(wheel)}
        if rollers:
            along = [abs(self._axis(j)[0]) for j in self._urdf.joints if j.name in rollers]
            kinds.append(OMNI if statistics.median(along) > _ALONG else MECANUM)
        names = {joint.name for joint in joints}
        joints = [
            j
            for j in joints
            if j.name not in rollers and (self._rollers(j) or not any(other.name in names for other in self._behind[j.name]))
        ]
        driven, passive = [], []
        for joint in joints:
            above = next((a for a in self._above[joint.name] if a.kind in _TURNING and abs(self._axis(a)[2]) > _ALONG), None)
            if above is None:
                driven.append(self._wheel(joint))
            elif above.kind == "continuous" and not _STEER.search(above.name + above.child):
                passive.append(self._wheel(joint))
            else:
                kinds.append(STEERED)
        if passive and not driven and not kinds:
            kinds.append(OMNI)  # swerve modules
        named = [j for j in self._urdf.joints if _CASTER.search(j.name + j.child)]
        passive += [self._wheel(j) for j in [j for j in named if j.child in self._shapes] or named]
        driven = _on_ground(driven, driven)
        passive = _on_ground(passive, driven)
        largest = max((wheel.radius for wheel in driven if wheel.radius > 0.0), default=math.nan)
        passive += [wheel for wheel in driven if wheel.radius < _SMALL * largest]
        return _Found([wheel for wheel in driven if not wheel.radius < _SMALL * largest], passive, kinds, has_names)

    def _candidates(self, commanded: frozenset[str]) -> tuple[list[Joint], bool]:
        """Joints that may be wheels by the first criterion that has any, and whether it was their names."""
        turning = [j for j in self._urdf.joints if _turns(j) and not _PASSIVE.search(j.name + j.child)]
        named = [j for j in turning if _WHEEL.search(j.name + j.child) and abs(self._axis(j)[2]) <= _ALONG]
        if named:
            return named, True
        driven = [j for j in turning if j.name in commanded]
        if not driven:
            lateral = [j for j in turning if abs(self._axis(j)[1]) > _ALONG and not _LIMB.search(f"{j.name}/{j.child}")]
            driven = [j for j in lateral if not any(map(self._is_part_of_arm, (j, *self._above[j.name])))]
        if driven:
            return driven, False
        return [
            j for j in self._urdf.joints if j.kind == "fixed" and _WHEEL.search(j.child) and not _PASSIVE.search(j.name + j.child)
        ], True

    def _is_part_of_arm(self, joint: Joint) -> bool:
        """Whether something that moves hangs on a ``joint`` that turns without end."""
        return _turns(joint) and not all(_PASSIVE.search(other.name) for other in self._behind[joint.name])

    def _rollers(self, wheel: Joint) -> list[Joint]:
        """Joints on the circumference of a mecanum or omni ``wheel``."""
        behind = [joint for joint in self._behind[wheel.name] if _turns(joint)]
        return behind if len(behind) >= _ROLLERS else []

    def _axis(self, joint: Joint) -> FloatArray:
        if not joint.moves:
            return np.full(3, math.nan)
        return np.asarray(self._poses[joint.child][0] @ joint.axis)

    def _wheel(self, joint: Joint) -> _Wheel:
        """A wheel with the largest shape of its link or of one that is fixed to it, if that turns about its middle."""
        rigid = {joint.child}
        for other in self._urdf.joints:
            if other.kind == "fixed" and other.parent in rigid:
                rigid.add(other.child)
        link = max(rigid, key=lambda name: (self._shapes.get(name, (0.0, None))[0], name == joint.child))
        radius, center = self._shapes.get(link, (math.nan, np.zeros(3)))
        rotation, translation = self._poses[link]
        axis, hub = self._axis(joint), self._poses[joint.child][1]
        place = translation + rotation @ center
        is_off_axis = bool(np.linalg.norm(np.cross(axis, place - hub)) > _ECCENTRIC * radius)  # False without an axis
        return _Wheel(joint.name, hub if is_off_axis else place, radius, axis, is_off_axis)


def _turns(joint: Joint) -> bool:
    """Whether a joint turns by a full turn or more."""
    return joint.kind == "continuous" or (joint.kind == "revolute" and joint.upper - joint.lower >= _FULL_TURN)


def _on_ground(wheels: list[_Wheel], driven: Sequence[_Wheel]) -> list[_Wheel]:
    """Wheels whose lowest point is below the lowest axle of those ``driven``: no flywheels, spare wheels, steering wheels and heads."""
    if not driven:
        return wheels
    assumed = 0.3 * _extent(wheel.position[1] for wheel in driven)  # radius of a wheel whose mesh alone is known
    lowest = min(float(wheel.position[2]) for wheel in driven)
    return [w for w in wheels if float(w.position[2]) - (w.radius if w.radius > 0.0 else assumed) <= lowest]


def _kinds(urdf: Urdf, root: ET.Element, found: _Found) -> tuple[str, ...]:
    """Kinds of wheels and tracks by structure, and by the names of links, joints, meshes and plugins."""
    meshes = [e.get("filename", "").rsplit("/", 1)[-1] for e in root.iter("mesh")]
    names = [*urdf.links, *(joint.name for joint in urdf.joints), *meshes, *(p.get("filename", "") for p in root.iter("plugin"))]
    return tuple(dict.fromkeys((*found.kinds, *drive_kinds(names))))


def _instead(urdf: Urdf, kinds: Sequence[str]) -> str:
    """What a URDF has instead of wheels, for an error."""
    moving = [joint.name for joint in urdf.joints if joint.moves]
    has = f"; it has {', '.join(kinds)}" if kinds else ""
    return f"{has}; its moving joints are {first_names(moving) or 'none'}"


def _mass(urdf: Urdf) -> float:
    """Mass of all links [kg]; NaN where only what moves has one."""
    rigid = {urdf.root}
    for joint in urdf.joints:
        if joint.parent in rigid and not joint.moves:
            rigid.add(joint.child)
    if sum(urdf.links[name].mass for name in rigid) <= 0.0:
        return math.nan
    return sum(link.mass for link in urdf.links.values())


def _body_links(urdf: Urdf, wheels: Sequence[str]) -> set[str]:
    """Links that are the body's: fixed to it, its ``wheels`` (joints), and what carries them."""
    above = {joint.child: joint for joint in urdf.joints}
    own = {*wheels}
    for joint in reversed(urdf.joints):  # children come before their parents
        if joint.name in own and joint.parent in above:
            own.add(above[joint.parent].name)
    links = {urdf.root}
    links.update(joint.child for joint in urdf.joints if joint.parent in links and (not joint.moves or joint.name in own))
    return links


def _center_of_gravity(
    urdf: Urdf, poses: Mapping[str, tuple[FloatArray, FloatArray]], body: set[str], middle: tuple[float, float]
) -> tuple[float, float]:
    """x, y [m] of the masses of the ``body``'s links, from the ``middle`` (x, y in the body frame)."""
    masses = {name: urdf.links[name].mass for name in body if urdf.links[name].mass > 0.0}
    moment = sum((m * (poses[n][1] + poses[n][0] @ urdf.links[n].com) for n, m in masses.items()), start=np.zeros(3))
    x, y, _ = moment / sum(masses.values())
    return float(x - middle[0]), float(y - middle[1])
