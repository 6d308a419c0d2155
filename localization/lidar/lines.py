"""Point-to-line registration against a map of points: where lines run through the map's points, and how far a scan is off them.

Compiled scalar loops. The map is a hash grid of square cells with a bounded number of points in each; a point stays where it was first
seen, so that the map does not creep along with the errors of later poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from motion_models.se2 import FloatArray

POINTS_PER_CELL = 40
_MIN_NEIGHBOURS = 4
_MAX_LINE_RATIO = 0.1  # smaller over larger eigenvalue of the neighbours' spread: beyond this it is a corner or clutter


@dataclass(frozen=True)
class LineFit:
    """The point-to-line cost around one pose, as a quadratic in its right perturbation d: const - gradient d + d H d / 2."""

    pose: FloatArray
    """(3,) where the cost was expanded."""
    information: FloatArray
    """(3, 3) H: the information of the points about the pose, nothing else."""
    gradient: FloatArray
    """(3,) downhill direction at ``pose``."""
    n_matched: int
    """Points that lie by a line of the map."""
    residual_rms: float
    """RMS distance of the matched points from their lines [m], robustly weighted."""


class LineMap:
    """A bounded map of 2D points in square cells."""

    def __init__(self, cell_size: float, min_distance: float, radius: float) -> None:
        """``cell_size`` [m]; points closer than ``min_distance`` [m] to one of their cell are not added; cells farther than ``radius``
        [m] from the robot are forgotten once there are many."""
        self._cell, self._min_distance, self._radius = cell_size, min_distance, radius
        self._allocate(1 << 12)

    def _allocate(self, slots: int) -> None:
        self._cells = np.zeros((slots, 3), np.int32)
        self._points = np.zeros((slots, POINTS_PER_CELL, 2), np.float32)

    def insert(self, points: FloatArray, pose: FloatArray) -> None:
        """Add ``points`` (N, 2) of the body frame, seen from ``pose`` (3,)."""
        used = _insert(self._cells, self._points, points, pose, self._cell, self._min_distance)
        if used < 0 or used > self._cells.shape[0] // 2:
            self._rebuild(pose)

    def _rebuild(self, pose: FloatArray) -> None:
        """Forget what is far from the robot; if that leaves the table too full, double it."""
        cells, points = self._cells, self._points
        near = cells[:, 2] > 0
        near &= np.hypot(cells[:, 0] * self._cell - pose[0], cells[:, 1] * self._cell - pose[1]) < self._radius
        self._allocate(cells.shape[0] * (2 if near.sum() > cells.shape[0] // 3 else 1))
        _copy(cells[near], points[near], self._cells, self._points)

    def fit(self, points: FloatArray, start: FloatArray, options: FitOptions, prior: FloatArray, center: FloatArray) -> LineFit:
        """Gauss-Newton from ``start`` (3,) for ``points`` (N, 2) of the body frame.

        ``prior`` (3, 3) is the information of a pull towards ``center`` (3,), which keeps directions that the scene does not hold
        where they were; it is no part of the returned quadratic.
        """
        information, gradient, pose = np.zeros((3, 3)), np.zeros(3), np.array(start, dtype=float)
        n, squares = _fit(
            self._cells,
            self._points,
            points,
            pose,
            self._cell,
            options.radius,
            options.sigma_point,
            options.sigma_line,
            options.kernel,
            options.wide_kernel,
            options.iterations,
            prior,
            center,
            information,
            gradient,
        )
        return LineFit(pose, information, gradient, n, math.sqrt(squares / n) if n else math.nan)

    def point_cloud(self) -> FloatArray:
        """(M, 2) all points of the map."""
        counts = np.where(self._cells[:, 2] > 0, self._cells[:, 2], 0)
        return self._points[np.arange(POINTS_PER_CELL) < counts[:, None]].astype(float)


@dataclass(frozen=True)
class FitOptions:
    radius: float
    """Neighbours within this distance of a point make its line [m]."""
    sigma_point: float
    """Noise of one LiDAR point [m]."""
    sigma_line: float
    """Error of a line of the map, shared by all points that meet it in one cell [m]."""
    kernel: float
    """Scale of the Geman-McClure kernel [m]."""
    wide_kernel: float
    """The same for the first half of the steps: it sees farther, and is not so easily caught by the wrong line [m]."""
    iterations: int
    """Gauss-Newton steps at most."""


@numba.njit(cache=True)
def _find(cells: NDArray[np.int32], ix: int, iy: int) -> int:  # pragma: no cover
    """Slot of the cell, or -1 - slot of the free place for it."""
    mask = cells.shape[0] - 1
    slot = ((ix * 73856093) ^ (iy * 19349663)) & mask
    while cells[slot, 2] != 0:
        if cells[slot, 0] == ix and cells[slot, 1] == iy:
            return slot
        slot = (slot + 1) & mask
    return -1 - slot


@numba.njit(cache=True)
def _insert(
    cells: NDArray[np.int32], points: NDArray[np.float32], new: FloatArray, pose: FloatArray, cell: float, min_distance: float
) -> int:  # pragma: no cover
    """Returns how many slots are used, or -1 when the table is so full that points were left out."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    used = 0
    for i in range(cells.shape[0]):
        used += cells[i, 2] > 0
    for i in range(new.shape[0]):
        x = pose[0] + c * new[i, 0] - s * new[i, 1]
        y = pose[1] + s * new[i, 0] + c * new[i, 1]
        ix, iy = int(math.floor(x / cell)), int(math.floor(y / cell))
        slot = _find(cells, ix, iy)
        if slot < 0:
            if used > cells.shape[0] * 3 // 4:
                return -1
            slot = -1 - slot
            used += 1
            cells[slot, 0], cells[slot, 1] = ix, iy
        n = cells[slot, 2]
        near = n >= points.shape[1]
        for k in range(n):
            if near:
                break
            dx, dy = points[slot, k, 0] - x, points[slot, k, 1] - y
            near = dx * dx + dy * dy < min_distance * min_distance
        if not near:
            points[slot, n, 0], points[slot, n, 1] = x, y
            cells[slot, 2] = n + 1
    return used


