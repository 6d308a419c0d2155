"""From a scan to points of the body at one moment: deskewing, and the walls of a 3D cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from localization.events import Scan
from motion_models import se2
from motion_models.compiled import kernel
from motion_models.robot import Mount
from motion_models.se2 import FloatArray, Twist2

_WALL_CELL_M = 0.2
"""Cell in which a cloud has to span a height to be a wall [m]."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Points (N, 3) of one sweep, each in the body frame of its own moment [m]."""

    points: FloatArray
    times: FloatArray
    """(N,) when each point was measured, after the middle of the sweep [s]; (0,) if all at once."""
    is_planar: bool = True

    @classmethod
    def from_scan(cls, scan: Scan, mount: Mount, min_range_m: float = 0.0, max_range_m: float = math.inf) -> Sweep:
        """``scan`` in the body frame. Points that are not finite are left out, and those nearer to the body's origin than ``min_range_m``
        or farther than ``max_range_m`` [m]."""
        points, times = scan.points, scan.times_from_middle
        is_finite = np.isfinite(points).all(axis=1)
        if not is_finite.all():
            points, times = points[is_finite], times[is_finite] if len(times) else times
        points = points @ mount.rotation.T + (mount.x, mount.y, mount.z)
        r2 = np.einsum("ni,ni->n", points, points)
        kept = (r2 >= min_range_m**2) & (r2 <= max_range_m**2)
        if not kept.all():
            points, times = points[kept], times[kept] if len(times) else times
        return cls(points, times, scan.is_planar)

    def deskew(self, twist: Twist2) -> FloatArray:
        """(N, 3) the points in the body frame at the middle of the sweep, during which the body moves with constant ``twist`` (3,).

        Each point's own time is used, so that a sweep that fills part of the scan period is not over-corrected. About the middle, an error
        of the twist cancels to first order; about the start it would read as yaw.
        """
        if not len(self.times) or not np.any(twist):
            return self.points
        points = np.empty_like(self.points)
        _move(self.points, self.times, twist, points)
        return points

    def deskew_in_space(self, velocity: FloatArray, turns: FloatArray) -> FloatArray:
        """(N, 3) as `deskew`, of a body that moves with constant ``velocity`` (3,) in its own axes [m/s], but turns by ``turns`` (N, 3)
        from the middle to each point's time [rad]: a robot that rocks on its wheels does not turn at a constant rate within a sweep."""
        if not len(self.times):
            return self.points
        points = np.empty_like(self.points)
        _move_in_space(self.points, np.outer(self.times, velocity), turns, points)
        return points

    def project(self, points: FloatArray) -> FloatArray:
        """(M, 2) what of the deskewed ``points`` (N, 3) is matched in the plane: a planar scan as it is, of a cloud the walls."""
        return self.project_with_times(points)[0]

    def project_with_times(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """`project`, and when each of these points was measured, after the middle of the sweep (M,) [s]; (0,) without times."""
        if self.is_planar:
            return np.ascontiguousarray(points[:, :2]), self.times
        walls = extract_walls(np.column_stack([points, self.times]) if len(self.times) else points, _WALL_CELL_M)
        return np.ascontiguousarray(walls[:, :2]), walls[:, 2:].ravel()

    @property
    def duration_s(self) -> float:
        """From the first to the last point [s]."""
        return float(np.ptp(self.times)) if len(self.times) else 0.0

    def displacement(self, twist: Twist2) -> float:
        """How far an error of ``twist`` (3,) moves points of the sweep against each other [m]."""
        if not len(self.times):
            return 0.0
        reach = float(np.median(np.hypot(self.points[:, 0], self.points[:, 1])))
        return self.duration_s * (math.hypot(twist[0], twist[1]) + abs(float(twist[2])) * reach)


def extract_walls(points: FloatArray, cell: float, min_height: float = 0.3) -> FloatArray:
    """(M, 2) the upright structure in a 3D cloud ``points`` (N, 3): one mean point for each ``cell`` [m] that spans ``min_height`` [m].

    Floors and ceilings span no height in a cell; walls, trees and poles do. What is left is a planar scan. Further columns (N, 3 + k) are
    averaged as well (M, 2 + k).
    """
    if len(points) == 0:
        return np.empty((0, points.shape[1] - 1))
    index = np.floor(points[:, :2] / cell).astype(np.int64)
    order = np.lexsort((index[:, 1], index[:, 0]))
    is_first = np.any(np.diff(index[order], axis=0, prepend=index[order[:1]] - 1) != 0, axis=1)
    starts = np.flatnonzero(is_first)
    ordered = points[order]
    heights = np.maximum.reduceat(ordered[:, 2], starts) - np.minimum.reduceat(ordered[:, 2], starts)
    means = np.add.reduceat(np.delete(ordered, 2, axis=1), starts) / np.diff(starts, append=len(points))[:, None]
    return np.asarray(means[heights >= min_height])


@kernel
def _move(points: FloatArray, times: FloatArray, twist: Twist2, out: FloatArray) -> None:
    """Fill ``out`` (N, 3) with ``points`` after the motion at ``twist`` (3,) for ``times`` (N,)."""
    for i in range(points.shape[0]):
        t = times[i]
        x, y, yaw = se2.scalar_exp((t * twist[0], t * twist[1], t * twist[2]))
        c, s = math.cos(yaw), math.sin(yaw)
        out[i, 0] = x + c * points[i, 0] - s * points[i, 1]
        out[i, 1] = y + s * points[i, 0] + c * points[i, 1]
        out[i, 2] = points[i, 2]


@kernel
def _move_in_space(points: FloatArray, ways: FloatArray, turns: FloatArray, out: FloatArray) -> None:
    """Fill ``out`` (N, 3) with ``points`` after ``ways`` in the body's axes (N, 3) and ``turns`` (N, 3), to second order in the turns."""
    for i in range(points.shape[0]):
        x, y, z, a, b, c = ways[i, 0], ways[i, 1], ways[i, 2], turns[i, 0], turns[i, 1], turns[i, 2]
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        qx, qy, qz = b * pz - c * py, c * px - a * pz, a * py - b * px
        rx, ry, rz = b * qz - c * qy, c * qx - a * qz, a * qy - b * qx
        out[i, 0] = px + qx + 0.5 * rx + x + 0.5 * (b * z - c * y)
        out[i, 1] = py + qy + 0.5 * ry + y + 0.5 * (c * x - a * z)
        out[i, 2] = pz + qz + 0.5 * rz + z + 0.5 * (a * y - b * x)
