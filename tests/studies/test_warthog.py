"""A Warthog by its geometry alone."""

from __future__ import annotations

import numpy as np
import pytest

from tests.studies.warthog import study


@pytest.mark.extended
def test_warthog_study_holds_its_bounds_over_robots() -> None:
    """Medians over sixteen robots; `python -m tests.studies.warthog` has the distribution over 40."""
    found = np.median([study(seed) for seed in range(16)], axis=0)
    no_slip, zero_drive, after_20_s, true_k, best_k = found
    assert zero_drive < 7.5 < no_slip
    assert best_k < after_20_s < zero_drive
    assert best_k < true_k < zero_drive
    assert after_20_s < 2.0
