"""Tables of a replay: accuracy, parameters, counts. One definition of each column serves the page and the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from localization.evaluation.scores import Result
from localization.report.page import Cell, Row, Table
from localization.report.runs import PlottedRun

MISSING = "–"  # noqa: RUF001
_MINUS = "\N{MINUS SIGN}"
_BEST, _NEAR, _LOST = "best", "as good", "LiDAR lost"
_UNITS = (
    ("_percent", "%"),
    ("_deg_per_m", "deg/m"),
    ("_rad_per_s", "rad/s"),
    ("_deg_per_s", "deg/s"),
    ("_m_per_s", "m/s"),
    ("_rad", "rad"),
    ("_deg", "deg"),
    ("_m2", "m²"),
    ("_deg2", "deg²"),
    ("_m", "m"),
    ("_s", "s"),
)


@dataclass(frozen=True)
class Column:
    """One number of each result."""

    title: str
    unit: str
    digits: int
    value: Callable[[Result], float | None]
    terminal: str = ""
    """Title on the terminal; "" where it is not shown there."""
    is_error: bool = True
    """The smaller the better."""


def _accuracy(name: str) -> Callable[[Result], float | None]:
    return lambda result: getattr(result.accuracy, name, None)


def _relations(group: str, name: str) -> Callable[[Result], float | None]:
    return lambda result: getattr(getattr(getattr(result.accuracy, "relations", None), group, None), name, None)


_GROUPS = (("all", "all relations"), ("short", "under 20 s"), ("long", "20 s and more"))
_TERMINAL_RELATIONS = {"all": ("relations m", "deg"), "short": ("< 20 s m", "deg"), "long": ("", "")}

COLUMNS = (
    Column("ATE", "m", 3, _accuracy("ate_rmse_m"), "ATE m"),
    Column("ATE heading", "deg", 2, _accuracy("ate_rmse_deg"), "ATE deg"),
    Column("RPE", "%", 2, _accuracy("rpe_translation_percent"), "RPE %"),
    Column("RPE heading", "deg/m", 3, _accuracy("rpe_rotation_deg_per_m"), "RPE deg/m"),
    Column("End error", "m", 2, _accuracy("end_error_m"), "end m"),
    Column("Drift", "%", 2, _accuracy("drift_percent"), "drift %"),
    *(
        column
        for group, which in _GROUPS
        for column in (
            Column(f"Translation, {which}", "m", 4, _relations(group, "translation_m"), _TERMINAL_RELATIONS[group][0]),
            Column("Rotation", "deg", 3, _relations(group, "rotation_deg"), _TERMINAL_RELATIONS[group][1]),
        )
    ),
    Column("NEES", "3 expected", 2, lambda result: result.nees_mean, "NEES", is_error=False),
    Column("NIS", "3 expected", 2, lambda result: result.nis_mean, "NIS", is_error=False),
    Column(
        "LiDAR lost",
        "% of the time",
        2,
        lambda result: 100.0 * result.run.lidar.share if result.run.lidar else None,
        "LiDAR lost %",
        is_error=False,
    ),
    Column("longest", "s", 1, lambda result: result.run.lidar.longest_s if result.run.lidar else None, is_error=False),
)
"""Of accuracy tables, on pages and terminals."""

_SQUARES = tuple(
    column
    for group, which in _GROUPS
    for column in (
        Column(f"Translation², {which}", "m²", 4, _relations(group, "translation_m2")),
        Column("Rotation²", "deg²", 3, _relations(group, "rotation_deg2")),
    )
)
_DRIVEN = Column("Driven", "m, by its own estimate", 1, lambda result: result.run.trajectory.distance(0.05), is_error=False)


def number(value: float | None, digits: int) -> str:
    """Fixed digits with thousands separated; an en dash for None and NaN, and never a rounded zero for a value that is not zero."""
    if value is None or math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else f"{_MINUS}∞"
    if value and abs(value) < 0.5 * 10.0**-digits:
        return f"< {10.0**-digits:.{digits}f}" if value > 0 else f"{value:.1e}"
    return f"{value:,.{digits}f}".replace("-", _MINUS)


def accuracy_tables(runs: Sequence[PlottedRun], best: PlottedRun | None, near: Sequence[PlottedRun]) -> list[Table]:
    """A row for each run; columns without any value are left out. The smallest error of a column is bold.

    ``near``: the runs practically as good as the best. A second table, of mean squares, follows for relations.
    """
    columns = with_values(COLUMNS, [run.result for run in runs])
    if not any(c.is_error for c in columns):
        columns = [_DRIVEN, *columns]
    badges = {run.number: _LOST for run in runs if run.is_lost} | {run.number: _NEAR for run in near}
    if best is not None:
        badges[best.number] = _BEST
    squares = with_values(_SQUARES, [run.result for run in runs])
    tables = [_accuracy_table(runs, columns, badges, "")]
    if squares:
        tables.append(_accuracy_table(runs, squares, {}, "Mean squares, as published for the benchmark"))
    return tables


def with_values(columns: Sequence[Column], results: Sequence[Result]) -> list[Column]:
    """Those of ``columns`` in which any of ``results`` has a value."""
    return [c for c in columns if any(c.value(result) is not None for result in results)]


def _accuracy_table(runs: Sequence[PlottedRun], columns: Sequence[Column], badges: Mapping[int, str], summary: str) -> Table:
    values = {i: [v for run in runs if (v := c.value(run.result)) is not None] for i, c in enumerate(columns) if c.is_error}
    smallest = {i: min(column, default=None) for i, column in values.items()} if len(runs) > 1 else {}
    rows = []
    for run in runs:
        model = "any: it does not use wheels" if run.model is None else run.model
        name = Cell(run.result.run.estimator, model, is_bold=True, badge=badges.get(run.number, ""), swatch=run)
        cells = [name]
        for i, column in enumerate(columns):
            value = column.value(run.result)
            bar = _bar(run, value, values[0]) if i == 0 and column.is_error else None
            cells.append(Cell(number(value, column.digits), is_bold=value is not None and value == smallest.get(i), bar=bar))
        rows.append(cells)
    return Table([Cell("Estimator", "motion model"), *(Cell(c.title, c.unit) for c in columns)], rows, summary)


def _bar(run: PlottedRun, value: float | None, values: Sequence[float]) -> tuple[float, str] | None:
    """Length of a bar, linear from zero, and its colour."""
    widest = max((v for v in values if math.isfinite(v)), default=0.0)
    if value is None or not math.isfinite(value) or widest <= 0.0:
        return None
    return value / widest, run.colour


def parameter_table(runs: Sequence[PlottedRun]) -> Table | None:
    """Mean and sigma of what was estimated besides the pose; None if nothing was."""
    cells = {run.number: {name: plus_minus(*value) for name, value in run.result.run.parameters.items()} for run in runs}
    return _by_name(runs, cells, lambda name: Cell(name, unit_of(name), is_code=True))


def count_table(runs: Sequence[PlottedRun]) -> Table | None:
    """Number of occurrences by name; None if nothing was counted."""
    cells = {run.number: {name: Cell(f"{count:,}") for name, count in run.result.run.counts.items()} for run in runs}
    return _by_name(runs, cells, lambda name: Cell(name.replace("_", " ")))


def plus_minus(mean: float, sigma: float) -> Cell:
    """``mean ± sigma`` to two digits of sigma, small numbers with a power of ten."""
    if not (math.isfinite(mean) and math.isfinite(sigma)):
        return Cell(f"{number(mean, 4)} ± {number(sigma, 4)}")
    largest = max(abs(mean), abs(sigma))
    power = math.floor(math.log10(largest)) if 0.0 < largest < 1e-3 or largest >= 1e6 else 0
    mean, sigma = mean / 10.0**power, sigma / 10.0**power
    digits = min(max(1 - math.floor(math.log10(abs(sigma))), 0), 9) if sigma else 4
    text = f"{mean:z.{digits}f} ± {sigma:.{digits}f}".replace("-", _MINUS)
    return Cell(text, power=str(power).replace("-", _MINUS)) if power else Cell(text)


def unit_of(name: str) -> str:
    """From the end of a name, as everywhere in this project; "" where it has none."""
    return next((unit for ending, unit in _UNITS if name.endswith(ending)), "")


def _by_name(runs: Sequence[PlottedRun], cells: Mapping[int, Mapping[str, Cell]], title: Callable[[str], Cell]) -> Table | None:
    names = list(dict.fromkeys(name for run in runs for name in cells[run.number]))
    shown = [run for run in runs if cells[run.number]]
    if not names:
        return None
    rows: list[Row] = [[title(name), *(cells[run.number].get(name, Cell(MISSING)) for run in shown)] for name in names]
    return Table([Cell(), *(Cell(run.label, swatch=run) for run in shown)], rows)
