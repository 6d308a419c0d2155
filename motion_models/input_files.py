"""The door for input: each file that a command, a node or the library reads is opened here, with a limit of bytes.

Files of which parts are read one by one, as logs and maps, are opened by `open_input`; their readers limit what these parts hold.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

MAX_BYTES = 64 << 20
"""Largest size of a robot file, URDF, YAML file or manifest [B]; the largest URDFs of humanoids have 1 MB, their meshes are other files."""
_MAX_TABLE_BYTES, _MAX_LINES = 128 << 20, 2_000_000
"""Largest table [B], and its most lines: 1.8 hours of motion capture at 300 Hz. As Python objects they take 1.4 GB."""
_MAX_LINE_BYTES = 1 << 20
"""Longest line of a table [B]."""


def check_file(path: str | Path) -> None:
    """Raises `OSError` for what is neither a file nor a folder: to read a FIFO or a device may never end."""
    mode = os.stat(path).st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        kind = {stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}.get(stat.S_IFMT(mode), "a device")
        raise OSError(errno.EINVAL, f"it is {kind}, not a file; copy what it gives into a file first", str(path))


def open_input(path: str | Path) -> BinaryIO:
    """A file, opened to read parts of it. Raises `OSError`."""
    check_file(path)
    return open(path, "rb")


def read_bytes(path: str | Path, max_bytes: int = MAX_BYTES) -> bytes:
    """All of a file. Raises `OSError`, also for one that is larger than ``max_bytes``."""
    with open_input(path) as file:
        is_too_large = os.fstat(file.fileno()).st_size > max_bytes
        content = b"" if is_too_large else file.read(max_bytes + 1)
    if is_too_large or len(content) > max_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {max_bytes >> 20} MB", str(path))
    return content


def read_text(path: str | Path, max_bytes: int = MAX_BYTES, errors: str = "strict") -> str:
    """The text of a file. Raises `OSError` and `UnicodeDecodeError`."""
    return read_bytes(path, max_bytes).decode("utf-8", errors)


def read_table(path: str | Path) -> str:
    """The text of a file of lines, as of poses or CSV, without its mark of the byte order. Raises `OSError` and `UnicodeDecodeError`."""
    content = read_bytes(path, _MAX_TABLE_BYTES)
    lines = content.count(b"\n") + content.count(b"\r")
    if lines > _MAX_LINES:
        raise OSError(errno.EFBIG, f"it has {lines} lines, more than {_MAX_LINES}", str(path))
    if len(content) > _MAX_LINE_BYTES and max(map(len, content.splitlines()), default=0) > _MAX_LINE_BYTES:
        raise OSError(errno.EFBIG, f"it has a line of more than {_MAX_LINE_BYTES >> 20} MB", str(path))
    return content.decode("utf-8-sig")
