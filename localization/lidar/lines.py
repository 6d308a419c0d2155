"""Point-to-line registration against a map of points: where lines run through the map's points, and how far a scan is off them.

Compiled scalar loops. The map is a hash grid of square cells with a bounded number of points in each; a point stays where it was first
seen, so that the map does not creep along with the errors of later poses. Each point remembers how far the robot had travelled when it
was inserted: old and young parts of the map can be told apart where the robot comes back to a place, and every use of the map says
which ages it means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from motion_models.se2 import FloatArray

POINTS_PER_CELL = 64
_IN_USE_PER_CELL = 40  # of the ages that are in use; the rest is for older visits
_AGE_M = 0.25
_MIN_NEIGHBOURS = 4
_MAX_SIGMAS = 3.0  # of a point's noise: neighbours that scatter more across their line are of two
_STALE = 0.02  # of the neighbourhood's radius: points that moved farther look for their lines again
_SAME = 0.05  # of the same: points that are nearer to each other look once for both
_MAX_LINE_RATIO = 0.1  # smaller over larger eigenvalue of the neighbours' spread: beyond this it is a corner or clutter


Ages = NDArray[np.uint8]
"""(A,) by travelled distance in steps of 0.25 m: 1 where points that were inserted then are in use. The last holds for all later ones."""
ALL_AGES: Ages = np.ones(1, np.uint8)


def ages_until(travel: float) -> Ages:
    """Points inserted up to ``travel`` [m], and no later ones."""
    return np.append(np.ones(max(round(travel / _AGE_M), 0), np.uint8), np.uint8(0))


def ages_between(spans: FloatArray) -> Ages:
    """Points inserted within any of ``spans`` (S, 2) [m], and all that come after the last one's end."""
    found = np.zeros(max(round(float(spans[:, 1].max()) / _AGE_M), 0) + 1, np.uint8)
    found[-1] = 1
    for start, end in spans:
        found[max(round(start / _AGE_M), 0) : max(round(end / _AGE_M), 0) + 1] = 1
    return found


@dataclass(frozen=True)
class Spread:
    """How far the points are off their lines: the sums of an analysis of variance, where points in one cell of the map are a group."""

    within: float = 0.0
    """Squares of the points' distances from their group's mean [m^2]."""
    within_freedom: float = 0.0
    between: float = 0.0
    """Squares of the groups' means, less what the noise of their points and of the map's points makes of them [m^2]."""
    between_freedom: float = 0.0


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
    n_on: int
    """Those of them that are on it, within three sigmas."""
    residual_rms: float
    """RMS distance of the matched points from their lines [m], robustly weighted."""
    spread: Spread


