"""Localization in maps of real buildings of which a tenth of the walls has been changed.

``python -m tests.studies.localization_changed`` takes the map of one half of each log, changes it, and localizes the keyframes of the
other half in both. Of the cells of walls a third each of ``--share`` is removed, moved by 0.3 to 1 m, and added as boxes of 0.8 m on free
space; all beams are cast anew: through what is gone to the next wall behind it, and only up to what is new.

Keyframes follow each 0.5 m or 0.3 rad, by the motion of the smoothed graph with noise of the odometry. Mapped is one whose scan, at the
true pose, has a score of 0.5 or more in the map that was not changed: the same ones for both maps. Tracked is localized within 0.5 m and
0.2 rad. Keyframes with a probability above 0.9 and a wrong pose are counted apart where the map has nothing and the pose is by odometry:
as many are expected there as the probabilities say, the sum of 1 - p. One draw of the noise is one way of the odometry from there on, so
that ``--draws`` of it are added up.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.maps import KeyframeMap
from localization.maps.grid import Grid, draw_grid
from localization.maps.localizer import Localizer
from localization.maps.place_probability import LIKELY
from localization.maps.place_search import CELL_M, PlaceMap
from motion_models import se2
from tests.studies.buildings import BUILDINGS
from tests.studies.localization import COV, STEP_M, STEP_RAD
from tests.studies.localization_halves import MAP_STRIDE, MAPPED_SCORE, dense_map, halves, off

_PIECE_CELLS = 10
"""Walls are changed by pieces of 1 m."""
_BOX_CELLS = 8
_BEYOND_M = 8.0
"""How far a beam goes on through a wall that is gone [m]."""
_SAMPLE_M = 0.05


class Walls(NamedTuple):
    """Images (H, W) of walls, as the cells of a grid."""

    kept: NDArray[np.bool_]
    gone: NDArray[np.bool_]
    new: NDArray[np.bool_]


class Tracked(NamedTuple):
    """One drive in a map."""

    share: float
    """Of the mapped keyframes, localized and right."""
    errors: np.ndarray
    """(n,) of these [m]."""
    above: np.ndarray
    """(n, 3) of each keyframe above 0.9: whether it is outside of the map, whether it is wrong, and the probability that it is."""


def change_walls(grid: Grid, share: float, rng: np.random.Generator) -> Walls:
    """The walls of ``grid``, a third each of the ``share`` of whose cells is removed, moved and added."""
    walls = grid.cells == 100
    rows, columns = np.nonzero(walls)
    piece = rows // _PIECE_CELLS * walls.shape[1] + columns // _PIECE_CELLS
    gone, new, wanted = np.zeros_like(walls), np.zeros_like(walls), share * len(rows) / 3.0
    for i, k in enumerate(rng.permutation(np.unique(piece))):
        at = piece == k
        if gone.sum() >= 2.0 * wanted:
            break
        gone[rows[at], columns[at]] = True
        if i % 2:
            angle, way = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.3, 1.0) / grid.resolution
            _paint(new, rows[at] + round(way * math.sin(angle)), columns[at] + round(way * math.cos(angle)))
    free, n_moved = np.argwhere(grid.cells == 0), new.sum()
    side = np.arange(_BOX_CELLS)
    while new.sum() < n_moved + wanted:
        row, column = free[rng.integers(len(free))]
        for edge in (0, _BOX_CELLS - 1):
            _paint(new, row + edge, column + side)
            _paint(new, row + side, column + edge)
    return Walls(walls & ~gone, gone, new)


def _paint(image: NDArray[np.bool_], rows: np.ndarray, columns: np.ndarray) -> None:
    rows, columns = np.broadcast_arrays(rows, columns)
    inside = (rows >= 0) & (columns >= 0) & (rows < image.shape[0]) & (columns < image.shape[1])
    image[rows[inside], columns[inside]] = True


def change_map(mapped: KeyframeMap, share: float, rng: np.random.Generator) -> KeyframeMap:
    """``mapped`` as it would be if the ``share`` of its walls were others."""
    grid = draw_grid(mapped, CELL_M)
    walls, scans = change_walls(grid, share, rng), mapped.scans()
    changed = [
        _cast(grid, walls, pose, sensor, scan, rng) if len(scan) else scan
        for pose, sensor, scan in zip(mapped.poses, mapped.sensors, scans, strict=True)
    ]
    counts = np.array([len(scan) for scan in changed], dtype=np.int64)
    return replace(mapped, points=np.vstack(changed).astype(np.float32), counts=counts)


def _cast(grid: Grid, walls: Walls, pose: np.ndarray, sensor: np.ndarray, scan: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The points (n, 2) of the body frame [m] where the beams from ``sensor`` (2,) to those of ``scan`` (N, 2) end among ``walls``."""
    ray = scan - sensor
    length = np.maximum(np.hypot(*ray.T), 1e-6)
    ahead = _SAMPLE_M * np.arange(1, math.ceil((length.max() + _BEYOND_M) / _SAMPLE_M))
    samples = sensor + ray[:, None, :] / length[:, None, None] * ahead[:, None]
    is_new, is_kept = (_values(grid, image, se2.transform(pose, samples)) for image in (walls.new, walls.kept))
    is_gone = _values(grid, walls.gone, se2.transform(pose, scan))
    is_behind = ahead > length[:, None] + 2.0 * CELL_M
    ends = is_new & (is_gone[:, None] | (ahead < length[:, None])) | is_kept & is_behind & is_gone[:, None]
    first = np.where(ends.any(axis=1), ahead[ends.argmax(axis=1)] + 0.5 * CELL_M + rng.normal(0.0, 0.01, len(scan)), np.inf)
    reach = np.where(is_gone, first, np.minimum(first, length))
    is_finite = np.isfinite(reach)
    return np.asarray(sensor + ray[is_finite] * (reach / length)[is_finite, None])


