"""A map of a square room, by formulas of its own."""

from __future__ import annotations

import itertools
import math

import numpy as np

from localization.maps import KeyframeMap, SavedMap
from motion_models import se2

HALF = 2.0
"""Walls are at x, y = -HALF and HALF [m]."""
SENSOR = np.array([0.1, 0.0])
POSES = np.array([[0.0, 0.0, 0.0], [0.5, -0.25, 0.7], [-0.5, 0.5, -2.0]])


def scan(pose: np.ndarray, beams: int = 720) -> np.ndarray:
    """(beams, 2) where beams of the sensor end on the walls, in the body frame."""
    x, y = se2.transform(pose, SENSOR)
    angles = 2.0 * math.pi * (np.arange(beams) + 0.5) / beams
    c, s = np.cos(angles), np.sin(angles)
    reach = np.minimum((np.sign(c) * HALF - x) / c, (np.sign(s) * HALF - y) / s)
    return se2.transform(se2.inverse(pose), np.column_stack([x + reach * c, y + reach * s]))


def make_map(poses: np.ndarray = POSES) -> KeyframeMap:
    """Keyframes at ``poses`` (K, 3), tied in a row."""
    n = len(poses)
    scans = [scan(pose) for pose in poses]
    return KeyframeMap(
        stamps_ns=np.arange(n) * 10**9,
        poses=poses,
        covariances=np.tile(1e-4 * np.eye(3), (n, 1, 1)),
        points=np.vstack(scans).astype(np.float32),
        counts=np.array([len(points) for points in scans]),
        sensors=np.tile(SENSOR, (n, 1)),
        edges=np.column_stack([np.arange(n - 1), np.arange(1, n)]),
        edge_deltas=np.array([se2.between(a, b) for a, b in itertools.pairwise(poses)]).reshape(-1, 3),
        edge_information=np.tile(1e4 * np.eye(3), (n - 1, 1, 1)),
        edge_is_loop=np.zeros(n - 1, dtype=bool),
    )


def saved() -> SavedMap:
    """The map with a provenance."""
    return SavedMap(make_map(), {"log": "room.mcap", "robot": "vaultbot"})
