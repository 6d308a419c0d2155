"""Report of a replay: summary, tables, figures, and a page that is valid, safe and reproducible."""

import dataclasses
import functools
import hashlib
import html
import io
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from localization.errors import OutputError
from localization.evaluation.references import ReferenceTrack, Relations, with_noise
from localization.evaluation.scores import Result, score
from localization.lifting import Trajectory3
from localization.messages import message
from localization.report.replay_page import MISSING, ReportHead, number, overview_png, page, plus_minus, unit_of, verdict, write_report
from localization.report.runs import (
    baseline_run,
    best_run,
    ellipse,
    map_view,
    nis_means,
    plotted_runs,
    relation_bins,
    run_with_map,
    thin_path,
    thin_series,
)
from localization.report.space_view import space_tracks
from localization.trajectory import Trajectory
from motion_models import se2
from tests.helpers.report import HEAD, PageText, chi_square_nis, relations, run, three_runs, track, with_error, without_scripts

pytestmark = pytest.mark.rendered

# ---- words


def test_summary_names_the_best_run_and_its_gains():
    results = score(three_runs(), relations())
    errors = [r.accuracy.relations.all.translation_m for r in results]
    text = verdict(results, relations())
    first = text.split(". ")[0]
    assert first.startswith("ekf with skid_steer is best: ")
    assert "over 392 relations" in text
    less_odometry, less_lidar = (100.0 * (1.0 - errors[2] / e) for e in errors[:2])
    found = [int(p) for p in re.findall(r"(\d+) % less", text)]
    assert found == [math.floor(less_odometry), math.floor(less_lidar)]
    assert "less than dead reckoning with diff_drive" in text
    assert "less than LiDAR alone" in text
    assert text.endswith("Use ekf with skid_steer.")


@pytest.mark.extended
def test_summary_takes_the_model_that_is_better_where_scans_fail():
    """Of estimators that scans make all but equal; not where the better dead reckoning is no better, or the estimator by it far worse."""
    by_wheels = [run("diff_drive", "odometry", 0.6, 1), run("friction", "odometry", 0.2, 2)]
    fused = run("diff_drive", "ekf", 0.050, 3)
    found = score([*by_wheels, fused, run("friction", "ekf", 0.055, 3)], track())
    text = verdict(found, track())
    advice = text[text.index("Use ") :]
    assert advice.startswith("Use ekf with friction (")
    assert [f"{r.accuracy.ate_rmse_m:.3f} m" in advice for r in found] == [True, True, False, True]
    worse = score([*by_wheels, fused, run("friction", "ekf", 0.58, 3)], track())
    alike = score([by_wheels[0], run("friction", "odometry", 0.6, 1), fused, run("friction", "ekf", 0.055, 3)], track())
    assert not any("scans fail" in verdict(each, track()) for each in (worse, alike))


def test_summary_names_a_track_reference_with_ate_and_distance():
    results = score(three_runs(), track())
    text = verdict(results, track())
    assert f"{results[2].accuracy.ate_rmse_m:.3f} m position error (ATE, root mean square) against /ground_truth/odom" in text
    assert f"over {results[2].accuracy.distance_m:.1f} m driven" in text


@pytest.mark.extended
def test_summary_of_corrected_poses_says_the_error_of_the_published_ones():
    """Without a LiDAR, where poses that never jump are published."""
    corrected = dataclasses.replace(run(noise=0.1), hindsight="gyro bias", live=run(noise=0.4, seed=1).trajectory)
    results = score([corrected, run(estimator="odometry", noise=0.9)], track())
    published = f"{results[0].live.ate_rmse_m:.3f} m"
    assert results[0].live.ate_rmse_m > 2.0 * results[0].accuracy.ate_rmse_m
    assert f"the poses that were published live had {published}" in verdict(results, track())
    assert "without jumps" not in verdict(score([run(noise=0.1)], track()), track())


