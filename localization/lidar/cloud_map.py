"""Submap of a 3D LiDAR: points of key scans in voxels, and the surface around each, to which clouds are registered point to surface.

    minimise   sum_i rho(n_i^T (T(x) p_i - mu_i) / s_i)  +  |log(prior^-1 x)|^2_P

over the pose x of SE(3), with the mean mu_i, a normal n_i and the variance s_i^2 of the surface around the voxel of each point p_i, and
Geman-McClure's loss rho. Surfaces are distributions (Biber & Strasser 2003; Magnusson 2009): of a plane one direction counts, of an upright
line (a trunk, a pole) the two across it. A single ring of the scanner on the ground is a level line: it moves with the scanner, says
nothing of the ground's direction, and counts nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from localization.lidar.submap import EMPTY_KEY, probe_slots
from localization.trajectory import IntArray
from motion_models import se3
from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray
from motion_models.se3 import Transform3

Point = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
_FIRST_VOXELS = 1 << 14
_MIN_POINTS = 6
"""Points without which voxels have no surface."""
_PLANE_RATIO = 9.0
"""Ratio of the second to the least variance of a plane, at least: sigma across is a third of that along."""
_UPRIGHT = 0.8
"""Cosine of a line's angle with the vertical, from which on it is a trunk or pole."""
_KERNEL = 3.0
"""Scale of Geman-McClure's loss, and residuals of inliers, in sigmas."""
_THINNING = 0.4
"""Edge of the cubes with one point each, in voxels: 3,300 of the 5,200 points of 16 rings on hills."""
_INLIER_WEIGHT = 0.25
"""Weight by Geman-McClure's loss at `_KERNEL` sigmas, over that at none."""
_REACH = 0.5
"""Distance along a surface from its mean, up to which it holds, in voxels; points of a plane are spread at least as far. Farther ones are
beyond the end of the map, where a plane misses ground that bends by h = .08 1/m by h d^2 / 2 = 10 mm at d = .5 m, and a ring or two of the
scanner, drawn from poses that drift, lean in the direction of the drift."""
_BLOCK = 2
"""Voxels along each side of a block, whose residuals err together."""
_BLOCKS = 1 << 13
_ROWS, _COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Places of the second moments xx, xy, xz, yy, yz, zz in their matrix."""
_SWEEPS = 6
"""Sweeps of Jacobi's rotations, until off-diagonal entries vanish."""
_ITERATIONS, _MIN_STEP = 20, 0.05
"""Most steps of Gauss-Newton, and length below which a step is the last [sigmas]."""
_OPEN_INFORMATION = np.diag([1e-2, 1e-2, 1e-2, 1.0, 1.0, 1.0])
"""Added to the information of a match, so that an open direction has a sigma of 10 m or 1 rad [1/m^2, 1/rad^2]."""
SYSTEMATIC_COV = np.diag([1.5e-3, 1.5e-3, 1.5e-3, 2e-4, 2e-4, 2e-4]) ** 2
"""Covariance of errors that all points of a cloud share, which no residual shows: ground that is not plane within the pooled voxels, and
motion that changes within a sweep. Clouds matched to maps of true poses err by .5 to 1.4 mm and .04 to .35 mrad beyond their noise
[m^2, rad^2]."""


class CloudGrid(NamedTuple):
    """The arrays of a submap, as compiled loops take them."""

    cell: float
    """Edge of a voxel [m]."""
    noise: float
    """Variance of a range [m^2], which every surface has at least."""
    slots: IntArray
    """(H, 2) hash table with open addressing: key of a cell, row of its voxel. H is a power of two."""
    cells: IntArray
    """(V, 3) indices of each voxel in the grid."""
    sums: FloatArray
    """(V, 10) number of points, their sums of x, y, z, x^2, x y, x z, y^2, y z, z^2 from the voxel's corner."""
    surfaces: FloatArray
    """(V, 13) mean (3), two normals (6), the variances along them [m^2], infinite where there is none, and the variances of the first one's
    turns towards the second and across both [rad^2]. NaN until first used."""


