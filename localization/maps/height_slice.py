"""A map in space as seen from above: what stands within a range of heights above the ground is a wall, and ground that was seen is free.

The ground is the lowest point of each column, and nowhere above a cone of 31 degrees over the ground around: a column in which a wall or
a crown alone was seen has none of its own. Below a column without points it is that of the nearest one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from localization.errors import MapError
from localization.maps.grid import FREE, Beams, Grid, cast_beams
from localization.maps.keyframe_map import KeyframeMap
from localization.trajectory import IntArray
from motion_models import se2, se3
from motion_models.se2 import FloatArray

HEIGHTS_M = (0.3, 1.8)
"""Above the ground: more than a robot drives over and a slope of 20 degrees rises in a column, and less than a robot needs [m]."""
_COLUMN_M = 0.5
"""Side of the columns in which the ground is found [m]."""
_STEEPEST = 0.6
"""Slope of the cones, 31 degrees: steeper than robots on wheels drive [-]."""
_FARTHEST_M = 10.0
"""Reach of the cones: a robot and walls of buildings are nearer to ground that was seen [m]."""
_PLANAR = [0, 1, 5]


class Ground(NamedTuple):
    """Height of the ground in columns."""

    heights: FloatArray
    """(W, H) [m]; x along the rows."""
    low: FloatArray
    """(2,) the middle of the first column [m]."""

    def above(self, points: FloatArray) -> FloatArray:
        """(N,) how high ``points`` (N, 3) of the map lie above the ground [m], which is linear between the columns."""
        at = (points[:, :2] - self.low) / _COLUMN_M
        below = ndimage.map_coordinates(self.heights, at.T, order=1, mode="nearest")
        return np.asarray(points[:, 2] - below)


def find_ground(points: FloatArray) -> Ground:
    """The ground below ``points`` (N, 3) with z up, one at least [m]."""
    index = np.floor(points[:, :2] / _COLUMN_M).astype(np.int64)
    first = index.min(axis=0)
    heights = np.full(index.max(axis=0) - first + 1, np.inf)
    np.minimum.at(heights, tuple((index - first).T), points[:, 2])
    is_unseen = np.isinf(heights)
    rise = _STEEPEST * _COLUMN_M * np.array([[math.sqrt(2.0), 1.0, math.sqrt(2.0)], [1.0, 0.0, 1.0], [math.sqrt(2.0), 1.0, math.sqrt(2.0)]])
    for _ in range(round(_FARTHEST_M / _COLUMN_M)):
        padded = np.pad(heights, 1, constant_values=np.inf)
        n, m = heights.shape
        heights = np.min([padded[i : i + n, j : j + m] + rise[i, j] for i in range(3) for j in range(3)], axis=0)
    nearest = ndimage.distance_transform_edt(is_unseen, return_distances=False, return_indices=True)
    return Ground(heights[tuple(nearest)], (first + 0.5) * _COLUMN_M)


class HeightSlice:
    """The part of a map within a range of heights above the ground, as `keyframes` of planar scans and as `grid`."""

    def __init__(self, mapped: KeyframeMap, heights: tuple[float, float] = HEIGHTS_M) -> None:
        """``heights``: lowest and highest of what is a wall [m]. Raises `MapError` where nothing stands there."""
        if not 0.0 <= heights[0] < heights[1] < math.inf:
            raise MapError(
                f"heights {heights[0]:g} to {heights[1]:g} m are no range above the ground. Give the lower one first, as 0.3 1.8."
            )
        points, keys = mapped.points_in_map(), np.repeat(np.arange(len(mapped.poses)), mapped.counts)
        if not len(points):
            raise MapError("the map has no points, so there is nothing to draw. Build it from a log with clouds of a 3D LiDAR.")
        above = find_ground(points).above(points)
        is_low, is_wall = above <= heights[1], (above >= heights[0]) & (above <= heights[1])
        if not is_wall.any():
            raise MapError(
                f"nothing stands between {heights[0]:g} and {heights[1]:g} m above the ground, so a planar grid would be empty. Give other "
                "--heights, or use the points (map.ply)."
            )
        self._beams = Beams(mapped.sensors_in_map()[:, :2], points[is_low, :2], keys[is_low])
        self._is_wall = is_wall[is_low]
        self.keyframes = self._from_above(mapped, points[is_wall, :2], keys[is_wall])
        """The map as one of planar scans."""

    def grid(self, resolution: float, free: float = FREE) -> Grid:
        """Walls and free ground, as `grid.draw_grid` has them. Raises `MapError` for too many cells."""
        return cast_beams(self._beams, self._is_wall, resolution, free)

    @staticmethod
    def _from_above(mapped: KeyframeMap, walls: FloatArray, keys: IntArray) -> KeyframeMap:
        yaws = np.arctan2(mapped.poses[:, 1, 0], mapped.poses[:, 0, 0])
        level = np.array([np.kron(np.eye(2), se3.rotation(np.array([0.0, 0.0, -yaw]))) for yaw in yaws])
        level = level @ np.array([np.kron(np.eye(2), R) for R in mapped.poses[:, :3, :3]])
        poses = np.column_stack([mapped.poses[:, :2, 3], yaws])
        inverse = se2.inverse(poses)
        return KeyframeMap(
            stamps_ns=mapped.stamps_ns,
            poses=poses,
            covariances=(level @ mapped.covariances @ level.swapaxes(1, 2))[:, _PLANAR][:, :, _PLANAR],
            points=se2.transform(inverse[keys], walls).astype(np.float32),
            counts=np.bincount(keys, minlength=len(poses)),
            sensors=se2.transform(inverse, mapped.sensors_in_map()[:, :2]),
            edges=mapped.edges,
            edge_deltas=np.zeros((len(mapped.edges), 3)),
            edge_information=np.zeros((len(mapped.edges), 3, 3)),
            edge_is_loop=mapped.edge_is_loop,
        )
