"""Errors that a user can mend. Each says what was found, where, and what to do; the command line turns them into exit code 2."""


class SkidlocError(Exception):
    """Base of every error of this library that is about its input, not about a bug."""


class RobotError(SkidlocError):
    """A robot file that is missing, malformed or physically impossible."""


class ModelError(SkidlocError):
    """A motion model that does not exist or was given parameters that it cannot use."""
