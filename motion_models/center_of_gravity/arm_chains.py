"""Arms of a URDF: what moves on a robot and is no wheel, with masses that are compared with those of known robots and arms."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from motion_models.center_of_gravity.kinematics import flatten
from motion_models.center_of_gravity.urdf import Joint, Link, Urdf, first_names, link_poses
from motion_models.errors import RobotError
from motion_models.se2 import FloatArray

BODY = "skidloc_body"
"""Link that `write_urdf` adds: the body frame, in the middle of the wheels."""
_UNLIKELY = 3.0
"""Standard deviations of a logarithm from which a mass is named; nothing is changed by it."""
_ARM_KG_PER_M = (12.0, 1.0)
"""Median of an arm's mass over its reach [kg/m] and sigma of its logarithm. By their makers' data sheets: UR5 22, Panda 21, xArm 6 17,
Kinova Gen3 lite 7; arms of hobby servos weigh about 3."""
_BASE_KG_PER_M2 = (124.0, 0.55)
"""Median of a base's mass over track times wheelbase [kg/m^2] and sigma of its logarithm: the shipped robots' (a test)."""


@dataclass(frozen=True)
class ArmChain:
    """A moving part that hangs on the body: an arm, a lift with what it carries, a pan-tilt."""

    root: str
    """Its first moving joint."""
    joints: tuple[str, ...]
    """Joints that can move the centre of mass, parents first; those that follow another are left out."""
    links: tuple[str, ...]
    mass_kg: float
    reach_m: float
    """Length from its first joint to its farthest joint or centre of mass, along the links [m]."""
    massless: tuple[str, ...]
    """Links with an origin of their own and no mass."""


def find_arms(urdf: Urdf, base_link: str, wheels: Iterable[str]) -> tuple[ArmChain, ...]:
    """The arms of ``urdf``: all that hangs on a joint that moves, but for the joints ``wheels`` and what hangs on these.

    Raises `RobotError` for a URDF without masses.
    """
    excluded = {*wheels}
    by_child = {joint.child: joint for joint in urdf.joints}
    heavy = {*flatten(urdf, base_link).joint_names}
    first: dict[str, str] = {}
    """First moving joint above each link that is no body's."""
    for joint in urdf.joints:
        if joint.parent in first:
            first[joint.child] = first[joint.parent]
        elif joint.moves:
            first[joint.child] = joint.name
    wheel_roots = {first[joint.child] for joint in urdf.joints if joint.name in excluded and joint.child in first}
    found = []
    for root in dict.fromkeys(first.values()):
        if root in wheel_roots:
            continue
        links = tuple(link for link, top in first.items() if top == root)
        joints = tuple(by_child[link].name for link in links if by_child[link].name in heavy)
        mass = sum(urdf.links[link].mass for link in links)
        massless = tuple(link for link in links if urdf.links[link].mass == 0.0 and by_child[link].moves)
        if joints or massless:
            found.append(ArmChain(root, joints, links, mass, _reach(urdf, links), massless))
    return tuple(found)


def _reach(urdf: Urdf, links: Sequence[str]) -> float:
    length: dict[str, float] = {}
    farthest = 0.0
    for joint in urdf.joints:
        if joint.child in links:
            length[joint.child] = length[joint.parent] + float(np.linalg.norm(joint.translation)) if joint.parent in length else 0.0
            own = float(np.linalg.norm(urdf.links[joint.child].com))
            farthest = max(farthest, length[joint.child] + own)
    return farthest


def doubts_of_masses(urdf: Urdf, arms: Sequence[ArmChain], footprint_m2: float) -> list[str]:
    """A sentence for each mass that is not believable: links of 0 kg, placeholders, arms and bases unlike known ones.

    ``footprint_m2`` is track times wheelbase, NaN where unknown.
    """
    doubts = []
    for arm in arms:
        if arm.massless:
            doubts.append(
                f"arm from {arm.root}: {first_names(arm.massless, 6)} move and have no mass in the URDF; the others alone move the centre "
                "of gravity. Add their <inertial>."
            )
        masses = [urdf.links[link].mass for link in arm.links if urdf.links[link].mass > 0.0]
        if len(masses) > 3 and len(set(masses)) == 1:
            doubts.append(f"arm from {arm.root}: all of its {len(masses)} links have {masses[0]:g} kg, as a placeholder has. Weigh them.")
        if arm.joints and arm.reach_m > 0.1 and _is_unlike(arm.mass_kg / arm.reach_m, _ARM_KG_PER_M):
            doubts.append(
                f"arm from {arm.root}: {arm.mass_kg:.3g} kg over a reach of {arm.reach_m:.2f} m; arms weigh {_range(_ARM_KG_PER_M)} kg "
                "per metre. Check its <inertial>s."
            )
    base = sum(link.mass for name, link in urdf.links.items() if not any(name in arm.links for arm in arms))
    if base > 0.0 and footprint_m2 > 0.0 and _is_unlike(base / footprint_m2, _BASE_KG_PER_M2):
        low, high = (footprint_m2 * bound for bound in _bounds(_BASE_KG_PER_M2))
        doubts.append(
            f"base: the URDF has {base:.3g} kg without arms; robots of this track and wheelbase weigh {low:.2g} to {high:.2g} kg. "
            "Weigh it and give --mass-kg: the centre of gravity moves by the arms' share of the mass."
        )
    return doubts


