"""Worlds to drive in: walls in plan view, pillars, glass, people who walk, and floors that are not everywhere the same."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motion_models.compiled import kernel, subroutine
from motion_models.se2 import FloatArray

OPAQUE, GLASS = 0.0, 1.0


def _none(columns: int) -> Callable[[], FloatArray]:
    return lambda: np.zeros((0, columns))


@dataclass(frozen=True, eq=False)
class World:
    """A floor plan. All walls go from the floor to the ceiling."""

    walls: FloatArray
    """(n, 5) segments x0, y0, x1, y1 [m] and their kind: 0 opaque, 1 glass."""
    people: FloatArray = field(default_factory=_none(6))
    """(k, 6) each walks to and fro from x0, y0 to x1, y1 [m] at a speed [m/s], as a cylinder of a radius [m]."""
    patches: FloatArray = field(default_factory=_none(5))
    """(k, 5) rectangles x0, y0, x1, y1 [m] of other floor, with a factor of the friction."""
    waves: FloatArray = field(default_factory=_none(4))
    """(n, 4) hills (`simulation.terrain`); none on level ground."""
    ceiling_m: float = math.inf
    """Height of the ceiling [m]; inf outdoors."""


def polygon(corners: FloatArray, kind: float = OPAQUE) -> FloatArray:
    """(n, 5) walls along the closed polygon of ``corners`` (n, 2)."""
    ends = np.roll(corners, -1, axis=0)
    return np.column_stack([corners, ends, np.full(len(corners), kind)])


def line(x0: float, y0: float, x1: float, y1: float, kind: float = OPAQUE) -> FloatArray:
    """(1, 5) one wall."""
    return np.array([[x0, y0, x1, y1, kind]])


def box(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    """(4, 5) the walls of a rectangle."""
    return polygon(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=float))


def pillar(x: float, y: float, radius: float = 0.2, sides: int = 8) -> FloatArray:
    """(sides, 5) a column."""
    angle = 2.0 * math.pi * (np.arange(sides) + 0.5) / sides
    return polygon(np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)]))


def hall() -> World:
    """20 x 14 m with pillars, the origin in its middle: room for open-loop drives."""
    walls = [
        box(-10, -7, 10, 7),
        pillar(-6, 4),
        pillar(6, 4.5),
        pillar(-5.5, -4.5),
        pillar(6.5, -4),
        box(-1, 6, 1, 7),
        box(8.5, -1, 10, 1.5),
    ]
    return World(np.concatenate(walls), ceiling_m=4.0)


def lab() -> World:
    """10 x 8 m with a few things along its walls, where rotations in place are measured."""
    walls = [box(-5, -4, 5, 4), pillar(3, 2.5), box(-5, -4, -3.5, -3), box(3.8, -2, 5, 0), box(-1, 3.3, 1.2, 4)]
    return World(np.concatenate(walls), ceiling_m=3.0)


def rooms() -> World:
    """Four rooms about a core, joined by doors, with furniture, a glass wall and two people: the place of `laps`."""
    outer = box(-8, -6, 8, 6)
    core = [box(-3, -2, 3, 2)]
    # each partition leaves a door of 1.8 m or more around the loop's path
    partitions = [
        line(0, 2, 0, 3.0),
        line(0, 5.0, 0, 6),
        line(0, -2, 0, -3.0),
        line(0, -5.0, 0, -6),
        line(3, 0, 4.4, 0, GLASS),
        line(6.6, 0, 8, 0),
        line(-3, 0, -4.4, 0),
        line(-6.6, 0, -8, 0),
    ]
    things = [pillar(7.2, 5.2, 0.25), pillar(-7.3, -5.3, 0.3), box(-8, 4.6, -6.9, 6), box(6.8, -6, 8, -4.9), pillar(-7.4, 2.0, 0.15)]
    glass = [line(-2.5, 5.9, -0.5, 5.9, GLASS)]
    people = np.array([[1.0, 5.4, 2.5, 5.4, 0.7, 0.25], [-7.3, -3.6, -7.3, -1.2, 0.5, 0.25]])
    return World(np.concatenate([outer, *core, *partitions, *things, *glass]), people=people, ceiling_m=2.8)


def corridor() -> World:
    """60 x 2.4 m, bare but for its ends: along it the ranges do not change."""
    return World(box(-2, -1.2, 58, 1.2), ceiling_m=2.5)


def slippery() -> World:
    """The hall with a wet patch in the middle, where friction falls to 0.35 of the floor's."""
    dry = hall()
    return World(dry.walls, patches=np.array([[1.0, -2.5, 4.0, 2.5, 0.35]]), ceiling_m=dry.ceiling_m)


