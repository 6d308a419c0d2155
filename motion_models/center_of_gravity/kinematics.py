"""Composite centre of mass of a tree of links at any joint positions, compiled.

`motion_models.center_of_gravity.flatten` makes the arrays that are evaluated here, once for a URDF.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

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
    """Moving links without mass: frames, or arms whose inertia nobody wrote down."""

    @property
    def mass(self) -> float:
        """All of it [kg]."""
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


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def body_moment(constants: FloatArray, rotations: FloatArray, translations: FloatArray, body: int, row: int) -> float:
    """First moment of one body along axis ``row`` of the base's frame [kg m]."""
    turned = 0.0
    for column in range(3):
        turned += rotations[body, row, column] * constants[body, COM + column]
    return float(constants[body, MASS] * (translations[body, row] + turned))


@numba.njit(cache=True)
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


@numba.njit(cache=True)
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


@numba.njit(cache=True)
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
