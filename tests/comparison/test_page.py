"""Report of a comparison: summary, every log, failures; it overwrites only reports."""

from __future__ import annotations

import re

import numpy as np
import pytest

from localization.comparison.comparison_page import CompareHead, comparison_page, write_comparison_report
from localization.comparison.statistics import closing, find, headline
from localization.errors import OutputError
from tests.helpers.report import PageText, without_scripts

pytestmark = pytest.mark.rendered

HEAD = CompareHead("vaultbot", "/ground_truth/odom", "table.csv", {"skidloc": "0.1.0"})
LOGS = [f"runs/drive_{i}.mcap" for i in range(20)]


def rows(values, metric="ate_rmse_m", corrections="constant"):
    """{(model, estimator): one number for each log, None where it failed}"""
    found = []
    for (model, estimator), numbers in values.items():
        form = corrections if estimator in ("ekf", "graph") else ""
        for log, value in zip(LOGS, numbers, strict=False):
            end = {"status": "ok", "error": ""} if value is not None else {"status": "failed", "error": f"{log} is broken"}
            found.append({"log": log, "robot": "vaultbot", "model": model, "estimator": estimator, "corrections": form, "key": "k", **end})
            found[-1][metric] = value
    return found


HARD = np.array([0.5, 1.0, 2.0, 4.0, 0.7, 1.5, 3.0, 0.9])
BETTER, WORSE = ("skid_steer", "ekf"), ("diff_drive", "ekf")


def summary_of(values, metric="ate_rmse_m"):
    found = find(rows(values, metric), metric)
    return headline(found), closing(found)


def test_summary_counts_wins_and_gain_of_the_means():
    factors = np.array([0.8, 0.9, 0.85, 0.9, 0.95, 0.9, 0.85, 1.02])  # worse on the last log, little
    first, rest = summary_of({WORSE: HARD, BETTER: HARD * factors})
    gain = 100.0 * (1.0 - (HARD * factors).sum() / HARD.sum())
    numbers = re.fullmatch(
        r"ekf with skid_steer beats ekf with diff_drive on 7 of 8 logs, by (\d+) % \[(\d+), (\d+)\] of position error \(ATE\), "
        r"p = (0\.\d+).",
        first,
    )
    assert numbers, first
    assert float(numbers[1]) == pytest.approx(gain, abs=0.5)
    assert float(numbers[2]) < gain < float(numbers[3])
    assert 2.0 / 2**8 <= float(numbers[4]) < 0.05
    assert rest == ["Use ekf with skid_steer."]


def test_gain_intervals_cover_the_true_gain():
    rng = np.random.default_rng(11)
    hits = 0
    for _ in range(100):
        hard = rng.gamma(4.0, 1.0, 20)
        (d,) = find(rows({WORSE: hard, BETTER: hard * rng.normal(0.88, 0.1, 20)}), "ate_rmse_m").tested
        hits += min(d.relative_low, d.relative_high) <= 0.12 <= max(d.relative_low, d.relative_high)
    assert 84 <= hits <= 99


def test_summary_without_significance_claims_nothing():
    noise = np.array([1.1, 0.9, 1.05, 0.93, 1.02, 0.97, 1.0, 1.01])
    first, rest = summary_of({WORSE: HARD, BETTER: HARD * noise})
    assert "is not significant" in first
    assert rest == ["No difference is significant on these logs: take the simplest, or record more drives."]
    first, rest = summary_of({WORSE: HARD[:4], BETTER: 0.5 * HARD[:4]})  # clear, but on four logs only
    assert "is not significant: the first is better on 4 of 4 logs" in first
    assert rest == ["4 logs cannot show it: p is at least 0.12 for one pair. Take at least 6."]
    first, rest = summary_of({WORSE: HARD})
    assert first.startswith("ekf with diff_drive: mean position error (ATE) 1.7 [")
    assert "over 8 logs" in first
    first, _ = summary_of({WORSE: HARD[:1], BETTER: HARD[:1] * 0.5})
    assert "share fewer than two logs" in first


def test_summary_of_two_equals_names_the_simpler_beside_the_best():
    equal = HARD * np.array([0.52, 0.49, 0.5, 0.48, 0.5, 0.49, 0.51, 0.52])
    _, rest = summary_of({("diff_drive", "odometry"): 5.0 * HARD, WORSE: 0.5 * HARD, BETTER: equal})
    assert rest == ["Use ekf with skid_steer; it is not significantly better than ekf with diff_drive on these logs."]