def yard() -> World:
    """40 x 40 m outdoors: walls and trees far off, no ceiling, sky above for GPS."""
    trees = [pillar(x, y, 0.25) for x, y in ((-9, 7), (8, 9), (11, -6), (-7, -11), (3, 14), (-14, -2))]
    return World(np.concatenate([box(-20, -20, 20, 20), box(-20, 12, -14, 20), *trees]))


def hills() -> World:
    """60 x 60 m of grass with trees and a few walls; its waves are those of the experiment."""
    places = [(-12, 9), (9, 12), (14, -8), (-9, -13), (3, 17), (-17, -3), (17, 4), (-4, 13), (6, -14), (-15, 16), (20, 18), (-21, -18)]
    trees = [pillar(x, y, 0.25) for x, y in places]
    return World(np.concatenate([box(-30, -30, 30, 30), box(-20, 4, -18, 11), line(12, -18, 21, -13), *trees]))


WORLDS: dict[str, Callable[[], World]] = {
    "hall": hall,
    "lab": lab,
    "rooms": rooms,
    "corridor": corridor,
    "slippery": slippery,
    "yard": yard,
    "hills": hills,
}
"""Worlds by name."""


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


IntArray = NDArray[np.int64]
_GLASS_MIRRORS = 0.985  # glass returns a beam that hits it within 10 degrees of its normal, and lets others pass
_FAR = 1e9


class WallGrid(NamedTuple):
    """Wall segments, and which of them touch each cell."""

    x0: float
    y0: float
    cell: float
    columns: int
    rows: int
    first: IntArray
    """(rows * columns + 1,) where each cell's list begins in `items`."""
    items: IntArray
    walls: FloatArray
    """(n, 5) as `World.walls`."""


def make_grid(walls: FloatArray, cell: float = 0.5) -> WallGrid:
    """The grid of ``walls`` (n, 5), with cells of ``cell`` [m]."""
    if len(walls) == 0:
        return WallGrid(0.0, 0.0, 1.0, 1, 1, np.zeros(2, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 5)))
    ends = walls[:, :4].reshape(-1, 2)
    low, high = ends.min(axis=0) - 0.5 * cell, ends.max(axis=0) + 0.5 * cell
    columns, rows = (math.ceil(span / cell) for span in high - low)
    lists: list[list[int]] = [[] for _ in range(rows * columns)]
    for k, (xa, ya, xb, yb, _) in enumerate(walls):
        i0, i1 = sorted(int((x - low[0]) / cell) for x in (xa, xb))
        j0, j1 = sorted(int((y - low[1]) / cell) for y in (ya, yb))
        for j, i in itertools.product(range(j0, j1 + 1), range(i0, i1 + 1)):
            centre = low + cell * (np.array([i, j]) + 0.5)
            if _distance(centre[0], centre[1], xa, ya, xb, yb) <= 0.7072 * cell:
                lists[j * columns + i].append(k)
    first = np.concatenate([[0], np.cumsum([len(one) for one in lists])]).astype(np.int64)
    items = np.array([k for one in lists for k in one], dtype=np.int64)
    return WallGrid(float(low[0]), float(low[1]), cell, columns, rows, first, items, np.ascontiguousarray(walls))


