"""The filter's path through keyframes: what smoothing changes between them."""

from __future__ import annotations

import numpy as np

from localization.estimators.recorded_path import RecordedPath, through_nodes
from motion_models.groups import SE2


def test_through_nodes_moves_poses_by_travelled_share():
    odometry = np.column_stack([[0.0, 1.0, 1.0, 2.0], np.zeros(4), np.zeros(4)])  # it rests in between
    poses, covs = np.array([[0.0, 0.0, 0.0], [2.2, 0.0, 0.0]]), np.array([0.01 * np.eye(3), 0.03 * np.eye(3)])
    found, mixed = through_nodes(SE2, odometry, np.zeros((4, 3, 3)), np.array([0, 3]), poses, covs)
    np.testing.assert_allclose(found[:, 0], [0.0, 1.1, 1.1, 2.2], atol=1e-6)
    np.testing.assert_allclose(mixed[[0, 3]], covs, atol=1e-8)


def test_through_nodes_adds_the_noise_of_the_motion_less_its_share():
    odometry = np.column_stack([[0.0, 0.5, 1.0, 1.5, 2.0], np.zeros(5), np.zeros(5)])
    noise, nothing = np.diag([1e-4, 2e-4, 3e-5]), np.zeros((2, 3, 3))
    _, found = through_nodes(SE2, odometry, np.tile(noise, (5, 1, 1)), np.array([0, 4]), odometry[[0, 4]], nothing)
    np.testing.assert_allclose(found, np.array([0.0, 0.75, 0.5, 0.25, 0.0])[:, None, None] * noise, atol=1e-12)


def test_recorded_path_of_step_without_duration_keeps_the_first_pose() -> None:
    path, none = RecordedPath(SE2), np.zeros((3, 3))
    path.add(0, np.zeros(3), none)
    path.add_node()
    path.add(10, np.array([1.0, 0.0, 0.0]), none)
    path.add(10, np.array([5.0, 0.0, 0.0]), none)
    assert not path.ends_at_node
    path.add_node()
    assert path.ends_at_node
    poses, _ = path.through(np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]]), np.zeros((2, 3, 3)))
    assert path.stamps_ns.tolist() == [0, 10]
    np.testing.assert_allclose(poses, [[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]], atol=1e-9)
