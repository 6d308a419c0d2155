"""The command `skidloc`. Only here are errors turned into messages and exit codes. A command's module is imported when it is run."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import importlib
import io
import os
import sys
import tempfile
import traceback
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from localization.blas_threads import use_one_blas_thread
from localization.commands.arguments import bash_completion, check_arguments
from localization.commands.common import PlainConsole
from localization.commands.short_help import short_help
from motion_models.errors import SkidlocError, no_such

if TYPE_CHECKING:
    from rich.console import Console

    from localization.ros.early_odometry import EarlyOdometry

_BAD_INPUT = 2
_DEFECT = 70
"""EX_SOFTWARE of BSD's sysexits.h."""
_INTERRUPTED = 130

COMMANDS: Mapping[str, tuple[str, str]] = {
    "try": ("Try", "Run info, init, check, calibrate, replay and diagnose on a log, and write one page."),
    "info": ("Info", "List the topics of a log and what each is used for."),
    "replay": ("Replay", "Run motion models and estimators over a log and score their trajectories."),
    "compare": ("Compare", "Compare motion models and estimators over many logs."),
    "table": (
        "TableCommand",
        "Show k, centres of rotation and gravity, and faults by robot, floor and day, with an alarm where k changed.",
    ),
    "calibrate": ("Calibrate", "Fit a motion model to logs or tables and write the robot file."),
    "diagnose": ("Diagnose", "Find what a motion model gets wrong on a log, its cause, and the gain of correcting it."),
    "twin": ("Twin", "Find what a simulator of the robot (MuJoCo, Gazebo) gets wrong on a log, and mend it."),
    "weigh": ("Weigh", "Estimate the centre of gravity and an unknown load from how the robot turns."),
    "init": ("Init", "Write a robot file for a new robot from a log and a URDF."),
    "check": ("Check", "Check signs, units, clocks and mounts of a robot file against a minute of driving."),
    "robots": ("Robots", "List the shipped robots, with the source of every number."),
    "cg": ("Cg", "Compute the centre of gravity from scales, arms and payload."),
    "map": ("Map", "Print, view or export a saved map, or merge two."),
    "online": ("OnlineCommand", "Run the estimator live on ROS topics, or on a log as it was recorded."),
    "warm-up": ("WarmUpCommand", "Compile once what later starts load."),
    "simulate": ("Simulate", "Simulate a skid-steer robot and write a log."),
}
"""By name: the class in `localization.commands.NAME`, and one line for the overview."""


def module_of(command: str) -> str:
    """Name of a command's module in `localization.commands`."""
    return command.replace("-", "_")


USAGE = "usage: skidloc COMMAND [OPTIONS]"