@kernel
def cast(x: float, y: float, angle: float, longest: float, grid: WallGrid) -> float:
    """Distance to the first wall that returns the beam from ``x, y`` along ``angle``; inf if none does within ``longest`` [m]."""
    ux, uy = math.cos(angle), math.sin(angle)
    # Enter the grid.
    begin, end = 0.0, longest
    for axis in range(2):
        p, u = (x - grid.x0, ux) if axis == 0 else (y - grid.y0, uy)
        size = grid.cell * (grid.columns if axis == 0 else grid.rows)
        if abs(u) < 1e-12:
            if p < 0.0 or p > size:
                return math.inf
        else:
            a, b = -p / u, (size - p) / u
            begin, end = max(begin, min(a, b)), min(end, max(a, b))
    if begin > end:
        return math.inf
    px, py = (x + begin * ux - grid.x0) / grid.cell, (y + begin * uy - grid.y0) / grid.cell
    i, j = min(max(int(px), 0), grid.columns - 1), min(max(int(py), 0), grid.rows - 1)
    step_i, step_j = (1 if ux > 0.0 else -1), (1 if uy > 0.0 else -1)
    per_i = grid.cell / abs(ux) if abs(ux) > 1e-12 else _FAR
    per_j = grid.cell / abs(uy) if abs(uy) > 1e-12 else _FAR
    next_i = begin + ((i + 1 - px) if step_i > 0 else (px - i)) * per_i if per_i < _FAR else _FAR
    next_j = begin + ((j + 1 - py) if step_j > 0 else (py - j)) * per_j if per_j < _FAR else _FAR

    nearest = math.inf
    while True:
        cell = j * grid.columns + i
        for at in range(grid.first[cell], grid.first[cell + 1]):
            wall = grid.walls[grid.items[at]]
            ax, ay = wall[0] - x, wall[1] - y
            ex, ey = wall[2] - wall[0], wall[3] - wall[1]
            cross = ux * ey - uy * ex
            if cross == 0.0:
                continue
            t = (ax * ey - ay * ex) / cross
            s = (ax * uy - ay * ux) / cross
            if t <= 0.0 or t >= nearest or s < 0.0 or s > 1.0:
                continue
            if wall[4] == GLASS and abs(cross) < _GLASS_MIRRORS * math.sqrt(ex * ex + ey * ey):
                continue
            nearest = t
        leave = min(next_i, next_j)
        if nearest <= leave or leave > end:
            break
        if next_i < next_j:
            i, next_i = i + step_i, next_i + per_i
            if i < 0 or i >= grid.columns:
                break
        else:
            j, next_j = j + step_j, next_j + per_j
            if j < 0 or j >= grid.rows:
                break
    return nearest if nearest <= longest else math.inf


@subroutine
def cast_at_people(x: float, y: float, angle: float, t: float, people: FloatArray) -> float:
    """Distance to the nearest person at time ``t`` [s]; inf if the beam hits none."""
    ux, uy = math.cos(angle), math.sin(angle)
    nearest = math.inf
    for k in range(people.shape[0]):
        cx, cy = person_at(people[k], t)
        along = (cx - x) * ux + (cy - y) * uy
        across = (cx - x) * uy - (cy - y) * ux
        inside = people[k, 5] * people[k, 5] - across * across
        if along > 0.0 and inside > 0.0:
            nearest = min(nearest, max(along - math.sqrt(inside), 0.0))
    return nearest


@subroutine
def person_at(person: FloatArray, t: float) -> tuple[float, float]:
    """Where a person of `World.people` is at time ``t`` [s]."""
    ex, ey = person[2] - person[0], person[3] - person[1]
    length = max(math.sqrt(ex * ex + ey * ey), 1e-9)
    phase = (t * person[4] / length) % 2.0
    f = phase if phase < 1.0 else 2.0 - phase
    return person[0] + f * ex, person[1] + f * ey


@kernel
def clearance(x: float, y: float, walls: FloatArray) -> float:
    """Distance of ``x, y`` to the nearest wall [m]; inf without walls."""
    least = math.inf
    for k in range(walls.shape[0]):
        least = min(least, _distance(x, y, walls[k, 0], walls[k, 1], walls[k, 2], walls[k, 3]))
    return least


@kernel
def _distance(x: float, y: float, xa: float, ya: float, xb: float, yb: float) -> float:
    ex, ey = xb - xa, yb - ya
    square = ex * ex + ey * ey
    f = ((x - xa) * ex + (y - ya) * ey) / square if square > 0.0 else 0.0
    f = min(1.0, max(0.0, f))
    return math.sqrt((x - xa - f * ex) ** 2 + (y - ya - f * ey) ** 2)


@kernel
def cast_rays(origins: FloatArray, directions: FloatArray, longest: float, grid: WallGrid, ranges: FloatArray) -> None:
    """Fill ``ranges`` (n, r) of rays from ``origins`` (n, 3) along unit ``directions`` (n, r, 3): to the first wall, of any height."""
    for n in range(directions.shape[0]):
        for r in range(directions.shape[1]):
            dx, dy = directions[n, r, 0], directions[n, r, 1]
            flat = math.hypot(dx, dy)
            ranges[n, r] = cast(origins[n, 0], origins[n, 1], math.atan2(dy, dx), longest, grid) / max(flat, 1e-9)
