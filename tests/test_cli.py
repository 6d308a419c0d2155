"""The command line itself: the overview, unknown commands, and what it imports."""

import dataclasses
import importlib
import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

from localization.cli import COMMANDS, main, module_of
from localization.commands.arguments import bash_completion
from localization.commands.short_help import short_help

HEAVY = ("numpy", "scipy", "numba", "gtsam", "matplotlib", "tyro")


@pytest.mark.parametrize("name", COMMANDS)
def test_overview_of_each_command_is_its_docstring(name: str) -> None:
    class_name, summary = COMMANDS[name]
    command = getattr(importlib.import_module(f"localization.commands.{module_of(name)}"), class_name)
    assert (command.__doc__ or "").splitlines()[0] == summary


def test_help_without_command_lists_all_and_imports_no_numerical_library() -> None:
    code = f"import sys; from localization.cli import main; main(['--help']); print([n for n in {HEAVY} if n in sys.modules])"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert printed[-1] == "[]"
    assert {line.split()[0] for line in printed if line.startswith("  ")} == set(COMMANDS)


@pytest.mark.parametrize(
    ("arguments", "expected"), [(["inof"], "did you mean 'info'?"), ([], "a command is missing"), (["xyz"], "there are try, info, replay")]
)
def test_unknown_command_is_refused_with_the_nearest(arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "map"])
def test_short_help_has_each_option_of_the_command(command: str) -> None:
    """Against the dataclass that tyro reads, for which everything is imported."""
    name = COMMANDS[command][0]
    text = short_help(command, name)
    assert text is not None
    for field in dataclasses.fields(getattr(importlib.import_module(f"localization.commands.{module_of(command)}"), name)):
        flag = "--" + field.name.replace("_", "-")
        assert any(line.startswith(("  " + flag, "  " + field.name.upper())) for line in text.splitlines()) or f"{flag}.*" in text


@pytest.mark.parametrize("command", ["replay", "online"])
def test_help_of_a_command_imports_no_numerical_library(command: str) -> None:
    code = f"import sys; from localization.cli import main; main(['{command}', '--help']); print([n for n in {HEAVY} if n in sys.modules])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert shown.splitlines()[-1] == "[]"
    assert "--estimator" in shown


def test_version_is_that_of_the_distribution(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"skidloc {importlib.metadata.version('skidloc')}\n"


@pytest.mark.parametrize(
    ("options", "planar"), [([], None), (["--config.step.planar"], True), (["--config.step.no-planar"], False)], ids=["auto", "on", "off"]
)
def test_planar_option_has_three_states(monkeypatch, tmp_path, options, planar):
    seen = []
    monkeypatch.setattr("localization.commands.replay.Replay.run", lambda self, console: seen.append(self.config.step.planar))
    (tmp_path / "some.bag").touch()
    assert main(["replay", str(tmp_path / "some.bag"), "--robot", "husky_a200", *options, "--out", str(tmp_path / "out")]) == 0
    assert seen == [planar]


def test_log_that_is_not_there_is_refused_before_numerical_libraries_are_imported() -> None:
    code = (
        f"import sys; from localization.cli import main; print(main(['replay', 'nofile.bag', '--robot', 'x', '--out', 'y'])); "
        f"print([n for n in {HEAVY} if n in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["2", "[]"]
    assert "no log 'nofile.bag'" in shown.stderr


def test_robot_and_model_with_a_slip_of_the_pen_are_refused_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "vaultbot"]) == 0
    assert main(["cg", "--robot", "vaultbt", "--posture", "ready"]) == 2
    assert "did you mean 'vaultbot'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (("init", "drive", "robot.toml"), "init needs --out ROBOT.toml: Robot file to write"),
        (("replay", "drive", "--robt", "jackal"), "did you mean '--robot'?"),
        (("replay", "drive", "--robot", "jackel", "--out", "x"), "no robot 'jackel'; did you mean 'jackal'?"),
        (("rplay", "drive"), "no command 'rplay'; did you mean 'replay'?"),
    ],
)
def test_wrong_arguments_are_named_without_heavy_imports(given: tuple[str, ...], expected: str, tmp_path: Path) -> None:
    (tmp_path / "drive").mkdir()
    code = "import sys; from localization.cli import main; c = main(sys.argv[1:]); print(c, 'numpy' in sys.modules, 'tyro' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code, *given], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert expected in shown.stderr
    assert shown.stdout.split() == ["2", "False", "False"]


def test_completion_has_commands_options_and_robots(tmp_path: Path) -> None:
    (tmp_path / "completion.sh").write_text(bash_completion(COMMANDS))
    script = "source completion.sh; COMP_WORDS=({}); COMP_CWORD={}; _skidloc; echo ${{COMPREPLY[@]}}"
    for words, expected in (
        ("skidloc repl", "replay"),
        ("skidloc init x --contr", "--controller"),
        ("skidloc info x --robot jack", "jackal"),
    ):
        command = script.format(words, len(words.split()) - 1)
        shown = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=tmp_path, check=True)
        assert shown.stdout.strip() == expected
