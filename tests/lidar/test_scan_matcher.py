"""Scans in a submap: poses, what the scan alone measures, and its covariance, against the truth of simulated rooms."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from localization.lidar import LidarConfig, ScanMatch, ScanMatcher, choose_cell, scan_matcher, submap
from localization.lidar.key_scans import KeyScan
from localization.lidar.registration import _KERNEL, linearize
from localization.lidar.submap import make_grid
from localization.simulation import world
from motion_models import se2
from motion_models.compiled import kernel
from tests.helpers import rooms
from tests.helpers.extended import cases

fill_surface, find_nearest = kernel(submap.fill_surface), kernel(submap.find_nearest)
LAB, HALL = world.lab().walls, world.hall().walls
CORRIDOR = np.concatenate([world.line(-60, -1.2, 60, -1.2), world.line(-60, 1.2, 60, 1.2)])
WALL = world.line(-60, 2.0, 60, 2.0)
CELL = 0.08
NARROW = np.diag([0.03, 0.03, 0.02]) ** 2
WIDE = np.diag([1.0, 1.0, 0.3]) ** 2


def mapped(walls: np.ndarray, rng: np.random.Generator, start=(0.0, 0.0, 0.0), noise: float = 0.012) -> tuple[ScanMatcher, np.ndarray]:
    """A submap of six key scans at their true poses, and the pose (3,) of the next scan."""
    matcher = ScanMatcher(LidarConfig(), CELL)
    poses = [se2.compose(np.array(start), np.array([0.3 * k, 0.02 * k, 0.05 * k])) for k in range(7)]
    for pose in poses[:-1]:
        matcher.insert_key_scan(pose, rooms.scan_from(walls, pose, rng, noise))
    return matcher, poses[-1]


@functools.cache
def lab() -> tuple[ScanMatcher, np.ndarray]:
    return mapped(LAB, np.random.default_rng(7))


def perturbed(pose: np.ndarray, cov: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return se2.compose(pose, se2.exp(np.sqrt(np.diag(cov)) * rng.normal(size=3)))


def error_of(true: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return se2.log(se2.between(true, pose))


# --- the cost


def test_linearize_gradient_equals_cost_differences() -> None:
    """Geman-McClure's loss over distances from the nearest surfaces, computed here."""
    rng = np.random.default_rng(0)
    drawn = rooms.scan_from(LAB, np.zeros(3), rng)
    grid, points, x = make_grid(drawn, CELL, 0.02), rooms.scan_from(LAB, np.zeros(3), rng), np.array([0.01, -0.008, 0.003])
    at = se2.transform(x, points) - grid.origin
    rows = np.array([find_nearest(grid, *p, 2.5 * CELL) for p in at])
    for v in range(len(grid.cells)):
        fill_surface(grid, v)
    grid.surfaces[:, 5] = 0.0  # normals without noise: nothing is discounted
    is_used = (rows >= 0) & np.isfinite(grid.surfaces[rows, 4])
    surfaces, used = grid.surfaces[rows[is_used]], points[is_used]

    def residuals(d: np.ndarray) -> np.ndarray:
        moved = se2.transform(se2.compose(x, se2.exp(d)), used) - grid.origin
        return np.einsum("ni,ni->n", surfaces[:, 2:4], moved - surfaces[:, :2]) / np.sqrt(surfaces[:, 4])

    def cost(d: np.ndarray) -> float:
        u = residuals(d) ** 2
        return float(0.5 * np.sum(u * _KERNEL**2 / (_KERNEL**2 + u)))

    found = linearize(grid, points, x)
    H, g = found.information, found.gradient
    h = 1e-6
    np.testing.assert_allclose(g, [(cost(h * e) - cost(-h * e)) / (2 * h) for e in np.eye(3)], rtol=1e-5, atol=1e-4)
    J = np.stack([(residuals(h * e) - residuals(-h * e)) / (2 * h) for e in np.eye(3)], axis=-1)
    weights = (_KERNEL**2 / (_KERNEL**2 + residuals(np.zeros(3)) ** 2)) ** 2
    np.testing.assert_allclose(H, J.T @ (weights[:, None] * J), rtol=1e-5)
    assert found.overlap == pytest.approx(np.mean(residuals(np.zeros(3)) ** 2 < _KERNEL**2) * len(used) / len(points))


# --- the size of voxels


