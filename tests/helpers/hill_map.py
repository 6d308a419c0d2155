"""A map of hills in space, by true poses and clouds of a robot that stands there."""

from __future__ import annotations

import itertools
import math

import numpy as np

from localization.maps import KeyframeMap
from localization.maps.keyframe_map import in_units
from motion_models import se3
from motion_models.robot_file import load_robot
from tests.helpers.hill_scans import MOUNT, Scene, make_scene, scans
from tests.helpers.hills import HillDrive, gradient, terrain

WAY = tuple((1.0 * i, 0.5 * i, 0.3 * i) for i in range(-4, 5))
"""x, y [m] and yaw [rad] of the keyframes."""


def on_hills(x: float, y: float, yaw: float) -> np.ndarray:
    """(4, 4) a body that stands on the hills, its z axis along their normal."""
    dx, dy = gradient(x, y)
    up = np.array([-dx, -dy, 1.0]) / math.sqrt(1.0 + dx * dx + dy * dy)
    ahead = np.array([math.cos(yaw), math.sin(yaw), dx * math.cos(yaw) + dy * math.sin(yaw)])
    ahead /= np.linalg.norm(ahead)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([ahead, np.cross(up, ahead), up])
    pose[:3, 3] = x, y, float(terrain(np.array([x]), np.array([y]))[0])
    return pose


def scene_around(way: np.ndarray, seed: int = 3) -> Scene:
    """Trees and walls, off a way (N, 2)."""
    return make_scene(_standing(np.eye(4), np.repeat(way, 25, axis=0)), seed)


def cloud_at(pose: np.ndarray, scene: Scene, seed: int = 1) -> np.ndarray:
    """(N, 3) in the body frame, of a robot that stands at ``pose`` (4, 4)."""
    (cloud,) = scans(_standing(pose, np.tile(pose[:2, 3], (2, 1))), scene, seed=seed)
    return cloud.points + np.array([MOUNT.x, MOUNT.y, MOUNT.z])


def _standing(pose: np.ndarray, way: np.ndarray) -> HillDrive:
    n = len(way)
    positions = np.tile(pose[:3, 3], (n, 1))
    positions[:, :2] = way
    stamps = np.linspace(0, 150_000_000, n).astype(np.int64)
    return HillDrive(load_robot("husky_a200"), {}, [], stamps, positions, np.tile(pose[:3, :3], (n, 1, 1)))


def make_map(scene: Scene, way: tuple[tuple[float, float, float], ...] = WAY, sigma: float = 1e-3) -> KeyframeMap:
    """Keyframes along ``way``, tied in a row, with covariances of ``sigma`` [m, rad]."""
    poses = np.array([on_hills(*place) for place in way])
    points, counts = in_units([cloud_at(pose, scene, seed) for seed, pose in enumerate(poses)])
    n = len(poses)
    return KeyframeMap(
        stamps_ns=np.arange(n) * 10**9,
        poses=poses,
        covariances=np.tile(sigma**2 * np.eye(6), (n, 1, 1)),
        points=points,
        counts=counts,
        sensors=np.tile([MOUNT.x, MOUNT.y, MOUNT.z], (n, 1)),
        edges=np.column_stack([np.arange(n - 1), np.arange(1, n)]),
        edge_deltas=np.array([se3.inverse(a) @ b for a, b in itertools.pairwise(poses)]),
        edge_information=np.tile(1e4 * np.eye(6), (n - 1, 1, 1)),
        edge_is_loop=np.zeros(n - 1, dtype=bool),
    )