@dataclass(frozen=True)
class CloudMatch:
    """Where a cloud fits into the submap."""

    pose: Transform3
    """(4, 4) ``odom_T_body`` that cloud and prior give together."""
    measured: Transform3
    """(4, 4) the pose that the cloud alone gives: the prior's share is taken off."""
    cov: FloatArray
    """(6, 6) of the right perturbation of ``measured``; wide open along directions that the scene leaves open."""
    overlap: float
    """Share of the points with a surface that are within 3 sigma of it."""
    mapped: int
    """Points with a surface."""


class CloudMap:
    """`insert` clouds and `match` others to them. Points are (N, 3) in the body frame [m]."""

    def __init__(self, cell: float, noise_m: float) -> None:
        self._n = 0
        self._grid = _make_grid(cell, noise_m**2, _FIRST_VOXELS)

    def insert(self, pose: Transform3, points: FloatArray) -> tuple[float, float]:
        """Add ``points``, measured from ``pose``; the mean share that they have of all points in their voxels, and that of those whose
        voxels were empty, 0 to 1."""
        while len(self._grid.cells) - self._n < len(points):
            self._grow()
        self._n, share, new = _insert(self._grid, self._n, se3.transform(pose, points))
        return share, new

    @property
    def cell(self) -> float:
        """Edge of a voxel [m]."""
        return self._grid.cell

    def match(self, points: FloatArray, prior: Transform3, cov: FloatArray) -> CloudMatch:
        """Register ``points`` from ``prior`` on, with the covariance (6, 6) of its right perturbation."""
        pose, information, scratch = prior, np.linalg.inv(cov), np.zeros((1, 6))
        for _ in range(_ITERATIONS):
            keep, H, gradient, _ = self._information(points, pose, scratch)
            off = se3.log(se3.compose(se3.inverse(prior), pose))
            step = -np.asarray(np.linalg.solve(H + information, gradient + information @ off), dtype=float)
            pose = se3.compose(pose, se3.exp(step))
            if step @ (H + information) @ step < _MIN_STEP**2:
                break
        blocks = np.zeros((_BLOCKS, 6))
        keep, H, gradient, counts = self._information(points, pose, blocks)
        inverse = np.linalg.inv(H + _OPEN_INFORMATION)
        measured = se3.compose(pose, se3.exp(-inverse @ gradient))
        R = inverse @ (keep @ blocks.T @ blocks @ keep.T + _OPEN_INFORMATION) @ inverse
        return CloudMatch(pose, measured, R, float(counts[1]) / max(float(counts[0]), 1.0), int(counts[0]))

    def inlier_share(self, points: FloatArray, pose: Transform3) -> float:
        """Share of ``points`` (N, 3) within 3 sigma of a surface, as seen from ``pose`` (4, 4)."""
        _, _, _, counts = _linearize(self._grid, points, pose, np.zeros((1, 6)))
        return float(counts[1]) / max(len(points), 1)

    def _information(self, points: FloatArray, pose: Transform3, blocks: FloatArray) -> tuple[FloatArray, ...]:
        """M (6, 6), information M H, gradient M g, and counts as of `_linearize`: M takes off what comes from the noise of normals.

        On bare ground that would hold the robot where it is. In the directions where the share m of spurious information is largest,
        information is scaled by 1 - 2 m, at least 0: it is as likely to be false as not from m = 1/2 on. Directions are those of both
        matrices' generalised eigenvectors.
        """
        H, spurious, gradient, counts = _linearize(self._grid, points, pose, blocks)
        L = np.linalg.cholesky(H + 1e-6 * np.eye(6))
        whitener = np.linalg.inv(L)
        shares, U = np.linalg.eigh(whitener @ spurious @ whitener.T)
        keep = L @ (U * np.maximum(1.0 - 2.0 * shares, 0.0)) @ U.T @ whitener
        return keep, keep @ H, keep @ gradient, counts

    def points(self) -> FloatArray:
        """(V, 3) mean of the points in each voxel [m]."""
        g = self._grid
        return np.asarray(g.cells[: self._n] * g.cell + g.sums[: self._n, 1:4] / g.sums[: self._n, :1])

    def _grow(self) -> None:
        old = self._grid
        self._grid = _make_grid(old.cell, old.noise, 2 * len(old.cells))
        for new, before in zip(self._grid[3:], old[3:], strict=True):
            new[: self._n] = before[: self._n]
        _index(self._grid, self._n)


