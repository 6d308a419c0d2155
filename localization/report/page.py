"""Pages of all reports: blocks of text, tables and figures as data, and the templates (Jinja2) that make HTML of them.

A page loads nothing, and the same data gives the same bytes. All HTML is in ``templates/``; texts are escaped there. What is drawn in the
browser has a static figure beside it, for paper and browsers without scripts.

The colours are Okabe and Ito's ("Color universal design", 2008), which colour-blind readers can distinguish. In an SVG each colour becomes
``var(--name, value)``: the page's style sheet decides for light, dark and paper, and the picture can be shown without one as well.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import ClassVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from localization.errors import OutputError
from localization.report.charts import Chart, safe_json
from localization.report.runs import PlottedRun

COLOURS = {
    "ink": "#1c2024",
    "soft": "#5f6770",
    "rule": "#d4d8dc",
    "band": "#cfe3d6",
    "blue": "#0072b2",
    "red": "#d55e00",
    "purple": "#cc79a7",
    "green": "#009e73",
    "orange": "#e69f00",
    "sky": "#56b4e9",
    "grey": "#7d848b",
}
"""By role or name, for white paper."""

DARK_COLOURS = {
    **COLOURS,
    "ink": "#e6e9ec",
    "soft": "#a2aab2",
    "rule": "#363c43",
    "band": "#1d4030",
    "blue": "#56b4e9",
    "red": "#f0883e",
    "purple": "#e29ac4",
    "green": "#2fc79a",
    "orange": "#f0e442",
    "sky": "#9ad7ff",
    "grey": "#98a0a8",
}
"""Colours of the series on a dark page: the same hues, lighter."""

WIDTH_IN = 8.2
"""Width of all figures of a page [in]: 9 pt letters have the size of the page's small text at its full width."""

_DRAWING_SCRIPTS = ("plotly-basic.min.js", "common.js")
_SCRIPTS = {"explorer": "explore.js", "live": "live.js", "chart": "charts.js"}
"""Script by the kind of block that it draws."""
_KEPT = ("series-", "reference", "band")
_PAPER = {"paper": "#ffffff", "card": "#f6f7f8", "accent": "#005a8c"}
_DARK_PAPER = {"paper": "#14171a", "card": "#1d2125", "accent": "#7cc4f5"}


@dataclass(frozen=True)
class Cell:
    """One cell of a table."""

    text: str = ""
    note: str = ""
    """Second line, small."""
    is_bold: bool = False
    is_code: bool = False
    is_words: bool = False
    """Aligned left among numbers."""
    power: str | None = None
    """Exponent of a power of ten that the text is multiplied by."""
    badge: str = ""
    swatch: PlottedRun | None = None
    """The run whose line style stands before the text."""
    mark: str = ""
    """Colour's name of a dot before the text."""
    link: str = ""
    """Relative address of the page that the text names."""
    bar: tuple[float, str] | None = None
    """Length (0 to 1) and colour's name of a bar below the text."""


Row = Sequence[Cell]


@dataclass(frozen=True)
class Table:
    """A table, folded away if it has a summary."""

    kind: ClassVar[str] = "table"
    header: Row
    rows: Sequence[Row]
    summary: str = ""
    """Title under which the table is folded away; "" to show it."""
    is_text: bool = False
    """Words and not numbers: aligned left, and wrapped."""
    is_sortable: bool = False
    """Sorted by a click on a title, and filtered by words, where scripts run."""


@dataclass(frozen=True)
class ListItem:
    """One entry of a list."""

    text: str
    name: str = ""
    """Bold, before the text."""


@dataclass(frozen=True)
class Bullets:
    """A list."""

    kind: ClassVar[str] = "bullets"
    items: Sequence[ListItem]
    summary: str = ""
    """Title under which the list is folded away; "" to show it."""

    @classmethod
    def of(cls, texts: Sequence[str], summary: str = "") -> Bullets:
        """A list of plain texts."""
        return cls([ListItem(text) for text in texts], summary)


@dataclass(frozen=True)
class Paragraph:
    """A paragraph of text."""

    kind: ClassVar[str] = "paragraph"
    text: str
    is_small: bool = False


@dataclass(frozen=True)
class Definitions:
    """Names and their values or explanations."""

    kind: ClassVar[str] = "definitions"
    entries: Mapping[str, str]
    is_glossary: bool = False


@dataclass(frozen=True)
class LegendItem:
    """A run's line style, or a symbol with a text."""

    run: PlottedRun | None = None
    has_box: bool = False
    """A box that hides the run in all figures."""
    symbol: str = ""
    """Style: ring, dots, rule."""
    colour: str = ""
    text: str = ""


@dataclass(frozen=True)
class Figure:
    """A picture with legend and caption."""

    kind: ClassVar[str] = "figure"
    svg: str
    title: str
    """For screen readers."""
    caption: str
    legend: Sequence[LegendItem] = ()

    @property
    def picture(self) -> Markup:
        """The SVG as an element of the page."""
        title = Markup.escape(self.title)
        return Markup(self.svg.replace("<svg", f'<svg class="picture" role="img" aria-label="{title}"', 1))


