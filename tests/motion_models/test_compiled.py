"""Machine code on disk is that of the present sources, and kernels leave out what numba compiles for seconds."""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numba
import pytest

from motion_models.jit import fingerprint

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


_PACKAGES = [Path(__file__).parents[2] / name for name in ("localization", "motion_models")]
_COMPILED = {"kernel", "threaded_kernel", "subroutine"}
_SLOW_CALLS = {"outer", "dot", "kron", "einsum"}


def slow_to_compile(function: ast.FunctionDef) -> list[int]:
    """Lines with products of matrices by numpy, or assignments of arrays to slices, whose check of shapes numba compiles in each process:
    of 30 s of a first start, nine were theirs in four kernels."""
    lines = []
    for node in ast.walk(function):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            lines.append(node.lineno)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in _SLOW_CALLS:
            lines.append(node.lineno)
        if isinstance(node, ast.Assign) and not _is_number(node.value):
            targets = [each for target in node.targets for each in (target.elts if isinstance(target, ast.Tuple) else [target])]
            lines += [node.lineno for each in targets if isinstance(each, ast.Subscript) and isinstance(each.slice, ast.Slice)]
    return lines


def _is_number(value: ast.expr) -> bool:
    """Literals, named constants, and tuples of these."""
    if isinstance(value, ast.Tuple):
        return all(map(_is_number, value.elts))
    return isinstance(value, ast.Constant | ast.Attribute) or (isinstance(value, ast.Name) and value.id == "HIDDEN")


def test_kernels_have_no_products_of_matrices_and_no_slices_of_arrays() -> None:
    count, found = 0, []
    for path in (path for package in _PACKAGES for path in package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any(isinstance(d, ast.Name) and d.id in _COMPILED for d in node.decorator_list):
                count += 1
                found += [f"{path.name}:{line}" for line in slow_to_compile(node)]
    assert count > 100
    assert not found


def test_product_and_slice_of_an_array_are_found() -> None:
    source = "def f(a, b, c):\n    a[:] = 0.0\n    a[:] = b\n    b[0] = a @ c\n    c[1:], a[0] = 0.0, np.outer(a, b)\n"
    function = ast.parse(source).body[0]
    assert isinstance(function, ast.FunctionDef)
    assert sorted(set(slow_to_compile(function))) == [3, 4, 5]
