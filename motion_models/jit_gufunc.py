"""Generalised ufuncs of numba: compiled functions that numpy broadcasts over leading axes, stored on disk by one process at a time."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import numba

from motion_models.jit import register_subroutines


def compile_gufunc(function: Callable[..., None], layout: str) -> Any:
    """The ufunc of ``function`` for `motion_models.compiled.gufunc`."""
    register_subroutines()
    parts = [part.strip("()") for part in layout.replace("->", ",").replace("),(", ")|(").split("|")]
    signature = "void(" + ", ".join("float64" + "[:" + ",:" * part.count(",") + "]" for part in parts) + ")"
    with _cache_lock() as is_locked:
        decorate: Callable[..., Any] = numba.guvectorize([signature], layout, nopython=True, cache=is_locked)  # type: ignore[no-untyped-call]
        return decorate(function).ufunc  # numpy's own object: without numba's Python wrapper around each call


_MAX_LOCK_WAIT_S = 5.0
"""A function is compiled in 0.1 to 1 s: who holds the lock longer is stopped, and may be for ever."""
_LOCK_POLL_S = 0.02


@contextlib.contextmanager
def _cache_lock() -> Iterator[bool]:
    """Whether numba's cache may be used inside: one process at a time has it.

    Numba caches a gufunc in two files that name each other. Two processes that compile it at the same time leave one file of each, and
    whoever loads these crashes. Where the lock is not to be had in time, a process compiles for itself.
    """
    global _MAX_LOCK_WAIT_S
    descriptor = _open_lock()
    if descriptor is None:  # without a place for the lock there is none for the cache
        yield True
        return
    try:
        is_locked = _lock(descriptor, _MAX_LOCK_WAIT_S)
        if not is_locked:
            _MAX_LOCK_WAIT_S = 0.0  # a dozen functions do not wait one after another
        yield is_locked
    finally:
        os.close(descriptor)


def _open_lock() -> int | None:
    """The lock file, in the first of the folders of numba's cache that is writable; others cannot put files there."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    usual = [os.path.join(os.path.dirname(__file__), "__pycache__"), os.path.expanduser("~/.cache/numba")]
    for folder in [chosen] if chosen else usual:
        with contextlib.suppress(OSError):
            os.makedirs(folder, exist_ok=True)
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
            return os.open(os.path.join(folder, ".skidloc.lock"), flags, 0o666)
    return None


def _lock(descriptor: int, wait_s: float) -> bool:
    """Whether it could be locked within ``wait_s`` [s]. A file system without locks counts as locked."""
    end = time.monotonic() + wait_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end:
                return False
            time.sleep(_LOCK_POLL_S)
        except OSError:
            return True
        else:
            return True