def test_summary_with_a_wrong_reference_judges_nothing():
    results = [dataclasses.replace(r, contradictions=("its scale is 1000.",)) for r in score([run(noise=0.1), run(noise=0.2)], track())]
    text = verdict(results, track())
    assert "scale is 1000" in text
    assert "best" not in text
    assert "overconfident" not in text
    assert results[0].metrics(1.0, with_timing=False)["reference_contradictions"] == ["its scale is 1000."]


def test_summary_without_reference_names_no_best():
    runs = three_runs()
    text = verdict(score(runs, None), None)
    assert text.startswith("No reference was given, so which run is right is unknown.")
    assert "--reference" in text
    assert "best" not in text
    ends = [r.trajectory.poses[-1, :2] for r in runs]
    farthest = max(math.dist(a, b) for i, a in enumerate(ends) for b in ends[i + 1 :])
    assert f"by {farthest:.{2 if farthest > 0.995 else 3}f} m" in text


def test_summary_without_reference_compares_runs_at_equal_times():
    """A run that ends 2 s before the other is not 2 s of driving away from it."""
    first = run(noise=0.0)
    short = dataclasses.replace(
        first, model="skid_steer", trajectory=Trajectory(first.trajectory.stamps_ns[:-20], first.trajectory.poses[:-20])
    )
    assert "farthest apart, by 0.000 m at the last moment of both" in verdict(score([first, short], None), None)


def test_summary_of_one_run_names_no_best():
    text = verdict(score([run(noise=0.1)], track()), track())
    assert "Nothing else was run" in text
    assert "best" not in text
    alone = verdict(score([run(noise=0.1)], None), None)
    assert "its accuracy is unknown" in alone


def test_summary_of_equal_runs_is_a_tie():
    same = [run("diff_drive", "ekf", 0.1, 4), run("skid_steer", "ekf", 0.1, 4)]
    text = verdict(score(same, track()), track())
    assert "ekf with diff_drive has the smallest error" in text
    assert "Within 2 % of it: ekf with skid_steer" in text
    assert "is best" not in text
    assert "less than" not in text
    assert "which motion model is better in it is not significant on this drive" in text


def test_summary_difference_from_one_stretch_is_not_significant():
    """Equal but for one tenth of the drive, where the other run is far off: lower in the mean, and no evidence."""
    first, second = run("diff_drive", "ekf", 0.1, 5), run("skid_steer", "ekf", 0.1, 6)
    poses = second.trajectory.poses.copy()
    poses[40:80, 0] += 2.0
    second = dataclasses.replace(second, trajectory=Trajectory(second.trajectory.stamps_ns, poses, second.trajectory.covariances))
    results = score([first, second], relations())
    errors = [r.accuracy.relations.all.translation_m for r in results]
    assert errors[1] > 1.3 * errors[0]  # else there is nothing to be careful about
    text = verdict(results, relations())
    assert "ekf with diff_drive has the smallest error" in text
    assert "Not proven worse by this one drive: ekf with skid_steer" in text


def test_summary_small_difference_all_along_is_significant():
    """5 % less noise everywhere is a difference of 5 %: the same draws, scaled."""
    pair = [run("diff_drive", "ekf", 0.100, 7), run("skid_steer", "ekf", 0.105, 7)]
    text = verdict(score(pair, relations()), relations())
    assert text.startswith("ekf with diff_drive is best")


def test_summary_false_positive_rate_for_equal_filters_is_small():
    """Two runs of one quality, other noise: at most a few of 100 may be called different (2.5 % one-sided by the test)."""
    called = 0
    for seed in range(100):
        pair = [run("diff_drive", "ekf", 0.1, 1000 + seed), run("skid_steer", "ekf", 0.1, 5000 + seed)]
        called += " is best" in verdict(score(pair, relations()), relations())
    assert called <= 12  # either may be the better one, so 5 % of 100 at most; 12 has probability 0.002


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (4.0, "are overconfident"),
        (0.25, "Its covariances are not too small"),
        (1.0, "Its covariances are consistent"),
    ],
)
def test_summary_of_covariances_follows_the_nis(scale, message):
    results = score([run(nis=chi_square_nis(scale=scale), noise=0.01), run(estimator="odometry", noise=0.5, seed=2)], track(yaws=False))
    text = verdict(results, track(yaws=False))
    assert message in text
    assert f"mean NIS {results[0].nis_mean:.3g}" in text


