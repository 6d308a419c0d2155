"""Checks of a command line before anything heavy is imported, and its completion in a shell: names of options, logs and robots."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence

from localization.commands.short_help import Option, options_of
from localization.errors import LogError, SettingError
from motion_models.errors import no_such
from motion_models.robot_names import check_robot_name, robot_names

_OF_LOGS = ("try", "info", "replay", "calibrate", "diagnose", "weigh", "twin", "init", "check")
"""Commands whose first argument is a log."""
_HELP = ("-h", "--help", "--help-all")


def check_arguments(command: str, class_name: str, given: Sequence[str]) -> None:
    """Raise `SkidlocError` for an option that ``command`` does not have or that is missing, a log that is not there, and an unknown robot.

    Values are checked by the command itself.
    """
    options = options_of(command, class_name)
    if options is None or any(text in _HELP for text in given):
        return
    if command in _OF_LOGS and given and not given[0].startswith("-"):
        _check_log(given[0])
    flags = [_flag(text) for text in given if text.startswith("--")]
    known = {name for option in options if not (option.is_positional or option.is_group) for name in (option.flag, *option.aliases)}
    groups = tuple(option.flag + "." for option in options if option.is_group)
    for flag in flags:
        if not flag.startswith(groups) and flag not in known and flag.replace("--no-", "--", 1) not in known:
            raise SettingError(f"{no_such(f'option of {command}', flag, sorted(known))} `skidloc {command} --help` describes them.")
    for option in options:
        if option.is_required and not option.is_positional and not {option.flag, *option.aliases} & {*flags}:
            raise SettingError(f"{command} needs {option.flag} {option.metavar}: {option.text}")
    for text, value in itertools.pairwise(given):
        if _flag(text) == "--robot" and "--robot" in known and "=" not in text:
            check_robot_name(value)


def _flag(text: str) -> str:
    return text.partition("=")[0].replace("_", "-")


def _check_log(path: str) -> None:
    if not path.lower().endswith(".csv") and not os.path.exists(path):
        raise LogError(f"no log '{path}': there is no such file or folder.")


def bash_completion(commands: Mapping[str, tuple[str, str]]) -> str:
    """Script for bash, and zsh by bashcompinit: commands, options, shipped robots, and files."""
    cases = []
    for name, (class_name, _) in commands.items():
        options: Sequence[Option] = options_of(name, class_name) or ()
        flags = " ".join(option.flag for option in options if not option.is_positional and not option.is_group)
        cases.append(f'    {name}) options="{flags} --help" ;;')
    return "\n".join(
        [
            "_skidloc() {",
            '  local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" options=""',
            "  if [ $COMP_CWORD -eq 1 ]; then",
            f'    COMPREPLY=($(compgen -W "{" ".join(commands)} --help --version" -- "$word")); return',
            "  fi",
            '  if [ "$before" = "--robot" ]; then',
            f'    COMPREPLY=($(compgen -W "{" ".join(robot_names())}" -- "$word") $(compgen -f -X "!*.toml" -- "$word")); return',
            "  fi",
            '  case "${COMP_WORDS[1]}" in',
            *cases,
            "  esac",
            '  case "$word" in',
            '    -*) COMPREPLY=($(compgen -W "$options" -- "$word")) ;;',
            '    *) COMPREPLY=($(compgen -f -- "$word")) ;;',
            "  esac",
            "}",
            "complete -o filenames -F _skidloc skidloc",
        ]
    )