@pytest.mark.parametrize("beams", [60, 80, 120, 720])
def test_scan_with_few_beams_has_surfaces_in_its_own_submap(beams: int) -> None:
    """At rest it is matched, and its place is mapped: at 2 % of the range the one with 80 beams has surfaces for four points in ten."""
    rng, pose = np.random.default_rng(beams), np.zeros(3)
    first, again = (rooms.scan_from(LAB, pose, rng, beams=beams) for _ in range(2))
    matcher = ScanMatcher(LidarConfig(), choose_cell(LidarConfig(), first))
    matcher.insert_key_scan(pose, first)
    found = matcher.match(again, perturbed(pose, NARROW, rng), NARROW)
    assert found is not None
    assert found.overlap > LidarConfig().search_below
    assert np.abs(found.pose[:2]).max() < 0.03


def test_cell_of_many_beams_is_a_share_of_the_range() -> None:
    points = rooms.scan_from(HALL, np.zeros(3), np.random.default_rng(0))
    assert choose_cell(LidarConfig(), points) == pytest.approx(0.02 * np.median(np.hypot(*points.T)))


# --- poses


@pytest.mark.parametrize("walls", cases([LAB, HALL], ("lab",), ("lab", "hall")))
def test_match_near_prior_errs_by_millimetres(walls: np.ndarray) -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        matcher, true = mapped(walls, rng, (rng.uniform(-2, 0), rng.uniform(-1, 1), rng.uniform(-3, 3)))
        found = matcher.match(rooms.scan_from(walls, true, rng), perturbed(true, NARROW, rng), NARROW)
        assert found is not None
        error = np.abs(error_of(true, found.pose))
        assert error[:2].max() < 0.003
        assert error[2] < 0.001
        assert found.overlap > 0.9
        assert not found.outlier_cov.any()


def test_match_from_wide_prior_is_searched() -> None:
    """Sigmas of 1 m and .3 rad, far beyond Gauss-Newton's basin."""
    (matcher, true), right = lab(), 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        found = matcher.match(rooms.scan_from(LAB, true, rng), perturbed(true, WIDE, rng), WIDE)
        assert found is None or np.hypot(*error_of(true, found.pose)[:2]) < 0.01
        right += found is not None
    assert right >= 11


@pytest.mark.parametrize("off", [(0.5, 0.0, 0.0), (-0.35, 0.35, 0.0), (0.0, 0.0, 0.2), (0.35, -0.35, -0.2), (1.0, 0.0, 0.0)])
def test_match_with_outlier_prior_overrules_it(off: tuple[float, float, float]) -> None:
    """10 to 50 sigma off: the match says by how much wider the prior has to be."""
    matcher, true = lab()
    prior, cov = se2.compose(true, np.array(off)), np.diag([0.02, 0.02, 0.01]) ** 2
    found = matcher.match(rooms.scan_from(LAB, true, np.random.default_rng(0)), prior, cov)
    assert found is not None
    assert np.abs(error_of(true, found.pose)).max() < 0.005
    error = error_of(prior, found.measured)
    assert error @ np.linalg.solve(cov, error) > 50.0
    assert error @ np.linalg.solve(cov + found.outlier_cov, error) < 150.0
    assert np.linalg.eigvalsh(found.outlier_cov).min() > 0.0


@pytest.mark.parametrize("off", [(4.0, 2.0, 0.8), (0.0, 0.0, 1.6), (30.0, 0.0, 0.0)])
@pytest.mark.parametrize("sigma", cases([0.02, 0.5], ("0.5",)))
def test_match_with_hopeless_prior_gives_no_wrong_pose(off: tuple[float, float, float], sigma: float) -> None:
    matcher, true = lab()
    cov = np.diag([sigma, sigma, 0.4 * sigma]) ** 2
    found = matcher.match(rooms.scan_from(LAB, true, np.random.default_rng(0)), se2.compose(true, np.array(off)), cov)
    assert found is None or np.hypot(*error_of(true, found.pose)[:2]) < 0.01


def test_match_of_another_place_is_lost() -> None:
    matcher, true = lab()
    elsewhere = rooms.scan_from(HALL, np.array([0.5, 0.5, 1.0]), np.random.default_rng(0))
    assert matcher.match(elsewhere, true, NARROW) is None
    assert matcher.match(elsewhere, true, WIDE) is None


def test_match_of_an_unmapped_place_with_unlimited_prior_ends() -> None:
    """After minutes without any sensor the prior is a kilometre wide, and no surface is looked for so far from a point."""
    matcher, true = lab()
    points = rooms.scan_from(HALL, np.array([30.0, 20.0, 0.5]), np.random.default_rng(3))
    assert matcher.match(points + np.array([500.0, 300.0]), true, np.diag([1e3, 1e3, 10.0]) ** 2) is None


