"""A pose with covariance, in the plane and in space: its motion and its update against samples, and against all measurements at once."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from localization.maps.uncertain_pose import UncertainPose
from motion_models import se2, se3

_SIGMAS = {3: np.array([0.05, 0.02, 0.03]), 6: np.array([0.05, 0.02, 0.04, 0.03, 0.02, 0.03])}


def example(dim: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """The group, a pose, and a motion of a metre with a turn of half a radian."""
    if dim == 3:
        return se2, np.array([4.0, -2.0, 1.2]), np.array([1.0, 0.2, 0.5])
    return se3, se3.lift(np.array([4.0, -2.0, 1.2])), se3.exp(np.array([1.0, 0.2, 0.1, 0.1, -0.2, 0.5]))


@pytest.mark.parametrize("dim", [3, 6])
def test_uncertain_pose_moved_has_the_covariance_of_samples(dim: int) -> None:
    group, pose, delta = example(dim)
    rng, P, Q = np.random.default_rng(3), np.diag(_SIGMAS[dim] ** 2), np.diag((0.5 * _SIGMAS[dim]) ** 2)
    moved = UncertainPose(pose, P).move(delta, Q)
    errors = []
    for start, noise in zip(rng.multivariate_normal(np.zeros(dim), P, 4000), rng.multivariate_normal(np.zeros(dim), Q, 4000), strict=True):
        end = group.compose(group.retract(pose, start), group.retract(delta, noise))
        errors.append(group.local(moved.pose, end))
    nees = np.einsum("ki,ij,kj->k", errors, np.linalg.inv(moved.cov), errors)
    assert np.mean(nees) == pytest.approx(dim, abs=4.0 * math.sqrt(2.0 * dim / 4000))


@pytest.mark.parametrize("dim", [3, 6])
def test_uncertain_pose_updated_is_the_weighted_mean(dim: int) -> None:
    """Two measurements one after the other give what their informations add up to, whichever is first."""
    group, pose, _ = example(dim)
    P, R = np.diag(_SIGMAS[dim] ** 2), np.diag(_SIGMAS[dim][::-1] ** 2)
    offset = 1e-4 * np.arange(1.0, dim + 1.0)
    updated = UncertainPose(pose, P).update(group.retract(pose, offset), R)
    expected = np.linalg.inv(np.linalg.inv(P) + np.linalg.inv(R))
    np.testing.assert_allclose(updated.cov, expected, atol=1e-12)
    np.testing.assert_allclose(group.local(pose, updated.pose), expected @ np.linalg.inv(R) @ offset, atol=1e-7)


@pytest.mark.parametrize("dim", [3, 6])
def test_uncertain_pose_distance_counts_sigmas_of_both(dim: int) -> None:
    group, pose, _ = example(dim)
    P = np.diag(_SIGMAS[dim] ** 2)
    measured = group.retract(pose, np.eye(dim)[0] * 3.0 * _SIGMAS[dim][0])
    assert UncertainPose(pose, P).squared_distance(measured, np.zeros((dim, dim))) == pytest.approx(9.0, rel=1e-6)
    assert UncertainPose(pose, P).squared_distance(measured, P) == pytest.approx(4.5, rel=1e-6)
