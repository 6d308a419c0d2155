"""Composite centre of mass of a tree of links at any joint positions, compiled; and from a URDF to the arrays of that tree.

`flatten` makes the arrays, once for a URDF: links that cannot move against each other become one body, idle joints are fixed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motion_models.center_of_gravity.urdf import Joint, Urdf
from motion_models.compiled import kernel, subroutine
from motion_models.errors import RobotError
from motion_models.se2 import FloatArray

IntArray = NDArray[np.int64]
Pose = tuple[FloatArray, FloatArray]
"""Rotation (3, 3) and translation (3,)."""

# Columns of Chain.layout and Chain.constants.
PARENT, SLIDES, INDEX = 0, 1, 2
ROTATION, TRANSLATION, MULTIPLIER, OFFSET, MASS, COM, COLUMNS = 0, 9, 12, 13, 14, 15, 18

_BEYOND_LIMIT = 0.05
"""How far an encoder may report a joint past its limits [rad or m]."""

_NO_LEVER = 1e-12
"""First moment off the axis [kg m] below which turning a joint moves no mass (a balanced wheel)."""


@dataclass(frozen=True)
class Chain:
    """Bodies: groups of links that cannot move against each other, in the frame of ``base_link``.

    Body 0 is the base with all that is fixed to it. Each other body hangs on one joint, and its frame is turned so that this joint acts
    along its z axis.
    """

    source: str
    base_link: str
    joint_names: tuple[str, ...]
    """The n joints that can move the centre of mass, in the order of every ``positions`` below. Others do not matter."""
    lower: FloatArray
    """(n,) least positions [rad or m]; -inf where there is no limit."""
    upper: FloatArray
    """(n,) greatest positions [rad or m]; inf where there is no limit."""
    other_joints: tuple[str, ...]
    """Joints of the URDF that are not needed: they turn balanced wheels, move nothing, follow others or were left out."""
    layout: IntArray
    """(b, 3) of each body: its parent, whether its joint slides (1) or turns (0), and the joint's index."""
    constants: FloatArray
    """(b, 18) of each body: the joint's rotation (9) and translation (3) [m] in the parent's frame, mimic's multiplier and offset, mass
    [kg] and centre of mass (3) [m]."""
    links: Mapping[str, tuple[int, Pose]]
    """Body of each link, and the link's pose in the body's frame."""
    massless: tuple[str, ...]
    """Moving links without mass: frames, or arms without an <inertial>."""

    @property
    def mass(self) -> float:
        """Total [kg]."""
        return float(self.constants[:, MASS].sum())

    def posture(self, positions: Mapping[str, float]) -> FloatArray:
        """(n,) positions of `joint_names` from names; `other_joints` may be there or not.

        Raises `RobotError` for joints that are missing or that the URDF does not have, and for positions that are not finite or beyond
        the joint's limits.
        """
        unknown = sorted(set(positions) - {*self.joint_names, *self.other_joints})
        if unknown:
            raise RobotError(f"{self.source} has no joint {', '.join(unknown)}; its joints are {', '.join(self.joint_names) or 'none'}.")
        missing = [name for name in self.joint_names if name not in positions]
        if missing:
            raise RobotError(f"no position of joint {', '.join(missing)}; {self.source} needs {', '.join(self.joint_names)}.")
        q = np.array([positions[name] for name in self.joint_names], dtype=float)
        for name, value, lower, upper in zip(self.joint_names, q, self.lower, self.upper, strict=True):
            if not math.isfinite(value):
                raise RobotError(f"position of joint {name} is {value}; it must be a finite number.")
            if not lower - _BEYOND_LIMIT <= value <= upper + _BEYOND_LIMIT:
                raise RobotError(
                    f"position {value:g} of joint {name} is beyond its limits {lower:g} to {upper:g} in {self.source}; "
                    "positions are in radians and metres."
                )
        return q

    def center_of_mass(self, positions: FloatArray) -> FloatArray:
        """(..., 3) composite centre of mass in the base's frame [m] at joint ``positions`` (..., n)."""
        q, lead = self._rows(positions)
        out = np.empty((q.shape[0], 3))
        _center_of_mass(self.layout, self.constants, q, out)
        return out.reshape(*lead, 3)

    def center_of_mass_jacobian(self, positions: FloatArray) -> FloatArray:
        """(..., 3, n) derivative of `center_of_mass` by the joint positions [m/rad or 1]."""
        q, lead = self._rows(positions)
        out = np.zeros((*q.shape[:1], 3, len(self.joint_names)))
        _jacobian(self.layout, self.constants, q, out)
        return out.reshape(*lead, 3, len(self.joint_names))

    def point(self, link: str, position: FloatArray) -> tuple[int, FloatArray]:
        """Body that carries ``link``, and the ``position`` (3,) [m] of a point of that link in the body's frame. Raises `RobotError`.

        Joints that cannot move the centre of mass stand still here; of a link behind one, only points on its axis are right.
        """
        if link not in self.links:
            raise RobotError(f"{self.source}: no link '{link}'; links are {', '.join(self.links)}.")
        body, (rotation, translation) = self.links[link]
        return body, translation + rotation @ position

    def _rows(self, positions: FloatArray) -> tuple[FloatArray, tuple[int, ...]]:
        q = np.ascontiguousarray(positions, dtype=float)
        if q.shape[-1:] != (len(self.joint_names),):
            raise RobotError(f"{self.source} has {len(self.joint_names)} joints ({', '.join(self.joint_names)}), got positions {q.shape}.")
        return q.reshape(math.prod(q.shape[:-1]), q.shape[-1]), q.shape[:-1]


