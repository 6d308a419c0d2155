"""Report of a replay: summary, accuracy, figures, parameters, problems of the log, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.stats import chi2

from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result
from localization.report import figures
from localization.report.page import (
    Block,
    Definitions,
    Figure,
    LegendItem,
    Page,
    Paragraph,
    Section,
    Table,
    bullets,
    glossary,
    render,
    write_new,
)
from localization.report.runs import MapView, PlottedRun, best_run, map_view, nis_means, plotted_runs, relation_bins, timeline
from localization.report.summary import is_close, metres, verdict, verdict_sentences
from localization.report.tables import accuracy_tables, count_table, parameter_table

__all__ = ["ReportHead", "overview_png", "verdict", "write_report"]

_TERMS = {
    "ATE": "Absolute trajectory error: the whole path is aligned with the reference by a rigid motion, then the root mean square of the "
    "remaining position errors is taken. It measures the shape of the whole path.",
    "RPE": "Relative pose error: over pieces of path of 1, 2, 5, 10 m and so on, the error at the end of each piece per metre driven. It "
    "measures how fast errors grow, wherever they began.",
    "Relations": "Pairs of moments whose relative pose was verified by hand. The error is that of the estimated motion between them; "
    "relations that span little time test the odometry, long ones that close a loop test the whole path.",
    "NEES": "Normalised estimation error squared: the true error in units of the estimator's sigmas. Its mean is 3 for x, y and heading if "
    "the covariance is consistent; much more is overconfident, much less conservative. Errors along one drive are correlated, so a single "
    "drive between 0.2 and 9 proves nothing.",
    "NIS": "Normalised innovation squared: difference of scan and prediction, in units of the sigmas of both. It needs no reference, and "
    "its mean should be 3, too. A good NIS alone does not prove the path right: errors that scan and wheels share do not appear in it.",
    "Ellipses": "Two sigmas of the position since the start, by the estimator's covariance. They should hold the robot in 86 of 100 cases.",
}


@dataclass(frozen=True)
class ReportHead:
    """Log, robot and provenance of a report."""

    log: str
    """Name of the log."""
    robot: str
    start: str
    """Time of the log's begin, readable."""
    duration_s: float
    warnings: Sequence[str]
    """Problems found in the log."""
    versions: Mapping[str, str]
    """Versions by library."""
    log_fingerprint: str
    """Hash of the log."""


