"""The account of a filter's true errors: covariances as large as the errors where scans share a map, and estimates that do not move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from localization.consistency import mean_band
from localization.estimators.account import _LOOSE, Account, _shared
from localization.estimators.ekf import Ekf
from localization.estimators.fusion import EkfFusion
from localization.estimators.witness import ScanWitness
from localization.events import Scan
from localization.lidar import LidarConfig, LidarMatcher, MapTie, body_points
from localization.lidar.lines import LEVER_M, FitOptions, LineMap, Spread
from localization.lidar.noise import Noise
from localization.lidar.track import positive_part
from localization.simulate import world
from localization.steps import Step
from motion_models import se2
from motion_models.base import Motion
from motion_models.corrections import Corrections, corrections
from motion_models.registry import make_model
from motion_models.robot import GyroNoise
from tests import rooms

ROOM = np.concatenate([world.box(-6, -4, 6, 4), world.box(-6, -4, -5, -3), world.pillar(4.5, 2.8)])
WAY = rooms.path((1, 0, 0), (5, 0.4, 0.4), (4, 0.4, -0.5))
SCANNER = rooms.Beams(beams=240, rate_hz=6.25)
RUNS = 24


def spd(rng: np.random.Generator, n: int, scale: float = 1.0) -> np.ndarray:
    A = rng.normal(size=(n, n))
    return np.asarray(scale * (A @ A.T / n + 0.1 * np.eye(n)))


def test_it_is_the_covariance_of_errors_that_are_made() -> None:
    """Errors of 40 000 filters with gains that are nobody's best, drawn one by one."""
    rng, n, count = np.random.default_rng(0), 5, 40_000
    draw = lambda cov: rng.multivariate_normal(np.zeros(len(cov)), cov, count)  # noqa: E731
    P, rows = spd(rng, n), np.eye(n)[:3]
    e = draw(P)
    account, m, drawn = Account(P, rows, 16.0, has_mark=True), e[:, :3].copy(), e[:, :3].copy()
    marked, held, restricted = drawn.copy(), None, 0
    for k in range(4):
        F, Q = np.eye(n), spd(rng, n, 0.1)
        delta = rng.normal(size=3)
        F[:3, :3] = se2.adjoint(se2.inverse(delta))
        F[:3, 3:] = 0.2 * rng.normal(size=(3, n - 3))
        e, m, drawn = e @ F.T + draw(Q), m @ F[:3, :3].T, drawn @ F[:3, :3].T
        marked = marked @ F[:3, :3].T
        account.move(delta, F[:3, 3:], Q)
        told = np.linalg.inv(spd(rng, 3, 0.02))
        old = 0.8 * np.linalg.inv(np.linalg.inv(told) + spd(rng, 3, 0.02))
        all_of = told + _LOOSE * np.eye(3)  # with what holds it where the scene does not
        kept, total = np.linalg.solve(all_of, old), np.linalg.inv(told + 0.1 * np.eye(3))
        if held is not None:  # where it is more than three times that by which the last scan was held, the rest was drawn of late
            back = np.linalg.inv(F[:3, :3])
            held = back.T @ held @ back
            ratios, V = eigh(old, held)
            restricted += int((ratios > 3.0).any())
            kept = np.linalg.solve(all_of, (held @ V * np.minimum(ratios, 3.0)) @ (held @ V).T)
        held, part = all_of, 0.4 * total @ told @ total
        tie = MapTie(told, old, 0.4 * told, spd(rng, 3, 0.3))
        by_map = np.linalg.solve(all_of, np.linalg.solve(all_of, tie.of_map).T)
        fresh = positive_part(by_map - kept @ by_map)
        m = m @ kept.T + drawn @ (np.eye(3) - kept).T + draw(fresh)
        K, d = 0.3 * rng.normal(size=(n, 3)), np.eye(3) + 0.1 * rng.normal(size=(3, 3))
        swept = draw(tie.sweep)
        doubt = spd(rng, 3, 0.3) if k % 2 else np.zeros((3, 3))
        found = m + draw(total - part) + swept + draw(doubt)
        e = e - (e[:, :3] - found) @ d.T @ K.T
        account.see(K, d, total, tie, doubt)
        account.draw(k != 2)
        if k != 2:
            drawn = e[:, :3] - swept @ (K[:3] @ d).T
        K, H, R = 0.3 * rng.normal(size=(n, 1)), rng.normal(size=(1, n)), np.array([[0.2]])
        e = e - (e @ H.T + draw(R)) @ K.T
        account.correct(K, H, R)
        if k == 1:
            account.mark()
            marked = e[:, :3].copy()
    assert restricted  # or that rule would not have been tried
    W = np.linalg.inv(np.linalg.cholesky(account.mark()))
    np.testing.assert_allclose(W @ np.cov((e[:, :3] - marked).T) @ W.T, np.eye(3), atol=0.05)
    W = np.linalg.inv(np.linalg.cholesky(account.covariance))
    np.testing.assert_allclose(W @ np.cov(e.T) @ W.T, np.eye(n), atol=0.05)


