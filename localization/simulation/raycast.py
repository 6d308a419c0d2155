"""Rays against a floor plan, compiled: a uniform grid of wall segments, walked cell by cell (Amanatides & Woo, 1987)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from localization.simulation.world import GLASS
from motion_models.se2 import FloatArray

IntArray = NDArray[np.int64]
_GLASS_MIRRORS = 0.985  # glass returns a beam that meets it within 10 degrees of its normal, and lets others pass
_FAR = 1e9


class Grid(NamedTuple):
    """Wall segments, and which of them touch each cell."""

    x0: float
    y0: float
    cell: float
    columns: int
    rows: int
    first: IntArray
    """(rows * columns + 1,) where each cell's list begins in `items`."""
    items: IntArray
    walls: FloatArray
    """(n, 5) as `World.walls`."""


def make_grid(walls: FloatArray, cell: float = 0.5) -> Grid:
    """The grid of ``walls`` (n, 5), with cells of ``cell`` [m]."""
    if len(walls) == 0:
        return Grid(0.0, 0.0, 1.0, 1, 1, np.zeros(2, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 5)))
    ends = walls[:, :4].reshape(-1, 2)
    low, high = ends.min(axis=0) - 0.5 * cell, ends.max(axis=0) + 0.5 * cell
    columns, rows = (math.ceil(span / cell) for span in high - low)
    lists: list[list[int]] = [[] for _ in range(rows * columns)]
    for k, (xa, ya, xb, yb, _) in enumerate(walls):
        i0, i1 = sorted(int((x - low[0]) / cell) for x in (xa, xb))
        j0, j1 = sorted(int((y - low[1]) / cell) for y in (ya, yb))
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                centre = low + cell * (np.array([i, j]) + 0.5)
                if _distance(centre[0], centre[1], xa, ya, xb, yb) <= 0.7072 * cell:
                    lists[j * columns + i].append(k)
    first = np.concatenate([[0], np.cumsum([len(one) for one in lists])]).astype(np.int64)
    items = np.array([k for one in lists for k in one], dtype=np.int64)
    return Grid(float(low[0]), float(low[1]), cell, columns, rows, first, items, np.ascontiguousarray(walls))


@numba.njit(cache=True, error_model="numpy")
def cast(x: float, y: float, angle: float, longest: float, grid: Grid) -> float:  # pragma: no cover
    """Distance to the first wall that returns the beam from ``x, y`` along ``angle``; inf if none does within ``longest`` [m]."""
    ux, uy = math.cos(angle), math.sin(angle)
    # Enter the grid.
    begin, end = 0.0, longest
    for axis in range(2):
        p, u = (x - grid.x0, ux) if axis == 0 else (y - grid.y0, uy)
        size = grid.cell * (grid.columns if axis == 0 else grid.rows)
        if abs(u) < 1e-12:
            if p < 0.0 or p > size:
                return math.inf
        else:
            a, b = -p / u, (size - p) / u
            begin, end = max(begin, min(a, b)), min(end, max(a, b))
    if begin > end:
        return math.inf
    px, py = (x + begin * ux - grid.x0) / grid.cell, (y + begin * uy - grid.y0) / grid.cell
    i, j = min(max(int(px), 0), grid.columns - 1), min(max(int(py), 0), grid.rows - 1)
    step_i, step_j = (1 if ux > 0.0 else -1), (1 if uy > 0.0 else -1)
    per_i = grid.cell / abs(ux) if abs(ux) > 1e-12 else _FAR
    per_j = grid.cell / abs(uy) if abs(uy) > 1e-12 else _FAR
    next_i = begin + ((i + 1 - px) if step_i > 0 else (px - i)) * per_i if per_i < _FAR else _FAR
    next_j = begin + ((j + 1 - py) if step_j > 0 else (py - j)) * per_j if per_j < _FAR else _FAR

    nearest = math.inf
    while True:
        cell = j * grid.columns + i
        for at in range(grid.first[cell], grid.first[cell + 1]):
            wall = grid.walls[grid.items[at]]
            ax, ay = wall[0] - x, wall[1] - y
            ex, ey = wall[2] - wall[0], wall[3] - wall[1]
            cross = ux * ey - uy * ex
            if cross == 0.0:
                continue
            t = (ax * ey - ay * ex) / cross
            s = (ax * uy - ay * ux) / cross
            if t <= 0.0 or t >= nearest or s < 0.0 or s > 1.0:
                continue
            if wall[4] == GLASS and abs(cross) < _GLASS_MIRRORS * math.sqrt(ex * ex + ey * ey):
                continue
            nearest = t
        leave = min(next_i, next_j)
        if nearest <= leave or leave > end:
            break
        if next_i < next_j:
            i, next_i = i + step_i, next_i + per_i
            if i < 0 or i >= grid.columns:
                break
        else:
            j, next_j = j + step_j, next_j + per_j
            if j < 0 or j >= grid.rows:
                break
    return nearest if nearest <= longest else math.inf


@numba.njit(cache=True, error_model="numpy")
def cast_at_people(x: float, y: float, angle: float, t: float, people: FloatArray) -> float:  # pragma: no cover
    """Distance to the nearest person at time ``t`` [s]; inf if the beam meets none."""
    ux, uy = math.cos(angle), math.sin(angle)
    nearest = math.inf
    for k in range(people.shape[0]):
        cx, cy = person_at(people[k], t)
        along = (cx - x) * ux + (cy - y) * uy
        across = (cx - x) * uy - (cy - y) * ux
        inside = people[k, 5] * people[k, 5] - across * across
        if along > 0.0 and inside > 0.0:
            nearest = min(nearest, max(along - math.sqrt(inside), 0.0))
    return nearest


@numba.njit(cache=True, error_model="numpy")
def person_at(person: FloatArray, t: float) -> tuple[float, float]:  # pragma: no cover
    """Where a person of `World.people` is at time ``t`` [s]."""
    ex, ey = person[2] - person[0], person[3] - person[1]
    length = max(math.sqrt(ex * ex + ey * ey), 1e-9)
    phase = (t * person[4] / length) % 2.0
    f = phase if phase < 1.0 else 2.0 - phase
    return person[0] + f * ex, person[1] + f * ey


@numba.njit(cache=True, error_model="numpy")
def clearance(x: float, y: float, walls: FloatArray) -> float:  # pragma: no cover
    """Distance of ``x, y`` to the nearest wall [m]; inf without walls."""
    least = math.inf
    for k in range(walls.shape[0]):
        least = min(least, _distance(x, y, walls[k, 0], walls[k, 1], walls[k, 2], walls[k, 3]))
    return least


@numba.njit(cache=True, error_model="numpy")
def _distance(x: float, y: float, xa: float, ya: float, xb: float, yb: float) -> float:  # pragma: no cover
    ex, ey = xb - xa, yb - ya
    square = ex * ex + ey * ey
    f = ((x - xa) * ex + (y - ya) * ey) / square if square > 0.0 else 0.0
    f = min(1.0, max(0.0, f))
    return math.sqrt((x - xa - f * ex) ** 2 + (y - ya - f * ey) ** 2)
