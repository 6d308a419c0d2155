"""Occupancy grid of a map: log-odds of the beams of all keyframes, each cell at most once a scan, a hit before a pass."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.errors import MapError
from localization.maps.keyframe_map import KeyframeMap
from localization.trajectory import IntArray
from motion_models import se2
from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray, Points2

_HIT, _PASS = math.log(0.7 / 0.3), math.log(0.35 / 0.65)
"""Log-odds of a scan that hits a cell (0.7: OctoMap, Hornung 2013), and of one that passes. Two passes make a cell free by nav2's 0.25."""
_LOW, _HIGH = -2.0, 3.5
"""Limits of the log-odds (Hornung 2013): what changes is unlearned after a few scans."""
OCCUPIED = 0.65
"""Probability above which a cell is occupied: the default of nav2's map saver."""
FREE = 0.25
"""Probability below which a cell is free: the default of nav2's map saver."""
_BESIDE = (1, 2)
"""Beams to each side whose ends show the direction of a surface: with one alone, 0.02 m of noise turn that of a near wall."""
_MARGIN_CELLS = 4
_REDRAWN_CELLS = 0.5
"""A growing grid is drawn anew where a keyframe has moved by more [cells]."""
_BLOCK_M = 10.0
"""Side of the blocks by which a growing grid is extended [m]."""
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
    ends = mapped.points_in_map()
    if not len(ends):
        raise MapError("the map has no scan points, so there is nothing to draw. Build it from a log with scans.")
    beams = Beams(se2.transform(mapped.poses, mapped.sensors), ends, np.repeat(np.arange(len(mapped.poses)), mapped.counts))
    return cast_beams(beams, np.ones(len(ends), dtype=bool), resolution, free)


class Beams(NamedTuple):
    """Beams of K keyframes, M in all, as seen from above."""

    starts: Points2
    """(K, 2) where the LiDAR of each keyframe was [m]."""
    ends: Points2
    """(M, 2) of the beams [m]."""
    keys: IntArray
    """(M,) keyframe of each, in rising order."""


def cast_beams(beams: Beams, is_wall: NDArray[np.bool_], resolution: float, free: float = FREE) -> Grid:
    """The grid of ``beams``, of which those that end on a wall (M,) hit their last cell, and the others pass up to there.

    Other arguments and errors are those of `draw_grid`.
    """
    if not (math.isfinite(resolution) and resolution > 0.0):
        raise MapError(f"a resolution of {resolution} m is none. Give the side of a cell in metres, as 0.05.")
    both = np.vstack((beams.ends, beams.starts))
    low = np.floor(both.min(axis=0) / resolution) - _MARGIN_CELLS
    shape = np.floor(both.max(axis=0) / resolution) - low + 1 + _MARGIN_CELLS
    if not (shape.max() <= _MAX_CELLS and shape[0] * shape[1] <= _MAX_CELLS):
        size = f"{shape[0] * resolution:.3g} m x {shape[1] * resolution:.3g} m"
        raise MapError(
            f"{size} at {resolution} m are more than {_MAX_CELLS // 1_000_000} million cells. Is the map in metres? Else use a larger "
            "--resolution."
        )
    log_odds = np.zeros((int(shape[1]), int(shape[0])))
    _add_beams(log_odds, low, resolution, beams, is_wall)
    return _classify(log_odds, low, resolution, free)


def _add_beams(log_odds: FloatArray, low: FloatArray, resolution: float, beams: Beams, is_wall: NDArray[np.bool_]) -> None:
    """Add ``beams`` (`cast_beams`) to the cells ``log_odds`` (H, W), whose first one has the indices ``low`` (2,)."""
    (starts, ends, keys), passed = beams, beams.ends.copy()
    passed[is_wall] = _clear_ends(starts[keys[is_wall]], ends[is_wall], keys[is_wall], resolution)
    first, clear, last = (np.floor(where / resolution).astype(np.int64) - low.astype(np.int64) for where in (starts, passed, ends))
    _cast(log_odds, first, clear, last, keys, is_wall)


def _clear_ends(starts: Points2, ends: Points2, keys: IntArray, distance: float) -> Points2:
    """(M, 2) up to where beams from ``starts`` to ``ends`` (M, 2), of keyframes ``keys`` (M,), are farther than ``distance`` from the
    surface that they end on [m]: a beam along a wall is beside it for metres, and passes cells of the wall.

    The surface goes through the end and those of the beams beside it. At the edge of an object, of the surfaces by the neighbours on each
    side, it is the one at the largest angle to the beam.
    """
    beams = ends - starts
    order = np.lexsort((np.arctan2(beams[:, 1], beams[:, 0]), keys))
    beam, key, length = beams[order], keys[order], np.maximum(np.hypot(*beams[order].T), 1e-9)
    sine = np.zeros(len(beam))
    for n in _BESIDE:
        along = ends[order[n:]] - ends[order[:-n]]
        width = np.where(key[n:] == key[:-n], np.hypot(*along.T), 0.0)
        for some in (slice(n, None), slice(None, -n)):
            cross = np.abs(beam[some, 0] * along[:, 1] - beam[some, 1] * along[:, 0])
            sine[some] = np.maximum(sine[some], np.divide(cross, width * length[some], out=np.zeros_like(cross), where=width > 0.0))
    is_alone = np.bincount(key)[key] == 1
    share = np.where(is_alone, 1.0, np.clip(1.0 - distance / np.maximum(sine * length, 1e-9), 0.0, 1.0))
    clear = np.empty_like(ends)
    clear[order] = starts[order] + share[:, None] * beam
    return clear


