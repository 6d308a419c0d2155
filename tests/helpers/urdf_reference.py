"""A second way to a URDF's centre of mass, sharing nothing with the library: 4x4 matrices, recursion, scipy's rotations."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation


def _floats(element, attribute, default):
    return np.array([float(v) for v in (default if element is None else element.get(attribute, default)).split()])


def _origin(element):
    origin = element.find("origin")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", _floats(origin, "rpy", "0 0 0")).as_matrix()
    matrix[:3, 3] = _floats(origin, "xyz", "0 0 0")
    return matrix


def _position(root, joint, positions):
    mimic = joint.find("mimic")
    if mimic is None:
        return positions.get(joint.get("name"), 0.0)
    master = next(j for j in root.findall("joint") if j.get("name") == mimic.get("joint"))
    return float(mimic.get("multiplier", "1")) * _position(root, master, positions) + float(mimic.get("offset", "0"))


def link_poses(text, positions, base="base_link"):
    """4x4 pose of every link in the frame of ``base``."""
    root = ET.fromstring(text)
    joints = root.findall("joint")
    children = {j.find("child").get("link") for j in joints}
    top = next(link.get("name") for link in root.findall("link") if link.get("name") not in children)
    poses = {}

    def visit(name, pose):
        poses[name] = pose
        for joint in joints:
            if joint.find("parent").get("link") != name:
                continue
            motion, axis = np.eye(4), _floats(joint.find("axis"), "xyz", "1 0 0")
            if joint.get("type") in ("revolute", "continuous"):
                motion[:3, :3] = Rotation.from_rotvec(axis / np.linalg.norm(axis) * _position(root, joint, positions)).as_matrix()
            elif joint.get("type") == "prismatic":
                motion[:3, 3] = axis / np.linalg.norm(axis) * _position(root, joint, positions)
            visit(joint.find("child").get("link"), pose @ _origin(joint) @ motion)

    visit(top, np.eye(4))
    to_base = np.linalg.inv(poses[base])
    return {name: to_base @ pose for name, pose in poses.items()}


def center_of_mass(text, positions, base="base_link"):
    """(3,) centre of mass in the frame of ``base``, and the mass."""
    poses, mass, moment = link_poses(text, positions, base), 0.0, np.zeros(3)
    for link in ET.fromstring(text).findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        m = float(inertial.find("mass").get("value"))
        mass += m
        moment += m * (poses[link.get("name")] @ np.append(_origin(inertial)[:3, 3], 1.0))[:3]
    return moment / mass, mass