def test_summary_overconfidence_factor_is_in_sigma():
    """All innovations three times what the filter believes: NIS nine times too large."""
    text = verdict(score([run(nis=chi_square_nis(scale=9.0), noise=0.01)], track(yaws=False)), track(yaws=False))
    assert re.search(r"innovations (2\.9|3\.0|3\.1) times their sigma", text)


def test_summary_of_one_drive_says_how_large_nees_may_be_by_chance():
    """Errors of a drive may be one sample: a mean of twice what is expected is no contradiction then, and the sentence has the band."""
    (result,) = score([run(nis=chi_square_nis(), noise=0.01)], track())
    text = verdict([dataclasses.replace(result, nees_mean=6.4, nees_band=None)], track())
    assert "are overconfident" in verdict([dataclasses.replace(result, nees_mean=6.4, nees_band=(2.0, 4.2))], track())
    assert "mean NEES 6.4, where 3 is expected (up to 9.3 by chance)" in text
    assert "are consistent" in text


def test_summary_few_outliers_are_no_overconfidence():
    nis = chi_square_nis()
    nis[::40] = 400.0
    text = verdict(score([run(nis=nis, noise=0.01)], track(yaws=False)), track(yaws=False))
    assert "some outliers make it" in text


@pytest.mark.extended
def test_summary_nees_of_one_drive_fails_only_outside_its_band():
    def summary_of_nees(nees):
        (result,) = score([run(noise=0.01)], track())
        return verdict([dataclasses.replace(result, nees_mean=nees, nees_band=None)], track())

    assert "overconfident" in summary_of_nees(9.5)
    assert "overconfident" not in summary_of_nees(9.2)  # chi-square(3) has its 97.5 % quantile at 9.35
    assert "overconfident" in summary_of_nees(math.inf)
    assert "larger than need be" in summary_of_nees(0.2)


def test_summary_large_innovations_with_honest_poses_are_no_overconfidence():
    (result,) = score([run(nis=chi_square_nis(scale=4.0), noise=0.01)], track())
    text = verdict([dataclasses.replace(result, nees_mean=1.5, nees_band=None)], track())
    assert "overconfident" not in text
    assert (
        "Its covariances are not too small by the reference (mean NEES 1.5, where 3 is expected; on so short a drive "
        "sigmas that are less than 1.8 times too small stay hidden" in text
    )
    assert "differ by more than their covariances predict: mean NIS" in text
    assert "`skidloc diagnose`" in text
    assert "overconfident" in verdict([dataclasses.replace(result, nees_mean=20.0)], track())


def test_summary_untestable_or_missing_covariances_are_reported():
    assert "could not be tested" in verdict(score([run(noise=0.1)], track(yaws=False)), track(yaws=False))
    assert "gives no covariance" in verdict(score([run(estimator="lidar", covariance=False, noise=0.1)], track()), track())


def test_summary_lidar_that_increases_the_error_is_reported():
    runs = [run(estimator="odometry", noise=0.01, seed=1), run(estimator="ekf", noise=0.5, seed=2, points=[(0, 0), (1, 1)])]
    text = verdict(score(runs, relations()), relations())
    assert text.startswith("Dead reckoning with diff_drive is best")
    assert "check its mount" in text


def test_summary_short_overlap_is_reported():
    whole = track()
    part = ReferenceTrack(whole.stamps_ns[:100], whole.positions[:100], whole.yaws[:100], source="/gps")
    results = score([run(noise=0.1)], part)
    assert "covers only 25 % of the drive" in verdict(results, part)


# ---- choice of runs


