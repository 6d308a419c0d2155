"""Map files: read as written, equal bytes, and a clear error for all that is no whole map of this format."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import random
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest

from localization.errors import MapError, OutputError
from localization.maps import KeyframeMap, SavedMap, load_map, save_map
from tests.helpers import square_room


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "room.skidmap"
    save_map(path, square_room.saved())
    return path


def rewrite(path: Path, member: str, content: bytes | None) -> None:
    """Replace ``member``; None leaves it out."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()} | {member: content}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            if data is not None:
                archive.writestr(name, data)


def rewrite_header(path: Path, **changes: object) -> None:
    with zipfile.ZipFile(path) as archive:
        header = json.loads(archive.read("skidmap.json"))
    rewrite(path, "skidmap.json", json.dumps(header | changes).encode())


def test_map_saved_and_loaded_is_equal(file: Path) -> None:
    found, expected = load_map(file), square_room.saved()
    assert found.provenance == expected.provenance
    for field in dataclasses.fields(KeyframeMap):
        np.testing.assert_array_equal(getattr(found.map, field.name), getattr(expected.map, field.name))


def test_map_saved_twice_has_equal_bytes(file: Path, tmp_path: Path) -> None:
    save_map(tmp_path / "again.skidmap", load_map(file))
    assert (tmp_path / "again.skidmap").read_bytes() == file.read_bytes()


def test_map_without_edges_and_scans_is_kept(tmp_path: Path) -> None:
    one = square_room.make_map(square_room.POSES[:1])
    empty = dataclasses.replace(one, points=np.empty((0, 2), np.float32), counts=np.zeros(1, np.int64))
    save_map(tmp_path / "one.skidmap", SavedMap(empty, {}))
    assert load_map(tmp_path / "one.skidmap").map.points_in_map().shape == (0, 2)


def test_save_over_a_file_is_refused(file: Path) -> None:
    before = file.read_bytes()
    with pytest.raises(OutputError, match="exists already"):
        save_map(file, square_room.saved())
    assert file.read_bytes() == before


def test_save_of_poses_not_finite_is_refused(tmp_path: Path) -> None:
    bad = dataclasses.replace(square_room.make_map(), poses=np.full((3, 3), np.nan))
    with pytest.raises(MapError, match="poses has numbers that are not finite"):
        save_map(tmp_path / "bad.skidmap", SavedMap(bad, {}))
    assert not list(tmp_path.iterdir())


def test_load_of_a_newer_version_names_both(file: Path) -> None:
    rewrite_header(file, version=7)
    with pytest.raises(MapError, match="version 7 of the format, and this program reads 1 and 2"):
        load_map(file)


def test_load_of_what_is_no_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no map"):
        load_map(tmp_path / "none.skidmap")
    with pytest.raises(MapError, match="is a folder"):
        load_map(tmp_path)
    text = tmp_path / "text.skidmap"
    text.write_text("image: map.pgm\n")
    with pytest.raises(MapError, match="no map file"):
        load_map(text)
    foreign = tmp_path / "foreign.zip"
    with zipfile.ZipFile(foreign, "w") as archive:
        archive.writestr("a.txt", "a")
    with pytest.raises(MapError, match=r"no skidmap\.json"):
        load_map(foreign)


def test_load_of_other_content_under_a_checksum_is_refused(file: Path) -> None:
    rewrite(file, "poses.npy", b"\x93NUMPY")
    with pytest.raises(MapError, match="poses differs from its checksum"):
        load_map(file)


def test_load_without_an_array_is_refused(file: Path) -> None:
    rewrite(file, "edges.npy", None)
    with pytest.raises(MapError, match="truncated, damaged"):
        load_map(file)


@pytest.mark.parametrize(
    "changes",
    [
        {"counts": np.array([720, 720, 719])},
        {"counts": np.array([-1, 720, 1441])},
        {"edges": np.array([[0, 1], [1, 3]])},
        {"poses": square_room.POSES[:2]},
        {"covariances": np.tile(-np.eye(3), (3, 1, 1))},
    ],
)
def test_save_of_arrays_that_disagree_is_refused(tmp_path: Path, changes: dict[str, np.ndarray]) -> None:
    with pytest.raises(MapError):
        save_map(tmp_path / "bad.skidmap", SavedMap(dataclasses.replace(square_room.make_map(), **changes), {}))


def test_load_of_truncated_and_damaged_files_raises_map_errors(file: Path) -> None:
    """200 files with a byte changed and 50 that are cut off give the map or `MapError`; what is cut off never gives a map."""
    data, rng = file.read_bytes(), random.Random(0)
    expected = square_room.make_map()
    for _ in range(200):
        damaged = bytearray(data)
        damaged[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        file.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(load_map(file).map.points, expected.points)
        except MapError:
            continue
    for _ in range(50):
        file.write_bytes(data[: rng.randrange(len(data))])
        with pytest.raises(MapError):
            load_map(file)


@pytest.mark.parametrize("attempt", range(30))
def test_save_by_two_at_once_leaves_one_whole_file_and_refuses_the_other(tmp_path: Path, attempt: int) -> None:
    path, both, refused = tmp_path / f"room{attempt}.skidmap", threading.Barrier(2), []

    def save(log: str) -> None:
        both.wait(10.0)
        try:
            save_map(path, SavedMap(square_room.make_map(), {"log": log}))
        except OutputError as error:
            refused.append(str(error))

    nodes = [threading.Thread(target=save, args=(log,)) for log in ("first", "second")]
    for node in nodes:
        node.start()
    for node in nodes:
        node.join()
    assert len(refused) == 1
    assert "exists already" in refused[0]
    assert load_map(path).provenance["log"] in ("first", "second")
    assert list(tmp_path.iterdir()) == [path]


def test_save_on_a_file_system_without_hard_links_writes_a_whole_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(source: str, target: Path) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path, saved = tmp_path / "room.skidmap", square_room.saved()
    save_map(path, saved)
    np.testing.assert_array_equal(load_map(path).map.points, saved.map.points)
    with pytest.raises(OutputError, match="exists already"):
        save_map(path, saved)
    assert list(tmp_path.iterdir()) == [path]
