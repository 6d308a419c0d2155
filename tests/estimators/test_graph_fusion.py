"""The graph behind the filter on simulated drives: loops about a building, positions, corrections, frames, checkpoints."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from localization.core.motion import FilterConfig
from localization.errors import EstimatorError
from localization.estimate_table import EstimateTable, trajectory
from localization.estimators import Estimate, EstimatorConfig
from localization.estimators.graph_fusion import subtract_information
from localization.estimators.keyframe_motion import MotionPreintegration
from localization.estimators.pose_graph import LivePoseGraph
from localization.evaluation.consistency import nees
from localization.events import PositionSample, Scan, WheelSample
from localization.log_replay import replay
from localization.logs.reference_topics import merge_positions
from localization.pipeline import Pipeline, ReplayConfig, Trial
from localization.ros.state_serialization import deserialize, serialize
from localization.simulation import world
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.groups import SE2
from motion_models.motion import Motion
from motion_models.online_calibration import add_correction_parameters, make_corrections
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from tests.helpers import rooms
from tests.studies.buildings import BUILDINGS

pytestmark = pytest.mark.xdist_group("graph_fusion")

QUIET = WheelNoise(*[1e-8] * 8)
SCANNER = rooms.Beams(beams=240, rate_hz=6.25, noise=0.03, longest=8.0)
RADIUS_ERROR, TURN_ERROR = 1.03, 1.1
"""Wheels count more than they drive and turn."""


def building() -> np.ndarray:
    """A corridor of 2 m about a pipeline of 12 x 8 m, with things of irregular size along its outer walls."""
    rng, things = np.random.default_rng(8), []
    for x in np.cumsum(rng.uniform(0.8, 2.2, 12)) - 8.0:
        if x < 7.0:
            things += [
                world.box(x, -6, x + rng.uniform(0.2, 0.6), rng.uniform(-5.9, -5.6)),
                world.box(x + 0.3, rng.uniform(5.6, 5.9), x + 0.7, 6),
            ]
    for y in np.cumsum(rng.uniform(0.8, 2.2, 9)) - 6.0:
        if y < 5.0:
            things += [world.box(-8, y, rng.uniform(-7.9, -7.6), y + 0.4), world.box(rng.uniform(7.6, 7.9), y + 0.2, 8, y + 0.6)]
    return np.concatenate([world.box(-8, -6, 8, 6), world.box(-6, -4, 6, 4), *things])


def lap() -> np.ndarray:
    turn = (0.5 * math.pi / 0.8, 0.0, 0.8)
    legs = [leg for length in (14.0, 10.0, 14.0, 10.0) for leg in ((length / 0.8, 0.8, 0.0), turn)]
    return rooms.path((1, 0, 0), *legs, (10, 0.8, 0), (1, 0, 0))


@functools.cache
def around(seed: int = 0) -> rooms.Drive:
    """Once around the building and 8 m farther, with wheels that are wrong."""
    return rooms.drive_through(
        building(), lap(), seed, (-7.0, -5.0, 0.0), SCANNER, QUIET, lambda t, twists: twists * [RADIUS_ERROR, 1.0, TURN_ERROR]
    )


def make_pipeline(drive: rooms.Drive, has_lidar: bool = True, is_smoothing: bool = True, model: str = "diff_drive") -> Pipeline:
    return Pipeline(Trial(make_model(model, rooms.ROBOT), "graph"), rooms.ROBOT, drive.mounts, has_lidar, is_smoothing=is_smoothing)


def run(pipeline: Pipeline, events: list) -> list[Estimate]:
    return [estimate for event in events for estimate in pipeline.process(event)] + pipeline.finish()


@functools.cache
def estimated(seed: int = 0) -> tuple[list[Estimate], Pipeline]:
    pipeline = make_pipeline(around(seed))
    return run(pipeline, around(seed).events), pipeline


def smoothed(estimates: list[Estimate], pipeline: Pipeline) -> Trajectory:
    records = EstimateTable()
    for estimate in estimates:
        records.add(estimate)
    found = pipeline.estimator.finish(trajectory(records.stamps(), records.rows()))
    assert found is not None
    return found


def errors(drive: rooms.Drive, stamps: list[int], poses: np.ndarray) -> np.ndarray:
    """Distance from the truth at each scan [m]."""
    rows = {stamp: i for i, stamp in enumerate(stamps)}
    found = [(poses[rows[int(s)]] - truth)[:2] for s, truth in zip(drive.stamps, drive.poses, strict=True) if int(s) in rows]
    assert len(found) > 0.95 * len(drive.stamps)
    return np.hypot(*np.array(found).T)


def at_scans(drive: rooms.Drive, stamps: list[int], poses: list[np.ndarray]) -> np.ndarray:
    """(N, 3) the poses at the stamps of the scans, in their order; every scan has one."""
    rows = dict(zip(stamps, poses, strict=True))
    return np.array([rows[int(s)] for s in drive.stamps])


def errors_on_second_visit(drive: rooms.Drive, poses: np.ndarray) -> np.ndarray:
    """(20,) errors of the last poses as seen from the nearest of the first visit [m]: no loop mends what drifted before that."""
    truth = np.array(drive.poses)
    last = np.arange(len(truth) - 20, len(truth))
    near = np.argmin(np.hypot(*(truth[last, None, :2] - truth[None, : len(truth) // 2, :2]).transpose(2, 0, 1)), axis=1)
    off = se2.between(se2.between(truth[near], truth[last]), se2.between(poses[near], poses[last]))
    return np.hypot(off[:, 0], off[:, 1])


# --- loops about a building


@pytest.mark.slow
def test_graph_around_building_closes_loop() -> None:
    """After it, live poses are nearer the place of the first visit than the odometry's, and smoothed trajectories nearer the truth: in the
    mean of four drives, as drift differs by chance."""
    rows = []
    for seed in range(4):
        drive, (estimates, pipeline) = around(seed), estimated(seed)
        assert pipeline.estimator.counts()["loops"] >= 1
        stamps, odometry = [e.stamp_ns for e in estimates], [e.odometry[0] for e in estimates]
        live, by_odometry = (
            errors_on_second_visit(drive, at_scans(drive, stamps, poses)).mean() for poses in ([e.pose for e in estimates], odometry)
        )
        whole = smoothed(estimates, pipeline)
        after, before = errors(drive, whole.stamps_ns.tolist(), whole.poses), errors(drive, stamps, np.array(odometry))
        rows.append([live, by_odometry, np.sqrt(np.mean(after**2)), np.sqrt(np.mean(before**2))])
    live, by_odometry, after, before = np.mean(rows, axis=0)
    assert before > 0.03
    assert live < 0.8 * by_odometry
    assert after < 0.8 * before


@pytest.mark.slow
def test_graph_with_corrections_that_hardly_change_is_solved() -> None:
    """Five minutes of fr079, after each of which corrections may change: GTSAM's marginals were indefinite at a sigma of 1e-6."""
    run = BUILDINGS["fr079"].open().until(300.0).run("graph", "skid_steer")
    assert run.trajectory.covariances is not None
    assert (np.linalg.eigvalsh(run.trajectory.covariances) > 0.0).all()


