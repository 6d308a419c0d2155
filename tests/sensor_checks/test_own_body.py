"""Beams that hit the robot itself."""

from __future__ import annotations

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.events import Scan, Step
from localization.sensor_checks.faults import FaultLog
from localization.sensor_checks.inflation import CovarianceInflation
from localization.sensor_checks.own_body import LIDAR_OWN_BODY, LIDAR_OWN_PARTS, OwnBody
from localization.simulation import world
from motion_models.motion import Motion
from tests.helpers import checked_drive, rooms
from tests.helpers.event_faults import named_faults, without_gyro
from tests.helpers.fault_drives import in_room, run

ANGLES = np.linspace(-np.pi, np.pi, 360, endpoint=False)
POST_RANGE_M = 0.3


def scan(k: int, rng: np.random.Generator) -> Scan:
    """Walls at ranges that change, a post on the robot over 20 beams, and a point that is not finite."""
    ranges = rng.uniform(2.0, 8.0, len(ANGLES))
    ranges[:20] = POST_RANGE_M
    points = np.column_stack([ranges * np.cos(ANGLES), ranges * np.sin(ANGLES), np.zeros(len(ANGLES))])
    points[100] = np.nan
    return Scan(1_000_000_000 + k, points)


def step(k: int, rng: np.random.Generator, delta: np.ndarray) -> Step:
    """With a scan, on a robot that moves by ``delta`` (3,)."""
    return Step(k * 10**8, (k + 1) * 10**8, Motion(delta, np.eye(3)), np.zeros(3), np.zeros(3), False, True, None, scan(k, rng))


def test_post_on_driving_and_turning_robot_is_removed() -> None:
    faults, rng = FaultLog(CovarianceInflation()), np.random.default_rng(0)
    body = OwnBody(faults)
    sizes = [len(body.remove(step(k, rng, np.array([0.1, 0.0, 0.05]))).scan.points) for k in range(30)]
    assert sizes[0] == len(ANGLES)
    assert sizes[-1] == len(ANGLES) - 20
    body.report()
    assert list(faults.found) == [LIDAR_OWN_PARTS]


def test_nothing_is_removed_from_scans_of_a_robot_at_rest() -> None:
    faults, rng = FaultLog(CovarianceInflation()), np.random.default_rng(0)
    body = OwnBody(faults)
    assert all(len(body.remove(step(k, rng, np.zeros(3))).scan.points) == len(ANGLES) for k in range(30))
    body.report()
    assert faults.found == {}


def test_few_scans_far_apart_show_no_part_of_the_robot() -> None:
    """Half a metre and 12 degrees from scan to scan: the post has the same range in four of them, as a wall has by chance; ten show it."""
    rng, body = np.random.default_rng(0), OwnBody(FaultLog(CovarianceInflation()))
    sizes = [len(body.remove(step(k, rng, np.array([0.5, 0.0, 0.2]))).scan.points) for k in range(14)]
    assert sizes[:8] == [len(ANGLES)] * 8
    assert sizes[-1] == len(ANGLES) - 20


def scan_of(walls: np.ndarray, pose: np.ndarray, rng: np.random.Generator, cover: np.ndarray | None = None) -> Scan:
    """Ranges to ``walls`` (n, 5) from ``pose`` (3,) with 1 cm of noise, and where it is nearer, to what ``cover`` (360,) them."""
    ranges = rooms.look_around(walls, pose, ANGLES) + 0.01 * rng.normal(size=len(ANGLES))
    ranges = ranges if cover is None else np.where(np.isfinite(cover), np.minimum(ranges, cover), ranges)
    points = np.column_stack([ranges * np.cos(ANGLES), ranges * np.sin(ANGLES), np.zeros(len(ANGLES))])
    return Scan(1, points[np.isfinite(ranges)])


def drive_straight_on(
    walls: np.ndarray, *, cover: np.ndarray | None = None, is_stuck: bool = False, is_held_back: bool = False
) -> tuple[FaultLog, np.ndarray]:
    """4 m ahead by the wheels, of a robot that may be stuck, with an estimate that may be; faults, and the share of each scan left out."""
    faults, rng = FaultLog(CovarianceInflation()), np.random.default_rng(0)
    body, left_out = OwnBody(faults), []
    for k in range(40):
        pose = np.array([0.1 * (k + 1), 0.0, 0.0])
        seen = scan_of(walls, np.zeros(3) if is_stuck else pose, rng, cover)
        motion = Motion(np.array([0.1, 0.0, 0.0]), 1e-6 * np.eye(3))
        one = Step(k * 10**8, (k + 1) * 10**8, motion, np.zeros(3), np.zeros(3), False, True, None, seen)
        after = body.remove(one).scan
        assert after is not None
        left_out.append(1.0 - len(after.points) / len(seen.points))
        faults.inflation.reckoning.predict(one)
        faults.inflation.reckoning.correct(one, np.zeros(3) if is_held_back else pose, None)
        body.report()
    return faults, np.array(left_out)


CORRIDOR = world.box(-3.0, -0.7, 9.0, 0.8)
"""Walls that keep their ranges beside a robot that drives along it."""
HALL = np.concatenate([world.box(-4.0, -3.0, 12.0, 4.0), world.pillar(3.0, 1.5, 0.2), world.pillar(5.0, -1.5, 0.3)])
COVERS = {
    "mast ahead": np.where(np.abs(ANGLES) < 0.1, 0.3, np.inf),
    "post behind and to the left": np.where(np.abs(ANGLES - 2.0) < 0.1, 0.4, np.inf),
    "arc on the right": np.where((ANGLES < -0.7) & (ANGLES > -1.6), 0.3, np.inf),
    "arm at growing range": np.where((ANGLES > 0.3) & (ANGLES < 1.0), 0.4 + 0.5 * ANGLES, np.inf),
    "plate along the left side": np.where((ANGLES > 0.8) & (ANGLES < 2.3), 0.25 / np.maximum(np.sin(ANGLES), 0.1), np.inf),
}


