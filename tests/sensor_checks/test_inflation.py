"""Covariance of what faults have done."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.sensor_checks.contradictions import LIDAR_DIRECTION
from localization.sensor_checks.inflation import CarriedError
from localization.trajectory import Trajectory
from motion_models import se2
from tests.helpers.checked_drive import SPEED, CheckedDrive, turned


def test_fault_inflates_the_covariance_by_what_it_has_done() -> None:
    """The estimate followed a LiDAR that is turned by 30 deg; wheels and gyro lead elsewhere."""
    robot = CheckedDrive(scan=lambda points: turned(points, 30.0))
    world_T_drive = np.array([0.0, 0.0, math.radians(30.0)])
    own = robot.checks.inflate

    def inflate(step, e, estimator):
        pose = se2.compose(se2.compose(world_T_drive, e.pose), se2.inverse(world_T_drive))
        return own(step, Estimate(e.stamp_ns, pose, e.covariance, e.twist, None), estimator)

    robot.checks.inflate = inflate  # type: ignore[method-assign]
    robot.drive()
    found = next(iter(robot.checks.found.values()))
    assert found.fault == LIDAR_DIRECTION
    sigma = np.sqrt([np.linalg.eigvalsh(e.covariance[:2, :2])[-1] for e in robot.estimates])  # type: ignore[index]
    assert sigma[0] == pytest.approx(1e-3)
    assert sigma[-1] > 0.3 * 2.0 * math.sin(math.radians(15.0)) * SPEED * 3.0  # declared after 3.5 s or later
    end = robot.estimates[-1]
    smooth = Trajectory(
        np.array([e.stamp_ns for e in robot.estimates]),
        np.array([e.pose for e in robot.estimates]),
        np.tile(1e-6 * np.eye(3), (len(robot.estimates), 1, 1)),
    )
    inflated = robot.checks.inflate_trajectory(smooth)
    assert inflated.covariances is not None
    np.testing.assert_allclose(inflated.covariances[-1], end.covariance, atol=1e-9)
    np.testing.assert_allclose(inflated.covariances[0], 1e-6 * np.eye(3))


def test_error_carried_along_is_that_of_the_start_seen_from_the_body() -> None:
    """The pose before was off by e: all later ones are compose(exp of it, motion), to first order."""
    off, before, after = np.array([1e-4, -2e-4, 3e-4]), np.array([1.0, 2.0, 0.4]), np.array([3.0, 1.5, 1.3])
    carried = CarriedError().moved(before).plus(off)
    np.testing.assert_allclose(carried.total, np.outer(off, off))
    moved = carried.moved(before).moved(after)
    true = se2.compose(se2.retract(before, off), se2.between(before, after))
    error = se2.local(after, true)
    np.testing.assert_allclose(moved.total, np.outer(error, error), rtol=2e-3)
    assert moved.count == 1
    assert not moved.pending.any()


def test_error_that_nothing_was_added_to_is_none_anywhere() -> None:
    carried = CarriedError().moved(np.array([5.0, 0.0, 1.0]))
    assert not carried.is_any
    assert not carried.total.any()