def one_place(walls: np.ndarray, cov: np.ndarray) -> ScanMatch | None:
    """A second scan from the place of the only key scan."""
    rng, matcher = np.random.default_rng(0), ScanMatcher(LidarConfig(), CELL)
    matcher.insert_key_scan(np.zeros(3), rooms.scan_from(walls, np.zeros(3), rng))
    return matcher.match(rooms.scan_from(walls, np.zeros(3), rng), np.zeros(3), cov)


@pytest.mark.parametrize(("prior_cov", "is_lost"), [(NARROW, False), (WIDE, True)], ids=["narrow", "wide"])
def test_match_of_half_a_scan_needs_a_narrow_prior(prior_cov: np.ndarray, is_lost: bool) -> None:
    """The other half hangs in unmapped space: people around the robot, or another place of which half looks alike."""
    matcher, pose = lab()
    rng = np.random.default_rng(3)
    points = rooms.scan_from(LAB, pose, rng)
    is_elsewhere = np.arange(len(points)) % 2 == 0
    points[is_elsewhere] = 0.4 * points[is_elsewhere] + 0.05 * rng.normal(size=(int(is_elsewhere.sum()), 2))
    match = matcher.match(points, pose, prior_cov)
    assert (match is None) == is_lost
    if match is not None:
        assert LidarConfig().lost_below < match.overlap < LidarConfig().search_below
        assert np.hypot(*error_of(pose, match.pose)[:2]) < 0.01


def test_match_in_ambiguous_place_is_lost() -> None:
    """Turns of a quarter look alike in a square room."""
    assert one_place(world.box(-3.0, -3.0, 3.0, 3.0), np.diag([0.3, 0.3, 1.0]) ** 2) is None


def test_match_with_wide_prior_in_corridor_stays_open() -> None:
    found = one_place(CORRIDOR, WIDE)
    assert found is None or np.sqrt(np.linalg.eigvalsh(found.cov)[-1]) > 1.0


# --- what the scan alone measures


def test_match_measured_is_independent_of_prior() -> None:
    """Priors 10 mm off that are as sure as the scan or surer: the pose gives way to them by up to 15 sigma, the measured pose by a tenth of
    that, as surfaces are associated where the pose is."""
    matcher, true = lab()
    points = rooms.scan_from(LAB, true, np.random.default_rng(3))
    free = matcher.match(points, true, np.diag([0.1, 0.1, 0.1]) ** 2)
    assert free is not None
    sigmas = np.sqrt(np.diag(free.cov))
    for off in ((0.01, 0.0, 0.0), (0.0, -0.01, 0.0), (0.004, 0.004, 0.002)):
        for sigma, least in ((0.001, 5.0), (0.003, 1.0), (0.01, 0.1)):
            found = matcher.match(points, se2.compose(true, np.array(off)), np.diag([sigma, sigma, 0.4 * sigma]) ** 2)
            assert found is not None
            pulled, left = (np.abs(error_of(free.measured, pose) / sigmas).max() for pose in (found.pose, found.measured))
            assert pulled > least
            assert left < 0.15 * pulled + 0.1


# --- its covariance


