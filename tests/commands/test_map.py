"""`replay --save-map`, `skidloc map info` and `skidloc map export` from end to end."""

from __future__ import annotations

import base64
import io
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from localization.cli import main
from localization.maps import SavedMap, load_map, save_map
from localization.trajectory import read_tum
from tests.helpers import bags, floor_plan, rooms

pytestmark = pytest.mark.xdist_group("map")


def replay(log: Path, out: Path, *more: object) -> int:
    return main(["replay", str(log), "--robot", "vaultbot", "--model", "diff_drive", "--out", str(out), *map(str, more)])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write_mcap(tmp_path_factory.mktemp("log") / "room.mcap", rooms.drive(15.0))


@pytest.fixture(scope="module")
def saved(log: Path) -> Path:
    path = log.parent / "room.skidmap"
    assert replay(log, log.parent / "first", "--estimator", "ekf,graph", "--save-map", path) == 0
    return path


def test_save_map_holds_the_rooms_walls_and_provenance(saved: Path) -> None:
    found = load_map(saved)
    x, y = found.map.points_in_map().T
    off = np.min([np.abs(x - rooms.X[0]), np.abs(x - rooms.X[1]), np.abs(y - rooms.Y[0]), np.abs(y - rooms.Y[1])], axis=0)
    assert np.quantile(off, 0.95) < 0.1
    assert len(found.map.poses) >= 5
    assert found.provenance["robot"] == "vaultbot"
    assert found.provenance["log_fingerprint"]
    assert (found.map.stamps_ns[1:] > found.map.stamps_ns[:-1]).all()


def test_save_map_twice_gives_equal_bytes(log: Path, saved: Path, tmp_path: Path) -> None:
    assert replay(log, tmp_path / "again", "--estimator", "graph", "--save-map", tmp_path / "again.skidmap") == 0
    assert (tmp_path / "again.skidmap").read_bytes() == saved.read_bytes()


def test_map_info_gives_size_and_source(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "info", str(saved), "--json", str(tmp_path / "info.json")]) == 0
    text = capsys.readouterr().out
    assert "robot vaultbot" in text
    found = json.loads((tmp_path / "info.json").read_text())
    np.testing.assert_allclose(found["size_m"], [rooms.X[1] - rooms.X[0], rooms.Y[1] - rooms.Y[0]], atol=0.3)


