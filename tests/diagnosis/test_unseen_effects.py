"""Laws of `tests.studies.unseen_effects` whose file was wrong, or was missing, when they were run first."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")

from tests.studies.unseen_effects import case_of, run


@pytest.mark.slow
def test_extend_law_that_follows_time_is_not_written_as_a_law_of_motion(tmp_path: Path) -> None:
    """vx = c wz sin(t/9) on a Jackal: |v| wz^3 and v wz^2 took 92 % of its squares on this drive, and added 12 times them on another."""
    row = run(case_of(8, 24), 8, tmp_path)
    assert row["truth"] == "vx[wz*sin(t/9)]"
    assert not row["written"]
    assert row["removed"] > -0.02


@pytest.mark.slow
def test_extend_law_whose_size_is_alike_in_all_parts_is_written(tmp_path: Path) -> None:
    """wz = c min(v, 0) max(wz, 0) on a Warthog: each quarter shows 1.4 to 1.6 times what the terms change."""
    row = run(case_of(8, 22), 8, tmp_path)
    assert row["truth"] == "wz[min(v,0)*max(wz,0)]"
    assert row["has_file"]
    assert row["removed"] > 0.7
