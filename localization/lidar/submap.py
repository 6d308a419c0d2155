"""Submap: the points of the last key scans in voxels, each with mean, normal and thickness of the surface around it.

A surface is a distribution, not a line: a thick, cluttered one simply counts less (Biber & Strasser 2003, normal distributions transform).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from localization.trajectory import IntArray
from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray, Points2

POOLED_VOXELS = 5
"""Voxels whose points are pooled for one surface: fewer give no direction along sparse walls, more round off corners."""
MAX_RINGS = 4
"""How many voxels away the pooled ones may be; what is sparser than that has no surface."""
EMPTY_KEY = -(1 << 62)
"""Key of a slot that holds no voxel."""


class VoxelGrid(NamedTuple):
    """The arrays of a submap, as compiled loops take them."""

    cell: float
    """Edge of a voxel [m]."""
    noise: float
    """Variance of a range [m^2], which every surface has at least."""
    origin: FloatArray
    """(2,) from which the voxels' sums are taken [m]."""
    slots: IntArray
    """(H, 2) hash table with open addressing: key of a cell, row of its voxel. H is a power of two."""
    cells: IntArray
    """(V, 2) column and row of each voxel in the grid."""
    sums: FloatArray
    """(V, 6) number of points, and their sums of x, y, x^2, x y, y^2."""
    surfaces: FloatArray
    """(V, 6) mean (2), normal (2), variance along it [m^2] and variance of its angle [rad^2] around each voxel. Filled when first used: NaN
    until then."""

    @property
    def means(self) -> Points2:
        """(V, 2) of the points in each voxel [m]."""
        return np.asarray(self.sums[:, 1:3] / self.sums[:, :1] + self.origin)


def make_grid(points: Points2, cell: float, noise_m: float) -> VoxelGrid:
    """Voxels with edge ``cell`` [m] of ``points`` (N, 2) [m], whose ranges have sigma ``noise_m`` [m]."""
    origin = np.floor(points.mean(axis=0) / cell) * cell if len(points) else np.zeros(2)
    slots = np.full((1 << max(4, math.ceil(math.log2(2 * len(points) + 1))), 2), EMPTY_KEY, dtype=np.int64)
    cells, sums = np.empty((len(points), 2), dtype=np.int64), np.zeros((len(points), 6))
    n = _fill(points, cell, origin, slots, cells, sums)
    return VoxelGrid(cell, noise_m**2, origin, slots, cells[:n], sums[:n], np.full((n, 6), np.nan))


def voxel_means(points: Points2, cell: float) -> Points2:
    """(M, 2) the mean of ``points`` (N, 2) in each voxel with edge ``cell`` [m]."""
    return make_grid(points, cell, 0.0).means


@subroutine
def probe_slots(slots: IntArray, key: int) -> int:
    """Index of the slot that holds ``key``, or of the empty one where it belongs (open addressing, linear probing)."""
    mask = slots.shape[0] - 1
    scattered = key * -7046029254386353131  # 2^64 / golden ratio (Knuth, multiplicative hashing)
    at = ((scattered >> 32) ^ scattered) & mask
    while slots[at, 0] != EMPTY_KEY and slots[at, 0] != key:
        at = (at + 1) & mask
    return int(at)


@subroutine
def find_slot(slots: IntArray, i: int, j: int) -> int:
    """Index of the slot that holds cell (i, j), or of the empty one where it belongs."""
    return probe_slots(slots, (i << 32) ^ (j & 0xFFFFFFFF))


@subroutine
def find_voxel(slots: IntArray, i: int, j: int) -> int:
    """Row of the voxel in cell (i, j); -1 where there is none."""
    at = find_slot(slots, i, j)
    return int(slots[at, 1]) if slots[at, 0] != EMPTY_KEY else -1


@kernel
def _fill(points: Points2, cell: float, origin: FloatArray, slots: IntArray, cells: IntArray, sums: FloatArray) -> int:
    """Sort ``points`` into voxels; returns how many there are."""
    n = 0
    for p in range(points.shape[0]):
        x, y = points[p, 0] - origin[0], points[p, 1] - origin[1]
        i, j = math.floor(x / cell), math.floor(y / cell)
        at = find_slot(slots, i, j)
        if slots[at, 0] == EMPTY_KEY:
            slots[at, 0], slots[at, 1] = (i << 32) ^ (j & 0xFFFFFFFF), n
            cells[n, 0], cells[n, 1] = i, j
            n += 1
        v = slots[at, 1]
        sums[v, 0] += 1.0
        sums[v, 1] += x
        sums[v, 2] += y
        sums[v, 3] += x * x
        sums[v, 4] += x * y
        sums[v, 5] += y * y
    return n