def test_map_export_writes_a_folder_once(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "exported"
    assert main(["map", "export", str(saved), "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["map.pgm", "map.ply", "map.png", "map.yaml"]
    assert 0.5 < np.mean(np.asarray(Image.open(out / "map.pgm")) == 254) < 0.98
    capsys.readouterr()
    assert main(["map", "export", str(saved), "--out", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_map_view_is_one_page_with_grid_keyframes_and_loops(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "room.html"
    assert main(["map", "view", str(saved), "--out", str(page)]) == 0
    text = page.read_text()
    assert not re.findall(r"<(?:script|link|img)[^>]* (?:src|href)=", text)
    data = json.loads(text.split('id="explore-data">')[1].split("</script>")[0])
    (drive,) = data["runs"]
    expected = load_map(saved).map
    np.testing.assert_allclose(drive["x"], expected.poses[:, 0], atol=1e-3)
    assert len(drive["loops"]) == expected.edge_is_loop.sum()
    picture = Image.open(io.BytesIO(base64.b64decode(data["grid"]["source"].split(",")[1])))
    assert picture.width * 0.05 == pytest.approx(data["grid"]["width"])
    assert {0, 205, 254} == set(np.unique(np.asarray(picture)).tolist())
    capsys.readouterr()
    assert main(["map", "view", str(saved), "--out", str(page)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_map_of_a_truncated_file_exits_with_2(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = tmp_path / "cut.skidmap"
    cut.write_bytes(saved.read_bytes()[:1000])
    assert main(["map", "export", str(cut), "--out", str(tmp_path / "out")]) == 2
    assert "truncated" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_save_map_without_a_graph_or_onto_a_file_is_refused(log: Path, saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert replay(log, log.parent / "other", "--estimator", "ekf", "--save-map", log.parent / "other.skidmap") == 2
    assert "--estimator" in capsys.readouterr().err
    assert replay(log, log.parent / "other", "--estimator", "graph", "--save-map", saved) == 2
    assert "exists already" in capsys.readouterr().err


def localization(out: Path) -> dict[str, Any]:
    results = json.loads((out / "metrics.json").read_text())["results"]
    (found,) = [result["localization"] for result in results if result["estimator"] == "map"]
    return found


def test_replay_in_its_own_map_near_a_pose_is_localized(log: Path, saved: Path, tmp_path: Path) -> None:
    """The room is nearly symmetric; the pose is off by 0.3 m and 6 degrees, and its poses are then those of the map."""
    assert replay(log, tmp_path / "out", "--estimator", "ekf", "--map", saved, "--initial-pose", 0.3, 0.1, 6) == 0
    found = localization(tmp_path / "out")
    assert found["state"] == "localized"
    assert found["probability"] > 0.9
    assert found["first_localized_s"] < 6.0
    last = read_tum(tmp_path / "out" / "diff_drive_map.tum").poses[-1]
    expected = load_map(saved).map
    assert np.hypot(*(last[:2] - expected.poses[-1, :2])) < 0.6  # of the keyframe before
    assert found["places"] == []
    (estimator,) = [r for r in json.loads((tmp_path / "out" / "metrics.json").read_text())["results"] if r["estimator"] == "ekf"]
    assert "localization" not in estimator


@pytest.mark.extended
def test_replay_extend_map_of_the_same_room_adds_little_and_keeps_the_old_file(log: Path, saved: Path, tmp_path: Path) -> None:
    before, extended = saved.read_bytes(), tmp_path / "extended.skidmap"
    assert (
        replay(log, tmp_path / "out", "--estimator", "graph", "--map", saved, "--initial-pose", 0.3, 0.1, 6, "--extend-map", extended) == 0
    )
    old, new = load_map(saved).map, load_map(extended)
    assert len(old.poses) <= len(new.map.poses) < 1.5 * len(old.poses)
    assert len(new.provenance["extended_from"]) == 2
    assert saved.read_bytes() == before
    assert localization(tmp_path / "out")["changed_share"] < 0.05
    report = (tmp_path / "out" / "report.html").read_text()
    assert "Occupancy grid of the map" in report


@pytest.mark.extended
def test_replay_extend_map_by_another_building_writes_nothing(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    office, extended = tmp_path / "office.skidmap", tmp_path / "extended.skidmap"
    save_map(office, SavedMap(floor_plan.make_map(), {}))
    before = office.read_bytes()
    assert replay(log, tmp_path / "out", "--estimator", "map", "--map", office, "--extend-map", extended) == 2
    assert "nothing was added" in capsys.readouterr().err
    assert office.read_bytes() == before
    assert not extended.exists()


@pytest.mark.extended
def test_replay_in_another_buildings_map_is_never_localized(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_map(tmp_path / "office.skidmap", SavedMap(floor_plan.make_map(), {}))
    assert replay(log, tmp_path / "out", "--estimator", "ekf", "--map", tmp_path / "office.skidmap") == 0
    found = localization(tmp_path / "out")
    assert found["localized_s"] == 0.0
    assert found["probability"] < 0.9
    assert "never localized" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--estimator", "map"], "--map"),
        (["--initial-pose", "1", "2", "3"], "--map"),
        (["--map", "missing.skidmap"], "no map 'missing.skidmap'"),
        (["--extend-map", "more.skidmap"], "--map"),
    ],
)
def test_replay_without_a_map_to_localize_in_exits_with_2(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert replay(log, tmp_path / "out", *arguments) == 2
    assert message in capsys.readouterr().err


def log_with_fixes(path: Path, first_s: int) -> Path:
    """The room's drive, with a fix of 0.1 m each second from ``first_s`` on: the first one is the origin of the log's plane."""
    metre = math.degrees(1.0 / 6_371_000.0)
    fixes = []
    for second in range(first_s, 20):
        x, y, _ = rooms.truth(float(second))
        stamp, cov = bags.START + second * bags.S, 0.01 * np.eye(3)
        fixes.append(("/fix", bags.fix(stamp, 48.0 + x * metre, 11.0 - y * metre / math.cos(math.radians(48.0)), covariance=cov), stamp))
    return bags.write_mcap(path, sorted([*rooms.drive(20.0), *fixes], key=lambda record: record[2]))


@pytest.mark.extended
def test_replay_in_a_map_with_positions_is_localized_by_them(tmp_path: Path) -> None:
    """The room is the same from four sides; both logs have an origin of their own."""
    saved, first = tmp_path / "placed.skidmap", log_with_fixes(tmp_path / "first.mcap", 0)
    assert replay(first, tmp_path / "a", "--estimator", "graph", "--positions", "/fix", "--reference", "none", "--save-map", saved) == 0
    plane = load_map(saved).map.plane
    assert plane is not None
    assert plane.origin == pytest.approx((48.0, 11.0, 0.0))
    assert abs(abs(plane.plane_T_map[2]) - 0.5 * math.pi) < 0.1  # the drive begins to the north
    second = log_with_fixes(tmp_path / "second.mcap", 4)
    assert replay(second, tmp_path / "b", "--estimator", "ekf", "--map", saved, "--positions", "/fix", "--reference", "none") == 0
    assert localization(tmp_path / "b")["state"] == "localized"
    assert "positions could not be used" not in (tmp_path / "b" / "metrics.json").read_text()