@numba.njit(cache=True)
def _copy(
    cells: NDArray[np.int32], points: NDArray[np.float32], to_cells: NDArray[np.int32], to_points: NDArray[np.float32]
) -> None:  # pragma: no cover
    for i in range(cells.shape[0]):
        slot = -1 - _find(to_cells, cells[i, 0], cells[i, 1])
        for j in range(3):
            to_cells[slot, j] = cells[i, j]
        for k in range(cells[i, 2]):
            to_points[slot, k, 0], to_points[slot, k, 1] = points[i, k, 0], points[i, k, 1]


@numba.njit(cache=True)
def _fit(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    source: FloatArray,
    pose: FloatArray,
    cell: float,
    radius: float,
    sigma_point: float,
    sigma_line: float,
    final_kernel: float,
    wide_kernel: float,
    iterations: int,
    prior: FloatArray,
    center: FloatArray,
    H: FloatArray,
    g: FloatArray,
) -> tuple[int, float]:  # pragma: no cover
    """Changes ``pose``, ``H`` and ``g`` in place; returns the matched points and their weighted sum of squares."""
    n_matched, squares = 0, 0.0
    hits = np.zeros(cells.shape[0], np.int32)
    home = np.empty(source.shape[0], np.int64)
    wide = iterations // 2
    for iteration in range(iterations + 1):
        kernel = wide_kernel if iteration < wide else final_kernel
        H[:], g[:] = 0.0, 0.0
        n_matched, squares = 0, 0.0
        c, s = math.cos(pose[2]), math.sin(pose[2])
        for i in range(source.shape[0]):
            x = pose[0] + c * source[i, 0] - s * source[i, 1]
            y = pose[1] + s * source[i, 0] + c * source[i, 1]
            home[i] = _find(cells, int(math.floor(x / cell)), int(math.floor(y / cell)))
            if home[i] >= 0:
                hits[home[i]] += 1
        for i in range(source.shape[0]):
            x = pose[0] + c * source[i, 0] - s * source[i, 1]
            y = pose[1] + s * source[i, 0] + c * source[i, 1]
            ix, iy = int(math.floor(x / cell)), int(math.floor(y / cell))
            m, sx, sy, sxx, sxy, syy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            for jx in range(ix - 1, ix + 2):
                for jy in range(iy - 1, iy + 2):
                    slot = _find(cells, jx, jy)
                    if slot < 0:
                        continue
                    for k in range(cells[slot, 2]):
                        qx, qy = points[slot, k, 0] - x, points[slot, k, 1] - y
                        if qx * qx + qy * qy < radius * radius:
                            m += 1
                            sx, sy = sx + qx, sy + qy
                            sxx, sxy, syy = sxx + qx * qx, sxy + qx * qy, syy + qy * qy
            if m < _MIN_NEIGHBOURS:
                continue
            mx, my = sx / m, sy / m
            cxx, cxy, cyy = sxx / m - mx * mx, sxy / m - mx * my, syy / m - my * my
            trace, split = cxx + cyy, math.hypot(cxx - cyy, 2.0 * cxy)
            wide, thin = 0.5 * (trace + split), max(0.5 * (trace - split), 0.0)
            if wide < 1e-4 or thin > _MAX_LINE_RATIO * wide:
                continue
            angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
            nx, ny = -math.sin(angle), math.cos(angle)
            e = -(nx * mx + ny * my)
            # All points in one cell meet the same line, whose error they share: together they know no more than it.
            shared = hits[home[i]] if home[i] >= 0 else 1
            robust = 1.0 + e * e / (kernel * kernel)
            w = 1.0 / ((sigma_point * sigma_point + shared * (sigma_line * sigma_line + thin / m)) * robust * robust)
            # e changes by n . R (dx, dy) and by the lever arm of the point
            jx_, jy_ = nx * c + ny * s, ny * c - nx * s
            jt = jy_ * source[i, 0] - jx_ * source[i, 1]
            H[0, 0] += w * jx_ * jx_
            H[0, 1] += w * jx_ * jy_
            H[0, 2] += w * jx_ * jt
            H[1, 1] += w * jy_ * jy_
            H[1, 2] += w * jy_ * jt
            H[2, 2] += w * jt * jt
            g[0] -= w * jx_ * e
            g[1] -= w * jy_ * e
            g[2] -= w * jt * e
            n_matched += 1
            squares += e * e / (robust * robust)
        H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
        for i in range(source.shape[0]):
            if home[i] >= 0:
                hits[home[i]] = 0
        if iteration >= iterations or n_matched == 0:
            break

        dx, dy = center[0] - pose[0], center[1] - pose[1]
        turn = (center[2] - pose[2] + math.pi) % (2.0 * math.pi) - math.pi
        px, py = c * dx + s * dy, c * dy - s * dx
        b0 = g[0] + prior[0, 0] * px + prior[0, 1] * py + prior[0, 2] * turn
        b1 = g[1] + prior[1, 0] * px + prior[1, 1] * py + prior[1, 2] * turn
        b2 = g[2] + prior[2, 0] * px + prior[2, 1] * py + prior[2, 2] * turn
        a00, a01, a02 = H[0, 0] + prior[0, 0], H[0, 1] + prior[0, 1], H[0, 2] + prior[0, 2]
        a11, a12, a22 = H[1, 1] + prior[1, 1], H[1, 2] + prior[1, 2], H[2, 2] + prior[2, 2]
        i00, i01, i02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
        i11, i12, i22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
        det = a00 * i00 + a01 * i01 + a02 * i02
        d0 = (i00 * b0 + i01 * b1 + i02 * b2) / det
        d1 = (i01 * b0 + i11 * b1 + i12 * b2) / det
        d2 = (i02 * b0 + i12 * b1 + i22 * b2) / det
        pose[0] += c * d0 - s * d1
        pose[1] += s * d0 + c * d1
        pose[2] += d2
        if abs(d0) + abs(d1) + abs(d2) < 1e-4:
            if iteration >= wide:
                iterations = iteration + 1
            wide = min(wide, iteration + 1)
    return n_matched, squares