def overview() -> str:
    """The text of ``skidloc --help``."""
    lines = [f"  {name:10} {summary}" for name, (_, summary) in COMMANDS.items()]
    return "\n".join(
        [
            USAGE,
            "",
            "Probabilistic odometry and localization for skid-steer robots whose centre of gravity moves.",
            "",
            "commands:",
            *lines,
            "",
            "`skidloc COMMAND --help` describes the options of a command, `--help-all` all of its settings as well.",
            "`source <(skidloc --completion)` completes commands, options and robots in bash.",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 for bad input, 70 for a defect of skidloc."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    use_one_blas_thread()
    _prepare_streams()
    errors = PlainConsole(stderr=True, soft_wrap=True, highlight=False)
    try:
        if given and given[0] in ("-h", "--help"):
            print(overview())
        elif given == ["--version"]:
            from importlib.metadata import version

            print(f"skidloc {version('skidloc')}")
        elif given == ["--completion"]:
            print(bash_completion(COMMANDS))
        elif not given or given[0] not in COMMANDS:
            errors.print(f"skidloc: {_unknown(given)}", markup=False)
            return _BAD_INPUT
        else:
            _run(given[0], given[1:])
        sys.stdout.flush()  # here: what fails at the end of the interpreter has no message
    except SkidlocError as error:
        errors.print(f"skidloc: {error}", markup=False)
        return _BAD_INPUT
    except KeyboardInterrupt:
        errors.print("skidloc: interrupted.")
        return _INTERRUPTED
    except BrokenPipeError:  # `skidloc info LOG | head`
        _discard_output()
    except OSError as error:  # errors of the system that no command handles: names that are too long, folders without permission
        name = f"'{error.filename}': " if error.filename is not None else ""
        errors.print(f"skidloc: {name}{error.strerror or error}.", markup=False)
        _discard_output()
        return _BAD_INPUT
    except MemoryError:
        errors.print("skidloc: there is not enough memory for this. Use a shorter log, or smaller settings.")
        return _BAD_INPUT
    except Exception:  # whatever is left is no user's fault
        errors.print(f"skidloc: a defect of skidloc, please report. {_write_trace(given)}", markup=False)
        return _DEFECT
    return 0


def _prepare_streams() -> None:
    """Make output and errors writable whatever the locale's encoding is, and where the caller has closed them."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (as long as the process)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _discard_output() -> None:
    """Send what is left in the buffer nowhere: the interpreter would try to write it again, and fail, at its end."""
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        return
    with contextlib.suppress(OSError, ValueError):  # a stream without a descriptor
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _write_trace(arguments: Sequence[str]) -> str:
    """Write the trace of the present exception to a new file; where it is, or the trace itself where no file can be written."""
    text = f"skidloc {' '.join(arguments)}\n\n{traceback.format_exc()}"
    try:
        descriptor, name = tempfile.mkstemp(prefix="skidloc-", suffix=".txt")
        with os.fdopen(descriptor, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
    except OSError:
        return f"Add this to the report:\n{text}"
    return f"Add to the report what is in {name}: command and trace."


def _unknown(given: Sequence[str]) -> str:
    """What is wrong with a first argument that names no command."""
    if not given:
        return f"a command is missing: {', '.join(COMMANDS)}. `skidloc --help` describes them."
    return no_such("command", given[0], [*COMMANDS])


def _run(name: str, options: Sequence[str]) -> None:
    text = short_help(name, COMMANDS[name][0]) if list(options) in (["-h"], ["--help"]) else None
    if text is not None:
        print(text)
        return
    check_arguments(name, COMMANDS[name][0], options)
    console = PlainConsole(highlight=False)
    with contextlib.ExitStack() as running:
        with _paused_garbage_collection():
            early = running.enter_context(_begin_early(name, options, console))
            command = parse(name, options)
        command.run(console, *early)


@contextlib.contextmanager
def _paused_garbage_collection() -> Iterator[None]:
    """Inside, packages are imported: all that they make stays, and to search it again and again takes a tenth of the time."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextlib.contextmanager
def _begin_early(name: str, options: Sequence[str], console: Console) -> Iterator[Collection[EarlyOdometry]]:
    """Inside, `online` publishes odometry by wheels, for its other packages take seconds to import; not with settings of the estimator."""
    if name != "online" or any(option == "--help-all" or option.startswith("--config.") for option in options):
        yield ()
        return
    from localization.commands.online_options import EarlyOptions

    with _parse_as(EarlyOptions, name, options).begin(console) as early:
        yield () if early is None else (early,)


def parse(name: str, options: Sequence[str]) -> Any:
    """The command ``name`` with its ``options``, to be run. Raises `SystemExit` (2) for what it does not have."""
    return _parse_as(getattr(importlib.import_module(f"localization.commands.{module_of(name)}"), COMMANDS[name][0]), name, options)


def _parse_as(command: Any, name: str, options: Sequence[str]) -> Any:
    """A ``command`` of the command line ``name`` with its ``options``."""
    import tyro

    options = _expand(options, set(_three_state_options(command)))
    try:
        return tyro.cli(command, prog=f"skidloc {name}", args=options, config=(tyro.conf.FlagCreatePairsOff,))
    except SystemExit as end:
        if end.code and any(option.startswith(("--topic.", "--config.")) for option in options):
            print(f"`skidloc {name} --help-all` lists --topic.* and --config.*.", file=sys.stderr)
        raise


def _expand(options: Sequence[str], three_state: Collection[str]) -> list[str]:
    """``options`` as tyro takes them: ``--a.b`` and ``--a.no-b`` of the ``three_state`` options become names with a value."""
    found: list[str] = []
    for option, following in zip(options, [*options[1:], ""], strict=False):  # one more where there is none
        on = ".".join(part.removeprefix("no-") for part in option.split("."))
        if on in three_state and following not in ("True", "False", "None"):
            found += [on, str(on == option)]
        else:
            found.append("--help" if option == "--help-all" else option)
    return found


def _three_state_options(kind: Any, prefix: str = "--") -> Iterator[str]:
    """Options of the dataclass ``kind`` that are on, off, or not given: its fields of type ``bool | None``, and those of its fields."""
    for name, hint in typing.get_type_hints(kind).items():
        option = prefix + name.replace("_", "-")
        if hint == bool | None:
            yield option
        elif dataclasses.is_dataclass(hint):
            yield from _three_state_options(hint, option + ".")


if __name__ == "__main__":
    sys.exit(main())
