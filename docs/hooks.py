"""What the site makes from the code: equations as MathML, lines of code beside them, and the texts of all warnings.

In a page `{code: PATH :: TEXT}` becomes the number and the text of the line of the file PATH that contains TEXT, which must be one line;
`<!-- messages: PATH -->` becomes the list of the warnings of that module, `<!-- readme: PATH -->` that file, `<!-- robots -->` the rows of
the shipped robots.
"""

from __future__ import annotations

import ast
import functools
import re
import tomllib
from collections.abc import Iterator
from html import escape, unescape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).parents[1]
PACKAGES = ("motion_models", "localization")
CODE = re.compile(r"\{code: (?P<path>\S+) :: (?P<text>[^\n]+?)\}(?=\s|$)")
MESSAGES = re.compile(r"<!-- messages: (?P<path>\S+) -->")
README = re.compile(r"<!-- readme: (?P<path>\S+) -->")
ROBOTS = "<!-- robots -->"
FIGURES = ROOT / "notebooks" / "figures"
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:|#)[^)]*\)")
_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_BRACES = re.compile(r"\{[^}]*\}")
_LEAST_LENGTH = 25
"""Of a text that is a sentence and not a part of one."""


class Line(NamedTuple):
    """A line of a file."""

    path: str
    number: int
    text: str


def find_line(path: str, text: str) -> Line:
    """The only line of the file ``path``, or of the packages where it was moved, that contains ``text``. Raises `ValueError` where there
    is none, or are several."""
    files = [ROOT / path] if (ROOT / path).exists() else sorted(p for name in PACKAGES for p in (ROOT / name).rglob("*.py"))
    found = [
        Line(str(file.relative_to(ROOT)), i, line.strip())
        for file in files
        for i, line in enumerate(file.read_text(encoding="utf-8").splitlines(), start=1)
        if text in line
    ]
    if len(found) != 1:
        raise ValueError(f"{path} has {len(found)} lines with '{text}': name a part of one.")
    return found[0]


@functools.cache
def messages(path: str) -> list[str]:
    """Texts of the warnings of a module, in the order of its lines; expressions in them are an ellipsis."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    found = {text: None for node in _warning_nodes(tree) for text in _texts(node) if " " in text and len(text) >= _LEAST_LENGTH}
    return list(found)


def modules_with_messages() -> list[str]:
    """Paths of all modules that warn users about their data."""
    return [str(p.relative_to(ROOT)) for p in sorted((ROOT / "localization").rglob("*.py")) if messages(str(p.relative_to(ROOT)))]


def _warning_nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Expressions that become warnings: of a `SensorFault`, of functions and variables with that word in their name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any(word in node.name for word in ("warning", "contradiction")):
            docstring = ast.get_docstring(node) is not None
            yield from node.body[docstring:]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "SensorFault":
            yield from node.args[:1]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ("append", "extend"):
            if "warning" in ast.unparse(node.func.value):
                yield from node.args
        elif isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any("warnings" in ast.unparse(target) for target in targets):
                yield node.value


def _texts(node: ast.AST) -> Iterator[str]:
    """Whole texts in an expression."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield _BRACES.sub("…", node.value)
    elif isinstance(node, ast.JoinedStr):
        yield "".join(_BRACES.sub("…", str(part.value)) if isinstance(part, ast.Constant) else "…" for part in node.values)
    else:
        for child in ast.iter_child_nodes(node):
            yield from _texts(child)


def on_page_markdown(markdown: str, **_: object) -> str:
    """Lines of code and warnings, before the page is rendered."""

    def show_line(found: re.Match[str]) -> str:
        line = find_line(found["path"], found["text"])
        return f'<small class="code-line">{line.path}:{line.number} <code>{escape(line.text)}</code></small>'

    def show_messages(found: re.Match[str]) -> str:
        return "\n".join(f"- {escape(text.strip())}" for text in messages(found["path"]))

    def show_readme(found: re.Match[str]) -> str:
        """The file without its links to others, which lie outside of the site."""
        return _LINK.sub(r"\1", (ROOT / found["path"]).read_text(encoding="utf-8"))

    markdown = markdown.replace("](../notebooks/figures/", "](images/")
    markdown = README.sub(show_readme, markdown).replace(ROBOTS, "\n".join(robot_rows()) if ROBOTS in markdown else "")
    return MESSAGES.sub(show_messages, CODE.sub(show_line, markdown))


def robot_rows() -> list[str]:
    """A row of a table for each shipped robot."""
    rows = []
    for path in sorted((ROOT / "motion_models" / "robots").glob("*.toml")):
        robot = tomllib.loads(path.read_text(encoding="utf-8"))
        g = robot["geometry"]
        lengths = f"{g['track_width_m']:.3g}, {g['wheelbase_m']:.3g}"
        rows.append(f"| {robot['name']} | {robot.get('drive', 'skid_steer')} | {lengths} | {g['mass_kg']:.3g} |")
    return rows


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The figures of the notebooks among the images of the pages."""
    from mkdocs.structure.files import File  # of the extra docs

    for path in sorted(FIGURES.glob("*.png")):
        files.append(File.generated(config, f"images/{path.name}", abs_src_path=str(path)))
    return files


def on_page_content(html: str, **_: object) -> str:
    """Equations as MathML, which browsers typeset without scripts."""
    if 'class="arithmatex"' not in html:
        return html
    from latex2mathml.converter import convert  # of the extra docs

    def typeset(found: re.Match[str]) -> str:
        return str(convert(unescape(found[3]), display="inline" if found[2] == "(" else "block"))

    return _EQUATION.sub(typeset, html)