@dataclass(frozen=True)
class Explorer:
    """Map and time series that one can zoom, hover over, and walk through by a time slider, drawn by Plotly in the browser."""

    kind: ClassVar[str] = "explorer"
    json: str

    @property
    def data(self) -> Markup:
        """The JSON, safe inside a script element."""
        return safe_json(self.json)


@dataclass(frozen=True)
class Live:
    """Map and time series of an estimator that runs, by events of the page's server (`localization.ros.dashboard`)."""

    kind: ClassVar[str] = "live"


Block = Table | Bullets | Paragraph | Definitions | Figure | Explorer | Live | Chart


@dataclass(frozen=True)
class Section:
    """Left out where it has no blocks."""

    title: str
    blocks: Sequence[Block]
    is_static: bool = False
    """For paper and browsers without scripts: an `Explorer` shows the same."""

    @property
    def style(self) -> str:
        """Class of the element: "drawn" where there is nothing on paper."""
        return "static" if self.is_static else "drawn" if all(block.kind in _SCRIPTS for block in self.blocks) else ""


@dataclass(frozen=True)
class Page:
    """Contents of a whole page."""

    title: str
    facts: str
    """One line below the title."""
    sentences: Sequence[str]
    """The summary, most important sentence first."""
    sections: Sequence[Section]
    hideable: Sequence[int] = field(default=())
    """Numbers of runs that a box in a legend can hide."""

    @property
    def scripts(self) -> Sequence[Markup]:
        """Scripts of what is drawn in the browser, Plotly's basic bundle (MIT) before them: the page needs no network."""
        blocks = [block for section in self.sections for block in section.blocks]
        drawn = [script for kind, script in _SCRIPTS.items() if any(block.kind == kind for block in blocks)]
        names = [*_DRAWING_SCRIPTS, *drawn] if drawn else []
        if any(isinstance(block, Table) and block.is_sortable for block in blocks):
            names.append("tables.js")
        folder = files("localization.report") / "templates"
        return [Markup((folder / name).read_text(encoding="utf-8")) for name in names]

    @property
    def is_live(self) -> bool:
        """Whether a block takes events from the page's own server."""
        return any(block.kind == "live" for section in self.sections for block in section.blocks)

    def without_scripts(self) -> Page:
        """For paper and mail: figures in place of charts."""
        sections = []
        for section in self.sections:
            blocks = [block for block in section.blocks if block.kind not in _SCRIPTS]
            plain = [replace(block, is_sortable=False) if isinstance(block, Table) else block for block in blocks]
            sections.append(replace(section, blocks=plain, is_static=False))
        return replace(self, sections=sections)


def glossary(terms: Mapping[str, str]) -> Section:
    """How to read a report."""
    return Section("How to read this", [Definitions(terms, is_glossary=True)])


def bullets(texts: Sequence[str], summary: str = "") -> list[Block]:
    """No block where there is no text."""
    return [Bullets.of(texts, summary)] if texts else []


def render(page: Page) -> str:
    """HTML of ``page``."""
    template = _environment().get_template("page.html")
    return template.render(page=page, light={**_PAPER, **COLOURS}, dark={**_DARK_PAPER, **DARK_COLOURS}).lstrip() + "\n"


@functools.cache
def _environment() -> Environment:
    """Keeps the templates that it has compiled."""
    return Environment(
        loader=PackageLoader("localization.report"), autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
    )


def write_new(path: str | Path, content: bytes) -> None:
    """Raises `OutputError` if there is such a file already or it cannot be written."""
    try:
        with open(path, "xb") as file:
            file.write(content)
    except FileExistsError as error:
        raise OutputError(f"'{path}' exists already. Remove it or choose another name.") from error
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror}.") from error


def for_page(svg: str, name: str) -> str:
    """An SVG element to stand among others in a page: no prologue, no size, ids of its own, short numbers, the page's colours.

    Groups whose id begins with ``series-`` (or is ``reference`` or ``band``) carry it as a class, for the page to hide or style.
    """
    svg = svg[svg.index("<svg") :].strip()
    svg = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg).replace("xlink:href", "href")
    head, body = svg.split(">", 1)
    svg = re.sub(r' (height|width|version)="[^"]*"', "", head) + ">" + body
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', svg))
    svg = re.sub(r' id="([^"]*)"', lambda found: _identity(found[1], used, name), svg)
    svg = re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", svg)
    svg = re.sub(r"(?<=[ ML\"])-?\d+\.\d{3,}", lambda found: f"{float(found[0]):.2f}".rstrip("0").rstrip("."), svg)
    for colour, value in COLOURS.items():
        svg = svg.replace(value, f"var(--{colour}, {value})")
    return re.sub(r"\n\s*", "\n", svg)


def _identity(identity: str, used: set[str], name: str) -> str:
    if identity in used:
        return f' id="{name}-{identity}"'
    return f' class="{identity}"' if identity.startswith(_KEPT) else ""
