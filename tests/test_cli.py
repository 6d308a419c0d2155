"""The command line itself: the overview, unknown commands, and what it imports."""

import importlib
import subprocess
import sys

import pytest

from localization.cli import COMMANDS, main

HEAVY = ("numpy", "scipy", "numba", "gtsam", "matplotlib", "tyro")


@pytest.mark.parametrize("name", COMMANDS)
def test_overview_of_each_command_is_its_docstring(name: str) -> None:
    class_name, summary = COMMANDS[name]
    command = getattr(importlib.import_module(f"localization.commands.{name}"), class_name)
    assert (command.__doc__ or "").splitlines()[0] == summary


def test_help_without_command_lists_all_and_imports_no_numerical_library() -> None:
    code = f"import sys; from localization.cli import main; main(['--help']); print([n for n in {HEAVY} if n in sys.modules])"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert printed[-1] == "[]"
    assert {line.split()[0] for line in printed if line.startswith("  ")} == set(COMMANDS)


@pytest.mark.parametrize(
    ("arguments", "expected"), [(["inof"], "did you mean 'info'?"), ([], "a command is missing"), (["xyz"], "there are info, replay")]
)
def test_unknown_command_is_refused_with_the_nearest(arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert expected in capsys.readouterr().err
