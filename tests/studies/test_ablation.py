"""The ablation study: every replacement fits the code that it replaces, and leaves nothing behind."""

from __future__ import annotations

import numpy as np
import pytest

from tests.studies.ablation import BEGIN, END, GRAPH_PATCHES, JOURNAL, PATCHES, SETTINGS, write_into
from tests.studies.buildings import BUILDINGS, Drive

pytestmark = pytest.mark.xdist_group("ablation")

_SECONDS = 25.0


@pytest.fixture(scope="module")
def drive() -> Drive:
    """The start of MIT-CSAIL: some 110 scans, half of them in motion."""
    return BUILDINGS["csail"].open().until(_SECONDS)


@pytest.fixture(scope="module")
def poses(drive: Drive) -> np.ndarray:
    return drive.run("ekf", "skid_steer").trajectory.poses


@pytest.mark.extended
@pytest.mark.parametrize("name", PATCHES)
def test_patch_runs_and_leaves_nothing_behind(name: str, drive: Drive, poses: np.ndarray) -> None:
    with PATCHES[name]():
        changed = drive.run("ekf", "skid_steer").trajectory.poses
    assert changed.shape == poses.shape
    assert np.isfinite(changed).all()
    assert np.array_equal(drive.until(5.0).run("ekf", "skid_steer").trajectory.poses, poses[: _scans(drive, 5.0)])


@pytest.mark.extended
@pytest.mark.parametrize("name", GRAPH_PATCHES)
def test_patch_of_graph_runs(name: str, drive: Drive) -> None:
    with GRAPH_PATCHES[name]():
        changed = drive.run("graph", "skid_steer")
    assert np.isfinite(changed.trajectory.poses).all()
    assert changed.counts["keyframes"] > 10


@pytest.mark.extended
@pytest.mark.parametrize("name", ["submap's error", "prior in the least squares", "thickness of surfaces", "size of the residuals"])
def test_patch_of_matcher_changes_poses(name: str, drive: Drive, poses: np.ndarray) -> None:
    with PATCHES[name]():
        assert not np.array_equal(drive.run("ekf", "skid_steer").trajectory.poses, poses)


@pytest.mark.extended
@pytest.mark.parametrize("name", SETTINGS)
def test_setting_changes_poses(name: str, drive: Drive, poses: np.ndarray) -> None:
    assert not np.array_equal(drive.run("ekf", "skid_steer", **SETTINGS[name]).trajectory.poses, poses)


def test_table_is_written_between_the_markers() -> None:
    text = JOURNAL.read_text(encoding="utf-8")
    found = write_into(text, ["| a |", "|---|"])
    assert found.split(BEGIN)[0] == text.split(BEGIN)[0]
    assert found.split(END)[1] == text.split(END)[1]
    assert f"{BEGIN}\n| a |\n|---|\n{END}" in found


def _scans(drive: Drive, seconds: float) -> int:
    return len(drive.until(seconds).run("ekf", "skid_steer").trajectory)