@kernel
def forward(layout: IntArray, constants: FloatArray, positions: FloatArray, rotations: FloatArray, translations: FloatArray) -> None:
    """Poses of all bodies in the base's frame at ``positions`` (n,), into ``rotations`` (b, 3, 3) and ``translations`` (b, 3)."""
    for row in range(3):
        for column in range(3):
            rotations[0, row, column] = constants[0, ROTATION + 3 * row + column]
        translations[0, row] = constants[0, TRANSLATION + row]
    for i in range(1, layout.shape[0]):
        parent = layout[i, PARENT]
        value = constants[i, MULTIPLIER] * positions[layout[i, INDEX]] + constants[i, OFFSET]
        for row in range(3):
            a, b, c = rotations[parent, row, 0], rotations[parent, row, 1], rotations[parent, row, 2]
            for column in range(3):
                rotations[i, row, column] = (
                    a * constants[i, ROTATION + column] + b * constants[i, ROTATION + 3 + column] + c * constants[i, ROTATION + 6 + column]
                )
            along = a * constants[i, TRANSLATION] + b * constants[i, TRANSLATION + 1] + c * constants[i, TRANSLATION + 2]
            translations[i, row] = translations[parent, row] + along
        if layout[i, SLIDES] == 1:
            for row in range(3):
                translations[i, row] += rotations[i, row, 2] * value
        else:
            cosine, sine = math.cos(value), math.sin(value)
            for row in range(3):
                x, y = rotations[i, row, 0], rotations[i, row, 1]
                rotations[i, row, 0] = cosine * x + sine * y
                rotations[i, row, 1] = cosine * y - sine * x


@subroutine
def body_moment(constants: FloatArray, rotations: FloatArray, translations: FloatArray, body: int, row: int) -> float:
    """First moment of one body along axis ``row`` of the base's frame [kg m]."""
    turned = 0.0
    for column in range(3):
        turned += rotations[body, row, column] * constants[body, COM + column]
    return float(constants[body, MASS] * (translations[body, row] + turned))


@kernel
def _center_of_mass(layout: IntArray, constants: FloatArray, positions: FloatArray, out: FloatArray) -> None:
    """`Chain.center_of_mass` of ``positions`` (N, n) into ``out`` (N, 3)."""
    bodies = layout.shape[0]
    rotations, translations = np.empty((bodies, 3, 3)), np.empty((bodies, 3))
    mass = 0.0
    for i in range(bodies):
        mass += constants[i, MASS]
    for sample in range(positions.shape[0]):
        forward(layout, constants, positions[sample], rotations, translations)
        for row in range(3):
            moment = 0.0
            for i in range(bodies):
                moment += body_moment(constants, rotations, translations, i, row)
            out[sample, row] = moment / mass


