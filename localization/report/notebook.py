"""Figures and tables of the notebooks: data in, one style, no computation.

Colours are names of `localization.report.page.COLOURS` (Okabe and Ito's); markers and dashes distinguish them in grey.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from localization.evaluation.references import ReferenceTrack, Relations
from localization.evaluation.scores import Result
from localization.report import figures
from localization.report.figures import Axes, Figure
from localization.report.page import COLOURS
from localization.report.runs import map_view, plotted_runs

CYCLE = ("blue", "red", "green", "purple", "orange", "sky", "grey", "ink")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
_WIDTH_IN = 8.2

Place = Literal["best", "upper left", "upper right", "lower left", "lower right", "lower center", "upper center", "center right"]


@dataclass(frozen=True, eq=False)
class Series:
    """Points, or a line through them."""

    label: str
    """In the legend; empty for none."""
    x: ArrayLike
    y: ArrayLike
    colour: str = "blue"
    marker: str = ""
    dashes: tuple[float, ...] | None = ()
    """Dashes of the line: () solid, None no line."""
    sigma: ArrayLike | None = None
    """Half length of the error bars."""
    below: ArrayLike | None = None
    above: ArrayLike | None = None
    """Borders of a band about the line."""


@dataclass(frozen=True, eq=False)
class Panel:
    """One pair of axes."""

    x_label: str
    y_label: str
    series: Sequence[Series]
    title: str = ""
    is_map: bool = False
    """One metre is as long along x as along y."""
    whole_x: bool = False
    """x counts things: its ticks are whole numbers."""
    log_x: bool = False
    log_y: bool = False
    band: tuple[float, float] | None = None
    """Lowest and highest consistent y, shaded between."""
    level: float | None = None
    """A thin horizontal line."""
    moments: Mapping[str, float] = field(default_factory=dict)
    """Thin vertical lines at x, by what happens there."""
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    legend: Place | None = "best"
    """None for no legend."""


@dataclass(frozen=True, eq=False)
class Bars:
    """Horizontal bars, one for each name in every group."""

    x_label: str
    names: Sequence[str]
    groups: Mapping[str, ArrayLike]
    """Label in the legend -> one value for each name."""
    title: str = ""
    pattern: str = "{:.3g}"
    level: float | None = None
    """A thin vertical line."""
    colours: Sequence[str] = CYCLE
    legend: Place = "best"
    room: float = 0.14
    """Margin beyond the longest bar, as a fraction of it."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A PNG that a notebook shows."""

    png: bytes

    def _repr_png_(self) -> bytes:
        return self.png

    def __repr__(self) -> str:
        return "a picture"

    def save(self, path: str | Path) -> None:
        """Write the PNG."""
        Path(path).write_bytes(self.png)