@pytest.mark.parametrize("place", ["hall", "corridor"])
@pytest.mark.parametrize("part", COVERS)
def test_parts_of_the_robot_are_found_on_a_straight_drive(part: str, place: str) -> None:
    """Other beams go through where the world would have these surfaces."""
    cover, walls = COVERS[part], {"hall": HALL, "corridor": CORRIDOR}[place]
    faults, left_out = drive_straight_on(walls, cover=cover)
    assert left_out[0] == 0.0
    share = np.isfinite(cover).mean()
    assert left_out[-1] == pytest.approx(share, rel=0.3)
    assert list(faults.found) == ([LIDAR_OWN_PARTS] if share > 0.05 else [])  # a few points are left out without a word


@pytest.mark.parametrize("walls", [CORRIDOR, HALL, world.box(-3.0, -0.35, 9.0, 0.35)], ids=["corridor", "hall", "narrow"])
def test_walls_beside_a_robot_that_drives_straight_on_are_kept(walls: np.ndarray) -> None:
    faults, left_out = drive_straight_on(walls)
    assert left_out.max() == 0.0
    assert faults.found == {}


@pytest.mark.parametrize("walls", [CORRIDOR, HALL, world.box(-0.5, -0.6, 0.7, 0.5)], ids=["corridor", "hall", "corner"])
def test_robot_that_is_stuck_while_its_wheels_turn_sees_the_world(walls: np.ndarray) -> None:
    faults, left_out = drive_straight_on(walls, is_stuck=True)
    assert left_out.max() == 0.0
    assert faults.found == {}


def test_report_has_bearings_range_and_the_setting() -> None:
    (found,) = drive_straight_on(HALL, cover=COVERS["arc on the right"])[0].found.values()
    assert "at bearings of -91 to -40 deg of the LiDAR" in found.message
    assert "up to 0.30 m" in found.message
    assert "config.estimator.lidar.min_range_m: 0.40" in found.message


def test_estimate_that_the_robot_itself_has_held_back_goes_to_where_the_other_points_lead() -> None:
    faults, _ = drive_straight_on(HALL, cover=COVERS["arc on the right"], is_held_back=True)
    assert list(faults.found) == [LIDAR_OWN_BODY]
    assert faults.have_scans_led_away


def test_beams_on_the_robot_are_left_out_and_reported() -> None:
    def cover(points: np.ndarray) -> np.ndarray:
        points = points.copy()
        points[:100] = 0.3 * np.column_stack([np.cos(rooms.ANGLES[:100]), np.sin(rooms.ANGLES[:100]), np.zeros(100)])
        return points

    robot = checked_drive.CheckedDrive(scan=cover)
    checks = robot.drive()
    assert list(checks.found) == [LIDAR_OWN_PARTS]
    assert "28 % of the LiDAR's points are the robot itself" in checks.warnings()[0]
    last = robot.applied[-1].scan
    assert last is not None
    assert np.hypot(last.points[:, 0], last.points[:, 1]).min() > 0.5
    assert sum(step.restarts_map for step in robot.applied) == 1  # the map has these beams until then


@pytest.mark.extended
def test_map_with_the_robot_in_it_holds_the_pose_no_longer() -> None:
    """Without a gyro: scans matched with such a map led the estimate .64 m away; it goes back to where the wheels lead."""
    outcome = run(in_room(1), without_gyro(named_faults()["beams on the robot"]))
    assert not outcome.is_wrong, outcome.least_consistent
    assert outcome.last[0] < 0.2


def test_beams_of_two_lidars_on_the_robot_are_left_out() -> None:
    """Posts on the robot at other bearings of each LiDAR, whose scans come in turn; first 28 % of the points, at last none."""
    rng = np.random.default_rng(0)
    robot = checked_drive.CheckedDrive(has_scans=False)
    is_own = []
    for k in range(60):
        frame, beams = ("front", slice(0, 100)) if k % 2 else ("rear", slice(200, 300))
        ranges = rng.uniform(2.0, 8.0, len(ANGLES))
        ranges[beams] = POST_RANGE_M
        points = np.column_stack([ranges * np.cos(ANGLES), ranges * np.sin(ANGLES), np.zeros(len(ANGLES))])
        motion = Motion(np.array([0.1, 0.0, 0.05]), 1e-6 * np.eye(3))
        stamps = k * checked_drive.S // 10, (k + 1) * checked_drive.S // 10
        one = Step(*stamps, motion, np.zeros(3), np.zeros(3), False, True, None, Scan(stamps[1], points, frame_id=frame))
        step = robot.checks.apply(one, robot.estimator)
        robot.checks.inflate(step, Estimate(stamps[1], np.zeros(3), None, np.zeros(3), None), robot.estimator)
        applied = step.scan
        assert applied is not None
        is_own.append((np.hypot(applied.points[:, 0], applied.points[:, 1]) < 1.0).mean())
    assert is_own[0] == is_own[1] == 100 / 360
    assert max(is_own[-10:]) == 0.0
    assert "28 % of the LiDAR's points are the robot itself" in robot.checks.warnings()[0]
