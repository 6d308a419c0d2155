"""Size of the code: modules and lines by folder, classes with many attributes, and private members that tests reach into.

python -m tests.studies.size [--root FOLDER]

Lines are those with code: docstrings, comments and blanks are not counted. ``--root``: another checkout, to compare with.
"""

from __future__ import annotations

import argparse
import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.core.test_structure import ROOT

_PACKAGES = ("localization", "motion_models", "skidloc")
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
_MOST_ATTRIBUTES = 10
_NAMED_TUPLE = {"_replace", "_fields", "_asdict"}
"""Public members of named tuples, in spite of their names."""


def code_lines(path: Path) -> int:
    """Lines of ``path`` with code."""
    source = path.read_text(encoding="utf-8")
    docs = {
        line
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return len({line for t in tokens if t.type not in _NO_CODE for line in range(t.start[0], t.end[0] + 1)} - docs)


def attributes(path: Path) -> Iterator[tuple[str, int]]:
    """Name and number of attributes of each class that sets them itself."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef):
            stored = (a for a in ast.walk(node) if isinstance(a, ast.Attribute) and isinstance(a.ctx, ast.Store))
            yield node.name, len({a.attr for a in stored if ast.unparse(a.value) == "self"})


def private_members(path: Path) -> int:
    """How often a test reaches into private members of what is not its own, or imports a private name."""
    nodes = [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    members = sum(
        node.attr.startswith("_") and not node.attr.startswith("__") and node.attr not in _NAMED_TUPLE
        for node in nodes
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ("self", "cls", "os")
    )
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(_PACKAGES)]
    return members + sum(alias.name.startswith("_") for node in imports for alias in node.names)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=ROOT)
    root = parser.parse_args().root.resolve()
    modules, lines = Counter[str](), Counter[str]()
    large = []
    for path in sorted(path for package in _PACKAGES for path in (root / package).rglob("*.py")):
        folder = "/".join(path.relative_to(root).parts[:-1][:2])
        modules[folder] += 1
        lines[folder] += code_lines(path)
        large += [(number, name) for name, number in attributes(path) if number > _MOST_ATTRIBUTES]
    print("| folder | modules | lines of code |\n|---|---|---|")
    for folder, number in lines.most_common():
        print(f"| `{folder}` | {modules[folder]} | {number:,} |")
    print(f"| all | {modules.total()} | {lines.total():,} |\n")
    print(f"over {_MOST_ATTRIBUTES} attributes:", ", ".join(f"{name} {number}" for number, name in sorted(large, reverse=True)))
    print("private members in tests:", sum(map(private_members, (root / "tests").rglob("*.py"))))


if __name__ == "__main__":
    main()