def _filter() -> tuple[Ekf, Corrections]:
    corrected = corrections(make_model("diff_drive", rooms.ROBOT), "constant")
    return Ekf(GyroNoise(), corrected), corrected


def test_where_no_error_is_shared_it_is_the_filters_own() -> None:
    """A map that is drawn anew by each scan, without errors of its own, is what the filter takes it for."""
    one, _ = _filter()
    other, _ = _filter()
    rng = np.random.default_rng(1)
    anew = MapTie(np.diag([1e5, 1e5, 1e5]), np.zeros((3, 3)), np.zeros((3, 3)))
    size = len(make_model("diff_drive", rooms.ROBOT).param_names)
    for k in range(30):
        delta = np.array([0.05, 0.0, 0.1 * np.sin(k)])
        predicted = Motion(delta, np.diag([1e-4, 1e-5, 1e-4]), 0.01 * rng.normal(size=(3, size)))
        step = Step(k * 10**8, (k + 1) * 10**8, predicted, delta / 0.1, np.zeros(3), False, True)
        seen = Motion(se2.compose(delta, se2.exp(1e-2 * rng.normal(size=3))), 1e-5 * np.eye(3))
        for ekf, tie in ((one, anew), (other, None)):
            ekf.predict(step)
            ekf.measure_motion(seen, 1.0, tie)
            ekf.set_anchor()
    np.testing.assert_array_equal(one.covariance, other.covariance)
    np.testing.assert_allclose(one.errors, one.covariance, rtol=1e-6, atol=1e-14)
    np.testing.assert_array_equal(other.errors, other.covariance)


def _drive(seed: int) -> rooms.Drive:
    return rooms.drive_through(ROOM, WAY, seed, scanner=SCANNER)


def _last_error(drive: rooms.Drive, kind: str) -> tuple[float, float]:
    """Squared sigmas of the last pose's error, and of its yaw's."""
    poses, covs = rooms.at_scans(drive, rooms.results(drive, kind)[kind])
    assert covs is not None
    error = se2.log(se2.between(drive.poses[-1], poses[-1]))
    return float(error @ np.linalg.solve(covs[-1], error)), float(error[2] ** 2 / covs[-1][2, 2])


@pytest.mark.parametrize("kind", ["ekf", "graph"])
def test_in_a_room_errors_are_as_large_as_is_said(kind: str) -> None:
    nees, yaw = zip(*(_last_error(_drive(seed), kind) for seed in range(RUNS)), strict=True)
    low, high = mean_band(RUNS, 3.0)
    assert low <= np.mean(nees) <= high
    assert np.mean(yaw) < mean_band(RUNS, 1.0)[1]  # what the sweep adds: without it, some five times too sure of the heading


