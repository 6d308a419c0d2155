"""Figures of reports, by matplotlib without pyplot's state, as SVG that takes its colours from the page.

The same data give the same bytes: no date, no random names. `localization.report.runs` prepares the data. No other module imports
matplotlib.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse as EllipsePatch
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from localization.evaluation.consistency import mean_band
from localization.report.page import COLOURS, WIDTH_IN, for_page
from localization.report.runs import MapPlane, NisMeans, PlottedRun, RelationBins, Timeline, raster, thin_path, thin_series

__all__ = [
    "Axes",
    "Figure",
    "map_svg",
    "nis_svg",
    "overview",
    "picture",
    "plain_logs",
    "plot_run",
    "relation_bins_svg",
    "svg",
    "timeline_svg",
]

_STYLE = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.edgecolor": COLOURS["soft"],
    "axes.labelcolor": COLOURS["ink"],
    "axes.titlesize": 9.0,
    "axes.titlecolor": COLOURS["ink"],
    "axes.titlelocation": "left",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": COLOURS["rule"],
    "grid.linewidth": 0.5,
    "xtick.color": COLOURS["soft"],
    "ytick.color": COLOURS["soft"],
    "xtick.labelcolor": COLOURS["ink"],
    "ytick.labelcolor": COLOURS["ink"],
    "text.color": COLOURS["ink"],
    "lines.linewidth": 1.3,
    "lines.dash_capstyle": "butt",
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}

_PIXELS, _OVERVIEW_PIXELS = 900, 1100
"""Across the raster of a map."""
_OVERVIEW_IN = 10.0
"""Width of the overview [in]."""
_ASPECT = (0.35, 0.9)
"""Height by width of a map at least and at most: a narrower one is a ribbon, a taller one leaves the screen."""


def map_svg(lines: Sequence[PlottedRun], view: MapPlane) -> str:
    """Trajectories, reference and ellipses over the map, in metres of one length along both axes."""
    low, high = view.low, view.high
    extent = np.maximum(high - low, 1e-6)
    height = float(np.clip(extent[1] / extent[0], *_ASPECT)) * (WIDTH_IN - 0.7) + 0.6

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        _draw_map(axes, lines, view, _PIXELS)

    return svg("map", WIDTH_IN, height, draw)


def timeline_svg(lines: Sequence[PlottedRun], timelines: Sequence[Timeline]) -> str:
    """Errors over time, position above heading. ``timelines`` go with ``lines``."""
    has_heading = any(t.heading_deg is not None for t in timelines)
    rows = 2 if has_heading else 1

    def draw(figure: Figure) -> None:
        panels = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
        for line, timeline in zip(lines, timelines, strict=True):
            for axes, values in zip(panels, (timeline.position_m, timeline.heading_deg), strict=False):
                if values is not None and len(values):
                    kept = thin_series(values)
                    plot_run(axes, line, timeline.seconds[kept], values[kept])
        panels[0].set_ylabel("position error [m]")
        panels[0].set_ylim(bottom=0.0)
        if has_heading:
            panels[1].set_ylabel("heading error [deg]")
        panels[-1].set_xlabel("time since the first pose [s]")

    return svg("time", WIDTH_IN, 2.2 * rows + 0.4, draw)


def relation_bins_svg(lines: Sequence[PlottedRun], bins: Sequence[RelationBins]) -> str:
    """Mean error of relations against the time that they span, both axes logarithmic."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2)
        for line, span in zip(lines, bins, strict=True):
            for axes, values in zip(panels, (span.translation_m, span.rotation_deg), strict=True):
                plot_run(axes, line, span.seconds, np.maximum(values, 1e-6), marker="o", markersize=3.0)
        for axes, name in zip(panels, ("translation error [m]", "rotation error [deg]"), strict=True):
            axes.set(xscale="log", yscale="log", ylabel=f"mean {name}")
            plain_logs(axes)
            axes.set_xlabel("time from first to second pose [s]")

    return svg("spans", WIDTH_IN, 3.1, draw)


def nis_svg(lines: Sequence[PlottedRun], means: Sequence[NisMeans]) -> str:
    """Means of successive innovations' NIS over time, on a logarithmic axis, and the 95 % band of consistent ones."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        band = mean_band(means[0].group, 3)
        axes.axhspan(*band, facecolor=COLOURS["band"], edgecolor="none", zorder=0.5, gid="band")
        axes.axhline(3.0, color=COLOURS["soft"], linewidth=0.8, zorder=0.6)
        for line, mean in zip(lines, means, strict=True):
            plot_run(axes, line, mean.seconds, np.maximum(mean.mean, 1e-3))
        axes.set(
            yscale="log", xlabel="time since the first pose [s]", ylabel=f"NIS, means of {means[0].group}" if means[0].group > 1 else "NIS"
        )
        plain_logs(axes)

    return svg("nis", WIDTH_IN, 2.6, draw)


def overview(lines: Sequence[PlottedRun], view: MapPlane, measure: str, title: str) -> bytes:
    """A PNG: the trajectories over the map, beside one bar for each run with its headline error."""

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
        _draw_map(left, lines, view, _OVERVIEW_PIXELS)
        left.set_title(title)
        _draw_bars(right, lines, measure)

    extent = np.maximum(view.high - view.low, 1e-6)
    return picture(_OVERVIEW_IN, float(np.clip(extent[1] / extent[0], 0.5, 0.9)) * 6.0 + 0.7, draw)


def picture(width_in: float, height_in: float, draw: Callable[[Figure], None]) -> bytes:
    """A PNG on white of what ``draw`` puts on a figure of this size [in], in this module's style."""
    figure = _figure(width_in, height_in, draw)
    out = io.BytesIO()
    with _style("picture"):
        figure.savefig(out, format="png", dpi=150, facecolor="white", metadata={"Software": None})
    return out.getvalue()


