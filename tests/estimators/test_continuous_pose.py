"""Poses without a LiDAR in two frames (REP-105): one that later measurements correct, and one that never jumps."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from localization.estimators import Estimate
from localization.estimators.graph_fusion import GraphConfig, GraphFusion
from localization.lidar import LidarConfig
from localization.ros.start_pose import StartPose
from motion_models import se2
from motion_models.se2 import FloatArray
from tests.helpers.synthetic_steps import PoseSensor, make_filter, make_world, weave

DRIVES = 30
MOVING, RESTING = 200, 40
"""Steps of a drive: it ends at rest, where the gyro shows its bias."""
AT_REST = MOVING + 2
"""First step that is at rest by the clocks of all."""


class Drive(NamedTuple):
    estimates: list[Estimate]
    truth: FloatArray


@cache
def drive(seed: int, with_graph: bool = False, is_radius_right: bool = False) -> Drive:
    """Wheels and gyro of a robot that drives off at once and stops at the end."""
    ekf = make_filter(PoseSensor(), "diff_drive", has_lidar=False)
    estimator = GraphFusion(ekf, LidarConfig(), GraphConfig(), False) if with_graph else ekf
    world = make_world(ekf, seed, has_lidar=False, wheels=lambda t: weave(t) if t < 0.1 * MOVING else (0.0, 0.0))
    if is_radius_right:
        world.radius = 0.0
    found, truth = [], []
    for k in range(MOVING + RESTING):
        step, _ = world.step(ekf.model.nominal if estimator.params is None else estimator.params, estimator.clock_offset_s)
        found.append(estimator.step(replace(step, is_standing=k >= MOVING)))
        truth.append(world.pose)
    return Drive(found, np.array(truth))


def normalised(pose: FloatArray, cov: FloatArray, truth: FloatArray) -> float:
    error = se2.local(pose, truth)
    return float(error @ np.linalg.solve(cov, error))


@pytest.mark.slow
def test_covariances_of_both_frames_equal_monte_carlo_scatter() -> None:
    corrected, continuous = [], []
    for seed in range(DRIVES):
        estimates, truth = drive(seed)
        corrected.append(normalised(estimates[-1].pose, estimates[-1].covariance, truth[-1]))
        continuous.append(normalised(*estimates[-1].odometry, truth[-1]))
    low, high = chi2.ppf([0.001, 0.999], 3 * DRIVES) / DRIVES
    assert low < np.mean(corrected) < high
    assert low < np.mean(continuous) < high


@pytest.mark.extended
def test_odometry_at_rest_moves_by_less_than_the_pose() -> None:
    """The gyro's bias, which is found there, corrects the pose by centimetres."""
    jumps = []
    for seed in range(DRIVES):
        estimates = drive(seed).estimates[AT_REST:]
        poses, odometry = np.array([e.pose for e in estimates]), np.array([e.odometry[0] for e in estimates])
        jumps.append([np.hypot(*se2.between(path[:-1], path[1:])[:, :2].T).max() for path in (poses, odometry)])
    of_pose, of_odometry = np.max(jumps, axis=0)
    assert of_odometry < 1e-3
    assert of_pose > 20.0 * of_odometry


@pytest.mark.extended
def test_corrected_pose_is_the_better_one_at_the_end() -> None:
    """The bias that is measured at rest corrects the way before: why both are estimated. An error of the radius is in both alike."""
    errors = []
    for seed in range(DRIVES):
        estimates, truth = drive(seed, is_radius_right=True)
        errors.append([np.hypot(*se2.local(pose, truth[-1])[:2]) for pose in (estimates[-1].pose, estimates[-1].odometry[0])])
    corrected, continuous = np.sqrt(np.mean(np.square(errors), axis=0))
    assert corrected < continuous


def test_published_pose_is_the_odometry_where_there_is_no_map_frame() -> None:
    estimate = drive(0).estimates[-1]
    start = StartPose(odom_T_start=np.array([2.0, -1.0, 0.5]))
    published = start.apply(estimate)
    assert published.odometry is None
    np.testing.assert_allclose(published.pose, se2.compose(start.odom_T_start, estimate.odometry[0]))
    assert np.hypot(*(published.pose - se2.compose(start.odom_T_start, estimate.pose))[:2]) > 1e-3


def test_map_frame_of_graph_takes_the_jumps() -> None:
    estimates = drive(1, with_graph=True).estimates
    for estimate in estimates[:: MOVING // 4]:
        np.testing.assert_allclose(se2.compose(estimate.map_T_odom, estimate.odometry[0]), estimate.pose, atol=1e-12)
    at_rest = np.array([e.odometry[0] for e in estimates[AT_REST:]])
    assert np.hypot(*np.diff(at_rest[:, :2], axis=0).T).max() < 1e-3
