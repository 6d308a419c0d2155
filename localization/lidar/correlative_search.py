"""Correlative search: the pose of a scan within a wide window, by exhaustive search over a pyramid of likelihood images (Olson 2009).

Coarse images hold the maxima of what a coarse step can reach, so that a coarse score is never below that of the fine poses within.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from localization.lidar.registration import CORRELATED_BEAMS, OUTLIER_SIGMAS
from motion_models import se2
from motion_models.compiled import kernel
from motion_models.se2 import Cov3, FloatArray, Points2, Pose2

COARSE = 4
"""Cells of a coarse step, and again from level to level."""
_KEPT = (150, 1000)
"""Candidates of the middle and of the coarsest level that are refined: with 3,000 of the latter, 78 searches of ACES accept the same."""
_MAX_CANDIDATES = 200_000
"""Poses that the coarsest level may score; a wider window gets a coarser level."""
_APART_CELLS = 6
"""A pose is another one, and not the flank of the best, from so many cells away on."""
_MIN_YAW_STEP_RAD = 2e-3
OUTLIER_COST = 0.5 * OUTLIER_SIGMAS**2
"""-log of the odds that the prior is an outlier."""
_SEARCH_FACTOR = 9.0
_SEARCH_FLOOR = np.diag([0.1, 0.1, 0.03]) ** 2
"""The search covers 3 sigma of 9 P + this [m^2, m^2, rad^2], and what `ScanMatcher.match` adds for wheels that are wrong."""
_SEARCH_LIMIT, _WIDEST_SEARCH = np.array([3.0, 3.0, 1.0]), np.array([15.0, 15.0, math.pi])
"""Half the window of a search at most, for a prior that may be an outlier, and for one that is wide itself [m, m, rad]."""
_MAX_RIVAL = 0.9
"""A search is ambiguous where a pose elsewhere scores more than this share of the best; where the prior is wider than its window, where one
is more probable than exp(-`OUTLIER_COST`) of the best."""


@dataclass(frozen=True, eq=False)
class LikelihoodImage:
    """How probable a point is in each cell: 1 at the points of a submap, falling off over a cell."""

    levels: tuple[FloatArray, ...]
    """Finest first; each holds the maxima of 4 x 4 cells of the one before, and of their neighbours."""
    origin: FloatArray
    """(2,) of all levels [m]."""
    cell: float
    """Edge of a cell of the finest level [m]."""


@dataclass(frozen=True)
class SearchResult:
    """Best pose of a search, and what competes with it."""

    pose: Pose2
    """(3,) of the best score, prior included."""
    score: float
    """Mean likelihood of the points, 0 to 1."""
    rival_score: float
    """The best score of a pose elsewhere."""
    margin: float
    """Logarithm of the ratio of both poses' likelihoods."""