@pytest.mark.extended
def test_graph_with_loop_moves_map_and_not_odometry() -> None:
    """The pose in the map jumps where the loop closes; odom -> base_link moves as the robot does (REP-105)."""
    jumps = ((estimated(seed)[0], np.diff([e.map_T_odom for e in estimated(seed)[0]], axis=0)) for seed in range(4))
    estimates = next(found for found, jump in jumps if np.hypot(*jump[:, :2].T).max() > 0.03)
    odometry = np.array([e.odometry[0] for e in estimates])
    moved = se2.between(odometry[:-1], odometry[1:])
    assert np.hypot(moved[:, 0], moved[:, 1]).max() < 0.8 / SCANNER.rate_hz + 0.03  # 0.8 m/s
    chained = se2.compose(np.array([e.map_T_odom for e in estimates]), odometry)
    assert np.abs(se2.between(chained, np.array([e.pose for e in estimates]))).max() < 1e-12


def test_graph_odometry_equals_filter_with_same_corrections() -> None:
    """Until the first keyframes the graph's odometry is the filter's, to the last bit."""
    drive = around().until(rooms.WALL_START_NS + 2 * 10**9)
    ours = run(make_pipeline(drive), drive.events)
    theirs = run(Pipeline(Trial(make_model("diff_drive", rooms.ROBOT), "ekf"), rooms.ROBOT, drive.mounts, True), drive.events)
    assert len(ours) == len(theirs) > 10
    assert all(np.array_equal(a.odometry[0], b.pose) for a, b in zip(ours[:8], theirs[:8], strict=True))


