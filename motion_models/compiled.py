"""Decorators of compiled loops. Numba compiles a kernel at its first call and stores the machine code on disk.

Numba itself is imported then: the first odometry of a node does not wait for it (`interpreted`).
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numpy as np

_Function = TypeVar("_Function", bound=Callable[..., Any])
NOT_STORED = (
    "compiled code can be stored neither beside the package nor in the home folder: each start compiles for a minute."
    " Set NUMBA_CACHE_DIR to a folder that can be written."
)


class _Thread(threading.local):
    is_interpreted = False


_thread = _Thread()


@contextmanager
def interpreted() -> Iterator[None]:
    """Inside, this thread runs what is not compiled yet as Python: for a few numbers, where neither numba nor machine code shall be waited
    for. Results are the same up to rounding."""
    before, _thread.is_interpreted = _thread.is_interpreted, True
    try:
        with np.errstate(all="ignore"):
            yield
    finally:
        _thread.is_interpreted = before


class CompiledFunction:
    """A function that is compiled at its first call, which puts the compiled one in its place in its module: later calls pass nothing else.
    Before that, it runs as Python inside `interpreted`."""

    def __init__(self, function: Callable[..., Any], compile_function: Callable[[], Any], python: Callable[..., Any]) -> None:
        """``compile_function`` gives the compiled form of ``function``, ``python`` is the interpreted one."""
        functools.update_wrapper(self, function)
        self._module, self._name = function.__globals__, function.__name__
        self._compile, self._python, self._compiled, self._lock = compile_function, python, None, threading.Lock()

    def __call__(self, *args: Any) -> Any:
        """Run it."""
        if _thread.is_interpreted:
            return self._python(*args)
        result = self.compiled(*args)
        if self._module.get(self._name) is self:
            self._module[self._name] = self._compiled
        return result

    @property
    def compiled(self) -> Any:
        """What numba makes of the function."""
        with self._lock:
            if self._compiled is None:
                self._compiled = self._compile()
        return self._compiled


def kernel(function: _Function) -> _Function:
    """A loop that Python calls, compiled once for each set of argument types. Division by zero gives inf or NaN, as in numpy."""
    return _kernel(function)


def threaded_kernel(function: _Function) -> _Function:
    """A `kernel` during which other threads of Python run: for loops of more than some milliseconds beside the estimates."""
    return _kernel(function, nogil=True)


def _kernel(function: _Function, **options: bool) -> _Function:
    def compile_function() -> Any:
        from motion_models.jit import compile_kernel

        return compile_kernel(function, **options)

    return cast(_Function, CompiledFunction(function, compile_function, function))


def gufunc(layout: str) -> Callable[[Callable[..., None]], Callable[..., Any]]:
    """A compiled function of pose-like arguments, the last of which is its result, that broadcasts over leading axes."""

    def decorate(function: Callable[..., None]) -> Callable[..., Any]:
        def compile_function() -> Any:
            from motion_models.jit_gufunc import compile_gufunc

            return compile_gufunc(function, layout)

        return CompiledFunction(function, compile_function, np.vectorize(_returning(function, layout), signature=layout))

    return decorate


def _returning(function: Callable[..., None], layout: str) -> Callable[..., Any]:
    """``function``, which fills its last argument, as one that returns it."""
    *inputs, output = [part.strip("()").split(",") for part in layout.replace("->", ",").replace("),(", ")|(").split("|")]

    def returning(*args: Any) -> Any:
        sizes = {name: n for names, array in zip(inputs, args, strict=True) for name, n in zip(names, array.shape, strict=True)}
        out = np.empty([sizes[name] for name in output])
        function(*args, out)
        return out

    return returning


subroutines: list[Callable[..., Any]] = []
"""Parts of kernels that numba has not got yet."""


def subroutine(function: _Function) -> _Function:
    """A part of kernels, compiled with them. Called from Python, it is interpreted."""
    subroutines.append(function)
    return function
