"""The picture in rerun: a recording is read back with rerun's own reader, and what it holds is held against a run without it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from localization.cli import main
from localization.events import Scan
from localization.ros.publisher import ODOMETRY
from localization.trajectory import read_tum
from tests.helpers.online import LogTransport, drive_events, drive_log, published, run_node

pytestmark = pytest.mark.xdist_group("online")


def online(*arguments):
    return main(["online", str(drive_log()), "--robot", "vaultbot", "--rate", "max", *map(str, arguments)])


@pytest.fixture(scope="module")
def chunk():
    return pytest.importorskip("rerun.chunk", reason="the extra 'viz' (rerun-sdk) is not installed")


@pytest.fixture(scope="module")
def recorded(chunk, tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    assert online("--view-file", folder / "drive.rrd", "--out", folder / "drive.tum") == 0
    return folder


def rows_of(chunk, path):
    """Rows by entity: (name of the component, values)."""
    found = {}
    for part in chunk.RrdReader(path).stream().to_chunks():
        batch = part.to_record_batch()
        found.setdefault(part.entity_path.strip("/"), []).append(batch)
    return found


def column(batches, ending):
    """All values of the component whose name ends so, in order."""
    values = []
    for batch in batches:
        for name, data in zip(batch.schema.names, batch.columns, strict=True):
            if name.endswith(ending):
                values += [value for value in data.to_pylist() if value is not None]
    return values


def test_recording_holds_all_poses_scans_and_corrections(chunk, recorded):
    rows = rows_of(chunk, recorded / "drive.rrd")
    track = read_tum(recorded / "drive.tum")
    places = np.array([value[0] for value in column(rows["world/robot"], "translation")])
    assert len(places) == len(track)
    order = np.lexsort(track.poses[:, :2].T), np.lexsort(places[:, :2].T)
    np.testing.assert_allclose(places[order[1], :2], track.poses[order[0], :2], atol=1e-5)  # rerun's are of 32 bits
    events, _ = drive_events()
    scans = [event for event in events if isinstance(event, Scan)]
    points = column(rows["world/robot/laser/scan"], "positions")
    assert sorted(map(len, points)) == sorted(len(scan.points) for scan in scans)
    assert len(column(rows["world/robot/two_sigma"], "strips")) == len(track)
    path = column(rows["world/path/0"], "strips")
    assert max(len(strip[0]) for strip in path) >= 200
    assert len(column(rows["world/map"], "positions")[-1]) > 300
    (mean, low, high) = column(rows["corrections/k_0"], "scalars")[-1]
    assert low < mean < high
    assert mean - low == pytest.approx(high - mean)
    assert len(column(rows["estimate/nis"], "scalars")) > 200


def test_recording_changes_no_estimate(recorded, tmp_path):
    assert online("--out", tmp_path / "drive.tum") == 0
    assert (tmp_path / "drive.tum").read_bytes() == (recorded / "drive.tum").read_bytes()


def test_live_node_records_all_estimates(chunk, tmp_path):
    from localization.ros.rerun_view import RerunView

    view = RerunView(tmp_path / "live.rrd")
    transport = LogTransport(drive_log())
    run_node(transport, view=view)
    view.close()
    places = column(rows_of(chunk, tmp_path / "live.rrd")["world/robot"], "translation")
    assert len(places) == len(published(transport, ODOMETRY)) > 250


def test_viewer_listens_to_this_machine_and_may_be_closed(chunk, monkeypatch, tmp_path):
    """Its server without the window stands in for it."""
    from localization.ros import rerun_view as module

    program = Path(sys.executable).with_name("rerun")
    viewers, asked, start, opened = [], [], subprocess.Popen, module._viewer
    monkeypatch.setattr(module.subprocess, "Popen", lambda *a, **k: viewers.append(start(*a, **k)) or viewers[-1])
    monkeypatch.setattr(module, "_viewer", lambda: asked.append(opened((str(program), "--serve-grpc"))) or asked[-1])
    view = module.RerunView()
    try:
        listening = subprocess.run(["ss", "-Hltnp"], capture_output=True, text=True, check=True).stdout.splitlines()
        addresses = [line.split()[3] for line in listening if "rerun" in line and f":{asked[0]} " in line]
        assert addresses
        assert all(address.startswith("127.0.0.1:") for address in addresses)
        run_node(LogTransport(drive_log(), lambda messages: messages[:1000]), view=view)
    finally:
        os.killpg(viewers[0].pid, signal.SIGKILL)
        viewers[0].wait()
    view.close()


def test_viewer_that_cannot_be_opened_is_refused(chunk, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert online("--view", "rerun") == 2
    assert "there is none here. --view-file NAME.rrd records" in " ".join(capsys.readouterr().err.split())
    monkeypatch.setenv("DISPLAY", ":4711")
    assert online("--view", "rerun") == 2
    assert "rerun's viewer cannot be opened" in " ".join(capsys.readouterr().err.split())


def test_two_sigmas_are_those_of_the_covariance(chunk):
    from localization.ros.rerun_view import two_sigma

    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    covariance = root @ root.T
    ellipse = two_sigma(covariance)[:, :2]
    distances = np.einsum("ni,ij,nj->n", ellipse, np.linalg.inv(covariance[:2, :2]), ellipse)
    np.testing.assert_allclose(distances, 4.0)


def test_view_file_that_exists_is_not_overwritten(chunk, tmp_path, capsys):
    kept = tmp_path / "kept.rrd"
    kept.write_bytes(b"precious")
    for name, text in (
        (kept, "exists already"),
        (tmp_path / "view.mp4", "must end in .rrd"),
        (tmp_path / "no" / "view.rrd", "cannot be written"),
    ):
        assert online("--view-file", name) == 2
        assert text in " ".join(capsys.readouterr().err.split())
    assert kept.read_bytes() == b"precious"
    assert online("--view-file", tmp_path / "new.rrd", "--topic.scan", "/nowhere") == 2
    assert [path.name for path in tmp_path.iterdir()] == ["kept.rrd"]


def test_view_without_its_extra_names_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "localization.ros.rerun_view", raising=False)
    for arguments in (("--view", "rerun"), ("--view-file", tmp_path / "a.rrd")):
        assert online(*arguments) == 2
        assert "pip install 'skidloc[viz]'" in " ".join(capsys.readouterr().err.split())
