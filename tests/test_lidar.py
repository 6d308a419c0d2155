"""Scan matching: what it claims of itself, against second differences, the truth of simulated rooms, and scans that are spoilt."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from localization.estimators.base import Estimate
from localization.events import Scan
from localization.lidar import LidarMatcher, Slip, Sweep, body_points
from localization.lidar.lines import FitOptions, LineFit, LineMap, Spread
from localization.lidar.noise import Noise
from localization.lidar_tilt import LidarTilt, ground
from localization.online.core import Core, Pair, ReplayConfig
from localization.simulate import world
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount, WheelNoise
from tests import rooms

NO_SLIP = WheelNoise(*[0.0] * 8)
LAB = world.lab().walls
HALL = world.hall().walls
CORRIDOR = np.concatenate([world.line(-60, -1.2, 60, -1.2), world.line(-60, 1.2, 60, 1.2)])
WALL = world.line(-60, 2.0, 60, 2.0)
SURE = np.diag([1e-4, 1e-4, 1e-4])
HARDLY = np.diag([0.5, 0.5, 0.2]) ** 2
TOUR = rooms.path((1, 0, 0), (9, 0.4, 0.5), (9, 0.4, -0.5), (4, 0, 0.5), (1, 0, 0))


def scans_of(drive: rooms.Drive) -> list[Scan]:
    return [event for event in drive.events if isinstance(event, Scan)]


def mapped(walls: np.ndarray, twists: np.ndarray, seed: int = 0, start=(0.0, 0.0, 0.0), scanner: rooms.Beams | None = None):
    """A matcher whose map is drawn from the true poses of a drive; the drive, and its last registration."""
    drive = rooms.drive_through(walls, twists, seed, start, scanner, NO_SLIP)
    rng, matcher, found = np.random.default_rng(seed), LidarMatcher(), None
    twist = se2.log(se2.between(drive.poses[:-1], drive.poses[1:])) * 12.5
    for scan, pose, t in zip(scans_of(drive), drive.poses, [*twist, twist[-1]], strict=True):
        guess = se2.compose(pose, se2.exp(0.01 * rng.normal(size=3)))
        found = matcher.register(body_points(scan, drive.mount, t), True, guess, SURE)
        matcher.insert(pose)
    return matcher, drive, found


# --- the quadratic -----------------------------------------------------------------------------------------------------------------


def test_the_information_is_the_curvature_of_the_cost() -> None:
    """Straight walls, points without noise: the cost is sum w e^2 / 2 with e the distance from the walls, computed here by hand."""
    x, y = np.arange(-3.0, 3.0, 0.05), np.arange(-2.0, 2.0, 0.05)
    walls = np.concatenate([np.column_stack([x, np.full(len(x), 2.0)]), np.column_stack([np.full(len(y), 3.0), y])])
    lines = LineMap(0.4, 0.01, 50.0)
    lines.insert(walls, np.zeros(3))
    points = np.concatenate([walls[10:100:3], walls[130:190:3]])
    options = FitOptions(0.2, 0.03, 0.0, 1e3, 1e3, 0)  # a kernel that is plainly quadratic, lines without errors of their own
    pose = np.array([0.004, -0.003, 0.001])
    here = se2.transform(se2.inverse(pose), points)

    def cost(d: np.ndarray) -> float:
        at = se2.transform(se2.compose(pose, se2.exp(d)), here)
        is_top = np.abs(points[:, 1] - 2.0) < 1e-9
        return float(0.5 * np.sum(np.where(is_top, at[:, 1] - 2.0, at[:, 0] - 3.0) ** 2) / 0.03**2)

    fit = lines.fit(here, pose, options, np.zeros((3, 3)), pose)
    assert fit.n_matched == len(points)
    h = 1e-4
    eye = h * np.eye(3)
    H = np.array([[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4 * h * h) for b in eye] for a in eye])
    g = np.array([(cost(a) - cost(-a)) / (2 * h) for a in eye])
    np.testing.assert_allclose(fit.information, H, rtol=2e-3, atol=2e-3 * np.abs(H).max())
    np.testing.assert_allclose(fit.gradient, -g, rtol=2e-3, atol=1e-3 * np.abs(H).max() * 1e-3)


def test_points_of_one_cell_know_no_more_than_their_line() -> None:
    """A thousand points against lines that are wrong by 2 cm each are no better than the lines."""
    x = np.arange(0.0, 0.4, 0.01)
    lines = LineMap(0.5, 0.001, 50.0)
    lines.insert(np.column_stack([np.arange(-1.0, 1.4, 0.01), np.full(240, 0.25)]), np.zeros(3))
    variances = []
    for copies in (1, 100):
        points = np.tile(np.column_stack([x, np.full(len(x), 0.25)]), (copies, 1))
        fit = lines.fit(points, np.zeros(3), FitOptions(0.3, 0.03, 0.02, 1.0, 1.0, 0), np.zeros((3, 3)), np.zeros(3))
        variances.append(1.0 / fit.information[1, 1])
    assert variances[0] > 0.02**2
    assert 0.02**2 <= variances[1] < 1.05 * 0.02**2 + variances[0] / 50


# --- what the covariance says ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("walls", "start", "free"), [(CORRIDOR, (0.0, 0.2, 0.4), True), (WALL, (0.0, 0.0, 0.3), True), (LAB, (0.0, 0.0, 0.4), False)]
)
def test_the_covariance_opens_along_what_the_scene_does_not_hold(walls: np.ndarray, start, free: bool) -> None:
    _, _, found = mapped(walls, rooms.path((1.5, 0.0, 0.0)), start=start, scanner=rooms.Beams(longest=20.0))
    (low, high), axes = np.linalg.eigh(found.cov[:2, :2])
    assert found.is_trusted
    assert found.is_degenerate == free
    assert math.sqrt(low) < 0.01
    if free:
        assert abs(axes[:, 1] @ [math.cos(start[2]), -math.sin(start[2])]) > math.cos(0.01)  # along the walls
        assert math.sqrt(high) > 1.0
    else:
        assert math.sqrt(high) < 0.01


@pytest.mark.parametrize("walls", [LAB, HALL])
def test_registrations_are_as_good_as_they_say(walls: np.ndarray) -> None:
    """One registration a run, against a map drawn from true poses: the mean NEES is 3."""
    drive = rooms.path((0.5, 0.4, 0.0), (1.5, 0.4, 0.4), (1.5, 0.4, -0.3))
    total = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        start = (rng.uniform(-2, 0), rng.uniform(-1, 1), rng.uniform(-3, 3))
        _, driven, found = mapped(walls, drive, seed, start)
        error = se2.log(se2.between(driven.poses[-1], found.pose))
        total.append(error @ np.linalg.solve(found.cov, error))
    assert 1.45 < np.mean(total) < 4.55  # 3.1 sigma of the mean of 24 chi-squares


def test_a_map_is_not_turned_by_which_of_its_points_are_kept() -> None:
    """Where the next beam is kept only if it is not too near to the last, a point that noise moves on along the wall is kept more often,
    and walls that are met askew would turn."""
    turned = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        start = (rng.uniform(-2, 0), rng.uniform(-1, 1), rng.uniform(-3, 3))
        _, driven, found = mapped(HALL, rooms.path((1.6, 0.0, 0.3)), seed, start)
        turned.append(se2.log(se2.between(driven.poses[-1], found.pose))[2])
    assert np.std(turned) < math.radians(0.03)
    assert abs(np.mean(turned)) < 3.5 * np.std(turned) / math.sqrt(24)


@pytest.mark.parametrize("y", [0.36, 0.39, 0.41])
def test_a_wall_along_the_border_of_cells_is_drawn_where_it_is(y: float) -> None:
    """A scanner so noisy that the map is full before all is drawn: what a wall has on either side of a border counts as one."""
    rng, lines, x = np.random.default_rng(0), LineMap(0.4, 0.02, 50.0), np.arange(-3.0, 3.0, 0.02)
    for _ in range(60):
        lines.insert(np.column_stack([x, y + 0.04 * rng.normal(size=len(x))]), np.zeros(3))
    drawn = lines.point_cloud()[:, 1]
    assert abs(drawn.mean() - y) < 0.004
    assert 0.03 < drawn.std() < 0.08


# --- where the search begins -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("off", [(0.5, 0.0, 0.0), (-0.35, 0.35, 0.0), (0.0, 0.0, 0.2), (0.35, -0.35, -0.2)])
def test_a_guess_half_a_metre_off_converges(off) -> None:
    matcher, drive, _ = mapped(LAB, TOUR[:2500])
    scan, pose = scans_of(drive)[-1], drive.poses[-1]
    twist = se2.log(se2.between(drive.poses[-2], pose)) * 12.5
    found = matcher.register(body_points(scan, drive.mount, twist), True, se2.compose(pose, se2.exp(np.array(off))), HARDLY)
    error = se2.log(se2.between(pose, found.pose))
    assert found.is_trusted
    assert np.hypot(*error[:2]) < 0.01
    assert abs(error[2]) < 0.003


@pytest.mark.parametrize("off", [(4.0, 2.0, 0.8), (0.0, 0.0, 1.6), (30.0, 0.0, 0.0)])
def test_a_hopeless_guess_is_no_confident_wrong_pose(off) -> None:
    matcher, drive, _ = mapped(LAB, TOUR[:2500])
    pose = drive.poses[-1]
    found = matcher.register(
        body_points(scans_of(drive)[-1], drive.mount, np.zeros(3)), True, se2.compose(pose, se2.exp(np.array(off))), HARDLY
    )
    error = se2.log(se2.between(pose, found.pose))
    is_right = np.hypot(*error[:2]) < 0.05
    is_wide = np.sqrt(np.linalg.eigvalsh(found.cov)[-1]) > 0.3
    assert is_right or is_wide or not found.is_trusted


# --- motion within the sweep -------------------------------------------------------------------------------------------------------------


def _second_error(drive: rooms.Drive, poses: np.ndarray) -> tuple[float, float]:
    error = rooms.second_errors(drive, poses)
    return float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())), float(np.sqrt((error[:, 2] ** 2).mean()))


def test_points_are_moved_by_their_own_times() -> None:
    """Against the truth of a turning robot in a room: with the sweep's own times the walls are straight; with none, or as if the sweep
    filled all of the scan's period, they are not."""
    drive = rooms.drive_through(world.box(-4, -3, 5, 3), rooms.path((1.0, 0.3, 1.0)), 0, noise=NO_SLIP, scanner=rooms.Beams(noise=0.0))
    scan, pose = scans_of(drive)[3], se2.compose(drive.start, drive.poses[3])
    twist = np.array([0.3, 0.0, 1.0])
    fill = rooms.Beams().view / (2.0 * math.pi)

    def off(offsets: np.ndarray) -> float:
        points = se2.transform(pose, body_points(replace(scan, offsets=offsets), drive.mount, twist)[:, :2])
        from_walls = np.min(np.abs(np.stack([points[:, 0] + 4, points[:, 0] - 5, points[:, 1] + 3, points[:, 1] - 3])), axis=0)
        return float(np.sqrt(np.mean(from_walls**2)))

    assert off(scan.offsets) < 0.002
    assert off(np.empty(0)) > 0.02
    assert off(scan.offsets / fill) > 0.02


