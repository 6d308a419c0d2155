"""Where scans fit into a whole map: branch and bound over free space and its border, and all headings (Olson 2009, Hess et al. 2016).

A block of poses is bounded by the sum over the points of the highest score that each of them can reach in it. Blocks are halved from 8
cells and four headings to one pose; those that cannot come to a share of the best are left out.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from localization.lidar.correlative_search import draw_image
from localization.lidar.registration import Alignment, align_points
from localization.lidar.scan_matcher import OPEN_INFORMATION
from localization.lidar.submap import VoxelGrid, make_grid, voxel_means
from localization.maps.grid import Grid, draw_grid
from localization.maps.keyframe_map import KeyframeMap
from localization.trajectory import IntArray
from motion_models import se2
from motion_models.compiled import subroutine, threaded_kernel
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2, Triple

CELL_M = 0.1
"""Cell of the search's image and of the grid that divides space into walls, free and unknown [m]."""
_SURFACE_CELL_M = 0.08
"""Voxel of the surfaces that scans are aligned with [m]."""
CERTAINLY_FREE = 0.125
"""Probability below which a cell contradicts a tracked place: four passes. With two, walls that a map has by few, slanting beams have up to
0.3 of the points of a right place in free space (ACES, halves); with four, 0.13."""
_BLOCK = 4
"""Edge of the blocks into which positions are divided [cells], and headings in a block of twice that edge."""
_MARGIN_BLOCKS = 1
"""Positions that are searched around free space, in blocks: 0.4 m. At the border of a map the robot stands where no beam
has passed twice, and measures mapped walls all the same: 22 of 263 such keyframes in halves of fr079, and one of them farther outside."""
_FREE_BORDER_CELLS = 2
"""Points in free space contradict a tracked place from so many cells inside it: 0.2 m. Walls that a map has from afar alone, by slanting
beams, are free cells in part: in a corridor of ACES that the map had from its end, 0.29 of the points of the right place lay in such."""
_SEARCH_POINTS = 150
"""Points of a search: what is aligned afterwards has all."""
_UNKNOWN_SCORE, _FREE_SCORE = 0.4, -0.4
"""What a point in unknown space and one in free space count, where one on a wall counts 1. With 0 in free space, 6 of 12 and 5 of 10 best
places were right where half of the points are unmapped (fr079, ACES), with -0.4 8 and 6; with -0.8, as `Place.score` has it, 9 and 1:
walls that a map has by few beams have free cells."""
_WIDTHS, _SHIFTS = (1, 2, 5, 11), (0.0, 0.5, 2.0, 5.0)
"""Cells that a point can reach from the poses of a block of 1, 2, 4 and 8 cells, and how many of them lie before the cell that it reaches
from its middle: as many as the block has, and one for the two headings of the third, three for the four of the last, which are a cell
apart at the range that eight of ten points are nearer than."""
_CHUNK, _MAX_BLOCKS = 200, 24_000
"""Blocks of 8 cells that are refined at once, and at most: with 6,000 three of four wrong starts in MIT-CSAIL had their right place in the
block that is 6,800th to 10,600th by its bound, of 150,000."""
_SHARE_OF_BEST, _SHARE_WHERE_ALONE = 0.85, 0.7
"""A place is a candidate where its score is above the first share of the best. Where one of the whole map is alone, the search goes on to
the second: by how much it is better than the next one is what its probability depends on most."""
_APART_M, _APART_RAD = 0.6, 0.3
"""Poses nearer than both are one place."""
_MAX_PLACES = 12
_SEARCH_S, _SEARCH_S_PER_BLOCK = 0.2, 1.2e-4
"""Time that a search beside the estimates is given, and for each block of free space [s]: 0.08 and 0.10 ms of CPU are the medians
of each in fr079 and ACES, 0.19 the most, on a machine with seven processes on two cores."""
_BLOCK_M, _PADDING = _BLOCK * CELL_M, max(_WIDTHS)
_NEAR = math.exp(-0.5 * 1.5**2)
"""Likelihood from which on a point lies on a wall: within 1.5 cells of a point of the map."""
_ALIGN_COV = np.diag([0.1, 0.1, 0.03]) ** 2
"""Covariance of a searched pose, from which scans are aligned [m^2, m^2, rad^2]."""


