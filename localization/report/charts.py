"""Charts that a page draws in the browser: what is plotted as data, which `templates/charts.js` draws with Plotly.

A chart has named columns of numbers; each axis shows one of them, and where there are several to choose from, the page has a list.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

_DIGITS = 5
"""Significant digits of all numbers: more cannot be read off a chart."""

Axis = Sequence[tuple[str, str]]
"""Columns that an axis can show, the first at first: name of the column, and title with unit."""


@dataclass(frozen=True, eq=False)
class ChartSeries:
    """Points or a line; of a series without a column of its own for y, it is what the chart's y axis shows."""

    name: str
    """In the legend; empty for none."""
    colour: str
    """Name of a colour of `page.COLOURS`."""
    x: str = ""
    """Column; "" for what the chart's x axis shows."""
    y: str = ""
    group: str = ""
    """Begin of the names of its columns, where series of one chart have other rows."""
    panel: int = 0
    is_line: bool = False
    is_filled: bool = False
    """Fill the area that the line encloses."""
    size: float = 6.0
    symbol: str = "circle"
    """Name of a symbol of Plotly."""
    texts: Sequence[str] = ()
    """Shown for each point where the pointer is."""
    error: str = ""
    """Column with half the length of horizontal error bars."""
    colour_by: str = ""
    """Column whose numbers colour the points instead of ``colour``."""
    is_hidden: bool = False
    """Shown after a click on its name."""


@dataclass(frozen=True, eq=False)
class Chart:
    """One picture with zoom, hover and a legend that hides."""

    kind: ClassVar[str] = "chart"
    title: str
    x: Axis
    y: Axis
    """One entry for each panel; with ``is_y_chosen`` the columns to choose from in the only panel."""
    series: Sequence[ChartSeries]
    columns: Mapping[str, ArrayLike]
    is_y_chosen: bool = False
    height_px: int = 340
    x_type: str = "linear"
    """linear, log or category."""
    names: Sequence[str] = ()
    """Words for the whole numbers 0, 1, ... of the y axis, from the top."""
    is_map: bool = False
    """One metre is as long along x as along y."""
    has_diagonal: bool = False
    note: str = ""
    x_range: tuple[float, float] | None = None
    """At first; what lies outside is reached by zooming out."""

    @property
    def data(self) -> Markup:
        """The JSON of the chart, safe inside a script element."""
        return safe_json(json.dumps(self.content(), separators=(",", ":"), allow_nan=False))

    def content(self) -> dict[str, Any]:
        """What `templates/charts.js` draws."""
        return {
            "title": self.title,
            "x": [list(entry) for entry in self.x],
            "y": [list(entry) for entry in self.y],
            "series": [vars(s) | {"texts": list(s.texts)} for s in self.series],
            "columns": {name: short_numbers(values) for name, values in self.columns.items()},
            "is_y_chosen": self.is_y_chosen,
            "height_px": self.height_px,
            "x_type": self.x_type,
            "names": list(self.names),
            "is_map": self.is_map,
            "has_diagonal": self.has_diagonal,
            "x_range": None if self.x_range is None else list(self.x_range),
        }


def safe_json(text: str) -> Markup:
    """JSON that can stand inside a script element."""
    return Markup(text.replace("<", "\\u003c"))


def short_numbers(values: ArrayLike) -> list[float | None]:
    """Numbers of `_DIGITS` significant digits; what is not finite is null."""
    return [float(f"{v:.{_DIGITS}g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=float)]
