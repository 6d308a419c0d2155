"""Report of a diagnosis: the sentence, the findings, the drive that would separate them, discrepancies before and after correction."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from localization.diagnosis.drive_predictor import CHANNEL_UNITS, CHANNELS
from localization.diagnosis.extension import EXTEND_ADVICE, suggests_extension
from localization.diagnosis.findings import (
    Diagnosis,
    describe_outliers,
    describe_p,
    describe_row,
    describe_sizes,
    describe_tolerated,
    is_contesting,
    unit_of,
)
from localization.diagnosis.model_extension import EXTENSION_HEADS, Extension
from localization.diagnosis.result import DiagnosisResult
from localization.report import page as html
from localization.report.diagnosis_charts import COMPONENTS, diagnosis_charts, motion_in_windows
from localization.report.figures import Axes, svg
from localization.report.figures import Figure as Canvas
from motion_models import se2
from motion_models.se2 import FloatArray

_MAX_PANELS = 4
_VERDICTS = {
    "consistent": "No discrepancy exceeds noise and tolerances; the table shows each component.",
    "explained": "Each discrepancy that exceeds its noise has a cause with a name.",
    "extended": "With the terms each discrepancy is explained; RMS is that of the model without them.",
    "ambiguous": "The discrepancies are explained, but by more than one cause; this drive cannot separate them.",
    "unexplained": "The discrepancies have a part that no cause explains.",
    "undecidable": "This drive cannot show whether the model is right.",
}
_TERMS = {
    "Discrepancy": "What the reference measured in a window of the drive minus the model's prediction from the wheels in that window.",
    "Noise": "How large discrepancies without a cause are, estimated from this drive after everything that any cause could explain.",
    "p": "Probability that noise alone would make any of all causes look as strong as this one.",
    "Corrected": "What is left once the findings are corrected: the blue points.",
    "Left": "What neither the findings nor causes within their tolerance account for.",
    "RMS": "Root mean square over the windows, weighted by their noise, as in the other columns.",
    "Gain": "How much smaller discrepancies become in windows that the cause's size was not fitted to.",
    "Or": "Causes that would explain the same drive about as well, each with the size that it would need.",
}


def write_diagnosis_report(path: str | Path, found: DiagnosisResult, is_interactive: bool = True) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    html.write_new(path, diagnosis_page(found, is_interactive).encode())


def diagnosis_page(found: DiagnosisResult, is_interactive: bool = True) -> str:
    """HTML of the whole page; unless it ``is_interactive``, without scripts."""
    d = found.diagnosis
    sections = [
        html.Section("The drive", _drive(found)),
        html.Section("Findings", _findings(d)),
        html.Section("Terms", _terms(d.extension)),
        html.Section("Components", _components(d)),
        html.Section("Next", [html.Paragraph(text) for text in _next_steps(found)]),
        html.Section("Explore", diagnosis_charts(found)),
        *_figures(found),
        html.Section("Corrected robot: before and after", _handover(d)),
        html.Section("Within tolerance", html.bullets(describe_tolerated(d))),
        html.Section("Contradictions", html.bullets(d.contradictions)),
        html.Section("Left unexplained", html.bullets([t.text for t in d.trends if is_contesting(d, t)])),
        html.Section("Left, and less than the noise", html.bullets([t.text for t in d.trends if not is_contesting(d, t)])),
        html.Section("What this drive would show", _detectable(d)),
        html.Section("About the log", html.bullets([*describe_outliers(d), *d.warnings])),
        html.glossary(_TERMS),
    ]
    facts = f"{d.robot} · model {d.model} · reference {d.motion_reference} · {d.windows:,} windows"
    page = html.Page(f"Diagnosis of {d.log}", facts, [d.sentence, _VERDICTS[d.verdict]], sections)
    return html.render(page if is_interactive else page.without_scripts())


def _figures(found: DiagnosisResult) -> list[html.Section]:
    """Discrepancies and gains, as far as there are any."""
    d, sections = found.diagnosis, []
    if found.residuals is not None:
        colours = "Red: as found; blue: once corrected."
        over_time = html.Figure(
            _discrepancy_svg(found), "Discrepancies over time", f"Measured minus predicted. {colours} The band is two sigmas of noise."
        )
        by_motion = html.Figure(_dependence_svg(found), "Discrepancies by motion", f"One point for each window. {colours}")
        sections += [
            html.Section("Discrepancies over time", [over_time], is_static=True),
            html.Section("Discrepancies by motion", [by_motion], is_static=True),
        ]
    if d.findings:
        caption = "Each finding beside all others; the line is its 95 % interval, by bootstrap over blocks of windows."
        sections.append(html.Section("Held-out gain", [html.Figure(_gain_svg(d), "Held-out gain of each finding", caption)]))
    return sections


def _drive(found: DiagnosisResult) -> list[html.Block]:
    """The measured path beside those by the model as it is and as it is corrected; nothing where poses were not measured along a drive."""
    paths = _paths(found)
    if paths is None:
        return []
    measured, before, after = paths
    off = [float(np.sqrt(np.mean(np.sum((path - measured)[:, :2] ** 2, axis=1)))) for path in (before, after)]
    lines = [(measured, html.COLOURS["ink"], 2.5), (before, html.COLOURS["red"], 1.2)]
    caption = f"Black: as measured, window after window; red: by the robot file, {off[0]:.2g} m off (root mean square)"
    d, extension = found.diagnosis, found.diagnosis.extension
    has_terms = extension is not None and bool(extension.terms) and extension.is_better
    if d.findings or has_terms:
        how = "with the terms" if has_terms else "once the findings are corrected"
        caption += f"; blue: {how}, {off[1]:.2g} m off"
        lines.append((after, html.COLOURS["blue"], 1.2))

    def draw(figure: Canvas) -> None:
        axes = figure.add_subplot()
        for path, colour, width in lines:
            axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=width)
        axes.plot(*measured[0, :2], "o", color=html.COLOURS["ink"])
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="x [m]", ylabel="y [m]")

    caption += "."
    return [html.Figure(svg("paths", html.WIDTH_IN, 3.6, draw), "Measured path, and the model's before and after", caption)]


def _paths(found: DiagnosisResult) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """(n, 3) poses from window to window: measured, by the robot file, and once corrected; None where these were not measured. Windows that
    a gap cut off begin where the one before ended."""
    if found.predictor is None or found.residuals is None:
        return None
    drive, batch, r = found.predictor.drive, found.predictor.batch, found.residuals
    if drive.kind != "log" or not (drive.has_positions and drive.has_headings):
        return None
    last = np.flatnonzero(np.diff(batch.owner, append=-1))  # of several poses in a window
    rows = np.stack([np.zeros_like(r.rows[last, :3]), r.rows[last, :3], r.left[last, :3]])
    motions = batch.measured[last]
    known = np.isfinite(rows).all(axis=(0, 2)) & np.isfinite(motions).all(axis=1)
    if not known.any():
        return None
    found_paths = []
    for off in rows[:, known]:
        pose = [np.zeros(3)]
        for step in se2.compose(motions[known], se2.inverse(off)):
            pose.append(se2.compose(pose[-1], step))
        found_paths.append(np.array(pose))
    return found_paths[0], found_paths[1], found_paths[2]


def _findings(d: Diagnosis) -> list[html.Block]:
    if not d.findings:
        return []
    rows = []
    for f in d.findings:
        unit = "" if f.definition.unit == "1" else f" {f.definition.unit}"
        others = describe_sizes(f.aliases) or "–"  # noqa: RUF001
        gain = f"{100 * f.gain.relative:.0f} % ({100 * f.gain.low:.0f} to {100 * f.gain.high:.0f})"
        cause = html.Cell(f.definition.label, f"{f.description}; {f.evidence}", is_code=True)
        rows.append(
            [cause, html.Cell(f"{f.size:+.4g} ± {f.sigma:.2g}{unit}"), html.Cell(gain), html.Cell(f"{f.p_value:.1g}"), html.Cell(others)]
        )
    return [html.Table([html.Cell(title) for title in ("Cause", "Size", "Held-out gain", "p", "Or")], rows)]


def _terms(extension: Extension | None) -> list[html.Block]:
    if extension is None or not (extension.terms or extension.effects):
        return []
    rows = [[html.Cell(row[0]), html.Cell(row[1], is_code=True), *(html.Cell(text) for text in row[2:])] for row in extension.table()]
    return [html.Table([html.Cell(head.capitalize()) for head in EXTENSION_HEADS], rows)]


def _next_steps(found: DiagnosisResult) -> list[str]:
    """The next drive, and the search for terms where it is worth its time and was not made."""
    is_suggested = found.diagnosis.extension is None and suggests_extension(found)
    advice = f"{EXTEND_ADVICE[0].upper()}{EXTEND_ADVICE[1:]}"
    return [text for text in (found.diagnosis.next_drive, advice if is_suggested else "") if text]


def _components(d: Diagnosis) -> list[html.Block]:
    rows = []
    for name, c in d.discrepancy.items():
        sizes = (f"{v:.3g}" for v in (c.rms, c.corrected_rms, c.unattributed_rms, c.expected_rms))
        status = html.Cell(c.status, describe_row(c).removeprefix(c.status).strip(": "))
        rows.append([*(html.Cell(text) for text in (name, c.unit, *sizes, describe_p(c.p_value))), status])
    return [
        html.Table([html.Cell(title) for title in ("Component", "Unit", "RMS", "Corrected", "Left", "Noise", "p", "Attributed to")], rows)
    ]


def _handover(d: Diagnosis) -> list[html.Block]:
    if d.handover is None:
        return []
    h = d.handover
    rows = [[html.Cell(c), html.Cell(f"{h.before[c]:.4g}"), html.Cell(f"{h.after[c]:.4g}")] for c in h.before]
    return [html.Paragraph(h.describe()), html.Table([html.Cell(title) for title in ("Component", "RMS before", "RMS after")], rows)]


def _detectable(d: Diagnosis) -> list[html.Block]:
    rows = [[html.Cell(name, is_code=True), html.Cell(f"{size:.3g}{unit_of(name)}")] for name, size in d.detectable_sizes.items()]
    return (
        [html.Table([html.Cell("Cause"), html.Cell("Smallest size that this drive would show (3 sigma, all else within tolerance)")], rows)]
        if rows
        else []
    )


def _discrepancy_svg(found: DiagnosisResult) -> str:
    """Each component window by window: as found, once corrected, and the band of noise."""
    assert found.predictor is not None
    assert found.residuals is not None
    r = found.residuals
    owner = found.predictor.batch.owner
    seconds = found.predictor.drive.starts_s[owner]
    shown = [c for c in range(_MAX_PANELS) if np.isfinite(r.rows[:, c]).any()]

    def draw(figure: Canvas) -> None:
        panels = np.atleast_1d(figure.subplots(len(shown), 1, sharex=True))
        for axes, c in zip(panels, shown, strict=True):
            _band(axes, seconds, 2.0 * r.sigmas[:, c])
            axes.plot(seconds, r.rows[:, c], ".", color=html.COLOURS["red"], markersize=4.0)
            axes.plot(seconds, r.left[:, c], ".", color=html.COLOURS["blue"], markersize=3.0)
            axes.set_ylabel(f"{COMPONENTS[CHANNELS[c]]} [{CHANNEL_UNITS[c]}]")
        panels[-1].set_xlabel("time since the first window [s]" if found.diagnosis.windows and seconds.any() else "maneuver")

    return svg("discrepancy", html.WIDTH_IN, 1.35 * len(shown) + 0.5, draw)


def _dependence_svg(found: DiagnosisResult) -> str:
    """Each component against what the wheels did: distance and turn by their rates, before and after."""
    assert found.predictor is not None
    assert found.residuals is not None
    r = found.residuals
    driven, turned, _ = motion_in_windows(found.predictor)
    shown = [c for c in range(3) if np.isfinite(r.rows[:, c]).any()]

    def draw(figure: Canvas) -> None:
        panels = np.reshape(figure.subplots(len(shown), 2, sharex="col", sharey="row", squeeze=False), (len(shown), 2))
        for row, c in enumerate(shown):
            for axes, along in zip(panels[row], (driven, turned), strict=True):
                axes.plot(along, r.rows[:, c], ".", color=html.COLOURS["red"], markersize=4.0)
                axes.plot(along, r.left[:, c], ".", color=html.COLOURS["blue"], markersize=3.0)
            panels[row][0].set_ylabel(f"{COMPONENTS[CHANNELS[c]]} [{CHANNEL_UNITS[c]}]")
        panels[-1][0].set_xlabel("driven in the window [m]")
        panels[-1][1].set_xlabel("turned in the window [rad]")

    return svg("dependence", html.WIDTH_IN, 1.6 * len(shown) + 0.5, draw)


def _gain_svg(d: Diagnosis) -> str:
    """What each finding takes off the held-out discrepancy, with its interval."""

    def draw(figure: Canvas) -> None:
        axes = figure.add_subplot()
        for row, f in enumerate(d.findings):
            gain, low, high = (100.0 * v for v in (f.gain.relative, f.gain.low, f.gain.high))
            axes.barh(row, gain, height=0.5, color=html.COLOURS["green"])
            axes.plot([low, high], [row, row], color=html.COLOURS["ink"], linewidth=1.0)
        axes.set(
            yticks=range(len(d.findings)), yticklabels=[f.definition.label for f in d.findings], xlabel="held-out discrepancy taken off [%]"
        )
        axes.invert_yaxis()

    return svg("gain", html.WIDTH_IN, 0.4 * len(d.findings) + 0.7, draw)


def _band(axes: Axes, seconds: FloatArray, width: FloatArray) -> None:
    axes.fill_between(seconds, -width, width, facecolor=html.COLOURS["band"], edgecolor="none", zorder=0.5)
    axes.axhline(0.0, color=html.COLOURS["soft"], linewidth=0.6, zorder=0.6)
