"""Report of a replay: summary, accuracy, figures, parameters, problems of the log, provenance; one definition of each column.

Tables are those of the page and of the terminal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.stats import chi2

from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result
from localization.messages import Message
from localization.report import figures
from localization.report import page as html
from localization.report.interactive import Scans, explorer
from localization.report.map_page import change_blocks, grid_figure, picture_grid
from localization.report.runs import MapPlane, PlottedRun, best_run, map_view, nis_means, plotted_runs, relation_bins, timeline
from localization.report.space_view import profile_svg, space_tracks, stretch, view_svg
from localization.report.summary import is_close, metres, verdict, verdict_sentences

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
class ReportHead:
    """Log, robot and provenance of a report."""

    log: str
    """Name of the log."""
    robot: str
    start: str
    """Time of the log's begin, readable."""
    duration_s: float
    warnings: Sequence[Message]
    """Problems found in the log."""
    versions: Mapping[str, str]
    """Versions by library."""
    log_fingerprint: str
    """Hash of the log."""
    scans: Scans = ()
    """Some scans of the drive, for the map: stamp [ns] and points (M, 2) in the body frame [m]."""
    center_of_gravity: Sequence[html.Block] = ()
    """k and centre of rotation against the centre of gravity."""


def write_report(
    path: str | Path, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None, is_interactive: bool = True
) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    html.write_new(path, page(head, results, reference, is_interactive).encode())


def overview_png(path: str | Path, head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None) -> None:
    """Write one picture: trajectories over the map beside a bar for each error. Raises `OutputError` as `write_report` does."""
    runs = plotted_runs(results)
    measure = "mean error of the relations [m]" if isinstance(reference, Relations) else "position error, ATE [m]"
    html.write_new(path, figures.overview(runs, map_view(runs, reference), measure, head.log))


def page(head: ReportHead, results: Sequence[Result], reference: ReferenceTrack | Relations | None, is_interactive: bool = True) -> str:
    """HTML of the whole page; unless it ``is_interactive``, without scripts."""
    runs = plotted_runs(results)
    sentences = verdict_sentences(results, reference)
    warnings, notes = ([found for found in head.warnings if found.is_warning == is_warning] for is_warning in (True, False))
    about = html.bullets([*warnings, *notes]) or [html.Paragraph("No problem was found in it.")]
    sections = [
        *(_sections(runs, reference, head, is_interactive) if runs else []),
        html.Section("About the log", about),
        html.glossary(_TERMS),
        html.Section("Sources and versions", [html.Definitions(_provenance(head, reference))]),
        html.Section("In short", [html.Paragraph(" ".join(sentences))]),
    ]
    facts = f"{head.robot} · {head.duration_s:,.1f} s from {head.start}"
    return html.render(html.Page(f"Replay of {head.log}", facts, sentences, sections, [run.number for run in runs]))


def _sections(
    runs: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None, head: ReportHead, is_interactive: bool
) -> list[html.Section]:
    """Numbers and figures."""
    best = best_run(runs) if reference is not None else None
    near = [run for run in runs if best is not None and run is not best and run.error is not None and is_close(run, best)]
    notes = " ".join(_about_reference(runs, reference))
    explore = [explorer(runs, reference, head.scans)] if is_interactive and any(len(run.result.run.trajectory) for run in runs) else []
    return [
        html.Section(
            "Accuracy" if reference is not None else "Runs", [*accuracy_tables(runs, best, near), html.Paragraph(notes, is_small=True)]
        ),
        html.Section("What the centre of gravity does", list(head.center_of_gravity)),
        html.Section("Explore", explore),
        html.Section("Trajectories", [map_figure(runs, map_view(runs, reference))], is_static=bool(explore)),
        html.Section("Map", _grid_blocks(runs)),
        html.Section("Errors", _error_figure(runs, reference), is_static=bool(explore) and not isinstance(reference, Relations)),
        html.Section("In space", _space_figures(runs)),
        html.Section("Innovations: are the covariances consistent?", _nis_figure(runs), is_static=bool(explore)),
        html.Section("Estimated parameters", _with_note(parameter_table(runs), "Mean ± sigma at the end of the drive.")),
        html.Section("Counts", _with_note(count_table(runs), "")),
    ]


def _grid_blocks(runs: Sequence[PlottedRun]) -> list[html.Block]:
    """The grid of the last map of a graph, or of a drive in a saved map; and what of the saved map has changed."""
    mapped = [(run.result.run, run.result.run.keyframes) for run in runs]
    planar = [
        (run, keyframes) for run, keyframes in mapped if keyframes is not None and not keyframes.is_in_space and len(keyframes.points)
    ]
    if not planar:
        return []
    run, keyframes = planar[-1]
    found = run.localization or {}
    return [grid_figure(picture_grid(keyframes), found.get("changes", ())), *change_blocks(found)]


