"""Office floors by recursive division: rooms, doors, furniture; drives through them; and the same floor after a part of it has changed."""

from __future__ import annotations

import itertools
import math
from collections import deque

import numpy as np

from tests.helpers.floor_plan import box

_STEP_M = 0.5
_CLEARANCE_M = 0.35
_DOOR_M = 1.1


def make_walls(rng: np.random.Generator, width: float = 24.0, height: float = 14.0) -> np.ndarray:
    """(W, 4) walls of one floor as x0, y0, x1, y1 [m]."""
    walls: list[tuple[float, float, float, float]] = list(box(0.0, 0.0, width, height))

    def divide(x0: float, y0: float, x1: float, y1: float) -> None:
        w, h = x1 - x0, y1 - y0
        if max(w, h) < rng.uniform(5.0, 8.0):
            for _ in range(rng.integers(0, 3)):
                a, b = rng.uniform(x0 + 0.3, max(x1 - 1.5, x0 + 0.4)), rng.uniform(y0 + 0.3, max(y1 - 1.5, y0 + 0.4))
                walls.extend(box(a, b, a + rng.uniform(0.4, 1.1), b + rng.uniform(0.4, 1.1)))
            return
        if w > h:
            x, door = rng.uniform(x0 + 0.35 * w, x0 + 0.65 * w), rng.uniform(y0 + 0.3, y1 - 0.3 - _DOOR_M)
            walls.extend([(x, y0, x, door), (x, door + _DOOR_M, x, y1)])
            divide(x0, y0, x, y1)
            divide(x, y0, x1, y1)
        else:
            y, door = rng.uniform(y0 + 0.35 * h, y0 + 0.65 * h), rng.uniform(x0 + 0.3, x1 - 0.3 - _DOOR_M)
            walls.extend([(x0, y, door, y), (door + _DOOR_M, y, x1, y)])
            divide(x0, y0, x1, y)
            divide(x0, y, x1, y1)

    divide(0.0, 0.0, width, height)
    return np.array(walls)


def make_equal_rooms(rng: np.random.Generator, n: int = 7, width: float = 4.0, depth: float = 4.0) -> np.ndarray:
    """(W, 4) walls of a corridor with ``n`` rooms that are equal to the last piece of furniture [m]: from the middle no end is in reach."""
    door, (x, y) = rng.uniform(0.4, width - 0.4 - _DOOR_M), rng.uniform([0.5, 2.8], [width - 1.4, 2.0 + depth - 1.2])
    walls: list[tuple[float, float, float, float]] = list(box(0.0, 0.0, n * width, 2.0 + depth))
    for left in width * np.arange(n):
        right = left + width
        walls += [(left, 2.0, left + door, 2.0), (left + door + _DOOR_M, 2.0, right, 2.0), (right, 2.0, right, 2.0 + depth)]
        walls += box(left + x, y, left + x + 0.7, y + 0.6)
    return np.array(walls)


def change(walls: np.ndarray, rng: np.random.Generator, share: float = 0.1) -> np.ndarray:
    """``walls`` (W, 4), of whose inner ones the ``share`` is changed: a third each moved by 0.3 to 1 m, removed, and added as boxes."""
    inner, rest = walls[4:].copy(), rng.permutation(len(walls) - 4)[: max(round(share * (len(walls) - 4)), 3)]
    moved, removed, added = np.array_split(rest, 3)
    for i in moved:
        inner[i] += np.tile(rng.uniform(0.3, 1.0) * np.array([math.cos(a := rng.uniform(0.0, 2.0 * math.pi)), math.sin(a)]), 2)
    places = walls[:4].max(axis=0)[:2] - 2.0
    boxes = [box(x, y, x + 0.8, y + 0.8) for x, y in rng.uniform(1.0, places, size=(len(added), 2))]
    return np.vstack([walls[:4], np.delete(inner, removed, axis=0), *boxes])


def drive(walls: np.ndarray, rng: np.random.Generator, n: int, obstacles: np.ndarray | None = None) -> np.ndarray:
    """(n, 3) poses every 0.5 m of a drive between random places, clear of ``walls`` and ``obstacles``."""
    free = _free(walls if obstacles is None else np.vstack([walls, obstacles]))
    cells = list(map(tuple, np.argwhere(free)))
    here, poses = cells[rng.integers(len(cells))], []
    while len(poses) < n:
        way = _way(free, here, cells[rng.integers(len(cells))])
        points = _STEP_M * np.array(way, dtype=float)
        poses += [(*b, math.atan2(*(b - a)[::-1])) for a, b in itertools.pairwise(points)]
        here = way[-1]
    return np.array(poses[:n])


def _free(walls: np.ndarray) -> np.ndarray:
    """Grid of 0.5 m: nodes that are clear of all walls, and in one piece with most others."""
    n = np.ceil(walls[:, :2].max(axis=0) / _STEP_M).astype(int)
    nodes = _STEP_M * np.stack(np.meshgrid(np.arange(n[0]), np.arange(n[1]), indexing="ij"), axis=-1)[..., None, :]
    a, b = walls[:, :2], walls[:, 2:] - walls[:, :2]
    t = np.clip(((nodes - a) * b).sum(axis=-1) / np.maximum((b**2).sum(axis=-1), 1e-9), 0.0, 1.0)[..., None]
    clear = np.hypot(*np.moveaxis(nodes - a - t * b, -1, 0)).min(axis=-1) > _CLEARANCE_M
    best = np.zeros_like(clear)
    for start in map(tuple, np.argwhere(clear)):
        if best[start] or not clear[start]:
            continue
        piece = np.zeros_like(clear)
        for node in _reach(clear, start):
            piece[node] = True
        best = piece if piece.sum() > best.sum() else best
        if best.sum() > 0.5 * clear.sum():
            break
    return best


def _reach(free: np.ndarray, start: tuple[int, int], goal: tuple[int, int] | None = None) -> dict[tuple[int, int], tuple[int, int]]:
    """Nodes that are reached from ``start``, breadth first, and the one before each."""
    before, queue = {start: start}, deque([start])
    while queue and goal not in before:
        x, y = queue.popleft()
        for node in ((x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)):
            if node not in before and 0 <= node[0] < free.shape[0] and 0 <= node[1] < free.shape[1] and free[node]:
                before[node] = (x, y)
                queue.append(node)
    return before


def _way(free: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]]:
    before, way = _reach(free, start, goal), [goal]
    while way[-1] != start:
        way.append(before[way[-1]])
    return way[::-1]
