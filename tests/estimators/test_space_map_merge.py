"""Merging maps in space: the second drive's keyframes where they are in the first, new ones alone to extend it, or an error."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from localization.cli import main
from localization.errors import MapError
from localization.estimators import merge_maps
from localization.maps import KeyframeMap, SavedMap, load_map, save_map
from motion_models import se3
from tests.helpers import floor_plan, hill_map

pytestmark = [pytest.mark.xdist_group("hill_map"), pytest.mark.extended]

_WAY = np.array(hill_map.WAY)
_SECOND = tuple(
    map(tuple, np.vstack([_WAY[2:] + np.array([0.3, 0.4, 0.1]), [_WAY[-1] + [(i + 1) * 1.5, (i + 1) * 1.2, 0.0] for i in range(4)]]))
)
"""Beside the first way, and beyond its end."""
_ORIGIN = hill_map.on_hills(1.0, -2.0, 1.1)
"""Of the second map's frame, level, in the first."""
_ORIGIN[:3, :3] = se3.rotation(np.array([0.0, 0.0, 1.1]))


@pytest.fixture(scope="module")
def scene():
    return hill_map.scene_around(np.vstack([_WAY[:, :2], np.array(_SECOND)[:, :2]]))


@pytest.fixture(scope="module")
def first(scene) -> KeyframeMap:
    return hill_map.make_map(scene)


@pytest.fixture(scope="module")
def second(scene) -> KeyframeMap:
    """In a frame of its own; its poses drift by 0.1 m."""
    there = hill_map.make_map(scene, _SECOND)
    own = se3.inverse(_ORIGIN) @ there.poses
    own[:, 0, 3] += np.linspace(0.0, 0.1, len(own))
    return dataclasses.replace(there, poses=own)


def true_poses() -> np.ndarray:
    return np.array([hill_map.on_hills(*place) for place in _SECOND])


@pytest.mark.slow
def test_merge_in_space_moves_the_second_map_into_the_first(first, second) -> None:
    found = merge_maps(first, second, 0.02)
    n = len(first.poses)
    np.testing.assert_array_equal(found.map.poses[:n], first.poses)
    assert found.added == len(_SECOND)
    assert found.closed >= 5
    off = np.array([se3.local(pose, true) for pose, true in zip(found.map.poses[n:], true_poses(), strict=True)])
    assert np.linalg.norm(off[:7, :3], axis=1).max() < 0.04
    assert np.linalg.norm(off[:, :3], axis=1).max() < 0.15  # beyond the first map by drift alone
    nees = [e @ np.linalg.solve(P, e) for e, P in zip(off, found.map.covariances[n:], strict=True)]
    assert np.max(nees) < 30.0
    assert np.median(found.errors) < 0.03
    assert found.map.edge_is_loop.sum() == found.closed
    assert (np.linalg.eigvalsh(found.map.covariances)[:, 0] > 0.0).all()


@pytest.mark.slow
def test_extension_in_space_adds_what_the_map_does_not_have(first, second) -> None:
    found = merge_maps(first, second, 0.02, only_new=True)
    added = found.map.stamps_ns[len(first.poses) :] // 10**9
    assert 0 < found.added < len(_SECOND)
    assert len(_SECOND) - 1 in added or len(_SECOND) - 2 in added  # beyond the end of the first way
    again = merge_maps(found.map, second, 0.02, only_new=True)
    assert again.added <= 1


@pytest.mark.slow
def test_extension_in_space_removes_what_is_gone(first, scene) -> None:
    nearest = np.argsort(np.hypot(*scene.trees[:, :2].T))
    felled = dataclasses.replace(scene, trees=scene.trees[nearest[4:]])
    again = hill_map.make_map(felled, tuple(map(tuple, _WAY + np.array([0.4, -0.5, 0.3]))))
    found = merge_maps(first, again, 0.02, only_new=True)
    n = found.map.counts[: len(first.poses)].sum()
    assert 50 < found.removed == len(first.points) - n
    assert merge_maps(first, again, 0.02).removed == 0


@pytest.mark.slow
def test_maps_of_other_hills_or_of_one_kind_each_are_not_merged(first, scene) -> None:
    poses = [se3.exp(np.array([0.6 * i, 0.0, 0.0, 0.0, 0.0, 0.0])) for i in range(4)]
    there = hill_map.make_map(scene, hill_map.WAY[:4])
    other = dataclasses.replace(there, poses=np.array(poses), points=there.points[:, [1, 0, 2]])  # as in a mirror
    with pytest.raises(MapError, match="could not be joined"):
        merge_maps(first, other, 0.02)
    with pytest.raises(MapError, match="one map holds planar scans, the other clouds in space"):
        merge_maps(first, floor_plan.make_map(), 0.02)


def test_map_merge_command_joins_maps_in_space(first, second, tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, mapped in (("a", first), ("b", second)):
        save_map(tmp_path / f"{name}.skidmap", SavedMap(mapped, {"log": name}))
    assert main(["map", "merge", *(str(tmp_path / f"{name}.skidmap") for name in "ab"), "--out", str(tmp_path / "c.skidmap")]) == 0
    assert "keyframes of" in capsys.readouterr().out
    found = load_map(tmp_path / "c.skidmap")
    assert found.map.is_in_space
    assert len(found.map.poses) == len(first.poses) + len(_SECOND)