def _with_note(table: html.Table | None, note: str) -> list[html.Block]:
    if table is None:
        return []
    return [table, html.Paragraph(note, is_small=True)] if note else [table]


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
            "It has positions only, so there are no heading errors and no RPE, and NEES is that of the distances; its own noise and the "
            "distance of its antenna from the robot's base are part of the errors."
        )
    if len(runs) > 1:
        sentences.append("Bold: the smallest error of its column.")
    return [*sentences, *dict.fromkeys(warning for a in scored for warning in a.warnings)]


def map_figure(runs: Sequence[PlottedRun], view: MapPlane) -> html.Figure:
    """Trajectories from above, with the reference and the map, where there are any."""
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
        legend.append(html.LegendItem(symbol="rule", text="reference"))
    if len(view.points):
        legend.append(html.LegendItem(symbol="dots", text="LiDAR map"))
    legend.append(html.LegendItem(symbol="ring", text="start"))
    return html.Figure(figures.map_svg(runs, view), "Trajectories from above", " ".join(sentences), legend)


def _error_figure(runs: Sequence[PlottedRun], reference: ReferenceTrack | Relations | None) -> list[html.Block]:
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
            html.Figure(
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
    return [html.Figure(figures.timeline_svg(shown, series), "Errors over time", caption, _legend(shown))]


def _space_figures(runs: Sequence[PlottedRun]) -> list[html.Block]:
    tracks = space_tracks(runs)
    if not tracks:
        return []
    legend = _legend([track.line for track in tracks])
    profile = "Height of the body's origin above that of the first pose, with two sigmas; roll is positive with the left side up, pitch "
    stretched = stretch(tracks)
    view = "The way in three dimensions" + (f", heights stretched {stretched:.1f} times." if stretched > 1.05 else ".")
    return [
        html.Figure(profile_svg(tracks), "Height and tilt", profile + "with the nose down.", legend),
        html.Figure(view_svg(tracks), "The way in three dimensions", view, legend),
    ]


def _nis_figure(runs: Sequence[PlottedRun]) -> list[html.Block]:
    shown, means = nis_means(runs, float(chi2.ppf(0.95, 3)))
    if not shown:
        return []
    inside = ", ".join(f"{run.label} {100 * mean.fraction_inside:.0f} %" for run, mean in zip(shown, means, strict=True))
    caption = (
        f"Each point is the mean of {means[0].group} successive scans. Above the band, scans and prediction differ by more than their "
        f"covariances allow; below it, by less. Single scans within their own 95 % limit: {inside} (95 % expected)."
    )
    legend = [*_legend(shown), html.LegendItem(symbol="dots", colour="band", text="95 % band of a consistent filter")]
    return [html.Figure(figures.nis_svg(shown, means), "Normalised innovations over time", caption, legend)]


def _legend(runs: Sequence[PlottedRun], has_boxes: bool = False) -> list[html.LegendItem]:
    """Labels hide and show their run in every figure; the boxes themselves stand in one legend only."""
    return [html.LegendItem(run, has_boxes) for run in runs]


def _provenance(head: ReportHead, reference: ReferenceTrack | Relations | None) -> dict[str, str]:
    return {
        "log": head.log,
        "log's SHA-256": head.log_fingerprint,
        "robot": head.robot,
        "reference": "none" if reference is None else reference.source,
        **head.versions,
    }


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
"""Columns of accuracy tables, on pages and terminals."""

_SQUARES = tuple(
    column
    for group, which in _GROUPS
    for column in (
        Column(f"Translation², {which}", "m²", 4, _relations(group, "translation_m2")),
        Column("Rotation²", "deg²", 3, _relations(group, "rotation_deg2")),
    )
)
_DRIVEN = Column("Driven", "m, by its own estimate", 1, lambda result: result.run.driven_m, is_error=False)


def number(value: float | None, digits: int) -> str:
    """Fixed digits with thousands separated; an en dash for None and NaN, and never a rounded zero for a value that is not zero."""
    if value is None or math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else f"{_MINUS}∞"
    if value and abs(value) < 0.5 * 10.0**-digits:
        return f"< {10.0**-digits:.{digits}f}" if value > 0 else f"{value:.1e}"
    return f"{value:,.{digits}f}".replace("-", _MINUS)


def accuracy_tables(runs: Sequence[PlottedRun], best: PlottedRun | None, near: Sequence[PlottedRun]) -> list[html.Table]:
    """A row for each run; columns without any value are left out. The smallest error of a column is bold.

    ``near``: the runs practically as good as the best. A second table, of mean squares, follows for relations.
    """
    columns = with_values(COLUMNS, [run.result for run in runs])
    if not any(c.is_error for c in columns):
        columns = [_DRIVEN, *columns]
    badges = {run.number: _NEAR for run in near} | {run.number: _LOST for run in runs if run.is_lost}
    if best is not None:
        badges[best.number] = _BEST
    squares = with_values(_SQUARES, [run.result for run in runs])
    tables = [_accuracy_table(runs, columns, badges, "")]
    if squares:
        tables.append(_accuracy_table(runs, squares, {}, "Mean squares, as published for the benchmark"))
    return tables


def with_values(columns: Sequence[Column], results: Sequence[Result]) -> list[Column]:
    """The ``columns`` in which any of ``results`` has a value."""
    return [c for c in columns if any(c.value(result) is not None for result in results)]


def _accuracy_table(runs: Sequence[PlottedRun], columns: Sequence[Column], badges: Mapping[int, str], summary: str) -> html.Table:
    values = {i: [v for run in runs if (v := c.value(run.result)) is not None] for i, c in enumerate(columns) if c.is_error}
    smallest = {i: min(column, default=None) for i, column in values.items()} if len(runs) > 1 else {}
    rows = []
    for run in runs:
        model = "any: it does not use wheels" if run.model is None else run.model
        name = html.Cell(run.result.run.estimator, model, is_bold=True, badge=badges.get(run.number, ""), swatch=run)
        cells = [name]
        for i, column in enumerate(columns):
            value = column.value(run.result)
            bar = _bar(run, value, values[0]) if i == 0 and column.is_error else None
            cells.append(html.Cell(number(value, column.digits), is_bold=value is not None and value == smallest.get(i), bar=bar))
        rows.append(cells)
    return html.Table([html.Cell("Estimator", "motion model"), *(html.Cell(c.title, c.unit) for c in columns)], rows, summary)


def _bar(run: PlottedRun, value: float | None, values: Sequence[float]) -> tuple[float, str] | None:
    """Length of a bar, linear from zero, and its colour."""
    widest = max((v for v in values if math.isfinite(v)), default=0.0)
    if value is None or not math.isfinite(value) or widest <= 0.0:
        return None
    return value / widest, run.colour


def parameter_table(runs: Sequence[PlottedRun]) -> html.Table | None:
    """Mean and sigma of what was estimated besides the pose; None if nothing was."""
    cells = {run.number: {name: plus_minus(*value) for name, value in run.result.run.parameters.items()} for run in runs}
    return _by_name(runs, cells, lambda name: html.Cell(name, unit_of(name), is_code=True))


def count_table(runs: Sequence[PlottedRun]) -> html.Table | None:
    """Number of occurrences by name; None if nothing was counted."""
    cells = {run.number: {name: html.Cell(f"{count:,}") for name, count in run.result.run.counts.items()} for run in runs}
    return _by_name(runs, cells, lambda name: html.Cell(name.replace("_", " ")))


def plus_minus(mean: float, sigma: float) -> html.Cell:
    """``mean ± sigma`` to two digits of sigma, small numbers with a power of ten."""
    if not (math.isfinite(mean) and math.isfinite(sigma)):
        return html.Cell(f"{number(mean, 4)} ± {number(sigma, 4)}")
    largest = max(abs(mean), abs(sigma))
    power = math.floor(math.log10(largest)) if 0.0 < largest < 1e-3 or largest >= 1e6 else 0
    mean, sigma = mean / 10.0**power, sigma / 10.0**power
    digits = min(max(1 - math.floor(math.log10(abs(sigma))), 0), 9) if sigma else 4
    text = f"{mean:z.{digits}f} ± {sigma:.{digits}f}".replace("-", _MINUS)
    return html.Cell(text, power=str(power).replace("-", _MINUS)) if power else html.Cell(text)


def unit_of(name: str) -> str:
    """From the end of a name, as everywhere in this project; "" where it has none."""
    return next((unit for ending, unit in _UNITS if name.endswith(ending)), "")


def _by_name(
    runs: Sequence[PlottedRun], cells: Mapping[int, Mapping[str, html.Cell]], title: Callable[[str], html.Cell]
) -> html.Table | None:
    names = list(dict.fromkeys(name for run in runs for name in cells[run.number]))
    shown = [run for run in runs if cells[run.number]]
    if not names:
        return None
    rows: list[html.Row] = [[title(name), *(cells[run.number].get(name, html.Cell(MISSING)) for run in shown)] for name in names]
    return html.Table([html.Cell(), *(html.Cell(run.label, swatch=run) for run in shown)], rows)