def test_runs_without_wheels_are_plotted_once_in_distinct_styles():
    runs = [run(m, e, 0.1) for e in ("odometry", "lidar", "ekf", "graph") for m in ("diff_drive", "skid_steer")]
    lines = plotted_runs(score(runs, None))
    assert [line.label for line in lines].count("lidar") == 1
    assert len(lines) == 7
    assert len({(line.colour, line.dashes) for line in lines}) == 7
    assert len({line.colour for line in lines}) == 4


@pytest.mark.extended
def test_runs_best_baseline_and_map_are_those_of_least_error():
    results = [
        with_error(0.3, "odometry", "skid_steer"),
        with_error(0.4, "odometry", "diff_drive"),
        with_error(0.2, "lidar"),
        with_error(0.1, "ekf"),
        with_error(math.nan, "graph"),
    ]
    lines = plotted_runs(results)
    assert best_run(lines).result is results[3]
    assert baseline_run(lines).result is results[1]
    assert run_with_map(lines) is None
    mapped = [dataclasses.replace(r, run=dataclasses.replace(r.run, map_points=np.ones((2, 2)))) for r in results[2:]]
    assert run_with_map(plotted_runs(mapped)).result is mapped[1]


# ---- what is drawn


def test_ellipse_has_size_and_direction_of_the_rotated_covariance():
    """Against the plain way: turn the covariance into the plane, then decompose it."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        a = rng.normal(size=(3, 3))
        cov, pose = a @ a.T, rng.normal(size=3) * [5, 5, 3]
        e = ellipse(pose, cov, sigmas=2.0)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        R = np.array([[c, -s], [s, c]])
        values, vectors = np.linalg.eigh(R @ cov[:2, :2] @ R.T)
        assert np.allclose(sorted(e.semi_axes), 2.0 * np.sqrt(values))
        assert e.semi_axes[0] >= e.semi_axes[1]
        assert abs(math.cos(e.angle) * vectors[1, 1] - math.sin(e.angle) * vectors[0, 1]) < 1e-9  # parallel
        assert e.center == (pose[0], pose[1])


def test_ellipse_of_two_sigma_contains_86_percent_of_samples():
    rng = np.random.default_rng(1)
    pose, cov = np.array([3.0, -2.0, 2.2]), np.diag([0.09, 0.0025, 1e-6])
    e = ellipse(pose, cov)
    drawn = se2.compose(pose, se2.exp(rng.multivariate_normal(np.zeros(3), cov, 20000)))[:, :2] - e.center
    c, s = math.cos(e.angle), math.sin(e.angle)
    along, across = drawn @ [c, s] / e.semi_axes[0], drawn @ [-s, c] / e.semi_axes[1]
    assert np.mean(along**2 + across**2 <= 1.0) == pytest.approx(1.0 - math.exp(-2.0), abs=0.01)


def test_figures_runs_map_and_ellipses_are_in_the_reference_plane():
    shift = np.array([100.0, -50.0, 1.0])
    whole = track()
    moved = se2.compose(shift, whole.poses)
    reference = ReferenceTrack(whole.stamps_ns, moved[:, :2], moved[:, 2])
    wall = np.array([[0.0, 0.0], [5.0, 5.0]])
    lines = plotted_runs(score([run(noise=0.0, points=wall)], reference))
    view = map_view(lines, reference)
    assert np.allclose(view.paths[0], moved[:, :2], atol=1e-6)
    assert np.allclose(view.points, se2.transform(shift, wall), atol=1e-6)
    assert np.allclose(view.ellipses[-1].center, moved[-1, :2], atol=1e-6)
    along_x = moved[-1, 2]  # the larger variance is that along the body's x
    assert math.sin(view.ellipses[-1].angle - along_x) == pytest.approx(0.0, abs=1e-6)
    assert (view.low < moved[:, :2].min(0)).all()
    assert (view.high > moved[:, :2].max(0)).all()


def test_figures_limits_ignore_a_diverged_run():
    lost = run("diff_drive", "odometry")
    lost = dataclasses.replace(lost, trajectory=Trajectory(lost.trajectory.stamps_ns, lost.trajectory.poses * [1000.0, 1000.0, 1.0]))
    lines = plotted_runs(score([lost, run("skid_steer", "ekf", 0.05, 3)], relations()))
    view = map_view(lines, relations())
    assert (view.high - view.low).max() < 20.0
    assert view.n_cut == 1


def test_thinned_paths_keep_ends_and_shape():
    stamps = np.linspace(0, 60 * math.pi, 100_000)
    path = np.column_stack([20.0 * np.sin(stamps), 20.0 * np.cos(stamps)])
    kept = thin_path(path, resolution_m=0.04)
    assert kept[0] == 0
    assert kept[-1] == 99_999
    assert len(kept) <= 1000
    assert np.hypot(*np.diff(path[kept], axis=0).T).max() < 5.0  # 30 laps in 1,000 pieces
    assert thin_path(np.zeros((10_000, 2)), 0.1).tolist() == [0, 9_999]  # a robot that stands


def test_thinned_series_keep_each_peak():
    values = np.zeros(50_000)
    values[[7, 31_234, 49_999]] = [5.0, -3.0, 2.0]
    kept = thin_series(values)
    assert {7, 31_234, 49_999} <= set(kept.tolist())
    assert len(kept) <= 700


def test_relation_bins_contain_every_relation_and_the_score_is_their_mean():
    r = relations(span=3)
    more = relations(span=60)
    both = Relations(
        np.r_[r.starts_ns, more.starts_ns[:4]], np.r_[r.ends_ns, more.ends_ns[:4]], np.r_[r.motions, more.motions[:4]], source="both"
    )
    results = score([run(noise=0.1)], both)
    found = relation_bins(plotted_runs(results)[0], both)
    assert sum(found.n) == len(both.starts_ns)
    weights = np.array(found.n) / sum(found.n)
    assert weights @ found.translation_m == pytest.approx(results[0].accuracy.relations.all.translation_m)
    assert weights @ found.rotation_deg == pytest.approx(results[0].accuracy.relations.all.rotation_deg)


def test_nis_means_are_of_equal_groups():
    nis = np.full(400, np.nan)
    nis[::2] = np.arange(200.0)
    shown, means = nis_means(plotted_runs(score([run(nis=nis), run(estimator="odometry")], None)), limit=7.8)
    assert [line.label for line in shown] == ["ekf · diff_drive"]
    assert means[0].group == 3
    assert means[0].mean.tolist() == [3.0 * i + 1.0 for i in range(66)]
    assert means[0].seconds[0] == pytest.approx(1.0)
    assert means[0].fraction_inside == pytest.approx(8 / 200)


# ---- tables


def test_table_has_the_given_numbers_and_a_dash_for_missing_ones():
    results, _ = cases()["track"]
    table = PageText(page_of("track")).tables[0]
    assert table[0][1].startswith("ATE")
    for row, result in zip(table[1:], results, strict=True):
        a = result.accuracy
        assert row[1] == f"{a.ate_rmse_m:.3f}"
        assert row[2] == f"{a.ate_rmse_deg:.2f}"
        assert row[3] == f"{a.rpe_translation_percent:.2f}"
    nis = next(i for i, head in enumerate(table[0]) if head.startswith("NIS"))
    assert [row[nis] for row in table[1:]] == [MISSING, MISSING, f"{results[2].nis_mean:.2f}"]


def test_table_of_positions_only_leaves_out_headings_with_a_note():
    text = PageText(page_of("positions"))
    assert not any("heading" in head for head in text.tables[0][0])
    assert "positions only" in "".join(text.words)


def test_table_of_relations_has_every_group():
    both = relations(span=60)  # 30 s
    results = score([run(noise=0.1)], both)
    text = PageText(page(HEAD, results, both))
    assert f"{results[0].accuracy.relations.long.translation_m:.4f}" in text.tables[0][1]
    assert f"{results[0].accuracy.relations.long.translation_m2:.4f}" in text.tables[1][1]
    assert not any("under 20 s" in head for head in text.tables[0][0])


def test_page_lists_parameters_counts_notes_and_provenance():
    estimated = run(parameters={"gyro_bias_rad_per_s": (0.0012, 0.00004)}, counts={"slips": 12345}, noise=0.1)
    words = " ".join(PageText(page(HEAD, score([estimated], None), None)).words)
    for expected in (
        "0.001200 ± 0.000040",
        "rad/s",
        "12,345",
        "3 scans without",
        "c0ffee",
        "vaultbot",
        "2026-01-02 03:04:05 UTC",
    ):
        assert expected in words


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(None, 3, "–"), (math.nan, 3, "–"), (math.inf, 2, "∞"), (0.0, 2, "0.00"), (0.0004, 3, "< 0.001"), (1234.5, 1, "1,234.5")],  # noqa: RUF001
)
def test_format_number_has_the_significant_digits(value, digits, text):
    assert number(value, digits) == text


@pytest.mark.parametrize(
    ("mean", "sigma", "text"),
    [
        (1.23456, 0.0213, "1.235 ± 0.021"),
        (-0.00001, 0.5, "0.00 ± 0.50"),
        (2.5e-5, 1e-6, "2.50 ± 0.10 e\N{MINUS SIGN}5"),
        (3.0, 0.0, "3.0000 ± 0.0000"),
    ],
)
def test_format_plus_minus_has_the_digits_of_sigma(mean, sigma, text):
    cell = plus_minus(mean, sigma)
    assert cell.text + (f" e{cell.power}" if cell.power else "") == text


def test_unit_is_that_of_the_name_suffix():
    assert [unit_of(name) for name in ("gyro_bias_rad_per_s", "wheel_clock_offset_s", "x_cr_m", "k_0")] == ["rad/s", "s", "m", ""]


# ---- the page


@functools.cache
def cases():
    lone = run(estimator="odometry", noise=0.1)
    return {
        "track": (score(three_runs(), track()), track()),
        "positions": (score(three_runs(), track(yaws=False)), track(yaws=False)),
        "relations": (score(three_runs(), relations()), relations()),
        "no reference": (score(three_runs(), None), None),
        "one": (score([lone], track()), track()),
        "nothing": ([], None),
        "one pose": (score([run(n=1)], None), None),
        "no pose": (
            [Result(dataclasses.replace(run(n=1), trajectory=Trajectory(np.empty(0), np.empty((0, 3))), nis=np.empty(0)), None, None)],
            None,
        ),
    }


@functools.cache
def page_of(case):
    return page(HEAD, *cases()[case])


CASES = ("track", "positions", "relations", "no reference", "one", "nothing", "one pose", "no pose")


@pytest.mark.parametrize("case", CASES)
def test_page_is_well_formed_and_loads_nothing(case):
    whole = page_of(case)
    assert "default-src 'none'" in whole  # Plotly's links to its homepage are never followed
    first = without_scripts(whole)
    text = PageText(first)  # fails on unclosed tags
    assert not re.search(r"https?://|xlink|url\((?!#)|@import|\son\w+=", first)
    assert not [tag for tag, _ in text.tags if tag in ("script", "link", "iframe", "object")]
    for tag, attributes in text.tags:
        for name in ("src", "href", "xlink:href"):
            assert attributes.get(name, "#").startswith(("#", "data:image/png;base64,")), (tag, attributes)
    ids = [attributes["id"] for _, attributes in text.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    wanted = set(re.findall(r'(?:url\(#|href="#)([^")]+)', first))
    assert wanted <= set(ids)
    assert "nan" not in re.sub(r"base64,[^\"]*", "", first).lower().replace("finance", "")
    assert len(whole) < 2_000_000


def test_page_starts_and_ends_with_the_summary():
    results, _ = cases()["track"]
    words = "".join(PageText(page_of("track")).words)
    first, last = html.unescape(verdict(results, track())).split(". ")[0], verdict(results, track())
    assert words.index(first) < words.index("Accuracy")
    assert words.rindex(last) > words.index("Sources and versions")


@pytest.mark.extended
def test_page_escapes_text_of_the_log():
    evil = "<script>alert('x')</script>&\"'"
    head = ReportHead(evil, evil, evil, 1.0, [message("smoothing.failed", reason=evil)], {evil: evil}, evil)
    bad = run(model=evil, estimator=evil + "2", noise=0.1, parameters={evil: (1.0, 0.1)}, counts={evil: 1})
    reference = dataclasses.replace(track(), source=evil, warnings=(evil,))
    mapped = dataclasses.replace(bad, map_points=np.ones((4, 2)), nis=chi_square_nis())
    made = page(head, score([mapped, run(noise=0.2, seed=1)], reference), reference)
    assert "<script>alert" not in made
    made = without_scripts(made)
    assert "<script" not in made
    assert PageText(made).words.count(evil) >= 5


def test_figures_axes_have_units_and_each_run_a_line():
    results, _ = cases()["track"]
    made = page_of("track")
    for label in ("x [m]", "y [m]", "position error [m]", "heading error [deg]", "time since the first pose [s]"):
        assert made.count(f">{label}<") >= 1
    for line in plotted_runs(results):
        assert made.count(f'class="series-{line.number}"') >= 2  # map and errors
        assert f"var(--{line.colour}" in made


def test_figures_have_the_colours_of_the_page_in_dark_mode():
    made = without_scripts(page_of("track"))
    assert "prefers-color-scheme:dark" in made
    assert not re.findall(r"(?:fill|stroke): ?#(?!f{6}|f{3}\b)[0-9a-f]{3,6}", made)  # every colour is the page's to change


@pytest.mark.extended
def test_page_of_a_large_log_is_small():
    n = 20_000
    rng = np.random.default_rng(0)
    stamps = np.arange(n, dtype=np.int64) * 10_000_000
    angle = np.linspace(0, 80 * math.pi, n)
    poses = np.column_stack([30 * np.sin(angle), 20 * np.cos(angle), angle]) + rng.normal(size=(n, 3)) * 0.01
    points = rng.uniform(-40, 40, (20_000, 2))
    big = [
        dataclasses.replace(run(m, e), trajectory=Trajectory(stamps, poses + 0.1 * i), nis=chi_square_nis(n), map_points=points)
        for i, (m, e) in enumerate((m, e) for m in ("diff_drive", "skid_steer") for e in ("odometry", "ekf", "graph", "other"))
    ]
    reference = ReferenceTrack(stamps[::20], poses[::20, :2], poses[::20, 2])
    assert len(page(HEAD, score(big, reference), reference)) < 2_000_000


def test_page_existing_file_is_refused(tmp_path):
    results, reference = cases()["track"]
    write_report(tmp_path / "report.html", HEAD, results, reference)
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == page_of("track")
    with pytest.raises(OutputError, match="exists already"):
        write_report(tmp_path / "report.html", HEAD, [], None)
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == page_of("track")
    with pytest.raises(OutputError, match="cannot be written"):
        write_report(tmp_path / "no" / "report.html", HEAD, [], None)


@pytest.mark.extended
def test_overview_has_no_date_and_the_same_bytes(tmp_path):
    results = score(three_runs(), track())
    for name in ("a.png", "b.png"):
        overview_png(tmp_path / name, HEAD, results, track())
    content = (tmp_path / "a.png").read_bytes()
    assert content == (tmp_path / "b.png").read_bytes()
    image = Image.open(io.BytesIO(content))
    assert image.width == 1500
    assert not {"Software", "Creation Time", "date"} & set(image.info)
    colours = {colour for _, colour in image.convert("RGB").getcolors(image.width * image.height)}
    assert {(0, 114, 178), (213, 94, 0), (204, 121, 167)} <= colours  # a bar of each estimator


@pytest.mark.slow
def test_overview_of_another_process_and_style_has_the_same_bytes(tmp_path):
    """A matplotlibrc of the user's must not reach the report."""
    (tmp_path / "matplotlibrc").write_text("axes.facecolor: red\nxtick.major.size: 30\naxes.labelpad: 40\nsvg.fonttype: path\n")
    code = "import hashlib; from tests.report.test_replay_page import page_of; print(hashlib.sha256(page_of('track').encode()).hexdigest())"
    root = Path(__file__).resolve().parents[2]
    there = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "MATPLOTLIBRC": str(tmp_path / "matplotlibrc"), "PYTHONHASHSEED": "7", "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=True,
        cwd=root,
    ).stdout.strip()
    here = hashlib.sha256(page_of("track").encode()).hexdigest()
    assert there == here