class LineMap:
    """A bounded map of 2D points in square cells."""

    def __init__(self, cell_size: float, min_distance: float, radius: float) -> None:
        """``cell_size`` [m]; points closer than ``min_distance`` [m] to one of their cell are not added; cells farther than ``radius``
        [m] from the robot are forgotten once there are many."""
        self._cell, self._min_distance, self._radius = cell_size, min_distance, radius
        self._allocate(1 << 12)

    def _allocate(self, slots: int) -> None:
        self._used = 0
        self._cells = np.zeros((slots, 3), np.int32)
        self._points = np.zeros((slots, POINTS_PER_CELL, 2), np.float32)
        self._travels = np.zeros((slots, POINTS_PER_CELL), np.float32)
        self._hits = np.zeros(slots, np.int32)  # of one step of a fit, all zero between steps

    def insert(self, points: FloatArray, pose: FloatArray, travel: float = 0.0, ages: Ages = ALL_AGES) -> None:
        """Add ``points`` (N, 2) of the body frame, seen from ``pose`` (3,) after ``travel`` [m], to what is in use."""
        self._insert(points, np.full(len(points), travel, np.float32), pose, ages)

    def _insert(self, points: FloatArray, travels: NDArray[np.float32], pose: FloatArray, ages: Ages) -> None:
        self._used, is_full = _insert(
            self._cells, self._points, self._travels, ages, points, travels, pose, self._cell, self._min_distance, self._used
        )
        if is_full or self._used > self._cells.shape[0] // 2:
            cells = self._cells
            near = cells[:, 2] > 0
            near &= np.hypot(cells[:, 0] * self._cell - pose[0], cells[:, 1] * self._cell - pose[1]) < self._radius
            self._rebuild(near, cells.shape[0] * (2 if near.sum() > cells.shape[0] // 3 else 1))

    def move_since(self, travel: float, world_T_world: FloatArray) -> None:
        """Move the points that were inserted after ``travel`` [m] by ``world_T_world`` (3,)."""
        use = np.arange(POINTS_PER_CELL) < self._cells[:, 2][:, None]
        use &= self._travels > travel
        points, travels = self._points[use].astype(float), self._travels[use]
        _keep_until(self._cells, self._points, self._travels, travel)
        self._rebuild(self._cells[:, 2] > 0, self._cells.shape[0])
        self._insert(points, travels, world_T_world, ages_between(np.array([[travel, travel + 1.0]])))

    def _rebuild(self, kept: NDArray[np.bool_], slots: int) -> None:
        """A new table of ``slots`` with the ``kept`` (S,) slots of the old one."""
        cells, points, travels = self._cells[kept], self._points[kept], self._travels[kept]
        self._allocate(slots)
        self._used = len(cells)
        _copy(cells, points, travels, self._cells, self._points, self._travels)

    def fit(
        self,
        points: FloatArray,
        start: FloatArray,
        options: FitOptions,
        prior: FloatArray,
        center: FloatArray,
        ages: Ages = ALL_AGES,
    ) -> LineFit:
        """Gauss-Newton from ``start`` (3,) for ``points`` (N, 2) of the body frame.

        ``prior`` (3, 3) is the information of a pull towards ``center`` (3,), which keeps directions that the scene does not hold
        where they were; it is no part of the returned quadratic. Only points of these ``ages`` count.
        """
        information, gradient, pose, spread = np.zeros((3, 3)), np.zeros(3), np.array(start, dtype=float), np.zeros(4)
        n, n_on, squares = _fit(
            self._cells,
            self._points,
            self._travels,
            self._hits,
            ages,
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
            spread,
        )
        return LineFit(pose, information, gradient, n, n_on, math.sqrt(squares / n) if n else math.nan, Spread(*spread.tolist()))

    def compare(self, points: FloatArray, pose: FloatArray, radius: float, ages: Ages = ALL_AGES) -> tuple[FloatArray, FloatArray]:
        """How far ``points`` (N, 2) of the body frame at ``pose`` (3,) are off the lines within ``radius`` [m] of them, and when those
        were seen: distances (N,) [m] and travelled distances (N,) [m], NaN for points without a line of these ``ages``."""
        errors, travels = np.empty(len(points)), np.empty(len(points))
        _compare(self._cells, self._points, self._travels, ages, points, pose, self._cell, radius, math.inf, errors, travels)
        return errors, travels

    def points_within(self, center: FloatArray, half: float) -> tuple[FloatArray, FloatArray]:
        """Points (M, 2) in cells whose centre is in a square of ``half`` a side [m] around ``center`` (2,), and their travelled distances
        (M,) [m]."""
        near = self._cells[:, 2] > 0
        near &= (np.abs((self._cells[:, :2] + 0.5) * self._cell - center) <= half).all(axis=1)
        slots = np.flatnonzero(near)
        use = np.arange(POINTS_PER_CELL) < self._cells[slots, 2][:, None]
        return self._points[slots][use].astype(float), self._travels[slots][use].astype(float)

    def point_cloud(self) -> FloatArray:
        """(M, 2) all points of the map."""
        return self._points[np.arange(POINTS_PER_CELL) < self._cells[:, 2][:, None]].astype(float)


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
    """The same for the first step: it sees farther, and is not so easily caught by the wrong line [m]."""
    iterations: int
    """Gauss-Newton steps at most."""


@numba.njit(cache=True)
def _find(cells: NDArray[np.int32], ix: int, iy: int) -> int:  # pragma: no cover
    """Slot of the cell, or -1 - slot of the free place for it."""
    mask: int = cells.shape[0] - 1
    slot: int = ((ix * 73856093) ^ (iy * 19349663)) & mask
    while cells[slot, 2] != 0:
        if cells[slot, 0] == ix and cells[slot, 1] == iy:
            return slot
        slot = (slot + 1) & mask
    return -1 - slot


@numba.njit(cache=True)
def _is_used(ages: Ages, travel: float) -> bool:  # pragma: no cover
    return bool(ages[min(int(travel / _AGE_M + 0.5), ages.shape[0] - 1)])


@numba.njit(cache=True)
def _insert(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    ages: Ages,
    new: FloatArray,
    new_travels: NDArray[np.float32],
    pose: FloatArray,
    cell: float,
    min_distance: float,
    used: int,
) -> tuple[int, bool]:  # pragma: no cover
    """Takes how many slots are used; returns how many are then, and whether the table is so full that points were left out."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(new.shape[0]):
        x = pose[0] + c * new[i, 0] - s * new[i, 1]
        y = pose[1] + s * new[i, 0] + c * new[i, 1]
        ix, iy = math.floor(x / cell), math.floor(y / cell)
        slot = _find(cells, ix, iy)
        if slot < 0:
            if used > cells.shape[0] * 3 // 4:
                return used, True
            slot = -1 - slot
            used += 1
            cells[slot, 0], cells[slot, 1] = ix, iy
        n, n_used, unused, near = cells[slot, 2], 0, -1, False
        for k in range(n):
            if not _is_used(ages, travels[slot, k]):
                unused = k
                continue
            n_used += 1
            dx, dy = points[slot, k, 0] - x, points[slot, k, 1] - y
            near = near or dx * dx + dy * dy < min_distance * min_distance
        if near or n_used >= _IN_USE_PER_CELL or (n >= points.shape[1] and unused < 0):
            continue
        k = n if n < points.shape[1] else unused
        points[slot, k, 0], points[slot, k, 1] = x, y
        travels[slot, k] = new_travels[i]
        cells[slot, 2] = max(n, k + 1)
    return used, False


@numba.njit(cache=True)
def _keep_until(
    cells: NDArray[np.int32], points: NDArray[np.float32], travels: NDArray[np.float32], travel: float
) -> None:  # pragma: no cover
    """The caller must rebuild the table: an emptied cell breaks the search for those behind it."""
    for slot in range(cells.shape[0]):
        kept = 0
        for k in range(cells[slot, 2]):
            if travels[slot, k] <= travel:
                points[slot, kept, 0], points[slot, kept, 1] = points[slot, k, 0], points[slot, k, 1]
                travels[slot, kept] = travels[slot, k]
                kept += 1
        cells[slot, 2] = kept


@numba.njit(cache=True)
def _copy(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    to_cells: NDArray[np.int32],
    to_points: NDArray[np.float32],
    to_travels: NDArray[np.float32],
) -> None:  # pragma: no cover
    for i in range(cells.shape[0]):
        slot = -1 - _find(to_cells, cells[i, 0], cells[i, 1])
        for j in range(3):
            to_cells[slot, j] = cells[i, j]
        for k in range(cells[i, 2]):
            to_points[slot, k, 0], to_points[slot, k, 1] = points[i, k, 0], points[i, k, 1]
            to_travels[slot, k] = travels[i, k]


@numba.njit(cache=True)
def _line(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    ages: Ages,
    x: float,
    y: float,
    cell: float,
    radius: float,
    most_thin: float,
) -> tuple[int, float, float, float, float, float]:  # pragma: no cover
    """The line of the points around (x, y): how many they are, 0 where they make none; its normal, the distance of (x, y) from it along
    the normal, the points' variance across it, and their mean travelled distance."""
    ix, iy = math.floor(x / cell), math.floor(y / cell)
    m, sx, sy, sxx, sxy, syy, st = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for jx in range(ix - 1, ix + 2):
        for jy in range(iy - 1, iy + 2):
            slot = _find(cells, jx, jy)
            if slot < 0:
                continue
            for k in range(cells[slot, 2]):
                qx, qy = points[slot, k, 0] - x, points[slot, k, 1] - y
                if qx * qx + qy * qy < radius * radius and _is_used(ages, travels[slot, k]):
                    m += 1
                    sx, sy = sx + qx, sy + qy
                    sxx, sxy, syy = sxx + qx * qx, sxy + qx * qy, syy + qy * qy
                    st += travels[slot, k]
    if m < _MIN_NEIGHBOURS:
        return 0, 0.0, 0.0, 0.0, 0.0, 0.0
    mx, my = sx / m, sy / m
    cxx, cxy, cyy = sxx / m - mx * mx, sxy / m - mx * my, syy / m - my * my
    trace, split = cxx + cyy, math.hypot(cxx - cyy, 2.0 * cxy)
    wide, thin = 0.5 * (trace + split), max(0.5 * (trace - split), 0.0)
    if wide < 1e-4 or thin > min(_MAX_LINE_RATIO * wide, most_thin):
        return 0, 0.0, 0.0, 0.0, 0.0, 0.0
    angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)
    nx, ny = -math.sin(angle), math.cos(angle)
    return m, nx, ny, -(nx * mx + ny * my), thin, st / m


@numba.njit(cache=True)
def _compare(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    ages: Ages,
    source: FloatArray,
    pose: FloatArray,
    cell: float,
    radius: float,
    most_thin: float,
    errors: FloatArray,
    seen: FloatArray,
) -> None:  # pragma: no cover
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(source.shape[0]):
        x = pose[0] + c * source[i, 0] - s * source[i, 1]
        y = pose[1] + s * source[i, 0] + c * source[i, 1]
        m, _, _, e, _, travel = _line(cells, points, travels, ages, x, y, cell, radius, most_thin)
        errors[i], seen[i] = (abs(e), travel) if m else (math.nan, math.nan)


@numba.njit(cache=True)
def _associate(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    hits: NDArray[np.int32],
    ages: Ages,
    source: FloatArray,
    pose: FloatArray,
    cell: float,
    radius: float,
    most_thin: float,
    home: NDArray[np.int64],
    lines: FloatArray,
) -> None:  # pragma: no cover
    """Fills ``lines`` (N, 7) for the points ``source`` (N, 2) at ``pose``: how many points make the line (0: none), its normal, a point on
    it, the variance of its place, and how many of ``source`` are in its cell, ``home`` (N,), below 0 where the map has none."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    last_x, last_y, near = math.inf, math.inf, (_SAME * radius) ** 2
    for i in range(source.shape[0]):
        x = pose[0] + c * source[i, 0] - s * source[i, 1]
        y = pose[1] + s * source[i, 0] + c * source[i, 1]
        if (x - last_x) ** 2 + (y - last_y) ** 2 < near:  # beside the point before, as beams are: it meets the same line
            lines[i, :6] = lines[i - 1, :6]
        else:
            last_x, last_y = x, y
            m, nx, ny, e, thin, _ = _line(cells, points, travels, ages, x, y, cell, radius, most_thin)
            lines[i, 0] = m
            if m:
                lines[i, 1], lines[i, 2], lines[i, 3], lines[i, 4], lines[i, 5] = nx, ny, x - e * nx, y - e * ny, thin / m
        home[i] = _find(cells, math.floor(x / cell), math.floor(y / cell))
        if home[i] >= 0:
            hits[home[i]] += 1
    for i in range(source.shape[0]):
        lines[i, 6] = hits[home[i]] if home[i] >= 0 else 1.0
    for i in range(source.shape[0]):
        if home[i] >= 0:
            hits[home[i]] = 0


@numba.njit(cache=True)
def _sum_up(
    source: FloatArray,
    lines: FloatArray,
    pose: FloatArray,
    sigma_point: float,
    sigma_line: float,
    kernel: float,
    H: FloatArray,
    g: FloatArray,
) -> tuple[int, float]:  # pragma: no cover
    """The quadratic of the cost around ``pose``, into ``H`` and ``g``; returns the matched points and their weighted sum of squares."""
    H[:], g[:] = 0.0, 0.0
    n_matched, squares = 0, 0.0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(source.shape[0]):
        if lines[i, 0] == 0.0:
            continue
        nx, ny = lines[i, 1], lines[i, 2]
        x = pose[0] + c * source[i, 0] - s * source[i, 1]
        y = pose[1] + s * source[i, 0] + c * source[i, 1]
        e = nx * (x - lines[i, 3]) + ny * (y - lines[i, 4])
        robust = 1.0 + e * e / (kernel * kernel)
        # All points in one cell meet the same line, whose error they share: together they know no more than it.
        w = 1.0 / ((sigma_point * sigma_point + lines[i, 6] * (sigma_line * sigma_line + lines[i, 5])) * robust * robust)
        # e changes by n . R (dx, dy) and by the lever arm of the point
        jx, jy = nx * c + ny * s, ny * c - nx * s
        jt = jy * source[i, 0] - jx * source[i, 1]
        H[0, 0] += w * jx * jx
        H[0, 1] += w * jx * jy
        H[0, 2] += w * jx * jt
        H[1, 1] += w * jy * jy
        H[1, 2] += w * jy * jt
        H[2, 2] += w * jt * jt
        g[0] -= w * jx * e
        g[1] -= w * jy * e
        g[2] -= w * jt * e
        n_matched += 1
        squares += e * e / (robust * robust)
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    return n_matched, squares


@numba.njit(cache=True)
def _fit(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    hits: NDArray[np.int32],
    ages: Ages,
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
    spread: FloatArray,
) -> tuple[int, int, float]:  # pragma: no cover
    """Changes ``pose``, ``H`` and ``g`` in place; returns the matched points, those on their lines, and the weighted sum of squares.

    Lines are looked up again where the points have moved by a part of the neighbourhood since they were: near the end, they stay.
    """
    most_thin = (_MAX_SIGMAS * sigma_point) ** 2
    home, lines = np.empty(source.shape[0], np.int64), np.empty((source.shape[0], 7))
    reach, moved, n_matched, squares = 0.0, math.inf, 0, 0.0
    for i in range(source.shape[0]):
        reach = max(reach, math.hypot(source[i, 0], source[i, 1]))
    for iteration in range(iterations + 1):
        if moved > _STALE * radius:
            _associate(cells, points, travels, hits, ages, source, pose, cell, radius, most_thin, home, lines)
            moved = 0.0
        kernel = wide_kernel if iteration == 0 else final_kernel
        n_matched, squares = _sum_up(source, lines, pose, sigma_point, sigma_line, kernel, H, g)
        if iteration >= iterations or n_matched == 0:
            break
        c, s = math.cos(pose[2]), math.sin(pose[2])
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
        moved += math.hypot(d0, d1) + abs(d2) * reach
        if iteration > 0 and abs(d0) + abs(d1) + abs(d2) < 1e-4:
            iterations = iteration + 1
    n_on = _spread(source, lines, home, pose, sigma_point, sigma_line, spread)
    return n_matched, n_on, squares


@numba.njit(cache=True)
def _spread(
    source: FloatArray,
    lines: FloatArray,
    home: NDArray[np.int64],
    pose: FloatArray,
    sigma_point: float,
    sigma_line: float,
    spread: FloatArray,
) -> int:  # pragma: no cover
    """Fills ``spread`` (4,), see `Spread`; returns how many points are on their lines: those beyond three sigmas are of something else.
    A group ends where the scan leaves a cell."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    limit = 9.0 * (sigma_point * sigma_point + sigma_line * sigma_line)
    spread[:] = 0.0
    n_on, n, total, squares, place = 0, 0, 0.0, 0.0, 0.0
    for i in range(source.shape[0] + 1):
        is_end = i == source.shape[0]
        if n and (is_end or home[i] != home[i - 1]):
            if n >= _MIN_NEIGHBOURS:
                within = squares - total * total / n
                spread[0] += within
                spread[1] += n - 1
                spread[2] += (total / n) ** 2 - within / (n - 1) / n - place / n
                spread[3] += 1.0
            n, total, squares, place = 0, 0.0, 0.0, 0.0
        if is_end or lines[i, 0] == 0.0:
            continue
        x = pose[0] + c * source[i, 0] - s * source[i, 1]
        y = pose[1] + s * source[i, 0] + c * source[i, 1]
        e = lines[i, 1] * (x - lines[i, 3]) + lines[i, 2] * (y - lines[i, 4])
        if e * e < limit + 9.0 * lines[i, 5]:
            n_on += 1
            n += 1
            total += e
            squares += e * e
            place += lines[i, 5]
    return n_on
