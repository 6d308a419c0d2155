"""Report of a comparison over many logs: summary, figures, means, tests, every log, failures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from localization.comparison.comparison_charts import is_wide, run_charts, run_table
from localization.comparison.statistics import (
    ComparisonFindings,
    Difference,
    Mean,
    against_best,
    by_combination,
    closing,
    combination,
    leading,
    p_words,
    percent,
)
from localization.errors import OutputError
from localization.output import write_text_file
from localization.report import page as html
from localization.report.figures import Axes, plain_logs, svg
from localization.report.figures import Figure as Canvas
from localization.report.replay_page import MISSING, number
from localization.report.runs import capitalize, estimator_colours
from motion_models.input_files import read_bytes

_MARKERS = "osD^v"  # of matplotlib, by motion model
_ROW_HEIGHT_IN = 0.42
_TITLE = "Comparison over"
_BEST, _EQUAL, _LOST = "best", "not significant", "LiDAR lost"
_TERMS = {
    "Mean": "Over logs, each of which counts once: errors within a log are correlated, logs are not. In brackets the interval that holds "
    "the mean of other such logs in 95 of 100 cases, by bootstrap over logs.",
    "Smaller by": "By what part of the other's mean the best one's is smaller, on the logs that both have. In brackets all parts that the "
    "test of p does not exclude, at 95 % for all pairs together: 0 is among them where the difference is not significant. No brackets: so "
    "few logs exclude nothing. Logs differ far more than combinations do on one log: this interval is of the pairs and can be narrow where "
    "those of the means overlap.",
    "p": "Probability of so large a difference if neither were better: signs of the differences are flipped log by log. Corrected for all "
    "pairs of the table after Holm. Below 0.05 a difference is called shown.",
}


@dataclass(frozen=True)
class CompareHead:
    """Provenance of a report."""

    robot: str
    reference: str
    table: str
    """Name of the table with all numbers."""
    versions: Mapping[str, str]
    notes: Sequence[str] = ()
    """On the robot, in sentences."""


def write_comparison_report(path: Path, head: CompareHead, found: ComparisonFindings, is_interactive: bool = True) -> None:
    """Write the page, over the report of an earlier state of the same table, but over nothing else. Raises `OutputError`."""
    check_report(path)
    write_text_file(path, comparison_page(head, found, is_interactive), replace=True)


def check_report(path: Path) -> None:
    """Raises `OutputError` where a report would overwrite something else."""
    try:
        if path.exists() and f"<title>{_TITLE}".encode() not in read_bytes(path)[:1000]:
            raise OutputError(f"'{path}' exists already and is not a report of a comparison. Choose another --out, or remove it.")
    except OSError as error:
        raise OutputError(f"'{path}' cannot be read: {error.strerror}.") from error


def comparison_page(head: CompareHead, found: ComparisonFindings, is_interactive: bool = True) -> str:
    """HTML of the whole page; ``found`` has means. Unless it ``is_interactive``, without scripts."""
    n = len(_logs(found))
    title = f"{_TITLE} {n} log{'s' * (n != 1)}"
    styles = _styles(found)
    facts = f"{head.robot} · {found.metric} · {len(found.words)} combinations of motion model and estimator"
    sections = [
        html.Section("Means over logs", [_means_figure(found, styles)]),
        html.Section("The best against the others", [*_gains_figure(found, styles), *_tests(found, styles)]),
        html.Section("Every run", [run_table(found, _names(found), styles), *run_charts(found, styles, _names(found))]),
        html.Section("Every log", _by_log(found, styles)),
        html.Section("Failures", _failures(found)),
        html.Section("Problems of logs that did not fail", _problems(found)),
        html.glossary(_TERMS),
        html.Section("Sources and versions", [html.Definitions(_provenance(head, found))]),
    ]
    sentences = [_unbroken(sentence) for sentence in (*leading(found), *closing(found), *head.notes)]
    page = html.Page(title, facts, sentences, sections)
    return html.render(page if is_interactive else page.without_scripts())


def _unbroken(sentence: str) -> str:
    """Numbers stay with their signs at the ends of lines."""
    return sentence.replace(" %", "\N{NO-BREAK SPACE}%").replace("p = ", "p\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}")


def _means_figure(found: ComparisonFindings, styles: Mapping[str, tuple[str, int]]) -> html.Figure:
    caption = "Large: mean over logs, the line its 95 % interval. Small: each log. Colours are estimators, shapes are motion models."
    return html.Figure(_means_svg(found, styles), f"Mean {found.measure} by combination", caption)


def _gains_figure(found: ComparisonFindings, styles: Mapping[str, tuple[str, int]]) -> list[html.Block]:
    differences = [(mean, found.against_best(mean.name)) for mean in found.means[1:]]
    others: list[Mean] = [mean for mean, d in differences if d is not None and not math.isnan(d.relative)]
    if not others:
        return []
    caption = (
        "Lines are 95 % intervals of all pairs together; where one reaches 0, these logs do not show that the best is better. A hollow "
        "mark without a line: so few logs cannot show it, whatever they are."
    )
    return [html.Figure(_gains_svg(found, others, styles), f"By how much the {found.measure} of the best is smaller", caption)]


def _tests(found: ComparisonFindings, styles: Mapping[str, tuple[str, int]]) -> list[html.Block]:
    digits = _digits(found)
    rows = []
    for mean in found.means:
        d = None if mean is found.best else found.against_best(mean.name)
        interval = f"{number(mean.low, digits)} to {number(mean.high, digits)}" if mean.n > 1 else ""
        badge = _LOST if found.lost(mean.name) else _BEST if mean is found.best else _EQUAL if d is None or not found.is_shown(d) else ""
        cells = (MISSING,) * 3 if d is None else _cells(d, found)
        rows.append(
            [
                _name(mean.name, found, styles, badge),
                html.Cell(number(mean.mean, digits), interval),
                html.Cell(str(mean.n)),
                *map(html.Cell, cells),
            ]
        )
    header = [
        html.Cell("Estimator", "motion model"),
        html.Cell("Mean", f"{found.unit or found.metric}, 95 %"),
        html.Cell("Logs"),
        html.Cell("Best is smaller by", "95 %"),
        html.Cell("on"),
        html.Cell("p"),
    ]
    sentences = html.bullets([against_best(mean, found) for mean in found.means[1:]], "The same in words")
    return [html.Table(header, rows), *sentences, *_all_pairs(found)]


def _cells(d: Difference, found: ComparisonFindings) -> tuple[str, str, str]:
    reverse = "" if d.better == found.best.name else "the other: "
    return f"{reverse}{percent(d, found.unit)}", f"{d.wins} of {d.n}", p_words(d.p_value)


def _all_pairs(found: ComparisonFindings) -> list[html.Block]:
    if len(found.means) < 3:
        return []
    rows = [
        [
            html.Cell(f"{capitalize(found.words[d.better])} before {found.words[d.worse]}"),
            html.Cell(percent(d, found.unit)),
            html.Cell(f"{d.wins} of {d.n}"),
            html.Cell(p_words(d.p_value)),
        ]
        for d in found.tested
    ]
    return [html.Table([html.Cell(title) for title in ("Pair", "Smaller by", "on", "p")], rows, "All pairs")]


def _by_log(found: ComparisonFindings, styles: Mapping[str, tuple[str, int]]) -> list[html.Block]:
    numbers = by_combination(found.rows, found.metric)
    shown = [mean.name for mean in found.means]
    failed = {(r["log"], combination(r)) for r in found.failed}
    digits, rows = _digits(found), []
    for log in _logs(found):
        values = [numbers[name].get(log) for name in shown]
        least = min((value for value in values if value is not None), default=None)
        cells = [html.Cell(_short(log, found))]
        for name, value in zip(shown, values, strict=True):
            text = ("failed" if (log, name) in failed else MISSING) if value is None else number(value, digits)
            cells.append(html.Cell(text, is_bold=value is not None and value == least and len(shown) > 1))
        rows.append(cells)
    unit = f" [{found.unit}]" if found.unit else ""
    header = [html.Cell("Log"), *(_name(name, found, styles) for name in shown)]
    return [html.Table(header, rows), html.Paragraph(f"{found.measure}{unit}. Bold: the smallest on its log.", is_small=True)]


def _failures(found: ComparisonFindings) -> list[html.Block]:
    reasons: dict[tuple[str, str], list[str]] = {}
    for r in found.failed:
        reasons.setdefault((r["log"], r["error"]), []).append(found.words[combination(r)])
    items = []
    for (log, reason), names in reasons.items():
        which = "everything" if len(names) == len(found.words) else ", ".join(names)
        items.append(html.ListItem(reason, f"{_short(log, found)} ({which})"))
    return [html.Bullets(items)] if items else []


def _problems(found: ComparisonFindings) -> list[html.Block]:
    notes = {r["log"]: r["notes"] for r in found.rows if r.get("notes")}
    return [html.Bullets([html.ListItem(note, _short(log, found)) for log, note in notes.items()])] if notes else []


def _name(name: str, found: ComparisonFindings, styles: Mapping[str, tuple[str, int]], badge: str = "") -> html.Cell:
    estimator, _, model = found.words[name].partition(" with ")
    return html.Cell(estimator, model, is_bold=True, badge=badge, mark=styles[name][0])


def _digits(found: ComparisonFindings) -> int:
    """After the point, so that the smallest mean has three that count."""
    least = min(abs(mean.mean) for mean in found.means)
    return min(max(2 - math.floor(math.log10(least)), 0), 6) if least else 3


def _styles(found: ComparisonFindings) -> dict[str, tuple[str, int]]:
    """Colour's name, by estimator as in all reports, and number of the motion model, by name of the combination."""
    colours = estimator_colours(r["estimator"] for r in found.rows)
    models = list(dict.fromkeys(r["model"] for r in found.rows))
    return {combination(r): (colours[r["estimator"]], models.index(r["model"])) for r in found.rows}