@pytest.mark.extended
def test_summary_of_a_large_nees_asks_for_the_noise_of_an_exact_reference() -> None:
    results = [dataclasses.replace(result, nees_mean=40.0) for result in score([run(noise=0.1)], track())]
    exact, noisy = track(), with_noise(track(), 0.02, 0.01)
    assert "pass its noise with --reference-sigma" in verdict(results, exact)
    assert "--reference-sigma" not in verdict(results, noisy)


def _over_hills(tilt_deg):
    planar = run("skid_steer", "ekf")
    n = len(planar.trajectory)
    pitch = np.radians(tilt_deg) * np.sin(np.linspace(0.0, 9.0, n))
    turns = Rotation.from_euler("ZY", np.column_stack([planar.trajectory.poses[:, 2], pitch]))
    positions = np.column_stack([planar.trajectory.poses[:, :2], np.cumsum(-0.08 * pitch)])
    covariances = np.tile(0.01 * np.eye(6), (n, 1, 1))
    in_space = Trajectory3(planar.trajectory.stamps_ns, positions, turns.as_quat(), covariances, is_lifted=False)
    return score([dataclasses.replace(planar, in_space=in_space)], None)


def test_page_of_hills_has_height_and_tilt_and_of_level_ground_none():
    hills, level = (page(HEAD, _over_hills(tilt), None, is_interactive=False) for tilt in (8.0, 1.0))
    for label in ("Height and tilt", "The way in three dimensions"):
        assert f'aria-label="{label}"' in hills
        assert f'aria-label="{label}"' not in level
    assert "pitch [deg]" in hills
    (track,) = space_tracks(plotted_runs(_over_hills(8.0)))
    assert track.pitch_deg.max() == pytest.approx(8.0, abs=0.01)
    assert np.abs(track.roll_deg).max() == pytest.approx(0.0, abs=1e-9)