def matches(walls: np.ndarray, noise: float, n: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 3) of measured poses over seeds, and their covariances (n, 3, 3); five scans show what is to be expected of residuals."""
    errors, covs = [], []
    for seed in range(n):
        rng = np.random.default_rng(seed)
        matcher, true = mapped(walls, rng, (rng.uniform(-2, 0), rng.uniform(-1, 1), rng.uniform(-3, 3)), noise)
        for _ in range(6):
            found = matcher.match(rooms.scan_from(walls, true, rng, noise), perturbed(true, NARROW, rng), NARROW)
            assert found is not None
        errors.append(error_of(true, found.measured))
        covs.append(found.cov)
    return np.array(errors), np.array(covs)


@pytest.mark.parametrize(("walls", "noise"), cases([(LAB, 0.005), (LAB, 0.03), (HALL, 0.012)], ("hall",), ("lab", "noisy", "hall")))
def test_match_cov_equals_scatter_of_errors(walls: np.ndarray, noise: float) -> None:
    """Against a submap of true poses, whatever the noise of the scanner. The surfaces are averaged over voxels and their noise is an upper
    bound, so the scan may be up to twice as good as it says, in the mean of squares; it must not be worse."""
    errors, covs = matches(walls, noise)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covs), errors)
    assert 0.5 * 3.0 - 1.1 < nees.mean() < 3.0 + 1.55  # 3.1 sigma of the mean of 24 chi-squares


@pytest.mark.parametrize(("walls", "start"), [(CORRIDOR, (0.0, 0.2, 0.4)), (CORRIDOR, (0.0, 0.0, 1.5)), (WALL, (0.0, 0.0, 0.3))])
def test_match_cov_along_bare_walls_is_open(walls: np.ndarray, start: tuple[float, float, float]) -> None:
    matcher, true = mapped(walls, np.random.default_rng(0), start)
    prior = se2.compose(true, np.array([0.05 * math.cos(true[2]), -0.05 * math.sin(true[2]), 0.0]))  # off along the walls
    found = matcher.match(rooms.scan_from(walls, true, np.random.default_rng(1)), prior, np.diag([0.1, 0.1, 0.02]) ** 2)
    assert found is not None
    (low, high), axes = np.linalg.eigh(found.cov[:2, :2])
    assert math.sqrt(low) < 0.01
    assert math.sqrt(high) > 1.0
    assert abs(axes[:, 1] @ [math.cos(true[2]), -math.sin(true[2])]) > math.cos(0.02)
    assert found.cov[2, 2] < 0.005**2
    along, across = se2.transform(np.array([0.0, 0.0, true[2]]), error_of(prior, found.pose)[None, :2])[0]
    assert abs(along) < 0.01  # the prior holds it
    assert abs(across) < 0.01


def test_match_that_fits_far_from_the_prior_needs_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight sigma off a narrow prior, Gauss-Newton finds the pose by itself: the prior is an outlier."""
    monkeypatch.setattr(scan_matcher, "find_place", lambda *a: pytest.fail("searched"))
    matcher, true = mapped(LAB, np.random.default_rng(0))
    cov = np.diag([0.003, 0.003, 0.002]) ** 2
    prior = se2.compose(true, np.array([0.024, -0.016, 0.01]))
    found = matcher.match(rooms.scan_from(LAB, true, np.random.default_rng(1)), prior, cov)
    assert found is not None
    assert found.outlier_cov.any()
    assert np.abs(error_of(true, found.pose)).max() < 0.003


@pytest.mark.parametrize("walls", [LAB, HALL])
def test_match_cov_in_a_room_is_closed(walls: np.ndarray) -> None:
    matcher, true = mapped(walls, np.random.default_rng(0))
    found = matcher.match(rooms.scan_from(walls, true, np.random.default_rng(1)), true, NARROW)
    assert found is not None
    assert math.sqrt(np.linalg.eigvalsh(found.cov[:2, :2])[1]) < 0.01


# --- key scans


@pytest.mark.parametrize("n", [1, 4])
def test_insert_key_scan_share_is_that_of_its_place(n: int) -> None:
    """After n scans from one place, the next has a share of 1 / (n + 1). A little more, as noise
    moves some of its points to voxels that were empty."""
    rng, matcher = np.random.default_rng(0), ScanMatcher(LidarConfig(), CELL)
    first = matcher.insert_key_scan(np.zeros(3), rooms.scan_from(LAB, np.zeros(3), rng))
    assert first.share == 1.0
    for _ in range(n - 1):
        matcher.insert_key_scan(np.zeros(3), rooms.scan_from(LAB, np.zeros(3), rng))
    key = matcher.insert_key_scan(np.zeros(3), rooms.scan_from(LAB, np.zeros(3), rng))
    assert 0.95 / (n + 1) < key.share < 1.35 / (n + 1)
    assert 0.0 < np.sqrt(np.linalg.eigvalsh(key.new_cov).max()) < 0.01


@pytest.mark.parametrize("noise", cases([0.006, 0.012, 0.024], ("0.012",)))
def test_insert_key_scan_of_first_has_its_noise(noise: float) -> None:
    """Scans that are matched to the first one share its noise, whatever the scanner's is: NEES of 30 rooms' worth of pairs, 3 expected."""
    squares = []
    for seed in range(30):
        rng, matcher = np.random.default_rng(seed), ScanMatcher(LidarConfig(), CELL)
        first = matcher.insert_key_scan(np.zeros(3), rooms.scan_from(LAB, np.zeros(3), rng, noise))
        found = matcher.match(rooms.scan_from(LAB, np.zeros(3), rng, noise), np.zeros(3), NARROW)
        assert found is not None
        error = error_of(np.zeros(3), found.measured)
        squares.append(error @ np.linalg.solve(found.cov + first.new_cov, error))
    assert 1.5 < np.mean(squares) < 4.5


def test_submap_holds_last_key_scans_only() -> None:
    rng, matcher = np.random.default_rng(0), ScanMatcher(LidarConfig(key_scans=3), CELL)
    for k in range(5):
        matcher.insert_key_scan(np.array([10.0 * k, 0.0, 0.0]), rng.uniform(-1.0, 1.0, (100, 2)))
    assert matcher.submap.points().shape == (300, 2)
    assert matcher.submap.points()[:, 0].min() > 18.0


