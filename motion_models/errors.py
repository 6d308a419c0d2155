"""Errors that a user can mend. Each message has what was found, where, and what to do; the command line turns them into exit code 2."""

import difflib
from collections.abc import Sequence


class SkidlocError(Exception):
    """Base of every error of this library that is about its input, not about a bug."""


class RobotError(SkidlocError):
    """A robot file that is missing, malformed or physically impossible."""


class ModelError(SkidlocError):
    """A motion model that does not exist or was given parameters that it cannot use."""


class CalibrationError(SkidlocError):
    """Data that do not determine what is to be estimated: malformed tables, too few rows, too little motion."""


class CgError(SkidlocError):
    """A centre of gravity that cannot be computed from its input, or with which the robot would tip over."""


def no_such(kind: str, name: str, known: Sequence[str]) -> str:
    """Sentence for a ``name`` that is not among the ``known`` ones, with the nearest of them.

    >>> no_such("robot", "jackel", ["husky", "jackal"])
    "no robot 'jackel'; did you mean 'jackal'? There are husky, jackal."
    """
    near = difflib.get_close_matches(name, known, n=1)
    meant = f"did you mean '{near[0]}'? There" if near else "there"
    return f"no {kind} '{name}'; {meant} are {', '.join(known) or 'none'}."
