"""What a comparison's page draws in the browser: every run by any of its numbers, two combinations log by log, and the table of runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from localization.comparison.jobs import OK, Row
from localization.comparison.statistics import ComparisonFindings, by_combination, combination, measure_of
from localization.report.charts import Chart, ChartSeries
from localization.report.page import Cell, Table
from localization.report.replay_page import number, unit_of
from localization.report.runs import capitalize

_LOG_SCALE_RATIO = 8.0
"""Ratio of the largest value to the smallest from which on the axis is logarithmic, so that a failing baseline does not set the scale."""
_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down")
"""Symbols of Plotly by motion model; those of the static figures."""
_NUMBERS = (
    *("ate_rmse_m", "ate_rmse_deg", "rpe_translation_percent", "rpe_rotation_deg_per_m", "end_error_m", "drift_percent"),
    *("relations_all_translation_m", "relations_all_rotation_deg", "nees_mean", "nis_mean", "lidar_lost_share", "distance_m"),
)
"""Columns of the table that a page shows beside the metric, where a run has them."""
_DIGITS = 3
_ROW_PX, _AXIS_PX = 34, 110


def is_wide(values: Sequence[float]) -> bool:
    """Whether numbers spread so far that they need a logarithmic axis."""
    return min(values) > 0.0 and max(values) > _LOG_SCALE_RATIO * min(values)


def run_charts(found: ComparisonFindings, styles: Mapping[str, tuple[str, int]], short: Mapping[str, str]) -> list[Chart]:
    """``styles``: colour's name and number of the motion model by combination; ``short``: name of each log in a table."""
    shown = [mean.name for mean in found.means]
    charts = [_by_number(found, shown, styles, short)]
    return charts if len(shown) < 2 else [*charts, _by_pair(found, shown, short)]


def run_table(found: ComparisonFindings, short: Mapping[str, str], styles: Mapping[str, tuple[str, int]]) -> Table:
    """A row for each run, to be sorted and filtered."""
    names = _numbers(found)
    rows = []
    for row in found.rows:
        name = combination(row)
        values = [_value(row, column) for column in names]
        texts = ["" if math.isnan(value) else number(value, _DIGITS) for value in values]
        status = Cell(row["status"], badge="LiDAR lost" if row in found.lost(name) else "")
        rows.append([Cell(short[row["log"]]), Cell(found.words[name], mark=styles[name][0], is_words=True), status, *map(Cell, texts)])
    titles = [Cell(capitalize(measure_of(name)), unit_of(name)) for name in names]
    return Table([Cell("Log"), Cell("Run", is_words=True), Cell("Status"), *titles], rows, is_sortable=True)


def _by_number(found: ComparisonFindings, shown: Sequence[str], styles: Mapping[str, tuple[str, int]], short: Mapping[str, str]) -> Chart:
    names, columns, series = _numbers(found), {}, []
    for k, name in enumerate(shown):
        rows = [row for row in found.rows if combination(row) == name and row["status"] == OK]
        group = f"{k} "
        columns[f"{group}row"] = [k + 0.24 * (i % 3 - 1.0) for i in range(len(rows))]
        for column in names:
            columns[group + column] = [_value(row, column) for row in rows]
        colour, model = styles[name]
        texts = [f"{short[row['log']]}, {found.words[name]}" for row in rows]
        series.append(ChartSeries("", colour, y="row", texts=texts, symbol=_SYMBOLS[model % len(_SYMBOLS)], size=8.0, group=group))
    values = [v for table in by_combination(found.rows, found.metric).values() for v in table.values()]
    return Chart(
        "Every run",
        x=[(name, _title(name)) for name in names],
        y=[("row", "")],
        series=series,
        columns=columns,
        names=[found.words[name] for name in shown],
        height_px=_AXIS_PX + _ROW_PX * len(shown),
        x_type="log" if is_wide(values) else "linear",
        note="One mark for each log. No test was made of these numbers but of the one that was compared, above.",
    )


def _by_pair(found: ComparisonFindings, shown: Sequence[str], short: Mapping[str, str]) -> Chart:
    numbers = by_combination(found.rows, found.metric)
    logs = list(dict.fromkeys(row["log"] for row in found.rows))
    columns = {name: [numbers[name].get(log, math.nan) for log in logs] for name in shown}
    values = [v for name in shown for v in columns[name] if not math.isnan(v)]
    axes = [(name, f"{found.words[name]}: {_title(found.metric)}") for name in shown]
    return Chart(
        "Two of them, log by log",
        x=axes,
        y=[axes[1], axes[0], *axes[2:]],
        series=[ChartSeries("", "blue", texts=[short[log] for log in logs], size=9.0)],
        columns=columns,
        is_y_chosen=True,
        has_diagonal=True,
        x_type="log" if is_wide(values) else "linear",
        note="Above the dotted line the one along the bottom has the smaller error on that log.",
    )


def _numbers(found: ComparisonFindings) -> list[str]:
    """The metric first."""
    return [name for name in dict.fromkeys((found.metric, *_NUMBERS)) if any(math.isfinite(_value(row, name)) for row in found.rows)]


def _value(row: Row, name: str) -> float:
    value = row.get(name)
    return float(value) if isinstance(value, int | float) else math.nan


def _title(name: str) -> str:
    return f"{measure_of(name)} [{unit}]" if (unit := unit_of(name)) else measure_of(name)
