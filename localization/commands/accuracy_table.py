"""The accuracy table on the terminal: a row for each model and estimator, only the columns that something is known of."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rich.console import Console
from rich.table import Table

from localization.evaluation.accuracy import Accuracy, RelationErrors
from localization.evaluation.scores import Result

_MISSING = "\u2013"  # an en dash
_Number = Callable[[Result], float | None]


def _of(name: str) -> _Number:
    return lambda result: getattr(result.accuracy, name, None)


def _relation(group: str, name: str) -> _Number:
    def number(result: Result) -> float | None:
        accuracy: Accuracy | None = result.accuracy
        errors: RelationErrors | None = getattr(accuracy.relations, group, None) if accuracy else None
        return getattr(errors, name, None)

    return number


_COLUMNS: tuple[tuple[str, str, _Number], ...] = (
    ("ATE m", ".3f", _of("ate_rmse_m")),
    ("ATE deg", ".2f", _of("ate_rmse_deg")),
    ("RPE %", ".2f", _of("rpe_translation_percent")),
    ("RPE deg/m", ".3f", _of("rpe_rotation_deg_per_m")),
    ("end m", ".2f", _of("end_error_m")),
    ("drift %", ".2f", _of("drift_percent")),
    ("relations m", ".4f", _relation("all", "translation_m")),
    ("deg", ".3f", _relation("all", "rotation_deg")),
    ("< 20 s m", ".4f", _relation("short", "translation_m")),
    ("deg", ".3f", _relation("short", "rotation_deg")),
    ("NEES", ".2f", lambda result: result.nees_mean),
    ("NIS", ".2f", lambda result: result.nis_mean),
    ("LiDAR lost %", ".2f", lambda result: 100.0 * result.run.lidar.share if result.run.lidar else None),
)


_FIRST_TO_GO = ("RPE deg/m", "speed x", "drift %", "ATE deg", "end m", "NEES", "LiDAR lost %")


def accuracy_table(results: Sequence[Result], duration_s: float, width: int) -> Table:
    """For rich's console: on one of fewer than ``width`` characters, numbers would be cut; rather, whole columns are left out."""
    columns = [column for column in (*_COLUMNS, ("speed x", ".0f", _speed(duration_s))) if any(column[2](r) is not None for r in results)]
    table = _table(results, columns)
    for title in _FIRST_TO_GO:
        if Console(width=1000).measure(table).maximum <= width:
            break
        columns = [column for column in columns if column[0] != title]
        table = _table(results, columns)
    return table


def _speed(duration_s: float) -> _Number:
    return lambda result: duration_s / result.run.seconds if result.run.seconds > 0 else None


def _table(results: Sequence[Result], columns: Sequence[tuple[str, str, _Number]]) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for title in ("model", "estimator"):
        table.add_column(title, no_wrap=True)
    for title, *_ in columns:
        table.add_column(title, justify="right", no_wrap=True)
    for result in results:
        numbers = [(number(result), form) for _, form, number in columns]
        cells = [_MISSING if number is None else format(number, form) for number, form in numbers]
        table.add_row(result.run.model, result.run.estimator, *cells)
    return table
