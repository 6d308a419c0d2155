"""`skidloc init` on kinds of URDFs as makers write them: each has its wheels, or a sentence that names what it has instead."""

from __future__ import annotations

from pathlib import Path

import pytest

from motion_models.errors import RobotError
from tests.helpers.urdf_kinds import KINDS, REFUSED, Kind, deviations, draft_of


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_init_of_a_kind_of_urdf_is_right_or_named(kind: Kind, tmp_path: Path) -> None:
    assert deviations(kind, draft_of(kind.text, tmp_path)) == []


@pytest.mark.parametrize(("text", "sentence"), REFUSED.values(), ids=REFUSED)
def test_init_of_a_urdf_without_wheels_has_one_sentence(text: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=sentence) as raised:
        draft_of(text, tmp_path)
    assert len(str(raised.value).removeprefix(str(tmp_path))) < 400