@subroutine
def subtree_jacobian(layout: IntArray, constants: FloatArray, rotations: FloatArray, translations: FloatArray, out: FloatArray) -> None:
    """Derivative of the chain's first moment [kg m] by the joints, added to ``out`` (3, n).

    A turning joint moves the moment P of all masses m behind it, whose joint is at o, by z x (P - m o); a sliding one by z m.
    """
    bodies = layout.shape[0]
    behind = np.zeros((bodies, 4))  # mass and first moment of each body with all behind it
    for i in range(bodies - 1, 0, -1):
        behind[i, 0] += constants[i, MASS]
        for row in range(3):
            behind[i, 1 + row] += body_moment(constants, rotations, translations, i, row)
        for k in range(4):
            behind[layout[i, PARENT], k] += behind[i, k]
        mass, joint, rate = behind[i, 0], layout[i, INDEX], constants[i, MULTIPLIER]
        zx, zy, zz = rotations[i, 0, 2], rotations[i, 1, 2], rotations[i, 2, 2]
        if layout[i, SLIDES] == 1:
            dx, dy, dz = mass * zx, mass * zy, mass * zz
        else:
            px = behind[i, 1] - mass * translations[i, 0]
            py = behind[i, 2] - mass * translations[i, 1]
            pz = behind[i, 3] - mass * translations[i, 2]
            dx, dy, dz = zy * pz - zz * py, zz * px - zx * pz, zx * py - zy * px
        out[0, joint] += rate * dx
        out[1, joint] += rate * dy
        out[2, joint] += rate * dz


@kernel
def _jacobian(layout: IntArray, constants: FloatArray, positions: FloatArray, out: FloatArray) -> None:
    """`Chain.center_of_mass_jacobian` of ``positions`` (N, n) into ``out`` (N, 3, n), which starts at zero."""
    bodies = layout.shape[0]
    rotations, translations = np.empty((bodies, 3, 3)), np.empty((bodies, 3))
    mass = 0.0
    for i in range(bodies):
        mass += constants[i, MASS]
    for sample in range(positions.shape[0]):
        forward(layout, constants, positions[sample], rotations, translations)
        subtree_jacobian(layout, constants, rotations, translations, out[sample])
        for row in range(3):
            for joint in range(out.shape[2]):
                out[sample, row, joint] /= mass


def flatten(urdf: Urdf, base_link: str = "base_link", joints: tuple[str, ...] | None = None) -> Chain:
    """The chain of ``urdf`` in the frame of ``base_link``.

    ``joints`` are those whose positions will be given; by default all that can move the centre of mass. The others stay at 0, or at
    their limit nearest to it. Joints that mimic others follow them. Raises `RobotError` for a link or a joint that is not there, a base
    that moves, and arms without masses.
    """
    if base_link not in urdf.links:
        raise RobotError(f"{urdf.source}: no link '{base_link}'; links are {', '.join(urdf.links)}.")
    if sum(link.mass for link in urdf.links.values()) <= 0.0:
        raise RobotError(f"{urdf.source}: no link has an <inertial> with a mass; links are {', '.join(urdf.links)}.")
    moving = [joint for joint in urdf.joints if joint.moves]
    masters = {joint.name: _master(urdf, joint)[0] for joint in moving}
    free = tuple(joint.name for joint in moving if joint.mimic is None)
    unknown = [name for name in joints or () if name not in free]
    if unknown:
        raise RobotError(f"{urdf.source}: no joint {', '.join(unknown)} that moves mass; there are {', '.join(free) or 'none'}.")

    idle, carried = _idle_joints(urdf)
    heavy = {masters[joint.name] for joint in moving if carried[joint.name] > 0.0}
    needed = {masters[joint.name] for joint in moving if joint.name not in idle}
    names = tuple(name for name in free if name in needed and (joints is None or name in joints))
    below = _moving_links(urdf)
    massless = tuple(name for name in urdf.links if name in below and urdf.links[name].mass == 0.0)
    useless = sorted(name for name in joints or () if name not in heavy)
    if useless or (not names and massless):
        culprits = f"joint {', '.join(useless)} moves" if useless else "its joints move"
        raise RobotError(
            f"{urdf.source}: {culprits} no mass; moving links without an <inertial> with a mass: {', '.join(massless) or 'none'}."
        )
    active = {name: names.index(master) for name, master in masters.items() if master in names}
    return _chain(urdf, base_link, names, active, massless)