def draw_image(points: Points2, cell: float) -> LikelihoodImage:
    """The image of ``points`` (N, 2) [m]."""
    margin, step = 8 * cell, COARSE**2
    origin = points.min(axis=0) - margin
    shape = np.ceil((points.max(axis=0) + margin - origin) / cell).astype(int) + 8
    fine = np.zeros(tuple((shape + step - 1) // step * step), np.float32)
    _draw(points, fine, origin, cell)
    middle = reduce_image(fine)
    return LikelihoodImage((fine, middle, reduce_image(middle)), origin, cell)


def search(image: LikelihoodImage, points: Points2, prior: Pose2, cov: Cov3, limit: FloatArray) -> SearchResult:
    """The best pose of ``points`` (N, 2) of the body frame within 3 sigma of ``prior`` (3,), at most ``limit`` (3,) [m, m, rad] from it.

    ``cov`` (3, 3) is that of the prior's right perturbation. Every score counts as the log-likelihood of N / 6 independent points.
    """
    world = se2.rotate_covariance(cov, prior[2])
    half = np.minimum(3.0 * np.sqrt(np.diag(world)), limit)
    reach = float(np.quantile(np.hypot(points[:, 0], points[:, 1]), 0.8))
    yaw_step = max(image.cell / max(reach, 1e-3), _MIN_YAW_STEP_RAD)
    yaws = np.arange(-math.ceil(half[2] / yaw_step), math.ceil(half[2] / yaw_step) + 1) * yaw_step
    level = 1 if _count(half, len(yaws), image.cell * COARSE) <= _MAX_CANDIDATES else 2
    step = image.cell * COARSE**level
    axes = [np.arange(-math.ceil(h / step), math.ceil(h / step) + 1) * step for h in half[:2]]
    turns = COARSE ** (level - 1)  # yaws to a step: the middle level has the steps of the finest
    a, x, y = np.meshgrid(np.arange(turns // 2, len(yaws) + turns // 2, turns), *axes, indexing="ij")
    offsets = np.stack([x.ravel(), y.ravel()], axis=-1)
    turned = _turned_points(points, prior, yaws) - image.origin
    rows = np.minimum(a.ravel(), len(yaws) - 1)
    while True:
        step = image.cell * COARSE**level
        scores = score_offsets(image.levels[level], turned / step, rows, offsets / step)
        if level == 0:
            break
        best = np.argsort(-scores, kind="stable")[: _KEPT[level - 1]]
        level -= 1
        fine = np.arange(-COARSE // 2, COARSE // 2) * image.cell * COARSE**level
        turn, dx, dy = (d.ravel() for d in np.meshgrid(np.arange(turns) - turns // 2, fine, fine, indexing="ij"))
        offsets = (offsets[best][:, None, :] + np.stack([dx, dy], axis=-1)).reshape(-1, 2)
        rows = np.clip((rows[best][:, None] + turn).ravel(), 0, len(yaws) - 1)
        turns = 1
    shifts = np.column_stack([offsets, yaws[rows]])
    return _pick(
        prior, shifts, scores, len(points), np.asarray(np.linalg.inv(world), dtype=float), np.array([image.cell, image.cell, yaw_step])
    )


def find_place(image: LikelihoodImage, points: Points2, prior: Pose2, wide: FloatArray, cov: Cov3) -> Pose2 | None:
    """The best pose (3,) of ``points`` (N, 2) within 3 sigma of ``wide`` (3, 3) from the ``prior`` (3,), limited by `search_limit`; None
    where it is ambiguous. ``cov`` (3, 3) of the prior itself."""
    limit = search_limit(cov)
    best = search(image, points, prior, wide, limit)
    if (limit <= _SEARCH_LIMIT).all():
        return best.pose if best.rival_score < _MAX_RIVAL * best.score else None
    return best.pose if best.margin >= OUTLIER_COST else None  # the place is unknown


def search_limit(cov: Cov3) -> FloatArray:
    """(3,) half the window of a search at most [m, m, rad], for a prior with ``cov`` (3, 3)."""
    return np.asarray(np.minimum(np.maximum(_SEARCH_LIMIT, 3.0 * np.sqrt(np.diagonal(cov))), _WIDEST_SEARCH))


def prior_outlier_cov(cov: Cov3) -> Cov3:
    """(3, 3) to be added to the covariance ``cov`` (3, 3) of a prior that may be an outlier."""
    return np.asarray((_SEARCH_FACTOR - 1.0) * cov + _SEARCH_FLOOR)


def _count(half: FloatArray, yaws: int, step: float) -> float:
    return float((2.0 * half[0] / step + 3.0) * (2.0 * half[1] / step + 3.0) * yaws)


def _pick(prior: Pose2, shifts: FloatArray, scores: FloatArray, n: int, information: FloatArray, step: FloatArray) -> SearchResult:
    log_likelihood = n / CORRELATED_BEAMS * np.log(np.maximum(scores, 1e-6))
    best = int(np.argmax(log_likelihood - 0.5 * np.einsum("ki,ij,kj->k", shifts, information, shifts)))
    away = shifts - shifts[best]
    is_elsewhere = (np.hypot(away[:, 0], away[:, 1]) > _APART_CELLS * step[0]) | (
        np.abs(se2.wrap_angle(away[:, 2])) > _APART_CELLS * step[2]
    )
    rival = float(scores[is_elsewhere].max()) if is_elsewhere.any() else 0.0
    margin = n / CORRELATED_BEAMS * math.log(max(float(scores[best]), 1e-6) / max(rival, 1e-6))
    return SearchResult(prior + shifts[best], float(scores[best]), rival, margin)


def _turned_points(points: Points2, prior: Pose2, yaws: FloatArray) -> FloatArray:
    """(Y, N, 2) the points where the prior has them, turned by each of the ``yaws`` (Y,)."""
    poses = np.column_stack([np.tile(prior[:2], (len(yaws), 1)), prior[2] + yaws])
    return np.asarray(se2.transform(poses[:, None, :], points))


@kernel
def _draw(points: Points2, image: FloatArray, origin: FloatArray, cell: float) -> None:
    along_x, along_y = np.empty(5), np.empty(5)
    for i in range(points.shape[0]):
        x, y = (points[i, 0] - origin[0]) / cell, (points[i, 1] - origin[1]) / cell
        first_x, first_y = int(x) - 2, int(y) - 2
        for k in range(5):
            along_x[k] = math.exp(-0.5 * (first_x + k + 0.5 - x) ** 2)
            along_y[k] = math.exp(-0.5 * (first_y + k + 0.5 - y) ** 2)
        for jx in range(5):
            for jy in range(5):
                image[first_x + jx, first_y + jy] = max(image[first_x + jx, first_y + jy], along_x[jx] * along_y[jy])


@kernel
def reduce_image(image: FloatArray) -> FloatArray:
    """The maxima of blocks of `COARSE` x `COARSE` cells, and of their neighbours."""
    rows, columns = image.shape[0] // COARSE, image.shape[1] // COARSE
    out = np.zeros((rows, columns), image.dtype)
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            if image[i, j] > out[i // COARSE, j // COARSE]:
                out[i // COARSE, j // COARSE] = image[i, j]
    for j in range(columns):  # maxima of three rows, then of three columns, in place
        above = out[0, j]
        for i in range(rows):
            here, below = out[i, j], out[min(i + 1, rows - 1), j]
            out[i, j], above = max(above, here, below), here
    for i in range(rows):
        left = out[i, 0]
        for j in range(columns):
            here, right = out[i, j], out[i, min(j + 1, columns - 1)]
            out[i, j], left = max(left, here, right), here
    return out


@kernel
def score_offsets(image: FloatArray, points: FloatArray, rows: FloatArray, offsets: FloatArray) -> FloatArray:
    """(K,) mean of the image where ``points`` (Y, N, 2) of rows (K,) lie, moved by ``offsets`` (K, 2) [cells]."""
    out = np.empty(len(rows))
    for k in range(len(rows)):
        total, dx, dy, row = 0.0, offsets[k, 0], offsets[k, 1], points[rows[k]]
        for i in range(row.shape[0]):
            x, y = row[i, 0] + dx, row[i, 1] + dy
            if x >= 0.0 and y >= 0.0 and x < image.shape[0] and y < image.shape[1]:
                total += image[int(x), int(y)]
        out[k] = total / points.shape[1]
    return out
