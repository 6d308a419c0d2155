"""Loops of a drive with a 3D LiDAR: places that were visited before, found by map-closures and verified by registration.

Clouds of successive keyframes make a local map. MapClosures (Gupta et al., ICRA 2024) draws its density as seen from above and compares
features of these images, wherever the odometry has the robot. What it proposes is registered point to surface, coarse to fine, and is a
loop if the surfaces fit, if what stands upright stands at the same places in both maps, and if the odometry allows for it.

The extra `loops` brings map-closures. It draws the samples of its RANSAC without a seed: registration removes what that changes, down to a
part of its own noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from localization.errors import EstimatorError
from localization.lidar.cloud_map import SYSTEMATIC_COV, CloudMap, CloudMatch, thin
from localization.lidar.kiss_icp import choose_voxel_size
from localization.lidar.scan_matcher import MIN_PLACE_OVERLAP
from localization.trajectory import IntArray
from motion_models import se3
from motion_models.se2 import FloatArray
from motion_models.se3 import Transform3

_KEYFRAMES = 5
"""Keyframes whose clouds make a local map, as of loops in the plane."""
_APART = 15
"""Keyframes between both visits: map-closures itself skips three local maps."""
_ABOVE_M = 1.0
"""Height of a local map's origin above the robot's: map-closures takes for the ground what lies below the origin [m]."""
_MOST_TRIALS = 3
"""Proposals for a local map that are registered, those of the most inliers first."""
_COARSE = 4.0
"""Voxels of the first registration, in those of the second: proposals are off by 0.1 to 0.9 m and up to 0.1 rad, of voxels of 0.4 m."""
_COARSE_SIGMAS = np.array([1.0, 1.0, 0.5, 0.1, 0.1, 0.1])
_FINE_SIGMAS = np.array([0.3, 0.3, 0.3, 0.03, 0.03, 0.03])
"""Sigmas of the proposal and of the coarse registration [m, rad]."""
_MIN_OVERLAP = 0.8
"""Share of the points with a surface within 3 sigma of it: of true revisits it is 0.97 or more."""
_TALL_M = 1.0
"""Extent in height of columns in which something stands upright [m]: more than slopes of 20 deg have in a column of 2 voxels."""
_FEWEST_TALL = 8
"""Columns in which something stands upright in both maps, at least: ground alone fits in many places."""
_MOST_SIGMA = np.array([0.1, 0.1, 0.1, 0.02, 0.02, 0.02])
"""Sigmas of a registration that the scene leaves open [m, rad]."""
_GATE_FACTOR, _GATE_FLOOR = 9.0, np.diag([0.1, 0.1, 0.1, 0.03, 0.03, 0.03]) ** 2
"""A loop is within 3 sigma of 9 P + this, with the odometry's covariance P, as searches are in the plane [m^2, rad^2]."""


@dataclass(frozen=True, eq=False)
class CloudLoop:
    """Keyframe ``b`` was measured from keyframe ``a``, visited before."""

    a: int
    b: int
    delta: Transform3
    """(4, 4) ``a_T_b``."""
    cov: FloatArray
    """(6, 6) of its right perturbation."""


class _LocalMap(NamedTuple):
    """Clouds of successive keyframes."""

    key: int
    """Its keyframe in the middle."""
    keys: list[int]
    """All of them."""
    level: Transform3
    """(4, 4) ``map_T_key``: axes of the map are level, its origin is above that of the keyframe."""
    points: FloatArray
    """(N, 3) in the axes of the map [m]."""


def make_map_closures(cell: float) -> Any:
    """MapClosures for images with pixels of ``cell`` [m]. Raises `EstimatorError` where the extra is missing."""
    try:
        from map_closures.config import MapClosuresConfig
        from map_closures.map_closures import MapClosures
    except ImportError as error:
        raise EstimatorError(
            f"loops in space need the extra 'loops': pip install 'skidloc[loops]' ({error}). Or leave out "
            "--config.estimator.graph.cloud-loops."
        ) from error
    return MapClosures(MapClosuresConfig(density_map_resolution=cell))


