"""The league's page: a table and a plot of errors for each log, what each system was given, and which system has the least error."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from math import hypot
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from localization.report.figures import svg
from tests.league.systems import System

_COLUMNS: Mapping[str, tuple[str, str]] = {
    "ate_m": ("ATE (relations: mean error) [m]", "{:.3f}"),
    "rpe_m": ("RPE over 10 m (relations: those under 20 s) [m]", "{:.3f}"),
    "crps_m": ("CRPS of a position axis [m]", "{:.4f}"),
    "anees": ("ANEES of the position (2 expected)", "{:.2f}"),
    "cpu_per_s": ("CPU [s per s of log]", "{:.4f}"),
    "memory_mb": ("memory [MB]", "{:.0f}"),
}
_MISSING = "<td>–</td>"  # noqa: RUF001
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1000px; margin: 2em auto; padding: 0 1em; color-scheme: light dark }
table { border-collapse: collapse; width: 100% }
th, td { padding: .3em .6em; text-align: right; border-bottom: 1px solid #8885 }
th:first-child, td:first-child { text-align: left; white-space: nowrap }
table.given td { text-align: left }
.best { font-weight: bold }
.scroll { overflow-x: auto }
svg { max-width: 100%; height: auto; background: #fff }
"""


def write(rows: Sequence[Mapping[str, Any]], systems: Sequence[System], out: Path) -> None:
    """Write league.html into ``out``."""
    logs = list(dict.fromkeys(row["log"] for row in rows))
    parts = [_log_section(log, [row for row in rows if row["log"] == log]) for log in logs]
    given = "".join(f"<tr><td>{html.escape(system.name)}</td><td>{html.escape(system.what)}</td></tr>" for system in systems)
    head = f"<meta charset=utf-8><meta name=viewport content='width=device-width'><title>League</title><style>{_STYLE}</style>"
    about = (
        "Each system with its own defaults on the same logs; peers also with the settings that were best on another log, named in the row;"
        " skidloc's are its defaults throughout. Errors by evo at the reference's instants; covariances by smfeval, with the"
        " reference's noise added; relations, which evo does not have, by skidloc. One drive is one sample."
    )
    table = f"<h2>What each system is given</h2><div class=scroll><table class=given>{given}</table></div>"
    text = f"<!doctype html><html lang=en>{head}<h1>League</h1><p>{about}</p>{''.join(parts)}{table}</html>"
    (out / "league.html").write_text(text)


def _log_section(log: str, rows: Sequence[Mapping[str, Any]]) -> str:
    scored = [row for row in rows if "ate_m" in row]
    floor = max((row.get("floor_m", 0.0) for row in scored), default=0.0)
    best = {key: hypot(min((row[key] for row in scored if key in row), default=0.0), floor) for key in ("ate_m", "rpe_m")}
    head = "".join(f"<th>{html.escape(title)}</th>" for title, _ in _COLUMNS.values())
    body = "".join(_table_row(row, best) for row in rows)
    noise = f" A pose of the reference is off by {floor:.3f} m itself: errors that differ by less, in squares, are ties." if floor else ""
    sentence = f"<p>{html.escape(_summary(scored) + noise)}</p>" if scored else ""
    plot = svg(f"league-{log}", 9.0, 4.5, lambda figure: _draw(figure.subplots(), scored))
    return f"<h2>{html.escape(log)}</h2>{sentence}<div class=scroll><table><tr><th>system</th>{head}</tr>{body}</table></div>{plot}"


def _summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """Which system has the least error, and where a peer is ahead of every row of skidloc."""
    first = min(rows, key=lambda row: row["ate_m"])
    parts = [f"Least error: {first['system']}, {first['ate_m']:.3f} m."]
    ours, peers = ([row for row in rows if _is_ours(row) == is_ours and row["system"] != "wheels"] for is_ours in (True, False))
    for key, (title, form) in _COLUMNS.items():
        own = min((row[key] for row in ours if key in row), default=None)
        if key == "anees" or own is None:
            continue
        if ahead := [f"{row['system']} {form.format(row[key])}" for row in peers if row.get(key, own) < own]:
            parts.append(f"Ahead of every estimator of skidloc ({form.format(own)}) in {title}: {', '.join(ahead)}.")
    return " ".join(parts)


def _is_ours(row: Mapping[str, Any]) -> bool:
    return str(row["system"]).startswith("skidloc")


def _table_row(row: Mapping[str, Any], best: Mapping[str, float]) -> str:
    name = html.escape(row["system"])
    if "failure" in row:
        return f"<tr><td>{name}</td><td colspan={len(_COLUMNS)} style='text-align:left'>{html.escape(row['failure'])}</td></tr>"
    cells = (
        _cell(form.format(row[key]), is_best=row[key] <= best.get(key, -1.0)) if key in row else _MISSING
        for key, (_, form) in _COLUMNS.items()
    )
    return f"<tr><td>{name}</td>{''.join(cells)}</tr>"


def _cell(text: str, *, is_best: bool) -> str:
    return f"<td class={'best' if is_best else 'value'}>{text}</td>"


def _draw(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    names = [row["system"] for row in rows][::-1]
    axes.barh(names, [row["ate_m"] for row in rows][::-1], color=["#2a6f97" if _is_ours(row) else "#b0b0b0" for row in rows[::-1]])
    axes.set_xscale("log")
    axes.set_xlabel("error [m], logarithmic")
    for index, row in enumerate(rows[::-1]):
        axes.annotate(f"{row['ate_m']:.3f}", (row["ate_m"], index), (4, 0), textcoords="offset points", va="center")
    axes.margins(x=0.15)
