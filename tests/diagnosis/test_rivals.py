"""Other ways to choose causes, on a case of the benchmark."""

from __future__ import annotations

import pytest

from tests.benchmarks.diagnosis import case_of, run
from tests.helpers.diagnosis_rivals import NONE


@pytest.mark.slow
def test_rivals_of_a_clear_case() -> None:
    row = run(case_of(400), has_rivals=True)  # VaultBot, longitudinal_slip_turning
    assert row["rivals"]["stepwise"][0] == row["findings"][0]["cause"] == next(iter(row["truth"]))
    assert row["rivals"]["gp"][0] == row["rivals"]["noise"][0] == NONE
    assert row["gain"] == pytest.approx(row["oracle"], abs=0.02)
