"""Disks that are full, for the tests of what is written."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """What a full disk is to a file: a part of what is written goes in, then nothing."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def fill_disk(monkeypatch, after: int = 0, name: str = "pwrite") -> None:
    """From the call ``after`` on, ``os.NAME`` finds no room."""
    real, calls = getattr(os, name), iter(range(10**9))

    def full_disk(*arguments):
        if next(calls) >= after:
            raise OSError(28, "No space left on device")
        return real(*arguments)

    monkeypatch.setattr(os, name, full_disk)
