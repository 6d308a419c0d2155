"""Covariance of what is unsure of all of a path."""

from __future__ import annotations

import numpy as np
import pytest

from localization.estimators import Estimate
from localization.sensor_checks.path_uncertainty import PathUncertainty
from localization.trajectory import Trajectory
from motion_models import se2


def test_smoothed_trajectory_of_an_uncertain_clock_has_the_way_in_that_time() -> None:
    """Ahead at 1 m/s after a second at rest: where the motion begins, the way is that afterwards."""
    t = np.arange(0.0, 5.0, 0.1)
    poses = np.column_stack([np.maximum(t - 1.0, 0.0), 0.0 * t, 0.0 * t])
    path = PathUncertainty(late_s=0.5)
    found = path.widen_trajectory(Trajectory(np.round(t * 1e9).astype(int), poses, np.zeros((len(t), 3, 3)))).covariances
    assert found is not None
    np.testing.assert_allclose(np.sqrt(found[[0, 10, 30], 0, 0]), [0.0, 0.5, 0.5], atol=1e-6)
    assert not found[:, 1:].any()


@pytest.mark.parametrize("unsure", [{"late_s": 0.1}, {"scale": 0.01}, {"turned_about_m": 0.0}])
def test_path_is_unsure_by_any_of_its_causes(unsure: dict[str, float]) -> None:
    path, pose = PathUncertainty(**unsure), np.array([2.0, 1.0, 0.3])
    assert path.is_any
    assert not PathUncertainty().is_any
    poses = Trajectory(np.arange(0, 2_000_000_000, 100_000_000), np.linspace(np.zeros(3), pose, 20), np.zeros((20, 3, 3)))
    widened = path.widen_trajectory(poses).covariances
    assert widened is not None
    assert widened.any()
    assert PathUncertainty().widen_trajectory(poses) is poses


def test_smoothed_trajectory_has_the_scale_of_the_way_from_its_start() -> None:
    path = PathUncertainty(scale=0.1)
    poses = np.array([[1.0, 2.0, 0.0], [4.0, 2.0, 0.0], [4.0, 6.0, np.pi / 2]])
    found = path.widen_trajectory(Trajectory(np.arange(3), poses, np.zeros((3, 3, 3)))).covariances
    assert found is not None
    np.testing.assert_allclose(found[:, 0, 0], [0.0, 0.09, 0.16], atol=1e-12)
    np.testing.assert_allclose(found[:, 1, 1], [0.0, 0.0, 0.09], atol=1e-12)


def test_covariance_of_an_unknown_front_reaches_the_other_side_of_the_start() -> None:
    """Two metres ahead and one to the left, in a right turn; turned about, the robot is two behind and one to the right."""
    pose, stamps = np.array([2.0, 1.0, -0.5]), np.arange(2)
    path = PathUncertainty(turned_about_m=0.05)
    found = path.widen(Estimate(0, pose, 1e-6 * np.eye(3), None, None), pose).covariance
    poses = Trajectory(stamps, np.array([np.zeros(3), pose]), np.tile(1e-6 * np.eye(3), (2, 1, 1)))
    smoothed = path.widen_trajectory(poses).covariances
    assert found is not None
    assert smoothed is not None
    error = se2.between(pose, [-2.0, -1.0, -0.5])
    for covariance in (found, smoothed[1]):
        assert float(error @ np.linalg.solve(covariance, error)) == pytest.approx(1.0, abs=0.01)
        assert covariance[2, 2] == pytest.approx(1e-6)
    assert smoothed[0, 0, 0] == pytest.approx(0.01, rel=0.01)
