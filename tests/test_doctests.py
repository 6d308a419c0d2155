"""Examples in docstrings and in the README run and print the stated output."""

from __future__ import annotations

import contextlib
import doctest
import importlib
import io
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MODULES = sorted(
    path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__")
    for package in ("motion_models", "localization", "skidloc")
    for path in (ROOT / package).rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


def test_doctests_of_the_public_functions_exist():
    assert {
        "motion_models.se2",
        "motion_models.registry",
        "localization.evaluation.scores",
        "localization.calibration.calibrate",
        "skidloc",
    } <= set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_are_true(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted
    assert not result.failed


def test_readme_python_code_runs(monkeypatch):
    monkeypatch.chdir(ROOT)
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert blocks
    for block in blocks:
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile(block, "README.md", "exec"), {})
        errors = dict(re.findall(r"^(\w+) ([\d.]+) m$", out.getvalue(), flags=re.MULTILINE))
        assert set(errors) == {"diff_drive_odometry", "diff_drive_ekf"}
        assert float(errors["diff_drive_ekf"]) < 0.6 * float(errors["diff_drive_odometry"])
