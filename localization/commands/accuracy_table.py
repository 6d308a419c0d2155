"""The accuracy table on the terminal: a row for each model and estimator, the columns of the report that have values."""

from __future__ import annotations

from collections.abc import Sequence

import rich.table
from rich.console import Console

from localization.evaluation.scores import Result
from localization.report.tables import COLUMNS, MISSING, Column, with_values

_FIRST_LEFT_OUT = ("RPE deg/m", "speed x", "drift %", "ATE deg", "end m", "NEES", "LiDAR lost %")
"""Titles of columns, in the order in which a narrow terminal leaves them out."""


def accuracy_table(results: Sequence[Result], duration_s: float, width: int) -> rich.table.Table:
    """For rich's console: on a terminal narrower than ``width`` characters whole columns are left out, rather than digits."""
    speed = Column("Speed", "", 0, lambda r: duration_s / r.run.seconds if r.run.seconds > 0 else None, "speed x", is_error=False)
    columns = [column for column in with_values((*COLUMNS, speed), results) if column.terminal]
    table = _table(results, columns)
    for title in _FIRST_LEFT_OUT:
        if Console(width=1000).measure(table).maximum <= width:
            break
        columns = [column for column in columns if column.terminal != title]
        table = _table(results, columns)
    return table


def _table(results: Sequence[Result], columns: Sequence[Column]) -> rich.table.Table:
    table = rich.table.Table(box=None, header_style="bold", pad_edge=False)
    for title in ("model", "estimator"):
        table.add_column(title, no_wrap=True)
    for column in columns:
        table.add_column(column.terminal, justify="right", no_wrap=True)
    for result in results:
        numbers = [(column.value(result), column.digits) for column in columns]
        cells = [MISSING if number is None else f"{number:.{digits}f}" for number, digits in numbers]
        table.add_row(result.run.model, result.run.estimator, *cells)
    return table
