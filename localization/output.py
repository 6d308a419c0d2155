"""Logs and trajectories are written to places that nothing stands in, whole or not at all; errors name the place."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from localization.errors import OutputError

_LONGEST_NAME = 255
"""Of a file [B], on the file systems of Linux, macOS and Windows."""


def refuse_existing(path: Path) -> None:
    """Raises `OutputError` rather than overwrite."""
    if path.exists() or path.is_symlink():
        raise OutputError(f"output '{path}' exists already; nothing is overwritten. Remove it or choose another name.")


def check_outputs(*paths: Path | None) -> None:
    """Raises `OutputError` where a command could not write all of ``paths`` at its end: something is there, or no file can be made."""
    given = [path for path in paths if path is not None]
    for path in given:
        if len(os.fsencode(path.name)) > _LONGEST_NAME:
            raise OutputError(f"output '{path.name[:40]}...' has a name of more than {_LONGEST_NAME} bytes. Choose a shorter one.")
        with output_errors(path):
            refuse_existing(path)
            parent = next(parent for parent in path.absolute().parents if parent.exists())
        if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            raise OutputError(f"output '{path}' cannot be written: '{parent}' is no folder in which you may make files.")
    for i, path in enumerate(given):
        for other in given[:i]:
            one, two = path.absolute(), other.absolute()
            if one == two or one in two.parents or two in one.parents:
                raise OutputError(f"outputs '{other}' and '{path}' are one, or one lies in the other. Choose names beside each other.")


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


@contextmanager
def whole_file(path: Path, *, replace: bool = False) -> Iterator[BinaryIO]:
    """A file to write that gets its name ``path`` at the end: it is whole, or it is not there. Raises `OutputError`.

    Until then it is beside its place, under a name that nobody can foresee, newly made: no link that stands there is followed. ``replace``:
    over what is there; else that is refused.
    """
    if not replace:
        refuse_existing(path)
    with output_errors(path):
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".skidloc-")
    try:
        with output_errors(path):
            with os.fdopen(descriptor, "wb") as file:
                yield file
            if not replace:
                refuse_existing(path)
            os.chmod(name, 0o644)  # mkstemp's files are for their owner only
            os.replace(name, path)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(name)


def write_text_file(path: Path, text: str, *, replace: bool = False) -> None:
    """Write ``text`` as UTF-8, and make the folders above; bytes of file names that are none appear as escapes. Raises `OutputError`."""
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path, replace=replace) as file:
        file.write(as_text(text).encode())


def as_text(name: str) -> str:
    """A file's name with escapes for bytes that are no text, which no file of text can hold."""
    return name.encode("utf-8", errors="backslashreplace").decode()
