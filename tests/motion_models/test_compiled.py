"""Machine code on disk is that of the present sources."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numba
import pytest

from motion_models.compiled import fingerprint

PART = """
from typing import NamedTuple
from motion_models.compiled import subroutine

class Pair(NamedTuple):
    a: float
    b: float

@subroutine
def add(pair):
    return pair.a + pair.b
"""
WHOLE = """
from motion_models.compiled import kernel
from tests.kernel_part import Pair, add

@kernel
def total(pair: Pair) -> float:
    return add(pair)

FOUND = total(Pair(1.0, 2.0))
STORED = len(total.stats.cache_hits)
"""


def _load(folder: Path, name: str, source: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    path = folder / f"{name}.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location(f"tests.{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def test_kernel_after_a_change_in_another_file_is_compiled_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A subroutine that multiplies, then a class with another name, then nothing."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    numba.config.reload_config()  # of other tests' environment
    product = PART.replace("pair.a + pair.b", "pair.a * pair.b")
    for part, found, stored in (
        (PART, 3.0, 0),
        (product, 2.0, 0),
        (product.replace("Pair", "Two") + "\nPair = Two", 2.0, 0),
        (PART, 3.0, 1),
    ):
        fingerprint.cache_clear()
        _load(tmp_path, "kernel_part", part, monkeypatch)
        whole = _load(tmp_path, "kernel_whole", WHOLE, monkeypatch)
        assert (found, stored) == (whole.FOUND, whole.STORED)
