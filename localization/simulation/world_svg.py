"""A world from above, with what was driven in it, as SVG text: for READMEs and notebooks, where no plotting library is needed."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from localization.simulation.world import GLASS, World
from motion_models.se2 import FloatArray

_MARGIN_M = 0.5
_WALL, _GLASS, _PERSON, _PATCH, _PATH = "#222222", "#5aa9e6", "#e07a5f", "#bcd8ec", "#3a7d44"


def world_svg(world: World, paths: Iterable[FloatArray] = (), width_px: int = 800) -> str:
    """An <svg> of ``world``: walls, glass, people with their ways, patches of other floor, and ``paths`` (n, 2 or more) in metres."""
    ends = world.walls[:, :4].reshape(-1, 2)
    (x0, y0), (x1, y1) = ends.min(axis=0) - _MARGIN_M, ends.max(axis=0) + _MARGIN_M
    scale = width_px / (x1 - x0)
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{width_px}" height="{scale * (y1 - y0):.0f}">']
    parts.append('<rect width="100%" height="100%" fill="white"/>')

    def px(x: float, y: float) -> tuple[str, str]:
        return f"{scale * (x - x0):.1f}", f"{scale * (y1 - y):.1f}"

    for xa, ya, xb, yb, factor in world.patches:
        left, top = px(xa, yb)
        size = f'width="{scale * (xb - xa):.1f}" height="{scale * (yb - ya):.1f}"'
        parts.append(f'<rect x="{left}" y="{top}" {size} fill="{_PATCH}"><title>friction x {factor:g}</title></rect>')
    for xa, ya, xb, yb, kind in world.walls:
        (u0, v0), (u1, v1) = px(xa, ya), px(xb, yb)
        colour = _GLASS if kind == GLASS else _WALL
        parts.append(f'<line x1="{u0}" y1="{v0}" x2="{u1}" y2="{v1}" stroke="{colour}" stroke-width="2"/>')
    for xa, ya, xb, yb, _, radius in world.people:
        (u0, v0), (u1, v1) = px(xa, ya), px(xb, yb)
        parts.append(f'<line x1="{u0}" y1="{v0}" x2="{u1}" y2="{v1}" stroke="{_PERSON}" stroke-dasharray="4"/>')
        parts.append(f'<circle cx="{u0}" cy="{v0}" r="{scale * radius:.1f}" fill="{_PERSON}"/>')
    for path in paths:
        points = " ".join(",".join(px(float(x), float(y))) for x, y in np.asarray(path)[:, :2])
        parts.append(f'<polyline points="{points}" fill="none" stroke="{_PATH}" stroke-width="1.5"/>')
    return "\n".join([*parts, "</svg>"]) + "\n"
