"""One self-contained page that tells what a replay found: words first, then the numbers, then the pictures, then where it all came from.

The page loads nothing, runs no script and has the same bytes for the same results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from scipy.stats import chi2

from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result
from localization.report import figures
from localization.report.figure_data import MapView, map_view, nis_means, spans, timeline
from localization.report.page import bullets, figure, glossary, html_page, opening, section, write_new
from localization.report.runs import Line, best_line, make_lines
from localization.report.summary import is_close, metres, verdict, verdict_sentences
from localization.report.tables import REFERENCE_SWATCH, accuracy_table, count_table, definition_table, parameter_table, swatch

__all__ = ["ReportHead", "overview_png", "verdict", "write_report"]

_TERMS = (
    (
        "ATE",
        "Absolute trajectory error: the whole path is laid onto the reference as well as a rigid motion can, then the root mean "
        "square of what remains is taken. It tells how good the shape of the whole path is.",
    ),
    (
        "RPE",
        "Relative pose error: over pieces of path of 1, 2, 5, 10 m and so on, the error at the end of each piece per metre "
        "driven. It tells how fast errors grow, wherever they began.",
    ),
    (
        "Relations",
        "Pairs of moments whose relative pose was verified by hand. The error is that of the estimated motion between them; "
        "relations that span little time test the odometry, long ones that close a loop test the whole path.",
    ),
    (
        "NEES",
        "Normalised estimation error squared: the true error measured in the sigmas that the estimator claims. The mean of an "
        "honest one is 3, for x, y and heading; much more is overconfident, much less is timid. Errors along one drive hang "
        "together, so one drive between 0.2 and 9 proves nothing.",
    ),
    (
        "NIS",
        "Normalised innovation squared: how far each scan disagrees with the prediction, in the sigmas of both. It needs no "
        "reference, and its mean should be 3, too. A good NIS alone does not prove the path right: errors that scan and wheels "
        "share do not show in it.",
    ),
    (
        "Ellipses",
        "Two sigmas of the position since the start, as the estimator claims it. The robot should be inside in 86 of 100 cases.",
    ),
)


@dataclass(frozen=True)
class ReportHead:
    """What a report says of the log and of itself."""

    log: str
    """Name of the log."""
    robot: str
    start: str
    """When the log begins, as a reader wants to see it."""
    duration_s: float
    warnings: Sequence[str]
    """What was lost or mended when the log was read."""
    versions: Mapping[str, str]
    """Of the libraries that made the numbers."""
    log_fingerprint: str
    """Hash of the log."""


def write_report(path: str | Path, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    write_new(path, page(head, results, reference).encode())


def overview_png(path: str | Path, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> None:
    """Write one picture: trajectories over the map beside a bar for each error. Raises `OutputError` as `write_report` does."""
    lines = make_lines(results)
    measure = "mean error of the relations [m]" if isinstance(reference, Relations) else "position error, ATE [m]"
    write_new(path, figures.overview(lines, map_view(lines, reference), measure, head.log))


def page(head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> str:
    """The whole page."""
    lines = make_lines(results)
    best = best_line(lines) if reference is not None else None
    near = [
        line
        for line in lines
        if best is not None and line is not best and line.error is not None and not line.is_lost and is_close(line, best)
    ]
    sentences = verdict_sentences(results, reference)
    facts = f"{head.robot} · {head.duration_s:,.1f} s from {head.start}"
    parts = opening(f"Replay of {head.log}", facts, sentences)
    if lines:
        parts += [
            section(
                "Accuracy" if reference is not None else "Runs", accuracy_table(lines, best, near) + _about_reference(lines, reference)
            ),
            section("Trajectories", _map_figure(lines, map_view(lines, reference))),
            section("Errors", _error_figure(lines, reference)),
            section("Innovations: does the filter know how wrong it is?", _nis_figure(lines)),
            section("Estimated parameters", _with_note(parameter_table(lines), "Mean ± sigma at the end of the drive.")),
            section("Counts", count_table(lines)),
        ]
    parts += [
        section("About the log", bullets(head.warnings) or "<p>Nothing was lost and nothing had to be mended.</p>"),
        glossary(_TERMS),
        section("Where this comes from", definition_table(_provenance(head, reference))),
        section("In short", f"<p>{escape(' '.join(sentences))}</p>"),
    ]
    return html_page(f"Replay of {head.log}", parts, lines)


def _with_note(table: str, note: str) -> str:
    return f"{table}<p><small>{note}</small></p>" if table else ""


def _about_reference(lines: Sequence[Line], reference: ReferenceTrack | Relations | None) -> str:
    if reference is None:
        return "<p><small>No reference: nothing here is an error, and columns that need one are left out.</small></p>"
    scored = [line.result.accuracy for line in lines if line.result.accuracy is not None]
    sayings = []
    if scored:
        a = scored[0]
        what = "relations" if isinstance(reference, Relations) else "samples"
        sayings.append(
            f"Scored against {reference.source}: {a.n_matched:,} of {a.n_reference:,} {what}, over {100 * a.overlap:.0f} % of the drive."
        )
    if isinstance(reference, ReferenceTrack) and reference.yaws is None:
        sayings.append(
            "It knows positions only, so there are no heading errors, no RPE and no NEES; its own noise and the distance of its antenna "
            "from the robot's base are part of the errors."
        )
    if len(lines) > 1:
        sayings.append("Bold: the smallest error of its column.")
    sayings += dict.fromkeys(note for a in scored for note in a.warnings)
    return "<p><small>" + " ".join(escape(saying) for saying in sayings) + "</small></p>"


def _map_figure(lines: Sequence[Line], view: MapView) -> str:
    sayings = []
    if view.reference is not None:
        sayings.append("Each run is laid onto the reference as a whole.")
    else:
        sayings.append("All runs start at the same pose.")
    if view.map_of is not None:
        sayings.append(f"The map is what {escape(view.map_of.words)} made of the scans.")
    if view.best is not None and view.ellipses:
        largest = metres(max(e.semi_axes[0] for e in view.ellipses))
        sayings.append(
            f"Ellipses: two sigmas of the position since the start, as {escape(view.best.words)} claims them (at most ±{largest})."
        )
    if view.n_cut:
        sayings.append(f"{view.n_cut} of the runs leave{'s' if view.n_cut == 1 else ''} the picture.")
    more = ['<li><span class="ring"></span>start</li>']
    if view.reference is not None:
        more.insert(0, f"<li>{REFERENCE_SWATCH}reference</li>")
    if len(view.points):
        more.append('<li><span class="dots"></span>LiDAR map</li>')
    pictures = [figures.map_svg(lines, view, size) for size in (figures.WIDE, figures.NARROW)]
    return figure(_legend(lines, boxes=True, more="".join(more)), pictures, "Trajectories seen from above", " ".join(sayings))


def _error_figure(lines: Sequence[Line], reference: ReferenceTrack | Relations | None) -> str:
    if isinstance(reference, Relations):
        scored = [line for line in lines if line.result.accuracy is not None]
        if not scored:
            return ""
        binned = [spans(line, reference) for line in scored]
        numbers = ", ".join(f"{n:,}" for n in binned[0].n)
        caption = (
            "Mean errors of the relations by the time that they span; both axes are logarithmic. "
            f"Relations in each point, from left: {numbers}."
        )
        pictures = [figures.spans_svg(scored, binned, size) for size in (figures.WIDE, figures.NARROW)]
        return figure(_legend(scored), pictures, "Errors of the relations by the time that they span", caption)
    known = [(line, found) for line in lines if (found := timeline(line)) is not None]
    if not known:
        return ""
    shown, series = [line for line, _ in known], [found for _, found in known]
    pictures = [figures.timeline_svg(shown, series, size) for size in (figures.WIDE, figures.NARROW)]
    caption = (
        "Each run is laid onto the reference as a whole, so errors at one time depend on those at others: large at both ends and small "
        "between is a path that bends."
    )
    return figure(_legend(shown), pictures, "Errors over time", caption)


def _nis_figure(lines: Sequence[Line]) -> str:
    shown, means = nis_means(lines, float(chi2.ppf(0.95, 3)))
    if not shown:
        return ""
    inside = ", ".join(f"{escape(line.label)} {100 * mean.fraction_inside:.0f} %" for line, mean in zip(shown, means, strict=True))
    band = '<li><span class="dots" style="background:var(--band);opacity:1"></span>95 % band of an honest filter</li>'
    caption = (
        f"Each point is the mean of {means[0].group} successive scans. Above the band the scans disagree with the prediction more than the "
        "filter believes possible; below it, less. Single scans within their own 95 % limit: "
        f"{inside} (95 % expected)."
    )
    pictures = [figures.nis_svg(shown, means, size) for size in (figures.WIDE, figures.NARROW)]
    return figure(_legend(shown, more=band), pictures, "Normalised innovations over time", caption)


def _legend(lines: Sequence[Line], boxes: bool = False, more: str = "") -> str:
    """Labels hide and show their line in every picture; the boxes themselves stand in one legend only."""
    items = []
    for line in lines:
        box = f'<input type="checkbox" id="show-{line.number}" checked>' if boxes and len(lines) > 1 else ""
        items.append(f'<li>{box}<label for="show-{line.number}">{swatch(line)}{escape(line.label)}</label></li>')
    return f'<ul class="legend">{"".join(items)}{more}</ul>\n'


def _provenance(head: ReportHead, reference: ReferenceTrack | Relations | None) -> dict[str, str]:
    return {
        "log": head.log,
        "log's SHA-256": head.log_fingerprint,
        "robot": head.robot,
        "reference": "none" if reference is None else reference.source,
        **head.versions,
    }
