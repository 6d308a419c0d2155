"""Lost LiDAR: what terminal, metrics, report, comparison and diagnostics publish of it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from localization.comparison.jobs import flat_scores
from localization.comparison.result_table import ResultTable
from localization.comparison.statistics import closing, find
from localization.evaluation.scores import score
from localization.lidar import LostScans
from localization.lidar.losses import LidarLosses, per_cent
from localization.pipeline import Pipeline, Trial
from localization.report.replay_page import page
from localization.report.runs import best_run, plotted_runs
from localization.report.summary import verdict
from localization.ros.diagnostics import ERROR, OK, WARN, Health
from motion_models.registry import make_model
from tests.helpers.report import HEAD, relations, run, track
from tests.helpers.rooms import ROBOT

S = 1_000_000_000

ALL_LOST = LidarLosses(1000, 400, 0.6, 60.0, 7.0, 0.0, {"lost": 600})
BRIEFLY = LidarLosses(1000, 998, 0.002, 0.2, 50.0, 0.0, {"sparse": 2})


def counted(matched: str) -> LostScans:
    """One scan a second: `m` matched, `l` lost, `s` stale, `x` excluded."""
    lost = LostScans()
    for second, kind in enumerate(matched):
        lost.add(second * S) if kind == "m" else lost.add(second * S, {"l": "lost", "s": "stale", "x": "excluded"}[kind])
    return lost


def test_losses_of_scans_have_share_and_longest_gap() -> None:
    """From the match at 2 s to one period before that at 5 s, and from 6 s to the end at 8 s."""
    losses = LidarLosses.of(counted("mmmllmmsl"))
    assert (losses.scans, losses.matched) == (9, 5)
    assert losses.share == pytest.approx(4.0 / 8.0)
    assert (losses.longest_s, losses.since_s, losses.ongoing_s) == (2.0, 6.0, 2.0)
    assert losses.causes == {"lost": 3, "stale": 1}
    assert losses.warnings()[0].startswith(
        "LiDAR lost for 50 % of the drive, longest 2 s at t = 6 s (4 of 9 scans: 3 fitted the map nowhere"
    )
    assert losses.warnings()[0].endswith(losses.advice)


def test_losses_of_a_lidar_that_dies_are_described_and_long() -> None:
    """Ten scans, then nothing while the wheels turn for 6 s more."""
    lost = counted("mmmmmmmmmm")
    for half in range(1, 13):
        lost.add_no_scan(9 * S + half * S // 2)
    losses = LidarLosses.of(lost)
    assert (losses.scans, losses.matched, losses.ongoing_s) == (10, 10, 6.0)
    assert losses.is_long
    assert losses.warnings()[0] == (
        "LiDAR lost for 40 % of the drive, longest 6 s at t = 9 s (no scans came for a second or more). "
        "The pose is by the other sensors there. Check the LiDAR's driver, cable and topic."
    )
    assert losses.numbers()["silences"] == 1


def test_losses_of_scans_left_out_are_no_silence() -> None:
    losses = LidarLosses.of(counted("mmmmxxxxxxmm"))
    assert (losses.scans, losses.matched, losses.silences) == (12, 6, 0)
    assert "6 of 12 scans: 6 were left out by a check" in losses.warnings()[0]
    assert losses.advice == "See the warning about the LiDAR above."


@pytest.mark.parametrize(
    ("causes", "words"),
    [({"sparse": 208, "moved": 1, "lost": 16}, "what covers the LiDAR"), ({"sparse": 3, "moved": 1, "lost": 16}, "was moved by other")],
)
def test_advice_is_about_the_most_frequent_cause(causes: dict[str, int], words: str) -> None:
    """One scan that lost the map is no robot that was carried; the scans after one that was are lost as well."""
    assert words in LidarLosses(351, 126, 0.64, 20.0, 10.0, 0.0, causes).advice


def test_describe_without_lost_scans_is_empty() -> None:
    losses = LidarLosses.of(counted("mmmm"))
    assert (losses.warnings(), losses.advice) == ([], "")
    assert not losses.is_long


@pytest.mark.parametrize(
    ("matched", "is_event"),
    [
        ("m" * 100 + "l" + "m" * 100, False),
        ("m" * 100 + "x" * 4 + "m" * 100, False),
        ("m" * 100 + "x" * 20 + "m" * 100, True),
        ("m" * 100 + "s" + "m" * 100, True),
    ],
)
def test_single_scans_that_are_bridged_are_no_event(matched: str, is_event: bool) -> None:
    assert LidarLosses.of(counted(matched)).is_event == is_event


def test_isolated_lost_scans_are_not_long() -> None:
    """One of 36 is empty."""
    losses = LidarLosses.of(counted((35 * "m" + "l") * 36 + "m"))
    assert losses.share == pytest.approx(1 / 36)
    assert losses.longest_s == 1.0
    assert not losses.is_long


@pytest.mark.parametrize(
    ("share", "longest_s", "expected"),
    [(0.049, 4.9, False), (0.051, 1.1, True), (0.2, 0.9, False), (0.01, 5.1, True)],
    ids=["brief", "often", "single scans", "at once"],
)
def test_is_long_from_5_percent_or_5_s_on(share: float, longest_s: float, expected: bool) -> None:
    assert LidarLosses(100, 90, share, longest_s, 0.0, 0.0, {"lost": 10}).is_long == expected


def test_per_cent_has_two_digits() -> None:
    assert [per_cent(x) for x in (0.0, 1e-6, 0.003, 0.034, 0.12, 1.0)] == ["0 %", "less than 0.01 %", "0.3 %", "3.4 %", "12 %", "100 %"]


def lost_and_found() -> list:
    return [replace(run("skid_steer", "ekf", 0.01), lidar=ALL_LOST), replace(run("diff_drive", "ekf", 0.2, seed=1), lidar=BRIEFLY)]


@pytest.mark.parametrize("reference", [track(), relations()], ids=["track", "relations"])
def test_verdict_with_reference_recommends_by_error(reference) -> None:
    """The run without LiDAR has the smallest error here; runs that measure no losses could not be held to them."""
    results = score(lost_and_found(), reference)
    text = verdict(results, reference)
    assert best_run(plotted_runs(results)).result is results[0]
    assert text.startswith("ekf with skid_steer is best: ")
    assert "without the LiDAR in ekf with skid_steer (LiDAR lost for 60 % of the drive, longest 60 s at t = 7 s)" in text
    assert "Check the LiDAR's mount" in text
    assert "ecommended" not in text


def test_verdict_with_one_lost_run_gives_its_error() -> None:
    text = verdict(score([replace(run(), lidar=ALL_LOST)], track()), track())
    assert text.startswith("ekf with diff_drive: ")
    assert "the errors include that" in text


def test_verdict_without_reference_reports_lost_lidar() -> None:
    text = verdict(score(lost_and_found(), None), None)
    assert "Not recommended is ekf with skid_steer: LiDAR lost for 60 %" in text


@pytest.mark.extended
def test_page_with_lost_run_marks_it() -> None:
    runs = [replace(run("skid_steer", "ekf", 0.01), lidar=BRIEFLY), replace(run("diff_drive", "ekf", 0.2, seed=1), lidar=ALL_LOST)]
    text = page(HEAD, score(runs, track()), track())
    assert text.count('<span class="badge soft">LiDAR lost</span>') == 1
    assert text.count('<span class="badge">best</span>') == 1
    assert "60.00" in text


def test_metrics_of_lost_run_have_its_losses() -> None:
    lost, reckoned = score([lost_and_found()[0], run(estimator="odometry")], track())
    assert lost.metrics(200.0, with_timing=False)["lidar"] == {
        "scans": 1000,
        "matched": 400,
        "lost_share": 0.6,
        "longest_lost_s": 60.0,
        "longest_lost_since_s": 7.0,
        "causes": {"lost": 600},
        "silences": 0,
    }
    assert reckoned.metrics(200.0, with_timing=False)["lidar"] is None


def compared(lost_share: float | None) -> list[dict]:
    """EKF, the better one on three logs, and odometry."""
    rows = []
    for log in ("a", "b", "c"):
        for estimator, ate in (("ekf", 0.1), ("odometry", 1.0)):
            lost = lost_share if estimator == "ekf" and log == "b" else None
            losses = {"lidar_lost_share": lost, "lidar_longest_lost_s": None if lost is None else 4.0, "lidar_longest_lost_since_s": 3.0}
            head = {"log": log, "model": "diff_drive", "estimator": estimator, "corrections": "", "status": "ok"}
            rows.append({**head, "ate_rmse_m": ate, **losses})
    return rows


def test_comparison_with_lost_best_combination_names_the_loss() -> None:
    text = " ".join(closing(find(compared(0.2), "ate_rmse_m")))
    assert "ekf with diff_drive lost the LiDAR for long on 1 log (20 % of b, longest 4 s at t = 3 s); the errors include that." in text
    assert "Of the others" not in text


@pytest.mark.parametrize("share", [None, 0.04])
def test_comparison_without_long_losses_is_silent(share: float | None) -> None:
    assert not any("lost the LiDAR" in sentence for sentence in closing(find(compared(share), "ate_rmse_m")))


def test_rows_of_a_comparison_are_numbers_that_the_table_reads_again(tmp_path) -> None:
    """Also of a run with live poses besides the smoothed ones."""
    smoothed = replace(lost_and_found()[0], live=run().trajectory)
    (result,) = score([smoothed], track())
    scores = flat_scores(result.metrics(200.0, with_timing=False))
    assert (scores["lidar_lost_share"], scores["lidar_longest_lost_s"], scores["lidar_longest_lost_since_s"]) == (0.6, 60.0, 7.0)
    assert not any(isinstance(value, dict) for value in scores.values())
    table = ResultTable(tmp_path / "table.csv")
    head = {"log": "a", "robot": "r", "model": "m", "estimator": "graph", "corrections": "", "key": "k", "status": "ok", "error": ""}
    table.put([{**head, **scores}])
    table.save([])
    assert ResultTable(tmp_path / "table.csv").path.exists()


@pytest.mark.parametrize(
    ("matched", "level", "message"),
    [
        ("m" * 100, OK, "ok"),
        ("m" * 100 + "l", WARN, "lost for 1.0 s"),
        ("m" * 100 + "l" * 6, ERROR, "lost for 6 s"),
        ("m" * 10 + "l" * 6 + "m" * 100, WARN, "LiDAR lost for 5.2 % of the drive, longest 6 s at t = 9 s"),
    ],
    ids=["matched", "just lost", "lost", "was lost"],
)
def test_diagnostics_level_follows_lost_scans(matched: str, level: int, message: str) -> None:
    pipeline = Pipeline(Trial(make_model("diff_drive", ROBOT), "ekf"), ROBOT, {}, has_lidar=True)
    lost = pipeline.estimator.lost
    assert lost is not None
    vars(lost).update(vars(counted(matched)))
    status = next(s for s in Health().statuses(pipeline) if s.name == "lidar")
    assert status.level == level
    assert status.message.startswith(message)
    assert {"lost_share", "longest_lost_s", "lost_now_s"} <= set(status.values)


def test_pipeline_warnings_name_losses_and_remedy() -> None:
    pipeline = Pipeline(Trial(make_model("skid_steer", ROBOT), "ekf"), ROBOT, {}, has_lidar=True)
    assert pipeline.estimator.lost is not None
    vars(pipeline.estimator.lost).update(vars(counted("mmsm")))
    (note,) = pipeline.warnings()
    assert note.startswith(
        "ekf (skid_steer): LiDAR lost for 33 % of the drive, longest 1 s at t = 1 s (1 of 4 scans: 1 repeated the ranges"
    )
    assert note.endswith("Check the LiDAR's driver.")


def test_dead_reckoning_warnings_have_no_lidar() -> None:
    pipeline = Pipeline(Trial(make_model("diff_drive", ROBOT), "odometry"), ROBOT, {}, has_lidar=True)
    assert pipeline.lidar is None
    assert pipeline.warnings() == []