@pytest.mark.parametrize(("drift_m", "stays"), [(0.03, True), (0.05, False)])
def test_submap_keeps_old_scan_while_drift_is_small(drift_m: float, stays: bool) -> None:
    """The noise of a range is 0.02 m. Three submaps' worth of old key scans stay at most."""
    rng, matcher = np.random.default_rng(0), ScanMatcher(LidarConfig(key_scans=2), CELL)
    for k in range(20):
        cov = np.diag([drift_m**2 * (k >= 10), 0.0, 0.0])
        matcher.insert_key_scan(np.array([10.0 * k, 0.0, 0.0]), rng.uniform(-1.0, 1.0, (100, 2)), cov)
        if k == 10:
            assert matcher.submap.points().shape == (100 * (8 if stays else 2), 2)
    assert matcher.submap.points().shape == (800, 2)


def test_drift_variance_of_yaw_counts_by_range() -> None:
    """An error of 1 mrad moves walls at 5 m by 5 mm, at 50 m by 50 mm; the same error carried along to another place is no drift."""
    cov = np.diag([0.0, 0.0, 1e-6])
    key = KeyScan(np.zeros((1, 2)), np.zeros(3), np.zeros((3, 3)))
    assert key.drift_variance(np.zeros(3), cov, 5.0) == pytest.approx(25e-6)
    assert key.drift_variance(np.zeros(3), cov, 50.0) == pytest.approx(2500e-6)
    there = np.array([7.0, -2.0, 1.0])
    A = se2.adjoint(se2.inverse(there))
    assert KeyScan(np.zeros((1, 2)), np.zeros(3), cov).drift_variance(there, A @ cov @ A.T, 5.0) == pytest.approx(0.0, abs=1e-12)


# --- spoilt scans


@pytest.mark.parametrize(
    "points",
    [np.tile([[1.0, 1.0]], (200, 1)), np.zeros((200, 2)), np.column_stack([np.linspace(30.0, 50.0, 50), np.zeros(50)])],
    ids=["one place", "the origin", "far away"],
)
def test_match_of_odd_points_is_not_confident(points: np.ndarray) -> None:
    matcher, true = mapped(LAB, np.random.default_rng(7))

    def check(found: ScanMatch | None) -> None:
        if found is not None:
            assert np.isfinite(found.pose).all()
            assert np.sqrt(np.linalg.eigvalsh(found.cov)[-1]) > 0.1

    check(matcher.match(points, true, NARROW))
    check(matcher.match(points, true, WIDE))
    matcher.insert_key_scan(true, points)
    good = matcher.match(rooms.scan_from(LAB, true, np.random.default_rng(0)), true, NARROW)
    assert good is not None
    assert np.abs(error_of(true, good.pose)).max() < 0.005


# --- scans that slip has bent


@pytest.mark.parametrize("walls", cases([LAB, HALL], ("lab",), ("lab", "hall")))
@pytest.mark.parametrize("axes", cases([[0.06, 0.03, 0.0], [0.0, 0.0, 0.01], [0.03, 0.02, 0.01]], ("all",), ("xy", "yaw", "all")))
def test_bend_cov_equals_scatter_of_bent_scans(walls: np.ndarray, axes: list[float]) -> None:
    """One scan, its beams 0.1 s from first to last, bent by random walks about its middle, by less than the kernel of the loss."""
    rng = np.random.default_rng(3)
    matcher, pose = mapped(walls, rng)
    points = rooms.scan_from(walls, pose, rng)
    times = np.linspace(-0.05, 0.05, len(points))
    sigmas = np.array(axes)
    straight = matcher.match(points, pose, NARROW)
    assert straight is not None
    found = []
    for _ in range(200):
        walk = np.cumsum(rng.normal(size=(len(points), 3)) * sigmas * np.sqrt(times[1] - times[0]), axis=0)
        drift = se2.exp(walk[len(walk) // 2] - walk)
        bent = se2.compose(drift, np.column_stack([points, np.zeros(len(points))]))[:, :2]
        match = matcher.match(np.ascontiguousarray(bent), pose, NARROW)
        assert match is not None
        found.append(error_of(straight.measured, match.measured))
    cov = matcher.intra_scan_slip_cov(points, times, straight.pose, np.diag(sigmas**2))
    scatter = np.sqrt(np.mean(np.square(found), axis=0))
    np.testing.assert_allclose(scatter, np.sqrt(np.diagonal(cov)), rtol=0.2)
