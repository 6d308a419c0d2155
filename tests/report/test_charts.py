"""Charts and sortable tables of reports: their data, and what they do in a real browser."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from localization.comparison.comparison_page import comparison_page
from localization.comparison.statistics import find
from localization.diagnosis.weigh import DrivenWeighing, Nuisance
from localization.report.charts import Chart, ChartSeries
from localization.report.page import Cell, Page, Section, Table, render
from localization.report.weigh_page import confidence_ellipse, weigh_page
from motion_models.robot_file import load_robot
from tests.comparison.test_page import BETTER, HARD, HEAD, WORSE, rows
from tests.helpers.browser import run_in_page
from tests.helpers.report import PageText, without_scripts

CHART = Chart(
    "Residuals",
    x=[("time", "time [s]"), ("speed", "speed [m/s]")],
    y=[("a", "along [m]"), ("b", "heading [rad]")],
    series=[ChartSeries("before", "red", y="a"), ChartSeries("after", "blue", y="b", panel=1, texts=["one", "two", "three"])],
    columns={"time": [0.0, 1.0, 2.0], "speed": [3.0, 4.0, math.nan], "a": [1.0, -1.0, 2.0], "b": [0.1, 0.2, 0.3]},
)
ROWS = (("one", "2.0"), ("two", "10.0"), ("three", "\N{MINUS SIGN}1.0"))
TABLE = Table([Cell("Run"), Cell("Error")], [[Cell(name), Cell(value)] for name, value in ROWS], is_sortable=True)
STILL = Table([Cell("a")], [])
SECTIONS = [Section("Table", [TABLE]), Section("Chart", [CHART]), Section("Still", [TABLE], is_static=True)]
PAGE = Page("A page", "", ["A sentence."], SECTIONS)
PROBE = """
const names = () => [...document.querySelectorAll("tbody tr")].filter(row => !row.hidden).map(row => row.cells[0].innerText);
document.querySelectorAll("thead button")[1].click(); found.up = names();
document.querySelectorAll("thead button")[1].click(); found.down = names();
const words = document.querySelector("input.filter"); words.value = "TWO";
words.dispatchEvent(new Event("input")); found.filtered = names();
const place = document.querySelector(".chart-place"), list = document.querySelector("select");
found.traces = place.data.map(t => [t.name, t.x]); list.value = "speed"; list.dispatchEvent(new Event("change"));
found.speed = place.data.map(t => t.x); found.title = place.layout.xaxis.title.text;
found.isStaticHidden = getComputedStyle(document.querySelector("section.static")).display === "none";
found.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
"""


def test_chart_content_has_null_for_what_is_no_number():
    content = json.loads(str(CHART.data))
    assert content["columns"]["speed"] == [3.0, 4.0, None]
    assert [title for _, title in content["y"]] == ["along [m]", "heading [rad]"]


def test_chart_text_cannot_end_its_script():
    evil = Chart(
        "</script>", [("x", "x")], [("y", "y")], [ChartSeries("</script><script>alert(1)", "red", y="y")], {"x": [1.0], "y": [1.0]}
    )
    assert "</script" not in str(evil.data)
    PageText(without_scripts(render(Page("A page", "", ["A sentence."], [Section("Chart", [evil])]))))


def test_page_without_scripts_keeps_tables_and_static_figures():
    made = render(PAGE.without_scripts())
    assert "<script" not in made
    assert 'class="static"' not in made
    assert made.count("<table>") == 2


@pytest.mark.extended
def test_charts_and_tables_in_a_browser_sort_filter_and_choose(tmp_path: Path):
    shown = render(dataclasses.replace(PAGE, sections=[*PAGE.sections[:2], Section("Still", [STILL], is_static=True)]))
    seen = run_in_page(shown, PROBE, tmp_path, "--window-size=390,900")
    assert seen["up"] == ["three", "one", "two"]
    assert seen["down"] == ["two", "one", "three"]
    assert seen["filtered"] == ["two"]
    assert seen["traces"] == [["before", [0, 1, 2]], ["after", [0, 1, 2]]]
    assert (seen["speed"][0], seen["title"]) == ([3, 4, None], "speed [m/s]")
    assert seen["isStaticHidden"]
    assert seen["overflow"] <= 0
    assert seen["errors"] == []


@pytest.mark.extended
def test_comparison_in_a_browser_draws_its_runs_and_pairs(tmp_path: Path):
    made = comparison_page(HEAD, find(rows({WORSE: [*HARD[:7], None], BETTER: 0.05 * HARD}), "ate_rmse_m"))
    assert len(made) < 2_000_000
    script = 'found.types = [...document.querySelectorAll(".chart-place")].map(p => [p.data.length, p.layout.xaxis.type]);'
    seen = run_in_page(made, script, tmp_path, "--blink-settings=preferredColorScheme=0")
    assert seen == {"errors": [], "types": [[2, "log"], [2, "log"]]}


def test_confidence_ellipse_holds_its_share_of_a_gaussian():
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    ellipse = confidence_ellipse(np.array([1.0, 2.0]), covariance)
    distances = np.einsum("ni,ij,nj->n", ellipse - [1.0, 2.0], np.linalg.inv(covariance), ellipse - [1.0, 2.0])
    drawn = np.random.default_rng(3).multivariate_normal(np.zeros(2), covariance, 20_000)
    inside = np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(covariance), drawn) < distances.mean()
    assert np.ptp(distances) < 1e-9
    assert inside.mean() == pytest.approx(0.95, abs=0.005)


def test_weigh_page_shows_the_ellipse_and_the_load():
    robot = load_robot("husky_a200")
    offset, cov = np.array([0.036, 0.0004]), np.diag([0.001, 0.003]) ** 2
    found = DrivenWeighing(
        "<a>.bag", "husky_a200", "scans", 28, 49.0, np.zeros(2), offset, cov, 46.0, 1.0, {"scrub": Nuisance(0.01, 0.002, 0.01, "m")}
    )
    made = weigh_page("The centre of gravity is there.", found, robot.geometry, (0.3, 0.0))
    text = made
    assert "&lt;a&gt;.bag" in text
    assert "load moment x" in text
    assert "<td>+1.66</td>" in text
    assert "diagonal_load" not in text
    assert len(made) < 2_000_000


def printed(page: str) -> str:
    """The page as it is printed: what holds for paper alone holds on the screen, and the other way round."""
    return page.replace("@media screen", "@media (width < 0)").replace("@media print", "@media screen")


@pytest.mark.extended
def test_printed_page_has_still_figures_and_no_controls(tmp_path: Path):
    script = """const shown = query => [...document.querySelectorAll(query)].map(e => getComputedStyle(e).display !== "none");
    found.still = shown("section.static"); found.drawn = shown(".explorer"); found.filters = shown("input.filter");
    found.paper = getComputedStyle(document.body).backgroundColor;
    found.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;"""
    options = ("--window-size=720,900", "--blink-settings=preferredColorScheme=0")  # A4 between its margins, of a reader with a dark theme
    seen = run_in_page(printed(render(PAGE)), script, tmp_path, *options)
    assert seen == {
        "errors": [],
        "still": [True],
        "drawn": [False],
        "filters": [False, False],
        "paper": "rgb(255, 255, 255)",
        "overflow": 0,
    }
