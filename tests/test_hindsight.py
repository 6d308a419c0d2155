"""What the whole way tells once it has come back to places it knows: errors shrink to what the loops leave, and are as large as is said."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from localization import Pair, replay
from localization.consistency import mean_band
from localization.errors import EstimatorError
from localization.estimators.hindsight import Hindsight, Loop
from localization.events import Scan
from localization.online.core import Core
from localization.run import Run
from localization.trajectory import Trajectory
from motion_models import se2
from motion_models.registry import make_model
from tests import rooms
from tests.test_revisits import START, laps, ring

STEP_COV = np.diag([0.01, 0.004, 0.002]) ** 2
LOOP_COV = np.diag([0.02, 0.02, 0.004]) ** 2
BENT = (4.0 / 6.0 + 8.0 / 3.0) * 4.0 * STEP_COV  # of a map that is drawn and matched along some metres of this way, four steps each
STEPS = 240
STAMPS = np.arange(STEPS + 1) * 100_000_000


def truth() -> np.ndarray:
    """(STEPS + 1, 3) a figure of eight, and where it began again: steps of 0.25 m."""
    turn = np.where(np.arange(STEPS) < STEPS // 2, 1.0, -1.0) * 4.0 * math.pi / STEPS
    poses = [np.array([1.0, -2.0, 0.3])]
    for w in turn:
        poses.append(se2.compose(poses[-1], se2.exp(np.array([0.25, 0.0, w]))))
    return np.array(poses)


def driven(rng: np.random.Generator, cov: np.ndarray = STEP_COV) -> Trajectory:
    """Estimates of moments whose errors grow by a random walk of ``cov`` a step, and are said to."""
    true, poses, covs = truth(), [truth()[0]], [np.zeros((3, 3))]
    for motion in se2.between(true[:-1], true[1:]):
        estimated = se2.compose(motion, se2.exp(rng.multivariate_normal(np.zeros(3), cov)))
        poses.append(se2.compose(poses[-1], estimated))
        covs.append(later(covs[-1], estimated, cov))
    return Trajectory(STAMPS, np.array(poses), np.array(covs))


def later(cov: np.ndarray, motion: np.ndarray, more: np.ndarray) -> np.ndarray:
    A = se2.adjoint(se2.inverse(motion))
    return A @ cov @ A.T + more


def seen_again(rng: np.random.Generator, a: int, b: int) -> Loop:
    true = truth()
    motion = se2.compose(se2.between(true[a], true[b]), se2.exp(rng.multivariate_normal(np.zeros(3), LOOP_COV + BENT)))
    return Loop(int(STAMPS[a]), int(STAMPS[b]), motion, LOOP_COV)


def smoothed(moments: Trajectory, *loops: Loop, cov: np.ndarray = STEP_COV, jump: tuple[int, np.ndarray] | None = None) -> Trajectory:
    """As the graph does it: a node a metre, at each loop and at the end; the estimate is moved to ``jump`` (3,) at a moment."""
    hindsight, growth, last = Hindsight(), np.zeros((3, 3)), moments.poses[0]
    for i, pose in enumerate(moments.poses):
        if i:
            growth = later(growth, se2.between(last, pose), cov)
        last = pose
        ends = [loop for loop in loops if loop.to_ns == STAMPS[i]]
        if hindsight.is_due(pose) or ends or (jump and jump[0] == i) or i == STEPS:
            hindsight.add(int(STAMPS[i]), pose, growth)
            growth = np.zeros((3, 3))
        hindsight.loops += [loop for loop in loops if loop.to_ns == STAMPS[i] or (i == STEPS and loop.to_ns > STAMPS[-1])]
        if jump and jump[0] == i:
            hindsight.jump(int(STAMPS[i]), jump[1])
            last = jump[1]
    found = hindsight.smooth(moments)
    assert found is not None
    return found


def nees(found: Trajectory, i: int) -> float:
    error = se2.log(se2.between(truth()[i], found.poses[i]))
    assert found.covariances is not None
    return float(error @ np.linalg.solve(found.covariances[i], error))


def test_a_closed_loop_takes_the_drift_of_all_of_it_back_and_says_what_is_left() -> None:
    """NEES over 100 drives at four moments, nodes and between them; half the drift is gone in the middle, nearly all of it at the end."""
    rng, off, found = np.random.default_rng(0), [], []
    for _ in range(100):
        moments = driven(rng)
        after = smoothed(moments, seen_again(rng, 0, STEPS), seen_again(rng, 30, 121))
        found.append([nees(after, i) for i in (60, 111, 170, STEPS)])
        off.append([[float(np.hypot(*(t.poses[i] - truth()[i])[:2])) for i in (60, 170, STEPS)] for t in (moments, after)])
    low, high = mean_band(100, 3.0)
    assert ((low < np.mean(found, axis=0)) & (np.mean(found, axis=0) < high)).all(), np.mean(found, axis=0)
    before, now = np.sqrt(np.mean(np.square(off), axis=0))
    assert (now < np.array([0.9, 0.6, 0.2]) * before).all(), (before, now)


def test_without_a_loop_there_is_nothing_to_say() -> None:
    assert Hindsight().smooth(driven(np.random.default_rng(0))) is None


def test_a_jump_of_the_estimate_is_no_motion_of_the_robot() -> None:
    """At moment 120 the estimate is put where it belongs; seen from the end, the robot went on as its wheels say."""
    rng = np.random.default_rng(1)
    moments, k = driven(rng, 100.0 * STEP_COV), 120
    right, drifted = truth()[k], moments.poses[k]
    assert np.hypot(*(drifted - right)[:2]) > 0.3
    poses = moments.poses.copy()
    poses[k + 1 :] = se2.compose(right, se2.between(drifted, poses[k + 1 :]))
    jumped = Trajectory(STAMPS, poses, moments.covariances)
    loop = Loop(0, int(STAMPS[k]), se2.between(truth()[0], right), LOOP_COV)
    found = smoothed(jumped, loop, cov=100.0 * STEP_COV, jump=(k, right))
    across = se2.between(found.poses[k], found.poses[k + 1])
    assert np.abs(across - se2.between(drifted, moments.poses[k + 1])).max() < 0.02
    blind = smoothed(jumped, loop, cov=100.0 * STEP_COV)
    assert np.abs(se2.between(blind.poses[k], blind.poses[k + 1]) - across).max() > 0.05


def test_a_loop_that_is_wrong_among_right_ones_moves_little() -> None:
    rng = np.random.default_rng(2)
    moments = driven(rng)
    right = [seen_again(rng, 0, STEPS), seen_again(rng, 5, 125), seen_again(rng, 10, 130), seen_again(rng, 0, 235)]
    wrong = Loop(int(STAMPS[60]), int(STAMPS[100]), np.array([3.0, -2.0, 1.0]), LOOP_COV)
    without, within = smoothed(moments, *right), smoothed(moments, *right, wrong)
    assert np.hypot(*(without.poses - within.poses)[:, :2].T).max() < 0.1


def test_where_the_way_was_worse_than_was_thought_a_sure_place_is_believed() -> None:
    """Wheels slip by 1 m at moment 60, which no covariance knows; at 180 a place is recognised, surely, with the slip that this tells."""
    rng, k = np.random.default_rng(5), 180
    moments = driven(rng)
    poses = moments.poses.copy()
    poses[60:] = se2.compose(se2.compose(poses[60], np.array([1.0, 0.0, 0.0])), se2.between(poses[60], poses[60:]))
    right = se2.compose(poses[5], se2.between(truth()[5], truth()[k]))
    off = se2.log(se2.between(poses[k], right))
    loop = Loop(int(STAMPS[5]), int(STAMPS[k]), se2.between(truth()[5], truth()[k]), LOOP_COV, np.outer(off, off))
    poses[k + 1 :] = se2.compose(right, se2.between(poses[k], poses[k + 1 :]))
    slipped = Trajectory(STAMPS, poses, moments.covariances)

    def off_after(slip: np.ndarray) -> float:
        found = smoothed(slipped, replace(loop, slip=slip), jump=(k, right))
        return float(np.hypot(*(found.poses - truth())[k:, :2].T).mean())

    assert off_after(loop.slip) < 0.25
    assert off_after(np.zeros((3, 3))) > 0.35  # or nothing would have been tried


def test_what_is_outside_of_the_log_is_left_out() -> None:
    rng = np.random.default_rng(6)
    moments, loop = driven(rng), seen_again(rng, 0, STEPS)
    late, early = replace(loop, to_ns=int(STAMPS[-1]) + 1), replace(loop, from_ns=-1)
    assert np.array_equal(smoothed(moments, loop).poses, smoothed(moments, loop, late, early).poses)


def test_moments_keep_their_stamps_and_the_motion_between_them() -> None:
    rng = np.random.default_rng(3)
    moments = driven(rng)
    found = smoothed(moments, seen_again(rng, 0, STEPS))
    assert np.array_equal(found.stamps_ns, moments.stamps_ns)
    steps = [se2.between(t.poses[:-1], t.poses[1:]) for t in (moments, found)]
    assert np.abs(steps[0] - steps[1]).max() < 0.02  # a drift of metres is spread over all steps
    assert np.isfinite(found.poses).all()
    assert found.covariances is not None
    assert (np.linalg.eigvalsh(found.covariances[1:]) > 0.0).all()  # the first is the origin


# --- the whole of it, on a lap and a half ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drives() -> list[tuple[rooms.Drive, Trajectory, Trajectory]]:
    """Drives, what the graph said of each moment, and what it says of them at the end."""
    return [(drive, *_tracks(run)) for drive, run in _runs()]


@functools.cache
def _runs() -> list[tuple[rooms.Drive, Run]]:
    found = []
    for seed in range(4):
        drive = laps(seed)
        (run,) = replay(drive.events, [Pair(make_model("diff_drive", rooms.ROBOT), "graph")], rooms.ROBOT, drive.mounts, has_lidar=True)
        assert run.counts["loops"] > 0
        found.append((drive, run))
    return found


def _tracks(run: Run) -> tuple[Trajectory, Trajectory]:
    assert run.moments is not None
    return run.moments, run.trajectory


def errors(drive: rooms.Drive, track: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) of the poses at scans from the second one on, and (K,) their normalised squares."""
    use = np.isin(track.stamps_ns, drive.stamps[1:])
    poses = dict(zip(drive.stamps.tolist(), drive.poses, strict=True))
    true = np.array([poses[s] for s in track.stamps_ns[use].tolist()])
    off = se2.log(se2.between(true, track.poses[use]))
    assert track.covariances is not None
    return off, np.einsum("ki,ki->k", off, np.linalg.solve(track.covariances[use], off[:, :, None])[:, :, 0])


