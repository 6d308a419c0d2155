"""From a URDF to the arrays of a `Chain`: links that cannot move against each other become one body, idle joints are fixed."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from motion_models.center_of_gravity.kinematics import COLUMNS, COM, MASS, MULTIPLIER, OFFSET, ROTATION, TRANSLATION, Chain, Pose
from motion_models.center_of_gravity.urdf import Joint, Urdf
from motion_models.errors import RobotError
from motion_models.se2 import FloatArray

_NO_LEVER = 1e-12
"""First moment off the axis [kg m] below which turning a joint moves no mass (a balanced wheel)."""


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
