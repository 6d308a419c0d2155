"""What commands share: a terminal that texts of logs cannot control, tables on it, names separated by commas, new folders, JSON."""

from __future__ import annotations

import contextlib
import json
import math
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.table import Table

from localization.errors import SettingError
from localization.messages import Message
from localization.output import output_errors, refuse_existing, write_text_file

# Control characters but for line ends and tabs, marks that turn the direction of writing, and bytes of file names that are no text.
_COMMANDS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")

WIDE = 200
"""Characters a line where the output is no terminal."""


class PlainConsole(Console):
    """A console that prints control characters, which could move the cursor, set the title or hide a line, as question marks."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Segments of ``renderable`` as by `Console.render`, without control characters."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=_COMMANDS.sub("\N{REPLACEMENT CHARACTER}", segment.text))


def print_warning(console: Console, text: str) -> None:
    """A line that is not lost among others."""
    console.print(f"[yellow]![/] {escape(text)}", soft_wrap=True)


def print_message(console: Console, found: Message) -> None:
    """A warning, or a note beside it: ``found`` has nothing to be done about it."""
    if found.is_warning:
        print_warning(console, found)
    else:
        console.print(f"- {found}", markup=False, soft_wrap=True)


def names(text: str, option: str) -> list[str]:
    """Names in ``text``, separated by commas, each once. Raises `SettingError` where there is none."""
    found = list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not found:
        raise SettingError(f"{option} is '{text}', which names nothing; it must be one name, or several separated by commas.")
    return found


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A new folder that is renamed to ``path`` at the end: it is complete, or it does not exist. Raises `OutputError`."""
    refuse_existing(path)
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=".skidloc-"))
    try:
        with output_errors(path):
            yield folder
            refuse_existing(path)
            folder.chmod(0o755)  # mkdtemp's folders are for their owner only
            folder.rename(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` as JSON, sorted as given, not finite numbers as null. Raises `OutputError` rather than overwrite."""
    write_text_file(path, json.dumps(_finite(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    return content


def plain_table(*columns: str, title: str | None = None) -> Table:
    """With its first column to the left and all others to the right; texts are no markup."""
    names = [escape(name) for name in columns]
    heading = None if title is None else escape(title)
    table = Table(*names, box=None, header_style="bold", pad_edge=False, title=heading, title_justify="left", title_style="")
    for column in table.columns[1:]:
        column.justify = "right"
    return table


def add_row(table: Table, *cells: str) -> None:
    """Add a row, its cells as plain text."""
    table.add_row(*map(escape, cells))


def print_table(console: Console, table: Table) -> None:
    """Print ``table``; where the output is no terminal, a row stays one line."""
    if console.is_terminal:
        console.print(table)
    else:
        PlainConsole(file=console.file, width=WIDE, highlight=False).print(table)


def print_line(console: Console, text: str) -> None:
    """Print one sentence without wrapping."""
    console.print(text, markup=False, soft_wrap=True)


def in_radians(sigma: tuple[float, float] | None) -> tuple[float, float] | None:
    """``--reference-sigma`` [m, deg] in SI units [m, rad]."""
    return None if sigma is None else (sigma[0], math.radians(sigma[1]))