def write_report(path: str | Path, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    write_new(path, page(head, results, reference).encode())


def overview_png(path: str | Path, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> None:
    """Write one picture: trajectories over the map beside a bar for each error. Raises `OutputError` as `write_report` does."""
    runs = plotted_runs(results)
    measure = "mean error of the relations [m]" if isinstance(reference, Relations) else "position error, ATE [m]"
    write_new(path, figures.overview(runs, map_view(runs, reference), measure, head.log))


def page(head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> str:
    """HTML of the whole page."""
    runs = plotted_runs(results)
    sentences = verdict_sentences(results, reference)
    sections = [
        *(_sections(runs, reference) if runs else []),
        Section("About the log", bullets(head.warnings) or [Paragraph("No problem was found in it.")]),
        glossary(_TERMS),
        Section("Sources and versions", [Definitions(_provenance(head, reference))]),
        Section("In short", [Paragraph(" ".join(sentences))]),
    ]
    facts = f"{head.robot} · {head.duration_s:,.1f} s from {head.start}"
    return render(Page(f"Replay of {head.log}", facts, sentences, sections, [run.number for run in runs]))


def _sections(runs: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None) -> list[Section]:
    """Numbers and figures."""
    best = best_run(runs) if reference is not None else None
    near = [
        run for run in runs if best is not None and run is not best and run.error is not None and not run.is_lost and is_close(run, best)
    ]
    notes = " ".join(_about_reference(runs, reference))
    return [
        Section("Accuracy" if reference is not None else "Runs", [*accuracy_tables(runs, best, near), Paragraph(notes, is_small=True)]),
        Section("Trajectories", [_map_figure(runs, map_view(runs, reference))]),
        Section("Errors", _error_figure(runs, reference)),
        Section("Innovations: are the covariances consistent?", _nis_figure(runs)),
        Section("Estimated parameters", _with_note(parameter_table(runs), "Mean ± sigma at the end of the drive.")),
        Section("Counts", _with_note(count_table(runs), "")),
    ]


def _with_note(table: Table | None, note: str) -> list[Block]:
    if table is None:
        return []
    return [table, Paragraph(note, is_small=True)] if note else [table]


def _about_reference(runs: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None) -> list[str]:
    if reference is None:
        return ["No reference: nothing here is an error, and columns that need one are left out."]
    scored = [run.result.accuracy for run in runs if run.result.accuracy is not None]
    sentences = []
    if scored:
        a = scored[0]
        what = "relations" if isinstance(reference, Relations) else "samples"
        sentences.append(
            f"Scored against {reference.source}: {a.n_matched:,} of {a.n_reference:,} {what}, over {100 * a.overlap:.0f} % of the drive."
        )
    if isinstance(reference, ReferenceTrack) and reference.yaws is None:
        sentences.append(
            "It has positions only, so there are no heading errors, no RPE and no NEES; its own noise and the distance of its antenna "
            "from the robot's base are part of the errors."
        )
    if len(runs) > 1:
        sentences.append("Bold: the smallest error of its column.")
    return [*sentences, *dict.fromkeys(warning for a in scored for warning in a.warnings)]


def _map_figure(runs: Sequence[PlottedRun], view: MapView) -> Figure:
    aligned = "Each run is aligned with the reference as a whole." if view.reference is not None else "All runs start at the same pose."
    sentences = [aligned]
    if view.map_of is not None:
        sentences.append(f"The map is drawn from the scans by {view.map_of.words}.")
    if view.best is not None and view.ellipses:
        largest = metres(max(e.semi_axes[0] for e in view.ellipses))
        sentences.append(f"Ellipses: two sigmas of the position since the start, by {view.best.words} (at most ±{largest}).")
    if view.n_cut:
        sentences.append(f"{view.n_cut} of the runs leave{'s' if view.n_cut == 1 else ''} the picture.")
    legend = _legend(runs, has_boxes=len(runs) > 1)
    if view.reference is not None:
        legend.append(LegendItem(symbol="rule", text="reference"))
    if len(view.points):
        legend.append(LegendItem(symbol="dots", text="LiDAR map"))
    legend.append(LegendItem(symbol="ring", text="start"))
    return Figure(figures.map_svg(runs, view), "Trajectories from above", " ".join(sentences), legend)


def _error_figure(runs: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None) -> list[Block]:
    if isinstance(reference, Relations):
        scored = [run for run in runs if run.result.accuracy is not None]
        if not scored:
            return []
        binned = [relation_bins(run, reference) for run in scored]
        numbers = ", ".join(f"{n:,}" for n in binned[0].n)
        caption = (
            "Mean errors of the relations by the time that they span; both axes are logarithmic. "
            f"Relations in each point, from left: {numbers}."
        )
        return [
            Figure(
                figures.relation_bins_svg(scored, binned), "Errors of the relations by the time that they span", caption, _legend(scored)
            )
        ]
    timelines = [(run, found) for run in runs if (found := timeline(run)) is not None]
    if not timelines:
        return []
    shown, series = [run for run, _ in timelines], [found for _, found in timelines]
    caption = (
        "Each run is aligned with the reference as a whole, so errors at one time depend on those at others: large at both ends and small "
        "between is a path that bends."
    )
    return [Figure(figures.timeline_svg(shown, series), "Errors over time", caption, _legend(shown))]


def _nis_figure(runs: Sequence[PlottedRun]) -> list[Block]:
    shown, means = nis_means(runs, float(chi2.ppf(0.95, 3)))
    if not shown:
        return []
    inside = ", ".join(f"{run.label} {100 * mean.fraction_inside:.0f} %" for run, mean in zip(shown, means, strict=True))
    caption = (
        f"Each point is the mean of {means[0].group} successive scans. Above the band, scans and prediction differ by more than their "
        f"covariances allow; below it, by less. Single scans within their own 95 % limit: {inside} (95 % expected)."
    )
    legend = [*_legend(shown), LegendItem(symbol="dots", colour="band", text="95 % band of a consistent filter")]
    return [Figure(figures.nis_svg(shown, means), "Normalised innovations over time", caption, legend)]


def _legend(runs: Sequence[PlottedRun], has_boxes: bool = False) -> list[LegendItem]:
    """Labels hide and show their run in every figure; the boxes themselves stand in one legend only."""
    return [LegendItem(run, has_boxes) for run in runs]


def _provenance(head: ReportHead, reference: ReferenceTrack | Relations | None) -> dict[str, str]:
    return {
        "log": head.log,
        "log's SHA-256": head.log_fingerprint,
        "robot": head.robot,
        "reference": "none" if reference is None else reference.source,
        **head.versions,
    }
