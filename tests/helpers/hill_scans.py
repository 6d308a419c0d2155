"""Scans of a 3D LiDAR on the hills of `tests.helpers.hills`: rays from each column's own pose to ground, tree trunks and walls."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from localization.events import Scan
from motion_models.robot import Mount
from motion_models.se2 import FloatArray
from tests.helpers.hills import HILLS, Ground, HillDrive

MOUNT = Mount(0.1, 0.0, 0.7)
_EXTENT_M, _CELL_M = 70.0, 0.1
_MAX_RANGE_M = 50.0
_STEEPEST = 0.45
"""More than the hills' steepest slope: how far a ray may go on per height above ground."""
_SWEEP_S, SWEEP_NS = 0.1, 100_000_000
COLUMNS, RINGS = 450, 16
HALF_FIELD_RAD = math.radians(15.0)
_CLEAR_M = 1.2
"""Trees keep this far from where the robot drives."""


@dataclass(frozen=True)
class Scene:
    """What stands on the hills, and their heights (n, n) on a grid of `_CELL_M` around the origin."""

    trees: FloatArray
    """(T, 4) x, y, radius, height above ground of the top [m]."""
    walls: FloatArray
    """(W, 5) x, y of both ends and the height of the top, in the world [m]."""
    heights: FloatArray


def make_scene(drive: HillDrive, seed: int, n_trees: int = 60, n_walls: int = 4, is_flat: bool = False, ground: Ground = HILLS) -> Scene:
    """Trees and walls on ``ground`` by chance, off the way of ``drive``; ``is_flat``: on the plane z = 0 instead."""
    rng = np.random.default_rng(seed)
    way = drive.positions[::25, :2]
    trees: list[list[float]] = []
    while len(trees) < n_trees:
        x, y = rng.uniform(-28.0, 28.0, 2)
        if np.hypot(way[:, 0] - x, way[:, 1] - y).min() > _CLEAR_M:
            trees.append([x, y, rng.uniform(0.1, 0.3), rng.uniform(3.0, 6.0)])
    sides = [(-24.0, -15.0, -24.0, 10.0), (-10.0, 25.0, 16.0, 25.0), (25.0, -8.0, 25.0, 14.0), (-12.0, -25.0, 8.0, -25.0)][:n_walls]
    axis = np.arange(-_EXTENT_M, _EXTENT_M + _CELL_M, _CELL_M)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    heights = np.zeros_like(x) if is_flat else ground.height(x, y)
    return Scene(np.array(trees).reshape(-1, 4), np.array([[*side, 5.0] for side in sides]).reshape(-1, 5), heights)


def scans(drive: HillDrive, scene: Scene, rings: int = RINGS, seed: int = 1, noise_m: float = 0.015) -> Iterator[Scan]:
    """Sweeps at 10 Hz, stamped at their begin, each column with its own time."""
    rng = np.random.default_rng(seed)
    seconds = (drive.stamps_ns - drive.stamps_ns[0]) * 1e-9
    turn = Slerp(seconds, Rotation.from_matrix(drive.rotations))
    elevations = np.linspace(-HALF_FIELD_RAD, HALF_FIELD_RAD, rings)
    azimuths = -math.pi + 2.0 * math.pi * np.arange(COLUMNS) / COLUMNS
    directions = np.stack(
        [
            np.outer(np.cos(azimuths), np.cos(elevations)),
            np.outer(np.sin(azimuths), np.cos(elevations)),
            np.broadcast_to(np.sin(elevations), (COLUMNS, rings)),
        ],
        axis=-1,
    )
    offsets, place = np.arange(COLUMNS) * _SWEEP_S / COLUMNS, np.array([MOUNT.x, MOUNT.y, MOUNT.z])
    for start in np.arange(0.0, seconds[-1] - _SWEEP_S, _SWEEP_S):
        times = start + offsets
        R = turn(times).as_matrix()
        origins = np.column_stack([np.interp(times, seconds, drive.positions[:, i]) for i in range(3)]) + R @ place
        ranges = _cast(origins, np.einsum("nij,nrj->nri", R, directions), scene.trees, scene.walls, scene.heights)
        ranges += noise_m * rng.normal(size=ranges.shape)
        hit = np.isfinite(ranges)
        points = directions[hit] * ranges[hit][:, None]
        stamp = int(drive.stamps_ns[0]) + round(start * 1e9)
        yield Scan(stamp, points, np.broadcast_to(offsets[:, None], hit.shape)[hit], "lidar_link", is_planar=False)


@numba.njit(cache=True)
def _height(heights, x, y):
    u, v = (x + _EXTENT_M) / _CELL_M, (y + _EXTENT_M) / _CELL_M
    i, j = min(max(int(u), 0), heights.shape[0] - 2), min(max(int(v), 0), heights.shape[1] - 2)
    a, b = u - i, v - j
    return (1 - a) * ((1 - b) * heights[i, j] + b * heights[i, j + 1]) + a * ((1 - b) * heights[i + 1, j] + b * heights[i + 1, j + 1])


@numba.njit(cache=True)
def _cast(origins, directions, trees, walls, heights):
    """(n, r) ranges of rays; infinite where nothing is hit."""
    out = np.full(directions.shape[:2], np.inf)
    for n in range(out.shape[0]):
        ox, oy, oz = origins[n]
        for r in range(out.shape[1]):
            dx, dy, dz = directions[n, r]
            nearest = _ground(heights, ox, oy, oz, dx, dy, dz)
            flat = dx * dx + dy * dy
            for k in range(trees.shape[0]):
                ex, ey, radius = ox - trees[k, 0], oy - trees[k, 1], trees[k, 2]
                half, rest = ex * dx + ey * dy, ex * ex + ey * ey - radius * radius
                square = half * half - flat * rest
                if square > 0.0:
                    t = (-half - math.sqrt(square)) / flat
                    if 0.3 < t < nearest and oz + t * dz < _height(heights, trees[k, 0], trees[k, 1]) + trees[k, 3]:
                        nearest = t
            for k in range(walls.shape[0]):
                ax, ay = walls[k, 0], walls[k, 1]
                bx, by = walls[k, 2] - ax, walls[k, 3] - ay
                across = dx * by - dy * bx
                if abs(across) > 1e-9:
                    t = ((ax - ox) * by - (ay - oy) * bx) / across
                    s = ((ax - ox) * dy - (ay - oy) * dx) / across
                    if 0.3 < t < nearest and 0.0 < s < 1.0 and oz + t * dz < walls[k, 4]:
                        nearest = t
            out[n, r] = nearest if nearest < _MAX_RANGE_M else np.inf
    return out


@numba.njit(cache=True)
def _ground(heights, ox, oy, oz, dx, dy, dz):
    t, before, was_above = 0.0, 0.0, 1.0
    while t < _MAX_RANGE_M:
        above = oz + t * dz - _height(heights, ox + t * dx, oy + t * dy)
        if above < 1e-4:
            return before + (t - before) * was_above / (was_above - above)
        before, was_above = t, above
        t += max(0.9 * above / (_STEEPEST + max(-dz, 0.0)), 1e-3 + 1e-3 * t)
    return np.inf
