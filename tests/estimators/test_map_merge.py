"""Merging the maps of two drives: the second one's keyframes where they are in the first, or an error for two buildings."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from localization.cli import main
from localization.errors import MapError
from localization.estimators import merge_maps
from localization.maps import SavedMap, load_map, save_map
from motion_models import se2
from tests.helpers import floor_plan

FIRST = floor_plan.make_map()
WAY = floor_plan.path((6, 3.6), (11, 4), (11, 7), (7.5, 6.5), (6, 3.6), (3.5, 3.6), (3.5, 1.0), step=0.7)
ORIGIN = np.array([4.0, -2.0, 1.1])
"""Of the second map, in the first."""


def second():
    """A drive of another day in a frame of its own; its poses drift by 0.1 m."""
    there = floor_plan.make_map(poses=WAY)
    own = np.array([se2.between(ORIGIN, pose) for pose in WAY])
    own[:, 0] += np.linspace(0.0, 0.1, len(own))
    return dataclasses.replace(there, poses=own)


def test_merge_moves_the_second_map_into_the_first() -> None:
    found = merge_maps(FIRST, second(), 0.02)
    poses = found.map.poses[len(FIRST.poses) :]
    np.testing.assert_array_equal(found.map.poses[: len(FIRST.poses)], FIRST.poses)
    assert np.hypot(*(poses[:, :2] - WAY[:, :2]).T).max() < 0.05
    assert found.closed > 0.6 * len(WAY)
    assert np.median(found.errors) < 0.03
    assert 0.005 < np.quantile(found.bent, 0.95) < 0.1
    assert found.map.edge_is_loop.sum() == found.closed
    assert (np.linalg.eigvalsh(found.map.covariances)[:, 0] > 0.0).all()


@pytest.mark.extended
def test_merge_of_two_buildings_is_refused() -> None:
    hall = floor_plan.make_map(floor_plan.HALL, floor_plan.path((1, 1), (8, 1), step=1.8))
    with pytest.raises(MapError, match="could not be joined"):
        merge_maps(FIRST, hall, 0.02)


def test_map_merge_command_writes_a_map_with_both_sources(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, mapped in (("a", FIRST), ("b", second())):
        save_map(tmp_path / f"{name}.skidmap", SavedMap(mapped, {"log": name}))
    assert main(["map", "merge", *(str(tmp_path / f"{name}.skidmap") for name in "ab"), "--out", str(tmp_path / "c.skidmap")]) == 0
    assert "keyframes of" in capsys.readouterr().out
    found = load_map(tmp_path / "c.skidmap")
    assert [source["log"] for source in found.provenance["merged_from"]] == ["a", "b"]
    assert len(found.map.poses) == len(FIRST.poses) + len(WAY)
    assert main(["map", "info", str(tmp_path / "c.skidmap")]) == 0
