"""Errors that a user can mend. Each message has what was found, where, and what to do; the command line turns them into exit code 2."""


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
