"""All checks together: sensors that agree, and state on disk."""

from __future__ import annotations

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.ros.state_serialization import deserialize, serialize
from motion_models import se2
from tests.helpers.checked_drive import CheckedDrive, S
from tests.helpers.event_faults import named_faults, without_gyro
from tests.helpers.fault_drives import in_room, run


@pytest.mark.parametrize("has_scans", [True, False])
def test_sensors_that_agree_are_all_used_and_not_reported(has_scans: bool) -> None:
    """Wheels that slip by half in turns and by 8 % on ways, 5 cm in 0.6 m; a gyro with a bias."""
    robot = CheckedDrive(gyro=lambda w: w + 0.02, wheels=lambda v, w: (0.92 * v, 1.5 * w), has_scans=has_scans)
    checks = robot.drive()
    assert checks.warnings() == []
    assert all(step.turn is not None and (step.scan is not None) == has_scans for step in robot.applied)
    assert np.array_equal(robot.estimates[0].covariance, 1e-6 * np.eye(3))
    assert np.array_equal(robot.estimates[-1].covariance, 1e-6 * np.eye(3))
    sigmas = np.sqrt([e.covariance[0, 0] + e.covariance[1, 1] for e in robot.estimates if e.covariance is not None])
    assert sigmas.max() < 0.15  # what wheels slip by counts while it may be a moving scene
    assert np.mean(sigmas > 2e-3) < 0.1


def test_checks_are_restored_from_a_checkpoint_during_and_after_a_fault() -> None:
    for seconds in (8.0, 20.0):
        robot = CheckedDrive()
        robot.gyro = lambda w, robot=robot: -w if len(robot.applied) < 90 else w
        checks = robot.drive(seconds)
        restored = deserialize(*serialize(checks))
        assert "the gyro turns opposite" in checks.warnings()[0]
        assert restored.warnings() == checks.warnings()
        last = robot.estimates[-1]
        ahead = Estimate(last.stamp_ns + S, se2.compose(last.pose, np.array([0.1, 0.0, 0.0])), last.covariance, np.zeros(3), None)
        assert np.array_equal(*(found.inflate(robot.applied[-1], ahead, robot.estimator).covariance for found in (restored, checks)))


def test_estimate_that_leaves_the_wheels_is_examined_before_it_is_published() -> None:
    """A LiDAR that is upside down, without a gyro: half a second later, poses would be .16 m off at a sigma of 6 mm until then."""
    outcome = run(in_room(1), without_gyro(named_faults()["LiDAR upside down"]))
    assert not outcome.is_wrong, outcome.least_consistent
