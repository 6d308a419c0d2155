"""Variants of logs, descriptions and references as practitioners bring them: each is read right, or named in a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.extended import cases
from tests.studies.entrance_variants import DEVELOPED, HEALTHY, HELD_OUT
from tests.studies.entrances import Variant

BY_NAME = {f"{v.kind}: {v.name}": v for v in (*DEVELOPED, *HEALTHY, *HELD_OUT)}
USUAL = ["clocks: IMU 3 s behind", "wiring: metres, small robot, gyro alone", "descriptions: wheel_1..4, URDF turned about"]
CHOSEN = [name for i, name in enumerate(BY_NAME) if i % 20 == 0 or name in USUAL]
"""Others run by `python -m tests.studies.entrances`."""


@pytest.mark.extended
@pytest.mark.parametrize("variant", cases([BY_NAME[name] for name in CHOSEN], usual=USUAL, ids=CHOSEN))
def test_variant_of_an_entrance_is_right_or_named(variant: Variant, tmp_path: Path) -> None:
    found = variant.judge(tmp_path)
    assert found.outcome in ("right", "named"), found.text