def test_no_error_of_the_map_grows_from_scan_to_scan() -> None:
    """Also where walls are so nearly parallel that one scan by itself would make a hundred times as much of it."""
    rng, scale, grown = np.random.default_rng(3), np.array([1.0, 1.0, LEVER_M]), 0
    for _ in range(300):
        angle, apart = rng.uniform(-np.pi, np.pi), 10.0 ** rng.uniform(-4.0, 0.0)
        n = np.array([[np.cos(a), np.sin(a), rng.normal()] for a in (angle, angle + apart, angle - 0.5 * apart)])
        parts = [10.0 ** rng.uniform(3.0, 8.0) * np.outer(row, row) for row in n]
        information, old = sum(parts), parts[0] + rng.uniform() * parts[1]
        _, kept, fresh = _shared(information, old, 0.4 * information, np.zeros((3, 3)))
        grown += np.linalg.norm(np.linalg.solve(information + _LOOSE * np.eye(3), old) * scale[:, None] / scale, 2) > 2.0
        assert np.linalg.norm(kept * scale[:, None] / scale, 2) < 1.0 + 1e-6
        assert np.linalg.eigvalsh(fresh).min() > -1e-12
    assert grown > 30  # or nothing was held back


LONG_WALLS = {
    "wall": world.line(-40, 3, 40, 3),
    "corridor": np.concatenate([world.line(-60, -1.2, 60, -1.2), world.line(-60, 1.2, 60, 1.2)]),
    "round room": world.pillar(0.0, 0.0, 6.0, 180),
}


@pytest.mark.parametrize("walls", LONG_WALLS)
@pytest.mark.parametrize("kind", ["ekf", "graph"])
def test_what_the_scene_leaves_open_grows_no_faster_than_the_wheels_errors(kind: str, walls: str) -> None:
    """Of two walls that are nearly parallel, errors across make larger ones along, other ones in each scan: they must not multiply."""
    way = rooms.path((2, 0, 0), (8, 0.25, 0.2), (4, 0.3, -0.2), (1, 0, 0))
    nees, runs = [], 6
    for seed in range(runs):
        drive = rooms.drive_through(LONG_WALLS[walls], way, seed, scanner=SCANNER, start=(1.0, 0.0, 0.0))
        found = rooms.results(drive, kind, "odometry")
        poses, covs = rooms.at_scans(drive, found[kind])
        _, by_wheels = rooms.at_scans(drive, found["odometry"])
        assert covs is not None
        assert by_wheels is not None
        assert (np.linalg.eigvalsh(covs) > -1e-12).all()
        # a lever of some metres makes of the heading's doubt one of the place
        reach = np.sqrt(by_wheels[:, 0, 0] + by_wheels[:, 1, 1] + 36.0 * by_wheels[:, 2, 2])
        assert (np.sqrt(covs[:, 0, 0] + covs[:, 1, 1]) < 2.0 * reach + 0.01).all()
        error = se2.log(se2.between(drive.poses[-1], poses[-1]))
        nees.append(float(error @ np.linalg.solve(covs[-1], error)))
    if walls != "round room":  # whose curved wall shifts what lines are laid through
        assert np.mean(nees) <= mean_band(runs, 3.0)[1]


@pytest.mark.parametrize("kind", ["ekf", "graph"])
def test_a_map_begun_by_a_sweep_that_nobody_could_set_right_is_known_as_badly(kind: str) -> None:
    """The wheels are heard too late for the first scan."""
    nees, late = [], rooms.WALL_START_NS + 5 * 10**8
    for seed in range(RUNS):
        drive = rooms.drive_through(ROOM, rooms.path((5, 0.4, 0.4), (4, 0.4, -0.5)), seed, scanner=SCANNER)
        events = [e for e in drive.events if isinstance(e, Scan) or e.stamp_ns > late]
        nees.append(_last_error(replace(drive, events=events), kind)[0])
    low, high = mean_band(RUNS, 3.0)
    assert low <= np.mean(nees) <= high


