"""What a drive has found changed in a saved map, by place: its grid against the map's, in the same cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from localization.maps.grid import Grid, draw_grid
from localization.maps.keyframe_map import KeyframeMap
from localization.maps.place_search import CELL_M, CERTAINLY_FREE, PlaceMap
from motion_models import se2
from motion_models.se2 import Points2, Pose2

_TOLERANCE_CELLS = 2
"""A wall that is moved by less is no change [cells]: 0.2 m, twice the p95 of positions in a saved map."""
_JOINED_CELLS = 3
"""Changed cells nearer than twice this are one place."""
_LEAST_CELLS = 4
"""Cells of a place, at least: 0.4 m of wall."""
_LEAST_SHARE, _LEAST_POINTS = 0.05, 10
"""Share and number of a scan's points in space that the map does not have, or on what is new, from which on the scan adds to the map."""
_SEEN_THROUGH_CELLS = 3
"""Cells of walls that are gone, from which on a scan that passes through them adds to the map."""
_BEHIND_M, _BEAM_RAD = 0.3, 0.01
"""A beam has passed a cell where it ends this far behind it, and is this near in angle [m, rad]."""


@dataclass(frozen=True)
class Change:
    """A place where the map no longer fits."""

    kind: Literal["new", "gone"]
    """A wall where the map has free space, or free space where it has a wall."""
    x: float
    """Middle of the place in `map` [m]."""
    y: float
    size_m: float
    """Diagonal of its extent [m]."""
    cells: int
    """Changed cells of 0.1 m."""


@dataclass(frozen=True, eq=False)
class Changes:
    """All changes that a drive has found, and how much of the map it has seen again."""

    places: Sequence[Change]
    """The largest first."""
    new: Points2
    """(N, 2) centres of cells that are walls now [m]."""
    gone: Points2
    """(G, 2) centres of cells that were walls [m]."""
    confirmed: int
    """Cells of walls that the drive has found again."""

    @property
    def changed_share(self) -> float:
        """Share of the measured walls that is new or gone."""
        changed = len(self.new) + len(self.gone)
        return changed / max(changed + self.confirmed, 1)


def find_changes(places: PlaceMap, drive: KeyframeMap) -> Changes:
    """Changes of the map by the keyframes of ``drive`` in its frame. Raises `MapError` where these have no points."""
    seen = draw_grid(drive, CELL_M, CERTAINLY_FREE)
    old, old_free, now = _on_common_cells(places.grid, places.certain_grid, seen)
    new = (now == 100) & (old_free == 0) & ~_near(old == 100)
    gone = (old == 100) & (now == 0) & ~_near(now == 100)
    found = [*_places(new, "new", seen), *_places(gone, "gone", seen)]
    confirmed = int(((old == 100) & _near(now == 100)).sum())
    return Changes(sorted(found, key=lambda change: -change.cells), _centres(new, seen), _centres(gone, seen), confirmed)


def adds_to(places: PlaceMap, changes: Changes, pose: Pose2, points: Points2) -> bool:
    """Whether the scan ``points`` (N, 2) of a keyframe at ``pose`` (3,) has what the map does not have: unmapped space, or a change."""
    if len(points) < _LEAST_POINTS:
        return False
    moved = np.asarray(se2.transform(pose, points))
    is_new = places.is_unknown(moved) | _is_among(moved, changes.new)
    if is_new.sum() >= max(_LEAST_POINTS, _LEAST_SHARE * len(points)):
        return True
    return _seen_through(pose, points, changes.gone) >= _SEEN_THROUGH_CELLS


def _seen_through(pose: Pose2, points: Points2, cells: Points2) -> int:
    """How many of ``cells`` (G, 2) [m] the beams to ``points`` (N, 2) pass."""
    if not len(cells):
        return 0
    local = np.asarray(se2.transform(se2.inverse(pose), cells))
    bearings = np.arctan2(points[:, 1], points[:, 0])
    off = np.abs(se2.wrap_angle(np.arctan2(local[:, 1], local[:, 0])[:, None] - bearings))
    nearest = off.argmin(axis=1)
    is_behind = np.hypot(*points[nearest].T) > np.hypot(*local.T) + _BEHIND_M
    return int((is_behind & (off.min(axis=1) < _BEAM_RAD)).sum())


def _is_among(points: Points2, cells: Points2) -> NDArray[np.bool_]:
    """(N,) whether each of ``points`` (N, 2) is in one of ``cells`` (M, 2) or beside it."""
    if not len(cells):
        return np.zeros(len(points), dtype=bool)
    known = {tuple(index) for index in np.floor(cells / CELL_M).astype(int)}
    return np.array([tuple(index) in known for index in np.floor(points / CELL_M).astype(int)])


def _on_common_cells(*grids: Grid) -> list[NDArray[np.int8]]:
    """The cells of ``grids`` where the last one is; -1 where another has none."""
    last, found = grids[-1], []
    for grid in grids:
        dx, dy = (round((a - b) / CELL_M) for a, b in zip(last.origin, grid.origin, strict=True))
        common: NDArray[np.int8] = np.full(last.cells.shape, -1, np.int8)
        rows, columns = (np.arange(n) + shift for n, shift in zip(last.cells.shape, (dy, dx), strict=True))
        in_rows, in_columns = (rows >= 0) & (rows < grid.cells.shape[0]), (columns >= 0) & (columns < grid.cells.shape[1])
        common[np.ix_(in_rows, in_columns)] = grid.cells[np.ix_(rows[in_rows], columns[in_columns])]
        found.append(common)
    return found


def _near(mask: NDArray[np.bool_], cells: int = _TOLERANCE_CELLS) -> NDArray[np.bool_]:
    return np.asarray(ndimage.binary_dilation(mask, np.ones((2 * cells + 1, 2 * cells + 1), dtype=bool)))


def _places(mask: NDArray[np.bool_], kind: Literal["new", "gone"], grid: Grid) -> list[Change]:
    labels, n = ndimage.label(_near(mask, _JOINED_CELLS), np.ones((3, 3)))
    found = []
    for i in range(1, n + 1):
        centres = _centres(mask & (labels == i), grid)
        if len(centres) >= _LEAST_CELLS:
            middle, extent = centres.mean(axis=0).round(2).tolist(), np.ptp(centres, axis=0) + CELL_M
            found.append(Change(kind, middle[0], middle[1], round(float(np.hypot(*extent)), 2), len(centres)))
    return found


def _centres(mask: NDArray[np.bool_], grid: Grid) -> Points2:
    rows, columns = np.nonzero(mask)
    return np.asarray(np.array(grid.origin) + CELL_M * (np.column_stack([columns, rows]) + 0.5))