def _draw_map(axes: Axes, lines: Sequence[PlottedRun], view: MapPlane, pixels: int) -> None:
    low, high = view.low, view.high
    resolution = float((high - low).max()) / pixels
    if len(view.points):
        image, extent = raster(view, resolution)
        axes.imshow(image, extent=extent, origin="upper", interpolation="none", aspect="equal", zorder=1)
    if view.reference is not None and len(view.reference):
        path = view.reference[thin_path(view.reference, resolution)]
        axes.plot(path[:, 0], path[:, 1], color=COLOURS["ink"], linewidth=0.9, zorder=2, gid="reference")
    for line, path in zip(lines, view.paths, strict=True):
        kept = path[thin_path(path, resolution)]
        # what is better lies on top
        order = 3.0 + 0.9 / (1.0 + view.ranks[line.number])
        plot_run(axes, line, kept[:, 0], kept[:, 1], zorder=order)
    if view.best is not None:
        colour = COLOURS[view.best.colour]
        for e in view.ellipses:
            axes.add_patch(
                EllipsePatch(
                    e.center,
                    2.0 * e.semi_axes[0],
                    2.0 * e.semi_axes[1],
                    angle=float(np.degrees(e.angle)),
                    facecolor=(colour, 0.10),
                    edgecolor=(colour, 0.9),
                    linewidth=0.6,
                    zorder=2.5,
                    gid=f"series-{view.best.number}",
                )
            )
    if view.start is not None:
        axes.plot(*view.start, marker="o", markersize=5.5, color=COLOURS["ink"], markerfacecolor="none", markeredgewidth=1.2, zorder=5)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.xaxis.set_major_locator(MaxNLocator(7))
    axes.yaxis.set_major_locator(MaxNLocator(7))


def _draw_bars(axes: Axes, lines: Sequence[PlottedRun], measure: str) -> None:
    scored = [line for line in lines if line.error is not None]
    for row, line in enumerate(scored):
        axes.barh(row, line.error or 0.0, height=0.55, color=COLOURS[line.colour], hatch="///" if line.dashes else None, edgecolor="white")
        axes.plot([0.0, 0.06], [row - 0.42] * 2, color=COLOURS[line.colour], dashes=_dashes(line), transform=axes.get_yaxis_transform())
        axes.text(0.08, row - 0.42, line.label, va="center", transform=axes.get_yaxis_transform())
        axes.annotate(f"{line.error:.3f}", (line.error or 0.0, row), xytext=(4, 0), textcoords="offset points", va="center")
    axes.set(
        xlabel=measure, ylim=(len(scored) - 0.5, -0.75), yticks=[], xlim=(0.0, 1.18 * max((x.error or 0.0 for x in scored), default=1.0))
    )
    axes.grid(visible=False, axis="y")
    axes.spines["left"].set_visible(False)


def plot_run(axes: Axes, line: PlottedRun, x: np.ndarray, y: np.ndarray, **more: object) -> None:
    """Draw ``y`` over ``x`` in the style of ``line``, which the page's legend hides and shows; ``more`` of matplotlib's keywords."""
    style: dict[str, object] = {"color": COLOURS[line.colour], "gid": f"series-{line.number}", **more}
    (drawn,) = axes.plot(x, y, **style)  # type: ignore[arg-type]  # matplotlib's keywords are typed one by one
    if line.dashes:
        drawn.set_dashes(line.dashes)


def _dashes(line: PlottedRun) -> tuple[float, ...]:
    return line.dashes or (1.0, 0.0)


def plain_logs(axes: Axes) -> None:
    """Decimal labels of a logarithmic axis: powers of ten, and 2 and 5 between them where these are few."""
    plain = FuncFormatter(lambda value, _: f"{value:,.0f}" if value >= 1 else f"{value:g}")
    between = FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
    for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
        if scale == "log":
            low, high = axis.get_view_interval()
            axis.set_major_formatter(plain)
            axis.set_minor_formatter(between if high < 50.0 * low else NullFormatter())


@contextlib.contextmanager
def _style(salt: str) -> Iterator[None]:
    """This module's style and nothing of the user's matplotlibrc."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update({**_STYLE, "svg.hashsalt": salt})  # type: ignore[dict-item]  # its keys are typed one by one
        yield


def _figure(width: float, height: float, draw: Callable[[Figure], None]) -> Figure:
    with _style("figure"):
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure)
    return figure


def svg(name: str, width: float, height: float, draw: Callable[[Figure], None]) -> str:
    """An SVG for a page, ``name`` unique in it, of what ``draw`` puts on a figure of this size [in], in this module's style."""
    figure = _figure(width, height, draw)
    out = io.StringIO()
    with _style(name):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return for_page(out.getvalue(), name)
