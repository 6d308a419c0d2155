"""Report of a diagnosis: the sentence, the findings, the drive that would separate them, discrepancies before and after correction."""

from __future__ import annotations

from pathlib import Path

from localization.diagnosis.diagnose import DiagnosisResult
from localization.diagnosis.findings import Diagnosis
from localization.diagnosis.summary import describe_outliers, describe_row, describe_tolerated
from localization.report.diagnosis_figures import dependence_svg, discrepancy_svg, gain_svg
from localization.report.page import Block, Cell, Figure, Page, Paragraph, Section, Table, bullets, glossary, render, write_new

_VERDICTS = {
    "consistent": "No discrepancy exceeds noise and tolerances; the table shows each component.",
    "explained": "Each discrepancy that exceeds its noise has a cause with a name.",
    "ambiguous": "The discrepancies are explained, but by more than one cause; this drive cannot separate them.",
    "unexplained": "The discrepancies have a part that no cause explains.",
    "undecidable": "This drive cannot show whether the model is right.",
}
_TERMS = {
    "Discrepancy": "What the reference measured in a window of the drive minus the model's prediction from the wheels in that window.",
    "Noise": "How large discrepancies without a cause are, estimated from this drive after everything that any cause could explain.",
    "p": "Probability that noise alone would make any of all causes look as strong as this one.",
    "Left": "What neither the findings nor causes within their tolerance account for.",
    "Gain": "How much smaller discrepancies become in windows that the cause's size was not fitted to.",
    "Or": "Causes that would explain the same drive about as well, each with the size that it would need.",
}


def write_diagnosis_report(path: str | Path, found: DiagnosisResult) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    write_new(path, diagnosis_page(found).encode())


def diagnosis_page(found: DiagnosisResult) -> str:
    """HTML of the whole page."""
    d = found.diagnosis
    sections = [
        Section("Findings", _findings(d)),
        Section("Components", _components(d)),
        Section("Next drive", [Paragraph(d.next_drive)] if d.next_drive else []),
        *_figures(found),
        Section("Corrected robot: before and after", _handover(d)),
        Section("Within tolerance", bullets(describe_tolerated(d))),
        Section("Contradictions", bullets(d.contradictions)),
        Section("Left unexplained", bullets([s.text for s in d.trends])),
        Section("What this drive would show", _detectable(d)),
        Section("About the log", bullets([*describe_outliers(d), *d.warnings])),
        glossary(_TERMS),
    ]
    facts = f"{d.robot} · model {d.model} · reference {d.motion_reference} · {d.windows:,} windows"
    return render(Page(f"Diagnosis of {d.log}", facts, [d.sentence, _VERDICTS[d.verdict]], sections))


def _figures(found: DiagnosisResult) -> list[Section]:
    """Discrepancies and gains, as far as there are any."""
    d, sections = found.diagnosis, []
    if found.residuals is not None:
        colours = "Red: as found; blue: once corrected."
        over_time = Figure(
            discrepancy_svg(found), "Discrepancies over time", f"Measured minus predicted. {colours} The band is two sigmas of noise."
        )
        by_motion = Figure(dependence_svg(found), "Discrepancies by motion", f"One point for each window. {colours}")
        sections += [
            Section("Discrepancies over time", [over_time]),
            Section("Discrepancies by motion", [by_motion]),
        ]
    if d.findings:
        caption = "Each finding beside all others; the line is its 95 % interval, by bootstrap over blocks of windows."
        sections.append(Section("Held-out gain", [Figure(gain_svg(d), "Held-out gain of each finding", caption)]))
    return sections


def _findings(d: Diagnosis) -> list[Block]:
    if not d.findings:
        return []
    rows = []
    for f in d.findings:
        unit = "" if f.definition.unit == "1" else f" {f.definition.unit}"
        others = ", ".join(f"{name} {size:+.3g}" for name, size in f.aliases) or "–"  # noqa: RUF001
        gain = f"{100 * f.gain.relative:.0f} % ({100 * f.gain.low:.0f} to {100 * f.gain.high:.0f})"
        cause = Cell(f.cause, f"{f.description}; {f.evidence}", is_code=True)
        rows.append([cause, Cell(f"{f.size:+.4g} ± {f.sigma:.2g}{unit}"), Cell(gain), Cell(f"{f.p_value:.1g}"), Cell(others)])
    return [Table([Cell(title) for title in ("Cause", "Size", "Held-out gain", "p", "Or")], rows)]


def _components(d: Diagnosis) -> list[Block]:
    rows = []
    for name, c in d.discrepancy.items():
        numbers = (f"{c.rms:.4g}", f"{c.expected_rms:.4g}", f"{c.unattributed_rms:.4g}", f"{c.p_value:.2g}")
        status = Cell(c.status, describe_row(c).removeprefix(c.status).strip(": "))
        rows.append([*(Cell(text) for text in (name, c.unit, *numbers)), status])
    return [Table([Cell(title) for title in ("Component", "Unit", "RMS", "Noise", "Left", "p", "Attributed to")], rows)]


def _handover(d: Diagnosis) -> list[Block]:
    if d.handover is None:
        return []
    h = d.handover
    rows = [[Cell(c), Cell(f"{h.before[c]:.4g}"), Cell(f"{h.after[c]:.4g}")] for c in h.before]
    return [Paragraph(h.describe()), Table([Cell(title) for title in ("Component", "RMS before", "RMS after")], rows)]


def _detectable(d: Diagnosis) -> list[Block]:
    rows = [[Cell(name, is_code=True), Cell(f"{size:.3g}")] for name, size in d.detectable_sizes.items()]
    return [Table([Cell("Cause"), Cell("Smallest size that this drive would show (3 sigma)")], rows)] if rows else []
