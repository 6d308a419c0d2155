"""Tuned constants of the files that a step of the EKF passes, by the trace over MIT-CSAIL of `tests.core.test_structure`.

python -m tests.studies.constants

A constant is a name in capitals at the top of a module with a number, or several, and a field of settings with a number: each number of
a tuple of names counts. Units, numbers of physics and labels (`_NO_TUNING`) are none. The last column is the first line of what is written
about it; a constant without is marked.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.core.test_structure import ROOT, usual_files

_NO_TUNING = {"_NS", "GRAVITY", "_SQRT2", "HIDDEN", "STILL", "MOVED"}
"""Names of units, of numbers of physics, and of labels."""
_SHAPES = {"np.zeros", "np.empty", "np.eye"}
"""Calls whose numbers are shapes."""
_NUMERIC_CALLS = {"math", "np", "max", "min", "float", "int"}


@dataclass(frozen=True)
class Constant:
    """A tuned number."""

    file: Path
    line: int
    name: str
    value: str
    text: str
    """First line of its docstring or comment, or ""."""


def constants_of(file: Path) -> Iterator[Constant]:
    """The constants of one module."""
    source = file.read_text(encoding="utf-8")
    tree = ast.parse(source)
    for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if isinstance(node, ast.Assign) and _is_number(node.value):
            for target in node.targets:
                for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                    if isinstance(name, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name.id) and name.id not in _NO_TUNING:
                        yield Constant(file, node.lineno, name.id, ast.unparse(node.value), _text(node, after, source))
        if isinstance(node, ast.ClassDef) and any("Settings" in ast.unparse(base) for base in node.bases):
            for field, below in zip(node.body, [*node.body[1:], None], strict=True):
                if isinstance(field, ast.AnnAssign) and field.value is not None and _is_number(field.value):
                    yield Constant(file, field.lineno, ast.unparse(field.target), ast.unparse(field.value), _text(field, below, source))


def _is_number(value: ast.expr) -> bool:
    """Whether ``value`` is made of numbers and functions of mathematics, and contains a number that is not 0."""
    numbers = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    names = [node.id for node in ast.walk(value) if isinstance(node, ast.Name)]
    is_numeric = all(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers)
    is_shape = isinstance(value, ast.Call) and ast.unparse(value.func) in _SHAPES
    return is_numeric and any(numbers) and not is_shape and all(name in _NUMERIC_CALLS for name in names)


def _text(node: ast.stmt, after: ast.stmt | None, source: str) -> str:
    if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
        return str(after.value.value).splitlines()[0]
    above, line = source.splitlines()[node.lineno - 2 : node.lineno]
    return line.partition("#")[2].strip() or (above[1:].strip() if above.startswith("#") else "")


def main() -> None:
    found = [constant for file in sorted(usual_files()) for constant in constants_of(file)]
    for one in found:
        print(f"{one.file.relative_to(ROOT)}:{one.line} {one.name} = {one.value} | {one.text or 'NOT EXPLAINED'}")
    print(f"{len(found)} constants in {len({one.file for one in found})} files, {sum(not one.text for one in found)} not explained")


if __name__ == "__main__":
    main()
