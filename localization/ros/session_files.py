"""The files of a session: which they are, that they do not get into each other's way, and that no other process has them meanwhile."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from localization.errors import OutputError
from localization.output import output_errors, refuse_existing

_SUFFIXES = (".mcap", ".tum")


@dataclass(frozen=True)
class Files:
    """What a session writes. Raises `OutputError` for an output of unknown kind, a state that is a folder, and two that are one file."""

    out: Path | None = None
    """Trajectory, .mcap or .tum, written at the end."""
    state: Path | None = None
    """Resumed at the start if it is there."""

    def __post_init__(self) -> None:
        if self.out is not None and self.out.suffix not in _SUFFIXES:
            raise OutputError(f"output '{self.out}': its name must end in {' or '.join(_SUFFIXES)}.")
        if self.state is not None and self.state.is_dir():
            raise OutputError(f"the state '{self.state}' is a folder. Name a file in it.")
        if self.out is not None and self.estimate_log is not None and self.state is not None:
            for taken, what in ((self.out, "the output"), (self.estimate_log, "where the output grows")):
                if self.state.resolve() == taken.resolve():
                    raise OutputError(f"the state '{self.state}' is {what} as well. Give the state a name of its own.")

    @property
    def estimate_log(self) -> Path | None:
        """Where the estimates are until the end."""
        return None if self.out is None else self.out.with_name(f".{self.out.name}.part")

    @contextlib.contextmanager
    def beside(self) -> Iterator[Path]:
        """Where to write what becomes the output at the end, under its name, for a bag holds that. What a process that was killed has left
        there is removed. Raises `OutputError`."""
        assert self.out is not None
        folder = self.out.with_name(f".{self.out.name}.new")
        with output_errors(self.out):
            if folder.is_symlink() or folder.is_file():
                folder.unlink()
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
        try:
            yield folder / self.out.name
            refuse_existing(self.out)
            with output_errors(self.out):
                (folder / self.out.name).replace(self.out)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    @contextlib.contextmanager
    def claimed(self) -> Iterator[None]:
        """Inside, they are this process's alone. Raises `OutputError` where they cannot be written, for an output that exists, and where
        another process has them."""
        if self.out is not None:
            refuse_existing(self.out)
        with contextlib.ExitStack() as stack:
            for path in (self.out, self.state):
                if path is not None:
                    lock = path.with_name(f".{path.name}.lock")
                    stack.enter_context(_locked(path, lock))
                    stack.callback(lock.unlink, missing_ok=True)  # while it is locked
            yield


def _locked(path: Path, lock: Path) -> TextIO:
    """The file ``lock``, which is another than ``path``, for a state is replaced again and again. The lock ends with the process, however
    that ends."""
    while True:
        try:
            file = os.fdopen(os.open(lock, os.O_CREAT | os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644), "a")
        except OSError as error:
            raise OutputError(f"'{path}' cannot be written: {error.strerror}. Name a file in a folder that is there and yours.") from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.close()
            raise OutputError(f"'{path}' is in use by another process that runs. StopSignal that, or name another file.") from error
        except OSError:
            return file  # a file system without locks is no reason not to work
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                return file
        file.close()  # whoever had it removed it meanwhile
