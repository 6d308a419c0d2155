"""Correlative search, against scoring every pose of its window."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from localization.lidar.correlative_search import COARSE, SearchResult, draw_image, score_offsets, search
from localization.lidar.submap import voxel_means
from localization.simulation import world
from motion_models import se2
from tests.helpers import rooms
from tests.helpers.extended import cases

CELL = 0.1
LAB, HALL = world.lab().walls, world.hall().walls
ANYWHERE = np.array([15.0, 15.0, math.pi])


def image_of(walls: np.ndarray, seed: int = 0):
    """The image of five scans around the origin."""
    rng = np.random.default_rng(seed)
    poses = [np.array([x, y, 0.3 * x]) for x, y in ((0.0, 0.0), (0.5, 0.1), (-0.5, 0.2), (0.1, 0.5), (0.2, -0.5))]
    return draw_image(np.vstack([se2.transform(pose, rooms.scan_from(walls, pose, rng)) for pose in poses]), CELL)


def brute_scores(image, points: np.ndarray, pose: np.ndarray) -> float:
    """Mean of the finest image at ``points`` seen from ``pose``."""
    at = np.floor((se2.transform(pose, points) - image.origin) / image.cell).astype(int)
    is_inside = (at >= 0).all(axis=1) & (at < image.levels[0].shape).all(axis=1)
    return float(image.levels[0][tuple(at[is_inside].T)].sum() / len(points))


def test_draw_image_is_one_at_points_and_decays() -> None:
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 2))
    image = draw_image(points, CELL)
    centres = image.origin + CELL * (np.indices(image.levels[0].shape).reshape(2, -1).T + 0.5)
    d = (centres[:, None] - points) / CELL
    expected = np.exp(-0.5 * (d**2).sum(axis=-1))
    expected[(np.abs(d) > 2.5).any(axis=-1)] = 0.0  # five by five cells
    found = image.levels[0].ravel()
    is_sure = (np.abs(np.abs(d) - 2.0) > 0.5).all(axis=(1, 2))  # the square is around the point's cell, not around the point
    np.testing.assert_allclose(found[is_sure], expected.max(axis=1)[is_sure], atol=1e-6)
    assert is_sure.sum() > 100
    assert found.max() <= 1.0


def test_search_coarse_scores_bound_fine_scores() -> None:
    image, rng = image_of(LAB), np.random.default_rng(1)
    points = se2.transform(np.array([0.3, -0.2, 0.4]), voxel_means(rooms.scan_from(LAB, np.zeros(3), rng), CELL)) - image.origin
    turned, rows = points[None], np.zeros(300, int)
    offsets = rng.uniform(-1.5, 1.5, (300, 2))
    for level in (1, 2):
        step = CELL * COARSE**level
        within = offsets + rng.integers(-(COARSE**level) // 2, COARSE**level // 2 + 1, (300, 2)) * CELL
        coarse = score_offsets(image.levels[level], turned / step, rows, offsets / step)
        fine = score_offsets(image.levels[0], turned / CELL, rows, within / CELL)
        assert (coarse >= fine - 1e-6).all()
        assert (coarse < 1.0).all()


@pytest.mark.parametrize("seed", cases(range(6), ("0",)))
def test_search_equals_exhaustive_search(seed: int) -> None:
    """Every cell and yaw of the window, scored one by one, with the prior."""
    rng, image = np.random.default_rng(seed), image_of(HALL)
    points = voxel_means(rooms.scan_from(HALL, np.array([0.1, -0.1, 0.2]), rng), CELL)
    prior = np.array([0.1, -0.1, 0.2]) + rng.uniform(-0.25, 0.25, 3) * [1.0, 1.0, 0.4]
    sigmas = np.array([0.2, 0.2, 0.06])
    found = search(image, points, prior, np.diag(sigmas**2), ANYWHERE)
    reach = float(np.quantile(np.hypot(*points.T), 0.8))
    yaw_step = CELL / reach
    n, m = math.ceil(3.0 * sigmas[0] / CELL), math.ceil(3.0 * sigmas[2] / yaw_step)
    shifts = np.array([(i * CELL, j * CELL, k * yaw_step) for i in range(-n, n + 1) for j in range(-n, n + 1) for k in range(-m, m + 1)])
    scores = np.array([brute_scores(image, points, prior + shift) for shift in shifts])
    total = len(points) / 6.0 * np.log(np.maximum(scores, 1e-6)) - 0.5 * ((shifts / sigmas) ** 2).sum(axis=1)
    np.testing.assert_allclose(found.pose, prior + shifts[total.argmax()], atol=1e-9)
    assert found.score == pytest.approx(scores[total.argmax()], abs=1e-5)


@pytest.mark.parametrize("seed", cases(range(4), ("0",)))
def test_search_of_wide_window_finds_the_pose(seed: int) -> None:
    """Sigmas of 1.5 m and .5 rad: 4.5 m and 1.5 rad to either side."""
    rng = np.random.default_rng(seed)
    true = np.array([0.2, 0.1, -0.1])
    off = np.array([rng.uniform(-3.0, 3.0), rng.uniform(-3.0, 3.0), rng.uniform(-1.0, 1.0)])
    points = voxel_means(rooms.scan_from(HALL, true, rng), CELL)
    found = search(image_of(HALL), points, true + off, np.diag([1.5, 1.5, 0.5]) ** 2, ANYWHERE)
    error = se2.between(true, found.pose)
    assert np.hypot(*error[:2]) < 1.5 * CELL
    assert abs(error[2]) < 0.05
    assert found.rival_score < 0.9 * found.score


def test_search_with_limit_stays_inside() -> None:
    true = np.array([0.2, 0.1, -0.1])
    points = voxel_means(rooms.scan_from(HALL, true, np.random.default_rng(0)), CELL)
    limit, prior, step = np.array([0.4, 0.4, 0.1]), np.array([2.2, 0.1, -0.1]), np.array([4 * CELL, 4 * CELL, 0.05])
    found = search(image_of(HALL), points, prior, np.eye(3), limit)
    assert (np.abs(found.pose - prior) <= limit + step).all()


def square(seed: int, spread: float) -> SearchResult:
    """The search in a square room, whose four corners are alike."""
    rng, walls = np.random.default_rng(seed), world.box(-3.0, -3.0, 3.0, 3.0)
    image = draw_image(rooms.scan_from(walls, np.zeros(3), rng), CELL)
    return search(
        image, voxel_means(rooms.scan_from(walls, np.zeros(3), rng), CELL), np.zeros(3), np.diag([0.1, 0.1, spread]) ** 2, ANYWHERE
    )


def test_search_in_square_room_has_equal_rival() -> None:
    result = square(0, 0.8)
    assert result.rival_score > 0.9 * result.score
    result = square(0, 0.05)
    assert result.rival_score < 0.9 * result.score


def test_search_of_another_place_scores_low() -> None:
    points = voxel_means(rooms.scan_from(LAB, np.array([0.5, 0.3, 0.7]), np.random.default_rng(0)), CELL)
    assert search(image_of(HALL), points, np.zeros(3), np.diag([0.5, 0.5, 0.3]) ** 2, ANYWHERE).score < 0.5


def test_draw_image_levels_are_maxima_of_neighbouring_blocks() -> None:
    image = draw_image(np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2)), 0.1)
    for fine, coarse in itertools.pairwise(image.levels):
        blocks = np.pad(fine.reshape(fine.shape[0] // COARSE, COARSE, fine.shape[1] // COARSE, COARSE).max((1, 3)), 1)
        for i, j in np.ndindex(coarse.shape):
            assert coarse[i, j] == blocks[i : i + 3, j : j + 3].max()


def test_search_of_any_heading_has_no_rival_in_itself() -> None:
    """Turned by half a circle to either side the pose is the same."""
    true = np.array([0.2, 0.1, math.pi])
    points = voxel_means(rooms.scan_from(HALL, true, np.random.default_rng(0)), CELL)
    found = search(image_of(HALL), points, np.array([0.2, 0.1, 0.0]), np.diag([0.5, 0.5, 2.0]) ** 2, np.array([1.0, 1.0, math.pi]))
    assert abs(abs(found.pose[2]) - math.pi) < 0.05
    assert found.rival_score < 0.9 * found.score