def find_loops(
    clouds: Sequence[FloatArray], poses: FloatArray, relative_cov: Callable[[int, int], FloatArray], noise_m: float
) -> list[CloudLoop]:
    """Loops among keyframes with ``clouds``, (N, 3) each in the body frame, at ``poses`` (K, 4, 4), whose z axis is upright.

    ``relative_cov(a, b)`` (6, 6): covariance of the right perturbation of ``a_T_b`` by the odometry; ``noise_m``: sigma of a range.
    """
    with_cloud = [k for k, cloud in enumerate(clouds) if len(cloud)]
    if not with_cloud:
        return []
    cell = choose_voxel_size(np.asarray(clouds[with_cloud[0]]))
    closures, maps, found = make_map_closures(cell), {}, []
    for n in range(len(with_cloud) // _KEYFRAMES):
        new = _local_map(clouds, poses, with_cloud[n * _KEYFRAMES : (n + 1) * _KEYFRAMES], cell)
        maps[new.key] = new
        proposed = [(p.number_of_inliers, p.source_id, np.asarray(p.pose)) for p in closures.get_top_k_closures(new.key, new.points, -1)]
        proposed = [p for p in proposed if new.key - p[1] > _APART]
        for _, key, new_T_old in sorted(proposed, key=lambda p: (-p[0], p[1]))[:_MOST_TRIALS]:
            old = maps[key]
            loop = _verify(old, new, se3.inverse(new_T_old), cell, noise_m)
            if loop is not None and _is_within_gate(loop, poses, relative_cov(loop.a, loop.b)):
                A = se3.adjoint(se3.inverse(loop.delta))
                bent = _bending_cov(new, poses, relative_cov) + A @ _bending_cov(old, poses, relative_cov) @ A.T
                found.append(replace(loop, cov=loop.cov + bent))
                break
    return found


def _local_map(clouds: Sequence[FloatArray], poses: FloatArray, keys: list[int], cell: float) -> _LocalMap:
    key = keys[len(keys) // 2]
    level = np.eye(4)
    level[:3, :3] = se3.rotation(np.array([0.0, 0.0, -np.arctan2(poses[key][1, 0], poses[key][0, 0])])) @ poses[key][:3, :3]
    level[2, 3] = -_ABOVE_M
    map_T_world = level @ se3.inverse(poses[key])
    points = np.vstack([se3.transform(map_T_world @ poses[k], np.asarray(clouds[k], dtype=float)) for k in keys])
    return _LocalMap(key, keys, level, thin(points, cell))


def _bending_cov(of: _LocalMap, poses: FloatArray, relative_cov: Callable[[int, int], FloatArray]) -> FloatArray:
    """(6, 6) by which the clouds of a local map are off their places around its keyframe in the middle, in its axes: their mean."""
    total = np.zeros((6, 6))
    for k in of.keys:
        if k != of.key:
            A = se3.adjoint(se3.inverse(poses[of.key]) @ poses[k])
            total += A @ relative_cov(of.key, k) @ A.T
    return total / len(of.keys)


def _verify(old: _LocalMap, new: _LocalMap, old_T_new: Transform3, cell: float, noise_m: float) -> CloudLoop | None:
    """The loop by registration of ``new`` to ``old`` from ``old_T_new`` on; None where they do not fit."""
    coarse = _register(old.points, thin(new.points, _COARSE * cell), old_T_new, _COARSE * cell, noise_m, _COARSE_SIGMAS)
    match = _register(old.points, new.points, coarse.pose, cell, noise_m, _FINE_SIGMAS)
    is_open = (np.sqrt(np.diagonal(match.cov)) > _MOST_SIGMA).any()
    if is_open or match.overlap < _MIN_OVERLAP:
        return None
    agree, differ = compare_columns(old.points, se3.transform(match.measured, new.points), 2.0 * cell)
    if agree < _FEWEST_TALL or agree < MIN_PLACE_OVERLAP * (agree + differ):
        return None
    delta = se3.inverse(old.level) @ match.measured @ new.level
    A = se3.adjoint(se3.inverse(new.level))
    return CloudLoop(old.key, new.key, delta, A @ (match.cov + SYSTEMATIC_COV) @ A.T)


def _register(place: FloatArray, points: FloatArray, guess: Transform3, cell: float, noise_m: float, sigmas: FloatArray) -> CloudMatch:
    surfaces = CloudMap(cell, noise_m)
    surfaces.insert(np.eye(4), place)
    return surfaces.match(points, guess, np.diag(sigmas**2))


def compare_columns(old: FloatArray, new: FloatArray, cell: float) -> tuple[int, int]:
    """Columns of edge ``cell`` [m], seen in both clouds (N, 3) and (M, 3) in level axes, in which something stands upright in both, and in
    one of them alone; what is in the next column agrees as well."""
    seen, tall = zip(*(_columns(points, cell) for points in (old, new)), strict=True)
    agree = differ = 0
    for mine, others, seen_there in ((tall[0], tall[1], seen[1]), (tall[1], tall[0], seen[0])):
        around = others[:, None] + _AROUND
        is_there = np.isin(mine, around)
        agree += int(is_there.sum())
        differ += int((np.isin(mine, seen_there) & ~is_there).sum())
    return agree // 2, differ // 2


_COLUMNS = 1 << 20
_AROUND = np.array([i * _COLUMNS + j for i in (-1, 0, 1) for j in (-1, 0, 1)])
"""Keys of the columns around one, less its own."""


def _columns(points: FloatArray, cell: float) -> tuple[IntArray, IntArray]:
    """Keys of the columns with ``points``, and of those in which something stands upright."""
    i, j = np.floor(points[:, :2] / cell).astype(np.int64).T
    keys, at = np.unique(i * _COLUMNS + j, return_inverse=True)
    low, high = np.full(len(keys), np.inf), np.full(len(keys), -np.inf)
    np.minimum.at(low, at, points[:, 2])
    np.maximum.at(high, at, points[:, 2])
    return keys, keys[high - low > _TALL_M]


def _is_within_gate(loop: CloudLoop, poses: FloatArray, cov: FloatArray) -> bool:
    off = se3.local(se3.inverse(poses[loop.a]) @ poses[loop.b], loop.delta)
    return bool(off @ np.linalg.solve(_GATE_FACTOR * cov + _GATE_FLOOR, off) < 9.0)
