"""The command `skidloc`. Only here are errors turned into messages and exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from localization.commands.calibrate import Calibrate
from localization.commands.cg import Cg
from localization.commands.compare import Compare
from localization.commands.diagnose import Diagnose
from localization.commands.info import Info
from localization.commands.online import Online
from localization.commands.replay import Replay
from localization.commands.simulate import Simulate
from localization.commands.terminal import PlainConsole
from motion_models.errors import SkidlocError

_BAD_INPUT = 2
_INTERRUPTED = 130

Command = (
    Annotated[Info, tyro.conf.subcommand("info", prefix_name=False)]
    | Annotated[Replay, tyro.conf.subcommand("replay", prefix_name=False)]
    | Annotated[Compare, tyro.conf.subcommand("compare", prefix_name=False)]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate", prefix_name=False)]
    | Annotated[Diagnose, tyro.conf.subcommand("diagnose", prefix_name=False)]
    | Annotated[Cg, tyro.conf.subcommand("cg", prefix_name=False)]
    | Annotated[Online, tyro.conf.subcommand("online", prefix_name=False)]
    | Annotated[Simulate, tyro.conf.subcommand("simulate", prefix_name=False)]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 for bad input."""
    complaints = PlainConsole(stderr=True, soft_wrap=True, highlight=False)
    try:
        command = tyro.cli(
            Command,
            prog="skidloc",
            description="Probabilistic odometry for skid-steer robots whose centre of gravity moves.",
            args=arguments,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        command.run(PlainConsole(highlight=False))
    except SkidlocError as error:
        complaints.print(f"skidloc: {error}", markup=False)
        return _BAD_INPUT
    except KeyboardInterrupt:
        complaints.print("skidloc: interrupted.")
        return _INTERRUPTED
    except BrokenPipeError:  # `skidloc info LOG | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:  # what no part of the program expected of the system: names that are too long, folders without permission
        name = f"'{error.filename}': " if error.filename is not None else ""
        complaints.print(f"skidloc: {name}{error.strerror or error}.", markup=False)
        return _BAD_INPUT
    except MemoryError:
        complaints.print("skidloc: there is not enough memory for this. Use a shorter log, or smaller settings.")
        return _BAD_INPUT
    return 0


if __name__ == "__main__":
    sys.exit(main())
