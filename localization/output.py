"""Output files, written whole or not at all and over nothing; versions of libraries and fingerprints of logs, as provenance of results."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO

from localization.errors import OutputError
from motion_models.input_files import open_input

_LIBRARIES = ("skidloc", "numpy", "numba", "filterpy", "gtsam", "kiss-icp", "rosbags")
_FINGERPRINT_BYTES = 1 << 20  # of the begin and of the end of each file
_MAX_NAME_BYTES = 255  # on the file systems of Linux, macOS and Windows


def refuse_existing(path: Path) -> None:
    """Raises `OutputError` rather than overwrite."""
    if path.exists() or path.is_symlink():
        raise OutputError(f"output '{path}' exists already; nothing is overwritten. Remove it or choose another name.")


def check_outputs(*paths: Path | None) -> None:
    """Raises `OutputError` where a command could not write all of ``paths`` at its end: something is there, or no file can be made."""
    given = [path for path in paths if path is not None]
    for path in given:
        if len(os.fsencode(path.name)) > _MAX_NAME_BYTES:
            raise OutputError(f"output '{path.name[:40]}...' has a name of more than {_MAX_NAME_BYTES} bytes. Choose a shorter one.")
        with output_errors(path):
            refuse_existing(path)
            parent = next(parent for parent in path.absolute().parents if parent.exists())
        try:
            tempfile.TemporaryFile(dir=parent).close()
        except OSError as error:
            raise OutputError(f"output '{path}' cannot be written: '{parent}' is not a folder in which you may create files.") from error
    for i, path in enumerate(given):
        for other in given[:i]:
            one, two = path.absolute(), other.absolute()
            if one == two or one in two.parents or two in one.parents:
                raise OutputError(f"outputs '{other}' and '{path}' are one, or one lies in the other. Choose names beside each other.")


def unwritable(path: Path, error: OSError) -> OutputError:
    """The error of an output that cannot be written: where and why."""
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
    """A file to write that is moved to ``path`` at the end: it is whole, or it does not exist. Raises `OutputError`.

    Until then it is a new file of a random name in the same folder, so that no link is followed. ``replace``: overwrite an existing file;
    else that is refused.
    """
    if not replace:
        refuse_existing(path)
    with output_errors(path):
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".skidloc-")
    try:
        with output_errors(path):
            with os.fdopen(descriptor, "wb") as file:
                yield file
            os.chmod(name, 0o644)  # mkstemp's files are for their owner only
            if replace:
                os.replace(name, path)
            else:
                _name_new_file(name, path)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(name)


def _name_new_file(name: str, path: Path) -> None:
    """Give the file ``name`` the name ``path`` in one step, so that of two writers one is refused. Raises `OutputError`."""
    try:
        os.link(name, path)
    except FileExistsError:
        refuse_existing(path)
        raise
    except OSError:  # a file system without hard links, as FAT: to look and to rename are two steps there
        refuse_existing(path)
        os.replace(name, path)


def write_text_file(path: Path, text: str, *, replace: bool = False) -> None:
    """Write ``text`` as UTF-8, and make its folders; bytes that are no text are written as escapes. Raises `OutputError`."""
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path, replace=replace) as file:
        file.write(as_text(text).encode())


def as_text(name: str) -> str:
    """A file's name with escapes in place of bytes that are no text."""
    return name.encode("utf-8", errors="backslashreplace").decode()


def versions() -> dict[str, str]:
    """Versions of this library and of those that results depend on, by name."""
    return {name: version(name) for name in _LIBRARIES}


def fingerprint(path: Path) -> str:
    """SHA-256 of a log, independent of its name: over sizes, first and last MiB of its files, and names of files in a folder.

    Reading all of a large bag would take minutes.
    """
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
        size = file.stat().st_size
        digest.update(os.fsencode(file.relative_to(path)) + f"\0{size}\0".encode())
        with open_input(file) as data:
            digest.update(data.read(_FINGERPRINT_BYTES))
            data.seek(max(size - _FINGERPRINT_BYTES, 0))
            digest.update(data.read(_FINGERPRINT_BYTES))
    return digest.hexdigest()
