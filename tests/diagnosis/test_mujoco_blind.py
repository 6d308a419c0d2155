"""Blind diagnoses of drives by MuJoCo's physics: a few of `tests.studies.mujoco_blind`."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")

from tests.helpers.diagnosis_drives import drive
from tests.studies.mujoco_blind import diagnose_mujoco, healthy


@pytest.mark.extended
@pytest.mark.parametrize(
    ("cause", "size"), [("wheel_radius_difference", -0.02), ("lidar_offset_x", 0.05)], ids=["wheel_radius_difference", "lidar_offset_x"]
)
def test_diagnose_mujoco_hidden_cause_is_named(cause: str, size: float) -> None:
    found = diagnose_mujoco("husky_a200", "40s", {cause: size}, 7, healthy("husky_a200", drive("tour"))).diagnosis
    first = found.findings[0]
    named = {first.cause: first.size, **dict(first.aliases)}
    assert cause in named
    assert named[cause] == pytest.approx(size, rel=0.3)
