"""One self-contained page that tells what a diagnosis found."""

from __future__ import annotations

from html import escape
from pathlib import Path

from localization.diagnosis.diagnose import Examined
from localization.report import _section, _write
from localization.report_page import style_sheet


def write_diagnosis_report(path: str | Path, found: Examined) -> None:
    """Write the page. Raises `OutputError` if there is such a file already or it cannot be written."""
    _write(path, diagnosis_page(found).encode())


def diagnosis_page(found: Examined) -> str:
    """The whole page."""
    d = found.diagnosis
    parts = [
        f"<h1>Diagnosis of {escape(d.log)}</h1>",
        f'<div class="verdict"><p><b>{escape(d.sentence)}</b></p></div>',
        _section("Next drive", escape(d.next_drive)),
    ]
    body = "\n".join(part for part in parts if part)
    return f"<!DOCTYPE html>\n<html><head><style>{style_sheet([])}</style></head><body><main>{body}</main></body></html>"