@dataclass(frozen=True, eq=False)
class Place:
    """A pose in the map, and how scans agree with it."""

    pose: Pose2
    """(3,) ``map_T_body``."""
    fit: Alignment
    on_walls: float
    """Share of the points that lie on walls of the map."""
    in_free: float
    """Share of the points that lie in space that is free in the map; the others are where the map is unknown."""
    contradicting: float
    """Share of the points that lie in space that is free for certain (`CERTAINLY_FREE`), and not at its border."""

    @property
    def residual_variance(self) -> float:
        """Mean square of the residuals of the inliers, in units of the assumed noise."""
        return self.fit.sum_squares / max(self.fit.n_inliers, 1)

    @property
    def measured_cov(self) -> Cov3:
        """(3, 3) of the pose by the points alone, along directions that the scene leaves open 10 m or 1 rad."""
        return np.asarray(np.linalg.inv(self.fit.information + OPEN_INFORMATION)) * max(self.residual_variance, 1.0)

    @property
    def score(self) -> float:
        """By which places compete: points in free space contradict the map, those in unknown space do not."""
        return self.on_walls - 2.0 * self.in_free

    @property
    def left_out_score(self) -> float:
        """What a place has at most that is left out where this one is alone: a search's score is 0.4 + 0.6 w - 0.8 f, and w - 2 f is no
        more than w - 4/3 f."""
        searched = _UNKNOWN_SCORE + (1.0 - _UNKNOWN_SCORE) * self.on_walls + (_FREE_SCORE - _UNKNOWN_SCORE) * self.in_free
        return (_SHARE_WHERE_ALONE * searched - _UNKNOWN_SCORE) / (1.0 - _UNKNOWN_SCORE)


