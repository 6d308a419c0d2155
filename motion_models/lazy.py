"""Names of a package that are imported on first use (PEP 562), so that `skidloc --help` needs no numerical library."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def exports(package: str, module_by_name: Mapping[str, str]) -> Callable[[str], Any]:
    """``__getattr__`` of ``package``: each name from its module. Raises `AttributeError` for others."""

    def get(name: str) -> Any:
        if name not in module_by_name:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(importlib.import_module(module_by_name[name]), name)

    return get
