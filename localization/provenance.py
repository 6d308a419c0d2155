"""What made a result: versions of the libraries, and which log."""

from __future__ import annotations

import hashlib
import os
from importlib.metadata import version
from pathlib import Path

_LIBRARIES = ("skidloc", "numpy", "numba", "filterpy", "gtsam", "kiss-icp", "rosbags")
_END = 1 << 20


def versions() -> dict[str, str]:
    """Of this library and of those whose numbers enter results."""
    return {name: version(name) for name in _LIBRARIES}


def fingerprint(path: Path) -> str:
    """Of a log, whatever it is called: SHA-256 over sizes, and first and last MiB of its files, and over names of those in a folder.

    Reading all of a large bag would take minutes.
    """
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
        size = file.stat().st_size
        digest.update(os.fsencode(file.relative_to(path)) + f"\0{size}\0".encode())
        with file.open("rb") as data:
            digest.update(data.read(_END))
            data.seek(max(size - _END, 0))
            digest.update(data.read(_END))
    return digest.hexdigest()