@pytest.mark.parametrize("kind", ["ekf", "graph"])
def test_a_drive_that_begins_in_motion_is_no_surer_than_it_is_right(kind: str) -> None:
    """The first scan is swept while the robot moves, and all others are matched with it."""
    ways = rooms.path((5, 0.4, 0.4), (4, 0.4, -0.5)), rooms.path((9, 0.0, 0.5))
    drives = (rooms.drive_through(ROOM, ways[seed % 2], seed, scanner=SCANNER) for seed in range(RUNS))
    nees = [_last_error(drive, kind)[0] for drive in drives]
    low, high = mean_band(RUNS, 3.0)
    assert low <= np.mean(nees) <= high


def test_it_moves_no_estimate_and_the_filter_stays_cautious(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[tuple[float, float]] = []
    step = EkfFusion.step

    def watched(self, s):
        estimate, ekf = step(self, s), self._ekf
        if s.scan is not None:
            said.append((np.trace(ekf.covariance[:2, :2]), np.trace(ekf.errors[:2, :2])))
        return estimate

    monkeypatch.setattr(EkfFusion, "step", watched)
    drive = _drive(0)
    with_it = rooms.results(drive, "ekf")["ekf"].trajectory
    cautious, errors = said[-1]
    assert cautious > 2.0 * errors
    look = ScanWitness.look

    def untied(self, s, anchor, guess):
        seen = look(self, s, anchor, guess)
        return None if seen is None else replace(seen, tie=None)

    monkeypatch.setattr(ScanWitness, "look", untied)
    without = rooms.results(drive, "ekf")["ekf"].trajectory
    np.testing.assert_array_equal(with_it.poses, without.poses)


def old_part(tie: MapTie) -> float:
    return float(np.trace(np.linalg.solve(tie.information + 0.01 * np.eye(3), tie.old))) / 3.0


def test_a_matcher_says_how_much_of_the_map_it_met_before() -> None:
    drive = rooms.drive_through(ROOM, rooms.path((1, 0, 0), (4, 0.4, 0.0)), 0)
    scans = [e for e in drive.events if isinstance(e, Scan)]
    matcher, kept = LidarMatcher(LidarConfig()), []
    for scan, pose in zip(scans, drive.poses, strict=True):
        found = matcher.register(body_points(scan, drive.mount, np.zeros(3)), True, pose, 1e-4 * np.eye(3))
        if found is not None:
            kept.append(old_part(found.tie))
        matcher.insert(pose)
    assert kept[0] < 0.01  # all of it was drawn by the scan before
    assert 0.9 < kept[-1] <= 1.0
    again = matcher.register(body_points(scans[-1], drive.mount, np.zeros(3)), True, drive.poses[-1], 1e-4 * np.eye(3))
    anew = matcher.register(body_points(scans[-1], drive.mount, np.zeros(3)), True, drive.poses[-1], 1e-4 * np.eye(3))
    assert again is not None
    assert anew is not None
    assert old_part(again.tie) < old_part(anew.tie)  # what the last scan added is new to one scan only


def test_a_line_is_as_sure_as_the_points_that_make_it() -> None:
    """Without noise of its own, a scan along a wall is as far off as the map's points are in the mean."""
    rng, sigma, errors, said = np.random.default_rng(2), 0.01, [], []
    x = np.linspace(-3.0, 3.0, 400)
    scan = np.column_stack([np.linspace(-3.0, 3.0, 301), np.full(301, 2.0)])
    options = FitOptions(0.6, 3.0 * sigma, 0.0, 10.0, 10.0, 10)
    for _ in range(200):
        lines = LineMap(0.6, 0.0, 100.0)
        lines.insert(np.column_stack([x + 0.01 * rng.normal(size=len(x)), 2.0 + sigma * rng.normal(size=len(x))]), np.zeros(3))
        free = np.diag([1e6, 1e-6, 1e-6])  # the wall leaves its own direction free
        found = lines.fit(scan, np.zeros(3), options, free, np.zeros(3))
        errors.append(found.pose[1])
        # of the said variance, take away what the scan's own points would have
        said.append(1.0 / found.information[1, 1] - options.sigma_point**2 / len(scan))
    assert 0.75 < np.var(errors) / np.mean(said) < 1.3


def test_noise_is_what_scans_show() -> None:
    """Groups of 10 points in 40 cells, whose means are off by the lines' errors, and a pose fitted to them."""
    rng = np.random.default_rng(3)
    for sigma_line, part in ((0.0, 0.4), (0.004, 1.0)):
        noise, place, said = Noise(0.03, 0.02), 4e-6, []
        for _ in range(300):
            off = np.sqrt(sigma_line**2 + part * place) * rng.normal(size=40)
            points = off[:, None] + 0.004 * rng.normal(size=(40, 10))
            fit = np.linalg.qr(rng.normal(size=(40, 3)))[0]
            means = points.mean(axis=1)
            within = ((points - means[:, None]) ** 2).sum(axis=1)
            means = means - fit @ (fit.T @ means)
            noise.see(Spread(within.sum(), 360.0, (means**2).sum(), 40.0, (within / 90.0).sum(), 40.0 * place))
            said.append((*noise.sigmas_of_a_point, noise.sigma_line, noise.place_part))
        point, _, line, its_part = np.mean(said[50:], axis=0)
        assert point == pytest.approx(0.004, rel=0.02)
        assert its_part == pytest.approx(part, abs=0.06)
        assert line == pytest.approx(sigma_line, abs=4e-4)


def test_a_pose_takes_more_of_errors_that_neighbours_share() -> None:
    """40 groups around a room; three in a row share the points that make their lines, and with them their errors."""
    rng, place, part = np.random.default_rng(4), 4e-6, 0.5
    around = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    fit = np.linalg.qr(np.column_stack([np.ones(40), np.cos(around), np.sin(around)]))[0]
    found: dict[float, list[float]] = {1.0: [], 3.0: []}
    for alike, parts in found.items():
        noise = Noise(0.03, 0.02)
        for _ in range(2000):
            white = rng.normal(size=40)
            off = np.sqrt(part * place / 3.0) * (white + np.roll(white, 1) + np.roll(white, -1))
            points = off[:, None] + 0.003 * rng.normal(size=(40, 10))
            means = points.mean(axis=1)
            within = ((points - means[:, None]) ** 2).sum()
            means = means - fit @ (fit.T @ means)
            noise.see(Spread(within, 360.0, (means**2).sum(), 40.0, within / 90.0, 40.0 * place, alike=alike))
            parts.append(noise.place_part)
    assert np.mean(found[3.0][50:]) == pytest.approx(part, rel=0.05)
    assert np.mean(found[1.0][50:]) < 0.9 * part


@pytest.mark.parametrize("kind", ["ekf", "graph"])
def test_a_scanner_that_comes_back_is_believed_at_once(kind: str) -> None:
    """It says the same for 2 s while the robot drives: the wheels' drift is known again as soon as the room is seen."""
    drive = rooms.drive_through(ROOM, rooms.path((1, 0, 0), (10, 0.4, 0.5)), 3)
    scans = [event for event in drive.events if isinstance(event, Scan)]
    frozen = {scan.stamp_ns for scan in scans[61:86]}
    events = [
        replace(event, points=scans[60].points, offsets=scans[60].offsets)
        if event.stamp_ns in frozen and isinstance(event, Scan)
        else event
        for event in drive.events
    ]
    run = rooms.results(replace(drive, events=events), kind)[kind]
    poses, covs = rooms.at_scans(drive, run)
    assert covs is not None
    assert run.counts["stale"] == 25
    sigma = np.sqrt(covs[:, [0, 1], [0, 1]].sum(axis=1))
    error = np.hypot(*(poses - drive.poses)[:, :2].T)
    assert sigma[85] > 5.0 * sigma[59]
    assert error[85] < 3.0 * sigma[85]
    assert sigma[90:].max() < 2.0 * sigma[59]
    assert (error[90:] < 3.5 * sigma[90:]).all()
