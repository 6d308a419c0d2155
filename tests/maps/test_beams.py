"""Beams behind walls: counted where they come into unknown space, and not along a wall, nor where it was taken away."""

import numpy as np

from localization.maps.beams import share_behind_walls
from localization.maps.grid import Grid
from localization.maps.recent_scans import RecentMotion, RecentScans

CELLS = np.full((40, 80), -1, dtype=np.int8)
CELLS[1:39, 1:40] = 0  # a room of 4 m ...
CELLS[1:39, 40] = 100  # ... and its wall, with unknown space behind
CELLS[30:39, 41:80] = 0  # and a free corner of the next room
GRID = Grid(CELLS, (0.0, 0.0), 0.1)
POSE = np.array([1.0, 1.0, 0.0])


def beam(x: float, y: float) -> np.ndarray:
    return np.array([[0.0, 0.0, x, y]])


def test_what_goes_on_behind_a_wall_counts() -> None:
    assert share_behind_walls(GRID, POSE, beam(5.0, 0.0)) == 1.0
    assert share_behind_walls(GRID, POSE, np.vstack([beam(5.0, 0.0), beam(3.0, 0.0)])) == 0.5


def test_walls_that_a_beam_ends_on_or_runs_along_do_not_count() -> None:
    assert share_behind_walls(GRID, POSE, beam(3.0, 0.0)) == 0.0
    assert share_behind_walls(GRID, POSE, beam(3.3, 0.0)) == 0.0  # the pose is 0.3 m off
    along = np.array([[3.05, -0.5, 3.05, 2.4]])
    assert share_behind_walls(GRID, POSE, along) == 0.0


def test_a_wall_that_was_taken_away_has_free_space_behind() -> None:
    at = np.array([1.0, 3.5, 0.0])
    assert share_behind_walls(GRID, at, beam(5.0, 0.0)) == 0.0


def test_unknown_space_that_is_not_behind_a_wall_does_not_count() -> None:
    assert share_behind_walls(GRID, POSE, beam(-3.0, 0.0)) == 0.0  # out of the grid


def test_beams_that_are_short_are_left_out() -> None:
    assert share_behind_walls(GRID, np.array([3.9, 1.0, 0.0]), beam(0.7, 0.0)) == 0.0
    assert share_behind_walls(GRID, POSE, np.empty((0, 4))) == 0.0


def test_it_turns_with_the_pose() -> None:
    assert share_behind_walls(GRID, np.array([1.0, 1.0, 0.5 * np.pi]), beam(0.0, -5.0)) == 1.0


def test_beams_of_all_scans_begin_at_their_lidar() -> None:
    recent, scan = RecentScans(0.02), np.array([[2.0, 0.0], [0.0, 2.0]])
    recent.add(scan, np.array([0.3, 0.0]))
    recent.move(RecentMotion(np.array([1.0, 0.0, 0.0]), 1e-8 * np.eye(3)), scan)
    recent.add(scan, np.array([0.3, 0.0]))
    expected = [[-0.7, 0.0, 1.0, 0.0], [-0.7, 0.0, -1.0, 2.0], [0.3, 0.0, 2.0, 0.0], [0.3, 0.0, 0.0, 2.0]]
    np.testing.assert_allclose(recent.beams(100), expected, atol=1e-9)
    assert len(recent.beams(2)) == 2