def cases():
    pairs = [(model, estimator) for model in ("a", "b") for estimator in ("odometry", "ekf", "graph", "lidar")]
    many = {pair: HARD * (1.0 + 0.2 * i) for i, pair in enumerate(pairs)}
    failing = {WORSE: [*HARD[:6], None, None], BETTER: [*(0.8 * HARD[:6]), 0.4, None]}
    return {
        "many": many,
        "failing": failing,
        "one": {WORSE: HARD},
        "one log": {WORSE: HARD[:1], BETTER: HARD[:1]},
        "zeros": {WORSE: 0.0 * HARD, BETTER: 0.0 * HARD},
        "negative": {WORSE: -HARD, BETTER: HARD},
    }


@pytest.mark.parametrize("case", list(cases()))
def test_page_is_well_formed_loads_nothing_and_starts_with_the_summary(case):
    found = find(rows(cases()[case]), "ate_rmse_m")
    made = comparison_page(HEAD, found)
    assert made == comparison_page(HEAD, found)
    made = without_scripts(made)
    text = PageText(made)
    assert not re.search(r"https?://|xlink|url\((?!#)|@import|\son\w+=", made)
    assert not [tag for tag, _ in text.tags if tag in ("script", "link", "iframe", "object")]
    ids = [attributes["id"] for _, attributes in text.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    words = "".join(text.words).replace("\N{NO-BREAK SPACE}", " ")
    assert words.index(headline(found)) < words.index("Means over logs")
    assert "nan" not in words.replace("finance", "")
    assert not re.findall(r"(?:fill|stroke): ?#(?!f{6}|f{3}\b)[0-9a-f]{3,6}", made)  # every colour is the page's to change
    assert made.count(">position error (ATE) [m]<") == 1


def test_page_lists_every_log_and_failure():
    found = find(rows(cases()["failing"]), "ate_rmse_m")
    text = PageText(comparison_page(HEAD, found, is_interactive=False))
    by_log = {row[0]: row[1:] for row in text.tables[-1][1:]}
    assert list(by_log) == [f"drive_{i}.mcap" for i in range(8)]
    shown = [mean.name for mean in found.means]
    assert by_log["drive_2.mcap"][shown.index("diff_drive ekf (constant)")] == "2.00"
    assert by_log["drive_6.mcap"][shown.index("diff_drive ekf (constant)")] == "failed"
    assert by_log["drive_7.mcap"] == ["failed", "failed"]
    words = "".join(text.words)
    assert "drive_6.mcap (ekf with diff_drive): runs/drive_6.mcap is broken" in words
    assert "drive_7.mcap (everything): runs/drive_7.mcap is broken" in words
    assert "3 of 16 runs failed, on 2 logs." in words


def test_page_escapes_text_of_the_logs():
    evil = "<script>alert('x')</script>&\"'"
    made = rows({(evil, "ekf"): [1.0, None], (evil, evil): [2.0, 3.0]})
    for row in made:
        row["log"] += evil
        row["error"] = evil
    page = comparison_page(CompareHead(evil, evil, evil, {evil: evil}), find(made, "ate_rmse_m"))
    assert "<script>alert" not in page
    PageText(without_scripts(page))


def test_page_overwrites_only_a_report_of_a_comparison(tmp_path):
    path, found = tmp_path / "report.html", find(rows({WORSE: HARD, BETTER: 0.9 * HARD}), "ate_rmse_m")
    write_comparison_report(path, HEAD, found)
    assert path.read_text() == comparison_page(HEAD, found)
    write_comparison_report(path, HEAD, find(rows({WORSE: HARD}), "ate_rmse_m"))
    assert "Nothing else" not in path.read_text()
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    path.write_text("<title>Replay of precious.mcap</title>")
    with pytest.raises(OutputError, match="not a report of a comparison"):
        write_comparison_report(path, HEAD, found)
    assert "precious" in path.read_text()
    with pytest.raises(OutputError, match="cannot be written"):
        write_comparison_report(path / "below" / "report.html", HEAD, found)


@pytest.mark.parametrize("n", [4, 8, 20])
def test_intervals_contain_no_difference_only_where_it_is_not_significant(n):
    rng = np.random.default_rng(n)
    pairs = [(model, estimator) for model in ("a", "b", "c") for estimator in ("odometry", "ekf")]
    hard = rng.gamma(4.0, 1.0, n)
    found = find(
        rows({pair: hard * f * rng.lognormal(0.0, 0.2, n) for pair, f in zip(pairs, (3, 1, 2, 1.1, 2.5, 0.9), strict=True)}), "ate_rmse_m"
    )
    assert len(found.tested) == 15
    for d in found.tested:
        assert (d.relative_low <= 0.0 <= d.relative_high) == (not found.is_shown(d))
        assert (d.low <= 0.0 <= d.high) == (not found.is_shown(d))
    if n == 4:
        assert all(np.isinf(d.relative_low) for d in found.tested)
        assert not re.search(r"% \[", " ".join([headline(found), *closing(found)]))
