"""Colours of the report, and how an SVG of matplotlib's becomes a part of the page.

The colours are Okabe and Ito's ("Color universal design", 2008), which colour-blind readers can distinguish. In an SVG each colour
becomes ``var(--name, value)``: the page's style sheet decides for light, dark and paper, and the picture stands without one as well.
"""

from __future__ import annotations

import re

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
"""The same hues, light enough for a dark page."""


WIDTH_IN = 8.2
"""Of all figures of a page [in]: 9 pt letters have the size of the page's small text at its full width."""

_KEPT = ("series-", "reference", "band")


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
