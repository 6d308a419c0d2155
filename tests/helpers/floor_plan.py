"""Maps and scans of floor plans made of wall segments, by intersecting rays with each."""

from __future__ import annotations

import itertools
import math

import numpy as np

from localization.maps import KeyframeMap
from motion_models import se2


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    """Four walls."""
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


OFFICE = np.array(
    [
        *box(0, 0, 12, 8),
        (5, 0, 5, 3),
        (5, 4.2, 5, 8),
        (8, 3, 12, 3),
        *box(2, 5.5, 3, 6.5),
        *box(9, 4.5, 9.6, 6),
        (0, 2, 1.5, 2),
        *box(6.2, 0.8, 7, 1.2),
    ],
    dtype=float,
)
"""Walls (W, 4) as x0, y0, x1, y1 [m]."""
HALL = np.array([*box(0, 0, 14, 6), *box(4, 2, 4.5, 2.5), *box(9, 4, 9.5, 4.5), (7, 0, 7, 2.2), (2, 6, 3.5, 4)], dtype=float)
"""Another building."""


def scan(walls: np.ndarray, pose: np.ndarray, beams: int = 180, noise: float = 0.01, seed: int = 0) -> np.ndarray:
    """(n, 2) in the body frame: where ``beams`` all around end on ``walls`` within 8 m."""
    angles = 2.0 * math.pi * np.arange(beams) / beams
    d = np.column_stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])])[:, None]
    a, b = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    cross = d[..., 0] * b[:, 1] - d[..., 1] * b[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / cross
        along = (a[:, 0] * d[..., 1] - a[:, 1] * d[..., 0]) / cross
    reach = np.where((reach > 0.0) & (along >= 0.0) & (along <= 1.0), reach, np.inf).min(axis=1)
    seen = reach < 8.0
    reach = reach[seen] + noise * np.random.default_rng(seed).standard_normal(seen.sum())
    return np.column_stack([reach * np.cos(angles[seen]), reach * np.sin(angles[seen])])


def path(*corners: tuple[float, float], step: float = 0.5) -> np.ndarray:
    """(K, 3) poses along the lines between ``corners``, ahead."""
    poses = []
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        n = max(round(math.hypot(x1 - x0, y1 - y0) / step), 1)
        yaw = math.atan2(y1 - y0, x1 - x0)
        poses += [(x0 + (x1 - x0) * i / n, y0 + (y1 - y0) * i / n, yaw) for i in range(n)]
    return np.array(poses)


TOUR = path(
    (1, 1), (4, 1), (4, 3.6), (6, 3.6), (7.5, 6.5), (11, 7), (11, 4), (6, 3.6), (6, 2), (11, 2), (6, 3.6), (1, 4), (1, 7), (4, 7), step=0.7
)
"""Through the office."""


def make_map(walls: np.ndarray = OFFICE, poses: np.ndarray = TOUR) -> KeyframeMap:
    """A map by scans from ``poses`` (K, 3)."""
    scans = [scan(walls, pose, seed=k) for k, pose in enumerate(poses)]
    n = len(poses)
    return KeyframeMap(
        stamps_ns=np.arange(n) * 10**9,
        poses=poses,
        covariances=np.tile(np.diag([0.02, 0.02, 0.005]) ** 2, (n, 1, 1)),
        points=np.vstack(scans).astype(np.float32),
        counts=np.array([len(points) for points in scans]),
        sensors=np.zeros((n, 2)),
        edges=np.empty((0, 2), np.int64),
        edge_deltas=np.empty((0, 3)),
        edge_information=np.empty((0, 3, 3)),
        edge_is_loop=np.zeros(0, dtype=bool),
    )


def moves(poses: np.ndarray) -> np.ndarray:
    """(K, 3) the motion to each of ``poses`` (K, 3) since the one before."""
    return np.vstack([np.zeros((1, 3)), [se2.between(a, b) for a, b in itertools.pairwise(poses)]])