def _values(grid: Grid, image: NDArray[np.bool_], points: np.ndarray) -> NDArray[np.bool_]:
    """(...,) of ``image`` where ``points`` (..., 2) lie; False outside."""
    index = np.floor((points - np.array(grid.origin)) / grid.resolution).astype(int)
    column, row = index[..., 0], index[..., 1]
    inside = (column >= 0) & (row >= 0) & (column < image.shape[1]) & (row < image.shape[0])
    return np.asarray(inside & image[np.where(inside, row, 0), np.where(inside, column, 0)])


def track(places: PlaceMap, keyframes: KeyframeMap, ids: np.ndarray, is_mapped: Sequence[bool], rng: np.random.Generator) -> Tracked:
    """A drive over keyframes ``ids`` (n,), of which ``is_mapped`` (n,) count, from the true pose on."""
    scans, poses = keyframes.scans(), keyframes.poses
    localizer, right, errors, above = Localizer(places, poses[ids[0]]), [], [], []
    for a, b, counts in zip(ids[:1].tolist() + ids[:-1].tolist(), ids.tolist(), is_mapped, strict=True):
        delta = se2.compose(se2.between(poses[a], poses[b]), rng.multivariate_normal(np.zeros(3), COV) * (a != b))
        localizer.add(scans[b], delta, COV * (a != b))
        error, is_near = off(poses[b], localizer.pose)
        is_right = localizer.state == "localized" and is_near
        if localizer.state == "localized" and localizer.probability > LIKELY:
            above.append((localizer.is_outside, not is_near, 1.0 - localizer.probability))
        if counts:
            right.append(is_right)
            errors += [error] if is_right else []
    return Tracked(float(np.mean(right)), np.array(errors), np.array(above, dtype=float).reshape(-1, 3))


def steps(keyframes: KeyframeMap, ids: np.ndarray) -> np.ndarray:
    """Those of the dense keyframes ``ids`` that a localizer would take."""
    kept = [ids[0]]
    for k in ids[1:]:
        delta = se2.between(keyframes.poses[kept[-1]], keyframes.poses[k])
        if math.hypot(delta[0], delta[1]) >= STEP_M or abs(delta[2]) >= STEP_RAD:
            kept.append(k)
    return np.array(kept)


def rows(name: str, keyframes: KeyframeMap, i: int, share: float, seeds: Sequence[int], n_draws: int) -> None:
    """Print half 1 - i of a log in the map of half i, as it is and changed by each of ``seeds``, with ``n_draws`` of the noise."""
    mapped, driven, scans = (
        keyframes.select(halves(keyframes)[i][::MAP_STRIDE]),
        steps(keyframes, halves(keyframes)[1 - i]),
        keyframes.scans(),
    )
    places = PlaceMap(mapped, 0.02)
    is_mapped = [len(scans[k]) > 0 and places.align(scans[k], keyframes.poses[k]).score >= MAPPED_SCORE for k in driven]
    for seed in (0, *seeds):
        used = PlaceMap(change_map(mapped, share, np.random.default_rng([seed, i])), 0.02) if seed else places
        drives = [track(used, keyframes, driven, is_mapped, np.random.default_rng(draw)) for draw in range(1, n_draws + 1)]
        shares, errors = [100.0 * found.share for found in drives], np.concatenate([found.errors for found in drives])
        above = np.vstack([found.above for found in drives])
        inside, outside = above[above[:, 0] == 0.0], above[above[:, 0] == 1.0]
        cells = [
            f"{name}, map of half {i + 1}, {f'changed, seed {seed}' if seed else 'as it is'}",
            f"{sum(is_mapped)} of {len(driven)}",
            f"{np.mean(shares):.1f} / {min(shares):.1f}",
            f"{np.median(errors):.3f} / {np.quantile(errors, 0.95):.3f}" if len(errors) else "-",
            *(f"{part[:, 1].sum():.0f} of {len(part)} / {part[:, 2].sum():.1f}" for part in (inside, outside)),
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


def main(words: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", default=",".join(BUILDINGS))
    parser.add_argument("--share", type=float, default=0.1, help="of the walls' cells that is changed")
    parser.add_argument("--seeds", default="1", help="of the changes to the map of each half, separated by commas")
    parser.add_argument("--draws", type=int, default=3, help="of the odometry's noise")
    options = parser.parse_args(words)
    wrong = "wrong above 0.9 / expected, in the map | and outside of it"
    print(f"| map | mapped keyframes | tracked [%], mean / least | error, median / p95 [m] | {wrong} |")
    print("|---" * 6 + "|")
    for name in options.log.split(","):
        keyframes = dense_map(BUILDINGS[name].open())
        for i in (0, 1):
            rows(name, keyframes, i, options.share, [int(word) for word in options.seeds.split(",")], options.draws)


if __name__ == "__main__":
    main()
