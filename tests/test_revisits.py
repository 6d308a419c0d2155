"""Places seen again: drift is corrected where a place is recognised, and nothing happens where it is not surely the same."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

from localization.lidar import LidarMatcher, Revisit, RevisitConfig, body_points
from localization.lidar.lines import FitOptions, LineMap
from localization.lidar.revisit import Revisits
from localization.lidar.track import Place, Track
from localization.online.core import Core, Pair, ReplayConfig
from localization.simulate import world
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from tests import rooms

NO_SLIP = WheelNoise(*[0.0] * 8)
START = (6.0, 1.2, 0.0)
SCANNER = rooms.Beams(beams=240, view=math.radians(270.0), rate_hz=6.25, longest=6.0)


# --- a lap and a half ----------------------------------------------------------------------------------------------------------------


def ring(size: float = 20.0, width: float = 2.4) -> np.ndarray:
    """A square of corridors: things of different sizes at its corners, and bare walls between them, along which only wheels know."""
    rng = np.random.default_rng(7)
    walls = [world.box(0, 0, size, size), world.box(width, width, size - width, size - width)]
    for side in range(4):
        for k in range(3):
            s, a, b = rng.uniform(0.2, 3.4) + (0.0 if k % 2 else size - 4.5), rng.uniform(0.2, 0.6), rng.uniform(0.15, 0.5)
            corners = [(s, 0, s + a, b), (size - b, s, size, s + a), (s, size - b, s + a, size), (0, s, b, s + a)]
            walls.append(world.box(*corners[side]))
    return np.concatenate(walls)


def laps(seed: int) -> rooms.Drive:
    """75 m around `ring`, and 30 m of it again; the robot drives as it is told, and its wheels are wrong by their noise."""
    corner = (0.5 * math.pi / 2.0, 1.0, 2.0)
    way = rooms.path((1, 0, 0), (12.3, 1, 0), corner, *[(16.6, 1, 0), corner] * 5, (3, 1, 0), (1, 0, 0))

    def wheels(t: np.ndarray, twists: np.ndarray) -> np.ndarray:
        return twists + rooms.slip(twists, WheelNoise(), np.random.default_rng(seed)) * (twists[:, :1] > 0.0)

    return rooms.drive_through(ring(), way, seed, START, SCANNER, NO_SLIP, wheels)


def test_the_second_lap_corrects_the_drift_of_the_first() -> None:
    before, after, nees = [], [], []
    for seed in range(4):
        drive = laps(seed)
        core = Core(Pair(make_model("diff_drive", rooms.ROBOT), "ekf"), rooms.ROBOT, drive.mounts, True, ReplayConfig())
        truth = dict(zip(drive.stamps.tolist(), drive.poses, strict=True))
        last, n, first_ns = np.zeros(3), 0, 0
        for event in drive.events:
            for estimate in core.push(event):
                if estimate.stamp_ns not in truth:
                    continue
                error = se2.log(se2.between(truth[estimate.stamp_ns], estimate.pose))
                found = core.estimator.counts()["revisits"]
                if found > n:
                    if n == 0:
                        before.append(np.hypot(*last[:2]))
                        after.append(math.nan)
                        first_ns = estimate.stamp_ns
                    if estimate.stamp_ns - first_ns < 15e9:  # two that follow each other: the first may see one wall only
                        after[-1] = np.hypot(*error[:2])
                    nees.append(error @ np.linalg.solve(estimate.covariance, error))
                last, n = error, found
        assert n >= 1
    rms_before, rms_after = np.sqrt(np.mean(np.square(before))), np.sqrt(np.mean(np.square(after)))
    assert rms_before > 0.1  # or there were nothing to correct
    assert rms_after < 0.5 * rms_before
    # within one run they are no independent samples: four runs count
    assert 0.1 < np.mean(nees) < chi2.ppf(0.999, 12) / 4


# --- one place, by hand -----------------------------------------------------------------------------------------------------------------


def periodic(step: float = 1.5) -> np.ndarray:
    """A corridor whose doorposts repeat, all the same."""
    walls = [world.line(-60, -1.2, 100, -1.2), world.line(-60, 1.2, 100, 1.2)]
    walls += [world.box(x, y, x + 0.3, y + 0.3) for x in np.arange(-60, 100, step) for y in (-1.2, 0.9)]
    return np.concatenate(walls)


def crooked() -> np.ndarray:
    """A passage where no stretch is like another: both walls bend every two or three metres."""
    rng = np.random.default_rng(3)
    walls = []
    for side in (-1.0, 1.0):
        x = np.cumsum(rng.uniform(2.0, 3.0, 45)) - 30.0
        y = side * rng.uniform(1.2, 3.0, 45)
        walls += [world.line(*ends) for ends in zip(x[:-1], y[:-1], x[1:], y[1:], strict=True)]
    return np.concatenate(walls)


def clutter() -> np.ndarray:
    """A passage full of things that are no walls: legs of chairs and tables, none like another."""
    rng = np.random.default_rng(5)
    spots = rng.uniform((-30.0, 0.9), (60.0, 3.5), (420, 2)) * np.where(rng.random(420) < 0.5, 1.0, -1.0)[:, None] ** np.array([0, 1])
    return np.concatenate([world.box(x, y, x + rng.uniform(0.03, 0.08), y + rng.uniform(0.03, 0.08)) for x, y in spots])


def visit_again(
    walls: np.ndarray, off: tuple[float, float, float], sigma: tuple[float, float, float], is_thorough: bool = False
) -> tuple[list[Revisit], np.ndarray]:
    """Drive 30 m along x, 25 m elsewhere, and from x = 8 m on again, believing to have come there ``off`` (3,) with ``sigma`` (3,).

    Gives what was recognised first, in a list of one or none, and the error (n, 3) of its pose against the first visit."""
    rng = np.random.default_rng(0)
    angles = np.linspace(-2.4, 2.4, 240)
    lines, revisits = LineMap(0.4, 0.02, 100.0), Revisits(RevisitConfig(), FitOptions(0.4, 0.03, 0.02, 0.1, 0.3, 12), 0.2, is_thorough)

    def look(x: float, believed: np.ndarray, cov: np.ndarray, travel: float) -> Revisit | None:
        ranges = rooms.look_around(walls, np.array([x, 0.0, 0.0]), angles, 8.0) + 0.01 * rng.normal(size=len(angles))
        seen = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])[np.isfinite(ranges)]
        found = revisits.look(seen, lines, believed, cov, travel, round(travel * 1e9))
        if found is None:
            lines.insert(seen, believed, travel, revisits.ages)
        return found

    for x in np.arange(0.0, 30.0, 0.25):
        assert look(x, np.array([x, 0.0, 0.0]), 1e-8 * np.eye(3), x) is None
    found, errors = [], []
    for x in np.arange(8.0, 14.0, 0.25):
        believed = se2.compose(se2.compose([8.0, 0.0, 0.0], np.array(off)), [x - 8.0, 0.0, 0.0])
        again = look(x, believed, np.diag(np.square(sigma)), 55.0 + x - 8.0)
        if again is not None:
            found.append(again)
            errors.append(se2.log(se2.between([x, 0.0, 0.0], again.pose)))
            break
    return found, np.array(errors)


def test_a_place_is_recognised_as_far_as_drift_can_be() -> None:
    found, errors = visit_again(crooked(), (0.9, 0.3, 0.05), (0.8, 0.3, 0.06))
    assert found
    assert np.abs(errors[:, :2]).max() < 0.03
    assert np.abs(errors[:, 2]).max() < 0.005
    for revisit, error in zip(found, errors, strict=True):
        assert error @ np.linalg.solve(revisit.cov, error) < chi2.ppf(0.9999, 3)
        assert 0.0 < revisit.then.travel < 30.0
        assert np.sqrt(revisit.cov[0, 0]) < 0.05


def test_among_clutter_a_place_is_recognised_where_it_is_looked_for_thoroughly() -> None:
    """Of what lies on no line, the nearest points tell; that is not sure enough to move a robot there and then."""
    assert not visit_again(clutter(), (0.9, 0.3, 0.05), (0.8, 0.3, 0.06))[0]
    found, errors = visit_again(clutter(), (0.9, 0.3, 0.05), (0.8, 0.3, 0.06), is_thorough=True)
    assert [revisit.is_sure for revisit in found] == [False]
    assert np.abs(errors[:, :2]).max() < 0.1


@pytest.mark.parametrize("is_thorough", [False, True])
def test_a_periodic_corridor_tells_nothing_along_itself(is_thorough: bool) -> None:
    """Doors 1.5 m apart, drift of a metre: any of several doors may be this one."""
    found, errors = visit_again(periodic(), (0.7, 0.1, 0.02), (1.0, 0.3, 0.06), is_thorough)
    for revisit, error in zip(found, errors, strict=True):
        assert np.sqrt(revisit.cov[0, 0]) > 10.0  # against a drift of 1 m: nothing
        assert abs(error[1]) < 0.05
        gain = revisit.growth @ np.linalg.inv(revisit.growth + revisit.cov)
        assert abs(gain[0, 0]) < 0.02


@pytest.mark.parametrize("is_thorough", [False, True])
def test_a_place_that_drift_cannot_reach_is_another(is_thorough: bool) -> None:
    """The same walls, believed to be 0.9 m and 18 sigma away: it merely looks alike."""
    found, _ = visit_again(crooked(), (0.9, 0.0, 0.0), (0.05, 0.05, 0.01), is_thorough)
    assert not found


def test_bare_walls_tell_hardly_anything_along_themselves() -> None:
    bare = np.concatenate([world.line(-60, -1.2, 100, -1.2), world.line(-60, 1.2, 100, 1.2)])
    found, errors = visit_again(bare, (0.9, 0.3, 0.05), (0.8, 0.3, 0.06))
    for revisit, error in zip(found, errors, strict=True):  # they tell the way across; noise in their normals claims a little more
        assert np.sqrt(revisit.cov[0, 0]) > 0.3
        assert error @ np.linalg.solve(revisit.cov, error) < chi2.ppf(0.999, 3)


# --- nothing is forgotten ----------------------------------------------------------------------------------------------------------------


def test_what_was_seen_of_late_moves_as_one() -> None:
    rng = np.random.default_rng(0)
    old, young = rng.uniform(-5.0, 0.0, (200, 2)), rng.uniform(1.0, 6.0, (200, 2))
    lines = LineMap(0.5, 0.001, 50.0)
    lines.insert(old, np.zeros(3), 1.0)
    lines.insert(young, np.zeros(3), 30.0)
    assert len(lines.point_cloud()) == 400
    world_T_world = np.array([0.3, -0.2, 0.1])
    lines.move_since(20.0, world_T_world)
    found = lines.point_cloud()
    assert len(found) == 400

    def nearest(points: np.ndarray) -> float:
        return float(np.min(np.hypot(*(points[:, None] - found[None]).transpose(2, 0, 1)), axis=1).max())

    assert nearest(old) < 1e-5
    assert nearest(se2.transform(world_T_world, young)) < 1e-5


def test_after_a_correction_the_same_scan_is_where_it_was_among_the_latest() -> None:
    drive = rooms.drive_through(world.lab().walls, rooms.path((4.0, 0.4, 0.3)), 0, noise=NO_SLIP)
    matcher = LidarMatcher()
    scans = [event for event in drive.events if hasattr(event, "points")]
    sure = np.diag([1e-4, 1e-4, 1e-4])
    for scan, pose in zip(scans, drive.poses, strict=True):
        points = body_points(scan, drive.mount, np.array([0.4, 0.0, 0.3]))
        matcher.register(points, True, pose, sure)
        matcher.recall(pose, 1e-6 * np.eye(3), scan.stamp_ns)
        matcher.insert(pose)
    before = matcher.register(points, True, drive.poses[-1], sure)
    after = se2.compose([0.8, -0.5, 0.3], before.pose)
    matcher.correct(before.pose, after)
    again = matcher.register(points, True, after, sure)
    assert again.is_trusted
    np.testing.assert_allclose(se2.log(se2.between(after, again.pose)), 0.0, atol=0.003)


def test_ways_share_the_errors_of_where_they_part() -> None:
    """A random walk in the plane: the covariance of now against then is that of the walk since then."""
    rng, step = np.random.default_rng(0), np.diag([1e-4, 4e-4, 1e-5])
    track, pose, cov = Track(), np.zeros(3), np.zeros((3, 3))
    poses, covs = [pose], [cov]
    track.add(Place(0, 0.0, pose, cov))
    for k in range(1, 20):
        motion = np.array([1.0, 0.0, 0.2 * rng.normal()])
        A = se2.adjoint(se2.inverse(motion))
        pose, cov = se2.compose(pose, motion), A @ cov @ A.T + step
        track.add(Place(k, float(k), pose, cov))
        poses.append(pose)
        covs.append(cov)
    for then in (0, 7, 18):
        since = np.zeros((3, 3))
        for k in range(then + 1, 20):
            A = se2.adjoint(se2.inverse(se2.between(poses[k - 1], poses[k])))
            since = A @ since @ A.T + step
        np.testing.assert_allclose(track.growth(then), since, rtol=1e-6, atol=1e-12)
    track.tie(3)  # the pose was corrected by what was seen at place 3: it is as sure as that one, and a bit less
    tied = se2.between(poses[3], poses[3])
    track.add(Place(20, 20.0, se2.compose(poses[3], tied), covs[3] + step))
    np.testing.assert_allclose(track.growth(3), step, rtol=1e-6, atol=1e-12)


def test_a_map_is_mended_as_it_was_moved_point_by_point() -> None:
    """A correction moves what was drawn after 19.4 m, between two keyframes; on the way as it was then, the map is where it was before."""
    rng = np.random.default_rng(0)
    lines, revisits = LineMap(0.4, 0.02, 100.0), Revisits(RevisitConfig(), FitOptions(0.4, 0.03, 0.02, 0.1, 0.3, 12), 0.2, is_thorough=True)
    walls, angles, T = crooked(), np.linspace(-2.4, 2.4, 120), np.array([5.0, 0.0, 0.0])
    poses = {}
    for x in np.arange(0.0, 25.0, 0.3):
        pose = np.array([x, 0.0, 0.0])
        ranges = rooms.look_around(walls, pose, angles, 8.0) + 0.01 * rng.normal(size=len(angles))
        seen = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])[np.isfinite(ranges)]
        revisits.look(seen, lines, pose, 1e-8 * np.eye(3), x, round(x * 1e9))
        lines.insert(seen, pose, x, revisits.ages)
        poses[round(x * 1e9)] = pose
    lines.move_since(19.4, T)
    revisits.correct(T, 19.4)
    travels = lines.point_travels()
    mended = revisits.mend(lines.point_cloud(), travels, lambda stamps: np.array([poses[s] for s in stamps.tolist()]))
    late = [i for i, t in enumerate(travels.tolist()) if 19.4 < t < 20.4]
    assert len(late) > 10
    clouds = lines.point_cloud()
    assert np.abs(mended[late] - (clouds[late] - T[:2])).max() < 1e-6
    early = np.flatnonzero(travels <= 19.4)
    assert np.abs(mended[early] - clouds[early]).max() < 1e-6
