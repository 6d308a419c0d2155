"""Logs and trajectories are written to places that nothing stands in, and what goes wrong there is told with the place."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from localization.errors import OutputError


def refuse_existing(path: Path) -> None:
    """Raises `OutputError` rather than overwrite."""
    if path.exists() or path.is_symlink():
        raise OutputError(f"output '{path}' exists already; nothing is overwritten. Remove it or choose another name.")


def unwritable(path: Path, error: OSError) -> OutputError:
    """What went wrong, and where."""
    return OutputError(f"output '{path}' cannot be written: {error.strerror or error}.")


@contextmanager
def output_errors(path: Path) -> Iterator[None]:
    """The system's errors inside become `OutputError`."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error) from error
