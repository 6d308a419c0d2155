"""Grids of a square room: walls where they are, free space inside, unknown outside; files as map_server reads them."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
import yaml
from PIL import Image

from localization.errors import MapError
from localization.maps.export import exports
from localization.maps.grid import Grid, GrowingGrid, draw_grid
from localization.ros.state_serialization import deserialize, serialize
from tests.helpers import floor_plan, square_room

ROOM = square_room.make_map()
CELL = 0.05


def value_at(grid, x: float, y: float) -> int:
    return int(grid.cells[int((y - grid.origin[1]) // grid.resolution), int((x - grid.origin[0]) // grid.resolution)])


def test_grid_of_a_room_has_walls_free_and_unknown_cells() -> None:
    grid = draw_grid(ROOM, CELL)
    for along in np.linspace(-1.9, 1.9, 39):
        at_walls = [(along, square_room.HALF), (along, -square_room.HALF), (square_room.HALF, along), (-square_room.HALF, along)]
        for x, y in at_walls:
            near = [value_at(grid, x + dx, y + dy) for dx in (-0.01, 0.01) for dy in (-0.01, 0.01)]
            assert 100 in near
        assert value_at(grid, along, 0.0) == 0
        assert value_at(grid, along, square_room.HALF + 0.12) == -1
    inside = [value_at(grid, x, y) for x in np.arange(-1.65, 1.7, 0.1) for y in np.arange(-1.65, 1.7, 0.1)]
    assert inside == [0] * len(inside)


def test_grid_wall_seen_at_glancing_angles_stays_a_wall() -> None:
    """A robot that drives 0.4 m beside a wall: each of its beams to the far end passes the cells of metres of wall."""
    poses = np.column_stack([np.arange(0.0, 8.0, 0.5), np.zeros(16), np.zeros(16)])
    bearings = np.radians(np.arange(2.0, 88.0))
    reach = np.minimum(0.4 / np.sin(bearings), 8.0 / np.cos(bearings))
    noise = np.random.default_rng(2).normal(0.0, 0.01, (16, len(bearings)))
    scans = [np.column_stack([(reach + n) * np.cos(bearings), (reach + n) * np.sin(bearings)]) for n in noise]
    counts = np.full(16, len(bearings), dtype=np.int64)
    mapped = dataclasses.replace(
        square_room.make_map(), poses=poses, points=np.vstack(scans).astype(np.float32), counts=counts, sensors=np.zeros((16, 2))
    )
    grid = draw_grid(mapped, CELL)
    along = np.arange(0.5, 7.5, 0.05)
    walls = [100 in [value_at(grid, x, 0.38), value_at(grid, x, 0.41)] for x in along]
    assert np.mean(walls) > 0.95
    assert all(value_at(grid, x, 0.2) == 0 for x in np.arange(1.0, 6.0, 0.05))


def test_grid_cells_seen_free_by_one_scan_alone_are_unknown() -> None:
    """A single pass is no proof of free space: p = 0.35, above nav2's limit of 0.25."""
    grid = draw_grid(square_room.make_map(square_room.POSES[:1]), CELL)
    assert value_at(grid, 1.0, 1.0) == -1
    assert (grid.cells == 100).any()


def test_grid_beams_start_at_the_lidar() -> None:
    """A body whose LiDAR is 1 m ahead draws no free space through the wall between body and LiDAR's room."""
    poses = np.tile([-2.5, 0.0, 0.0], (3, 1))
    points = np.tile(np.array([[1.5, 0.0]], np.float32), (3, 1))  # one beam, of 0.5 m
    moved = dataclasses.replace(
        square_room.make_map(), poses=poses, points=points, counts=np.ones(3, np.int64), sensors=np.tile([1.0, 0.0], (3, 1))
    )
    grid = draw_grid(moved, CELL)
    assert value_at(grid, -1.3, 0.01) == 0
    assert value_at(grid, -1.7, 0.01) == -1


@pytest.mark.parametrize("resolution", [0.0, -1.0, float("nan"), 1e-5])
def test_grid_of_a_resolution_without_sense_is_refused(resolution: float) -> None:
    with pytest.raises(MapError, match="resolution"):
        draw_grid(ROOM, resolution)


