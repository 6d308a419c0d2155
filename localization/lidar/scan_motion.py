"""Motion from one scan to the next, by the scans alone: coarse, but independent of wheels, gyro, filter and submap.

The turn is initialized by the circular correlation of the two range profiles. Point-to-line Gauss-Newton with projective association
refines it (Censi 2008, "An ICP variant using a point-to-line metric"; Serafin & Grisetti 2015, NICP, for the association by bearing).
Sensor checks compare it with the other sensors; it is never fused.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from motion_models import se2
from motion_models.se2 import FloatArray

_BEARINGS = 360
_BIN_RAD = 2.0 * np.pi / _BEARINGS
_MIN_BEARINGS = 60
"""Filled bearings of a profile, of `_BEARINGS`; fewer leave the turn ambiguous."""
_MAX_TURN_BINS = 60
_SHIFTED = (np.arange(_BEARINGS) - np.arange(-_MAX_TURN_BINS, _MAX_TURN_BINS + 1)[:, None]) % _BEARINGS
"""(shifts, bearings) index of a profile that is turned by each shift."""
_ITERATIONS = 8
_FIRST_SCALE_M, _LAST_SCALE_M = 0.5, 0.05
"""Scale of the robust loss (Cauchy), annealed [m]."""
_INLIER_M, _MIN_INLIERS = 0.1, 0.5
_MIN_STRUCTURE = 0.05
"""Smallest eigenvalue of the mean of n n^T over the normals; rooms have 0.3 and more, corridors at most 0.011 (measured)."""
_DAMPING = 1e-3


class ScanMotion(NamedTuple):
    """Motion of the body from one scan to the next."""

    delta: FloatArray
    """(3,) a_T_b [m, m, rad]."""
    has_translation: bool
    """The scene has structure along both axes."""


class _Profile(NamedTuple):
    """A planar scan by bearing about the sensor."""

    center: FloatArray
    """(2,) sensor in the body frame [m]."""
    points: FloatArray
    """(M, 2) nearest point of each filled bearing, about the sensor in the body's axes [m]."""
    ranges: FloatArray
    """(360,) nearest range by bearing; NaN where none [m]."""
    normals: FloatArray
    """(360, 2) of the surface at each bearing; NaN where unknown."""


class ScanOdometry:
    """Give it each scan; it returns the motion since the scan before, where that can be measured."""

    def __init__(self) -> None:
        self._last: _Profile | None = None

    def register(self, points: FloatArray, center: FloatArray) -> ScanMotion | None:
        """Motion since the last call; ``points`` (M, 2) and sensor position ``center`` (2,) in the body frame [m].

        None for the first scan, for scans with too few points and where the scans do not fit onto each other.
        """
        last, now = self._last, _make_profile(points - center, center)
        self._last = now
        if last is None or now is None:
            return None
        turn = _correlate(last.ranges, now.ranges)
        return None if turn is None else _refine(last, now, turn)


def _make_profile(points: FloatArray, center: FloatArray) -> _Profile | None:
    """None for too few points."""
    r = np.hypot(points[:, 0], points[:, 1])
    points, r = points[r > 0.0], r[r > 0.0]
    bins = np.floor(np.arctan2(points[:, 1], points[:, 0]) / _BIN_RAD).astype(np.intp) % _BEARINGS
    ranges = np.full(_BEARINGS, np.inf)
    np.minimum.at(ranges, bins, r)
    ranges[~np.isfinite(ranges)] = np.nan
    if np.isfinite(ranges).sum() < _MIN_BEARINGS:
        return None
    bearing = (np.arange(_BEARINGS) + 0.5) * _BIN_RAD
    surface = ranges[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    along = np.roll(surface, -2, axis=0) - np.roll(surface, 2, axis=0)
    length = np.hypot(along[:, 0], along[:, 1])
    is_edge = ~(length < 0.1 + 0.5 * ranges)  # from one surface to another, or unknown
    normals = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(length, 1e-6)[:, None]
    normals[is_edge] = np.nan
    return _Profile(center, points[r == ranges[bins]], ranges, normals)


def _correlate(a: FloatArray, b: FloatArray) -> float | None:
    """Turn [rad] from profile ``a`` to ``b``, both (360,), at the least mean difference of log-ranges."""
    is_known_a, is_known_b = np.isfinite(a), np.isfinite(b)
    log_a, log_b = np.where(is_known_a, np.log(np.maximum(a, 1e-3)), 0.0), np.where(is_known_b, np.log(np.maximum(b, 1e-3)), 0.0)
    both = is_known_a & is_known_b[_SHIFTED]
    n = both.sum(axis=1)
    difference = np.einsum("sb,sb->s", np.abs(log_a - log_b[_SHIFTED]), both)
    cost = np.where(n >= _MIN_BEARINGS, difference / np.maximum(n, 1), np.inf)
    best = int(np.argmin(cost))
    return (best - _MAX_TURN_BINS) * _BIN_RAD if np.isfinite(cost[best]) else None


def _refine(a: _Profile, b: _Profile, turn: float) -> ScanMotion | None:
    """a_T_b of the body by point-to-line Gauss-Newton from a pure ``turn`` [rad]."""
    a_T_b = np.array([0.0, 0.0, turn])
    scales = np.geomspace(_FIRST_SCALE_M, _LAST_SCALE_M, _ITERATIONS)
    residual, J = np.empty(0), np.empty((0, 3))
    for scale in scales:
        residual, J = _residuals(a, b.points, a_T_b)
        if len(residual) < _MIN_BEARINGS // 2:
            return None
        weight = 1.0 / (1.0 + (residual / scale) ** 2)
        A = (J * weight[:, None]).T @ J + _DAMPING * len(residual) * np.eye(3)
        a_T_b = a_T_b - np.linalg.solve(A, (J * weight[:, None]).T @ residual)
    is_inlier = np.abs(residual) < _INLIER_M
    if is_inlier.sum() < _MIN_INLIERS * len(b.points) or not np.isfinite(a_T_b).all():
        return None
    normals = J[is_inlier, :2]
    structure = float(np.linalg.eigvalsh(normals.T @ normals / len(normals))[0])
    body_T_sensor = np.array([a.center[0], a.center[1], 0.0])
    moved = se2.compose(se2.compose(body_T_sensor, a_T_b), se2.inverse(body_T_sensor))
    return ScanMotion(moved, structure >= _MIN_STRUCTURE)


def _residuals(a: _Profile, points: FloatArray, a_T_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (n,) of ``points`` (M, 2), moved by ``a_T_b`` (3,), from the lines of ``a``; Jacobian (n, 3) by a_T_b."""
    c, s = np.cos(a_T_b[2]), np.sin(a_T_b[2])
    turned = points @ np.array([[c, s], [-s, c]])
    moved = turned + a_T_b[:2]
    bins = np.floor(np.arctan2(moved[:, 1], moved[:, 0]) / _BIN_RAD).astype(np.intp) % _BEARINGS
    bearing = (bins + 0.5) * _BIN_RAD
    nearest = a.ranges[bins, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    n = a.normals[bins]
    off = moved - nearest
    is_close = np.isfinite(n[:, 0]) & (np.abs(off) < 1.0).all(axis=1)
    n, off, turned = n[is_close], off[is_close], turned[is_close]
    residual = np.einsum("ij,ij->i", n, off)
    J = np.column_stack([n, n[:, 1] * turned[:, 0] - n[:, 0] * turned[:, 1]])
    return residual, J