def _logs(found: ComparisonFindings) -> list[str]:
    return list(dict.fromkeys(r["log"] for r in found.rows))


def _names(found: ComparisonFindings) -> dict[str, str]:
    return {log: _short(log, found) for log in _logs(found)}


def _short(log: str, found: ComparisonFindings) -> str:
    """The log's name alone, where no other log has the same."""
    name = Path(log).name
    return name if sum(Path(other).name == name for other in _logs(found)) == 1 else log


def _provenance(head: CompareHead, found: ComparisonFindings) -> dict[str, str]:
    return {"robot": head.robot, "metric": found.metric, "reference": head.reference, "all numbers": head.table, **head.versions}


def _means_svg(found: ComparisonFindings, styles: Mapping[str, tuple[str, int]]) -> str:
    """A row for each combination, the best on top: a dot for each log, the mean and its 95 % interval. ``styles``: colour's name and
    number of the motion model, by name of the combination."""
    values = {name: np.array(list(table.values())) for name, table in by_combination(found.rows, found.metric).items()}

    def draw(figure: Canvas) -> None:
        axes = figure.add_subplot()
        for row, mean in enumerate(found.means):
            colour, model = styles[mean.name]
            axes.plot(values[mean.name], _spread(row, mean.n), ".", color=html.COLOURS[colour], alpha=0.45, markersize=4.0)
            _interval(axes, row, mean.mean, (mean.low, mean.high), colour, _MARKERS[model % len(_MARKERS)])
        everything = np.concatenate([values[mean.name] for mean in found.means])
        least, most = everything.min(), everything.max()
        if is_wide([least, most]):
            axes.set(xscale="log", xlim=(least / 1.2, most * 1.2))
            plain_logs(axes)
        else:
            axes.set_xlim(min(0.0, 1.05 * least), 1.05 * most or 1.0)
        _rows(axes, [found.words[mean.name] for mean in found.means])
        axes.set_xlabel(_with_unit(found))

    return svg("means", html.WIDTH_IN, _ROW_HEIGHT_IN * len(found.means) + 0.75, draw)


