"""The map's error as a state: exact derivatives, filter and graph that agree, and covariances that are as large as the errors."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from localization.consistency import mean_band
from localization.estimators.graph_factors import map_residual
from localization.estimators.make import EstimatorConfig
from localization.events import Scan
from localization.lidar import LidarConfig, LidarMatcher, MapTie, body_points
from localization.logs import open_log
from localization.run import Pair, ReplayConfig, replay
from localization.simulate import world
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import load_robot
from tests import rooms

SHARED = ReplayConfig(estimator=EstimatorConfig(lidar=LidarConfig(map_is_state=True)))
ROOM = np.concatenate([world.box(-6, -4, 6, 4), world.box(-6, -4, -5, -3), world.pillar(4.5, 2.8)])
WAY = rooms.path((1, 0, 0), (5, 0.4, 0.4), (4, 0.4, -0.5))
RUNS = 24


def test_derivatives_are_those_of_differences() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b, seen = rng.normal(size=(3, 3))
        b = se2.compose(a, se2.compose(seen, se2.exp(0.3 * rng.normal(size=3))))
        small = [0.3 * rng.normal(size=3) for _ in range(3)]  # mount, map at a, map at b
        _, by = map_residual(a, b, seen, *small)
        tiny = 1e-6
        for name, at in (("pose_a", 0), ("pose_b", 1), ("mount", 3), ("map_a", 4), ("map_b", 5)):
            found = np.empty((3, 3))
            for k in range(3):
                ends = []
                for sign in (1.0, -1.0):
                    step = sign * tiny * np.eye(3)[k]
                    values = [a, b, seen, *small]
                    values[at] = se2.compose(values[at], se2.exp(step)) if at < 2 else values[at] + step
                    ends.append(map_residual(*values)[0])
                found[:, k] = (ends[0] - ends[1]) / (2.0 * tiny)
            np.testing.assert_allclose(getattr(by, name), found, atol=1e-7)


@pytest.mark.parametrize("kind", ["ekf", "graph"])
def test_in_a_room_errors_are_as_large_as_is_said(kind: str) -> None:
    nees = []
    for seed in range(RUNS):
        drive = rooms.drive_through(ROOM, WAY, seed, scanner=rooms.Beams(beams=240, rate_hz=6.25))
        poses, covs = rooms.at_scans(drive, rooms.results(drive, kind, config=SHARED)[kind])
        assert covs is not None
        error = se2.log(se2.between(drive.poses[-1], poses[-1]))
        nees.append(float(error @ np.linalg.solve(covs[-1], error)))
    low, high = mean_band(RUNS, 3.0)
    assert low <= np.mean(nees) <= high


def test_counted_anew_with_each_scan_they_are_said_to_be_far_larger() -> None:
    """What the state is for."""
    drive = rooms.drive_through(ROOM, WAY, 0, scanner=rooms.Beams(beams=240, rate_hz=6.25))
    sigmas = []
    for config in (SHARED, ReplayConfig()):
        _, covs = rooms.at_scans(drive, rooms.results(drive, "ekf", config=config)["ekf"])
        assert covs is not None
        sigmas.append(np.sqrt(np.trace(covs[-1][:2, :2])))
    assert sigmas[1] > 2.0 * sigmas[0]


def test_filter_and_fixed_lag_agree_on_a_real_log() -> None:
    robot = load_robot("aces")
    log = open_log(Path(__file__).parent / "data" / "aces" / "aces.mcap", robot)
    events = log.events()
    first = next(events)
    part = itertools.takewhile(lambda e: e.stamp_ns < first.stamp_ns + 60_000_000_000, itertools.chain([first], events))
    pairs = [Pair(make_model("diff_drive", robot), kind) for kind in ("ekf", "graph")]
    ekf, graph = (run.trajectory for run in replay(part, pairs, robot, log.mounts, True, SHARED))
    assert ekf.covariances is not None
    sigmas = np.sqrt(np.maximum(ekf.covariances.diagonal(axis1=1, axis2=2), 1e-8))
    assert np.abs(se2.log(se2.between(ekf.poses, graph.poses)) / sigmas).max() < 1.0


def test_the_old_map_is_found_again_where_the_scanner_was_frozen() -> None:
    """Nothing was drawn meanwhile, so that the wheels were lost in between does not count: pose and sigma are as before."""
    drive = rooms.drive_through(ROOM, rooms.path((1, 0, 0), (10, 0.4, 0.5)), 3)
    scans = [e for e in drive.events if isinstance(e, Scan)]
    frozen = {s.stamp_ns for s in scans[60:85]}
    events = [
        replace(e, points=scans[60].points, offsets=scans[60].offsets) if isinstance(e, Scan) and e.stamp_ns in frozen else e
        for e in drive.events
    ]
    poses, covs = rooms.at_scans(drive, rooms.results(replace(drive, events=events), "ekf", config=SHARED)["ekf"])
    assert covs is not None
    sigma = np.sqrt(covs[:, [0, 1], [0, 1]].sum(axis=1))
    assert sigma[84] > 5.0 * sigma[59] > sigma[90]
    assert np.hypot(*(poses - drive.poses)[90:, :2].T).max() < 0.015


def test_a_matcher_says_how_much_of_the_map_it_met_before() -> None:
    drive = rooms.drive_through(ROOM, rooms.path((1, 0, 0), (4, 0.4, 0.0)), 0)
    scans = [e for e in drive.events if isinstance(e, Scan)]
    matcher, kept = LidarMatcher(LidarConfig(map_is_state=True)), []
    for scan, pose in zip(scans, drive.poses, strict=True):
        found = matcher.register(body_points(scan, drive.mount, np.zeros(3)), True, pose, 1e-4 * np.eye(3))
        if found is not None:
            kept.append(np.trace(found.tie.kept) / 3.0)
            assert np.linalg.eigvalsh(found.tie.fresh).min() > -1e-12
        matcher.insert(pose)
    assert kept[0] < 0.01  # all of it was drawn by the scan before
    assert 0.9 < kept[-1] <= 1.0
    again = matcher.register(body_points(scans[-1], drive.mount, np.zeros(3)), True, drive.poses[-1], 1e-4 * np.eye(3))
    anew = matcher.register(body_points(scans[-1], drive.mount, np.zeros(3)), True, drive.poses[-1], 1e-4 * np.eye(3))
    assert again is not None
    assert anew is not None
    assert np.trace(again.tie.kept) < np.trace(anew.tie.kept)  # what the last scan added is new to one scan only
    assert MapTie(np.zeros((3, 3)), found.cov).fresh.tolist() == found.cov.tolist()
