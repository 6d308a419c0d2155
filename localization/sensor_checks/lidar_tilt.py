"""Roll and pitch of a 3D LiDAR against the ground in its clouds.

Nothing is left out: clouds are matched as if upright, and a tilted mount or a body that sways is reported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from localization.events import Scan
from localization.messages import Message, message
from motion_models.robot import Mount
from motion_models.se2 import FloatArray

_PERIOD_NS = 500_000_000
_MAX_POINTS = 6000
_CELL_M, _MAX_RANGE_M = 1.0, 15.0
_RANSAC_DRAWS = 150
_THICKNESS_M, _MAX_BELOW_M = 0.06, 0.2  # of the ground; only outliers are farther below it
_MIN_CELLS, _MIN_SHARE, _MAX_SHARE_BELOW, _MIN_SPREAD_M = 15, 0.4, 0.1, 1.0
_MAX_SLOPE = math.tan(math.radians(20.0))
_BIN_RAD, _BINS = math.radians(0.1), 300  # more than the steepest ground
_MIN_CLOUDS, _MIN_REPORTED_RAD = 10, math.radians(1.0)


class LidarTilt:
    """Fits the ground in clouds; memory is bounded. ``mounts`` of the LiDARs are by frame."""

    def __init__(self, mounts: Mapping[str, Mount]) -> None:
        self._mounts = mounts
        self._next_ns = -(1 << 62)
        self._frame = ""
        self._found = np.zeros((2, 2 * _BINS + 1), dtype=np.int64)  # how often which roll and pitch, in bins
        self._height = 0.0  # sum over clouds: how far above or below the LiDAR the rest of them is [m]

    def add(self, scan: Scan) -> None:
        """Fit the ground in a cloud, twice a second."""
        if scan.is_planar or scan.stamp_ns < self._next_ns:
            return
        self._next_ns, self._frame = scan.stamp_ns + _PERIOD_NS, scan.frame_id
        mount = self._mounts.get(scan.frame_id, Mount())
        points = scan.points[:: 1 + len(scan.points) // _MAX_POINTS] @ mount.rotation.T + [mount.x, mount.y, mount.z]
        points = points[np.hypot(points[:, 0], points[:, 1]) < _MAX_RANGE_M]
        plane = fit_ground(points)
        if plane is None:
            return
        roll, pitch = -math.atan(plane[2]), math.atan(plane[1])
        self._found[[0, 1], np.rint(np.array([roll, pitch]) / _BIN_RAD).astype(int) + _BINS] += 1
        above = np.abs(points[:, 2] - mount.z)[points[:, 2] - _height(plane, points) > _THICKNESS_M]
        self._height += float(np.quantile(above, 0.9)) if len(above) else 0.0

    def warnings(self) -> list[Message]:
        """Tilt and sway, where they are large."""
        n = int(self._found[0].sum())
        if n < _MIN_CLOUDS:
            return []
        angles = _BIN_RAD * np.arange(-_BINS, _BINS + 1)
        roll, pitch = (angles[np.searchsorted(np.cumsum(counts), 0.5 * n)] for counts in self._found)
        tilt = math.hypot(roll, pitch)
        sway = math.sqrt(sum(counts @ (angles - middle) ** 2 for counts, middle in zip(self._found, (roll, pitch), strict=True)) / n)
        if max(tilt, sway) < _MIN_REPORTED_RAD:
            return []
        off_m = math.sin(math.hypot(tilt, 2.0 * sway)) * self._height / n
        found = {
            "tilt": math.degrees(tilt),
            "roll": math.degrees(roll),
            "pitch": math.degrees(pitch),
            "sway": math.degrees(sway),
            "off_cm": 100.0 * off_m,
        }
        if tilt < _MIN_REPORTED_RAD:
            return [message("cloud_tilt.swaying", **found)]
        return [message("cloud_tilt.mount", frame=self._frame, **found)]


def fit_ground(points: FloatArray) -> FloatArray | None:
    """(3,) a, b, c of the ground z = a + b x + c y in a cloud ``points`` (N, 3) [m], not steeper than 20 degrees; None if there is none.

    It is the plane that holds most of the lowest points of all cells, if hardly one is below.
    """
    if len(points) == 0:
        return None
    index = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    order = np.lexsort((points[:, 2], index[:, 1], index[:, 0]))
    is_first = np.append(True, (np.diff(index[order], axis=0) != 0).any(axis=1))
    low = points[order[is_first]]
    if len(low) < _MIN_CELLS:
        return None
    corners = low[np.random.default_rng(0).integers(0, len(low), (_RANSAC_DRAWS, 3))]
    A = np.concatenate([np.ones((_RANSAC_DRAWS, 3, 1)), corners[:, :, :2]], axis=2)
    is_wide = np.abs(np.linalg.det(A)) > _CELL_M**2
    planes = np.linalg.solve(A[is_wide], corners[is_wide, :, 2:])[:, :, 0]
    planes = planes[np.hypot(planes[:, 1], planes[:, 2]) < _MAX_SLOPE]
    above = low[:, 2] - planes[:, :1] - planes[:, 1:] @ low[:, :2].T
    counts = (np.abs(above) < _THICKNESS_M).sum(axis=1)
    counts[(above < -_MAX_BELOW_M).mean(axis=1) > _MAX_SHARE_BELOW] = 0
    if not len(counts) or counts.max() < max(_MIN_CELLS, _MIN_SHARE * len(low)):
        return None
    held = low[np.abs(above[counts.argmax()]) < _THICKNESS_M]
    if np.linalg.eigvalsh(np.cov(held[:, :2].T))[0] < _MIN_SPREAD_M**2:
        return None
    found: FloatArray = np.linalg.lstsq(np.column_stack([np.ones(len(held)), held[:, :2]]), held[:, 2], rcond=None)[0]
    return found


def _height(plane: FloatArray, points: FloatArray) -> FloatArray:
    """(N,) z of ``plane`` (3,) under ``points`` (N, 3)."""
    found: FloatArray = plane[0] + points[:, :2] @ plane[1:]
    return found