def _gains_svg(found: ComparisonFindings, others: Sequence[Mean], styles: Mapping[str, tuple[str, int]]) -> str:
    """By how much the best is smaller than each of ``others``, with 95 % intervals: those that reach 0 show nothing."""

    def draw(figure: Canvas) -> None:
        axes = figure.add_subplot()
        for row, mean in enumerate(others):
            d = found.against_best(mean.name)
            assert d is not None
            sign = 1.0 if d.better == found.best.name else -1.0
            low, high = sorted(100.0 * sign * part for part in (d.relative_low, d.relative_high))
            colour, model = styles[mean.name]
            _interval(axes, row, 100.0 * sign * d.relative, (low, high), colour, _MARKERS[model % len(_MARKERS)])
        axes.axvline(0.0, color=html.COLOURS["ink"], linewidth=0.9)
        _rows(axes, [f"than {found.words[mean.name]}" for mean in others])
        axes.set_xlabel(f"smaller by [%]: {found.measure} of {found.words[found.best.name]}")

    return svg("gains", html.WIDTH_IN, _ROW_HEIGHT_IN * len(others) + 0.75, draw)


def _interval(axes: Axes, row: int, value: float, interval: tuple[float, float], colour: str, marker: str) -> None:
    is_bounded = not np.isinf(interval).any()
    if is_bounded:
        axes.plot(interval, [row, row], color=html.COLOURS[colour], linewidth=2.0, solid_capstyle="butt")
    face, edge = (html.COLOURS[colour], html.COLOURS["ink"]) if is_bounded else ("none", html.COLOURS[colour])
    axes.plot(value, row, marker, color=face, markersize=6.5, markeredgecolor=edge, markeredgewidth=0.6 if is_bounded else 1.4)


def _rows(axes: Axes, names: Sequence[str]) -> None:
    axes.set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.4, -0.6))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)


def _spread(row: int, n: int) -> np.ndarray:
    """Heights in a row, so that equal numbers do not hide each other."""
    return row + 0.24 * (np.arange(n) % 3 - 1.0)


def _with_unit(found: ComparisonFindings) -> str:
    return f"{found.measure} [{found.unit}]" if found.unit else found.measure
