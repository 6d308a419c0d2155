"""Changes of a map that a drive finds, by place, and the map that is extended by them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.estimators import merge_maps
from localization.maps.changes import find_changes
from localization.maps.grid import draw_grid
from localization.maps.place_search import PlaceMap
from tests.helpers import floor_plan
from tests.helpers.floor_plan import OFFICE, TOUR

BOX = (5.45, 5.05, 6.25, 5.65)
"""A box that is put up."""
IS_KEPT = ~np.isin(OFFICE[:, 0], [9.0, 9.6]) | (OFFICE[:, 1] < 4.0)
"""Walls of `OFFICE` without the box at (9.3, 5.25), which is taken away."""
CHANGED = np.vstack([OFFICE[IS_KEPT], floor_plan.box(*BOX)])
SECOND = TOUR + np.array([0.1, -0.05, 0.1])


def cells(grid, x: float, y: float) -> set[int]:
    """Values within 0.1 m of a point."""
    column, row = (round((v - o) / grid.resolution - 0.5) for v, o in zip((x, y), grid.origin, strict=True))
    return set(grid.cells[row - 1 : row + 2, column - 1 : column + 2].ravel().tolist())


def test_find_changes_of_the_same_building_finds_none():
    found = find_changes(PlaceMap(floor_plan.make_map(), 0.02), floor_plan.make_map(poses=SECOND))
    assert found.changed_share < 0.01
    assert not found.places
    assert found.confirmed > 300


def test_find_changes_names_a_new_box_and_a_missing_one():
    found = find_changes(PlaceMap(floor_plan.make_map(), 0.02), floor_plan.make_map(CHANGED, SECOND))
    by_kind = {change.kind: change for change in reversed(found.places)}
    assert set(by_kind) == {"new", "gone"}
    assert math.hypot(by_kind["new"].x - 5.8, by_kind["new"].y - 5.3) < 0.4
    assert math.hypot(by_kind["gone"].x - 9.3, by_kind["gone"].y - 5.25) < 0.5
    assert 0.05 < found.changed_share < 0.3


def test_merge_of_what_is_new_redraws_changed_places():
    second = floor_plan.make_map(CHANGED, np.vstack([SECOND, SECOND]))
    found = merge_maps(floor_plan.make_map(), second, 0.02, only_new=True)
    assert 5 < found.added < len(second.poses)
    grid = draw_grid(found.map, 0.1)
    assert 100 in cells(grid, 5.85, 5.05)
    assert cells(grid, 9.0, 5.2) == {0}


@pytest.mark.extended
def test_merge_of_what_is_new_leaves_out_what_the_map_has():
    same = merge_maps(floor_plan.make_map(), floor_plan.make_map(poses=SECOND), 0.02, only_new=True)
    assert same.added < 0.2 * len(SECOND)
