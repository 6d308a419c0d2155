"""A drive over hills saved by `replay --save-map`, and localized in by `replay --map`; maps and LiDARs that do not fit are refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from localization.cli import main
from localization.maps import SavedMap, load_map, save_map
from localization.trajectory import read_tum
from tests.helpers import bags, hill_log, hill_map, rooms, square_room
from tests.helpers.hill_scans import make_scene, scans
from tests.helpers.hills import rolling_drive

pytestmark = pytest.mark.xdist_group("among_trees")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    drive = rolling_drive(8.0)
    return hill_log.write(tmp_path_factory.mktemp("hills") / "hills.mcap", drive, list(scans(drive, make_scene(drive, 3))))


def replay(log: Path, out: Path, *more: object, robot: str = "husky_a200") -> int:
    return main(["replay", str(log), "--robot", robot, "--model", "diff_drive", "--static", "--out", str(out), *map(str, more)])


@pytest.mark.extended
def test_drive_over_hills_is_saved_and_localized_in_its_own_map(log: Path, tmp_path: Path) -> None:
    """The pose that is given is off by 0.5 m and 10 degrees; height, roll and pitch are the map's. The odometry does not jump."""
    path = tmp_path / "hill.skidmap"
    assert replay(log, tmp_path / "first", "--estimator", "graph", "--save-map", path) == 0
    saved = load_map(path)
    assert saved.map.is_in_space
    assert len(saved.map.poses) >= 3  # of the way after the IMU has shown the slope
    assert saved.provenance["robot"] == "husky_a200"
    more = "--initial-pose", 0.3, -0.4, 10, "--extend-map", tmp_path / "more.skidmap"
    assert replay(log, tmp_path / "out", "--estimator", "ekf", "--map", path, *more) == 0
    assert len(load_map(tmp_path / "more.skidmap").map.poses) >= len(saved.map.poses)
    results = json.loads((tmp_path / "out" / "metrics.json").read_text())["results"]
    (found,) = [result["localization"] for result in results if result["estimator"] == "map"]
    assert found["state"] == "localized"
    assert found["probability"] > 0.9
    smoothed, localized = (
        np.loadtxt(tmp_path / folder / name) for folder, name in (("first", "diff_drive_graph_3d.tum"), ("out", "diff_drive_map_3d.tum"))
    )
    assert np.abs(localized[-1, 1:4] - smoothed[-1, 1:4]).max() < 0.03
    last = read_tum(tmp_path / "out" / "diff_drive_map.tum").poses[-1]
    np.testing.assert_allclose(last[:2], localized[-1, 1:3], atol=1e-9)


@pytest.mark.slow
def test_planar_map_for_a_robot_on_hills_is_refused(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_map(tmp_path / "room.skidmap", square_room.saved())
    assert replay(log, tmp_path / "out", "--estimator", "map", "--map", tmp_path / "room.skidmap") == 2
    assert "holds planar scans, and the IMU shows that the ground tilts" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_map_in_space_for_a_planar_lidar_is_refused_before_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, room = tmp_path / "hill.skidmap", bags.write_mcap(tmp_path / "room.mcap", rooms.drive(2.0))
    save_map(path, SavedMap(hill_map.make_map(hill_map.scene_around(np.zeros((2, 2))), hill_map.WAY[:2]), {}))
    before = path.read_bytes()
    for more in ([], ["--extend-map", tmp_path / "more.skidmap"], ["--positions", "/fix"]):
        assert replay(room, tmp_path / "out", "--estimator", "map", "--map", path, *more, robot="vaultbot") == 2
        assert "holds clouds in space" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "more.skidmap").exists()
