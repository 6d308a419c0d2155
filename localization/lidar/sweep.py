"""From a scan to points in the body frame at one moment, and from a 3D cloud to the walls in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from localization.events import Scan
from motion_models import se2
from motion_models.robot import Mount
from motion_models.se2 import FloatArray


@dataclass(frozen=True, eq=False)
class Sweep:
    """A scan's points (N, 3), each in the body frame of its own moment, ``offsets`` (N,) [s] after the stamp, or (0,) if all are of it."""

    points: FloatArray
    offsets: FloatArray
    is_planar: bool = True

    @classmethod
    def of(cls, scan: Scan, mount: Mount) -> Sweep:
        """Points that are not finite are left out."""
        points, offsets = np.empty((len(scan.points), 3)), scan.offsets
        if not _transform(scan.points, mount.rotation(), mount.x, mount.y, mount.z, points):
            is_finite = np.isfinite(points).all(axis=1)
            points, offsets = points[is_finite], offsets[is_finite] if len(offsets) else offsets
        return cls(points, offsets, scan.is_planar)

    def at_stamp(self, twist: FloatArray) -> FloatArray:
        """(N, 3) in the body frame as it was at the stamp.

        Each point is moved from where the body was when it was measured, at constant ``twist`` (3,) from the stamp on: the true time of
        each point is used, so a sweep that fills only part of the scan period is not over-corrected.
        """
        if not len(self.offsets) or not np.any(twist):
            return self.points
        points = np.empty_like(self.points)
        _carry(self.points, self.offsets, twist, points)
        return points

    @property
    def lateness(self) -> float:
        """How long after the stamp a point is seen, in the mean [s]."""
        return float(self.offsets.mean()) if len(self.offsets) else 0.0

    def shift(self, twist: FloatArray) -> float:
        """How far an error of the motion by ``twist`` (3,) moves the points against each other [m]."""
        if not len(self.offsets):
            return 0.0
        r2 = self.points[:, 0] ** 2 + self.points[:, 1] ** 2
        reach = math.sqrt(np.partition(r2, len(r2) // 2)[len(r2) // 2])  # the median, ten times as fast as by its name
        return float(np.ptp(self.offsets)) * (math.hypot(twist[0], twist[1]) + abs(float(twist[2])) * reach)


def body_points(scan: Scan, mount: Mount, twist: FloatArray) -> FloatArray:
    """(N, 3) points of ``scan`` in the body frame as it was at the scan's stamp, if it has moved with ``twist`` (3,) since."""
    return Sweep.of(scan, mount).at_stamp(twist)


def walls(points: FloatArray, cell: float, min_height: float = 0.3) -> FloatArray:
    """(M, 2) the upright structure in a 3D cloud ``points`` (N, 3): one mean point for each ``cell`` [m] that spans ``min_height`` [m].

    Floors and ceilings span no height in a cell; walls, trees and poles do. What is left is a planar scan.
    """
    if len(points) == 0:
        return np.empty((0, 2))
    index = np.floor(points[:, :2] / cell).astype(np.int64)
    order = np.lexsort((index[:, 1], index[:, 0]))
    out = np.empty((len(points), 2))
    n = _walls(points, index, order, min_height, out)
    return out[:n]


@numba.njit(cache=True)
def _transform(points: FloatArray, R: FloatArray, x: float, y: float, z: float, out: FloatArray) -> bool:  # pragma: no cover
    """Fills ``out`` (N, 3) with ``points`` turned by ``R`` and moved; whether all are finite."""
    checked = 0.0
    for i in range(points.shape[0]):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        out[i, 0] = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + x
        out[i, 1] = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + y
        out[i, 2] = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + z
        checked += 0.0 * (a + b + c)
    return checked == 0.0


@numba.njit(cache=True)
def _carry(points: FloatArray, offsets: FloatArray, twist: FloatArray, out: FloatArray) -> None:  # pragma: no cover
    """Fills ``out`` (N, 3) with ``points`` where they are after the motion at ``twist`` (3,) for their ``offsets`` (N,)."""
    for i in range(points.shape[0]):
        t = offsets[i]
        x, y, yaw = se2.scalar_exp((t * twist[0], t * twist[1], t * twist[2]))
        c, s = math.cos(yaw), math.sin(yaw)
        out[i, 0] = x + c * points[i, 0] - s * points[i, 1]
        out[i, 1] = y + s * points[i, 0] + c * points[i, 1]
        out[i, 2] = points[i, 2]


@numba.njit(cache=True)
def _walls(points: FloatArray, index: np.ndarray, order: np.ndarray, min_height: float, out: FloatArray) -> int:  # pragma: no cover
    n, i = 0, 0
    while i < order.shape[0]:
        first = order[i]
        low, high, x, y, count = math.inf, -math.inf, 0.0, 0.0, 0
        while i < order.shape[0] and index[order[i], 0] == index[first, 0] and index[order[i], 1] == index[first, 1]:
            p = order[i]
            low, high = min(low, points[p, 2]), max(high, points[p, 2])
            x, y, count = x + points[p, 0], y + points[p, 1], count + 1
            i += 1
        if high - low >= min_height:
            out[n, 0], out[n, 1] = x / count, y / count
            n += 1
    return n
