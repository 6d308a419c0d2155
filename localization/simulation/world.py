"""Worlds to drive in: walls seen from above, pillars, glass, people who walk, and floors that are not everywhere the same."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

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
    """60 x 2.4 m, bare but for its ends: along it a scanner sees nothing move."""
    return World(box(-2, -1.2, 58, 1.2), ceiling_m=2.5)


def slippery() -> World:
    """The hall with a wet patch in the middle, where friction falls to 0.35 of the floor's."""
    dry = hall()
    return World(dry.walls, patches=np.array([[1.0, -2.5, 4.0, 2.5, 0.35]]), ceiling_m=dry.ceiling_m)


def yard() -> World:
    """40 x 40 m outdoors: walls and trees far off, no ceiling, sky above for GPS."""
    trees = [pillar(x, y, 0.25) for x, y in ((-9, 7), (8, 9), (11, -6), (-7, -11), (3, 14), (-14, -2))]
    return World(np.concatenate([box(-20, -20, 20, 20), box(-20, 12, -14, 20), *trees]))


WORLDS: dict[str, Callable[[], World]] = {
    "hall": hall,
    "lab": lab,
    "rooms": rooms,
    "corridor": corridor,
    "slippery": slippery,
    "yard": yard,
}
"""Worlds by name."""
