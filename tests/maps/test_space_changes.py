"""Points that a drive has found gone from a map in space: trees that were cut, and nothing else."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from localization.maps.space_changes import find_gone
from motion_models import se3
from tests.helpers import hill_map
from tests.helpers.hills import terrain

_WAY = np.array(hill_map.WAY)
_BESIDE = tuple(map(tuple, _WAY + np.array([0.4, -0.5, 0.3])))
_CELL_M = 0.5
_TREE_M = 0.5
"""Points so near to the axis of a tree are its own."""


@pytest.fixture(scope="module")
def scene():
    return hill_map.scene_around(_WAY[:, :2])


@pytest.fixture(scope="module")
def mapped(scene):
    return hill_map.make_map(scene)


def near_trees(points: np.ndarray, trees: np.ndarray) -> np.ndarray:
    return (np.hypot(points[:, None, 0] - trees[:, 0], points[:, None, 1] - trees[:, 1]) < _TREE_M).any(axis=1)


def test_find_gone_returns_cut_trees_alone(scene, mapped) -> None:
    order = np.argsort(np.hypot(*scene.trees[:, :2].T))
    cut, kept = scene.trees[order[:4]], scene.trees[order[4:]]
    drive = hill_map.make_map(dataclasses.replace(scene, trees=kept), _BESIDE)
    gone, points = find_gone(mapped, drive, _CELL_M), mapped.points_in_map()
    of_cut = near_trees(points, cut) & (points[:, 2] - terrain(points[:, 0], points[:, 1]) > 0.5)
    assert of_cut.sum() > 50
    assert gone[of_cut].mean() > 0.8
    assert not (gone & ~near_trees(points, cut)).any()
    left = mapped.without(gone)
    assert left.counts.sum() == len(left.points) == len(points) - gone.sum()
    np.testing.assert_allclose(left.points_in_map(), points[~gone])


def test_find_gone_in_an_unchanged_scene_returns_nothing(scene, mapped) -> None:
    drive = hill_map.make_map(scene, _BESIDE)
    assert not find_gone(mapped, drive, _CELL_M).any()
    off = dataclasses.replace(drive, poses=drive.poses @ se3.exp(np.array([0.03, 0.02, 0.02, 0.002, 0.002, 0.003])))
    assert not find_gone(mapped, off, _CELL_M).any()


def test_find_gone_by_a_drive_without_points_returns_nothing(mapped) -> None:
    empty = mapped.without(np.ones(len(mapped.points), dtype=bool))
    assert not find_gone(mapped, empty, _CELL_M).any()