@pytest.mark.extended
def test_graph_with_wrong_wheels_estimates_radius_scale() -> None:
    """Radius by the scans along the way, k by the turns; both within 3 sigma, and with more certainty than at first."""
    estimates, pipeline = estimated()
    del estimates
    parameters = pipeline.estimator.parameters()
    mean, sigma = parameters["wheel_radius_scale"]
    assert sigma < 0.005
    assert abs(1.0 + mean - 1.0 / RADIUS_ERROR) < 3.0 * sigma
    nominal = rooms.ROBOT.driver.wheel_separation_multiplier
    mean, sigma = parameters["wheel_separation_multiplier"]
    assert abs(mean - nominal * TURN_ERROR) < 3.0 * sigma
    assert abs(mean - nominal * TURN_ERROR) < abs(mean - nominal)


@pytest.mark.extended
def test_graph_corrections_hold_for_next_prediction() -> None:
    _, pipeline = estimated()
    names = pipeline.estimator.odometry.noise.corrections.names
    learned = pipeline.estimator.graph.corrections()[0][: len(names)]
    assert np.abs(learned).min() > 0.0
    assert pipeline.synchronizer.wheels.params == pytest.approx(pipeline.estimator.params)
    nominal = make_model("diff_drive", rooms.ROBOT).nominal
    assert not np.allclose(pipeline.synchronizer.wheels.params, nominal)


def test_graph_predicts_with_the_corrections_that_its_filter_has() -> None:
    """Also where the graph has changed them after the last estimate."""
    pipeline, used = make_pipeline(around()), []
    estimator, step = pipeline.estimator, pipeline.estimator.odometry.step

    def record(given):
        used.append((pipeline.synchronizer.wheels.params, estimator.odometry.params))
        return step(given)

    estimator.odometry.step = record
    run(pipeline, around().events[:2000])
    assert np.ptp([params for params, _ in used], axis=0).max() > 0.01
    for of_prediction, of_filter in used[1:]:
        np.testing.assert_array_equal(of_prediction, of_filter)


def test_keyframe_motion_is_that_of_one_set_of_corrections() -> None:
    """Ten steps predicted while corrections are learned equal ten that were predicted with those at the end."""
    model = add_correction_parameters(make_model("diff_drive", rooms.ROBOT), "constant")
    correct, rates, no_cg = make_corrections(model, "constant"), np.array([1.0, 3.0]), np.zeros(2)
    final = 0.2 * np.ones(len(correct.names))

    def motion(at: np.ndarray) -> Motion:
        twist = model.twist(rates, no_cg, model.nominal + correct.directions @ at)
        return Motion(se2.exp(0.1 * twist.value), 1e-8 * np.eye(3), se2.right_jacobian(0.1 * twist.value) @ (0.1 * twist.d_params))

    while_learning, at_once = MotionPreintegration(len(correct.names)), MotionPreintegration(len(correct.names))
    predicted = np.zeros(3)
    for share in np.linspace(0.0, 1.0, 10):
        predicted = se2.compose(predicted, motion(share * final).delta)
        while_learning.add(motion(share * final), correct, True, share * final)
        at_once.add(motion(final), correct, True, final)
    expected = at_once.with_corrections(final).delta
    off = se2.log(se2.between(expected, while_learning.with_corrections(final).delta))
    as_predicted = se2.log(se2.between(expected, predicted))
    assert np.abs(off).max() < 0.1 * np.abs(as_predicted).max()


