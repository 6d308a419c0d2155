"""Fleets: a manifest of logs, results that are kept log by log, and alarms where k of a robot has changed."""

from __future__ import annotations

import csv
import json
import sys

import numpy as np
import pytest
from scipy.stats import kstest

from localization.cli import main
from localization.comparison import remote
from localization.comparison.fleet import LEVEL, compare_k, fleet_table
from localization.comparison.jobs import failed_rows, run_job
from localization.comparison.result_table import read_results
from localization.comparison.turning import turning
from localization.errors import LogError
from motion_models.registry import MODELS, make_model
from motion_models.robot_file import load_robot
from tests.helpers.compare import logs

pytestmark = pytest.mark.xdist_group("compare")


def write_manifest(folder, rows, header=("log", "robot", "floor", "day")):
    path = folder / "logs.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


@pytest.fixture
def asked(monkeypatch):
    """Logs that were run, in this process."""
    found = []

    def run_here(jobs, processes):
        for job in jobs:
            found.append(job.log)
            yield job, run_job(job)

    monkeypatch.setattr("localization.commands.compare.run_local", run_here)
    return found


def compare(manifest, out, *arguments):
    return main(
        ["compare", "--manifest", str(manifest), "--out", str(out), "--model", "skid_steer", "--estimator", "odometry,ekf", *arguments]
    )


@pytest.mark.extended
def test_fleet_run_is_kept_by_log_and_resumed(tmp_path, asked, capsys):
    first, second = (str(path) for path in logs(2))
    (tmp_path / "bad.mcap").write_bytes(b"no log")
    rows = [(first, "vaultbot", "hall", "2026-11-01"), ("bad.mcap", "vaultbot", "hall", "2026-11-02")]
    manifest, out = write_manifest(tmp_path, rows), tmp_path / "fleet"
    assert compare(manifest, out) == 0
    assert asked == [first, "bad.mcap"]
    assert sorted(path.name for path in out.iterdir()) == ["report.html", "results", "table.csv", "trajectories"]
    tracks = sorted(path.name for path in out.glob("trajectories/vaultbot/drive_0-*/*"))
    assert tracks == ["skid_steer_ekf_constant.tum", "skid_steer_odometry.tum"]
    # again with another log: that alone is run, what cannot be read is not tried twice, and files of other logs are not touched
    kept = {path: path.stat().st_mtime_ns for path in out.glob("results/*/*")}
    asked.clear()
    write_manifest(tmp_path, [*rows, (second, "vaultbot", "hall", "")])
    assert compare(manifest, out) == 0
    assert asked == [second]
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    found = read_results(out)
    assert sorted({(row["log"], row["cause"]) for row in found}) == sorted([(first, ""), ("bad.mcap", "input"), (second, "")])
    assert {row["day"] for row in found if row["log"] == first} == {"2026-11-01"}
    capsys.readouterr()
    assert main(["table", str(out), "--json", str(tmp_path / "table.json")]) == 0
    printed = capsys.readouterr().out
    assert "1 log has no result" in printed
    days = json.loads((tmp_path / "table.json").read_text())["days"]
    assert [day["logs"] for day in days] == [1, 1]


def test_fleet_failed_process_is_run_again(tmp_path, monkeypatch, asked):
    manifest = write_manifest(tmp_path, [(str(logs(1)[0]), "vaultbot", "", "")])
    died = []

    def die(jobs, processes):
        for job in jobs:
            died.append(job)
            yield job, failed_rows(job, "its process died", "process")

    monkeypatch.setattr("localization.commands.compare.run_local", die)
    assert compare(manifest, tmp_path / "fleet") == 2
    assert compare(manifest, tmp_path / "fleet") == 2
    assert len(died) == 2


@pytest.mark.parametrize(
    ("header", "row", "message"),
    [
        (("path", "robot"), ("a.mcap", "vaultbot"), "has no column 'log'"),
        (("log", "robot"), ("a.mcap", ""), "line 2: no robot"),
        (("log", "robot"), ("", "vaultbot"), "line 2: no log"),
        (("log", "robot"), ("a.mcap", "nobody"), "no robot 'nobody'"),
        (("log", "robot"), ("s4://bucket/a.mcap", "vaultbot"), "Protocol not known: s4"),
        (("log",), ("a.mcap",), "--robot is not given"),
    ],
)
def test_fleet_bad_manifest_is_refused(header, row, message, tmp_path, capsys):
    assert compare(write_manifest(tmp_path, [row], header), tmp_path / "fleet") == 2
    assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.extended
