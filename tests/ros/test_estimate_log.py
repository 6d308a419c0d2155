"""`skidloc online` on a log: the bytes of a replay, also after kill -9; files that cannot be gone on from are refused."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
import types

import numpy as np
import pytest

from localization.cli import main
from localization.errors import OutputError
from localization.estimators import Estimate
from localization.logs.writer import write_fused
from localization.ros.checkpoint import read_head
from localization.ros.estimate_log import EstimateLog
from localization.ros.session import Files, Session, SessionState
from tests.helpers.disks import files_of_at_most, fill_disk
from tests.helpers.online import drive_events, drive_log, new_core, reseal

_DEADLINE_S = 120.0  # only a failure waits for so long
COMMAND = (sys.executable, "-m", "localization.cli", "online")


pytestmark = pytest.mark.xdist_group("online")


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    out = tmp_path_factory.mktemp("online") / "replayed"
    options = ("--robot", "vaultbot", "--model", "skid_steer", "--estimator", "ekf", "--reference", "none")
    assert main(["replay", str(drive_log()), *options, "--out", str(out)]) == 0
    return out


def online(*arguments):
    return main(["online", str(drive_log()), "--robot", "vaultbot", *map(str, arguments)])


def test_online_of_a_log_writes_the_bytes_of_a_replay(replayed, tmp_path, capsys):
    assert online("--rate", "max", "--out", tmp_path / "fused.mcap") == 0  # a bag's name is written in it
    assert (tmp_path / "fused.mcap").read_bytes() == (replayed / "fused.mcap").read_bytes()
    assert online("--rate", "max", "--out", tmp_path / "run.tum") == 0
    assert (tmp_path / "run.tum").read_bytes() == (replayed / "skid_steer_ekf.tum").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fused.mcap", "run.tum"]
    assert "estimates" in capsys.readouterr().out


def start(tmp_path, rate):
    files = ("--out", tmp_path / "fused.mcap", "--state", tmp_path / "state")
    return subprocess.Popen(
        [*COMMAND, drive_log(), "--robot", "vaultbot", "--rate", rate, *files], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def wait_for_state(tmp_path, process, events):
    end = time.monotonic() + _DEADLINE_S
    while time.monotonic() < end and process.poll() is None:
        if (tmp_path / "state").exists() and read_head(tmp_path / "state")["events"] > events:
            return
        time.sleep(0.02)
    pytest.fail(f"no state: {process.stdout.read() if process.poll() is not None else 'still running'}")


def kill_after(tmp_path, events):
    process = start(tmp_path, "1")
    wait_for_state(tmp_path, process, events)
    for _ in range(20):  # a state on disk is whole
        assert read_head(tmp_path / "state")["records"] >= 0
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert process.returncode == -signal.SIGKILL
    assert not (tmp_path / "fused.mcap").exists()


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("killed")
    kill_after(folder, 200)
    return folder


def test_state_on_disk_is_never_older_than_a_second(tmp_path, monkeypatch):
    """By a clock that shows the time of the events; writing costs no time of a processor that others use as well."""
    clock = types.SimpleNamespace(monotonic=lambda: clock.now_s, thread_time=lambda: 0.0, now_s=0.0)
    monkeypatch.setattr("localization.ros.checkpoint.time", clock)
    state, (events, _) = tmp_path / "state", drive_events()
    session = Session.start(Files(state=state), SessionState(new_core("odometry")), "drive", {})
    written_s, modified_ns = events[0].stamp_ns * 1e-9, 0
    for event in events[:800]:
        clock.now_s = event.stamp_ns * 1e-9
        session.process(event)
        session.save_state()
        session.checkpoints.wait()
        if state.exists() and state.stat().st_mtime_ns != modified_ns:
            written_s, modified_ns = clock.now_s, state.stat().st_mtime_ns
        assert clock.now_s - written_s < 1.0
    assert read_head(state)["events"] > 600
    session.close()


@pytest.mark.slow
def test_online_killed_twice_and_resumed_writes_the_same_bytes(replayed, killed, tmp_path, capsys):
    shutil.copytree(killed, tmp_path, dirs_exist_ok=True)
    kill_after(tmp_path, read_head(tmp_path / "state")["events"] + 50)  # written by this process, not left by the one before
    assert online("--rate", "max", "--out", tmp_path / "fused.mcap", "--state", tmp_path / "state") == 0
    assert "resumed from" in capsys.readouterr().out
    assert (tmp_path / "fused.mcap").read_bytes() == (replayed / "fused.mcap").read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["fused.mcap"]


def test_output_that_a_killed_run_left_is_replaced(tmp_path, monkeypatch):
    written = []

    def write(path, *arguments):
        assert list(path.parent.iterdir()) == []
        written.append(path)
        write_fused(path, *arguments)

    monkeypatch.setattr("localization.ros.session.write_fused", write)
    beside = tmp_path / ".fused.mcap.new"
    (beside / ".fused-abc").mkdir(parents=True)
    assert online("--rate", "max", "--estimator", "odometry", "--out", tmp_path / "fused.mcap") == 0
    assert written == [beside / "fused.mcap"]
    assert [path.name for path in tmp_path.iterdir()] == ["fused.mcap"]


@pytest.mark.slow
def test_online_stopped_by_sigterm_leaves_its_last_state(replayed, tmp_path, capsys):
    process = start(tmp_path, "1")
    wait_for_state(tmp_path, process, 100)
    for other in (["--out", tmp_path / "a.tum", "--state", tmp_path / "state"], ["--out", tmp_path / "fused.mcap"]):
        assert online("--rate", "max", *other) == 2
        assert "is in use by another process that runs" in capsys.readouterr().err
    process.send_signal(signal.SIGTERM)
    expected, _ = process.communicate()
    assert process.returncode == 130
    assert "interrupted" in expected
    assert "the same command goes on from there" in expected
    assert "Traceback" not in expected
    assert online("--rate", "max", "--out", tmp_path / "fused.mcap", "--state", tmp_path / "state") == 0
    assert (tmp_path / "fused.mcap").read_bytes() == (replayed / "fused.mcap").read_bytes()


@pytest.mark.slow
def test_online_stopped_without_a_state_writes_its_estimates(replayed, tmp_path):
    out, estimate_log = tmp_path / "a.tum", tmp_path / ".a.tum.part"
    options = ("--robot", "vaultbot", "--rate", "2", "--out", out)
    process = subprocess.Popen([*COMMAND, drive_log(), *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    end = time.monotonic() + _DEADLINE_S
    while time.monotonic() < end and not (estimate_log.exists() and estimate_log.stat().st_size > 15_000):
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    expected, _ = process.communicate()
    assert process.returncode == 130, expected
    lines = out.read_text().splitlines()
    assert f"{len(lines) - 1} estimates, up to where the run was stopped" in expected.replace("\n", " ")
    assert len(lines) > 50
    assert lines == (replayed / "skid_steer_ekf.tum").read_text().splitlines()[: len(lines)]
    assert [path.name for path in tmp_path.iterdir()] == ["a.tum"]


def test_files_that_cannot_be_written_are_refused_at_the_start(tmp_path, capsys):
    out = tmp_path / "a.tum"
    for state, expected in [
        (tmp_path / "no" / "state", "Name a file in a folder that is there"),
        (tmp_path, "is a folder"),
        (out, "is the output as well"),
        (tmp_path / "b" / ".." / ".a.tum.part", "is where the output grows as well"),
    ]:
        assert online("--out", out, "--state", state) == 2
        assert expected in capsys.readouterr().err.replace("\n", " ")
        assert list(tmp_path.iterdir()) == []


def test_files_claimed_by_another_process_are_refused(tmp_path):
    files = Files(tmp_path / "a.tum", tmp_path / "state")
    (tmp_path / ".state.lock").touch()  # of a process that was killed
    with files.claimed(), pytest.raises(OutputError, match=r"state' is in use by another process"), Files(state=files.state).claimed():
        pass
    assert list(tmp_path.iterdir()) == []
    with files.claimed():
        pass


def test_online_at_a_rate_takes_the_time_of_the_log(tmp_path):
    begin = time.monotonic()
    assert online("--rate", "40", "--estimator", "odometry", "--out", tmp_path / "a.tum") == 0
    assert time.monotonic() - begin > 20.0 / 40.0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--rate", "0"], "--rate is '0'"),
        (["--rate", "nan"], "--rate is 'nan'"),
        (["--rate", "1e-300"], "--rate is '1e-300'; it must be a number from 0.001 (1 is real time), or max."),
        (["--rate", "fast"], "--rate is 'fast'"),
        (["--estimator", "magic"], "no estimator 'magic'"),
        (["--model", "magic"], "magic"),
        (["--corrections", "magic"], "no form of corrections 'magic'"),
        (["--out", "a.csv"], "must end in .mcap or .tum"),
        (["--robot", "nobody"], "nobody"),
        (["--topic.scan", "/nowhere"], "no topic '/nowhere'"),
        (["--node.wait-s", "nan"], "setting wait_s of NodeConfig is nan"),
    ],
)
def test_online_with_bad_arguments_is_refused(arguments, expected, capsys):
    assert online(*arguments) == 2
    shown = capsys.readouterr()
    assert expected in shown.err
    assert "Traceback" not in shown.err


@pytest.mark.extended
def test_online_with_a_state_of_another_run_is_refused(killed, tmp_path, capsys):
    shutil.copytree(killed, tmp_path, dirs_exist_ok=True)
    state, out = tmp_path / "state", tmp_path / "a.tum"
    for arguments, expected in [
        (["--estimator", "graph", "--state", state, "--out", tmp_path / "fused.mcap"], "made with another estimator (ekf then, graph now)"),
        (["--model", "diff_drive", "--state", state, "--out", tmp_path / "fused.mcap"], "made with another model"),
        (["--state", state], "with an --out"),
        (["--state", state, "--out", out], "the estimates up to the state, cannot be read"),
        (["--state", drive_log(), "--out", out], "no state of an estimator"),
    ]:
        assert online("--rate", "max", *arguments) == 2
        assert expected in capsys.readouterr().err.replace("\n", " ")
    other_log = drive_log(seed=1)
    assert main(["online", str(other_log), "--robot", "vaultbot", "--state", str(state), "--out", str(tmp_path / "fused.mcap")]) == 2
    assert "made with another source" in capsys.readouterr().err
    whole = state.read_bytes()
    reseal(state, "events", 10**9)
    assert online("--rate", "max", "--state", state, "--out", tmp_path / "fused.mcap") == 2
    assert "is of 1000000000 events where the log has" in capsys.readouterr().err
    state.write_bytes(whole)
    os.truncate(tmp_path / ".fused.mcap.part", 208)
    assert online("--rate", "max", "--state", state, "--out", tmp_path / "fused.mcap") == 2
    assert "estimates where the state refers to" in capsys.readouterr().err
    out.write_text("precious")
    assert online("--rate", "max", "--out", out) == 2
    assert out.read_text() == "precious"


def test_estimate_log_on_a_full_disk_holds_whole_rows(tmp_path):
    estimate_log = EstimateLog.create(tmp_path / "part")
    estimates = [Estimate(stamp, np.array([stamp, 0.0, 0.0]), None, np.zeros(3), None) for stamp in range(1, 6)]
    with files_of_at_most(500):  # two rows and a part
        for estimate in estimates[:2]:
            estimate_log.add(estimate)
        for estimate in estimates[2:4]:
            with pytest.raises(OutputError, match=r"cannot be written to '.*part': File too large"):
                estimate_log.add(estimate)
        assert estimate_log.rows()[0].tolist() == [1, 2]
    estimate_log.add(estimates[4])
    assert estimate_log.rows()[0].tolist() == [1, 2, 5]
    assert estimate_log.rows()[1][:, 0].tolist() == [1.0, 2.0, 5.0]
    assert estimate_log.missing == 2
    estimate_log.close()
    again = EstimateLog.resume(tmp_path / "part", 2)
    assert again.rows()[0].tolist() == [1, 2]
    again.remove()


def test_online_of_a_log_on_a_full_disk_ends_with_the_reason(tmp_path, monkeypatch, capsys):
    fill_disk(monkeypatch, 50)
    assert online("--rate", "max", "--out", tmp_path / "a.tum") == 2
    assert ".a.tum.part': No space left on device." in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("door", "remedy"),
    [("dds", "pip install 'skidloc[ros2]'"), ("rclpy", "source a ROS 2 installation"), ("rospy", "apt install python3-rospy")],
)
def test_transport_without_its_library_names_it(door, remedy, monkeypatch, capsys):
    """As where nothing of the extras can be imported, and the transport was not yet."""
    for name in ("cyclonedds", "cyclonedds.core", "rclpy", "rospy", "rosgraph"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, f"localization.ros.transports.{door}", raising=False)
    assert main(["online", "--robot", "vaultbot", "--door", door]) == 2
    assert remedy in " ".join(capsys.readouterr().err.split())


def test_hidden_files_of_a_killed_run_do_not_stop_the_next(tmp_path):
    """Hidden files beside the output, also links, of which nobody knows; the estimates are kept."""
    path, victim = tmp_path / ".a.tum.part", tmp_path / "victim"
    victim.write_text("precious")
    path.write_bytes(b"estimates")
    estimate_log = EstimateLog.create(path)
    estimate_log.add(Estimate(1, np.zeros(3), None, np.zeros(3), None))
    estimate_log.close()
    assert (tmp_path / ".a.tum.part.old").read_bytes() == b"estimates"
    path.unlink()
    path.symlink_to(victim)
    EstimateLog.create(path).remove()
    files = Files(out=tmp_path / "a.tum")
    (tmp_path / ".a.tum.new").symlink_to(victim)
    with files.beside() as beside:
        beside.write_text("whole")
    assert (tmp_path / "a.tum").read_text() == "whole"
    assert victim.read_text() == "precious"
