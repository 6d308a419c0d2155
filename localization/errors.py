"""Errors of logs, references and outputs that a user can correct (exit code 2 on the command line)."""

from motion_models.errors import SkidlocError


class LogError(SkidlocError):
    """A log that cannot be used: it does not exist, is no bag, has no readable message, or only one."""


class TopicError(LogError):
    """A topic that is not in the log, or that carries another type of message than is needed."""


class EvaluationError(SkidlocError):
    """A reference that cannot be used: missing, malformed, or not overlapping the trajectory in time."""


class SettingError(SkidlocError):
    """An invalid setting: a number out of its range or not finite, an empty list of names."""


class EventError(SkidlocError):
    """An invalid event: an array of another shape, numbers that are not finite, a matrix that is no covariance."""


class OutputError(SkidlocError):
    """An output path that exists already, or that cannot be written."""


class EstimatorError(SkidlocError):
    """An estimator that does not exist, that needs data which the log does not hold, or whose state is no longer finite."""


class SimulationError(SkidlocError):
    """A simulation that does not exist or cannot be driven: an unknown experiment or effect, a robot that tips over or hits a wall."""


class MapError(SkidlocError):
    """A map that cannot be used: missing, foreign, newer or damaged; or one that cannot be made."""


class CheckpointError(SkidlocError):
    """A state that cannot be written, or a file of one that is damaged, foreign, or of another robot, model or configuration."""


class TransportError(SkidlocError):
    """A live source or sink that cannot be used: its library or peer is missing, or messages have another type."""
