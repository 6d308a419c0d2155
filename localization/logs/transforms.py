"""Sensor mounts: the log's fixed transforms, chained down from the body frame."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from localization.logs.decode import frame_name
from localization.messages import Message, message
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

_ROOTS = ("base_link", "base_footprint")
_WORLDS = {"map", "odom", "world", "earth"}
_MAX_CHANGE = 1e-6
_AGREE_M, _AGREE_RAD = 0.01, math.radians(0.5)
"""Two chains to a frame that differ by less agree: drivers round, and publish a robot's model beside their own mounts."""
_MIN_NORM, _MAX_NORM = 0.5, 2.0
"""Norms of quaternions that are accepted as rotations: drivers round, and some are typed by hand with two digits."""

Edges = dict[tuple[str, str], FloatArray]


class FixedTransforms:
    """Collects transforms and keeps those that never change."""

    def __init__(self) -> None:
        self._edges: Edges = {}
        self._fixed: set[tuple[str, str]] = set()
        self._moving: set[tuple[str, str]] = set()
        self._contradictions: dict[str, Message] = {}
        self._no_rotations: dict[str, Message] = {}

    def add(self, received: Any, *, is_static: bool) -> None:
        """Insert a TFMessage. On a static topic the last transform counts; on /tf one that changes is no mount."""
        for transform in received.transforms:
            edge = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            matrix = _matrix(transform.transform)
            if matrix is None and is_static and _is_unfilled(transform.transform):
                matrix = _translation(transform.transform)
                self._no_rotations[edge[1]] = message("transforms.zeros", parent=edge[0], frame=edge[1])
            if matrix is None or edge[0] == edge[1]:
                if is_static and matrix is None:
                    self._no_rotations[edge[1]] = message("transforms.no_rotation", parent=edge[0], frame=edge[1])
                elif is_static:
                    self._no_rotations[edge[1]] = message("transforms.own_parent", parent=edge[0], frame=edge[1])
                continue
            before = self._edges.get(edge)
            if is_static:
                if edge in self._fixed and before is not None and not _agree(before, matrix):
                    self._contradictions.setdefault(edge[1], message("transforms.two_poses", parent=edge[0], frame=edge[1]))
                self._fixed.add(edge)
            elif edge in self._fixed:
                continue
            elif before is not None and np.abs(before - matrix).max() > _MAX_CHANGE:
                self._moving.add(edge)
            self._edges[edge] = matrix

    def frames(self) -> set[str]:
        """Names of all frames so far."""
        return {frame for edge in self._edges for frame in edge}

    def mounts(self, body: str | None = None) -> dict[str, Mount]:
        """Pose in the body frame of every frame that is fixed to it, by name. ``body``: its name where it is not one of the usual."""
        neighbours: dict[str, list[tuple[str, FloatArray]]] = {}
        for (parent, child), parent_T_child in sorted(self._edges.items(), key=lambda e: e[0]):
            if (parent, child) not in self._moving:
                neighbours.setdefault(parent, []).append((child, parent_T_child))
                upwards = neighbours.setdefault(child, [])
                if (parent, child) in self._fixed:  # a fixed transform from the world is a robot that stands still
                    upwards.append((parent, np.asarray(np.linalg.inv(parent_T_child), dtype=float)))
        root = body if body in neighbours else _root(neighbours)
        if root is None:
            return {}
        poses = {root: np.eye(4)}
        queue = [root]
        while queue:
            frame = queue.pop(0)
            for other, frame_T_other in neighbours[frame]:
                if other not in poses and other not in _WORLDS:
                    poses[other] = poses[frame] @ frame_T_other
                    queue.append(other)
        self._compare(poses)
        return {frame: mount_of(pose) for frame, pose in poses.items()}

    def contradictions(self) -> dict[str, Message]:
        """Frames whose poses in the log contradict each other, as found by `mounts`, with a message about each."""
        return dict(self._contradictions)

    def describe_moving(self, frames: Iterable[str]) -> list[Message]:
        """Sentences about those of ``frames`` that move against the body, such as a LiDAR's on a pan joint."""
        moving = {child: parent for parent, child in self._moving if parent not in _WORLDS}
        return [message("transforms.moving", frame=frame, parent=moving[frame]) for frame in sorted(frames) if frame in moving]

    def warnings(self) -> list[Message]:
        """Sentences about transforms that could not be used, or that contradict each other."""
        return [*self._contradictions.values(), *self._no_rotations.values()]

    def _compare(self, poses: dict[str, FloatArray]) -> None:
        """Check that all chains to a frame (of two parents, or in a cycle) give one pose."""
        for (parent, child), parent_T_child in sorted(self._edges.items(), key=lambda e: e[0]):
            if (
                (parent, child) in self._fixed
                and parent in poses
                and child in poses
                and not _agree(poses[parent] @ parent_T_child, poses[child])
            ):
                self._contradictions.setdefault(child, message("transforms.two_chains", parent=parent, frame=child))


def _agree(one: FloatArray, other: FloatArray) -> bool:
    turned = np.linalg.norm(one[:3, :3] - other[:3, :3]) / math.sqrt(2.0)  # 2 sin of half the angle between them
    return bool(np.linalg.norm(one[:3, 3] - other[:3, 3]) <= _AGREE_M and turned <= _AGREE_RAD)


def _root(frames: Iterable[str]) -> str | None:
    """The body frame; of a robot with a name before its frames, its own."""
    names = sorted(frames)
    for wanted in _ROOTS:
        if wanted in names:
            return wanted
    for wanted in _ROOTS:
        prefixed = [name for name in names if name.endswith("/" + wanted)]
        if len(prefixed) == 1:
            return prefixed[0]
    return None


def _matrix(transform: Any) -> FloatArray | None:
    """(4, 4) of a geometry_msgs/Transform; None if it is none."""
    t, q = transform.translation, transform.rotation
    values = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w], dtype=float)
    norm = np.linalg.norm(values[3:])
    if not np.isfinite(values).all() or not _MIN_NORM <= norm <= _MAX_NORM:
        return None
    x, y, z, w = values[3:] / norm
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = values[:3]
    return matrix


def _is_unfilled(transform: Any) -> bool:
    """Whether its rotation was left at zeros, and its translation is one."""
    t, q = transform.translation, transform.rotation
    return bool(np.isfinite([t.x, t.y, t.z]).all()) and (q.x, q.y, q.z, q.w) == (0.0, 0.0, 0.0, 0.0)


def _translation(transform: Any) -> FloatArray:
    """(4, 4) of a geometry_msgs/Transform without its rotation."""
    matrix = np.eye(4)
    matrix[:3, 3] = transform.translation.x, transform.translation.y, transform.translation.z
    return matrix


def mount_of(pose: FloatArray) -> Mount:
    """The mount of a pose (4, 4). At a pitch of a right angle, where roll and yaw are one, the roll is zero."""
    r = pose[:3, :3]
    pitch = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    if math.hypot(r[0, 0], r[1, 0]) > 1e-9:
        roll, yaw = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
    else:
        roll, yaw = 0.0, math.atan2(-r[0, 1], r[1, 1])
    # Adding zero turns -0.0 into 0.0.
    return Mount(*(float(value) + 0.0 for value in (*pose[:3, 3], roll, pitch, yaw)))
