"""Scores: compared with evo where definitions agree, and on cases with an analytic answer.

Where evo's definitions differ from ours, and so what is not compared: evo's relative pose error is not divided by the distance, takes
the sample *nearest* to the wanted distance (ours: the first at or beyond it; the same on paths of equal steps that divide the distance),
and has no noise floor in its path length. Its alignment is in space and could turn a planar path over; it does not for paths that
resemble each other. It has no end error, no drift and no relations metric.
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from scipy.optimize import minimize

from localization.errors import EvaluationError
from localization.evaluation.metrics import Accuracy, EvaluateConfig, align, evaluate, score_relations
from localization.evaluation.reference_files import read_reference_file
from localization.evaluation.references import ReferenceTrack, Relations, read_relations, reference_track
from localization.events import Reference
from localization.trajectory import Trajectory, write_tum
from motion_models import se2

SECOND = 10**9
ACES = Path(__file__).parents[1] / "data" / "aces" / "aces.relations"


def planar_path(seed, n=400, step=0.25):
    """(n, 3) poses of a robot that wanders in equal steps."""
    rng = np.random.default_rng(seed)
    course = np.cumsum(rng.normal(0, 0.2, n))
    xy = np.cumsum(step * np.column_stack([np.cos(course), np.sin(course)]), axis=0)
    return np.column_stack([xy, se2.wrap_angle(course + rng.normal(0, 0.1, n))])


def disturbed(poses, seed, size=0.02):
    """The same path with a drift and noise, in another plane."""
    rng = np.random.default_rng(seed)
    motions = se2.compose(se2.between(poses[:-1], poses[1:]), se2.exp(rng.normal(0, size, (len(poses) - 1, 3))))
    path = [np.array([5.0, -3.0, 2.0])]
    for motion in motions:
        path.append(se2.compose(path[-1], motion))
    return np.array(path)


def seconds(n):
    return np.arange(n, dtype=np.int64) * SECOND


def track(poses, **more):
    return ReferenceTrack(seconds(len(poses)), poses[:, :2], poses[:, 2], **more)


def positions_only(poses):
    return ReferenceTrack(seconds(len(poses)), poses[:, :2])


def evo_path(poses):
    matrices = []
    for x, y, theta in poses:
        c, s = math.cos(theta), math.sin(theta)
        matrices.append(np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    return PosePath3D(poses_se3=matrices)


@pytest.mark.parametrize("seed", range(5))
def test_ate_is_that_of_evo(seed):
    truth = planar_path(seed)
    estimate = disturbed(truth, seed)
    found = evaluate(Trajectory(seconds(400), estimate), track(truth))
    other_truth, other = evo_path(truth), evo_path(estimate)
    other.align(other_truth)
    for relation, ours in (
        (metrics.PoseRelation.translation_part, found.ate_rmse_m),
        (metrics.PoseRelation.rotation_angle_deg, found.ate_rmse_deg),
    ):
        ape = metrics.APE(relation)
        ape.process_data((other_truth, other))
        assert ours == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    np.testing.assert_allclose(found.errors.estimate[:, :2], other.positions_xyz[:, :2], atol=1e-9)
    np.testing.assert_allclose(se2.compose(found.reference_T_world, estimate), found.errors.estimate, atol=1e-12)


@pytest.mark.parametrize(("seed", "length"), [(0, 1.0), (1, 2.0), (2, 5.0), (0, 50.0)])
def test_rpe_is_that_of_evo(seed, length):
    truth = planar_path(seed)
    estimate = disturbed(truth, seed)
    found = evaluate(Trajectory(seconds(400), estimate), track(truth), EvaluateConfig(rpe_distances_m=(length,)))
    ours = found.rpe[0]
    for relation, mean in (
        (metrics.PoseRelation.translation_part, ours.translation_percent / 100.0 * length),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation_deg_per_m * length),
    ):
        rpe = metrics.RPE(relation, length, metrics.Unit.meters, rel_delta_tol=1e-6, all_pairs=True, pairs_from_reference=True)
        rpe.process_data((evo_path(truth), evo_path(estimate)))
        assert len(rpe.error) == ours.n
        assert mean == pytest.approx(rpe.get_statistic(metrics.StatisticsType.mean), abs=1e-9)


def test_align_no_other_rigid_motion_has_less_error():
    truth = planar_path(7)
    estimate = disturbed(truth, 7, size=0.1)

    def cost(pose):
        return np.sum((se2.transform(pose, estimate[:, :2]) - truth[:, :2]) ** 2)

    found = align(estimate, truth[:, :2])
    for start in ([0, 0, 0], [1, 1, 2], [-5, 3, -2]):
        best = minimize(cost, start, method="BFGS")
        assert cost(found) <= best.fun + 1e-9 * best.fun
        np.testing.assert_allclose(found[:2], best.x[:2], atol=1e-3)


def test_score_perfect_estimate_in_another_plane_has_no_error():
    truth = planar_path(1)
    moved = se2.compose([10.0, -20.0, 2.5], truth)
    found = evaluate(Trajectory(seconds(400), moved), track(truth))
    for value in (found.ate_rmse_m, found.ate_rmse_deg, found.rpe_translation_percent, found.rpe_rotation_deg_per_m, found.end_error_m):
        assert value == pytest.approx(0.0, abs=1e-5 if value is found.ate_rmse_deg else 1e-9)
    np.testing.assert_allclose(se2.compose(found.reference_T_world, moved), truth, atol=1e-9)


def test_score_does_not_depend_on_either_plane():
    truth = planar_path(2)
    estimate = disturbed(truth, 2)
    here = evaluate(Trajectory(seconds(400), estimate), track(truth)).numbers()
    there = evaluate(Trajectory(seconds(400), se2.compose([3, 4, 1], estimate)), track(se2.compose([-9, 7, -2.0], truth))).numbers()
    assert here.keys() == there.keys()
    for name in here:
        assert (here[name] is None) == (there[name] is None), name
        if here[name] is not None:
            assert here[name] == pytest.approx(there[name], rel=1e-9), name


def test_score_wheel_two_percent_too_large_drifts_two_percent():
    truth = np.column_stack([np.linspace(0, 100, 1001), np.zeros(1001), np.zeros(1001)])
    found = evaluate(Trajectory(seconds(1001), truth * [1.02, 1, 1]), track(truth))
    assert found.rpe_translation_percent == pytest.approx(2.0)
    assert found.rpe_rotation_deg_per_m == pytest.approx(0.0, abs=1e-12)
    assert found.end_error_m == pytest.approx(2.0)
    assert found.drift_percent == pytest.approx(2.0)
    assert found.distance_m == pytest.approx(100.0)
    assert [score.length_m for score in found.rpe] == [1, 2, 5, 10, 20, 50, 100]
    # aligned at their middles the error grows linearly to 1 m at both ends
    assert found.ate_rmse_m == pytest.approx(2.0 / math.sqrt(12.0), rel=2e-3)


def test_score_heading_drift_of_a_degree_per_metre_is_measured():
    truth = np.column_stack([np.linspace(0, 20, 201), np.zeros(201), np.zeros(201)])
    curve = [np.zeros(3)]
    for _ in range(200):
        curve.append(se2.compose(curve[-1], se2.exp([0.1, 0.0, math.radians(0.1)])))
    found = evaluate(Trajectory(seconds(201), np.array(curve)), track(truth))
    assert found.rpe_rotation_deg_per_m == pytest.approx(1.0)
    # the chord of an arc of L metres that turns L degrees, against a straight line of L metres
    for score in found.rpe:
        turn = math.radians(score.length_m)
        miss = math.hypot(score.length_m - score.length_m * math.sin(turn) / turn, score.length_m * (1 - math.cos(turn)) / turn)
        assert score.translation_percent == pytest.approx(100 * miss / score.length_m)
    assert found.end_error_m == pytest.approx(
        math.hypot(20 - 20 * math.sin(math.radians(20)) / math.radians(20), 20 * (1 - math.cos(math.radians(20))) / math.radians(20))
    )


def test_score_positions_only_has_no_heading_errors():
    truth = planar_path(3)
    estimate = disturbed(truth, 3)
    trajectory = Trajectory(seconds(400), estimate)
    with_heading, without = evaluate(trajectory, track(truth)), evaluate(trajectory, positions_only(truth))
    assert without.ate_rmse_m == with_heading.ate_rmse_m
    assert (without.ate_rmse_deg, without.rpe_translation_percent, without.rpe_rotation_deg_per_m) == (None, None, None)
    assert (without.rpe, without.relations, without.errors.heading_rad) == ((), None, None)
    # the end after the alignment of the whole path, and the distance by the estimate
    assert without.end_error_m == without.errors.position_m[-1]
    assert without.distance_m == pytest.approx(trajectory.distance(0.05))
    assert without.drift_percent == pytest.approx(100 * without.end_error_m / without.distance_m)


def test_distance_of_noisy_positions_does_not_count_the_noise():
    rng = np.random.default_rng(4)
    truth = np.column_stack([np.linspace(0, 50, 1000), np.zeros(1000), np.zeros(1000)])
    gps = positions_only(truth + rng.normal(0, 1.0, truth.shape))
    found = evaluate(Trajectory(seconds(1000), truth), gps)
    assert found.distance_m == pytest.approx(50.0, abs=0.1)
    assert found.ate_rmse_m == pytest.approx(math.sqrt(2.0), rel=0.1)


def test_score_interpolates_the_estimate_at_the_reference():
    # a fast estimate on a circle, a slow reference between its stamps
    def circle(t):
        return np.column_stack([np.cos(t), np.sin(t), se2.wrap_angle(t + math.pi / 2)])

    stamps = np.arange(0, 60 * SECOND, SECOND // 2)
    asked = np.arange(SECOND // 7, 59 * SECOND, 3 * SECOND)
    reference = ReferenceTrack(asked, *np.split(circle(asked / SECOND * 0.4), [2], axis=1)[:1], circle(asked / SECOND * 0.4)[:, 2])
    found = evaluate(Trajectory(stamps, circle(stamps / SECOND * 0.4)), reference)
    assert found.ate_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert found.n_matched == found.n_reference == len(asked)


def test_score_gaps_in_the_estimate_are_left_out():
    truth = planar_path(5, n=100)
    keep = np.r_[0:40, 60:100]
    stamps = seconds(100)[keep]
    found = evaluate(Trajectory(stamps, truth[keep]), track(truth))
    assert (found.n_matched, found.n_reference) == (80, 100)
    assert found.ate_rmse_m == pytest.approx(0.0, abs=1e-9)
    bridged = evaluate(Trajectory(stamps, truth[keep]), track(truth), EvaluateConfig(max_gap_s=30.0))
    assert bridged.n_matched == 100
    assert bridged.ate_rmse_m > 0.01
    with pytest.raises(EvaluationError, match=r"at most 0\.1 s apart; 3 are needed"):
        evaluate(Trajectory(stamps, truth[keep]), ReferenceTrack(seconds(40) + SECOND // 2, truth[:40, :2]), EvaluateConfig(max_gap_s=0.1))


def test_overlap_is_the_fraction_of_the_run_that_was_scored():
    truth = planar_path(6, n=101)
    half = ReferenceTrack(seconds(51), truth[:51, :2], truth[:51, 2])
    assert evaluate(Trajectory(seconds(101), truth), half).overlap == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("shift_s", "complaint"),
    [
        (1_432_235_498, r"Trajectory: 0\.000 s to 99\.000 s.*2015-05-21T19:11:38Z to 2015-05-21T19:13:17Z \(99\.0 s\).*counts from 1970"),
        (7200, r"\+2 hours apart.*local time"),
        (-5400, r"-1\.5 hours apart"),
        (1000, "another run"),
    ],
)
def test_score_without_common_time_error_has_spans_and_cause(shift_s, complaint):
    truth = planar_path(8, n=100)
    reference = ReferenceTrack(seconds(100) + shift_s * SECOND, truth[:, :2], source="/gps/fix")
    with pytest.raises(EvaluationError, match=complaint) as caught:
        evaluate(Trajectory(seconds(100), truth), reference)
    assert "of 100 stamps of /gps/fix none lies" in str(caught.value)


def test_score_too_few_matches_or_empty_trajectory_is_refused():
    truth = planar_path(9, n=10)
    with pytest.raises(EvaluationError, match=r"only 2 lie within.*too sparse or too short"):
        evaluate(Trajectory(seconds(10), truth), ReferenceTrack(np.array([0, 5, 20]) * SECOND, np.zeros((3, 2))))
    with pytest.raises(EvaluationError, match="trajectory is empty"):
        evaluate(Trajectory(np.empty(0), np.empty((0, 3))), track(truth))


def test_align_turn_in_place_uses_the_headings():
    angles = np.linspace(0, 6, 61)
    truth = np.column_stack([np.zeros(61), np.zeros(61), se2.wrap_angle(angles)])
    found = evaluate(Trajectory(seconds(61), se2.compose([1, 2, 0.7], truth)), track(truth))
    assert found.ate_rmse_deg == pytest.approx(0.0, abs=1e-9)
    assert found.ate_rmse_m == pytest.approx(0.0, abs=1e-12)
    # nothing was driven: what is per distance is unknown, not zero and not infinite
    assert (found.rpe, found.rpe_translation_percent, found.drift_percent, found.distance_m) == ((), None, None, 0.0)


def test_score_standing_position_reference_measures_the_spread():
    estimate = np.column_stack([np.tile([1.0, -1.0], 50), np.zeros(100), np.zeros(100)])
    found = evaluate(Trajectory(seconds(100), estimate), ReferenceTrack(seconds(100), np.full((100, 2), 7.0)))
    assert found.ate_rmse_m == pytest.approx(1.0)
    assert found.reference_T_world[2] == 0.0


def test_rpe_jitter_of_a_standing_robot_is_no_sub_path():
    rng = np.random.default_rng(10)
    truth = np.column_stack([np.append(np.zeros(500), np.linspace(0, 10, 500)), np.zeros(1000), np.zeros(1000)])
    noisy = truth + np.column_stack([rng.normal(0, 1e-3, (1000, 2)), np.zeros(1000)])
    found = evaluate(Trajectory(seconds(1000), truth * [1.05, 1, 1]), track(noisy))
    assert found.distance_m == pytest.approx(10.0, abs=0.05)
    assert found.rpe_translation_percent == pytest.approx(5.0, abs=0.2)


def test_rpe_gap_in_the_reference_is_no_short_sub_path():
    truth = np.column_stack([np.r_[np.linspace(0, 3, 31), np.linspace(40, 43, 31)], np.zeros(62), np.zeros(62)])
    found = evaluate(Trajectory(seconds(62), truth), track(truth), EvaluateConfig(rpe_distances_m=(1.0, 30.0)))
    assert [score.n for score in found.rpe] == [2 * 21, 31]  # 1 m: within either half; 30 m: over the gap, from its near side only
    with pytest.raises(EvaluationError, match="must be positive"):
        evaluate(Trajectory(seconds(62), truth), track(truth), EvaluateConfig(rpe_distances_m=(1.0, 0.0)))


# --- relations


def test_relations_errors_match_hand_calculation():
    # facing north at (1, 1), one metre forward and a quarter turn; the relation is 1.1 m and 80 degrees
    trajectory = Trajectory(seconds(2), [[1, 1, math.pi / 2], [1, 2, math.pi]])
    relations = Relations(seconds(2)[:1], seconds(2)[1:], np.array([[1.1, 0.0, math.radians(80)]]))
    found = evaluate(trajectory, relations)
    errors = found.relations.all
    assert (errors.n, found.n_matched) == (1, 1)
    assert errors.translation_m == pytest.approx(0.1)
    assert errors.translation_m2 == pytest.approx(0.01)
    assert errors.rotation_deg == pytest.approx(10.0)
    assert errors.rotation_deg2 == pytest.approx(100.0)
    assert found.relations.long is None
    numbers = found.numbers()
    assert numbers["relations_short_translation_m"] == pytest.approx(0.1)
    assert numbers["relations_long_translation_m"] is None
    assert numbers["ate_rmse_m"] is None


def test_relations_are_grouped_by_their_span():
    poses = planar_path(11, n=100)
    starts, ends = np.array([0, 10, 50, 60]), np.array([5, 29, 70, 95])  # spans of 5, 19, 20, 35 s
    wrong = se2.compose(se2.between(poses[starts], poses[ends]), [[1.0, 0, 0], [3.0, 0, 0], [5.0, 0, 0], [7.0, 0, 0]])
    relations = Relations(starts * SECOND, ends * SECOND, wrong)
    found = evaluate(Trajectory(seconds(100), poses), relations).relations
    assert (found.all.n, found.short.n, found.long.n) == (4, 2, 2)
    assert found.all.translation_m == pytest.approx(4.0)
    assert found.short.translation_m == pytest.approx(2.0)
    assert found.short.translation_m2 == pytest.approx(5.0)
    assert found.long.translation_m == pytest.approx(6.0)
    assert evaluate(Trajectory(seconds(100), poses), relations, EvaluateConfig(short_span_s=6.0)).relations.short.n == 1


def test_relations_errors_match_matrices():
    rng = np.random.default_rng(12)
    relation, motion = rng.uniform(-3, 3, (2, 50, 3))

    def matrix(p):
        return np.array([[math.cos(p[2]), -math.sin(p[2]), p[0]], [math.sin(p[2]), math.cos(p[2]), p[1]], [0, 0, 1]])

    errors = [np.linalg.inv(matrix(r)) @ matrix(m) for r, m in zip(relation, motion, strict=True)]
    found = score_relations(motion, relation)
    assert found.translation_m == pytest.approx(np.mean([np.linalg.norm(e[:2, 2]) for e in errors]))
    assert found.rotation_deg == pytest.approx(np.mean([math.degrees(math.acos(np.clip(e[0, 0], -1, 1))) for e in errors]), rel=1e-6)


def test_relations_outside_the_trajectory_are_counted():
    relations = Relations(np.array([0, 5, 50]) * SECOND, np.array([2, 20, 60]) * SECOND, np.zeros((3, 3)))
    found = evaluate(Trajectory(seconds(11), np.zeros((11, 3))), relations)
    assert (found.n_matched, found.n_reference, found.overlap) == (1, 3, pytest.approx(0.2))
    with pytest.raises(EvaluationError, match="of 6 stamps of relations none lies"):
        evaluate(Trajectory(seconds(11) - 100 * SECOND, np.zeros((11, 3))), relations)


def test_relations_file_of_aces_is_read_whole():
    relations = read_reference_file(ACES)
    assert isinstance(relations, Relations)
    assert len(relations.motions) == 1279
    assert (relations.starts_ns[0], relations.ends_ns[0]) == (90_239_599_000, 90_719_599_000)
    np.testing.assert_array_equal(relations.motions[0], [0.422330, -0.000750, 0.017260])
    assert np.count_nonzero(relations.ends_ns - relations.starts_ns > 20 * SECOND) == 94


# --- reading references


def test_track_is_sorted_and_cleaned_with_a_note():
    samples = [
        Reference(3, np.array([3.0, 0.0]), 0.3),
        Reference(1, np.array([1.0, 0.0]), 0.1),
        Reference(2, np.array([np.nan, 0.0]), 0.2),
        Reference(3, np.array([9.0, 0.0]), 0.9),
        Reference(4, np.array([4.0, 0.0]), None),
    ]
    found = reference_track(samples, "/pose")
    np.testing.assert_array_equal(found.stamps_ns, [1, 3])
    np.testing.assert_array_equal(found.positions[:, 0], [1, 3])
    np.testing.assert_array_equal(found.yaws, [0.1, 0.3])
    assert found.covariances is None
    assert found.n_dropped == 3
    assert "3 of 5 samples of /pose" in found.warnings[0]
    with pytest.raises(EvaluationError, match="/fix holds no usable sample"):
        reference_track([Reference(1, np.array([np.nan, np.nan]), None)], "/fix")
    with pytest.raises(EvaluationError, match="no usable sample"):
        reference_track([])


def test_track_dropped_samples_are_counted_in_the_scores():
    truth = planar_path(13, n=50)
    samples = [Reference(i * SECOND, p[:2] if i % 5 else np.array([np.inf, 0.0]), p[2]) for i, p in enumerate(truth)]
    found = evaluate(Trajectory(seconds(50), truth), reference_track(samples))
    assert (found.n_dropped, found.n_matched, found.n_reference) == (10, 40, 40)
    assert found.ate_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert "10 of 50" in found.warnings[0]


def test_track_of_gps_is_positions_with_covariance():
    covariance = np.diag([0.8, 0.8, np.nan])
    found = reference_track([Reference(i, np.array([i, 0.0]), None, covariance) for i in range(5)])
    assert found.yaws is None
    np.testing.assert_array_equal(found.covariances[0], covariance)
    with pytest.raises(EvaluationError, match="has positions only"):
        _ = found.poses


def test_track_constant_heading_on_a_curved_path_is_dropped():
    path = planar_path(14)
    frozen = [Reference(i * SECOND, p[:2], 0.0) for i, p in enumerate(path)]
    found = reference_track(frozen, "/rtk/pose")
    assert found.yaws is None
    assert "never changes though the path turns" in found.warnings[0]
    assert evaluate(Trajectory(seconds(400), path), found).ate_rmse_deg is None
    straight = [Reference(i * SECOND, np.array([0.1 * i, 0.0]), 0.0) for i in range(100)]
    assert reference_track(straight).yaws is not None
    parked = [Reference(i * SECOND, np.zeros(2), 0.5) for i in range(100)]
    assert reference_track(parked).yaws is not None


def test_reference_format_is_detected_by_suffix_and_content(tmp_path):
    truth = planar_path(15, n=20)
    for name in ("pose.tum", "pose.txt"):
        write_tum(tmp_path / name, Trajectory(seconds(20), truth))
        found = read_reference_file(tmp_path / name)
        assert isinstance(found, ReferenceTrack)
        np.testing.assert_allclose(found.poses, truth, atol=1e-14)
    (tmp_path / "pairs.txt").write_text("# t1 t2 ...\n1.0 2.0 0.5 0 0 0 0 0.1\n\n2 3.5 0.5 0 0 0 0 -3.1\n")
    (tmp_path / "still.txt").write_text("1.0 2.0 0 0 0 0 0 0\n")
    for name in ("pairs.txt", "still.txt"):
        assert isinstance(read_reference_file(tmp_path / name), Relations)
    assert read_reference_file(tmp_path / "pairs.txt").ends_ns[1] == 3_500_000_000


def test_reference_tum_file_with_gaps_is_accepted(tmp_path):
    (tmp_path / "a.tum").write_text("0 0 0 0 0 0 0 1\n2 2 0 0 0 0 0.6 0.8\n1 nan nan nan nan nan nan nan\n1 1 0 0 0 0 0.6 0.8\n")
    found = read_reference_file(tmp_path / "a.tum")
    np.testing.assert_array_equal(found.stamps_ns, seconds(3))
    assert found.n_dropped == 1
    (tmp_path / "b.tum").write_text("".join(f"{i} {i * i} {i} 0 0 0 0 0\n" for i in range(9)))
    assert read_reference_file(tmp_path / "b.tum").yaws is None


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("1 2 3\n", r"r\.relations, line 1: expected 8 numbers \(t1 t2 dx dy dz droll dpitch dyaw\), found 3"),
        ("1 2 0 0 0 0 0 0\n1 2 x 0 0 0 0 0\n", "line 2: 'x' is not a number"),
        ("1 2 nan 0 0 0 0 0\n", "line 1: the relation is not finite"),
        ("1 inf 0 0 0 0 0 0\n", "line 1: 'inf' is not a time"),
        ("", "holds no data"),
    ],
)
def test_relations_malformed_error_names_file_and_line(tmp_path, text, complaint):
    (tmp_path / "r.relations").write_text(text)
    with pytest.raises(EvaluationError, match=complaint):
        read_relations(tmp_path / "r.relations")


def test_reference_file_that_is_a_log_is_refused(tmp_path):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(range(256)))
    with pytest.raises(EvaluationError, match=r"a\.bag' is not a text file"):
        read_reference_file(tmp_path / "a.bag")
    with pytest.raises(EvaluationError, match="cannot be read"):
        read_reference_file(tmp_path / "missing.tum")


def test_scores_default_to_none():
    scores = {
        k: v
        for k, v in dataclasses.asdict(Accuracy()).items()
        if k not in ("n_reference", "n_matched", "n_dropped", "overlap", "rpe", "warnings")
    }
    assert set(scores.values()) == {None}
