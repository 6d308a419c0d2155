"""Voxels and their surfaces, against scipy's tree and numpy's eigenvalues."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from localization.lidar import submap
from localization.lidar.submap import MAX_RINGS, POOLED_VOXELS, make_grid, measure_shares, voxel_means
from motion_models.compiled import kernel

fill_surface, find_nearest, find_voxel = kernel(submap.fill_surface), kernel(submap.find_nearest), kernel(submap.find_voxel)
CELL, NOISE_M = 0.1, 0.02


def scatter(seed: int, n: int = 1500) -> np.ndarray:
    """Points on walls and strewn about, far from the origin and on both sides of it."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack([rng.uniform(-3.0, 3.0, n), 1.0 + 0.03 * rng.normal(size=n)])
    return np.concatenate([wall, rng.uniform(-4.0, 4.0, (n // 3, 2))]) + rng.uniform(-50.0, 50.0, 2)


def cells_of(points: np.ndarray, origin: np.ndarray) -> np.ndarray:
    return np.floor((points - origin) / CELL).astype(int)


@pytest.mark.parametrize("seed", range(3))
def test_voxel_means_equal_grouped_points(seed: int) -> None:
    points = scatter(seed)
    grid = make_grid(points, CELL, NOISE_M)
    cells, which = np.unique(cells_of(points, grid.origin), axis=0, return_inverse=True)
    expected = np.array([points[which.ravel() == k].mean(axis=0) for k in range(len(cells))])
    found = voxel_means(points, CELL)
    assert len(found) == len(cells) == len(grid.cells)
    at = np.array([find_voxel(grid.slots, i, j) for i, j in cells])
    np.testing.assert_allclose(found[at], expected, atol=1e-9)
    assert find_voxel(grid.slots, 10_000, -10_000) == -1


@pytest.mark.parametrize("reach", [0.05, 0.3, 2.0])
def test_find_nearest_equals_kd_tree(reach: float) -> None:
    points = scatter(0)
    grid, means = make_grid(points, CELL, NOISE_M), voxel_means(points, CELL)
    tree = cKDTree(means)
    queries = np.random.default_rng(1).uniform(points.min(axis=0) - 4.0, points.max(axis=0) + 4.0, (800, 2))
    distances, nearest = tree.query(queries, distance_upper_bound=reach)
    found = np.array([find_nearest(grid, *(q - grid.origin), reach) for q in queries])
    np.testing.assert_array_equal(found, np.where(np.isfinite(distances), nearest, -1))
    assert 0 < np.isfinite(distances).sum() < len(queries)


@pytest.mark.parametrize("seed", range(3))
def test_fill_surface_equals_pooled_points(seed: int) -> None:
    """Mean and least eigenvalue of the points in the nearest voxels of the smallest square of rings that has enough of them."""
    points = scatter(seed)
    grid, means = make_grid(points, CELL, NOISE_M), voxel_means(points, CELL)
    voxel_of = {tuple(cell): row for row, cell in enumerate(grid.cells)}
    rows = np.array([voxel_of[tuple(cell)] for cell in cells_of(points, grid.origin)])
    for v in np.random.default_rng(seed).choice(len(means), 60, replace=False):
        rings = np.abs(grid.cells - grid.cells[v]).max(axis=1)
        ring = next((r for r in range(1, MAX_RINGS + 1) if (rings <= r).sum() >= POOLED_VOXELS), MAX_RINGS)
        near = np.flatnonzero(rings <= ring)
        pooled = near[np.argsort(np.linalg.norm(means[near] - means[v], axis=1))[:POOLED_VOXELS]]
        fill_surface(grid, int(v))
        mean, normal, variance = grid.surfaces[v, :2] + grid.origin, grid.surfaces[v, 2:4], grid.surfaces[v, 4]
        if len(pooled) < 3:
            assert math.isinf(variance)
            continue
        inside = points[np.isin(rows, pooled)]
        values, axes = np.linalg.eigh(np.cov(inside.T, bias=True))
        np.testing.assert_allclose(mean, inside.mean(axis=0), atol=1e-9)
        assert abs(normal @ axes[:, 0]) == pytest.approx(1.0, abs=1e-6)
        assert variance == pytest.approx(values[0] + NOISE_M**2, rel=1e-6)


def test_fill_surface_of_thick_wall_has_its_thickness() -> None:
    rng, thickness = np.random.default_rng(0), 0.05
    across = rng.uniform(-0.5, 0.5, 20_000) * math.sqrt(12.0) * thickness
    wall = np.column_stack([rng.uniform(0.0, 4.0, 20_000), 0.2 + across])  # in one row of cells
    grid = make_grid(wall, 0.4, NOISE_M)
    for v in range(len(grid.cells)):
        fill_surface(grid, v)
    inner = (grid.surfaces[:, 0] + grid.origin[0] > 0.8) & (grid.surfaces[:, 0] + grid.origin[0] < 3.2)
    np.testing.assert_allclose(grid.surfaces[inner, 4], thickness**2 + NOISE_M**2, rtol=0.1)
    assert np.abs(grid.surfaces[inner, 3]).min() > 0.99


def test_fill_surface_of_two_voxels_has_no_thickness() -> None:
    grid = make_grid(np.array([[0.01, 0.01], [0.11, 0.01], [0.02, 0.03], [5.0, 5.0]]), CELL, NOISE_M)
    for v in range(len(grid.cells)):
        fill_surface(grid, v)
    assert np.isinf(grid.surfaces[:, 4]).all()


def test_measure_shares_equal_counted_points() -> None:
    rng = np.random.default_rng(2)
    mapped, scan = rng.uniform(-2.0, 2.0, (3000, 2)), rng.uniform(-1.0, 3.0, (500, 2))
    grid, drawn = make_grid(mapped, CELL, NOISE_M), make_grid(scan, CELL, NOISE_M)
    cells, counts = np.unique(cells_of(mapped, np.zeros(2)), axis=0, return_counts=True)
    known = {tuple(cell): n for cell, n in zip(cells, counts, strict=True)}
    own_cells, own_counts = np.unique(cells_of(scan, np.zeros(2)), axis=0, return_counts=True)
    pairs = [(n, known.get(tuple(cell), 0)) for cell, n in zip(own_cells, own_counts, strict=True)]
    share = sum(n * n / (n + m) for n, m in pairs) / len(scan)
    new = sum(n for n, m in pairs if m == 0) / len(scan)
    np.testing.assert_allclose(measure_shares(grid, drawn), (share, new), rtol=1e-9)
    assert 0.3 < new < 0.7


@pytest.mark.parametrize("copies", [1, 3, 9])
def test_measure_shares_of_place_mapped_n_times_is_1_of_n_plus_1(copies: int) -> None:
    points = scatter(3)
    share, new = measure_shares(make_grid(np.tile(points, (copies, 1)), CELL, NOISE_M), make_grid(points, CELL, NOISE_M))
    assert share == pytest.approx(1.0 / (copies + 1))
    assert new == 0.0