def test_way_is_that_of_the_published_poses_which_do_not_jump():
    """Positions alone are measured, as by a GPS: the way comes from the estimate."""
    positions = dataclasses.replace(track(), yaws=None)
    corrected = dataclasses.replace(run(noise=0.4), hindsight="gyro bias", live=run(noise=0.0).trajectory)
    (result,), (smooth,) = score([corrected], positions), score([run(noise=0.0)], positions)
    (jumping,) = score([run(noise=0.4)], positions)
    assert result.accuracy.distance_m == smooth.accuracy.distance_m < 0.98 * jumping.accuracy.distance_m
    assert result.accuracy.drift_percent == 100.0 * result.accuracy.end_error_m / smooth.accuracy.distance_m
    assert f"over {smooth.accuracy.distance_m:.1f} m driven" in verdict([result], positions)


def test_summary_nees_of_few_poses_is_no_verdict() -> None:
    (result,) = score([run(nis=chi_square_nis(), noise=0.01)], track())
    wrong = dataclasses.replace(result, nees_mean=40.0, nees_band=(2.0, 4.2))
    few = verdict([dataclasses.replace(wrong, nees_counts=(9, 283))], track())
    assert "overconfident" not in few
    assert "NEES is not judged: it is of 9 of 292 poses" in few
    assert "overconfident" in verdict([dataclasses.replace(wrong, nees_counts=(283, 9))], track())
