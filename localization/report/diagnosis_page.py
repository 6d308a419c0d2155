"""One self-contained page that tells what a diagnosis found: the sentence first, then the proof, then what to drive next."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from localization.diagnosis.diagnose import Examined
from localization.diagnosis.findings import Diagnosis
from localization.report import figures
from localization.report.diagnosis_figures import dependence_svg, discrepancy_svg, gain_svg
from localization.report.page import bullets, figure, glossary, html_page, opening, section, write_new
from localization.report.tables import header, row, table

_VERDICTS = {
    "consistent": "Wheels and witness agree within their noise.",
    "explained": "What they disagree about has a cause with a name.",
    "ambiguous": "What they disagree about is explained, but by more than one cause; this drive cannot tell them apart.",
    "unexplained": "They disagree in a way that no known cause explains.",
    "undecidable": "This drive cannot show what is right and what is wrong.",
}
_TERMS = (
    ("Discrepancy", "What the witness measured of a window of the drive, minus what the model makes of the wheels in the same window."),
    ("Noise", "How large discrepancies without a cause are, estimated from this drive after everything that any cause could explain."),
    ("p", "How probable it is that noise alone would make any of all causes look as strong as this one."),
    ("Gain", "How much smaller discrepancies become in windows that the cause's size was not fitted to."),
    ("Or", "Causes that would explain the same drive about as well, each with the size that it would need."),
)


def write_diagnosis_report(path: str | Path, found: Examined) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    write_new(path, diagnosis_page(found).encode())


def diagnosis_page(found: Examined) -> str:
    """The whole page."""
    d = found.diagnosis
    facts = f"{d.robot} · model {d.model} · held against {d.witness} · {d.windows:,} windows"
    parts = [
        *opening(f"Diagnosis of {d.log}", facts, [d.sentence, _VERDICTS[d.verdict]]),
        section("Findings", _findings(d)),
        section("Next drive", f"<p>{escape(d.next_drive)}</p>" if d.next_drive else ""),
    ]
    if found.residuals is not None:
        legend = '<p><small><b style="color:var(--red)">●</b> as found &nbsp; <b style="color:var(--blue)">●</b> once corrected</small></p>'
        over_time = [discrepancy_svg(found, size) for size in (figures.WIDE, figures.NARROW)]
        by_motion = [dependence_svg(found, size) for size in (figures.WIDE, figures.NARROW)]
        parts += [
            section(
                "Discrepancies over time",
                legend + figure("", over_time, "Discrepancies over time", "Measured minus predicted; the band is two sigmas of noise."),
            ),
            section("Discrepancies by motion", legend + figure("", by_motion, "Discrepancies by motion", "One point for each window.")),
            section("Components", _components(d)),
        ]
    if d.findings:
        gains = [gain_svg(d, size) for size in (figures.WIDE, figures.NARROW)]
        caption = "Each finding beside all others; the line is its 95 % interval, by bootstrap over blocks of windows."
        parts.append(section("Held-out gain", figure("", gains, "Held-out gain of each finding", caption)))
    parts += [
        section("Left unexplained", bullets(s.text for s in d.shapes)),
        section("What this drive would show", _visible(d)),
        section("About the log", bullets(d.warnings)),
        glossary(_TERMS),
    ]
    return html_page(f"Diagnosis of {d.log}", parts)


def _findings(d: Diagnosis) -> str:
    if not d.findings:
        return ""
    rows = []
    for f in d.findings:
        unit = "" if f.effect.unit == "1" else f" {escape(f.effect.unit)}"
        others = ", ".join(f"{escape(name)} {size:+.3g}" for name, size in f.aliases) or "–"  # noqa: RUF001
        gain = f"{100 * f.gain.relative:.0f} % ({100 * f.gain.low:.0f} to {100 * f.gain.high:.0f})"
        words = f"<small>{escape(f.effect.meaning)}; {escape(f.evidence)}</small>"
        rows.append(row(f"<code>{f.cause}</code><br>{words}", f"{f.size:+.4g} ± {f.sigma:.2g}{unit}", gain, f"{f.p_value:.1g}", others))
    return table(header("Cause", "Size", "Held-out gain", "p", "Or"), rows)


def _components(d: Diagnosis) -> str:
    rows = [
        row(name, c.unit, f"{c.rms:.4g}", f"{c.expected_rms:.4g}", f"{c.left_rms:.4g}", f"{c.p_value:.2g}")
        for name, c in d.discrepancy.items()
    ]
    return table(header("Component", "Unit", "RMS", "Noise", "RMS once corrected", "p"), rows)


def _visible(d: Diagnosis) -> str:
    rows = [row(f"<code>{name}</code>", f"{size:.3g}") for name, size in d.visible.items()]
    return table(header("Cause", "Smallest size that this drive would show (3 sigma)"), rows) if rows else ""


__all__: Sequence[str] = ["diagnosis_page", "write_diagnosis_report"]
