"""One self-contained page that tells what a diagnosis found: the sentence first, then the proof, then what to drive next."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from localization import plots
from localization.diagnosis.diagnose import Examined
from localization.diagnosis.findings import Diagnosis
from localization.report import _figure, _section, _write
from localization.report_diagnosis_plots import dependence_svg, discrepancy_svg, gain_svg
from localization.report_page import style_sheet
from localization.report_tables import _table

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
    _write(path, diagnosis_page(found).encode())


def diagnosis_page(found: Examined) -> str:
    """The whole page."""
    d = found.diagnosis
    parts = [
        f"<h1>Diagnosis of {escape(d.log)}</h1>",
        f'<p class="facts">{escape(d.robot)} · model {escape(d.model)} · held against {escape(d.witness)} · {d.windows:,} windows</p>',
        f'<div class="verdict"><p><b>{escape(d.sentence)}</b></p><p>{_VERDICTS[d.verdict]}</p></div>',
        _section("Findings", _findings(d)),
        _section("Next drive", f"<p>{escape(d.next_drive)}</p>" if d.next_drive else ""),
    ]
    if found.residuals is not None:
        legend = '<p><small><b style="color:var(--red)">●</b> as found &nbsp; <b style="color:var(--blue)">●</b> once corrected</small></p>'
        over_time = [discrepancy_svg(found, size) for size in (plots.WIDE, plots.NARROW)]
        by_motion = [dependence_svg(found, size) for size in (plots.WIDE, plots.NARROW)]
        parts += [
            _section(
                "Discrepancies over time",
                legend + _figure("", over_time, "Discrepancies over time", "Measured minus predicted; the band is two sigmas of noise."),
            ),
            _section("Discrepancies by motion", legend + _figure("", by_motion, "Discrepancies by motion", "One point for each window.")),
            _section("Components", _components(d)),
        ]
    if d.findings:
        gains = [gain_svg(d, size) for size in (plots.WIDE, plots.NARROW)]
        caption = "Each finding beside all others; the line is its 95 % interval, by bootstrap over blocks of windows."
        parts.append(_section("Held-out gain", _figure("", gains, "Held-out gain of each finding", caption)))
    left = "".join(f"<li>{escape(s.text)}</li>" for s in d.shapes)
    parts += [
        _section("Left unexplained", f"<ul>{left}</ul>" if left else ""),
        _section("What this drive would show", _visible(d)),
        _section("About the log", "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in d.notes) + "</ul>" if d.notes else ""),
        _section("How to read this", '<dl class="terms">' + "".join(f"<dt>{t}</dt><dd>{x}</dd>" for t, x in _TERMS) + "</dl>"),
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>Diagnosis of {escape(d.log)}</title>\n<style>\n{style_sheet([])}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _findings(d: Diagnosis) -> str:
    if not d.findings:
        return ""
    rows = []
    for f in d.findings:
        unit = "" if f.effect.unit == "1" else f" {escape(f.effect.unit)}"
        others = ", ".join(f"{escape(name)} {size:+.3g}" for name, size in f.aliases) or "–"  # noqa: RUF001
        gain = f"{100 * f.gain.relative:.0f} % ({100 * f.gain.low:.0f} to {100 * f.gain.high:.0f})"
        words = f"<small>{escape(f.effect.meaning)}; {escape(f.evidence)}</small>"
        rows.append(_row(f"<code>{f.cause}</code><br>{words}", f"{f.size:+.4g} ± {f.sigma:.2g}{unit}", gain, f"{f.p_value:.1g}", others))
    return _table(_head("Cause", "Size", "Held-out gain", "p", "Or"), rows)


def _components(d: Diagnosis) -> str:
    rows = [
        _row(name, c.unit, f"{c.rms:.4g}", f"{c.expected_rms:.4g}", f"{c.left_rms:.4g}", f"{c.p_value:.2g}")
        for name, c in d.discrepancy.items()
    ]
    return _table(_head("Component", "Unit", "RMS", "Noise", "RMS once corrected", "p"), rows)


def _visible(d: Diagnosis) -> str:
    rows = [_row(f"<code>{name}</code>", f"{size:.3g}") for name, size in d.visible.items()]
    return _table(_head("Cause", "Smallest size that this drive would show (3 sigma)"), rows) if rows else ""


def _head(*cells: str) -> str:
    return "<tr>" + "".join(f'<th scope="col">{cell}</th>' for cell in cells) + "</tr>"


def _row(first: str, *cells: str) -> str:
    return f'<tr><th scope="row">{first}</th>' + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


__all__: Sequence[str] = ["diagnosis_page", "write_diagnosis_report"]
