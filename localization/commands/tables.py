"""Tables and lines on the terminal, for all commands."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from localization.evaluation.scores import Result
from localization.report.tables import COLUMNS, MISSING, Column, with_values

WIDE = 200
"""Characters a line where the output is no terminal."""
_FIRST_LEFT_OUT = ("RPE deg/m", "speed x", "drift %", "ATE deg", "end m", "NEES", "LiDAR lost %")
"""Titles of columns, in the order in which a narrow terminal leaves them out."""


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
        Console(file=console.file, width=WIDE, highlight=False).print(table)


def print_line(console: Console, text: str) -> None:
    """Print one sentence without wrapping."""
    console.print(text, markup=False, soft_wrap=True)


def accuracy_table(results: Sequence[Result], duration_s: float, width: int) -> Table:
    """For rich's console: on a terminal narrower than ``width`` characters whole columns are left out, rather than digits."""
    speed = Column("Speed", "", 0, lambda r: duration_s / r.run.seconds if r.run.seconds > 0 else None, "speed x", is_error=False)
    columns = [column for column in with_values((*COLUMNS, speed), results) if column.terminal]
    table = _accuracy_cells(results, columns)
    for title in _FIRST_LEFT_OUT:
        if Console(width=1000).measure(table).maximum <= width:
            break
        columns = [column for column in columns if column.terminal != title]
        table = _accuracy_cells(results, columns)
    return table


def _accuracy_cells(results: Sequence[Result], columns: Sequence[Column]) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for title in ("model", "estimator"):
        table.add_column(title, no_wrap=True)
    for column in columns:
        table.add_column(column.terminal, justify="right", no_wrap=True)
    for result in results:
        numbers = [(column.value(result), column.digits) for column in columns]
        cells = [MISSING if number is None else f"{number:.{digits}f}" for number, digits in numbers]
        table.add_row(result.run.model, result.run.estimator, *cells)
    return table
