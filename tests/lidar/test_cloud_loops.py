"""Loops in space: registration of local maps, its covariance, and places that look alike. Robots stand on hills for each sweep."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from localization.errors import EstimatorError
from localization.estimators import EstimatorConfig, GraphConfig
from localization.lidar import cloud_loops
from localization.lidar.cloud_loops import CloudLoop, compare_columns, find_loops
from localization.lidar.cloud_map import thin
from localization.pipeline import Pipeline, ReplayConfig, Trial
from motion_models import se3
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.hill_scans import MOUNT, SWEEP_NS, make_scene, scans
from tests.helpers.hills import HillDrive, gradient, terrain

_NOISE_M, _CELL_M = 0.02, 0.4
_WITHOUT_CLOUD = 12
"""Keyframes between both visits."""


def _standing(x: float, y: float, yaw: float, is_flat: bool) -> np.ndarray:
    """(4, 4) of a robot on the ground."""
    pose, (dx, dy) = np.eye(4), (0.0, 0.0) if is_flat else gradient(x, y)
    up = np.array([-dx, -dy, 1.0]) / math.sqrt(1.0 + dx * dx + dy * dy)
    ahead = np.array([math.cos(yaw), math.sin(yaw), dx * math.cos(yaw) + dy * math.sin(yaw)])
    ahead /= np.linalg.norm(ahead)
    pose[:3, :3] = np.column_stack([ahead, np.cross(up, ahead), up])
    pose[:3, 3] = x, y, 0.0 if is_flat else float(terrain(np.array([x]), np.array([y]))[0])
    return pose


def _clouds(poses: np.ndarray, scene_seed: int = 1, seed: int = 1, is_flat: bool = False, n_walls: int = 2) -> list[np.ndarray]:
    """(N, 3) of each pose, in the body frame."""
    stamps = np.array([[n * SWEEP_NS, (n + 1) * SWEEP_NS - 1] for n in range(len(poses) + 1)]).ravel()
    rows = np.minimum(np.repeat(np.arange(len(poses) + 1), 2), len(poses) - 1)
    made = HillDrive(load_robot("husky_a200"), {}, [], stamps, poses[rows, :3, 3], poses[rows, :3, :3])
    scene = make_scene(made, scene_seed, 30, n_walls, is_flat)
    place = np.array([MOUNT.x, MOUNT.y, MOUNT.z])
    return [thin(cloud.points + place, _CELL_M) for cloud in scans(made, scene, seed=seed)][: len(poses)]


def _there_and_back(n: int = 5, is_flat: bool = False) -> np.ndarray:
    """(2 n, 4, 4): along a line, and back beside it."""
    there = [_standing(0.8 * k, 0.0, 0.1 * k, is_flat) for k in range(n)]
    back = [_standing(0.8 * k + 0.3, 0.7, math.pi + 0.1 * k, is_flat) for k in reversed(range(n))]
    return np.array(there + back)


class _Proposing:
    """In place of map-closures: of the newest map, the first one at ``new_T_old``, both in level axes."""

    def __init__(self, new_T_old: np.ndarray) -> None:
        self._pose = new_T_old

    def get_top_k_closures(self, key: int, points: np.ndarray, k: int) -> list[_Proposal]:
        return [_Proposal(2, 5, self._pose)] if key > 2 else []


@dataclass(frozen=True)
class _Proposal:
    source_id: int
    number_of_inliers: int
    pose: np.ndarray


def _leveled(pose: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = se3.rotation(np.array([0.0, 0.0, math.atan2(pose[1, 0], pose[0, 0])]))
    out[:3, 3] = pose[:3, 3]
    return out


def _loops(monkeypatch, clouds: list[np.ndarray], poses: np.ndarray, proposed: np.ndarray, sigma: float = 0.3) -> list[CloudLoop]:
    monkeypatch.setattr(cloud_loops, "make_map_closures", lambda cell: _Proposing(se3.inverse(proposed)))
    apart = np.repeat(poses[4:5], _WITHOUT_CLOUD, axis=0)
    keyframes, keyframe_poses = [*clouds[:5], *[np.empty((0, 3))] * _WITHOUT_CLOUD, *clouds[5:]], np.vstack([poses[:5], apart, poses[5:]])
    return find_loops(keyframes, keyframe_poses, lambda a, b: _cov(b - a, sigma, 0.01), _NOISE_M)


def _cov(keyframes: int, position: float, angle: float) -> np.ndarray:
    """Of the odometry, without an error in a local map."""
    return np.diag([position**2] * 3 + [angle**2] * 3) if abs(keyframes) > 4 else np.zeros((6, 6))


_OFF = se3.exp(np.array([0.5, -0.4, 0.2, 0.03, -0.03, 0.06]))
"""By as much proposals of map-closures are off."""


@pytest.mark.extended
def test_loop_in_space_errs_as_its_covariance_has_it(monkeypatch):
    """Of four draws of the ranges' noise, the mean NEES of 6 degrees of freedom: at most 10.7 in 99 % (chi-square with 24), and a loop is
    known to millimetres."""
    poses, nees, errors = _there_and_back(), [], []
    old_T_new = se3.inverse(_leveled(poses[2])) @ _leveled(poses[7])
    drifted = poses.copy()
    drifted[5:] = se3.exp(np.array([0.3, 0.2, -0.1, 0.0, 0.0, 0.02])) @ poses[5:]
    for seed in range(4):
        (loop,) = _loops(monkeypatch, _clouds(poses, seed=seed), drifted, old_T_new @ _OFF)
        assert (loop.a, loop.b) == (2, 7 + _WITHOUT_CLOUD)
        error = se3.local(loop.delta, se3.inverse(poses[2]) @ poses[7])
        errors.append(np.linalg.norm(error[:3]))
        nees.append(error @ np.linalg.solve(loop.cov, error))
    assert 0.5 < np.mean(nees) < 10.7
    assert max(errors) < 0.01


def test_place_with_other_trees_is_no_loop(monkeypatch):
    """Plane ground fits plane ground anywhere: what stands upright decides."""
    poses = _there_and_back(is_flat=True)
    here, elsewhere = _clouds(poses, 1, is_flat=True), _clouds(poses, 2, is_flat=True, n_walls=0)
    old_T_new = se3.inverse(_leveled(poses[2])) @ _leveled(poses[7])
    assert len(_loops(monkeypatch, here, poses, old_T_new)) == 1
    assert not _loops(monkeypatch, here[:5] + elsewhere[5:], poses, old_T_new)


def test_place_that_looks_alike_elsewhere_is_no_loop(monkeypatch):
    """The same trees again after 40 m, which the odometry knows to 0.3 m."""
    poses, apart = _there_and_back(), np.array([40.0, 0.0, 0.0])
    clouds, old_T_new = _clouds(poses), se3.inverse(_leveled(poses[2])) @ _leveled(poses[7])
    away = poses.copy()
    away[5:, :3, 3] += apart
    assert not _loops(monkeypatch, clouds, away, old_T_new)
    assert len(_loops(monkeypatch, clouds, away, old_T_new, sigma=10.0)) == 1  # an odometry that does not know


def test_columns_agree_within_one_and_differ_where_both_have_seen_the_ground():
    ground = np.array([[x, y, 0.0] for x in range(20) for y in range(20)], dtype=float) + 0.5
    trunk = np.array([[5.5, 5.5, z] for z in range(4)])
    assert compare_columns(np.vstack([ground, trunk]), np.vstack([ground, trunk + np.array([1.0, 0.0, 0.0])]), 1.0) == (1, 0)
    elsewhere = trunk + np.array([6.0, 0.0, 0.0])
    agree, differ = compare_columns(np.vstack([ground, trunk]), np.vstack([ground, elsewhere]), 1.0)
    assert (agree, differ) == (0, 1)
    assert compare_columns(np.vstack([ground, trunk]), np.vstack([ground, trunk + 100.0]), 1.0) == (0, 0)  # not seen in the other


def test_loops_without_their_extra_are_refused_before_the_drive(monkeypatch):
    monkeypatch.setitem(sys.modules, "map_closures.config", None)
    robot = load_robot("husky_a200")
    config = ReplayConfig(estimator=EstimatorConfig(graph=GraphConfig(cloud_loops=True)))
    with pytest.raises(EstimatorError, match=r"skidloc\[loops\]"):
        Pipeline(Trial(make_model("skid_steer", robot), "graph"), robot, {}, True, config)


def test_revisits_are_found_by_map_closures():
    """A lap and a quarter, with drift after two thirds of it."""
    pytest.importorskip("map_closures", reason="needs the extra 'loops'")
    ring = [_standing(9.0 * math.cos(t), 9.0 * math.sin(t), t + 0.5 * math.pi, False) for t in np.arange(35) * 2.0 * math.pi / 28.0]
    poses = np.array(ring)
    drifted = poses.copy()
    drifted[20:] = se3.exp(np.array([0.6, -0.5, 0.2, 0.0, 0.0, 0.03])) @ poses[20:]
    found = find_loops(_clouds(poses), drifted, lambda a, b: _cov(b - a, 0.3, 0.03), _NOISE_M)
    assert found
    for loop in found:
        assert np.linalg.norm(se3.local(loop.delta, se3.inverse(poses[loop.a]) @ poses[loop.b])[:3]) < 0.01
