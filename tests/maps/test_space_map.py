"""Maps in space: files with clouds on SE(3), what is refused, and the planar grid of what stands above the ground."""

from __future__ import annotations

import dataclasses
import json
import random
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from localization.cli import main
from localization.errors import MapError
from localization.maps import KeyframeMap, SavedMap, load_map, save_map
from localization.maps.height_slice import HeightSlice, find_ground
from localization.maps.keyframe_map import POINT_UNIT_M, in_units
from localization.maps.map_file import PLANAR, SPACE
from motion_models import se3
from tests.helpers import hill_map, square_room
from tests.helpers.hills import terrain

pytestmark = pytest.mark.xdist_group("hill_map")


@pytest.fixture(scope="module")
def scene():
    return hill_map.scene_around(np.array(hill_map.WAY)[:, :2])


@pytest.fixture(scope="module")
def hills(scene):
    return hill_map.make_map(scene)


@pytest.fixture(scope="module")
def file(hills, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("hills") / "hill.skidmap"
    save_map(path, SavedMap(hills, {"log": "hill.mcap", "robot": "husky_a200"}))
    return path


def test_map_in_space_saved_and_loaded_is_equal_to_the_last_bit(file: Path, hills: KeyframeMap, tmp_path: Path) -> None:
    found = load_map(file)
    assert found.map.is_in_space
    for field in dataclasses.fields(KeyframeMap):
        np.testing.assert_array_equal(getattr(found.map, field.name), getattr(hills, field.name))
    save_map(tmp_path / "again.skidmap", found)
    assert (tmp_path / "again.skidmap").read_bytes() == file.read_bytes()


def test_map_file_has_a_version_of_its_own_in_space_alone(file: Path, tmp_path: Path) -> None:
    """Planar maps are written as before there were maps in space, and readers of those refuse the new ones by their version."""
    import zipfile

    save_map(tmp_path / "room.skidmap", square_room.saved())
    for path, version in ((tmp_path / "room.skidmap", PLANAR), (file, SPACE)):
        with zipfile.ZipFile(path) as archive:
            assert json.loads(archive.read("skidmap.json"))["version"] == version
    assert not load_map(tmp_path / "room.skidmap").map.is_in_space


def test_clouds_in_units_are_within_half_a_unit_and_far_points_left_out() -> None:
    cloud = np.random.default_rng(1).uniform(-60.0, 60.0, (500, 3))
    points, counts = in_units([cloud, np.array([[200.0, 0.0, 0.0]]), np.empty((0, 3))])
    assert counts.tolist() == [500, 0, 0]
    assert np.abs(POINT_UNIT_M * points - cloud).max() <= 0.5 * POINT_UNIT_M + 1e-12


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("poses", np.tile(2.0 * np.eye(4), (9, 1, 1))),
        ("poses", np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (9, 1, 1))),
        ("covariances", np.tile(-np.eye(6), (9, 1, 1))),
        ("sensors", np.zeros((9, 2))),
    ],
)
def test_save_of_a_map_in_space_that_is_none_is_refused(hills: KeyframeMap, tmp_path: Path, name: str, bad: np.ndarray) -> None:
    with pytest.raises(MapError, match=name):
        save_map(tmp_path / "bad.skidmap", SavedMap(dataclasses.replace(hills, **{name: bad}), {}))
    assert not list(tmp_path.iterdir())


def test_load_of_damaged_and_cut_maps_in_space_raises_map_errors(hills: KeyframeMap, tmp_path: Path) -> None:
    few = dataclasses.replace(hills, points=hills.points[:0], counts=0 * hills.counts)
    path, rng = tmp_path / "few.skidmap", random.Random(0)
    save_map(path, SavedMap(few, {}))
    data = path.read_bytes()
    for k in range(60):
        damaged = bytearray(data)
        damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged if k < 40 else data[: rng.randrange(len(data))])
        try:
            np.testing.assert_array_equal(load_map(path).map.poses, few.poses)
        except MapError:
            continue
        assert k < 40, "a file that is cut off gave a map"


