"""What the site makes from the code: equations as MathML, lines of code beside them, and the page of all warnings.

In a page `{code: PATH :: TEXT}` becomes the number and the text of the line of the file PATH that contains TEXT, which must be one line;
`<!-- readme: PATH -->` becomes that file, `<!-- robots -->` the rows of the shipped robots.

`python docs/hooks.py` writes `docs/warnings.md` from the tables of messages.
"""

from __future__ import annotations

import re
import tomllib
from html import escape, unescape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = Path(__file__).parents[1]
PACKAGES = ("motion_models", "localization")
CODE = re.compile(r"\{code: (?P<path>\S+) :: (?P<text>[^\n]+?)\}(?=\s|$)")
README = re.compile(r"<!-- readme: (?P<path>\S+) -->")
ROBOTS = "<!-- robots -->"
FIGURES = ROOT / "notebooks" / "figures"
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:|#)[^)]*\)")
_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
TABLES = ROOT / "localization" / "messages"
_FIELD = re.compile(r"\{[^}]*\}")
_PAGE_HEAD = """# Warnings, causes and cures

Every message states what happened, where, and what to do. Those with **!** ask for something; those without state what was chosen or left
out, and nothing has to be done. … stands for numbers and names. `metrics.json` has each message by its id, with its numbers, and so have
the diagnostics of the live node."""


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


def warnings_page() -> str:
    """All messages with their causes and cures, from the tables of `localization.messages`."""
    tables = {path.stem: tomllib.loads(path.read_text(encoding="utf-8")) for path in TABLES.glob("*.toml")}
    lines = [_PAGE_HEAD]
    for subject, table in sorted(tables.items(), key=lambda item: item[1]["title"].lower()):
        found = {name: entry for name, entry in table.items() if isinstance(entry, dict) and "text" in entry}
        lines += ["", f"## {table['title']}", ""]
        for name, entry in found.items():
            text = _FIELD.sub("…", f"{entry['text']} {entry.get('remedy', '')}".strip())
            lines.append(f"- {'**!** ' if 'remedy' in entry else ''}`{subject}.{name}`: {escape(text, quote=False)}")
        lines += ["", f"**Cause.** {table['cause']}", "", f"**Cure.** {table['cure']}"]
    return "\n".join(lines) + "\n"


def on_page_markdown(markdown: str, **_: object) -> str:
    """Lines of code, before the page is rendered."""

    def show_line(found: re.Match[str]) -> str:
        line = find_line(found["path"], found["text"])
        return f'<small class="code-line">{line.path}:{line.number} <code>{escape(line.text)}</code></small>'

    def show_readme(found: re.Match[str]) -> str:
        """The file without its links to others, which lie outside of the site."""
        return _LINK.sub(r"\1", (ROOT / found["path"]).read_text(encoding="utf-8"))

    markdown = markdown.replace("](../notebooks/figures/", "](images/")
    markdown = README.sub(show_readme, markdown).replace(ROBOTS, "\n".join(robot_rows()) if ROBOTS in markdown else "")
    return CODE.sub(show_line, markdown)


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


if __name__ == "__main__":
    (ROOT / "docs" / "warnings.md").write_text(warnings_page(), encoding="utf-8")
