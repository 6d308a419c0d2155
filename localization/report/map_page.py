"""The page of a saved map, and the picture of a grid: free space, walls, keyframes with their sigma, and the graph's loop closures."""

from __future__ import annotations

import base64
import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from localization.maps.export import png
from localization.maps.grid import Grid, draw_grid
from localization.maps.height_slice import HeightSlice
from localization.maps.keyframe_map import KeyframeMap
from localization.report import page as html
from localization.report.interactive import grid_layer, numbers
from localization.trajectory import IntArray
from motion_models.se2 import Points2

_RESOLUTION_M = 0.05
_MOST_CELLS = 4_000_000
"""Cells of a picture: 0.05 m for 100 m x 100 m; larger ones have larger cells."""
_ANOTHER_DRIVE_NS = 3_600_000_000_000
"""A time without keyframes between two drives of one map: an hour [ns]."""
_COLOURS = ("blue", "red", "green", "purple", "orange", "sky")
_MARK_M = 0.8
"""Least side of the square that marks a change [m]."""


def map_page(name: str, mapped: KeyframeMap, sentences: Sequence[str], provenance: Mapping[str, Any]) -> str:
    """HTML of the whole page of ``mapped``, in one file; one in space is seen from above, with walls of `height_slice.HEIGHTS_M`.

    Raises `MapError` where it has no points."""
    if mapped.is_in_space:
        upright = HeightSlice(mapped)
        planar, grid = upright.keyframes, upright.grid(_cell_of(mapped.points_in_map()[:, :2]))
    else:
        planar, grid = mapped, picture_grid(mapped)
    facts = f"{len(mapped.poses)} keyframes, {len(mapped.points)} points, {int(mapped.edge_is_loop.sum())} loop closures"
    known = {key: str(value) for key, value in provenance.items() if isinstance(value, (str, int, float))}
    sections = [
        html.Section("Explore", [html.Explorer(json.dumps(_explorer_data(planar, grid), separators=(",", ":"), allow_nan=False))]),
        html.Section("Grid", [grid_figure(grid)], is_static=True),
        html.Section("Where it comes from", [html.Definitions(known)] if known else []),
    ]
    return html.render(html.Page(f"Map {name}", facts, sentences, sections))


def picture_grid(mapped: KeyframeMap) -> Grid:
    """The grid of ``mapped`` with cells of 0.05 m, or larger ones where these were too many. Raises `MapError` without points."""
    return draw_grid(mapped, _cell_of(mapped.points_in_map()))


def _cell_of(points: Points2) -> float:
    """Side of the cells of a picture of ``points`` (N, 2) [m]."""
    area = float(np.prod(np.ptp(points, axis=0) + 1.0)) if len(points) else 1.0
    return _RESOLUTION_M * max(1.0, float(np.ceil(np.sqrt(area / _RESOLUTION_M**2 / _MOST_CELLS))))


def grid_figure(grid: Grid, changes: Sequence[Mapping[str, Any]] = ()) -> html.Figure:
    """``grid`` in metres of its frame, with a mark for each of ``changes`` (`kind`, `x`, `y`, `size_m`)."""
    height, width = (cells * grid.resolution for cells in grid.cells.shape)
    left, bottom = grid.origin
    marks = [
        f'<rect class="change-{change["kind"]}" x="{change["x"] - 0.5 * side:.2f}" y="{-change["y"] - 0.5 * side:.2f}" width="{side:.2f}" '
        f'height="{side:.2f}" fill="none" stroke="{"#D55E00" if change["kind"] == "new" else "#0072B2"}" stroke-width="0.2"/>'
        for change in changes
        for side in [max(float(change["size_m"]), _MARK_M)]
    ]
    svg = (
        f'<svg viewBox="{left:.2f} {-(bottom + height):.2f} {width:.2f} {height:.2f}">'
        f'<image x="{left:.2f}" y="{-(bottom + height):.2f}" width="{width:.2f}" height="{height:.2f}" style="image-rendering:pixelated" '
        f'href="{data_url(grid)}"/>{"".join(marks)}</svg>'
    )
    named = " Squares: walls that are new in this drive (orange) and gone (blue)." if marks else ""
    caption = f"White is free, black a wall, grey unknown; {width:.1f} m x {height:.1f} m, cells of {grid.resolution:g} m.{named}"
    return html.Figure(svg, "Occupancy grid of the map", caption)


def data_url(grid: Grid) -> str:
    """``grid`` as PNG inside a page."""
    return "data:image/png;base64," + base64.b64encode(png(grid)).decode()


def change_blocks(found: Mapping[str, Any]) -> list[html.Block]:
    """What of the map has changed, in a sentence, by ``found`` of `Run.localization`."""
    places = found.get("changes", ())
    if not places:
        return []
    share = 100.0 * float(found["changed_share"])
    listed = "; ".join(f"{p['kind']} at x {p['x']:.1f} m, y {p['y']:.1f} m ({p['size_m']:.1f} m)" for p in places)
    return [html.Paragraph(f"Of the saved map's walls that were measured, {share:.1f} % have changed: {listed}.")]


def _explorer_data(mapped: KeyframeMap, grid: Grid) -> dict[str, Any]:
    """The keyframes of each drive as a run whose loops are the loop closures, over the grid."""
    gaps = np.diff(mapped.stamps_ns)
    begins = np.r_[0, np.flatnonzero((gaps < 0) | (gaps > _ANOTHER_DRIVE_NS)) + 1, len(mapped.stamps_ns)]
    runs = [_drive(mapped, i, np.arange(first, last)) for i, (first, last) in enumerate(itertools.pairwise(begins.tolist()))]
    layer = grid_layer(grid, data_url(grid))
    borders = {"x": [layer["left"], layer["left"] + layer["width"]], "y": [layer["top"] - layer["height"], layer["top"]]}
    return {
        "runs": runs,
        "borders": borders,
        "reference": None,
        "map": {"x": [], "y": [], "run": ""},
        "grid": layer,
        "scans": [],
    }


def _drive(mapped: KeyframeMap, number: int, ids: IntArray) -> dict[str, Any]:
    seconds, poses = (mapped.stamps_ns[ids] - mapped.stamps_ns[ids[0]]) * 1e-9, mapped.poses[ids]
    own = [edge for edge in mapped.edges[mapped.edge_is_loop].tolist() if ids[0] <= max(edge) <= ids[-1]]
    return {
        "label": f"keyframes of drive {number + 1}",
        "number": number,
        "colour": _COLOURS[number % len(_COLOURS)],
        "dash": "solid",
        "t": numbers(seconds, 2),
        "x": numbers(poses[:, 0], 3),
        "y": numbers(poses[:, 1], 3),
        "heading": numbers(np.degrees(poses[:, 2]), 1),
        "way": numbers(np.r_[0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))], 2),
        "sigma": numbers(np.sqrt(np.trace(mapped.covariances[ids, :2, :2], axis1=1, axis2=2)), 4),
        "errors": None,
        "nis": None,
        "loops": [numbers([*mapped.poses[a, :2], *mapped.poses[b, :2], seconds[max(a, b) - ids[0]]], 2) for a, b in own],
        "lost": [],
        "faults": [],
        "parameters": {},
    }