@pytest.mark.extended
def test_graph_smoothed_has_consistent_nees() -> None:
    """The middle and the end of five drives, of 3 degrees of freedom each; slip is far less than assumed (`QUIET`)."""
    found = []
    for seed in range(5):
        drive, (estimates, pipeline) = around(seed), estimated(seed)
        whole = smoothed(estimates, pipeline)
        assert whole.covariances is not None
        for share in (0.5, 0.95):
            k = int(share * len(drive.stamps))
            i = int(np.searchsorted(whole.stamps_ns, drive.stamps[k]))
            assert whole.stamps_ns[i] == drive.stamps[k]
            error = se2.log(se2.between(drive.poses[k], whole.poses[i]))
            found.append(nees(error[None], whole.covariances[i : i + 1])[0])
    assert 0.1 < np.mean(found) < 6.0


# --- what may be missing


def test_graph_with_empty_scans_closes_no_loops() -> None:
    drive = around()
    blind = [
        replace(e, points=e.points[:0], offsets=e.offsets[:0]) if isinstance(e, Scan) and i % 3 else e for i, e in enumerate(drive.events)
    ]
    pipeline = make_pipeline(drive)
    estimates = run(pipeline, blind)
    assert np.isfinite([e.pose for e in estimates]).all()
    assert pipeline.estimator.counts()["keyframes"] > 40
    assert np.isfinite(smoothed(estimates, pipeline).poses).all()