def test_deskewing_pays(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = rooms.drive_through(LAB, TOUR, 0)
    with_it = _second_error(drive, rooms.at_scans(drive, rooms.results(drive, "ekf")["ekf"])[0])
    blind = replace(drive, events=[replace(e, offsets=np.empty(0)) if isinstance(e, Scan) else e for e in drive.events])
    without = _second_error(drive, rooms.at_scans(drive, rooms.results(blind, "ekf")["ekf"])[0])
    monkeypatch.setattr(Slip, "measure", lambda self, rate, variance: np.zeros(3))
    by_wheels = _second_error(drive, rooms.at_scans(drive, rooms.results(drive, "ekf")["ekf"])[0])
    assert with_it[1] < 0.2 * without[1]
    assert with_it[0] < 0.5 * without[0]
    assert with_it[1] < 0.6 * by_wheels[1]  # what the wheels say of the sweep is wrong where they slip; what lasts, is learned


def test_slip_is_followed_and_forgotten() -> None:
    slip = Slip()
    usual = np.diag([1e-5, 1e-5, 1e-4])
    for _ in range(10):  # wheels that spin on the spot at 0.5 m/s
        slip.advance(0.08, usual, np.zeros(3))
        slip.measure(np.array([-0.5, 0.0, 0.0]), np.full(3, 0.02**2))
    assert slip.rate[0] == pytest.approx(-0.5, abs=0.05)
    assert abs(slip.rate[1:]).max() < 1e-12
    slip.advance(2.0, 25.0 * usual, np.zeros(3))
    assert abs(slip.rate[0]) < 0.01
    slip.advance(0.08, np.zeros((3, 3)), np.zeros(3))
    slip.measure(np.array([0.3, 0.0, 0.0]), np.full(3, 10.0**2))  # along a corridor nothing was measured
    assert abs(slip.rate[0]) < 0.02


def test_a_sweep_is_taken_back_as_the_robot_moves_whoever_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wheels that fall silent and come back are one witness more or less: the robot does not stop or start for it."""
    drive = rooms.drive_through(LAB, rooms.path((1, 0, 0), (10, 0.4, 0.3)), 2)
    gone = (rooms.WALL_START_NS + 3 * 10**9, rooms.WALL_START_NS + 8 * 10**9)
    heard = [e for e in drive.events if isinstance(e, Scan) or not gone[0] < e.stamp_ns < gone[1]]
    swept: dict[int, tuple[Sweep, np.ndarray]] = {}  # the first twist that was thought of each sweep
    at_stamp = Sweep.at_stamp

    def watched(self: Sweep, twist: np.ndarray) -> np.ndarray:
        swept.setdefault(id(self), (self, twist))
        return at_stamp(self, twist)

    monkeypatch.setattr(Sweep, "at_stamp", watched)
    rooms.results(replace(drive, events=heard), "ekf")
    thought = np.array([twist for _, twist in swept.values()])
    assert len(thought) == len(drive.stamps)
    off = np.abs(thought - [0.4, 0.0, 0.3])[drive.stamps > rooms.WALL_START_NS + 2 * 10**9]
    assert off.max() < 0.2


# --- noise -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.005, 0.012, 0.03])
def test_the_noise_of_the_scanner_is_learned(sigma: float) -> None:
    matcher, _, _ = mapped(HALL, rooms.path((4.0, 0.4, 0.2)), scanner=rooms.Beams(noise=sigma))
    across, along = matcher._noise.sigmas_of_a_point
    assert math.hypot(across, along) == pytest.approx(sigma, rel=0.15)
    assert across < 0.5 * sigma  # the scanner's noise is along its beams
    assert matcher._noise.sigma_line < 0.005


def test_parts_of_the_variance_are_told_apart() -> None:
    rng, noise = np.random.default_rng(0), Noise(0.03, 0.02)
    for _ in range(200):
        groups = 0.01 * rng.normal(size=(30, 1)) + 0.02 * rng.normal(size=(30, 20))
        means = groups.mean(axis=1)
        within = float(((groups - means[:, None]) ** 2).sum())
        noise.see(Spread(within, 570.0, float((means**2).sum()) - within / 570 / 20 * 30, 30.0))
    assert noise.sigmas_of_a_point == pytest.approx((0.02, 0.0), rel=0.03)
    assert noise.sigma_line == pytest.approx(0.01 * math.sqrt(30 / 27), rel=0.1)


def test_noise_along_the_beam_is_told_from_noise_across() -> None:
    """From groups whose points meet their lines at many angles: beams that graze a wall tell of the one, those that face it of both."""
    rng, noise, sigmas = np.random.default_rng(1), Noise(0.03, 0.02), (0.004, 0.015)
    for _ in range(50):
        facing = rng.uniform(0.0, 1.0, size=40)
        points = np.sqrt(sigmas[0] ** 2 + sigmas[1] ** 2 * facing)[:, None] * rng.normal(size=(40, 12))
        within = points.var(axis=1, ddof=1) * 11.0
        free = 11.0 * facing
        means, due = float((points.mean(axis=1) ** 2).sum()), float(within.sum() / 11.0 / 12.0)
        sums = within.sum(), 440.0, means, 40.0, due, 0.0, free.sum(), (free * facing).sum(), within @ facing
        noise.see(Spread(*(float(value) for value in sums)))
    assert noise.sigmas_of_a_point == pytest.approx(sigmas, rel=0.15)


def test_a_heap_of_points_is_no_line() -> None:
    """A robot at rest sees the same spots again and again, spread by noise along the beam: that is not how the wall runs."""
    rng, beam = np.random.default_rng(0), np.array([0.9, math.sqrt(1.0 - 0.81)])
    spots = np.column_stack([np.arange(2.0, 6.0, 0.5), np.full(8, 2.0)])
    lines, options = LineMap(0.25, 0.0, 50.0), FitOptions(0.25, 0.001, 0.0, 1.0, 1.0, 0, sigma_beam=0.012)
    for _ in range(8):
        lines.insert(spots + 0.012 * rng.normal(size=(8, 1)) * beam, np.zeros(3))
    assert lines.fit(spots, np.zeros(3), options, np.zeros((3, 3)), np.zeros(3)).n_matched == 0
    lines.insert(np.column_stack([np.arange(2.0, 6.0, 0.02), np.full(200, 2.0)]), np.zeros(3))
    assert lines.fit(spots, np.zeros(3), options, np.zeros((3, 3)), np.zeros(3)).n_matched == 8


ROOM_MAP = np.concatenate(
    [np.column_stack([np.arange(-3.0, 3.0, 0.02), np.full(300, 2.0)]), np.column_stack([np.full(200, 3.0), np.arange(-2.0, 2.0, 0.02)])]
)


def test_what_is_of_no_line_does_not_pull() -> None:
    """A wall that was hidden before, 15 cm behind one that is known, seen by a tenth of the points: they are left out of the pose and of
    its information. Of a scan of which most is from elsewhere, nothing is left out."""
    rng, options = np.random.default_rng(0), FitOptions(0.3, 0.005, 0.0, 0.15, 0.45, 12)
    lines = LineMap(0.3, 0.0, 50.0)
    lines.insert(ROOM_MAP + 0.005 * rng.normal(size=ROOM_MAP.shape), np.zeros(3))
    seen = ROOM_MAP[::3] + 0.005 * rng.normal(size=ROOM_MAP[::3].shape)
    behind = np.column_stack([np.arange(-3.0, -2.0, 0.05), np.full(20, 2.15)])
    free = 1e-3 * np.eye(3)

    def fit(points: np.ndarray) -> LineFit:
        return lines.fit(points, np.array([0.02, -0.02, 0.01]), options, free, np.zeros(3))

    alone, both = fit(seen), fit(np.concatenate([seen, behind]))
    assert both.n_matched > alone.n_matched + 10
    np.testing.assert_allclose(both.pose, alone.pose, atol=5e-4)
    np.testing.assert_allclose(both.information, alone.information, rtol=0.02, atol=0.02 * np.abs(alone.information).max())
    lost = fit(np.concatenate([seen[::8], np.repeat(behind, 6, axis=0)]))
    assert np.hypot(*lost.pose[:2]) > 0.02


def test_a_fit_does_not_hang_on_single_points_of_the_map() -> None:
    """Few points, and crates among them: where the pose moves by a hair, what it is drawn to moves little."""

    def points(walls: np.ndarray, n: int) -> np.ndarray:
        ends, lengths = walls[:, :4], np.hypot(walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1])
        which = rng.choice(len(walls), n, p=lengths / lengths.sum())
        on_walls = ends[which, :2] + rng.random((n, 1)) * (ends[which, 2:] - ends[which, :2])
        return np.asarray(on_walls + 0.02 * rng.normal(size=(n, 2)))

    options, free, jumps = FitOptions(0.6, 0.02, 0.005, 0.15, 0.45, 0), 1e-9 * np.eye(3), []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        crates = [world.box(x, y, x + 0.3, y + 0.3) for x, y in rng.uniform(-1.2, 1.2, (6, 2)) * [6.0, 1.0]]
        walls, lines, drawn_to = np.concatenate([world.box(-9.0, -1.5, 9.0, 1.5), *crates]), LineMap(0.6, 0.03, 100.0), []
        lines.insert(points(walls, 300), np.zeros(3))
        seen = points(walls, 120)
        for x in np.arange(0.0, 0.02, 2e-5):
            fit = lines.fit(seen, np.array([x, 0.3 * x, 0.1 * x]), options, free, np.zeros(3))
            drawn_to.append(np.linalg.solve(fit.curvature, fit.gradient) / np.sqrt(np.diag(np.linalg.inv(fit.information))))
        jumps.append(np.abs(np.diff(drawn_to, axis=0)).max())
    assert np.mean(jumps) < 0.15  # sigmas
    assert np.max(jumps) < 0.5


def test_information_is_not_lost_to_the_kernel() -> None:
    """Points that follow their noise tell as much as by least squares, also where the kernel is as narrow as it gets."""
    rng, free = np.random.default_rng(1), 1e-3 * np.eye(3)
    lines = LineMap(0.3, 0.0, 50.0)
    lines.insert(ROOM_MAP, np.zeros(3))
    seen = ROOM_MAP[::3] + 0.01 * rng.normal(size=ROOM_MAP[::3].shape)
    narrow, plain = (lines.fit(seen, np.zeros(3), FitOptions(0.3, 0.01, 0.0, k, k, n), free, np.zeros(3)) for k, n in ((0.1, 9), (1e3, 0)))
    np.testing.assert_allclose(narrow.information, plain.information, rtol=0.03, atol=0.01 * np.abs(plain.information).max())


def test_lines_that_are_known_badly_tell_little_of_the_others() -> None:
    """A sixth of the wall is drawn four times as badly. What lines are off counts as much as it is known, so the good ones decide."""
    rng, noise = np.random.default_rng(2), Noise(0.005, 0.02)
    x = np.arange(-3.0, 3.0, 0.02)
    effective = []
    for _ in range(60):
        lines = LineMap(0.3, 0.0, 50.0)
        sigma = np.where(x < -2.0, 0.02, 0.005)
        lines.insert(np.column_stack([x, 2.0 + sigma * rng.normal(size=len(x))]), np.zeros(3))
        scan = np.column_stack([x, 2.0 + 0.005 * rng.normal(size=len(x))])
        options = FitOptions(0.3, 0.01, noise.sigma_line, 1e3, 1e3, 9, place_part=noise.place_part)
        found = lines.fit(scan, np.zeros(3), options, np.diag([1e6, 1e-3, 1e-3]), np.zeros(3))
        effective.append(found.spread.between_freedom)
        noise.see(found.spread)
    assert 12.0 < np.mean(effective) < 19.0  # of 20 or 21 groups
    assert noise.place_part > 0.5
    assert noise.sigma_line < 0.001


def test_a_point_at_the_robots_origin_does_no_harm() -> None:
    """A mast over the origin of the body, whose points draw a line as the robot drives."""
    lines, options = LineMap(0.25, 0.0, 50.0), FitOptions(0.25, 0.01, 0.0, 1.0, 1.0, 5)
    lines.insert(np.column_stack([np.arange(-1.0, 1.0, 0.02), np.zeros(100)]), np.zeros(3))
    found = lines.fit(np.zeros((1, 2)), np.zeros(3), options, np.eye(3), np.zeros(3))
    assert found.n_matched == 1
    assert np.isfinite(found.information).all()


def test_a_twist_in_the_sweep_moves_the_pose_as_the_lateness_says() -> None:
    matcher, drive, _ = mapped(LAB, TOUR[:2500])
    sweep, pose = Sweep.of(scans_of(drive)[-1], drive.mount), drive.poses[-1]
    twist = se2.log(se2.between(drive.poses[-2], pose)) * 12.5
    found = matcher.register(sweep.at_stamp(twist), True, pose, SURE, sweep.offsets)
    for d in 0.02 * np.eye(3):
        moved = [matcher.refine(sweep.at_stamp(twist + sign * d), True, found.pose, sweep.offsets).pose for sign in (-1.0, 1.0)]
        by_difference = 0.5 * se2.log(se2.between(moved[1], moved[0]))
        np.testing.assert_allclose(found.lateness @ d, by_difference, atol=0.1 * sweep.lateness * 0.02)


@pytest.mark.parametrize("walls", [LAB, HALL])
def test_a_pose_moved_by_its_derivative_is_where_a_second_match_finds_it(walls: np.ndarray) -> None:
    """A sweep that was undone with a twist so wrong that points move by a centimetre: what is left is less than half a sigma."""
    for seed in range(4):
        matcher, drive, _ = mapped(walls, TOUR[:2500], seed)
        sweep, pose = Sweep.of(scans_of(drive)[-1], drive.mount), drive.poses[-1]
        twist = se2.log(se2.between(drive.poses[-2], pose)) * 12.5
        missed = np.array([0.1, -0.05, 0.03])
        assert 0.008 < sweep.shift(missed) < 0.02
        found = matcher.register(sweep.at_stamp(twist - missed), True, pose, SURE, sweep.offsets)
        again = matcher.refine(sweep.at_stamp(twist), True, found.pose, sweep.offsets)
        amended = se2.compose(found.pose, se2.exp(-found.lateness @ missed))
        moved, left = (se2.log(se2.between(p, again.pose)) for p in (found.pose, amended))
        sigmas = np.sqrt(np.diag(found.cov))
        assert np.abs(moved / sigmas).max() > 1.0
        assert np.abs(left / sigmas).max() < 0.5


def test_a_wrong_sweep_moves_no_pose_far_along_walls_that_hold_nothing() -> None:
    """Wide open as the covariance is there, the pose is held by what the walls' directions feign: the derivative is of that pose."""
    for seed in range(4):
        matcher, drive, _ = mapped(CORRIDOR, rooms.path((1.5, 0.3, 0.3)), seed, (0.0, 0.2, 0.4), rooms.Beams(longest=20.0))
        sweep, pose = Sweep.of(scans_of(drive)[-1], drive.mount), drive.poses[-1]
        twist = se2.log(se2.between(drive.poses[-2], pose)) * 12.5
        found = matcher.register(sweep.at_stamp(twist), True, pose, SURE, sweep.offsets)
        assert math.sqrt(np.linalg.eigvalsh(found.cov[:2, :2])[1]) > 1.0
        for d in 0.02 * np.eye(3):
            assert np.hypot(*(found.lateness @ d)[:2]) < 0.02


@pytest.mark.parametrize("walls", [CORRIDOR, WALL, LAB])
def test_parts_of_a_covariance_are_no_more_than_all_of_it(walls: np.ndarray) -> None:
    """The map's, and what of it was drawn anew, also along walls that hold nothing."""
    _, _, found = mapped(walls, rooms.path((1.5, 0.3, 0.0)), start=(0.0, 0.2, 0.4), scanner=rooms.Beams(longest=20.0))
    scale = np.sqrt(np.diag(found.cov))
    by_map = found.cov @ found.tie.of_map @ found.cov
    for part in (by_map, found.cov - by_map):
        assert np.linalg.eigvalsh(part / np.outer(scale, scale)).min() > -1e-8
    root = np.sqrt(np.diag(found.tie.information))
    for less in (found.tie.old, found.tie.information - found.tie.old):
        assert np.linalg.eigvalsh(less / np.outer(root, root)).min() > -1e-8


# --- clouds ------------------------------------------------------------------------------------------------------------------------------


def cloud(walls: np.ndarray, pose: np.ndarray, seed: int, tilt: float = 0.0) -> np.ndarray:
    """(N, 3) 16 rings 0.8 m above a floor, in the body frame, which is pitched by ``tilt`` [rad]."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(-math.pi, math.pi, 400, endpoint=False)
    found = []
    for elevation in np.radians(np.linspace(-15.0, 15.0, 16)):
        c, s = math.cos(tilt), math.sin(tilt)
        ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.full(400, math.sin(elevation))])
        level = np.stack([c * ray[0] + s * ray[2], ray[1], -s * ray[0] + c * ray[2]])
        across = np.hypot(level[0], level[1])
        to_wall = rooms.look_around(walls, pose, np.arctan2(level[1], level[0])) / across
        with np.errstate(divide="ignore"):
            to_floor = np.where(level[2] < 0.0, -0.8 / level[2], np.inf)
        r = np.minimum(to_wall, to_floor) + 0.02 * rng.normal(size=400)
        found.append((r * ray).T)
    points = np.concatenate(found) + np.array([0.0, 0.0, 0.8])
    return points[np.isfinite(points).all(axis=1)]


@pytest.mark.parametrize("tilt", [0.0, 0.03])
def test_clouds_come_by_the_same_door(tilt: float) -> None:
    """The floor is most of a cloud and says nothing of the pose; a robot that pitches by 2 degrees is still where it is."""
    matcher = LidarMatcher()
    rng = np.random.default_rng(1)
    for k in range(12):
        pose = np.array([0.05 * k, 0.02 * k, 0.03 * k])
        guess = se2.compose(pose, se2.exp(np.array([0.02, 0.02, 0.01]) * rng.normal(size=3)))
        found = matcher.register(cloud(LAB, pose, k, tilt * math.sin(k)), False, guess, SURE)
        matcher.insert(pose)
    error = se2.log(se2.between(pose, found.pose))
    assert found.is_trusted
    assert np.hypot(*error[:2]) < (0.01 if tilt == 0.0 else 0.04)
    assert abs(error[2]) < 0.005
    assert found.cov[0, 0] < 0.03**2


def tilted(pitch, scans: int = 24) -> LidarTilt:
    """What clouds on a bend tell, whose scan k is pitched by ``pitch`` (k) [rad]."""
    found = LidarTilt({"laser": Mount(z=0.8)})
    for k in range(scans):
        points = cloud(LAB, np.array([0.05 * k, 0.02 * k, 0.03 * k]), k, pitch(k)) - np.array([0.0, 0.0, 0.8])
        found.see(Scan(k * 500_000_000, points, frame_id="laser", is_planar=False))
    return found


def test_clouds_that_are_tilted_are_told() -> None:
    assert tilted(lambda k: math.radians(0.4)).notes() == []
    (note,) = tilted(lambda k: math.radians(3.0)).notes()
    assert "by 3.0 deg (roll +0.0, pitch +3.0)" in note
    assert "mount of 'laser'" in note
    (note,) = tilted(lambda k: math.radians(4.0) * math.sin(0.7 * k)).notes()
    assert float(note.split("sway by ")[1].split()[0]) == pytest.approx(4.0 / math.sqrt(2.0), abs=0.2)
    assert "mount" not in note
    assert tilted(lambda k: math.radians(3.0), scans=9).notes() == []  # a glimpse is not enough


def test_a_mount_that_tells_the_tilt_is_believed() -> None:
    points = cloud(LAB, np.zeros(3), 0, math.radians(5.0)) - np.array([0.0, 0.0, 0.8])
    found = LidarTilt({"laser": Mount(z=0.8, pitch=math.radians(5.0))})
    for k in range(12):
        found.see(Scan(k * 500_000_000, points, frame_id="laser", is_planar=False))
    assert found.notes() == []


def test_only_a_ground_is_taken_for_one() -> None:
    rng = np.random.default_rng(0)
    across = rng.uniform(-8.0, 8.0, (2000, 2))
    level = np.array([-0.8, 0.05, -0.1])
    flat = np.column_stack([across, level[0] + across @ level[1:] + 0.01 * rng.normal(size=2000)])
    np.testing.assert_allclose(ground(flat), level, atol=0.01)
    steep = np.column_stack([across, 0.5 * across[:, 0]])
    heap = np.column_stack([across, rng.uniform(-2.0, 2.0, 2000)])
    strip = flat[np.abs(across[:, 1]) < 0.5]
    shelf = np.concatenate([flat, flat[np.abs(across).max(axis=1) < 3.5] - [20.0, 0.0, 3.0]])  # there is more below
    for none in (np.empty((0, 3)), flat[:5], steep, heap, strip, shelf):
        assert ground(none) is None


# --- spoilt scans ------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["empty", "one point", "nan", "inf", "all the same point"])
def test_scans_with_nothing_in_them_are_survived(kind: str) -> None:
    matcher, drive, _ = mapped(LAB, rooms.path((1.5, 0.3, 0.2)))
    n = 200
    points = {
        "empty": np.empty((0, 3)),
        "one point": np.array([[1.0, 0.0, 0.0]]),
        "nan": np.full((n, 3), np.nan),
        "inf": np.full((n, 3), np.inf),
        "all the same point": np.tile([[1.0, 1.0, 0.0]], (n, 1)),
    }[kind]
    before = matcher.point_cloud()
    scan = Scan(0, points, np.zeros(len(points)), "laser")
    sweep = Sweep.of(scan, Mount())
    assert np.isfinite(sweep.points).all()
    found = matcher.register(sweep.at_stamp(np.array([0.3, 0.0, 0.2])), True, drive.poses[-1], SURE)
    if found is not None:
        assert np.isfinite(found.pose).all()
        assert np.isfinite(found.cov).all()
        assert not found.is_trusted or np.sqrt(np.linalg.eigvalsh(found.cov)[-1]) > 0.1
    matcher.insert(drive.poses[-1])
    assert len(matcher.point_cloud()) <= len(before) + 1


def run(drive: rooms.Drive, spoil) -> tuple[list[Estimate], dict[str, int]]:
    """The filter's estimates of ``drive`` whose scan k is ``spoil`` (k, scan), None for one that never comes."""
    core = Core(Pair(make_model("diff_drive", rooms.ROBOT), "ekf"), rooms.ROBOT, drive.mounts, True, ReplayConfig())
    found, k = [], 0
    for event in drive.events:
        if isinstance(event, Scan):
            event, k = spoil(k, event), k + 1
        if event is not None:
            found += core.push(event)
    return found + core.finish(), dict(core.estimator.counts())


def worst(drive: rooms.Drive, estimates: list[Estimate], first: int, last: int) -> float:
    """[m] at scans ``first`` to ``last``."""
    at = {e.stamp_ns: e.pose for e in estimates}
    return max(float(np.hypot(*(at[int(s)] - p)[:2])) for s, p in zip(drive.stamps[first:last], drive.poses[first:last], strict=True))


SPOILT = range(60, 85)  # two seconds


@pytest.fixture(scope="module")
def driven() -> rooms.Drive:
    return rooms.drive_through(LAB, TOUR[:6000], 3)


def test_a_frozen_scanner_is_found_out(driven: rooms.Drive) -> None:
    frozen = scans_of(driven)[SPOILT.start]
    estimates, counts = run(driven, lambda k, s: replace(s, points=frozen.points, offsets=frozen.offsets) if k in SPOILT else s)
    assert counts["stale"] == len(SPOILT) - 1
    assert worst(driven, estimates, SPOILT.start, SPOILT.stop) < 0.1  # by wheels
    assert worst(driven, estimates, SPOILT.stop + 5, len(driven.poses)) < 0.02  # the old map is found again


def test_a_scanner_that_froze_on_the_way_is_no_better_when_the_robot_stands() -> None:
    drive = rooms.drive_through(LAB, rooms.path((1.5, 0.4, 0.2), (2.5, 0.0, 0.0), (1.5, 0.4, 0.2), (1.0, 0.0, 0.0)), 1)
    frozen = scans_of(drive)[8]
    estimates, counts = run(drive, lambda k, s: replace(s, points=frozen.points, offsets=frozen.offsets) if k > 8 else s)
    assert counts["stale"] == len(drive.stamps) - 9
    assert counts["standing"] > 30
    assert worst(drive, estimates, 0, len(drive.poses)) < 0.1  # by wheels


def test_a_robot_that_stands_may_see_the_same_again_and_again() -> None:
    """As in a simulator without noise."""
    drive = rooms.drive_through(LAB, rooms.path((1.0, 0.0, 0.0)), 1, scanner=rooms.Beams(noise=0.0))
    assert all(np.array_equal(scan.points, scans_of(drive)[0].points) for scan in scans_of(drive))
    _, counts = run(drive, lambda k, s: s)
    assert counts["stale"] == 0
    assert counts["matched"] == len(drive.stamps)


def test_a_scan_from_elsewhere_is_left_out(driven: rooms.Drive) -> None:
    off = np.array([0.9, 0.4, 0.3])

    def jump(k: int, scan: Scan) -> Scan:
        if k not in (60, 61, 90):
            return scan
        return replace(scan, points=np.column_stack([se2.transform(off, scan.points[:, :2]), scan.points[:, 2]]))

    estimates, counts = run(driven, jump)
    assert counts["jumps"] == 3
    assert worst(driven, estimates, 0, len(driven.poses)) < 0.03


def test_a_robot_that_was_carried_is_believed_at_last(driven: rooms.Drive) -> None:
    """Half a second is cut out of a log: 3 m/s from one scan to the next, against wheels that know nothing of it."""
    at, gap = int(driven.stamps[60]) + 1, 480_000_000
    before = [e for e in driven.events if e.stamp_ns < at]
    after = [e for e in driven.events if e.stamp_ns > at + gap]
    lost = [next(e for e in events if not isinstance(e, Scan)).position for events in (after, before[::-1])]
    after = [replace(e, stamp_ns=e.stamp_ns - gap) for e in after]
    after = [e if isinstance(e, Scan) else replace(e, position=e.position - lost[0] + lost[1]) for e in after]
    core = Core(Pair(make_model("diff_drive", rooms.ROBOT), "ekf"), rooms.ROBOT, driven.mounts, True, ReplayConfig())
    found = [estimate for event in before + after for estimate in core.push(event)] + core.finish()
    assert core.estimator.counts()["jumps"] == 5
    poses = np.array([e.pose for e in found if e.stamp_ns + gap in set(driven.stamps[70:].tolist())])
    np.testing.assert_allclose(poses[-20:, :2], driven.poses[-20:, :2], atol=0.02)


def test_without_scans_the_wheels_carry_on(driven: rooms.Drive) -> None:
    nothing = np.empty((0, 3))
    for spoil in (
        lambda k, s: None if k in SPOILT else s,
        lambda k, s: replace(s, points=nothing, offsets=nothing[:, 0]) if k in SPOILT else s,
    ):
        estimates, counts = run(driven, spoil)
        assert worst(driven, estimates, SPOILT.stop + 5, len(driven.poses)) < 0.02
        assert counts["matched"] >= len(driven.stamps) - len(SPOILT) - 2


@pytest.mark.parametrize("estimator", ["ekf", "graph"])
def test_scans_that_hold_nothing_to_match_are_told(estimator: str, driven: rooms.Drive) -> None:
    """Clouds of the floor alone, and a few points: neither is a scan without a point."""
    clouds = [cloud(LAB, np.zeros(3), k) for k in range(10)]
    floors = [
        replace(scan, points=c[c[:, 2] < 0.1], offsets=np.empty(0), is_planar=False)
        for scan, c in zip(scans_of(driven)[:10], clouds, strict=True)
    ]
    for spoilt in (floors, [replace(scan, points=scan.points[:9], offsets=scan.offsets[:9]) for scan in scans_of(driven)[:10]]):
        core = Core(Pair(make_model("diff_drive", rooms.ROBOT), estimator), rooms.ROBOT, driven.mounts, True, ReplayConfig())
        for event in sorted([*spoilt, *(e for e in driven.events[:50] if not isinstance(e, Scan))], key=lambda e: e.stamp_ns):
            core.push(event)
        core.finish()
        assert core.estimator.counts()["scans"] == 10
        assert core.estimator.counts()["matched"] == 0
        assert core.notes() == ["10 scans had too few points on walls to be matched: the wheels carried on alone."]


def test_scans_that_cannot_be_true_are_told(driven: rooms.Drive) -> None:
    frozen = scans_of(driven)[40]
    scans = [replace(frozen, stamp_ns=s.stamp_ns) if 40 < k <= 50 else s for k, s in enumerate(scans_of(driven)[:75])]
    strange = replace(scans[60], points=scans[60].points + np.array([0.9, 0.4, 0.0]))
    core = Core(Pair(make_model("diff_drive", rooms.ROBOT), "ekf"), rooms.ROBOT, driven.mounts, True, ReplayConfig())
    wheels = (e for e in driven.events if not isinstance(e, Scan))
    for event in sorted([*scans[:60], strange, *scans[61:], *wheels], key=lambda e: e.stamp_ns):
        core.push(event)
    assert core.notes() == [
        "10 scans told the very same ranges as the one before although the robot drove: the wheels carried on alone.",
        "1 scan would have moved the robot as no slip can: the wheels carried on alone.",
    ]


def test_a_degenerate_scene_is_counted() -> None:
    drive = rooms.drive_through(CORRIDOR, rooms.path((3.0, 0.5, 0.0)), 0, noise=NO_SLIP, scanner=rooms.Beams(longest=20.0))
    _, counts = run(drive, lambda k, s: s)
    assert counts["degenerate"] > 0.9 * counts["matched"]
    _, counts = run(rooms.drive_through(LAB, rooms.path((3.0, 0.3, 0.0)), 0), lambda k, s: s)
    assert counts["degenerate"] < 0.1 * counts["matched"]


# --- figures -----------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("walls", [LAB, HALL])
def test_errors_of_a_second(walls: np.ndarray) -> None:
    """Also under wheels that slip by a fifth of their turning, changing twice a second. Root mean square of three drives: one alone is
    off by a tenth and more."""
    for noise, most_rad in ((NO_SLIP, math.radians(0.03)), (WheelNoise(), math.radians(0.05))):
        drives = [rooms.drive_through(walls, TOUR, seed, noise=noise) for seed in (1, 2, 3)]
        errors = [_second_error(drive, rooms.at_scans(drive, rooms.results(drive, "ekf")["ekf"])[0]) for drive in drives]
        metres, radians = np.sqrt((np.array(errors) ** 2).mean(axis=0))
        assert metres < 0.0025
        assert radians < most_rad


def test_a_bare_corridor_is_as_long_as_the_wheels_say() -> None:
    noise = WheelNoise(lateral_m2_per_m=1e-6, yaw_rad2_per_m=1e-5)
    drive = rooms.drive_through(CORRIDOR, rooms.path((1, 0, 0), (30, 0.5, 0.0), (1, 0, 0)), 0, (0.0, 0.1, 0.02), noise=noise)
    found = {name: np.hypot(*rooms.at_scans(drive, r)[0][-1, :2]) for name, r in rooms.results(drive, "lidar", "ekf").items()}
    length = np.hypot(*drive.poses[-1, :2])
    assert found["ekf"] == pytest.approx(length, rel=0.02)
    assert found["lidar"] < 0.9 * length  # or the corridor were no test


def test_wheels_that_spin_on_the_spot_do_no_harm() -> None:
    def spinning(t: np.ndarray, twists: np.ndarray) -> np.ndarray:
        return twists + np.where((t > 6) & (t < 10), 0.5, 0.0)[:, None] * [1.0, 0.0, 0.0]

    way = rooms.path((1, 0, 0), (4, 0.4, 0.3), (6, 0, 0), (6, 0.3, 0.4), (1, 0, 0))
    drive = rooms.drive_through(HALL, way, 0, wheels=spinning)
    off = {name: rooms.ate(drive, rooms.at_scans(drive, r)[0]) for name, r in rooms.results(drive, "odometry", "lidar", "ekf").items()}
    assert off["odometry"] > 0.5
    assert off["ekf"] < 1.1 * off["lidar"]
    assert off["ekf"] < 0.02
