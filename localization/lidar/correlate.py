"""Where in a window of poses a scan falls onto a map's points: Olson, "Real-time correlative scan matching", ICRA 2009."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from motion_models import se2
from motion_models.se2 import FloatArray


@dataclass(frozen=True, eq=False)
class Scores:
    """How many points of the scan fall onto the map, at each pose of a window."""

    poses: FloatArray
    """(K, 3)"""
    distances: FloatArray
    """(K,) squared Mahalanobis distance from the prior."""
    fractions: FloatArray
    """(K,) part of the scan's points on the map, 0 to 1."""


def correlate(
    scan: FloatArray, points: FloatArray, pose: FloatArray, cov: FloatArray, limits: FloatArray, step: float, gate: float
) -> Scores:
    """Try the poses around ``pose`` (3,) whose squared Mahalanobis distance by ``cov`` (3, 3) is below ``gate``, and that are within
    ``limits`` (3,) [m, m, rad], in steps that move no point of ``scan`` (N, 2) by much more than ``step`` [m].

    A point is on the map if one of ``points`` (M, 2) is within about ``step``: no pose can fall between two steps.
    """
    reach = float(np.quantile(np.hypot(scan[:, 0], scan[:, 1]), 0.8))
    turn = step / max(reach, 1.0)
    half = np.minimum(np.sqrt(gate * np.diag(cov)), limits)
    # offsets in the body frame of the prior's pose
    axes = [np.arange(-math.ceil(h / d), math.ceil(h / d) + 1) * d for h, d in zip(half, (step, step, turn), strict=True)]
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distances = np.einsum("ki,ij,kj->k", offsets, np.linalg.inv(cov), offsets)
    near = distances <= gate
    offsets, distances = offsets[near], distances[near]
    poses = np.empty_like(offsets)
    poses[:, :2] = se2.transform(pose, offsets[:, :2])
    poses[:, 2] = pose[2] + offsets[:, 2]
    origin, image = _raster(points, 0.5 * step, 2)
    fractions = np.empty(len(poses))
    _score(scan, poses, image, origin, 0.5 * step, fractions)
    return Scores(poses, distances, fractions)


def _raster(points: FloatArray, cell: float, dilation: int) -> tuple[FloatArray, NDArray[np.uint8]]:
    """The lower corner (2,) of an image, and the image: 1 in cells within ``dilation`` cells of a point."""
    origin = points.min(axis=0) - (dilation + 1) * cell
    shape = np.floor((points.max(axis=0) - origin) / cell).astype(int) + dilation + 2
    image = np.zeros(shape, np.uint8)
    _draw(points, image, origin, cell, dilation)
    return origin, image


@numba.njit(cache=True)
def _draw(points: FloatArray, image: NDArray[np.uint8], origin: FloatArray, cell: float, dilation: int) -> None:  # pragma: no cover
    for i in range(points.shape[0]):
        ix, iy = int((points[i, 0] - origin[0]) / cell), int((points[i, 1] - origin[1]) / cell)
        for jx in range(-dilation, dilation + 1):
            for jy in range(-dilation, dilation + 1):
                if jx * jx + jy * jy <= dilation * dilation:
                    image[ix + jx, iy + jy] = 1


@numba.njit(cache=True)
def _score(
    scan: FloatArray, poses: FloatArray, image: NDArray[np.uint8], origin: FloatArray, cell: float, fractions: FloatArray
) -> None:  # pragma: no cover
    for k in range(poses.shape[0]):
        c, s = math.cos(poses[k, 2]) / cell, math.sin(poses[k, 2]) / cell
        x0, y0 = (poses[k, 0] - origin[0]) / cell, (poses[k, 1] - origin[1]) / cell
        n = 0
        for i in range(scan.shape[0]):
            x, y = x0 + c * scan[i, 0] - s * scan[i, 1], y0 + s * scan[i, 0] + c * scan[i, 1]
            if x >= 0.0 and y >= 0.0 and x < image.shape[0] and y < image.shape[1]:
                n += image[int(x), int(y)]
        fractions[k] = n / scan.shape[0]
