"""Pictures of a comparison: each combination's mean over logs with its interval, and by how much the best one is smaller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from localization.comparison.statistics import Mean, by_combination
from localization.comparison.summary import Findings
from localization.report.figures import Axes, Figure, plain_logs, svg
from localization.report.svg import COLOURS, WIDTH_IN

_MARKERS = "osD^v"
_LOGARITHMIC = 8.0
_ROW_IN = 0.42


def means_svg(found: Findings, styles: Mapping[str, tuple[str, int]]) -> str:
    """A row for each combination, the best on top: a dot for each log, the mean and its 95 % interval. ``styles``: colour's name and
    number of the motion model, by name of the combination."""
    values = {name: np.array(list(table.values())) for name, table in by_combination(found.rows, found.metric).items()}

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for row, mean in enumerate(found.means):
            colour, model = styles[mean.name]
            axes.plot(values[mean.name], _spread(row, mean.n), ".", color=COLOURS[colour], alpha=0.45, markersize=4.0)
            _interval(axes, row, mean.mean, (mean.low, mean.high), colour, _MARKERS[model % len(_MARKERS)])
        everything = np.concatenate([values[mean.name] for mean in found.means])
        least, most = everything.min(), everything.max()
        if least > 0.0 and most > _LOGARITHMIC * least:
            axes.set(xscale="log", xlim=(least / 1.2, most * 1.2))
            plain_logs(axes)
        else:
            axes.set_xlim(min(0.0, 1.05 * least), 1.05 * most or 1.0)
        _rows(axes, [found.words[mean.name] for mean in found.means])
        axes.set_xlabel(_with_unit(found))

    return svg("means", WIDTH_IN, _ROW_IN * len(found.means) + 0.75, draw)


def gains_svg(found: Findings, others: Sequence[Mean], styles: Mapping[str, tuple[str, int]]) -> str:
    """By how much the best is smaller than each of ``others``, with 95 % intervals: those that reach 0 show nothing."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for row, mean in enumerate(others):
            d = found.against_best(mean.name)
            assert d is not None
            sign = 1.0 if d.better == found.best.name else -1.0
            low, high = sorted(100.0 * sign * part for part in (d.relative_low, d.relative_high))
            colour, model = styles[mean.name]
            _interval(axes, row, 100.0 * sign * d.relative, (low, high), colour, _MARKERS[model % len(_MARKERS)])
        axes.axvline(0.0, color=COLOURS["ink"], linewidth=0.9)
        _rows(axes, [f"than {found.words[mean.name]}" for mean in others])
        axes.set_xlabel(f"smaller by [%]: {found.measure} of {found.words[found.best.name]}")

    return svg("gains", WIDTH_IN, _ROW_IN * len(others) + 0.75, draw)


def _interval(axes: Axes, row: int, value: float, interval: tuple[float, float], colour: str, marker: str) -> None:
    axes.plot(interval, [row, row], color=COLOURS[colour], linewidth=2.0, solid_capstyle="butt")
    axes.plot(value, row, marker, color=COLOURS[colour], markersize=6.5, markeredgecolor=COLOURS["ink"], markeredgewidth=0.6)


def _rows(axes: Axes, names: Sequence[str]) -> None:
    axes.set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.4, -0.6))
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)


def _spread(row: int, n: int) -> np.ndarray:
    """Heights in a row, so that equal numbers do not hide each other."""
    return row + 0.24 * (np.arange(n) % 3 - 1.0)


def _with_unit(found: Findings) -> str:
    return f"{found.measure} [{found.unit}]" if found.unit else found.measure