@dataclass(frozen=True)
class NotebookTable:
    """Rows that a notebook shows, and a console prints."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{escape(cell)}</th>" for cell in self.header)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in self.rows)
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

    def __repr__(self) -> str:
        widths = [max(len(cell) for cell in column) for column in zip(self.header, *self.rows, strict=True)]
        return "\n".join(
            "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in (self.header, *self.rows)
        )


def table(header: Sequence[str], *rows: Sequence[object]) -> NotebookTable:
    """Numbers to four digits; None and NaN as a dash."""
    return NotebookTable(tuple(header), tuple(tuple(_cell(cell) for cell in row) for row in rows))


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, float | np.floating):
        return f"{float(value):.4g}"
    return str(value)


def picture(*panels: Panel | Bars, columns: int = 2, row_in: float = 3.1, width_in: float = _WIDTH_IN) -> Picture:
    """The panels row by row, each row ``row_in`` inches high."""
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, panel in itertools.zip_longest(grid, panels):
            if panel is None:
                axes.set_axis_off()
            elif isinstance(panel, Bars):
                _draw_bars(axes, panel)
            else:
                _draw_panel(axes, panel)

    return Picture(figures.picture(width_in, rows * row_in, draw))


def trajectories(results: Sequence[Result], reference: ReferenceTrack | Relations | None, title: str) -> Picture:
    """Trajectories over the map, beside one bar for each run with its headline error."""
    lines = plotted_runs(results)
    measure = "mean error of the relations [m]" if isinstance(reference, Relations) else "position error, ATE [m]"
    return Picture(figures.overview(lines, map_view(lines, reference), measure, title))


def _draw_panel(axes: Axes, panel: Panel) -> None:
    if panel.band is not None:
        axes.axhspan(*panel.band, facecolor=COLOURS["band"], edgecolor="none", zorder=0.5)
    if panel.level is not None:
        axes.axhline(panel.level, color=COLOURS["soft"], linewidth=0.8, zorder=0.6)
    for name, at in panel.moments.items():
        axes.axvline(at, color=COLOURS["soft"], linewidth=0.8, linestyle=(0, (1, 1)), zorder=0.6)
        axes.text(at, 1.0, f" {name}", transform=axes.get_xaxis_transform(), va="top", color=COLOURS["soft"], fontsize=8.0)
    for series in panel.series:
        _draw_series(axes, series)
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label, title=panel.title)
    if panel.log_x:
        axes.set_xscale("log")
    else:
        axes.locator_params(axis="x", nbins=6, integer=panel.whole_x)
    if panel.log_y:
        axes.set_yscale("log")
    if panel.is_map:
        axes.set_aspect("equal", adjustable="datalim")
    if panel.x_range is not None:
        axes.set_xlim(*panel.x_range)
    if panel.y_range is not None:
        axes.set_ylim(*panel.y_range)
    figures.plain_logs(axes)
    if panel.legend is not None and any(s.label for s in panel.series):
        axes.legend(fontsize=8.0, frameon=True, framealpha=0.8, edgecolor="none", handlelength=2.2, loc=panel.legend)


def _draw_series(axes: Axes, series: Series) -> None:
    x, y, colour = np.asarray(series.x, dtype=float), np.asarray(series.y, dtype=float), COLOURS[series.colour]
    if series.below is not None and series.above is not None:
        axes.fill_between(x, np.asarray(series.below), np.asarray(series.above), color=colour, alpha=0.18, linewidth=0.0)
    dashes = series.dashes
    style: dict[str, Any] = {"color": colour, "marker": series.marker, "markersize": 4.0, "linestyle": "none" if dashes is None else "-"}
    if series.sigma is None:
        (line,) = axes.plot(x, y, label=series.label or None, **style)
    else:
        line, *_ = axes.errorbar(x, y, np.asarray(series.sigma), label=series.label or None, elinewidth=0.8, capsize=0.0, **style)
    if dashes:
        line.set_dashes(dashes)


def _draw_bars(axes: Axes, bars: Bars) -> None:
    each = 0.8 / len(bars.groups)
    rows = np.arange(len(bars.names))
    hatches = (None, "///", "...", "xxx")
    for i, (label, values) in enumerate(bars.groups.items()):
        at, width = rows - 0.4 + (i + 0.5) * each, np.asarray(values, dtype=float)
        colour = COLOURS[bars.colours[i % len(bars.colours)]]
        axes.barh(at, width, height=0.9 * each, color=colour, hatch=hatches[i % 4], edgecolor="white", label=label)
        for row, value in zip(at, width, strict=True):
            if math.isfinite(value):
                axes.annotate(bars.pattern.format(value), (value, row), (3, 0), textcoords="offset points", va="center", fontsize=8.0)
    if bars.level is not None:
        axes.axvline(bars.level, color=COLOURS["soft"], linewidth=0.8)
    axes.set(xlabel=bars.x_label, title=bars.title, yticks=rows, yticklabels=bars.names, ylim=(len(rows) - 0.5, -0.5))
    axes.margins(x=bars.room)
    axes.grid(visible=False, axis="y")
    if len(bars.groups) > 1:
        axes.legend(fontsize=8.0, frameon=True, framealpha=0.8, edgecolor="none", loc=bars.legend)