def _chain(urdf: Urdf, base_link: str, names: tuple[str, ...], active: Mapping[str, int], massless: tuple[str, ...]) -> Chain:
    """``active`` maps joints that make a new body to their index in ``names``; those that mimic have their master's."""
    by_name = {joint.name: joint for joint in urdf.joints}
    links: dict[str, tuple[int, Pose]] = {urdf.root: (0, (np.eye(3), np.zeros(3)))}
    layout: list[list[int]] = [[-1, 0, -1]]
    rows = [np.zeros(COLUMNS)]
    for joint in urdf.joints:
        body, (rotation, translation) = links[joint.parent]
        if joint.name not in active:
            step_rotation, step = _pose(joint, _rest(urdf, joint))
            links[joint.child] = body, (rotation @ step_rotation, translation + rotation @ step)
            continue
        turn = _turn_to_z(joint.axis)
        _, multiplier, offset = _master(urdf, joint)
        row = np.zeros(COLUMNS)
        row[ROTATION:TRANSLATION] = (rotation @ joint.rotation @ turn).ravel()
        row[TRANSLATION:MULTIPLIER] = translation + rotation @ joint.translation
        row[MULTIPLIER], row[OFFSET] = multiplier, offset
        links[joint.child] = len(rows), (turn.T, np.zeros(3))
        rows.append(row)
        layout.append([body, int(joint.kind == "prismatic"), active[joint.name]])

    body, (rotation, translation) = links[base_link]
    if body != 0:
        raise RobotError(f"{urdf.source}: base link '{base_link}' hangs on a joint that moves; name a link that is fixed to '{urdf.root}'.")
    # Body 0 is posed so that the base's frame is where all is expressed.
    rows[0][ROTATION:TRANSLATION], rows[0][TRANSLATION:MULTIPLIER] = rotation.T.ravel(), -rotation.T @ translation

    moments = np.zeros((len(rows), 4))
    for name, (index, (link_rotation, link_translation)) in links.items():
        link = urdf.links[name]
        moments[index, 0] += link.mass
        moments[index, 1:] += link.mass * (link_translation + link_rotation @ link.com)
    constants = np.array(rows)
    constants[:, MASS] = moments[:, 0]
    heavy = moments[:, 0] > 0.0
    constants[heavy, COM:] = moments[heavy, 1:] / moments[heavy, :1]

    limits = np.array([[by_name[name].lower, by_name[name].upper] for name in names]).reshape(-1, 2)
    others = tuple(name for name in by_name if name not in names)
    return Chain(urdf.source, base_link, names, limits[:, 0], limits[:, 1], others, np.array(layout), constants, links, massless)


def _master(urdf: Urdf, joint: Joint) -> tuple[str, float, float]:
    """Joint that ``joint`` follows in the end (itself, if none), with multiplier and offset."""
    multiplier, offset = 1.0, 0.0
    by_name = {j.name: j for j in urdf.joints}
    while joint.mimic is not None:
        offset += multiplier * joint.mimic.offset
        multiplier *= joint.mimic.multiplier
        joint = by_name[joint.mimic.joint]
    return joint.name, multiplier, offset


def _rest(urdf: Urdf, joint: Joint) -> float:
    """Position of a joint whose position is not given: 0, or the limit nearest to it, of the joint that it follows."""
    name, multiplier, offset = _master(urdf, joint)
    master = next(j for j in urdf.joints if j.name == name)
    return multiplier * min(max(0.0, master.lower), master.upper) + offset


def _pose(joint: Joint, position: float) -> Pose:
    """The child's frame in the parent's at ``position``."""
    if joint.kind == "fixed":
        return joint.rotation, joint.translation
    if joint.kind == "prismatic":
        return joint.rotation, joint.translation + joint.rotation @ joint.axis * position
    x, y, z = joint.axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.eye(3) + math.sin(position) * cross + (1.0 - math.cos(position)) * cross @ cross  # Rodrigues
    return joint.rotation @ turn, joint.translation


def _moving_links(urdf: Urdf) -> set[str]:
    """Links that move against the root."""
    moving: set[str] = set()
    for joint in urdf.joints:
        if joint.moves or joint.parent in moving:
            moving.add(joint.child)
    return moving


def _idle_joints(urdf: Urdf) -> tuple[set[str], dict[str, float]]:
    """Joints that move no mass, or that turn one about its own centre, as a wheel's joint does; and the mass behind every joint [kg]."""
    idle: set[str] = set()
    carried: dict[str, float] = {}
    restless: set[str] = set()  # links with a joint below them that is not idle
    moments = {name: (link.mass, link.mass * link.com) for name, link in urdf.links.items()}
    for joint in reversed(urdf.joints):
        mass, moment = moments[joint.child]
        carried[joint.name] = mass
        lever = mass if joint.kind == "prismatic" else float(np.linalg.norm(np.cross(joint.axis, moment)))
        if joint.child in restless or (joint.moves and lever > _NO_LEVER):
            restless.add(joint.parent)
        else:
            idle.add(joint.name)
        rotation, translation = _pose(joint, _rest(urdf, joint))
        parent_mass, parent_moment = moments[joint.parent]
        moments[joint.parent] = (parent_mass + mass, parent_moment + rotation @ moment + mass * translation)
    return idle, carried


def _turn_to_z(axis: FloatArray) -> FloatArray:
    """(3, 3) rotation whose third column is ``axis``."""
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(axis)))], axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