@pytest.mark.extended
def test_graph_of_wheels_alone_has_keyframes() -> None:
    """Without LiDAR and positions it is dead reckoning, with a covariance that grows."""
    drive = around()
    pipeline = make_pipeline(drive, has_lidar=False)
    estimates = run(pipeline, [e for e in drive.events if isinstance(e, WheelSample)])
    sigmas = [float(np.sqrt(np.trace(e.covariance[:2, :2]))) for e in estimates]
    assert sigmas[-1] > 5.0 * sigmas[len(sigmas) // 10]
    assert pipeline.estimator.counts()["keyframes"] > 40
    assert "loops" not in pipeline.estimator.counts()
    assert len(pipeline.estimator.map_points()) == 0
    whole = smoothed(estimates, pipeline)
    assert np.abs(se2.between(whole.poses, np.array([e.pose for e in estimates]))).max() < 0.05


# --- positions


def positions(drive: rooms.Drive, sigma_m: float = 0.1, spoil: dict[int, np.ndarray] | None = None) -> list[PositionSample]:
    """One each second, of a plane that is turned and moved."""
    rng, enu_T_map = np.random.default_rng(1), np.array([300.0, -200.0, 0.9])
    found = []
    for n, k in enumerate(range(0, len(drive.stamps), 6)):
        at = se2.compose(enu_T_map, drive.poses[k])[:2] + sigma_m * rng.normal(size=2) + (spoil or {}).get(n, np.zeros(2))
        found.append(PositionSample(int(drive.stamps[k]), at, sigma_m**2 * np.eye(2)))
    return found


def driven_with(fixes: list[PositionSample]) -> tuple[np.ndarray, Pipeline]:
    """Errors [m] of the smoothed poses by wheels and ``fixes`` alone."""
    drive, pipeline = around(), make_pipeline(around(), has_lidar=False)
    wheels = [e for e in drive.events if isinstance(e, WheelSample)]
    estimates = run(pipeline, list(merge_positions(wheels, fixes)))
    whole = smoothed(estimates, pipeline)
    at = np.column_stack([np.interp(drive.stamps, whole.stamps_ns, column) for column in whole.poses[:, :2].T])
    return np.hypot(*(at - drive.poses[:, :2]).T), pipeline


@pytest.mark.extended
def test_graph_with_positions_corrects_wrong_wheels() -> None:
    without, with_fixes = driven_with([])[0], driven_with(positions(around()))[0]
    assert without.max() > 2.0
    assert np.sqrt(np.mean(with_fixes**2)) < 0.2 * np.sqrt(np.mean(without**2))


@pytest.mark.extended
def test_graph_with_outlier_position_keeps_poses() -> None:
    clean, pipeline = driven_with(positions(around()))
    spoilt, _ = driven_with(positions(around(), spoil={40: np.array([50.0, 0.0])}))
    assert pipeline.estimator.counts()["positions"] > 70
    assert pipeline.estimator.warnings() == []
    assert np.abs(spoilt - clean).max() < 0.3
    plane = pipeline.estimator.keyframe_map().plane
    off = se2.local(plane.plane_T_map, np.array([300.0, -200.0, 0.9]))
    assert off @ np.linalg.solve(plane.covariance, off) < 16.3  # 99.9 % of normal errors


@pytest.mark.extended
def test_graph_with_first_position_far_off_leaves_it_out() -> None:
    """It is among those that give the map its heading."""
    errors, pipeline = driven_with(positions(around(), spoil={1: np.array([1e5, 1e5])}))
    assert np.sqrt(np.mean(errors**2)) < 0.5
    (warning,) = pipeline.estimator.warnings()
    assert warning.startswith("1 of ")


def test_graph_with_positions_at_rest_reports_them_unused() -> None:
    drive, pipeline = around(), make_pipeline(around(), has_lidar=False)
    fixes = positions(drive)[:3]  # the first one comes before the first keyframe
    wheels = [e for e in drive.events if isinstance(e, WheelSample) and e.stamp_ns <= fixes[-1].stamp_ns + 200_000_000]
    run(pipeline, list(merge_positions(wheels, fixes)))
    assert "2 positions could not be used" in pipeline.warnings()[-1]


@pytest.mark.extended
def test_graph_with_position_that_comes_late_reports_it() -> None:
    fixes = positions(around())
    late = replace(fixes[60], stamp_ns=fixes[20].stamp_ns)
    pipeline = make_pipeline(around(), has_lidar=False)
    wheels = [e for e in around().events if isinstance(e, WheelSample)]
    events = [e for e in merge_positions(wheels, fixes) if e is not fixes[60]]
    at = next(i for i, e in enumerate(events) if e.stamp_ns > fixes[60].stamp_ns)
    run(pipeline, [*events[:at], late, *events[at:]])
    (warning,) = pipeline.estimator.warnings()
    assert warning.startswith("1 position came after")


@pytest.mark.extended
def test_graph_with_named_radius_has_it_once() -> None:
    """`wheel_radius_scale` is a correction of the motion model here, with the size of the graph's own, and not there a second time."""
    trial = Trial(make_model("diff_drive", rooms.ROBOT), "graph", "constant+wheel_radius_scale")
    pipeline = Pipeline(trial, rooms.ROBOT, around().mounts, True)
    run(pipeline, around().events)
    size, sigma = pipeline.estimator.parameters()["wheel_radius_scale"]
    own, _ = estimated()[1].estimator.parameters()["wheel_radius_scale"]
    assert size == pytest.approx(own, abs=0.01)
    assert own == pytest.approx(1.0 / RADIUS_ERROR - 1.0, abs=0.01)
    assert 0.0 < sigma < 0.03
    assert pipeline.estimator.graph.corrections()[1][-1, -1] < 1e-6


def test_graph_takes_the_prior_of_the_radius_from_the_settings() -> None:
    """0 is the robot file's radius: the graph has no variable for it either."""
    config = ReplayConfig(estimator=EstimatorConfig(ekf=FilterConfig(wheel_radius_sigma=0.0)))
    trial = Trial(make_model("diff_drive", rooms.ROBOT), "graph")
    (fixed,) = replay(around().events[:600], [trial], rooms.ROBOT, around().mounts, True, config)
    (free,) = replay(around().events[:600], [trial], rooms.ROBOT, around().mounts, True)
    assert "wheel_radius_scale" not in fixed.parameters
    assert free.parameters["wheel_radius_scale"][1] > 0.0


def test_graph_positions_wait_for_heading() -> None:
    """From a robot that has not moved by 5 m they do not tell where the map is turned to."""
    drive = around()
    pipeline = make_pipeline(drive, is_smoothing=False)
    until = rooms.WALL_START_NS + 5 * 10**9
    run(pipeline, list(merge_positions([e for e in drive.events if e.stamp_ns < until], positions(drive))))
    assert "positions" not in pipeline.estimator.counts()


def test_graph_with_positions_and_silent_lidar_uses_them() -> None:
    """Its topic is there, and no scan ever comes."""
    drive, pipeline = around(), make_pipeline(around())
    wheels = [e for e in drive.events if isinstance(e, WheelSample)]
    run(pipeline, list(merge_positions(wheels, positions(drive))))
    counts = pipeline.estimator.counts()
    assert counts["positions"] > 70
    assert counts["keyframes"] > 20


def test_smoothed_after_the_lidars_end_is_as_uncertain_as_the_filter() -> None:
    drive, pipeline = around(), make_pipeline(around())
    until = rooms.WALL_START_NS + 20 * 10**9
    estimates = run(pipeline, [e for e in drive.events if isinstance(e, WheelSample) or e.stamp_ns < until])
    live, whole = estimates[-1].covariance, smoothed(estimates, pipeline).covariances
    assert np.sqrt(np.trace(live[:2, :2])) > 0.1
    np.testing.assert_allclose(np.sqrt(np.diag(whole[-1])), np.sqrt(np.diag(live)), rtol=0.1)


@given(st.floats(-3.0, 3.0), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_keyframe_motion_derivative_by_radius_is_numeric(x: float, y: float, yaw: float) -> None:
    """Ways scale, turns do not."""
    motion, h = MotionPreintegration(0), 1e-6
    none = make_corrections(make_model("diff_drive", rooms.ROBOT), "none")
    delta = np.array([x, y, yaw])
    motion.add(Motion(delta, 1e-6 * np.eye(3), np.zeros((3, 0))), none, True, np.zeros(0))
    more, less = (delta * [1.0 + step, 1.0 + step, 1.0] for step in (h, -h))
    numeric = (se2.log(se2.between(delta, more)) - se2.log(se2.between(delta, less))) / (2.0 * h)
    np.testing.assert_allclose(motion.with_corrections(np.zeros(0)).by_corrections[:, -1], numeric, atol=1e-6)


# --- checkpoints


def numbers(estimate: Estimate) -> tuple:
    arrays = (estimate.pose, estimate.covariance, estimate.twist, estimate.odometry[0], estimate.odometry[1], estimate.map_T_odom)
    return estimate.stamp_ns, *(array.tobytes() for array in arrays)


@pytest.mark.extended
def test_graph_resumed_after_loops_equals_uncut_bitwise() -> None:
    drive = around()
    fixed = list(merge_positions(drive.events, positions(drive)))
    pipeline, cut = make_pipeline(drive), int(0.97 * len(fixed))
    for event in fixed[:cut]:
        pipeline.process(event)
    assert pipeline.estimator.counts()["loops"] >= 2
    assert pipeline.estimator.counts()["positions"] > 50
    resumed = deserialize(*serialize(pipeline))
    assert list(map(numbers, run(pipeline, fixed[cut:]))) == list(map(numbers, run(resumed, fixed[cut:])))
    assert dict(pipeline.estimator.parameters()) == dict(resumed.estimator.parameters())


@pytest.mark.extended
def test_graph_replay_equals_live_bitwise() -> None:
    drive, (estimates, pipeline) = around(), estimated()
    live = make_pipeline(drive, is_smoothing=False)
    found = []
    for event in drive.events:
        found += live.process(event)
        live.run_deferred()
    found += live.finish()
    (replayed,) = replay(drive.events, [Trial(make_model("diff_drive", rooms.ROBOT), "graph")], rooms.ROBOT, drive.mounts, True)
    assert list(map(numbers, found)) == list(map(numbers, estimates))
    assert replayed.live is not None
    assert np.array_equal(replayed.live.poses[-1], found[-1].pose)
    assert np.array_equal(replayed.trajectory.poses, smoothed(estimates, pipeline).poses)


# --- parts


@pytest.mark.extended
@pytest.mark.parametrize("has_lidar", [True, False])
def test_graph_without_loops_is_as_certain_as_the_filter(has_lidar):
    """In a bare corridor scans show the heading and one axis; without scans wheels count once, and the radius is its prior in both."""
    drive = rooms.drive_through(world.box(-5, -1, 60, 1), rooms.path((1, 0, 0), (30, 0.5, 0.0), (1, 0, 0)), 0, (0.0, 0.1, 0.02))
    trials = [Trial(make_model("diff_drive", rooms.ROBOT), name, "none") for name in ("ekf", "graph")]
    ekf, graph = replay(drive.events, trials, rooms.ROBOT, drive.mounts, has_lidar)
    assert graph.live is not None
    for found in (graph.live, graph.trajectory):
        assert ekf.trajectory.covariances is not None
        assert found.covariances is not None
        certain, ours = (np.sqrt(np.diagonal(t.covariances[-1])) for t in (ekf.trajectory, found))
        assert (ours > 0.9 * certain).all()
        assert (ours < 1.7 * certain).all()
        assert np.abs(se2.between(ekf.trajectory.poses[-1], found.poses[-1])[:2]).max() < certain[:2].max()


def test_smoothed_poses_between_keyframes_have_the_noise_of_scans() -> None:
    """A robot that rests, and creeps, before the second keyframe: the first one is the origin, and has no noise."""
    drive = rooms.drive_through(world.lab().walls, rooms.path((5, 0, 0), (8, 0.01, 0.0), (6, 0.5, 0.2), (1, 0, 0)), 0)
    (run,) = replay(drive.events, [Trial(make_model("diff_drive", rooms.ROBOT), "graph")], rooms.ROBOT, drive.mounts, True)
    poses, covs = rooms.at_scans(drive, run)
    assert covs is not None
    early = (drive.stamps > drive.stamps[0] + 2e9) & (drive.stamps < drive.stamps[0] + 12e9)
    found = nees(se2.log(se2.between(drive.poses, poses))[early], covs[early])
    assert found.mean() < 8.0
    live = np.searchsorted(run.live.stamps_ns, drive.stamps)
    assert (np.sqrt(covs[early, 0, 0]) > 0.4 * np.sqrt(run.live.covariances[live][early, 0, 0])).all()


@pytest.mark.slow
def test_graph_with_a_field_of_corrections_can_be_smoothed() -> None:
    """Prior sigmas of a field over the CG differ by a factor of 1,500, and corrections are 16 variables in a row."""
    run = BUILDINGS["fr079"].open().run("graph", "skid_steer", "cg_field")
    assert run.live is not None
    assert not [warning for warning in run.warnings if "smoothed" in warning]


def test_graph_that_cannot_be_smoothed_keeps_its_live_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: LivePoseGraph) -> None:
        raise EstimatorError("the pose graph cannot be solved.")

    drive = around()
    monkeypatch.setattr(LivePoseGraph, "smooth", fail)
    (run,) = replay(drive.events[:600], [Trial(make_model("diff_drive", rooms.ROBOT), "graph")], rooms.ROBOT, drive.mounts, True)
    assert run.live is None
    assert len(run.trajectory) > 50
    assert [warning for warning in run.warnings if "could not be smoothed" in warning and "cannot be solved" in warning]


def test_smoothed_covariance_has_what_widens_live_poses_not_between_keyframes() -> None:
    """Sensor faults inflate live covariances; smoothed ones are inflated by the pipeline afterwards, alike at keyframes and between."""
    estimates, pipeline = run(make_pipeline(around()), around().events[:600]), make_pipeline(around())
    run(pipeline, around().events[:600])
    wide = [replace(e, covariance=e.covariance + 0.1 * np.eye(3)) for e in estimates]
    np.testing.assert_array_equal(smoothed(wide, pipeline).covariances, smoothed(estimates, pipeline).covariances)


@pytest.mark.extended
@pytest.mark.xfail(reason="angles on both sides of the gap measure the way: its sigma is .15 m, not metres", strict=False)
def test_graph_after_a_gap_of_all_sensors_is_where_the_scans_find_it() -> None:
    """Its keyframes before that are uncertain by metres, and what a scan shows is not about them."""
    circles = rooms.path((1, 0, 0), (60, 0.5, 0.4))
    drive = rooms.drive_through(world.lab().walls, circles, 0, (-0.5, -1.5, 0.0))
    gap, until_wheels, until_scans = rooms.WALL_START_NS + np.array([30, 34, 39]) * 10**9
    events = [e for e in drive.events if not gap < e.stamp_ns < (until_wheels if isinstance(e, WheelSample) else until_scans)]
    pipeline = make_pipeline(drive)
    estimates = run(pipeline, events)
    sigmas = np.array([np.sqrt(np.trace(e.covariance[:2, :2])) for e in estimates])
    stamps = np.array([e.stamp_ns for e in estimates])
    lost = (stamps > until_wheels) & (stamps < until_scans)
    keyframes = pipeline.estimator.keyframe_map().stamps_ns
    assert ((keyframes > until_wheels) & (keyframes < until_scans)).sum() > 1
    assert sigmas[lost].min() > 0.5
    found = stamps > until_scans + 3 * 10**9
    truth = drive.poses[np.searchsorted(drive.stamps, stamps[found])]
    assert np.hypot(*(np.array([e.pose for e in estimates])[found] - truth)[:, :2].T).max() < 0.05
    assert sigmas[found].max() < 0.1


@pytest.mark.extended
def test_graph_with_silent_lidar_has_keyframes_without_scan() -> None:
    """The scan of before the silence was measured elsewhere."""
    drive, pipeline = around(), make_pipeline(around())
    silent = (rooms.WALL_START_NS + 5 * 10**9, rooms.WALL_START_NS + 16 * 10**9)
    run(pipeline, [e for e in drive.events if isinstance(e, WheelSample) or not silent[0] < e.stamp_ns < silent[1]])
    has_scan = (pipeline.estimator.keyframe_map().counts > 0).tolist()
    assert (has_scan[0], all(has_scan), has_scan[-1]) == (True, False, True)


def test_subtract_information_with_wheels_gives_filters_motion() -> None:
    wheels, wheel_cov = np.array([1.0, 0.0, 0.1]), np.diag([0.05, 0.05, 0.03]) ** 2
    delta, cov = np.array([1.01, 0.005, 0.11]), np.diag([0.01, 0.01, 0.002]) ** 2
    measured, information = subtract_information(SE2, delta, cov, wheels, wheel_cov)
    np.testing.assert_allclose(information + np.linalg.inv(wheel_cov), np.linalg.inv(cov), rtol=1e-9)
    by_scans, by_wheels = se2.log(se2.between(delta, measured)), se2.log(se2.between(delta, wheels))
    np.testing.assert_allclose(
        information @ by_scans + np.linalg.inv(wheel_cov) @ by_wheels, 0.0, atol=0.02 * np.abs(information @ by_scans).max()
    )


@pytest.mark.parametrize("scan_sigma_m", [0.01, 0.03, 0.09])
def test_subtract_information_counts_each_measurement_once(scan_sigma_m: float) -> None:
    """Wheels and what is left of the filter's motion have the filter's covariance, also where scans are three times worse than wheels."""
    wheels = np.diag([1.0, 1.0, 1.0]) / 0.03**2
    scans = np.diag([scan_sigma_m**-2, scan_sigma_m**-2, 0.002**-2])
    cov = np.linalg.inv(wheels + scans)
    information = subtract_information(SE2, np.array([1.0, 0.0, 0.1]), cov, np.array([1.01, 0.0, 0.1]), np.linalg.inv(wheels))[1]
    np.testing.assert_allclose(np.linalg.inv(information + wheels), cov, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("gain", [0.5, 0.999, 1.0, 1.001, 1.5])
def test_subtract_information_stays_within_wheels_distance(gain: float) -> None:
    """Also where scans say next to nothing along x: a difference is not divided by nothing."""
    wheels, wheel_cov = np.array([1.1, 0.0, 0.0]), np.diag([0.02, 0.02, 0.05]) ** 2
    delta, cov = np.array([1.0, 0.0, 0.0]), wheel_cov * [[1.0 / gain], [0.1], [0.1]]
    measured, information = subtract_information(SE2, delta, cov, wheels, wheel_cov)
    assert np.abs(measured - delta).max() <= 0.1 + 1e-9
    assert (np.linalg.eigvalsh(information) > 0.0).all()
