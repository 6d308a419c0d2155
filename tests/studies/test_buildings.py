"""The filter in two buildings with default settings: accuracy at the reference's own instants, and scans that were matched."""

from __future__ import annotations

import pytest

from tests.studies.buildings import BUILDINGS, track_errors


@pytest.mark.extended
@pytest.mark.parametrize(("name", "seconds", "max_rpe_m"), [("fr079", 240.0, 0.10), ("csail", 1e6, 0.06)])
def test_ekf_in_unknown_building_stays_within_30_cm(name: str, seconds: float, max_rpe_m: float) -> None:
    """fr079's first four minutes keep the suite quick; `python -m tests.studies.buildings` replays all of it."""
    drive = BUILDINGS[name].open().until(seconds)
    run = drive.run("ekf")
    ate, rpe = track_errors(run.trajectory, drive.reference)
    assert ate < 0.30
    assert rpe < max_rpe_m
    assert run.lidar is not None
    assert run.lidar.scans > 1000
    assert not run.lidar.is_long


@pytest.mark.extended
def test_wheels_alone_in_csail_err_by_metres() -> None:
    """The bounds above are not those of the wheels: the log is hard."""
    drive = BUILDINGS["csail"].open()
    ate, rpe = track_errors(drive.run("odometry").trajectory, drive.reference)
    assert ate > 5.0
    assert rpe > 0.5
