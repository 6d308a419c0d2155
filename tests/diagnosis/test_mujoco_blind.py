"""Blind diagnoses of drives by MuJoCo's physics: a few of `tests.studies.mujoco_blind`."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")

from tests.helpers.diagnosis_drives import drive
from tests.studies.mujoco_blind import diagnose_mujoco, healthy


@pytest.mark.extended
def test_diagnose_mujoco_hidden_cause_is_named() -> None:
    cause, size = "lidar_offset_x", 0.05
    found = diagnose_mujoco("husky_a200", "40s", {cause: size}, 7, healthy("husky_a200", drive("tour"))).diagnosis
    first = found.findings[0]
    named = {first.cause: first.size, **dict(first.aliases)}
    assert cause in named
    assert named[cause] == pytest.approx(size, rel=0.3)
