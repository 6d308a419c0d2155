"""Pages for readers with disabilities, by axe-core in a real browser: contrast, labels, headings, names of pictures."""

from __future__ import annotations

import pytest

from localization.evaluation.scores import score
from localization.report.charts import Chart, ChartSeries
from localization.report.page import Cell, Page, Section, Table, render
from localization.report.replay_page import page
from localization.ros import dashboard
from tests.helpers.browser import violations_of
from tests.helpers.extended import cases
from tests.helpers.report import HEAD, run, track

pytestmark = pytest.mark.rendered

WINDOWS = {"desktop": "--window-size=1280,900", "phone": "--window-size=390,900"}
THEMES = {"light": "--blink-settings=preferredColorScheme=1", "dark": "--blink-settings=preferredColorScheme=0"}


def replay_page():
    mapped = run(nis=[3.0] * 400, points=[[1.0, 2.0]] * 9, parameters={"k_0": (0.5, 0.1)})
    runs = [run(noise=0.2, covariance=False, estimator="odometry"), mapped]
    return page(HEAD, score(runs, track()), track())


def chart_page():
    """Charts and sortable tables, as in compare, diagnose, check and weigh."""
    columns = {"t": [0.0, 1.0], "v": [2.0, 3.0], "e": [0.1, 0.2]}
    chart = Chart("Residuals", [("t", "time [s]"), ("v", "speed [m/s]")], [("e", "error [m]")], [ChartSeries("before", "red")], columns)
    rows = [
        [Cell("ekf", "skid_steer", is_bold=True, badge="best"), Cell("2.0", mark="blue")],
        [Cell("graph", badge="not significant"), Cell("3.0")],
    ]
    table = Table([Cell("Run", "model"), Cell("Error", "m")], rows, is_sortable=True)
    return render(Page("A page", "facts", ["A sentence."], [Section("Table", [table]), Section("Chart", [chart])]))


PAGES = {"replay": replay_page, "chart": chart_page, "dashboard": dashboard.page}
ALL = [(name, size, theme) for name in PAGES for size in WINDOWS for theme in THEMES]


@pytest.mark.parametrize(("name", "size", "theme"), cases(ALL, ["replay-desktop-light"], ["-".join(case) for case in ALL]))
def test_page_has_no_violation(name, size, theme, tmp_path):
    assert violations_of(PAGES[name](), tmp_path, WINDOWS[size], THEMES[theme]) == []
