"""Examples in docstrings and in the README run and print the stated output."""

from __future__ import annotations

import contextlib
import doctest
import importlib.util
import io
import re
from pathlib import Path

import pytest

from tests.helpers.checkout import HUSKY, ROOT, enter_checkout
from tests.helpers.extended import cases

MODULES = sorted(
    path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__")
    for package in ("motion_models", "localization", "skidloc")
    for path in (ROOT / package).rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
SHORT = [name for name in MODULES if HUSKY.as_posix() not in Path(str(importlib.util.find_spec(name).origin)).read_text(encoding="utf-8")]
"""Those that do not replay a whole log."""


def test_doctests_of_the_public_functions_exist():
    assert {
        "motion_models.se2",
        "motion_models.registry",
        "localization.evaluation.scores",
        "localization.calibration.calibrate",
        "skidloc",
    } <= set(MODULES)


@pytest.mark.parametrize("name", cases(MODULES, usual=SHORT, others=pytest.mark.slow))
def test_docstring_examples_are_true(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted
    assert not result.failed


def test_readme_python_code_runs(tmp_path, monkeypatch):
    enter_checkout(tmp_path, monkeypatch, part=5)
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert blocks
    for block in blocks:
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile(block, "README.md", "exec"), {})
        errors = dict(re.findall(r"^(\w+) ([\d.]+) m$", out.getvalue(), flags=re.MULTILINE))
        assert set(errors) == {"diff_drive_odometry", "diff_drive_ekf"}
        assert float(errors["diff_drive_ekf"]) < float(errors["diff_drive_odometry"])
