"""One self-contained page that tells what a comparison over many logs found: words first, then means, tests, every log, what failed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from localization.comparison.figures import gains_svg, means_svg
from localization.comparison.statistics import Difference, Mean, by_combination, combination
from localization.comparison.summary import Findings, against_best, closing, headline, p_words, percent
from localization.errors import OutputError
from localization.output import write_text_file
from localization.report.page import bullets, figure, glossary, html_page, opening, section
from localization.report.runs import capitalised, estimator_colours
from localization.report.svg import NARROW, WIDE
from localization.report.tables import MISSING, definition_table, header, number, row, table

_TITLE = "Comparison over"
_BEST, _EQUAL = ' <span class="badge">best</span>', ' <span class="badge soft">not told apart</span>'
_LOST = ' <span class="badge soft">LiDAR lost</span>'
_TERMS = (
    (
        "Mean",
        "Over logs, each of which counts once: errors within a log hang together, logs do not. In brackets the interval that holds the "
        "mean of other such logs in 95 of 100 cases, by bootstrap over logs.",
    ),
    (
        "Smaller by",
        "By what part of the other's mean the best one's is smaller, on the logs that both have, with its 95 % interval. Logs differ far "
        "more than combinations do on one log: this interval is of the pairs and can be narrow where those of the means overlap.",
    ),
    (
        "p",
        "How probable so large a difference is if neither were better: signs of the differences are flipped log by log. Corrected for "
        "all pairs of the table after Holm. Below 0.05 a difference is called shown.",
    ),
)


@dataclass(frozen=True)
class CompareHead:
    """What a report says of where it comes from."""

    robot: str
    reference: str
    table: str
    """Name of the table with all numbers."""
    versions: Mapping[str, str]


def write_comparison_report(path: Path, head: CompareHead, found: Findings) -> None:
    """Write the page, over the report of an earlier state of the same table, but over nothing else. Raises `OutputError`."""
    check_report(path)
    write_text_file(path, comparison_page(head, found), replace=True)


def check_report(path: Path) -> None:
    """Raises `OutputError` where a report would overwrite something else."""
    try:
        if path.exists() and f"<title>{_TITLE}".encode() not in path.read_bytes()[:1000]:
            raise OutputError(f"'{path}' exists already and is no report of a comparison. Choose another --out, or remove it.")
    except OSError as error:
        raise OutputError(f"'{path}' cannot be read: {error.strerror}.") from error


def comparison_page(head: CompareHead, found: Findings) -> str:
    """The whole page; ``found`` has means."""
    names = [_short(log, found) for log in _logs(found)]
    n = len(names)
    title = f"{_TITLE} {n} log{'s' * (n != 1)}"
    styles = _styles(found)
    facts = f"{head.robot} · {found.metric} · {len(found.words)} combinations of motion model and estimator"
    others = [mean for mean in found.means[1:] if (d := found.against_best(mean.name)) is not None and d.relative == d.relative]
    parts = [
        *opening(title, facts, [_unbroken(said) for said in (headline(found), *closing(found))]),
        section("Means over logs", _means_figure(found, styles)),
        section("The best against the others", _gains_figure(found, others, styles) + _tests(found, styles)),
        section("Every log", _by_log(found, styles)),
        section("What failed", _failures(found)),
        section("What was amiss with logs that did not fail", _notes(found)),
        glossary(_TERMS),
        section("Where this comes from", definition_table(_provenance(head, found))),
    ]
    return html_page(title, parts)


def _unbroken(sentence: str) -> str:
    """Numbers stay with their signs at the ends of lines."""
    return sentence.replace(" %", "\N{NO-BREAK SPACE}%").replace("p = ", "p\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}")


def _means_figure(found: Findings, styles: Mapping[str, tuple[str, int]]) -> str:
    caption = "Large: mean over logs, the line its 95 % interval. Small: each log. Colours are estimators, shapes are motion models."
    return figure("", [means_svg(found, styles, size) for size in (WIDE, NARROW)], f"Mean {found.measure} by combination", caption)


def _gains_figure(found: Findings, others: Sequence[Mean], styles: Mapping[str, tuple[str, int]]) -> str:
    if not others:
        return ""
    caption = "Lines are 95 % intervals over logs; where one reaches 0, these logs do not show that the best is better."
    pictures = [gains_svg(found, others, styles, size) for size in (WIDE, NARROW)]
    return figure("", pictures, f"By how much the {found.measure} of the best is smaller", caption)


def _tests(found: Findings, styles: Mapping[str, tuple[str, int]]) -> str:
    digits = _digits(found)
    rows = []
    for mean in found.means:
        d = None if mean is found.best else found.against_best(mean.name)
        interval = f"<br><small>{number(mean.low, digits)} to {number(mean.high, digits)}</small>" if mean.n > 1 else ""
        badge = _LOST if found.lost(mean.name) else _BEST if mean is found.best else _EQUAL if d is None or not found.is_shown(d) else ""
        cells = (MISSING,) * 3 if d is None else _cells(d, found)
        rows.append(row(_name(mean.name, found, styles, badge), number(mean.mean, digits) + interval, str(mean.n), *cells))
    unit = f"<br><small>{found.unit or found.metric}, 95 %</small>"
    head = header("Estimator<br><small>motion model</small>", f"Mean{unit}", "Logs", "Best is smaller by<br><small>95 %</small>", "on", "p")
    sentences = bullets(against_best(mean, found) for mean in found.means[1:])
    told = f"<details><summary>The same in words</summary>{sentences}</details>" if sentences else ""
    return table(head, rows) + told + _all_pairs(found)


def _cells(d: Difference, found: Findings) -> tuple[str, str, str]:
    reverse = "" if d.better == found.best.name else "the other: "
    return f"{reverse}{percent(d, found.unit)}", f"{d.wins} of {d.n}", p_words(d.p_value)


def _all_pairs(found: Findings) -> str:
    if len(found.means) < 3:
        return ""
    rows = [
        row(
            escape(f"{capitalised(found.words[d.better])} before {found.words[d.worse]}"),
            percent(d, found.unit),
            f"{d.wins} of {d.n}",
            p_words(d.p_value),
        )
        for d in found.tested
    ]
    return f"<details><summary>All pairs</summary>{table(header('Trial', 'Smaller by', 'on', 'p'), rows)}</details>"


def _by_log(found: Findings, styles: Mapping[str, tuple[str, int]]) -> str:
    numbers = by_combination(found.rows, found.metric)
    shown = [mean.name for mean in found.means]
    failed = {(r["log"], combination(r)) for r in found.failed}
    digits, rows = _digits(found), []
    for log in _logs(found):
        values = [numbers[name].get(log) for name in shown]
        least = min((value for value in values if value is not None), default=None)
        cells = []
        for name, value in zip(shown, values, strict=True):
            text = ("failed" if (log, name) in failed else MISSING) if value is None else number(value, digits)
            cells.append(f"<b>{text}</b>" if value is not None and value == least and len(shown) > 1 else text)
        rows.append(row(escape(_short(log, found)), *cells))
    unit = f" [{found.unit}]" if found.unit else ""
    note = f"<p><small>{escape(found.measure)}{unit}. Bold: the smallest on its log.</small></p>"
    return table(header("Log", *(_name(name, found, styles) for name in shown)), rows) + note


def _failures(found: Findings) -> str:
    reasons: dict[tuple[str, str], list[str]] = {}
    for r in found.failed:
        reasons.setdefault((r["log"], r["error"]), []).append(found.words[combination(r)])
    rows = []
    for (log, reason), names in reasons.items():
        which = "everything" if len(names) == len(found.words) else ", ".join(names)
        rows.append(f"<li><b>{escape(_short(log, found))}</b> ({escape(which)}): {escape(reason)}</li>")
    return f"<ul>{''.join(rows)}</ul>" if rows else ""


def _notes(found: Findings) -> str:
    notes = {r["log"]: r["notes"] for r in found.rows if r.get("notes")}
    listed = "".join(f"<li><b>{escape(_short(log, found))}</b>: {escape(said)}</li>" for log, said in notes.items())
    return f"<ul>{listed}</ul>" if listed else ""


def _name(name: str, found: Findings, styles: Mapping[str, tuple[str, int]], badge: str = "") -> str:
    estimator, _, model = found.words[name].partition(" with ")
    mark = f'<b style="color:var(--{styles[name][0]})">●</b>'
    return f'<span class="name">{mark} <b>{escape(estimator)}</b></span>{badge}<br><small>{escape(model)}</small>'


def _digits(found: Findings) -> int:
    """After the point, so that the smallest mean has three that count."""
    least = min(abs(mean.mean) for mean in found.means)
    return min(max(2 - math.floor(math.log10(least)), 0), 6) if least else 3


def _styles(found: Findings) -> dict[str, tuple[str, int]]:
    """Colour's name, by estimator as in all reports, and number of the motion model, by name of the combination."""
    colours = estimator_colours(r["estimator"] for r in found.rows)
    models = list(dict.fromkeys(r["model"] for r in found.rows))
    return {combination(r): (colours[r["estimator"]], models.index(r["model"])) for r in found.rows}


def _logs(found: Findings) -> list[str]:
    return list(dict.fromkeys(r["log"] for r in found.rows))


def _short(log: str, found: Findings) -> str:
    """The log's name alone, where no other log has the same."""
    name = Path(log).name
    return name if sum(Path(other).name == name for other in _logs(found)) == 1 else log


def _provenance(head: CompareHead, found: Findings) -> dict[str, str]:
    return {"robot": head.robot, "metric": found.metric, "reference": head.reference, "all numbers": head.table, **head.versions}
