"""A hash grid of square cells, each with a bounded number of points that remember when they were inserted, as compiled loops.

The age of a point is the distance that the robot had travelled when it was inserted: old and young parts of the map can be told apart
where the robot comes back to a place, and every use of the map says which ages it means.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from motion_models.se2 import FloatArray

POINTS_PER_CELL = 64
_ENOUGH = 40  # points of the ages that are in use, within half a cell of a point
_AGE_M = 0.25

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


@numba.njit(cache=True)
def find_cell(cells: NDArray[np.int32], ix: int, iy: int) -> int:  # pragma: no cover
    """Slot of the cell, or -1 - slot of the free place for it."""
    mask: int = cells.shape[0] - 1
    slot: int = ((ix * 73856093) ^ (iy * 19349663)) & mask
    while cells[slot, 2] != 0:
        if cells[slot, 0] == ix and cells[slot, 1] == iy:
            return slot
        slot = (slot + 1) & mask
    return -1 - slot


@numba.njit(cache=True)
def is_used(ages: Ages, travel: float) -> bool:  # pragma: no cover
    return bool(ages[min(int(travel / _AGE_M + 0.5), ages.shape[0] - 1)])


@numba.njit(cache=True)
def _stride(n: int) -> int:  # pragma: no cover
    """Near the golden section of ``n`` and without a common divisor, so that all of ``n`` are met, far from each other in turn."""
    stride = int(0.6180339887498949 * n)
    while True:
        a, b = n, stride
        while b:
            a, b = b, a % b
        if a == 1:
            return stride
        stride += 1


@numba.njit(cache=True)
def _count(
    cells: NDArray[np.int32], points: NDArray[np.float32], travels: NDArray[np.float32], ages: Ages, x: float, y: float, cell: float
) -> int:  # pragma: no cover
    """How many points of these ``ages`` are within half a ``cell`` of (x, y).

    Were they counted cell by cell, a wall along the border of two would be drawn as thick on the one side as on the other, wherever it is.
    """
    n = 0
    for jx in range(math.floor(x / cell - 0.5), math.floor(x / cell + 0.5) + 1):
        for jy in range(math.floor(y / cell - 0.5), math.floor(y / cell + 0.5) + 1):
            slot = find_cell(cells, jx, jy)
            if slot < 0:
                continue
            for k in range(cells[slot, 2]):
                dx, dy = points[slot, k, 0] - x, points[slot, k, 1] - y
                n += dx * dx + dy * dy < 0.25 * cell * cell and is_used(ages, travels[slot, k])
    return n


@numba.njit(cache=True)
def insert_points(
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
    stride = _stride(new.shape[0])
    i = 0
    for _ in range(new.shape[0]):
        i = (i + stride) % new.shape[0]
        x = pose[0] + c * new[i, 0] - s * new[i, 1]
        y = pose[1] + s * new[i, 0] + c * new[i, 1]
        ix, iy = math.floor(x / cell), math.floor(y / cell)
        slot = find_cell(cells, ix, iy)
        if slot < 0:
            if used > cells.shape[0] * 3 // 4:
                return used, True
            slot = -1 - slot
        n, unused, near = cells[slot, 2], -1, False
        for k in range(n):
            if not is_used(ages, travels[slot, k]):
                unused = k
                continue
            dx, dy = points[slot, k, 0] - x, points[slot, k, 1] - y
            near = near or dx * dx + dy * dy < min_distance * min_distance
        if near or (n >= points.shape[1] and unused < 0) or _count(cells, points, travels, ages, x, y, cell) >= _ENOUGH:
            continue
        if n == 0:
            used += 1
            cells[slot, 0], cells[slot, 1] = ix, iy
        k = n if n < points.shape[1] else unused
        points[slot, k, 0], points[slot, k, 1] = x, y
        travels[slot, k] = new_travels[i]
        cells[slot, 2] = max(n, k + 1)
    return used, False


@numba.njit(cache=True)
def keep_until(
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
def copy_cells(
    cells: NDArray[np.int32],
    points: NDArray[np.float32],
    travels: NDArray[np.float32],
    to_cells: NDArray[np.int32],
    to_points: NDArray[np.float32],
    to_travels: NDArray[np.float32],
) -> None:  # pragma: no cover
    for i in range(cells.shape[0]):
        slot = -1 - find_cell(to_cells, cells[i, 0], cells[i, 1])
        for j in range(3):
            to_cells[slot, j] = cells[i, j]
        for k in range(cells[i, 2]):
            to_points[slot, k, 0], to_points[slot, k, 1] = points[i, k, 0], points[i, k, 1]
            to_travels[slot, k] = travels[i, k]
