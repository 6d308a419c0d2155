"""Messages are data: every one in the code is in a table and has its fields, every one in a table is used, and the page has them all."""

from __future__ import annotations

import ast
import copy
import importlib
import importlib.util
import json
import pickle
import pkgutil
import string
from collections.abc import Iterator
from pathlib import Path

import pytest

from localization import sensor_checks
from localization.logs.decode import Oddity
from localization.messages import message, phrase, subject
from localization.sensor_checks.faults import SensorFault
from localization.sensor_checks.sensor_consistency import DIFFERENCES

ROOT = Path(__file__).parents[2]
SUBJECTS = sorted(path.stem for path in (ROOT / "localization" / "messages").glob("*.toml"))
TEMPLATES = {f"{name}.{key}": f"{t.text} {t.remedy}" for name in SUBJECTS for key, t in subject(name).templates.items()}
PHRASES = {f"{name}.{key}": text for name in SUBJECTS for key, text in subject(name).phrases.items()}


def fields(text: str) -> set[str]:
    return {name for _, name, _, _ in string.Formatter().parse(text) if name is not None}


def calls() -> Iterator[tuple[str, ast.Call]]:
    """Calls of `message` and `phrase` with an id that is written there."""
    for path in sorted((ROOT / "localization").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("message", "phrase")
            if is_call and node.args and isinstance(node.args[0], ast.Constant):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", node


def literals() -> set[str]:
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "localization").rglob("*.py")]
    trees = [ast.parse(text) for text in sources]
    return {n.value for tree in trees for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}


def test_messages_of_the_code_are_in_a_table_with_the_fields_that_they_are_given():
    found = list(calls())
    assert len(found) > 100
    wrong = []
    for where, call in found:
        table = TEMPLATES if call.func.id == "message" else PHRASES
        name, given = call.args[0].value, {keyword.arg for keyword in call.keywords}
        named, has_more = given - {None}, None in given
        if name not in table or not named <= fields(table[name]) or (not has_more and named != fields(table[name])):
            wrong.append((where, name))
    assert wrong == []


def test_oddities_of_messages_have_the_fields_that_they_are_given():
    assert {oddity.value: fields(TEMPLATES[oddity.value]) for oddity in Oddity} == {o.value: {"topic", "messages"} for o in Oddity}


def test_messages_of_a_table_are_used():
    assert sorted({*TEMPLATES, *PHRASES} - literals()) == []


@pytest.mark.parametrize("name", SUBJECTS)
def test_subject_has_a_title_a_cause_and_a_cure(name: str):
    found = subject(name)
    assert found.templates
    assert all(text.strip() and not text.startswith(" ") for text in (found.title, found.cause, found.cure))
    assert found.cause.endswith(".")
    assert found.cure.endswith(".")


def test_page_of_warnings_is_that_of_the_tables():
    spec = importlib.util.spec_from_file_location("docs_hooks", ROOT / "docs" / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    page = hooks.warnings_page()
    assert (ROOT / "docs" / "warnings.md").read_text(encoding="utf-8") == page, "python docs/hooks.py writes it"
    assert all(f"`{name}`" in page for name in TEMPLATES)


def test_every_fault_of_a_sensor_has_a_message():
    modules = [importlib.import_module(f"{sensor_checks.__name__}.{m.name}") for m in pkgutil.iter_modules(sensor_checks.__path__)]
    faults = {thing for module in modules for thing in vars(module).values() if isinstance(thing, SensorFault)}
    faults |= set(DIFFERENCES.values())
    assert len(faults) >= 18
    assert sorted(fault.id for fault in faults if fault.id not in TEMPLATES) == []


def test_message_names_its_source_and_begin_and_keeps_its_id():
    found = message("scans.late", scans=phrase("scans.many", count=3)).at(2.04).of("ekf (icr)")
    assert found.startswith("ekf (icr): at t = 2.0 s: 3 scans came after later ones and could not be used. ")
    assert found.is_warning
    assert found.of("graph (icr)") == found.replace("ekf", "graph")
    assert (found.id, found.source, found.at_s, found.values) == ("scans.late", "ekf (icr)", 2.04, {"scans": "3 scans"})
    for other in (copy.deepcopy(found), pickle.loads(pickle.dumps(found))):
        assert (other, other.id, other.at_s, other.body) == (found, found.id, found.at_s, found.body)


def test_message_without_a_remedy_is_a_note():
    assert not message("wheel_gaps.no_data", total_s=3.0).is_warning
    assert message("wheel_gaps.long", total_s=90.0).is_warning


def test_message_as_json_has_its_numbers_and_none_that_json_has_not():
    found = message("corridor.by_wheels", way_m=12.0, begin_s=float("nan"), sigma_m=1.5).as_json()
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["values"] == {"way_m": 12.0, "begin_s": None, "sigma_m": 1.5}


def test_message_has_no_bytes_that_are_no_text():
    assert "\\udcff" in message("imu.spike", frame="imu\udcff")


def test_message_without_a_value_or_a_table_is_an_error():
    with pytest.raises(KeyError, match="total_s"):
        message("wheel_gaps.no_data")
    with pytest.raises(KeyError, match="no table of messages"):
        message("nothing.at_all")
