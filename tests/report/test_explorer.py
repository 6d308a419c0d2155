"""The interactive part of a replay's page, in a real browser where there is one (Debian: chromium)."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from localization.evaluation.references import ReferenceTrack
from localization.evaluation.scores import score
from localization.log_replay import Run
from localization.maps.keyframe_map import KeyframeMap
from localization.messages import message
from localization.report.interactive import explorer_data
from localization.report.replay_page import ReportHead, page
from localization.report.runs import plotted_runs
from localization.trajectory import Trajectory
from tests.helpers.browser import run_in_page

pytestmark = pytest.mark.rendered

SCANS = [(k * 4_000_000_000, np.array([[2.0, 1.0], [2.0, -1.0]])) for k in range(11)]
HEAD = ReportHead("drive.mcap", "husky_a200", "2026-01-02 03:04:05 UTC", 40.0, [], {}, "c0ffee", SCANS)
STAMPS = np.arange(401, dtype=np.int64) * 100_000_000
POSES = np.column_stack([0.5 * STAMPS * 1e-9, np.zeros(401), np.zeros(401)])
PROBE = """
const box = id => document.getElementById("explore-" + id);
const change = (id, value, kind) => {box(id).value = value; box(id).dispatchEvent(new Event(kind));};
const now = () => {const d = box("map").data; return d[d.length - 1].x.slice();};
const titles = () => (box("time").layout.annotations || []).map(a => a.text);
const scan = () => {const d = box("map").data; return [d[d.length - 2].x, d[d.length - 2].y];};
change("slider", 21, "input"); found.scan = scan();
change("slider", 20, "input"); found.at20 = now(); found.text = box("now").textContent;
const ellipse = box("map").data.filter(t => t.name === "two sigma now");
found.ellipse = ellipse.map(t => [Math.max(...t.x) - 10, Math.max(...t.y)]);
found.log = box("time").layout.yaxis.type; found.titles = titles();
change("a", 0, "change"); change("b", 1, "change"); found.difference = titles().includes("A to B [m]");
change("axis", "way", "change"); found.way = box("time").layout.xaxis.title.text;
found.bands = box("time").layout.shapes.filter(s => s.type === "rect").map(s => [s.x0, s.x1]);
found.isStaticHidden = getComputedStyle(document.querySelector("section.static")).display === "none";
change("aligned", "start", "change"); found.atStart = Math.max(...box("time").data[0].y);
found.events = [...box("event").options].map(o => o.text).slice(1);
change("event", 12.3, "change"); found.jumped = box("now").textContent;
const width = () => {const [low, high] = box("map").layout.xaxis.range; return high - low;};
found.widths = [width()]; box("map").querySelector('[data-title="Zoom in"]').dispatchEvent(new Event("click")); found.widths.push(width());
change("slider", 30, "input"); change("axis", "time", "change"); found.widths.push(width());
const path = box("map").data.findIndex(t => t.name.startsWith("ekf"));
Plotly.Fx.hover(box("map"), [{curveNumber: path, pointNumber: 100}]); found.hover = box("map").querySelector(".hoverlayer").textContent;
found.loops = box("map").data.filter(t => t.name.startsWith("1 loops")).map(t => t.x);
found.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
"""


def one_loop():
    """Three keyframes, of which the last closes a loop with the first."""
    edges, information = np.array([[0, 1], [0, 2]]), np.tile(np.eye(3), (2, 1, 1))
    points = np.zeros((0, 2), np.float32), np.zeros(3, np.int64), np.zeros((3, 2))
    return KeyframeMap(STAMPS[::200], POSES[::200], information[[0, 0, 0]], *points, edges, np.zeros((2, 3)), information, edges[:, 1] == 2)


def results():
    nis = np.full(401, 3.0)
    nis[100:200] = np.nan
    nis[251:255] = 100.0
    cov = np.tile(np.diag([0.01, 0.01, 0.001]), (401, 1, 1))
    zeros = np.zeros((401, 3)), np.zeros((401, 3, 3))
    plain = Run(
        "diff_drive",
        "odometry",
        Trajectory(STAMPS, POSES * [1.1, 1, 1], cov),
        *zeros,
        np.full(401, np.nan),
        {},
        {},
        np.empty((0, 2)),
        (),
        1.0,
    )
    fused = dataclasses.replace(
        plain,
        estimator="ekf",
        trajectory=Trajectory(STAMPS, POSES, cov),
        nis=nis,
        map_points=np.ones((9, 2)),
        parameter_history={"k_0": np.array([[0.0, 0.5, 0.1], [40.0, 0.55, 0.01]])},
        warnings=(message("stopped_gyro.repeats").at(12.3), message("wheel_gaps.no_data", total_s=1.0)),
        keyframes=one_loop(),
    )
    reference = ReferenceTrack(STAMPS[::4], POSES[::4, :2], POSES[::4, 2])
    return score([plain, fused], reference), reference


def test_explorer_data_has_times_without_a_matched_scan():
    found, reference = results()
    data = explorer_data(plotted_runs(found), reference)
    assert [run["lost"] for run in data["runs"]] == [[], [[9.9, 20.0]]]
    assert [run["slips"] for run in data["runs"]] == [[], [[25.1, 25.4, 10.0]]]
    assert data["runs"][1]["way"][-1] == pytest.approx(20.0)
    assert data["reference"]["t"][-1] == pytest.approx(40.0)


@pytest.mark.extended
def test_static_page_has_no_script():
    found, reference = results()
    assert "<script" not in page(HEAD, found, reference, is_interactive=False)
    assert 'class="static"' not in page(HEAD, found, reference, is_interactive=False)


def test_explorer_data_has_errors_aligned_at_the_start():
    found, reference = results()
    plain = explorer_data(plotted_runs(found), reference)["runs"][0]["errors"]
    assert plain["start"]["position"][0] == 0.0
    assert plain["start"]["position"][-1] == pytest.approx(2.0, abs=0.01)  # a tenth of 20 m
    assert plain["position"][-1] == pytest.approx(1.0, abs=0.02)  # half of that where the whole path is aligned


@pytest.mark.extended
def test_explorer_run_that_diverged_does_not_set_the_scale():
    found, reference = results()
    far = dataclasses.replace(found[0].run, trajectory=Trajectory(STAMPS, POSES * [100.0, 1, 1], None))
    borders = explorer_data(plotted_runs(score([far, found[1].run], reference)), reference)["borders"]
    assert borders["x"][1] < 40.0


@pytest.mark.extended
def test_explorer_in_a_browser_moves_with_its_slider(tmp_path: Path):
    found, reference = results()
    seen = run_in_page(page(HEAD, found, reference), PROBE, tmp_path, "--window-size=390,900")
    assert seen["at20"][1] == pytest.approx(10.0, abs=0.1)
    assert (seen["text"], seen["log"], seen["way"]) == ("20.0 s", "log", "way [m]")
    assert {"position error [m]", "heading error [deg]", "position sigma [m]", "NIS (3 expected)", "k_0 ± sigma"} == set(seen["titles"])
    assert seen["scan"] == [[12.0, 12.0], [1.0, -1.0]]  # the last one before 21 s, from where the robot was at 20 s
    assert seen["difference"]
    assert seen["isStaticHidden"]
    assert np.array(seen["ellipse"]) == pytest.approx(np.full((2, 2), 0.2), abs=0.01)
    assert seen["bands"] == [[4.95, 10.0], [12.55, 12.7]]
    assert seen["atStart"] == pytest.approx(2.0, abs=0.01)
    assert seen["events"] == [
        "9.9 s: no scan matched for 10.1 s, ekf · diff_drive",
        f"12.3 s: fault: {message('stopped_gyro.repeats')}",
        "25.1 s: scan against wheels 10 sigma (slip or push), ekf · diff_drive",
        "40.0 s: loop closed, ekf · diff_drive",
    ]
    assert seen["jumped"] == "12.3 s"
    assert np.array(seen["widths"]) / seen["widths"][0] == pytest.approx([1.0, 0.5, 0.5])  # kept while slider and lists are used
    assert "10.0 s" in seen["hover"]
    assert "sigma 0.141 m" in seen["hover"]
    assert seen["loops"] == [[0.0, 20.0, None]]
    assert seen["overflow"] <= 0
    assert seen["errors"] == []