def test_grid_of_points_beyond_all_measure_is_refused() -> None:
    with pytest.raises(MapError, match="million cells"):
        draw_grid(dataclasses.replace(ROOM, poses=ROOM.poses + [1e306, 0.0, 0.0] * (np.arange(3) % 2)[:, None]), CELL)


def test_grid_of_a_map_without_scans_is_refused() -> None:
    empty = dataclasses.replace(ROOM, points=np.empty((0, 2), np.float32), counts=np.zeros(3, np.int64))
    with pytest.raises(MapError, match="no scan points"):
        draw_grid(empty, CELL)


def read_as_map_server(files: dict[str, bytes]) -> tuple[np.ndarray, dict]:
    """Occupancy by map_server's rules (trinary): (H, W), row 0 at the smallest y; and the YAML. PIL and PyYAML are independent readers."""
    about = yaml.safe_load(files["map.yaml"])
    image = np.asarray(Image.open(io.BytesIO(files[about["image"]])), dtype=float)
    share = (255.0 - image) / 255.0
    occupancy = np.where(share > about["occupied_thresh"], 100, np.where(share < about["free_thresh"], 0, -1))
    return occupancy[::-1], about


def test_export_read_by_map_servers_rules_is_the_grid() -> None:
    grid = draw_grid(ROOM, CELL)
    occupancy, about = read_as_map_server(exports(grid, ROOM))
    np.testing.assert_array_equal(occupancy, grid.cells)
    assert about["resolution"] == CELL
    assert about["origin"] == pytest.approx([*grid.origin, 0.0])
    assert about["negate"] == 0
    assert about["mode"] == "trinary"


def test_export_png_and_pgm_are_the_same_picture() -> None:
    files = exports(draw_grid(ROOM, CELL), ROOM)
    pictures = [np.asarray(Image.open(io.BytesIO(files[name]))) for name in ("map.pgm", "map.png")]
    np.testing.assert_array_equal(*pictures)


def test_export_ply_has_the_points() -> None:
    head, body = exports(draw_grid(ROOM, CELL), ROOM)["map.ply"].split(b"end_header\n", 1)
    assert b"format binary_little_endian 1.0" in head
    assert f"element vertex {len(ROOM.points)}".encode() in head
    points = np.frombuffer(body, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points[:, :2], ROOM.points_in_map(), atol=1e-6)
    assert not points[:, 2].any()


def keyframes_of(mapped):
    return mapped.poses, mapped.scans(), list(mapped.sensors)


def test_growing_grid_by_parts_is_the_grid_of_all() -> None:
    mapped = floor_plan.make_map()
    poses, scans, lidars = keyframes_of(mapped)
    growing = GrowingGrid(0.1, 4_000_000)
    for k in (1, 2, 10, len(poses)):
        grid = growing.update(poses[:k], scans[:k], lidars[:k])
    assert_same_cells(grid, draw_grid(mapped, 0.1))


def test_growing_grid_is_drawn_anew_where_keyframes_have_moved() -> None:
    mapped = floor_plan.make_map()
    poses, scans, lidars = keyframes_of(mapped)
    growing = GrowingGrid(0.1, 4_000_000)
    growing.update(poses + np.array([0.0, 0.3, 0.02]), scans, lidars)
    assert_same_cells(growing.update(poses, scans, lidars), draw_grid(mapped, 0.1))
    resumed = pickle_free_copy(growing)
    assert_same_cells(resumed.update(poses, scans, lidars), draw_grid(mapped, 0.1))


def test_growing_grid_of_too_many_cells_has_larger_ones() -> None:
    mapped = floor_plan.make_map()
    grid = GrowingGrid(0.1, 20_000).update(*keyframes_of(mapped))
    assert grid.resolution == 0.2
    assert grid.cells.size <= 20_000


def pickle_free_copy(growing: GrowingGrid) -> GrowingGrid:
    text, blob = serialize(growing)
    assert len(text) + len(blob) < 500
    return deserialize(text, blob)


def assert_same_cells(one: Grid, other: Grid) -> None:
    """Known cells are the same; their margins differ."""
    found = []
    for grid in (one, other):
        rows, columns = np.nonzero(grid.cells >= 0)
        x, y = (np.round(origin / grid.resolution) for origin in grid.origin)
        found.append({(int(c + x), int(r + y)): int(grid.cells[r, c]) for r, c in zip(rows, columns, strict=True)})
    assert found[0] == found[1]
