"""Beams that a map contradicts: those that go on behind a wall of it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from localization.maps.grid import Grid
from motion_models import se2
from motion_models.compiled import threaded_kernel
from motion_models.se2 import FloatArray, Pose2

_MIN_LENGTH_M = 0.8
"""Length from which on a beam counts [m]."""
_IGNORED_END_M = 0.4
"""The last part of a beam, which is beside the wall that it ends on [m]."""
_BEHIND_M = 0.3
"""How far behind the wall a beam is in unknown space [m]: one along a wall has cells of it on its way."""


def share_behind_walls(grid: Grid, pose: Pose2, beams: FloatArray) -> float:
    """Share of ``beams`` (M, 4) from x, y to x, y of the body frame at ``pose`` (3,) that pass a wall of ``grid`` and unknown space behind
    it [m]; 0 without any. A wall that was taken away has free space behind it."""
    begin, end = (se2.transform(pose, beams[:, part]) - grid.origin for part in (slice(0, 2), slice(2, 4)))
    return float(_share_behind(grid.cells, np.ascontiguousarray(begin), np.ascontiguousarray(end), grid.resolution))


@threaded_kernel
def _share_behind(cells: NDArray[np.int8], begin: FloatArray, end: FloatArray, cell_m: float) -> float:
    """Share of beams from ``begin`` (M, 2) to ``end`` (M, 2), from the corner of ``cells`` (H, W): 100 a wall, -1 unknown."""
    n, n_behind, height, width = 0, 0, cells.shape[0], cells.shape[1]
    for i in range(begin.shape[0]):
        dx, dy = end[i, 0] - begin[i, 0], end[i, 1] - begin[i, 1]
        length = math.hypot(dx, dy)
        if length < _MIN_LENGTH_M:
            continue
        n += 1
        wall_m = np.inf
        for step in range(int((length - _IGNORED_END_M) / cell_m)):
            way_m = step * cell_m
            column = math.floor((begin[i, 0] + dx * way_m / length) / cell_m)
            row = math.floor((begin[i, 1] + dy * way_m / length) / cell_m)
            is_inside = row >= 0 and column >= 0 and row < height and column < width
            cell = cells[row, column] if is_inside else -1
            if cell == 100:
                wall_m = min(wall_m, way_m)
            elif cell == -1 and way_m > wall_m + _BEHIND_M:
                n_behind += 1
                break
    return n_behind / max(n, 1)
