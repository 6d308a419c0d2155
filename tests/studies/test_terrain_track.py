"""The effective track of a real Husky on five grounds, from the shipped runs."""

from __future__ import annotations

import numpy as np
import pytest

from motion_models.errors import CalibrationError
from tests.studies.terrain_track import TERRAINS, by_fit, by_seconds, fitted_track, load

TURNING = ("FLOORING", "ASPHALT", "ICE")


@pytest.mark.parametrize("terrain", TURNING)
def test_track_width_of_two_methods_agrees_while_turning(terrain: str) -> None:
    run = load(terrain)
    plain, fitted = by_seconds(run, np.random.default_rng(0)), fitted_track(by_fit(run))
    assert plain is not None
    assert plain.low < fitted.high
    assert fitted.low < plain.high
    assert fitted.low > 0.571  # wider than where the wheels stand: it skids


@pytest.mark.parametrize("terrain", ["ASPHALT", "ICE"])
def test_track_width_of_one_run_agrees_with_all_runs(terrain: str) -> None:
    track = by_seconds(load(terrain), np.random.default_rng(0))
    assert track is not None
    assert track.low <= TERRAINS[terrain] <= track.high


@pytest.mark.parametrize("terrain", ["SANDY_LOAM", "SNOW"])
def test_run_without_turns_is_refused_with_the_drive_needed(terrain: str) -> None:
    run = load(terrain)
    assert by_seconds(run, np.random.default_rng(0)) is None
    with pytest.raises(CalibrationError, match=r"wheel_separation_multiplier .*turning in place"):
        by_fit(run)
