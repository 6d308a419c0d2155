"""Decorators of compiled loops. Numba compiles a kernel at its first call and stores the machine code on disk.

Compilation takes seconds. A third of it goes into the wrappers for calls from Python and C that `numba.njit` adds to every function: here
only kernels have one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.extending import register_jitable

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(function: _Function) -> _Function:
    """A loop that Python calls, compiled once for each set of argument types. Division by zero gives inf or NaN, as in numpy."""
    return numba.njit(cache=True, error_model="numpy", no_cfunc_wrapper=True)(function)  # type: ignore[call-overload, no-any-return]


def threaded_kernel(function: _Function) -> _Function:
    """A `kernel` during which other threads of Python run: for loops of more than some milliseconds beside the estimates."""
    return numba.njit(cache=True, error_model="numpy", no_cfunc_wrapper=True, nogil=True)(function)  # type: ignore[call-overload, no-any-return]


def subroutine(function: _Function) -> _Function:
    """A part of kernels, compiled with them. Called from Python, it is interpreted."""
    return register_jitable(error_model="numpy", no_cfunc_wrapper=True)(function)
