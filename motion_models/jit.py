"""What numba compiles and where it stores the machine code.

Compilation takes seconds. A third of it goes into the wrappers for calls from Python and C that `numba.njit` adds to every function: here
only kernels have one.
"""

from __future__ import annotations

import functools
import hashlib
import sys
import threading
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numba
from numba.core import caching
from numba.extending import register_jitable, typeof_impl

from motion_models.compiled import NOT_STORED, CompiledFunction, subroutines

_registering = threading.Lock()
_not_stored: list[str] = []
_PACKAGES = ("motion_models", "localization", "tests")


def register_subroutines() -> None:
    """Give numba the subroutines that were defined since the last call."""
    with _registering:
        while subroutines:
            register_jitable(error_model="numpy", no_cfunc_wrapper=True)(subroutines.pop())


def compile_kernel(function: Callable[..., Any], **options: bool) -> Any:
    """Stored on disk, where numba finds a folder that can be written; else compiled at each start, which is reported once."""
    register_subroutines()
    options |= {"no_cfunc_wrapper": True}
    try:
        return numba.njit(cache=True, error_model="numpy", **options)(function)  # type: ignore[call-overload]
    except RuntimeError:
        if not _not_stored:
            print(f"skidloc: {NOT_STORED}", file=sys.stderr)
        _not_stored.append(getattr(function, "__name__", ""))
        return numba.njit(error_model="numpy", **options)(function)  # type: ignore[call-overload]


@typeof_impl.register(CompiledFunction)
def _type_of_kernel(function: CompiledFunction, context: Any) -> Any:
    """To numba, a kernel that another one calls is what it has compiled itself."""
    return numba.typeof(function.compiled)  # type: ignore[no-untyped-call]


class KernelCacheLocator(caching._CacheLocator):
    """Where numba stores machine code of this project: in its usual folder, under a name that has all sources that are compiled into it.

    Numba itself compares the kernel's own file alone: it would go on with an older subroutine or constant of another file, and ends with
    "Can't get attribute" where a class of a kernel's arguments has another name by now.
    """

    def __init__(self, usual: Any, fingerprint: str) -> None:
        self._usual, self._fingerprint, self._py_file = usual, fingerprint, usual._py_file

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> KernelCacheLocator | None:
        """Called by numba for each function that it caches; None for those of others."""
        if py_func.__module__.partition(".")[0] not in _PACKAGES:
            return None
        classes: list[Any] = [each for each in caching.CacheImpl._locator_classes if each is not cls]
        usual = (each.from_function(py_func, py_file) for each in classes)
        found = next((locator for locator in usual if locator is not None), None)
        return None if found is None else cls(found, fingerprint(py_func.__module__))

    def get_cache_path(self) -> str:
        """Folder of the usual locator."""
        return str(self._usual.get_cache_path())

    def get_source_stamp(self) -> str:
        """Nothing that the name does not have."""
        return self._fingerprint

    def get_disambiguator(self) -> str:
        """Part of the files' name."""
        return f"{self._usual.get_disambiguator()}-{self._fingerprint}"


@functools.cache
def fingerprint(name: str) -> str:
    """Hash of the source of the module ``name``, of the numbers that it has imported, and of the modules with kernels that it imports."""
    module = sys.modules[name]
    with open(module.__file__ or "", "rb") as file:
        found = hashlib.sha256(file.read())
    for key, value in list(vars(module).items()):
        other = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None) or ""
        if isinstance(value, int | float):
            found.update(f"{key}={value!r}".encode())
        elif other != name and other.partition(".")[0] in _PACKAGES and "motion_models.compiled" in _modules(sys.modules[other]):
            found.update(fingerprint(other).encode())
    return found.hexdigest()[:12]


def _modules(module: ModuleType) -> set[str]:
    """Modules from which ``module`` has names."""
    return {getattr(value, "__module__", None) or "" for value in vars(module).values()}


caching.CacheImpl._locator_classes.insert(0, KernelCacheLocator)