@subroutine
def find_nearest(grid: VoxelGrid, x: float, y: float, reach: float) -> int:
    """The voxel whose mean is nearest to (x, y) [m, from the grid's origin], or -1 where none is within ``reach`` [m]."""
    cell, slots, sums = grid.cell, grid.slots, grid.sums
    i, j = math.floor(x / cell), math.floor(y / cell)
    border = min(x - i * cell, (i + 1) * cell - x, y - j * cell, (j + 1) * cell - y)
    best, nearest = reach * reach, -1
    ring = 0
    while ring == 0 or ((ring - 1) * cell + border) ** 2 < best:
        for di in range(-ring, ring + 1):
            gap_x = _gap(x, i + di, cell)
            stride = 1 if abs(di) == ring else 2 * ring
            for dj in range(-ring, ring + 1, max(stride, 1)):
                is_near = gap_x * gap_x + _gap(y, j + dj, cell) ** 2 < best  # else no mean in this cell is nearer
                best, nearest = _nearer(sums, find_voxel(slots, i + di, j + dj) if is_near else -1, x, y, best, nearest)
        ring += 1
    return nearest


@subroutine
def _gap(x: float, i: int, cell: float) -> float:
    """Distance [m] of ``x`` from cell ``i`` along one axis; 0 inside."""
    return max(i * cell - x, x - (i + 1) * cell, 0.0)


@subroutine
def _nearer(sums: FloatArray, v: int, x: float, y: float, best: float, nearest: int) -> tuple[float, int]:
    """Squared distance [m^2] and row of the nearer one of voxel ``v``, if it is one, and of the ``nearest`` so far."""
    d2 = _squared_distance(sums, v, x, y) if v >= 0 else math.inf
    return (d2, v) if d2 < best else (best, nearest)


@subroutine
def _squared_distance(sums: FloatArray, v: int, x: float, y: float) -> float:
    n = sums[v, 0]
    return (sums[v, 1] / n - x) ** 2 + (sums[v, 2] / n - y) ** 2  # type: ignore[no-any-return]


@subroutine
def fill_surface(grid: VoxelGrid, v: int) -> None:
    """Pool the points of the `POOLED_VOXELS` voxels nearest to voxel ``v``: mean, direction of least spread, and the spread along it."""
    slots, sums = grid.slots, grid.sums
    i, j, n = grid.cells[v, 0], grid.cells[v, 1], sums[v, 0]
    x, y = sums[v, 1] / n, sums[v, 2] / n
    d2s, rows, total = np.empty(POOLED_VOXELS), np.empty(POOLED_VOXELS, dtype=np.int64), np.empty(6)  # the nearest so far, in order
    d2s[:], total[:] = math.inf, 0.0
    found, ring = 0, 0
    while ring == 0 or (found < POOLED_VOXELS and ring <= MAX_RINGS):
        for di in range(-ring, ring + 1):
            for dj in range(-ring, ring + 1, 1 if abs(di) == ring else max(2 * ring, 1)):
                w = find_voxel(slots, i + di, j + dj)
                found += w >= 0
                _insert_sorted(d2s, rows, _squared_distance(sums, w, x, y) if w >= 0 else math.inf, w)
        ring += 1
    for k in range(min(found, POOLED_VOXELS)):
        for c in range(6):
            total[c] += sums[rows[k], c]
    mx, my = total[1] / total[0], total[2] / total[0]
    xx, xy, yy = total[3] / total[0] - mx * mx, total[4] / total[0] - mx * my, total[5] / total[0] - my * my
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    least, most = 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy), 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)
    out = grid.surfaces[v]
    out[0], out[1], out[2], out[3] = mx, my, -math.sin(angle), math.cos(angle)
    out[4] = max(least, 0.0) + grid.noise if found >= 3 else math.inf  # two voxels have a direction, but no thickness
    out[5] = out[4] / (total[0] * most) if most > 0.0 else math.inf  # of a line fit: variance across over the spread along


@subroutine
def _insert_sorted(d2s: FloatArray, rows: IntArray, d2: float, row: int) -> None:
    """Insert ``d2`` and ``row`` into both, sorted by ``d2``; the largest drops out."""
    k = len(d2s) - 1
    if not d2 < d2s[k]:
        return
    while k > 0 and d2 < d2s[k - 1]:
        d2s[k], rows[k] = d2s[k - 1], rows[k - 1]
        k -= 1
    d2s[k], rows[k] = d2, row


@kernel
def measure_shares(grid: VoxelGrid, scan: VoxelGrid) -> tuple[float, float]:
    """Shares, 0 to 1, of the points of ``scan``, which has the cells of ``grid``.

    First the share that they would have of all points in their voxels, in the mean: 1 / (n + 1) in a place that was mapped by n scans like
    this one. Second, the share of the points whose voxels were empty.
    """
    share, points, new = 0.0, 0.0, 0.0
    di = math.floor((scan.origin[0] - grid.origin[0]) / grid.cell + 0.5)
    dj = math.floor((scan.origin[1] - grid.origin[1]) / grid.cell + 0.5)
    for w in range(scan.cells.shape[0]):
        v = find_voxel(grid.slots, scan.cells[w, 0] + di, scan.cells[w, 1] + dj)
        n = scan.sums[w, 0]
        share += n * (1.0 if v < 0 else n / (n + grid.sums[v, 0]))
        points += n
        new += n if v < 0 else 0.0
    return share / max(points, 1.0), new / max(points, 1.0)
