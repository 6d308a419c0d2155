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
        measured, offsets = scan.points, scan.offsets
        is_finite = np.isfinite(measured).all(axis=1)
        if not is_finite.all():
            measured, offsets = measured[is_finite], offsets[is_finite] if len(offsets) else offsets
        points: FloatArray = measured @ mount.rotation().T + np.array([mount.x, mount.y, mount.z])
        return cls(points, offsets, scan.is_planar)

    def at_stamp(self, twist: FloatArray) -> FloatArray:
        """(N, 3) in the body frame as it was at the stamp.

        Each point is moved from where the body was when it was measured, at constant ``twist`` (3,) from the stamp on: the true time of
        each point is used, so a sweep that fills only part of the scan period is not over-corrected.
        """
        if not len(self.offsets) or not np.any(twist):
            return self.points
        points = self.points.copy()
        points[:, :2] = se2.transform(se2.exp(self.offsets[:, None] * twist), points[:, :2])
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