def test_the_first_lap_is_mended_by_the_second(drives) -> None:
    """What an estimate of a moment cannot know: the way as a whole is nearer to the truth, in every drive, and by a quarter in most."""
    rms = np.array([[math.sqrt((errors(drive, t)[0][:, :2] ** 2).sum(axis=1).mean()) for t in two] for drive, *two in drives])
    assert rms[:, 0].max() > 0.1  # or there were nothing to mend
    assert (rms[:, 1] < rms[:, 0]).all(), rms
    assert np.median(rms[:, 1] / rms[:, 0]) < 0.75, rms


def test_what_is_said_of_its_errors_is_true(drives) -> None:
    """One drive is one sample, as its moments share their errors: the mean over four is within 99.8 % of what three numbers each give."""
    for which in (1, 2):
        mean = np.mean([errors(each[0], each[which])[1].mean() for each in drives])
        assert chi2.ppf(0.001, 12) / 4 < mean < chi2.ppf(0.999, 12) / 4, (which, mean)


def test_hindsight_changes_no_estimate_of_a_moment(drives) -> None:
    drive, moments, _ = drives[0]
    core = Core(Pair(make_model("diff_drive", rooms.ROBOT), "graph"), rooms.ROBOT, drive.mounts, True)
    live = [estimate for event in drive.events for estimate in core.push(event)] + core.finish()
    known = {estimate.stamp_ns: estimate for estimate in live}
    for stamp, pose in zip(moments.stamps_ns.tolist(), moments.poses, strict=True):
        assert np.array_equal(known[stamp].pose, pose)
    # and the map is drawn where the robot went, as is known now
    walls = se2.transform(se2.inverse(np.array(START)), ring()[:, :4].reshape(-1, 2)).reshape(-1, 4)
    then, now = core.estimator.map_points(), _runs()[0][1].map_points
    assert len(then) == len(now) > 1000
    assert np.hypot(*(now - then).T).max() > 0.1
    assert np.mean(_distance(now, walls)) < 0.03  # of a corridor's walls nothing tells how far along them


