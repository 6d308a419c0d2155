"""The live page: what its server sends, and what a real browser draws of it (Debian: chromium)."""

from __future__ import annotations

import json
import subprocess
import urllib.error
import urllib.request

import numpy as np
import pytest

from localization.cli import main
from localization.ros import dashboard as module
from localization.ros.dashboard import Dashboard, Feed, History
from tests.helpers.browser import CHROMIUM, OPTIONS
from tests.helpers.online import ROBOT, drive_events, drive_log, new_core

pytestmark = pytest.mark.xdist_group("online")


def play(dashboard, events, mounts):
    """Give the drive to the page; returns all estimates."""
    pipeline, found = new_core("ekf"), []
    dashboard.begin(ROBOT, mounts)
    for event in events:
        estimates = pipeline.process(event)
        found += estimates
        dashboard.show(event, estimates, pipeline)
    dashboard.show(None, [], pipeline)
    return found


@pytest.fixture(scope="module")
def served():
    """A dashboard after a drive, and the estimates of the drive."""
    events, mounts = drive_events()
    dashboard = Dashboard()
    found = play(dashboard, events[: len(events) // 2], mounts)
    yield dashboard, found
    dashboard.close()


def read_events(address):
    with urllib.request.urlopen(address + "events", timeout=20.0) as answer:
        blocks = answer.read().decode().strip().split("\n\n")
    return [(block.split("\n")[0].removeprefix("event: "), json.loads(block.split("\n")[1].removeprefix("data: "))) for block in blocks]


def test_dashboard_sends_the_whole_drive_to_a_late_page(served):
    dashboard, found = served
    (kind, content), (last, _) = read_events(dashboard.address)
    assert (kind, last) == ("history", "end")
    stamps = np.array([e.stamp_ns for e in found]) * 1e-9
    samples = np.array([row[:3] for row in content["samples"]])
    for t, x, y in samples:
        nearest = found[int(np.argmin(abs(stamps - stamps[0] - t)))]
        np.testing.assert_allclose((x, y), nearest.pose[:2], atol=1e-4)
    assert np.all(np.diff(samples[:, 0]) >= 0.1 - 1e-3)
    assert samples[-1, 0] > 8.0
    assert "k_0" in content["names"]
    assert min(len(content["map"][0]), len(content["scan"][0])) > 100


@pytest.mark.extended
def test_dashboard_page_draws_the_drive_in_a_browser(served, tmp_path):
    dashboard, _ = served
    if CHROMIUM is None:
        pytest.skip("no Chromium runs on this machine")
    command = [CHROMIUM, *OPTIONS, f"--user-data-dir={tmp_path}", "--virtual-time-budget=4000", "--dump-dom", dashboard.address]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False).stdout
    assert "The run has ended. No fault." in shown
    assert shown.count('class="trace scatter') >= 9  # map, scan, path, ellipse, robot; sigmas, NIS, speeds, parameter
    assert '<option value="k_0">k_0</option>' in shown


def test_dashboard_serves_this_machine_alone(served):
    dashboard, _ = served
    assert dashboard.address.startswith("http://127.0.0.1:")
    for path, host in (("", "evil.example:80"), ("secret", None)):
        asked = urllib.request.Request(dashboard.address + path, headers={} if host is None else {"Host": host})
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(asked, timeout=5.0)


def test_history_of_ten_hours_has_bounded_rows():
    history = History(100_000_000)
    for i in range(36_000):
        if history.is_due(i * 1_000_000_000):
            history.add(i * 1_000_000_000, [float(i)])
    assert len(history.rows) <= module._MOST_SAMPLES
    assert history.rows[0] == [0.0]
    assert history.rows[-1][0] > 35_900.0
    steps = np.diff([row[0] for row in history.rows])
    assert steps.max() <= 2.0 * steps.min()


def test_feed_sends_what_is_new_and_all_after_thinning(monkeypatch):
    monkeypatch.setattr(module, "_MOST_SAMPLES", 4)
    feed, seen = Feed(), []
    messages = feed.messages()
    for i in range(6):
        feed.samples.add(i, [float(i)])
        feed.set(**({"map": i} if i in (0, 4) else {"pose": i}))
        seen.append(next(messages))
    assert seen[0] == ("history", {"map": 0, "samples": [[0.0]], "parameters": []})
    assert seen[1] == ("update", {"pose": 1, "samples": [[1.0]], "parameters": []})
    assert seen[4] == ("history", {"map": 4, "pose": 3, "samples": [[0.0], [2.0], [4.0]], "parameters": []})
    feed.end()
    assert [name for name, _ in messages] == ["end"]


@pytest.mark.extended
def test_online_with_a_dashboard_gives_the_same_estimates(tmp_path, capsys):
    command = ["online", str(drive_log()), "--robot", "vaultbot", "--rate", "max"]
    assert main([*command, "--out", str(tmp_path / "plain.tum")]) == 0
    assert main([*command, "--dashboard", "--out", str(tmp_path / "shown.tum")]) == 0
    assert "dashboard: http://127.0.0.1:" in capsys.readouterr().out
    assert (tmp_path / "shown.tum").read_bytes() == (tmp_path / "plain.tum").read_bytes()
    assert main([*command, "--dashboard", "--view", "rerun"]) == 2
    assert "Leave one of them out" in capsys.readouterr().err