def _is_unlike(value: float, known: tuple[float, float]) -> bool:
    median, sigma = known
    return value <= 0.0 or abs(math.log(value / median)) > _UNLIKELY * sigma


def _bounds(known: tuple[float, float]) -> tuple[float, float]:
    """Range of two sigmas."""
    median, sigma = known
    return median * math.exp(-2.0 * sigma), median * math.exp(2.0 * sigma)


def _range(known: tuple[float, float]) -> str:
    low, high = _bounds(known)
    return f"{low:.1g} to {high:.2g}"


def write_urdf(urdf: Urdf, base_link: str, middle: tuple[float, float], names: Mapping[str, str], fixed: Iterable[str]) -> str:
    """``urdf`` as XML with what the centre of gravity needs: links with masses, and joints.

    ``names`` renames joints, as to those of a log. The joints ``fixed`` stand still, as wheels. The link `BODY` is added at ``middle``
    (2,) of ``base_link`` [m]. What is read back moves its centre of mass as ``urdf`` does.
    """
    still = {*fixed}
    root = ET.Element("robot", name="arms")
    for link in urdf.links.values():
        element = ET.SubElement(root, "link", name=link.name)
        if link.mass > 0.0:
            inertial = ET.SubElement(element, "inertial")
            ET.SubElement(inertial, "origin", xyz=_text(link.com))
            ET.SubElement(inertial, "mass", value=repr(link.mass))
    for joint in urdf.joints:
        _add_joint(root, joint if joint.name not in still else replace(joint, kind="fixed", mimic=None), names)
    ET.SubElement(root, "link", name=BODY)
    body = ET.SubElement(root, "joint", name=f"{BODY}_joint", type="fixed")
    ET.SubElement(body, "parent", link=base_link)
    ET.SubElement(body, "child", link=BODY)
    ET.SubElement(body, "origin", xyz=_text(np.array([*middle, 0.0])))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _add_joint(root: ET.Element, joint: Joint, names: Mapping[str, str]) -> None:
    element = ET.SubElement(root, "joint", name=names.get(joint.name, joint.name), type=joint.kind)
    ET.SubElement(element, "parent", link=joint.parent)
    ET.SubElement(element, "child", link=joint.child)
    R = joint.rotation
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    roll, yaw = math.atan2(R[2, 1], R[2, 2]), math.atan2(R[1, 0], R[0, 0])
    if math.hypot(R[0, 0], R[1, 0]) < 1e-9:  # straight up or down: roll and yaw turn about one axis
        roll, yaw = math.atan2(-R[1, 2], R[1, 1]), 0.0
    ET.SubElement(element, "origin", xyz=_text(joint.translation), rpy=_text(np.array([roll, pitch, yaw])))
    if not joint.moves:
        return
    ET.SubElement(element, "axis", xyz=_text(joint.axis))
    if math.isfinite(joint.lower) and math.isfinite(joint.upper):
        ET.SubElement(element, "limit", lower=repr(joint.lower), upper=repr(joint.upper))
    if joint.mimic is not None:
        mimic = joint.mimic
        ET.SubElement(
            element, "mimic", joint=names.get(mimic.joint, mimic.joint), multiplier=repr(mimic.multiplier), offset=repr(mimic.offset)
        )


def _text(numbers: FloatArray) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def static_position(urdf: Urdf, base_link: str, arms: Sequence[ArmChain]) -> tuple[FloatArray, float]:
    """(2,) centre of mass in ``base_link`` [m] and mass [kg] of all but the ``arms``, joints at 0. Raises `RobotError` for a mass of 0."""
    moving = {link for arm in arms for link in arm.links}
    own: dict[str, Link] = {name: link for name, link in urdf.links.items() if name not in moving and link.mass > 0.0}
    mass = sum(link.mass for link in own.values())
    if mass <= 0.0:
        raise RobotError(f"{urdf.source}: nothing but its arms has a mass.")
    poses = link_poses(urdf, base_link)
    moment = sum((link.mass * (poses[name][1] + poses[name][0] @ link.com) for name, link in own.items()), start=np.zeros(3))
    return np.asarray(moment[:2] / mass), mass