def test_scans_that_begin_late_leave_the_way_before_as_unsure_as_it_was() -> None:
    """For 12 s the LiDAR sees nothing; what is said of that part of the way is by wheels alone, and says so at the end, too."""
    drive = laps(0)
    blind = [
        replace(e, points=np.empty((0, 3)), offsets=np.empty(0)) if isinstance(e, Scan) and e.stamp_ns < 13e9 else e for e in drive.events
    ]
    (run,) = replay(blind, [Pair(make_model("diff_drive", rooms.ROBOT), "graph")], rooms.ROBOT, drive.mounts, has_lidar=True)
    assert run.counts["loops"] > 0
    for track in _tracks(run):
        assert errors(drive, track)[1].mean() < chi2.ppf(0.999, 3)


def test_where_no_solution_is_found_the_estimates_of_each_moment_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(self: Hindsight, moments: Trajectory) -> Trajectory:
        raise EstimatorError("the graph is singular")

    drive, kept = _runs()[0]
    monkeypatch.setattr(Hindsight, "smooth", fails)
    (run,) = replay(drive.events, [Pair(make_model("diff_drive", rooms.ROBOT), "graph")], rooms.ROBOT, drive.mounts, has_lidar=True)
    assert run.counts["loops_unsolved"] == kept.counts["loops"]
    assert run.moments is None
    assert np.array_equal(run.trajectory.poses, _tracks(kept)[0].poses)


def _distance(points: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """(N,) of ``points`` (N, 2) from the nearest of ``walls`` (W, 4), by their ends."""
    a, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    part = np.einsum("nwi,wi->nw", points[:, None] - a, along) / (along**2).sum(axis=1)
    nearest = a + np.clip(part, 0.0, 1.0)[:, :, None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1)
