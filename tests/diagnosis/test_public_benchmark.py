"""The public benchmark: each method on one case, and the table of scores."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.diagnosis_public import EFFECTS, METHODS, cases, is_installed, score, table
from tests.helpers.diagnosis_unknown import FURTHER, UNKNOWN, VERIFYING


def test_public_effects_have_all_kinds_of_the_other_studies() -> None:
    assert {*UNKNOWN, *VERIFYING, *FURTHER} < set(EFFECTS)
    assert sum(not hidden.names for hidden in EFFECTS.values()) >= 20


def test_public_table_of_a_method_that_is_not_installed_says_so() -> None:
    row = {"method": "skidloc", "effect": "nothing", "names": [], "is_alarm": False, "is_named": False, "is_wrong": False}
    text = table([{**row, "size_error": float("nan"), "removed": float("nan"), "seconds": 1.0, "is_written": False}])
    assert "| GP residual (scikit-learn) | not installed |" in text
    assert "| skidloc | 0/1 | 0/0 |" in text


@pytest.mark.extended
def test_public_score_of_a_law_by_each_method(tmp_path: Path) -> None:
    """The fresh drive is of other motions: what the written file removes there is the law's."""
    ((_, name, *drives),) = cases(("windows",), ("slip when accelerating",), tmp_path)
    rows = {m: score(m, name, (drives[0], drives[1], drives[2]), None) for m in METHODS if is_installed(m)}
    assert rows["skidloc"]["names"] == ["vx[dv]"]
    assert rows["skidloc"]["removed"] == pytest.approx(1.0, abs=0.05)
    assert rows["skidloc"]["size_error"] < 0.1
    assert rows["stepwise BIC"]["is_named"]
    assert rows["least squares"]["removed"] < 0.5