def _classify(log_odds: FloatArray, low: FloatArray, resolution: float, free: float) -> Grid:
    """Cells (H, W) of ``log_odds``, whose first one has the indices ``low`` (2,)."""
    cells = np.full(log_odds.shape, -1, np.int8)
    cells[log_odds > math.log(OCCUPIED / (1.0 - OCCUPIED))] = 100
    cells[log_odds < math.log(free / (1.0 - free))] = 0
    return Grid(cells, (float(low[0] * resolution), float(low[1] * resolution)), resolution)


class GrowingGrid:
    """The grid of a map that grows: new keyframes are added, and all are drawn anew where a loop has moved those that were."""

    def __init__(self, resolution: float, max_cells: int) -> None:
        """``resolution``: side of a cell [m]; it doubles until there are at most ``max_cells``."""
        self._resolution, self._max_cells = resolution, max_cells
        self._clear()

    def __getstate__(self) -> dict[str, Any]:
        """Settings alone: the cells are drawn again from the keyframes."""
        return {"resolution": self._resolution, "max_cells": self._max_cells}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._resolution, self._max_cells = state["resolution"], state["max_cells"]
        self._clear()

    def _clear(self) -> None:
        self._drawn, self._low, self._log_odds = np.empty((0, 3)), np.zeros(2), np.zeros((0, 0))

    def update(self, poses: FloatArray, scans: Sequence[Points2], lidars: Sequence[FloatArray]) -> Grid:
        """The grid of keyframes at ``poses`` (K, 3), with ``scans`` (n, 2) in their body frames and the places (2,) of their LiDARs [m]."""
        old = poses[: len(self._drawn)]
        if len(poses) < len(self._drawn) or np.hypot(*(old - self._drawn)[:, :2].T).max(initial=0.0) > _REDRAWN_CELLS * self._resolution:
            self._clear()
        new = range(len(self._drawn), len(poses))
        starts = [se2.transform(poses[k], lidars[k]) for k in new]
        ends = [se2.transform(poses[k], scans[k]) for k in new if len(scans[k])]
        if ends:
            points, counts = np.vstack(ends), np.array([len(scans[k]) for k in new])
            if not self._grow(np.vstack([points, *starts])):
                return self.update(poses, scans, lidars)
            beams = Beams(np.array(starts), points, np.repeat(np.arange(len(starts)), counts))
            _add_beams(self._log_odds, self._low, self._resolution, beams, np.ones(len(points), dtype=bool))
        self._drawn = poses.copy()
        return _classify(self._log_odds, self._low, self._resolution, FREE)

    def _grow(self, points: Points2) -> bool:
        """Make room for ``points`` (N, 2); False where the cells became larger, and all is to be drawn anew."""
        block = max(round(_BLOCK_M / self._resolution), 1)
        low = np.floor(points.min(axis=0) / self._resolution / block) * block
        high = (np.floor(points.max(axis=0) / self._resolution / block) + 1.0) * block
        rows, columns = self._log_odds.shape
        if rows:
            low, high = np.minimum(low, self._low), np.maximum(high, self._low + np.array([columns, rows]))
        if np.prod(high - low) > self._max_cells:
            self._resolution *= 2.0
            self._clear()
            return False
        grown = np.zeros((int(high[1] - low[1]), int(high[0] - low[0])))
        x, y = (self._low - low).astype(int) if rows else (0, 0)
        grown[y : y + rows, x : x + columns] = self._log_odds
        self._low, self._log_odds = low, grown
        return True


@kernel
def _cast(log_odds: FloatArray, starts: IntArray, clear: IntArray, ends: IntArray, keys: IntArray, is_wall: NDArray[np.bool_]) -> None:
    """Add beams to ``log_odds`` (H, W): from cells ``starts`` (K, 2) they pass up to ``clear`` (M, 2), and those that end on a wall (M,)
    hit ``ends`` (M, 2). ``keys`` (M,) are their keyframes, in rising order."""
    done = np.full(log_odds.shape, -1, np.int64)
    begin = 0
    while begin < len(keys):
        k = keys[begin]
        end = begin
        while end < len(keys) and keys[end] == k:
            x, y = ends[end]
            if is_wall[end] and done[y, x] != k:
                done[y, x] = k
                log_odds[y, x] = min(log_odds[y, x] + _HIT, _HIGH)
            end += 1
        for i in range(begin, end):
            _pass(log_odds, done, k, starts[k], clear[i])
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
