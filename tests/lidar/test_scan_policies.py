"""A frozen scanner, and a robot that was moved."""

from __future__ import annotations

import numpy as np
import pytest

from localization.events import Scan, Step
from localization.lidar import LidarConfig
from localization.lidar.scan_policies import MOVED_COV, MovedRobot, StaleScans
from motion_models import se2
from motion_models.motion import Motion


def scan(seed: int, n: int = 5) -> Scan:
    return Scan(0, np.random.default_rng(seed).normal(size=(n, 3)))


def test_is_stale_with_same_ranges_while_driving_is_true() -> None:
    checks = StaleScans()
    found = [checks.is_stale(scan(seed), False) for seed in (0, 1, 1, 1, 2, 1)]
    assert found == [False, False, True, True, False, False]


def test_is_stale_with_same_ranges_at_rest_is_false() -> None:
    """As in a simulator without noise."""
    checks = StaleScans()
    assert not any(checks.is_stale(scan(0), True) for _ in range(5))


def test_is_stale_after_freezing_on_the_way_stays_true_at_rest() -> None:
    checks = StaleScans()
    found = [
        checks.is_stale(scan(seed), standing) for seed, standing in ((0, False), (0, False), (0, True), (0, True), (1, True), (1, True))
    ]
    assert found == [False, True, True, True, False, False]


def test_is_stale_with_empty_scans_is_false() -> None:
    checks = StaleScans()
    assert not any(checks.is_stale(scan(0, 0), False) for _ in range(3))


def test_is_stale_tells_scanners_apart() -> None:
    """Both are frozen, and their scans alternate."""
    checks = StaleScans()
    scans = [Scan(0, scan(k % 2).points, frame_id="ab"[k % 2]) for k in range(6)]
    assert [checks.is_stale(s, False) for s in scans] == [False, False, True, True, True, True]


def step(stamp_ns: int, way: float = 0.0) -> Step:
    return Step(0, stamp_ns, Motion(np.array([way, 0.0, 0.0]), np.zeros((3, 3))), np.zeros(3), np.zeros(3), False, True)


def is_moved(moved: MovedRobot, step: Step, scan: Scan, share: float, *, is_matched: bool) -> bool:
    motion = se2.compose(moved.since, step.predicted.delta)
    return moved.is_moved(step, scan, motion, share, is_matched=is_matched)


def test_is_moved_where_the_map_is_lost_at_once_while_the_wheels_stand() -> None:
    moved = MovedRobot(LidarConfig())
    moved.begin(scan(0))
    assert not is_moved(moved, step(1), scan(1), 0.9, is_matched=True)
    assert is_moved(moved, step(2), scan(2), 0.1, is_matched=False)
    np.testing.assert_array_equal(moved.cov(step(2)), MOVED_COV)
    assert not is_moved(moved, step(3), scan(3), 0.1, is_matched=False)  # it was lost already
    assert moved.cov(step(3)) is None


@pytest.mark.parametrize(("way", "share", "is_matched"), [(0.5, 0.1, False), (0.0, 0.5, False), (0.0, 0.1, True)])
def test_is_moved_of_a_robot_that_drives_or_keeps_the_map_is_false(way: float, share: float, is_matched: bool) -> None:
    moved = MovedRobot(LidarConfig())
    moved.begin(scan(0))
    assert not is_moved(moved, step(1, way), scan(1), share, is_matched=is_matched)
    assert moved.cov(step(1)) is None


def test_is_moved_counts_the_way_since_the_last_scan() -> None:
    """Sparse scans: steps without one lie between."""
    moved = MovedRobot(LidarConfig())
    moved.begin(scan(0))
    for k in range(3):
        moved.add_no_scan(step(k, 0.2))
    assert not is_moved(moved, step(3), scan(1), 0.1, is_matched=False)


def test_is_moved_tells_frames_apart() -> None:
    """A second LiDAR sees another part of the map than the first."""
    moved = MovedRobot(LidarConfig())
    moved.begin(scan(0))
    other = Scan(0, scan(1).points, frame_id="rear")
    assert not is_moved(moved, step(1), other, 0.1, is_matched=False)
    assert is_moved(moved, step(1), scan(2), 0.1, is_matched=False)
