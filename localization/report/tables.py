"""The report's tables as HTML: accuracy, parameters, counts. Every text from outside is escaped here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from localization.evaluation.scores import Result
from localization.report.runs import Line

MISSING = "–"  # noqa: RUF001
_MINUS = "\N{MINUS SIGN}"
_BEST = ' <span class="badge">best</span>'
_LOST = ' <span class="badge soft">LiDAR lost</span>'
_NEAR = ' <span class="badge soft">as good</span>'
REFERENCE_SWATCH = '<svg class="swatch" viewBox="0 0 30 8" aria-hidden="true"><path d="M1 4H29" stroke="var(--ink)"/></svg>'
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
    title: str
    unit: str
    digits: int
    value: Callable[[Result], float | None]
    is_error: bool = True
    """The smaller the better."""


def _accuracy(name: str) -> Callable[[Result], float | None]:
    return lambda result: getattr(result.accuracy, name, None)


def _relations(group: str, name: str) -> Callable[[Result], float | None]:
    return lambda result: getattr(getattr(getattr(result.accuracy, "relations", None), group, None), name, None)


_TRACK = (
    Column("ATE", "m", 3, _accuracy("ate_rmse_m")),
    Column("ATE heading", "deg", 2, _accuracy("ate_rmse_deg")),
    Column("RPE", "%", 2, _accuracy("rpe_translation_percent")),
    Column("RPE heading", "deg/m", 3, _accuracy("rpe_rotation_deg_per_m")),
    Column("End error", "m", 2, _accuracy("end_error_m")),
    Column("Drift", "%", 2, _accuracy("drift_percent")),
)
_GROUPS = (("all", "all relations"), ("short", "under 20 s"), ("long", "20 s and more"))
_RELATIONS = tuple(
    column
    for group, which in _GROUPS
    for column in (
        Column(f"Translation, {which}", "m", 4, _relations(group, "translation_m")),
        Column("Rotation", "deg", 3, _relations(group, "rotation_deg")),
    )
)
_SQUARES = tuple(
    column
    for group, which in _GROUPS
    for column in (
        Column(f"Translation², {which}", "m²", 4, _relations(group, "translation_m2")),
        Column("Rotation²", "deg²", 3, _relations(group, "rotation_deg2")),
    )
)
_CONSISTENCY = (
    Column("NEES", "3 expected", 2, lambda result: result.nees_mean, is_error=False),
    Column("NIS", "3 expected", 2, lambda result: result.nis_mean, is_error=False),
)
_LOSSES = (
    Column("LiDAR lost", "% of the time", 2, lambda result: 100.0 * result.run.lidar.share if result.run.lidar else None, is_error=False),
    Column("longest", "s", 1, lambda result: result.run.lidar.longest_s if result.run.lidar else None, is_error=False),
)
_DRIVEN = Column("Driven", "m, by its own estimate", 1, lambda result: result.run.trajectory.distance(0.05), is_error=False)


def number(value: float | None, digits: int) -> str:
    """Fixed digits with thousands parted; an en dash for what is not known, and never a rounded zero for what is not zero."""
    if value is None or math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else f"{_MINUS}∞"
    if value and abs(value) < 0.5 * 10.0**-digits:
        return f"&lt; {10.0**-digits:.{digits}f}" if value > 0 else f"{value:.1e}"
    return f"{value:,.{digits}f}".replace("-", _MINUS)


def accuracy_table(lines: Sequence[Line], best: Line | None, near: Sequence[Line]) -> str:
    """A row for each line; columns that nothing is known of are left out. The smallest error of a column is bold.

    ``near``: the runs practically as good as the best.
    """
    columns = _known([*_TRACK, *_RELATIONS, *_CONSISTENCY, *_LOSSES], lines)
    if not any(c.is_error for c in columns):
        columns = [_DRIVEN, *columns]
    badges = {line.number: _LOST for line in lines if line.is_lost} | {line.number: _NEAR for line in near}
    if best is not None:
        badges[best.number] = _BEST
    errors = _rows(lines, columns, badges)
    squares = _known(_SQUARES, lines)
    more = (
        f"<details><summary>Mean squares, as published for the benchmark</summary>{_rows(lines, squares, {})}</details>" if squares else ""
    )
    return errors + more


def _known(columns: Sequence[Column], lines: Sequence[Line]) -> list[Column]:
    return [c for c in columns if any(c.value(line.result) is not None for line in lines)]


def _rows(lines: Sequence[Line], columns: Sequence[Column], badges: Mapping[int, str]) -> str:
    known = {i: [v for line in lines if (v := c.value(line.result)) is not None] for i, c in enumerate(columns) if c.is_error}
    smallest = {i: min(values, default=None) for i, values in known.items()} if len(lines) > 1 else {}
    rows = []
    for line in lines:
        cells = []
        for i, column in enumerate(columns):
            value = column.value(line.result)
            text = number(value, column.digits)
            if value is not None and value == smallest.get(i):
                text = f"<b>{text}</b>"
            cells.append(text + (_bar(line, value, known[0]) if i == 0 and column.is_error else ""))
        model = "any: it asks no wheels" if line.model is None else escape(line.model)
        title = f'<span class="name">{swatch(line)}<b>{escape(line.result.run.estimator)}</b></span>'
        name = f"{title}{badges.get(line.number, '')}<br><small>{model}</small>"
        rows.append(row(name, *cells))
    heads = [f"{c.title}<br><small>{c.unit}</small>" for c in columns]
    return table(header("Estimator<br><small>motion model</small>", *heads), rows)


def _bar(line: Line, value: float | None, values: Sequence[float]) -> str:
    """The first column as lengths, linear from zero."""
    widest = max((v for v in values if math.isfinite(v)), default=0.0)
    if value is None or not math.isfinite(value) or widest <= 0.0:
        return ""
    return f'<span class="bar" style="width:{100.0 * value / widest:.1f}%;background:var(--{line.colour})"></span>'


def parameter_table(lines: Sequence[Line]) -> str:
    """Mean and sigma of what was estimated besides the pose; "" if nothing was."""
    cells = {line.number: {name: plus_minus(*value) for name, value in line.result.run.parameters.items()} for line in lines}
    return _by_name(lines, cells, unit_of)


def count_table(lines: Sequence[Line]) -> str:
    """How often what happened; "" if nothing was counted."""
    cells = {line.number: {name: f"{count:,}" for name, count in line.result.run.counts.items()} for line in lines}
    return _by_name(lines, cells, None)


def plus_minus(mean: float, sigma: float) -> str:
    """``mean ± sigma`` to two digits of sigma, small numbers with a power of ten."""
    if not (math.isfinite(mean) and math.isfinite(sigma)):
        return f"{number(mean, 4)} ± {number(sigma, 4)}"
    largest = max(abs(mean), abs(sigma))
    power = math.floor(math.log10(largest)) if 0.0 < largest < 1e-3 or largest >= 1e6 else 0
    mean, sigma = mean / 10.0**power, sigma / 10.0**power
    digits = min(max(1 - math.floor(math.log10(abs(sigma))), 0), 9) if sigma else 4
    text = f"{mean:z.{digits}f} ± {sigma:.{digits}f}".replace("-", _MINUS)
    return f"({text}) · 10<sup>{str(power).replace('-', _MINUS)}</sup>" if power else text


def unit_of(name: str) -> str:
    """From the end of a name, as everywhere in this project; "" where it has none."""
    return next((unit for ending, unit in _UNITS if name.endswith(ending)), "")


def definition_table(entries: Mapping[str, str]) -> str:
    return "<dl>" + "".join(f"<dt>{escape(str(key))}</dt><dd>{escape(str(value))}</dd>" for key, value in entries.items()) + "</dl>"


def swatch(line: Line) -> str:
    """A piece of the line as it is drawn."""
    dashes = f' stroke-dasharray="{" ".join(f"{1.8 * d:g}" for d in line.dashes)}"' if line.dashes else ""
    return (
        '<svg class="swatch" viewBox="0 0 30 8" aria-hidden="true">'
        f'<path d="M1 4H29" fill="none" stroke="var(--{line.colour})" stroke-width="2.4"{dashes}/></svg>'
    )


def _by_name(lines: Sequence[Line], cells: Mapping[int, Mapping[str, str]], unit: Callable[[str], str] | None) -> str:
    names = list(dict.fromkeys(name for line in lines for name in cells[line.number]))
    shown = [line for line in lines if cells[line.number]]
    if not names:
        return ""
    heads = header(*(swatch(line) + escape(line.label) for line in shown))
    rows = []
    for name in names:
        unit_text = unit(name) if unit else ""
        title = (
            f"<code>{escape(name).replace('_', '_<wbr>')}</code><br><small>{unit_text}</small>" if unit else escape(name.replace("_", " "))
        )
        rows.append(row(title, *(cells[line.number].get(name, MISSING) for line in shown)))
    return table(f"<td></td>{heads}", rows)


def header(*cells: str) -> str:
    """A table's first row, of HTML."""
    return "".join(f'<th scope="col">{cell}</th>' for cell in cells)


def row(first: str, *cells: str) -> str:
    """A row of HTML, the first cell its title."""
    return f'<tr><th scope="row">{first}</th>' + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def table(head: str, rows: Sequence[str]) -> str:
    """Of a `header` and rows (`row`)."""
    body = "\n".join(rows)
    return f'<div class="scroll" tabindex="0"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'
