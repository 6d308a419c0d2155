"""What is no fault of the set-up is read as before, and accused of nothing."""

from __future__ import annotations

from functools import cache

import pytest

from tests.helpers.extended import cases
from tests.studies.set_ups.forms import FORMS, Form, compare, drawn, read

USUAL = ["scans in bursts of 2.5 s", "gyro of another day", "wheels and gyro jump together"]
_drawn = cache(lambda source: drawn(1, source))
_healthy = cache(lambda source: read(_drawn(source)[1], _drawn(source)[0], None, is_judged=False)[0])


@pytest.mark.extended
@pytest.mark.parametrize("form", cases(FORMS, usual=USUAL, ids=[form.id for form in FORMS]))
def test_form_of_messages_is_read_as_before(form: Form) -> None:
    robot, records = _drawn(form.source)
    before = _healthy(form.source)
    found, accused = read(records, robot, form, is_judged=form.id in USUAL)
    assert {kind: compare(source, found.get(kind)) for kind, source in before.items()} == dict.fromkeys(before, "same")
    assert accused == ()