def thin(points: FloatArray, cell: float) -> FloatArray:
    """(M, 3) the first of the ``points`` (N, 3) in each cube with an edge of `_THINNING` voxels of ``cell`` [m]."""
    i, j, k = np.floor(points / (_THINNING * cell)).astype(np.int64).T
    _, kept = np.unique((i << 42) ^ ((j & 0x1FFFFF) << 21) ^ (k & 0x1FFFFF), return_index=True)
    return np.ascontiguousarray(points[np.sort(kept)])


def _make_grid(cell: float, noise: float, voxels: int) -> CloudGrid:
    slots = np.full((2 * voxels, 2), EMPTY_KEY, dtype=np.int64)
    return CloudGrid(cell, noise, slots, np.empty((voxels, 3), np.int64), np.zeros((voxels, 10)), np.full((voxels, 13), np.nan))


@subroutine
def _find_slot(slots: IntArray, i: int, j: int, k: int) -> int:
    """Index of the slot that holds cell (i, j, k), or of the empty one where it belongs."""
    return probe_slots(slots, ((i & 0x1FFFFF) << 42) | ((j & 0x1FFFFF) << 21) | (k & 0x1FFFFF))


@subroutine
def _set_slot(slots: IntArray, at: int, i: int, j: int, k: int, row: int) -> None:
    slots[at, 0] = ((i & 0x1FFFFF) << 42) | ((j & 0x1FFFFF) << 21) | (k & 0x1FFFFF)
    slots[at, 1] = row


@kernel
def _index(grid: CloudGrid, n: int) -> None:
    """Fill the hash table with the first ``n`` voxels."""
    for v in range(n):
        i, j, k = grid.cells[v, 0], grid.cells[v, 1], grid.cells[v, 2]
        _set_slot(grid.slots, _find_slot(grid.slots, i, j, k), i, j, k, v)


