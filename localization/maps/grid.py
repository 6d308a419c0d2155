"""Occupancy grid of a map: log-odds of the beams of all keyframes, each cell at most once a scan, a hit before a pass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localization.errors import MapError
from localization.maps.keyframe_map import IntArray, KeyframeMap
from motion_models import se2
from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray

_HIT, _PASS = math.log(0.7 / 0.3), math.log(0.35 / 0.65)
"""Log-odds of a scan that hits a cell (0.7: OctoMap, Hornung 2013), and of one that passes. Two passes make a cell free by nav2's 0.25."""
_LOW, _HIGH = -2.0, 3.5
"""Limits of the log-odds (Hornung 2013): what changes is unlearned after a few scans."""
OCCUPIED, FREE = 0.65, 0.25
"""Probabilities above which a cell is occupied, and below which it is free: the defaults of nav2's map saver."""
_MARGIN_CELLS = 4
_MAX_CELLS = 100_000_000
"""A square of 500 m at 0.05 m; its arrays take 1.7 GB."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells of a map, as in nav_msgs/OccupancyGrid."""

    cells: NDArray[np.int8]
    """(H, W) 100 occupied, 0 free, -1 unknown; row 0 has the smallest y."""
    origin: tuple[float, float]
    """The lower left corner of the lower left cell [m]."""
    resolution: float
    """Side of a cell [m]."""


def draw_grid(mapped: KeyframeMap, resolution: float, free: float = FREE) -> Grid:
    """The grid of ``mapped`` with cells of ``resolution`` [m], free below a probability of ``free``.

    Raises `MapError` if there are no points, or too many cells.
    """
    if not (math.isfinite(resolution) and resolution > 0.0):
        raise MapError(f"a resolution of {resolution} m is none. Give the side of a cell in metres, as 0.05.")
    ends = mapped.points_in_map()
    if not len(ends):
        raise MapError("the map has no scan points, so there is nothing to draw. Build it from a log with scans.")
    starts = se2.transform(mapped.poses, mapped.sensors)
    both = np.vstack((ends, starts))
    low = np.floor(both.min(axis=0) / resolution) - _MARGIN_CELLS
    shape = np.floor(both.max(axis=0) / resolution) - low + 1 + _MARGIN_CELLS
    if not (shape.max() <= _MAX_CELLS and shape[0] * shape[1] <= _MAX_CELLS):
        size = f"{shape[0] * resolution:.3g} m x {shape[1] * resolution:.3g} m"
        raise MapError(f"{size} at {resolution} m are more than {_MAX_CELLS // 1_000_000} million cells. Use a larger --resolution.")
    log_odds = np.zeros((int(shape[1]), int(shape[0])))
    starts, ends = np.floor(starts / resolution) - low, np.floor(ends / resolution) - low
    _cast(log_odds, starts.astype(np.int64), ends.astype(np.int64), np.repeat(np.arange(len(starts)), mapped.counts))
    cells = np.full(log_odds.shape, -1, np.int8)
    cells[log_odds > math.log(OCCUPIED / (1.0 - OCCUPIED))] = 100
    cells[log_odds < math.log(free / (1.0 - free))] = 0
    return Grid(cells, (float(low[0] * resolution), float(low[1] * resolution)), resolution)


@kernel
def _cast(log_odds: FloatArray, starts: IntArray, ends: IntArray, keys: IntArray) -> None:
    """Add beams from cells ``starts`` (K, 2) to ``ends`` (M, 2), of keyframes ``keys`` (M,) in rising order, to ``log_odds`` (H, W)."""
    done = np.full(log_odds.shape, -1, np.int64)
    begin = 0
    while begin < len(keys):
        k = keys[begin]
        end = begin
        while end < len(keys) and keys[end] == k:
            x, y = ends[end]
            if done[y, x] != k:
                done[y, x] = k
                log_odds[y, x] = min(log_odds[y, x] + _HIT, _HIGH)
            end += 1
        for i in range(begin, end):
            _pass(log_odds, done, k, starts[k], ends[i])
        begin = end


@subroutine
def _pass(log_odds: FloatArray, done: IntArray, k: int, start: IntArray, end: IntArray) -> None:
    """Cells of one beam before its end, by Bresenham's line."""
    x, y = start
    dx, dy = abs(end[0] - x), -abs(end[1] - y)
    sx, sy = (1 if end[0] > x else -1), (1 if end[1] > y else -1)
    error = dx + dy
    while x != end[0] or y != end[1]:
        if done[y, x] != k:
            done[y, x] = k
            log_odds[y, x] = max(log_odds[y, x] + _PASS, _LOW)
        double = 2 * error
        if double >= dy:
            error += dy
            x += sx
        if double <= dx:
            error += dx
            y += sy
