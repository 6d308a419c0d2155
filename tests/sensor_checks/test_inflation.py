"""Covariance of what faults have done."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.sensor_checks.contradictions import LIDAR_DIRECTION
from localization.sensor_checks.inflation import CovarianceInflation
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


def test_smoothed_trajectory_of_an_uncertain_clock_has_the_way_in_that_time() -> None:
    """Ahead at 1 m/s after a second at rest: where the motion begins, the way is that afterwards."""
    t = np.arange(0.0, 5.0, 0.1)
    poses = np.column_stack([np.maximum(t - 1.0, 0.0), 0.0 * t, 0.0 * t])
    inflation = CovarianceInflation()
    inflation.late_s = 0.5
    found = inflation.inflate_trajectory(Trajectory(np.round(t * 1e9).astype(int), poses, np.zeros((len(t), 3, 3)))).covariances
    assert found is not None
    np.testing.assert_allclose(np.sqrt(found[[0, 10, 30], 0, 0]), [0.0, 0.5, 0.5], atol=1e-6)
    assert not found[:, 1:].any()


def test_covariance_of_an_unknown_front_reaches_the_other_side_of_the_start() -> None:
    """Two metres ahead and one to the left, in a right turn; turned about, the robot is two behind and one to the right."""
    pose, stamps = np.array([2.0, 1.0, -0.5]), np.arange(2)
    inflation = CovarianceInflation(turned_about_m=0.05)
    inflation.reckoning.poses = np.tile(pose, (5, 1))
    found = inflation.inflate(Estimate(0, pose, 1e-6 * np.eye(3), None, None)).covariance
    poses = Trajectory(stamps, np.array([np.zeros(3), pose]), np.tile(1e-6 * np.eye(3), (2, 1, 1)))
    smoothed = inflation.inflate_trajectory(poses).covariances
    assert found is not None
    assert smoothed is not None
    error = se2.between(pose, [-2.0, -1.0, -0.5])
    for covariance in (found, smoothed[1]):
        assert float(error @ np.linalg.solve(covariance, error)) == pytest.approx(1.0, abs=0.01)
        assert covariance[2, 2] == pytest.approx(1e-6)
    assert smoothed[0, 0, 0] == pytest.approx(0.01, rel=0.01)