class PlaceMap:
    """The walls of a map as scans are matched to them, and its free space."""

    def __init__(self, keyframes: KeyframeMap, range_noise_m: float) -> None:
        """``range_noise_m``: sigma of a range, added to the thickness of surfaces [m]. Raises `MapError` without points."""
        self.range_noise_m = range_noise_m
        arrays = (keyframes.poses, keyframes.covariances, keyframes.points)
        self.fingerprint = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()[:12]
        self.grid: Grid = draw_grid(keyframes, CELL_M)
        self.certain_grid: Grid = draw_grid(keyframes, CELL_M, CERTAINLY_FREE)
        """`grid`, free where the map certainly is."""
        self._inside_free = ndimage.binary_erosion(self.certain_grid.cells.T == 0, iterations=_FREE_BORDER_CELLS)
        points = keyframes.points_in_map()
        index = np.floor((points - self.grid.origin) / CELL_M).astype(np.int64)
        walls = points[self.grid.cells[index[:, 1], index[:, 0]] == 100]  # without what moved
        walls = points if not len(walls) else walls
        self.surfaces: VoxelGrid = make_grid(walls, _SURFACE_CELL_M, range_noise_m)
        self._walls = draw_image(self.surfaces.means, CELL_M)
        self._scores = self._score_images()
        """For each of `_WIDTHS`, the highest score in so many cells from each one on; `_PADDING` cells of unknown space are around."""
        self._starts = self._free_blocks(keyframes)
        self.search_s = _SEARCH_S + _SEARCH_S_PER_BLOCK * len(self._starts)
        """Time after which the result of a search beside the estimates is due [s]."""
        self.mapped = keyframes
        low, high = points.min(axis=0), points.max(axis=0)
        self.centre: Pose2 = np.array([*(0.5 * (low + high)), 0.0])
        """(3,) the middle of the map."""
        self.extent_cov: Cov3 = np.diag(np.array([*np.full(2, 0.5 * np.hypot(*(high - low))), math.pi]) ** 2)
        """(3, 3) of a pose that may be anywhere in it."""

    def _score_images(self) -> tuple[FloatArray, ...]:
        fine = self._walls.levels[0]
        rows, columns = fine.shape
        x, y = (self._walls.origin[0] + CELL_M * (np.arange(rows) + 0.5), self._walls.origin[1] + CELL_M * (np.arange(columns) + 0.5))
        centres = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        is_free = self._grid_values(centres).reshape(rows, columns) == 0
        scores = np.where(is_free, np.where(fine > 0.0, fine, _FREE_SCORE), np.maximum(fine, _UNKNOWN_SCORE)).astype(fine.dtype)
        scores = np.pad(scores, _PADDING, constant_values=_UNKNOWN_SCORE)
        return tuple(ndimage.maximum_filter(scores, width, origin=-(width // 2), mode="nearest") for width in _WIDTHS)

    def is_unknown(self, points: Points2) -> NDArray[np.bool_]:
        """(N,) whether each of ``points`` (N, 2) is in space that the map does not have, and not beside a wall."""
        is_near = _look_up(self._walls.levels[0], points - self._walls.origin) >= _NEAR
        return np.asarray((self._grid_values(points) == -1) & ~is_near)

    def _grid_values(self, points: Points2) -> FloatArray:
        return _look_up(self.grid.cells.T, points - self.grid.origin, -1)

    def _free_blocks(self, keyframes: KeyframeMap) -> FloatArray:
        """(C, 2) the blocks that hold free space or a keyframe, and those around: their middles [m]."""
        rows, columns = np.nonzero(self.grid.cells == 0)
        free = np.vstack([self.grid.origin + CELL_M * (np.column_stack([columns, rows]) + 0.5), keyframes.poses[:, :2]])
        margin = np.arange(-_MARGIN_BLOCKS, _MARGIN_BLOCKS + 1)
        around = np.stack(np.meshgrid(margin, margin), axis=-1).reshape(-1, 2)
        blocks = np.unique(np.floor(free / _BLOCK_M), axis=0)
        blocks = np.unique((blocks[:, None, :] + around).reshape(-1, 2), axis=0)
        return np.asarray((blocks + 0.5) * _BLOCK_M)

    def search(self, points: Points2, near: Pose2 | None = None, half: FloatArray | None = None) -> list[Place]:
        """Places where ``points`` (N, 2) of the body frame [m] fit best, the best first; with ``near`` (3,), within
        ``half`` (3,) [m, m, rad] of it. None where no free space is."""
        some = voxel_means(points, 2.0 * CELL_M)
        some = np.ascontiguousarray(some[np.linspace(0, len(some) - 1, min(len(some), _SEARCH_POINTS)).astype(np.intp)])
        reach = float(np.quantile(np.hypot(some[:, 0], some[:, 1]), 0.8))
        n_turns = max(math.ceil(2.0 * math.pi * reach / CELL_M / _BLOCK), 8)
        step = 2.0 * math.pi / n_turns
        starts, turns = self._starts, np.arange(n_turns)
        if near is not None and half is not None:
            starts = starts[(np.abs(starts - near[:2]) <= half[:2] + _BLOCK_M).all(axis=1)]
            turns = turns[np.abs(se2.wrap_angle(step * (turns + 0.5) - near[2])) <= half[2] + step]
        if not len(starts) or not len(turns):
            return []
        parts = np.arange(2 * _BLOCK) / (2 * _BLOCK)  # every other one is a pose's, those between are middles of blocks
        yaws = step * (turns[:, None] + parts).ravel()
        turned = se2.transform(np.column_stack([np.zeros((len(yaws), 2)), yaws])[:, None, :], some)
        turned, found = np.ascontiguousarray(turned / CELL_M + _PADDING), []
        for share in (_SHARE_OF_BEST, _SHARE_WHERE_ALONE) if near is None else (_SHARE_OF_BEST,):
            poses, scores = self._branch_and_bound(turned, starts, share)
            poses = np.column_stack([CELL_M * poses[:, :2] + self._walls.origin, yaws[poses[:, 2].astype(np.intp)]])
            found = _distinct(poses, scores, share)
            if len(found) != 1:
                break
        return sorted((self.align(points, pose) for pose in found), key=lambda place: -place.score)

    def _branch_and_bound(self, turned: FloatArray, starts: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
        """The best poses (K, 3) of blocks, as x, y [cells] and row of ``turned`` (Y, N, 2), and their scores (K,): in blocks about
        ``starts`` (C, 2) [m] and of headings of ``turned``, 8 rows each, and all that come to a ``share`` of the best."""
        wide, which = np.unique(np.floor(starts / (2.0 * _BLOCK_M)), axis=0, return_inverse=True)
        centres = 2.0 * _BLOCK_M * (wide + 0.5)
        column, row = (starts > centres[which.ravel()]).T
        is_start = np.zeros((len(wide), 4), dtype=bool)
        is_start[which.ravel(), 2 * column + row] = True
        middles = (centres - self._walls.origin) / CELL_M
        bounds = _bound_blocks(self._scores[3], np.ascontiguousarray(turned[_BLOCK - 1 :: 2 * _BLOCK]), middles).ravel()
        order = np.argpartition(-bounds, min(_MAX_BLOCKS, len(bounds) - 1))[:_MAX_BLOCKS]
        order = order[np.argsort(-bounds[order], kind="stable")]
        poses, scores, best = [], [], 0.0
        for begin in range(0, len(order), _CHUNK):
            chunk = order[begin : begin + _CHUNK]
            if bounds[chunk[0]] < share * best:
                break
            turn, block = np.divmod(chunk, len(wide))
            one, score = _refine_blocks(self._scores, turned, middles[block], is_start[block], 2 * _BLOCK * turn, best, share)
            poses.append(one[score > 0.0])
            scores.append(score[score > 0.0])
            best = max(best, float(score.max()))
        return np.vstack(poses), np.concatenate(scores)

    def align(self, points: Points2, pose: Pose2, cov: FloatArray = _ALIGN_COV) -> Place:
        """The place of ``points`` (N, 2) of the body frame near ``pose`` (3,), uncertain by ``cov`` (3, 3)."""
        fit = align_points(self.surfaces, points, pose, cov, pose)
        return self.compare(points, fit)

    def compare(self, points: Points2, fit: Alignment) -> Place:
        """How ``points`` (N, 2) agree with walls and free space at the pose of ``fit``."""
        moved = np.asarray(se2.transform(fit.pose, points))
        is_near = _look_up(self._walls.levels[0], moved - self._walls.origin) >= _NEAR
        values = self._grid_values(moved)
        is_inside = _look_up(self._inside_free, moved - self.certain_grid.origin) > 0.0
        in_free, contradicting = (float((~is_near & is_free).mean()) for is_free in (values == 0, is_inside))
        return Place(fit.pose, fit, float(is_near.mean()), in_free, contradicting)


def _look_up(image: NDArray[Any], points: Points2, outside: float = 0.0) -> FloatArray:
    """(N,) values of the cells of ``image``, of `CELL_M`, where ``points`` (N, 2) from its origin lie."""
    index = np.floor(points / CELL_M).astype(np.int64)
    is_inside = ((index >= 0) & (index < image.shape)).all(axis=1)
    found = np.full(len(points), outside)
    found[is_inside] = image[index[is_inside, 0], index[is_inside, 1]]
    return found


def _distinct(poses: FloatArray, scores: FloatArray, share: float) -> list[Pose2]:
    """The best pose of each place, the best first, of all that have a ``share`` of the best score."""
    order = np.argsort(-scores, kind="stable")
    order = order[scores[order] >= share * scores.max(initial=0.0)]
    found: list[Pose2] = []
    rest = poses[order]
    while len(rest) and len(found) < _MAX_PLACES:
        found.append(rest[0])
        off = rest - rest[0]
        is_same = (np.hypot(off[:, 0], off[:, 1]) < _APART_M) & (np.abs(se2.wrap_angle(off[:, 2])) < _APART_RAD)
        rest = rest[~is_same]
    return found


@subroutine
def _mean(image: FloatArray, points: Points2, x: float, y: float, spare: float) -> float:
    """Mean of ``image`` where ``points`` (N, 2) lie, moved by ``x`` and ``y`` [cells]; -1 where N less the sum exceeds ``spare``."""
    total = 0.0
    for i in range(points.shape[0]):
        u, v = points[i, 0] + x, points[i, 1] + y
        is_inside = u >= 0.0 and v >= 0.0 and u < image.shape[0] and v < image.shape[1]
        total += image[int(u), int(v)] if is_inside else _UNKNOWN_SCORE
        if i + 1 - total > spare:
            return -1.0
    return total / points.shape[0]  # type: ignore[no-any-return]


@threaded_kernel
def _bound_blocks(image: FloatArray, turned: FloatArray, middles: FloatArray) -> FloatArray:
    """(T, C) bounds of the blocks of 8 cells about ``middles`` (C, 2) [cells], with points ``turned`` (T, N, 2)."""
    out = np.empty((turned.shape[0], middles.shape[0]))
    for t in range(turned.shape[0]):
        for c in range(middles.shape[0]):
            out[t, c] = _mean(image, turned[t], middles[c, 0] - _SHIFTS[3], middles[c, 1] - _SHIFTS[3], np.inf)
    return out


@threaded_kernel
def _refine_blocks(
    images: tuple[FloatArray, ...],
    turned: FloatArray,
    middles: FloatArray,
    is_start: NDArray[np.bool_],
    rows: IntArray,
    best: float,
    share: float,
) -> tuple[FloatArray, FloatArray]:
    """The best pose (8 K, 3) in each block of 4 cells and two headings within those of 8 cells about ``middles`` (K, 2) [cells] and four
    headings from ``rows`` (K,) of ``turned`` (Y, N, 2) on, where ``is_start`` (K, 4); and its score (8 K,), -1 for what cannot come to a
    ``share`` of the ``best``.
    """
    poses, scores, n = np.zeros((8 * middles.shape[0], 3)), np.full(8 * middles.shape[0], -1.0), turned.shape[1]
    for k in range(8 * middles.shape[0]):
        block, part, row = k // 8, k // 2 % 4, rows[k // 8] + 4 * (k % 2)
        x, y = middles[block, 0] + 4 * (part // 2) - 2, middles[block, 1] + 4 * (part % 2) - 2
        spare = n * (1.0 - share * best)
        if not is_start[block, part] or _mean(images[2], turned[row + 1], x - _SHIFTS[2], y - _SHIFTS[2], spare) < 0.0:
            continue
        for j in range(8):
            pose = row + 2 * (j // 4), x + 2 * (j // 2 % 2) - 1, y + 2 * (j % 2) - 1
            score, dx, dy = _best_of_four(images, turned[pose[0]], pose[1], pose[2], spare)
            if score > scores[k]:
                scores[k], best = score, max(best, score)
                poses[k, 0], poses[k, 1], poses[k, 2] = dx, dy, pose[0]
    return poses, scores


@subroutine
def _best_of_four(images: tuple[FloatArray, ...], points: Points2, x: float, y: float, spare: float) -> Triple:
    """Score and position of the best of the four poses about ``x`` and ``y`` [cells]; the score is -1 where the points miss more than
    ``spare`` of theirs."""
    found = -1.0, x, y
    if _mean(images[1], points, x - _SHIFTS[1], y - _SHIFTS[1], spare) < 0.0:
        return found
    for j in range(4):
        u, v = x + j // 2 - 0.5, y + j % 2 - 0.5
        score = _mean(images[0], points, u, v, spare)
        if score > found[0]:
            found = score, u, v
    return found
