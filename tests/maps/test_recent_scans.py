"""Scans of the last keyframes stay joined while the odometry is by slipping wheels alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.maps.recent_scans import RecentMotion, RecentScans
from motion_models import se2
from tests.helpers import floor_plan
from tests.helpers.floor_plan import OFFICE, path

WHEELS = np.diag([0.02, 0.02, 0.08]) ** 2
SLIPPING = np.diag([0.2, 0.2, 0.2]) ** 2
WAY = path((1, 1), (4, 1), (4, 3.6), (7, 3.6), (7, 6.5))


def driven(seed: int, cov: np.ndarray = WHEELS) -> tuple[list[RecentMotion], list[np.ndarray], RecentScans]:
    """Motions as the scans have them, the true ones, and the scans."""
    rng, recent, found, moves = np.random.default_rng(seed), RecentScans(0.02), [], floor_plan.moves(WAY)
    for k, delta in enumerate(moves):
        points = floor_plan.scan(OFFICE, WAY[k], noise=0.02, seed=1000 * seed + k)
        measured = se2.compose(delta, rng.multivariate_normal(np.zeros(3), cov)) if k else delta
        found.append(recent.move(RecentMotion(measured, cov if k else np.zeros((3, 3))), points))
        recent.add(points)
    return found, list(moves), recent


def test_recent_scans_by_slipping_wheels_stay_joined() -> None:
    _, _, recent = driven(1)
    assert len(recent) == 12
    assert recent.way_m > 5.0
    walls = se2.transform(WAY[-1], recent.joined(0.08))
    distances = np.abs(np.stack([walls[:, 0] - x for x in (0, 5, 8, 12)] + [walls[:, 1] - y for y in (0, 2, 3, 8)])).min(axis=0)
    assert np.median(distances) < 0.05


@pytest.mark.extended
@pytest.mark.parametrize("cov", [WHEELS, SLIPPING], ids=["wheels", "slipping"])
def test_motions_by_scans_have_their_covariance(cov: np.ndarray) -> None:
    """Monte Carlo of 20 drives with 18 motions each: squares of normalised errors are those of three normal numbers, but for one
    in a hundred beyond 16.3, at most."""
    squares = []
    for seed in range(20):
        found, truth, _ = driven(seed, cov)
        for motion, delta in zip(found[1:], truth[1:], strict=True):
            off = se2.local(delta, motion.delta)
            squares.append(off @ np.linalg.solve(motion.cov, off))
    np.testing.assert_allclose(np.quantile(squares, [0.5, 0.9]), [2.37, 6.25], rtol=0.25)
    assert np.mean(np.array(squares) > 16.3) < 0.01


def test_recent_scans_of_a_carried_robot_are_forgotten() -> None:
    _, _, recent = driven(1)
    recent.move(RecentMotion(np.zeros(3), np.diag([3.0, 3.0, math.pi]) ** 2), np.empty((0, 2)))
    assert not len(recent)


def test_motion_that_is_uncertain_along_one_axis_alone_is_aligned() -> None:
    """A robot that stands, and may be pushed along a corridor only."""
    _, _, recent = driven(1)
    motion = recent.move(RecentMotion(np.zeros(3), np.diag([0.16, 0.0, 0.0]) ** 2), floor_plan.scan(OFFICE, WAY[-1], noise=0.02, seed=1))
    assert len(recent) == 12
    assert math.sqrt(motion.cov[0, 0]) < 0.02
    assert math.hypot(motion.delta[0], motion.delta[1]) < 0.02