def test_covariance_of_a_map_in_space_is_that_of_the_nearest_keyframe(hills: KeyframeMap) -> None:
    """Of a keyframe's heading, off by a milliradian, a pose two metres ahead is off by two millimetres to the left."""
    covs = np.zeros((len(hills.poses), 6, 6))
    covs[4, 5, 5] = 1e-6
    turned = dataclasses.replace(hills, covariances=covs)
    pose = hills.poses[4] @ se3.exp(np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(np.sqrt(np.diagonal(turned.cov_at(pose))), [0.0, 4e-4, 0.0, 0.0, 0.0, 1e-3], atol=1e-12)


def test_ground_below_a_cloud_is_that_of_the_hills(hills: KeyframeMap) -> None:
    """Between rings, too, and below trees and walls: where nine keyframes have seen it, it is within decimetres."""
    at = np.random.default_rng(2).uniform(-8.0, 8.0, (400, 2))
    points = np.column_stack([at, terrain(at[:, 0], at[:, 1])])
    off = find_ground(hills.points_in_map()).above(points)
    assert np.median(np.abs(off)) < 0.06
    assert np.quantile(np.abs(off), 0.95) < 0.2


def test_slice_has_trees_and_walls_and_ground_between_is_free(hills: KeyframeMap, scene) -> None:
    found = HeightSlice(hills)
    grid = found.grid(0.1)
    walls = found.keyframes.points_in_map()
    near = [np.abs(np.hypot(*(walls - tree[:2]).T) - tree[2]) for tree in scene.trees]
    sides = [np.abs(walls[:, 0] - w[0]) if w[0] == w[2] else np.abs(walls[:, 1] - w[1]) for w in scene.walls]
    assert np.mean(np.min([*near, *sides], axis=0) < 0.15) > 0.9
    way = np.array(hill_map.WAY)[:, :2]
    column, row = np.floor((way - grid.origin) / grid.resolution).astype(int).T
    assert (grid.cells[row, column] == 0).all()
    assert (grid.cells == 100).sum() > 200


def test_slice_where_nothing_stands_and_heights_that_are_none_are_named(hills: KeyframeMap) -> None:
    with pytest.raises(MapError, match="nothing stands between 40 and 50 m"):
        HeightSlice(hills, (40.0, 50.0))
    with pytest.raises(MapError, match="no range above the ground"):
        HeightSlice(hills, (1.0, 0.5))


def test_map_commands_of_a_map_in_space(file: Path, hills: KeyframeMap, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "info", str(file), "--json", str(tmp_path / "info.json")]) == 0
    assert "9 keyframes in space" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "info.json").read_text())["size_m"]) == 3
    assert main(["map", "view", str(file), "--out", str(tmp_path / "hill.html")]) == 0
    assert "9 keyframes" in (tmp_path / "hill.html").read_text()
    assert main(["map", "export", str(file), "--out", str(tmp_path / "out"), "--resolution", "0.2"]) == 0
    assert {0, 205, 254} == set(np.unique(np.asarray(Image.open(tmp_path / "out" / "map.pgm"))).tolist())
    head, body = (tmp_path / "out" / "map.ply").read_bytes().split(b"end_header\n", 1)
    assert f"element vertex {len(hills.points)}".encode() in head
    np.testing.assert_allclose(np.frombuffer(body, "<f4").reshape(-1, 3), hills.points_in_map(), atol=1e-4)


def test_map_commands_refuse_what_is_for_the_other_kind(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room, out = tmp_path / "room.skidmap", tmp_path / "out"
    save_map(room, square_room.saved())
    assert main(["map", "merge", str(room), str(file), "--out", str(out)]) == 2
    assert "one map holds planar scans, the other clouds in space" in capsys.readouterr().err
    assert main(["map", "export", str(room), "--out", str(out), "--heights", "0.3", "2"]) == 2
    assert "--heights" in capsys.readouterr().err
    assert not out.exists()
