"""Checks of a healthy building whose scans are sparse."""

from __future__ import annotations

import pytest

from tests.studies.buildings import BUILDINGS, track_errors
from tests.studies.thinned import thinned


@pytest.mark.slow
def test_sparse_scans_of_a_building_accuse_no_part_of_the_robot() -> None:
    """One scan a second: walls that had the same range in four scans were taken for the robot itself, and the error was 3.9 m."""
    drive = thinned(BUILDINGS["csail"].open(), 1.0)
    run = drive.run("ekf")
    assert track_errors(run.trajectory, drive.reference)[0] < 0.5
    assert not any("robot itself" in text for text in run.warnings)