@kernel
def _insert(grid: CloudGrid, n: int, points: FloatArray) -> tuple[int, float, float]:
    """Add ``points`` (N, 3) of the world; the number of voxels then, the mean share of the points in their voxels, and that of those whose
    voxels were empty."""
    rows, counts = np.empty(points.shape[0], np.int64), np.zeros(len(grid.cells))
    for p in range(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        i, j, k = math.floor(x / grid.cell), math.floor(y / grid.cell), math.floor(z / grid.cell)
        at = _find_slot(grid.slots, i, j, k)
        if grid.slots[at, 0] == EMPTY_KEY:
            _set_slot(grid.slots, at, i, j, k, n)
            grid.cells[n, 0], grid.cells[n, 1], grid.cells[n, 2] = i, j, k
            n += 1
        v = grid.slots[at, 1]
        rows[p] = v
        counts[v] += 1.0
        x, y, z = x - i * grid.cell, y - j * grid.cell, z - k * grid.cell
        s = grid.sums[v]
        s[0] += 1.0
        s[1] += x
        s[2] += y
        s[3] += z
        s[4] += x * x
        s[5] += x * y
        s[6] += x * z
        s[7] += y * y
        s[8] += y * z
        s[9] += z * z
    share, new = 0.0, 0.0
    for p in range(points.shape[0]):
        v = rows[p]
        share += counts[v] / grid.sums[v, 0]
        new += counts[v] == grid.sums[v, 0]
        if counts[v] > 0.0:
            _forget_surfaces(grid, v)
    return n, share / max(points.shape[0], 1), new / max(points.shape[0], 1)


@subroutine
def _neighbour(grid: CloudGrid, i: int, j: int, k: int, n: int) -> int:
    """Row of the voxel in the ``n``-th of the 27 cells around cell (i, j, k), which is the 13th; -1 where there is none."""
    at = _find_slot(grid.slots, i + n // 9 - 1, j + n // 3 % 3 - 1, k + n % 3 - 1)
    return int(grid.slots[at, 1]) if grid.slots[at, 0] != EMPTY_KEY else -1


@subroutine
def _forget_surfaces(grid: CloudGrid, v: int) -> None:
    """The surfaces around voxel ``v`` have changed."""
    for n in range(27):
        w = _neighbour(grid, grid.cells[v, 0], grid.cells[v, 1], grid.cells[v, 2], n)
        if w >= 0:
            grid.surfaces[w, 0] = math.nan


@subroutine
def _fill_surface(grid: CloudGrid, v: int) -> None:
    """Pool the points of voxel ``v`` and of the 26 around it: mean, and the directions of little spread."""
    out, C, V = grid.surfaces[v], np.empty((3, 3)), np.eye(3)
    n = _pool(grid, v, out, C)
    for _ in range(_SWEEPS):
        _rotate_pair(C, V, 0, 1)
        _rotate_pair(C, V, 0, 2)
        _rotate_pair(C, V, 1, 2)
    least, most = 0, 0
    for a in range(3):
        least = a if C[a, a] < C[least, least] else least
        most = a if C[a, a] >= C[most, most] else most
    middle = 3 - least - most
    is_known = n >= _MIN_POINTS and least != most
    low, mid = max(C[least, least], 0.0) + grid.noise, max(C[middle, middle], 0.0) + grid.noise
    for a in range(3):
        out[3 + a], out[6 + a] = V[a, least], V[a, middle]
    is_wide = C[middle, middle] > (_REACH * grid.cell) ** 2 / 3.0  # of points spread evenly over the reach to both sides
    is_plane = is_wide and mid > _PLANE_RATIO * low
    is_upright = abs(V[2, most]) > _UPRIGHT and C[most, most] > _PLANE_RATIO * mid
    out[9] = low if is_known and (is_plane or is_upright) else math.inf
    out[10] = mid if is_known and is_upright else math.inf
    out[11] = 0.0 if is_upright else low / (n * mid)  # of a fit: variance across over the spread along
    out[12] = low / (n * C[most, most])


@subroutine
def _pool(grid: CloudGrid, v: int, mean: FloatArray, C: FloatArray) -> float:
    """Fill ``mean`` (3,) and covariance ``C`` (3, 3) of the points around voxel ``v``; their number."""
    i, j, k, cell = grid.cells[v, 0], grid.cells[v, 1], grid.cells[v, 2], grid.cell
    count, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for n in range(27):
        w = _neighbour(grid, i, j, k, n)
        if w < 0:
            continue
        s, shift = grid.sums[w], ((n // 9 - 1) * cell, (n // 3 % 3 - 1) * cell, (n % 3 - 1) * cell)
        count += s[0]
        for e in range(6):
            a, b = _ROWS[e], _COLUMNS[e]
            second[a, b] += s[4 + e] + shift[a] * s[1 + b] + shift[b] * s[1 + a] + shift[a] * shift[b] * s[0]
        for a in range(3):
            first[a] += s[1 + a] + shift[a] * s[0]
    for e in range(6):
        a, b = _ROWS[e], _COLUMNS[e]
        C[a, b] = C[b, a] = second[a, b] / count - first[a] * first[b] / (count * count)
    for a in range(3):
        mean[a] = grid.cells[v, a] * cell + first[a] / count
    return count


@subroutine
def _rotate_pair(C: FloatArray, V: FloatArray, p: int, q: int) -> None:
    """Turn axes p and q of a symmetric matrix (3, 3), and the columns of ``V``, so that ``C[p, q]`` is zero (Jacobi)."""
    if abs(C[p, q]) < 1e-15:
        return
    theta = 0.5 * math.atan2(2.0 * C[p, q], C[q, q] - C[p, p])
    c, s = math.cos(theta), math.sin(theta)
    for a in range(3):
        x, y, v, w = C[a, p], C[a, q], V[a, p], V[a, q]
        C[a, p], C[a, q], V[a, p], V[a, q] = c * x - s * y, s * x + c * y, c * v - s * w, s * v + c * w
    for a in range(3):
        x, y = C[p, a], C[q, a]
        C[p, a], C[q, a] = c * x - s * y, s * x + c * y


@subroutine
def _nearest(grid: CloudGrid, x: float, y: float, z: float) -> int:
    """The voxel in the cell of a point, or the one beside it whose mean is nearest; -1 where there is none."""
    cell = grid.cell
    i, j, k = math.floor(x / cell), math.floor(y / cell), math.floor(z / cell)
    found = _neighbour(grid, i, j, k, 13)
    if found >= 0:
        return found
    best = math.inf
    for n in range(27):
        w = _neighbour(grid, i, j, k, n)
        if w < 0:
            continue
        s = grid.sums[w]
        dx = grid.cells[w, 0] * cell + s[1] / s[0] - x
        dy = grid.cells[w, 1] * cell + s[2] / s[0] - y
        dz = grid.cells[w, 2] * cell + s[3] / s[0] - z
        d2 = dx * dx + dy * dy + dz * dz
        best, found = (d2, w) if d2 < best else (best, found)
    return found


@kernel
def _linearize(grid: CloudGrid, points: FloatArray, pose: Transform3, blocks: FloatArray) -> tuple[FloatArray, ...]:
    """Information (6, 6), what of it comes from the noise of normals (6, 6), gradient (6,) of half the cost, numbers of points with a
    surface and of inliers.

    ``blocks`` (B, 6): the gradient's parts by blocks of voxels are added to it.
    """
    H, spurious, gradient, counts = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(2)
    for p in range(points.shape[0]):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
        y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
        z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
        v = _nearest(grid, x, y, z)
        if v < 0:
            continue
        if math.isnan(grid.surfaces[v, 0]):
            _fill_surface(grid, v)
        s = grid.surfaces[v]
        if not s[9] < math.inf:
            continue
        i, j, k = grid.cells[v, 0] // _BLOCK, grid.cells[v, 1] // _BLOCK, grid.cells[v, 2] // _BLOCK
        block = blocks[(i * 73856093 ^ j * 19349663 ^ k * 83492791) % len(blocks)]  # Teschner et al. 2003
        off = (x - s[0], y - s[1], z - s[2])
        first, second = (s[3], s[4], s[5]), (s[6], s[7], s[8])
        third = (
            first[1] * second[2] - first[2] * second[1],
            first[2] * second[0] - first[0] * second[2],
            first[0] * second[1] - first[1] * second[0],
        )
        across = (_dot(first, off), _dot(second, off), _dot(third, off))
        is_line = s[10] < math.inf
        along = math.sqrt((0.0 if is_line else across[1] ** 2) + across[2] ** 2)
        share = 1.0 if along < _REACH * grid.cell else 0.0
        J = _by_pose(pose, (a, b, c), first)
        weight = _add_residual(H, gradient, block, J, across[0], s[9], share)
        _add_outer(spurious, _by_pose(pose, (a, b, c), second), share * weight * min(s[11], 1.0))
        _add_outer(spurious, _by_pose(pose, (a, b, c), third), share * weight * min(s[12], 1.0))
        least = weight * s[9]
        if is_line:
            J = _by_pose(pose, (a, b, c), second)
            least = min(least, _add_residual(H, gradient, block, J, across[1], s[10], share) * s[10])
        counts[0] += 1.0
        counts[1] += least > _INLIER_WEIGHT
    return H, spurious, gradient, counts


@subroutine
def _dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@subroutine
def _by_pose(pose: Transform3, point: Point, direction: Point) -> Six:
    """Derivative of where a ``point`` of the body is along a ``direction``, by the pose's right perturbation."""
    u, v, w = direction
    x = pose[0, 0] * u + pose[1, 0] * v + pose[2, 0] * w
    y = pose[0, 1] * u + pose[1, 1] * v + pose[2, 1] * w
    z = pose[0, 2] * u + pose[1, 2] * v + pose[2, 2] * w
    return x, y, z, point[1] * z - point[2] * y, point[2] * x - point[0] * z, point[0] * y - point[1] * x


@subroutine
def _add_residual(H: FloatArray, gradient: FloatArray, block: FloatArray, J: Six, r: float, variance: float, share: float) -> float:
    """Add the ``share`` of a residual ``r`` with derivative ``J`` that counts; its whole weight."""
    weight = 1.0 / ((1.0 + r * r / (variance * _KERNEL * _KERNEL)) ** 2 * variance)
    _add_outer(H, J, share * weight)
    for d in range(6):
        gradient[d] += share * weight * r * J[d]
        block[d] += share * weight * r * J[d]
    return weight


@subroutine
def _add_outer(total: FloatArray, J: Six, weight: float) -> None:
    """Add ``weight`` J J^T to ``total`` (6, 6)."""
    for d in range(6):
        for e in range(6):
            total[d, e] += weight * J[d] * J[e]
