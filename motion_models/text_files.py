"""Text files that a user names: read with a bound, and only where they are files."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

_MOST_BYTES = 64 << 20
"""Largest size of a robot file, URDF or SRDF [B]; the largest URDFs of humanoids have 1 MB, their meshes are other files."""


def check_file(path: str | Path) -> None:
    """Raises `OSError` for what is neither a file nor a folder: to read a FIFO or a device may never end."""
    mode = os.stat(path).st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        kind = {stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}.get(stat.S_IFMT(mode), "a device")
        raise OSError(errno.EINVAL, f"it is {kind}, not a file; copy what it gives into a file first", str(path))


def read_text(path: Path) -> str:
    """The text of a file. Raises `OSError` and `UnicodeDecodeError`."""
    check_file(path)
    with path.open("rb") as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise OSError(errno.EFBIG, f"it is larger than {_MOST_BYTES >> 20} MB", str(path))
    return content.decode("utf-8")