def test_fleet_log_of_a_store_is_read_and_an_absent_one_named(tmp_path, asked, monkeypatch, capsys):
    fsspec = pytest.importorskip("fsspec")
    fsspec.filesystem("memory").pipe("/bucket/drive.mcap", logs(1)[0].read_bytes())
    rows = [("memory://bucket/drive.mcap", "vaultbot", "", ""), ("memory://bucket/no.mcap", "vaultbot", "", "")]
    assert compare(write_manifest(tmp_path, rows), tmp_path / "fleet") == 0
    assert "memory://bucket/no.mcap: log 'memory://bucket/no.mcap': the store has no such object." in capsys.readouterr().out
    there = read_results(tmp_path / "fleet")[0]
    assert (there["log"], there["status"]) == ("memory://bucket/drive.mcap", "ok")
    monkeypatch.setitem(sys.modules, "fsspec", None)
    assert compare(tmp_path / "logs.csv", tmp_path / "fleet") == 2
    assert "pip install 'skidloc[fleet]'" in " ".join(capsys.readouterr().err.split())


def test_store_that_fails_once_is_asked_again(monkeypatch):
    monkeypatch.setattr(remote, "_FIRST_PAUSE_S", 0.0)
    answers = iter([OSError("busy"), OSError("busy"), 7])

    def read():
        answer = next(answers)
        if isinstance(answer, OSError):
            raise answer
        return answer

    assert remote.repeated("s3://b/x", read) == 7

    def absent():
        raise FileNotFoundError

    with pytest.raises(LogError, match="no such object"):
        remote.repeated("s3://b/x", absent)


@pytest.mark.parametrize("name", MODELS)
def test_turning_of_each_model_is_that_of_its_twist(name):
    """Sigma by differences of the model's own corrections."""
    robot = load_robot("vaultbot")
    model, cg = make_model(name, robot), np.array([0.02, 0.01])
    plain = turning(model, robot, cg)
    vx, vy, wz = model.twist(np.array([-1.0, 1.0]), cg, model.nominal).value
    assert plain.k == pytest.approx(wz * robot.geometry.track_width_m / (2.0 * robot.geometry.wheel_radius_m))
    assert (plain.centre_x_m, plain.centre_y_m) == pytest.approx((-vy / wz, vx / wz))
    assert plain.k_sigma is None


def test_turning_learned_k_has_its_sigma():
    robot = load_robot("vaultbot")
    model = make_model("skid_steer", robot)
    found = turning(model, robot, np.zeros(2), "constant", {"k_0": (0.55, 0.01), "x_cr_0": (-0.1, 0.02), "y_cr_0": (0.03, 0.04)})
    assert found == pytest.approx((0.55, 0.01, -0.1, 0.02, 0.03, 0.04))


def test_change_of_k_p_value_is_uniform_without_a_change():
    """Monte Carlo, for two to eight logs before and one to four after."""
    rng = np.random.default_rng(5)
    p = []
    for _ in range(4000):
        n, m = rng.integers(2, 9), rng.integers(1, 5)
        k = 0.5 + 0.02 * rng.standard_normal(n + m)
        p.append(compare_k(k[:n], k[n:]).p_value)
    assert kstest(p, "uniform").pvalue > 0.01


def made_up_rows(rng, days, k, sigma=0.003):
    """Three logs a day; ``k`` by day."""
    base = {"model": "skid_steer", "estimator": "ekf", "status": "ok", "robot": "r", "floor": "hall", "cg_x_m": 0.0, "cg_y_m": 0.0}
    return [
        {
            **base,
            "log": f"{day}-{i}",
            "day": f"2026-11-{day + 1:02d}",
            "k": k(day) + sigma * rng.standard_normal(),
            "k_sigma": sigma,
            "centre_x_m": 0.0,
            "centre_y_m": 0.0,
            "faults": "at t = 3.2 s: the gyro turns by 9.1 rad/s against the wheels." if i == 0 else "",
        }
        for day in range(days)
        for i in range(3)
    ]


def test_fleet_table_alarms_on_a_change_of_four_percent_and_on_no_scatter():
    rng = np.random.default_rng(3)
    changed = fleet_table(made_up_rows(rng, 8, lambda day: 0.5 if day < 5 else 0.52))
    assert [day.day for day in changed.alarms] == ["2026-11-06"]
    assert changed.alarms[0].change.relative == pytest.approx(0.04, abs=0.015)
    assert changed.faults == [("r", "the gyro turns by ... rad/s against the wheels.", 8)]
    false = sum(bool(fleet_table(made_up_rows(rng, 8, lambda day: 0.5, sigma=0.02)).alarms) for _ in range(300))
    assert false <= 300 * LEVEL + 3.0 * np.sqrt(300 * LEVEL)


def test_fleet_table_short_turns_are_no_sample_of_k(tmp_path):
    rows = made_up_rows(np.random.default_rng(0), 3, lambda day: 0.5)
    rows[0]["k_sigma"] = 0.07
    found = fleet_table(rows)
    assert [(day.logs, day.learned) for day in found.days] == [(3, 2), (3, 3), (3, 3)]


def test_table_of_nothing_is_refused(tmp_path, capsys):
    assert main(["table", str(tmp_path)]) == 2
    assert "has no results of a comparison" in " ".join(capsys.readouterr().err.split())
    assert main(["table", str(tmp_path / "no")]) == 2
    assert "does not exist" in capsys.readouterr().err
