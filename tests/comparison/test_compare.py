"""Many logs: the same table for any number of processes and after any loss of one; calibrated statistics."""

from __future__ import annotations

import csv
import dataclasses
import html
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from scipy.stats import ttest_rel

from localization.cli import main
from localization.comparison import jobs as job_module
from localization.comparison.jobs import Job, failed_rows, job_key, run_job, run_local, trials
from localization.comparison.result_table import ResultTable
from localization.comparison.statistics import differences, means, sign_flip_p
from localization.errors import OutputError
from localization.logs import TopicOverrides
from localization.pipeline import ReplayConfig
from tests.helpers.compare import killing, logs, quick
from tests.helpers.online import ROBOT

pytestmark = pytest.mark.xdist_group("compare")


def jobs(count=3, estimators=("odometry",)):
    wanted = tuple(trials(["diff_drive"], estimators, ["none"]))
    nothing, config = TopicOverrides(), ReplayConfig()
    return [Job(str(path), ROBOT, wanted, job_key(str(path), ROBOT, None, nothing, config)) for path in logs(count)]


PAIRS = ("--model", "diff_drive", "--estimator", "odometry,ekf")


def compare(out, *arguments, of=None):
    chosen = logs(3) if of is None else of
    return main(["compare", *map(str, chosen), "--robot", "vaultbot", "--out", str(out), *PAIRS, *map(str, arguments)])


@pytest.fixture(autouse=True)
def asked(monkeypatch, table):
    """The jobs that were run, here and not in other processes, which take seconds to start."""
    found = []
    monkeypatch.setattr("localization.commands.compare.run_local", run_here(found))
    return found


def run_here(found):
    def run(jobs, processes):
        for job in jobs:
            found.append(job)
            yield job, run_job(job)

    return run


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    out = tmp_path_factory.mktemp("compare") / "table.csv"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("localization.commands.compare.run_local", run_here([]))
        assert compare(out, "--json", out.with_suffix(".json")) == 0
    return out


@pytest.mark.extended
def test_compare_numbers_are_those_of_replay(table, tmp_path):
    assert main(["replay", str(logs(3)[1]), "--robot", "vaultbot", *PAIRS, "--out", str(tmp_path / "replayed")]) == 0
    metrics = json.loads((tmp_path / "replayed" / "metrics.json").read_text())
    expected = {(r["model"], r["estimator"]): r for r in metrics["results"]}
    found = {(r["model"], r["estimator"]): r for r in rows_of(table) if r["log"] == str(logs(3)[1])}
    assert set(found) == set(expected)
    for name, row in found.items():
        assert float(row["ate_rmse_m"]) == expected[name]["ate_rmse_m"]
        assert float(row["nees_mean"]) == expected[name]["nees_mean"]
        assert row["status"] == "ok"


@pytest.mark.extended
def test_compare_table_does_not_depend_on_the_processes(table, tmp_path, monkeypatch):
    monkeypatch.setattr("localization.commands.compare.run_local", run_local)
    assert compare(tmp_path / "two.csv", "--processes", "2") == 0
    assert (tmp_path / "two.csv").read_bytes() == table.read_bytes()


@pytest.mark.extended
def test_compare_prints_means_and_differences(table, capsys, tmp_path):
    content = json.loads(table.with_suffix(".json").read_text())
    found = {m["name"]: m for m in content["means"]}
    assert set(found) == {"diff_drive odometry", "diff_drive ekf (constant)"}
    odometry = found["diff_drive odometry"]
    assert odometry["n"] == 3
    assert odometry["low"] <= odometry["mean"] <= odometry["high"]
    assert len(content["differences"]) == 1
    assert compare(tmp_path / "t.csv", "--estimator", "odometry", "--model", "diff_drive,skid_steer") == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert re.search(
        r"The difference of dead reckoning with (\w+) and dead reckoning with (\w+) is not significant: the first is better on \d of 3",
        printed,
    )
    assert "3 logs cannot show it: p is at least 0.25 for one pair. Take at least 6." in printed
    assert (tmp_path / "t.html").read_text().startswith("<!DOCTYPE html>")


@pytest.mark.extended
def test_compare_again_skips_finished_logs(table, tmp_path, asked, capsys):
    out = tmp_path / "table.csv"
    out.write_bytes(table.read_bytes())
    assert compare(out) == 0
    assert asked == []
    assert out.read_bytes() == table.read_bytes()
    assert "6 results are in" in capsys.readouterr().out
    # a log more: it alone is run; another configuration: all
    assert compare(out, of=logs(4)) == 0
    assert [job.log for job in asked] == [str(logs(4)[3])]
    asked.clear()
    kept = [row for row in rows_of(out) if row["log"] != str(logs(4)[3])]
    assert kept == rows_of(table)
    assert compare(out, "--estimator", "odometry", "--config.step.wait-s", "0.2") == 0
    assert len(asked) == 3


@pytest.mark.slow
def test_compare_log_under_several_names_counts_once(table, tmp_path, monkeypatch, capsys):
    copy, linked = tmp_path / "copy.mcap", tmp_path / "linked.mcap"
    copy.write_bytes(logs(3)[1].read_bytes())
    linked.symlink_to(logs(3)[2])
    monkeypatch.chdir(logs(3)[0].parent)
    otherwise = [os.path.join("..", logs(3)[0].parent.name, logs(3)[0].name), copy, linked]
    assert compare(tmp_path / "t.csv", of=[*logs(3), *otherwise, logs(3)[0]]) == 0
    assert (tmp_path / "t.csv").read_bytes() == table.read_bytes()
    printed = capsys.readouterr().out.splitlines()[:3]
    assert printed == [f"{other} is the same log as {first}: counted once." for other, first in zip(otherwise, logs(3), strict=True)]


@pytest.mark.extended
def test_compare_half_a_table_is_completed(table, tmp_path):
    lines = table.read_text().splitlines(keepends=True)
    out = tmp_path / "table.csv"
    out.write_text("".join(lines[:4]))  # the first log, and one of the second's two trials
    assert compare(out) == 0
    assert out.read_bytes() == table.read_bytes()


@pytest.mark.slow
def test_compare_broken_log_is_reported_and_the_others_finished(table, tmp_path, capsys):
    broken, absent = tmp_path / "broken.mcap", tmp_path / "absent.mcap"
    broken.write_bytes(logs(3)[0].read_bytes()[:40])
    assert compare(tmp_path / "t.csv", of=[broken, *logs(3), absent]) == 0
    rows = rows_of(tmp_path / "t.csv")
    assert [r["status"] for r in rows] == ["failed"] * 2 + ["ok"] * 6 + ["failed"] * 2
    assert "no such file" in rows[-1]["error"]
    printed = " ".join(capsys.readouterr().out.split())
    assert "absent.mcap" in printed
    assert "4 of 10 runs failed, on 2 logs." in printed
    report = (tmp_path / "t.html").read_text()
    assert "no such file" in report
    assert report.count("failed</td>") == 8
    assert {r["ate_rmse_m"] for r in rows[2:8]} == {r["ate_rmse_m"] for r in rows_of(table)}
    assert compare(tmp_path / "u.csv", of=[absent]) == 2
    assert "none of 1 logs could be compared" in " ".join(capsys.readouterr().err.split())


@pytest.mark.extended
def test_compare_warnings_of_a_log_are_reported(tmp_path, capsys):
    """A truncated log counts, and is reported beside the means."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(logs(1)[0].read_bytes()[:-4000])
    assert compare(tmp_path / "t.csv", of=[cut, *logs(1)]) == 0
    by_log = {row["log"]: row["notes"] for row in rows_of(tmp_path / "t.csv")}
    assert by_log[str(logs(1)[0])] == ""
    assert by_log[str(cut)]
    assert html.escape(by_log[str(cut)]) in (tmp_path / "t.html").read_text()
    capsys.readouterr()
    assert compare(tmp_path / "t.csv", "--json", tmp_path / "t.json", of=[cut, *logs(1)]) == 0  # and it is read again
    told, page = capsys.readouterr().out, (tmp_path / "t.html").read_text()
    (line,) = [line for line in told.splitlines() if line.startswith("! ")]
    damage = json.loads((tmp_path / "t.json").read_text())["damaged"][str(cut)]
    assert re.search(r"messages of it are used; of its last \d+ bytes only what is whole could be read", damage)
    assert line == f"! {cut}: {damage}"
    for text in (told, page):
        assert "1 log is not whole: what could be read counts as much as a whole drive." in text


def test_compare_bug_in_one_log_does_not_stop_the_others(monkeypatch):
    def bug(*arguments):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(job_module, "replay", bug)
    rows = run_job(jobs(1)[0])
    assert {row["error"] for row in rows} == {"ZeroDivisionError: a bug"}


@pytest.mark.extended
def test_compare_worker_in_another_folder_finds_the_given_paths(tmp_path, monkeypatch):
    """As those of a cluster: log and reference are relative to the folder of the command."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run.mcap").symlink_to(logs(1)[0])
    (tmp_path / "run.tum").write_text("".join(f"{t} 0 0 0 0 0 0 1\n" for t in range(2, 20)))
    monkeypatch.chdir(tmp_path)
    asked = [dataclasses.replace(jobs(1)[0], log="run.mcap", reference=reference) for reference in (None, "{stem}.tum")]
    found = [run_job(job) for job in asked]
    monkeypatch.chdir("elsewhere")
    assert [run_job(job) for job in asked] == found
    assert [(row["log"], row["status"], row["n_reference"]) for (row,) in found] == [("run.mcap", "ok", 539), ("run.mcap", "ok", 18)]


@pytest.mark.extended
def test_compare_killed_process_loses_no_other_log(table):
    """The second log always kills its process, the third does it once."""
    found = {job.log: rows for job, rows in run_local(jobs(3), 1, killing)}
    first, second, third = (found[str(path)] for path in logs(3))
    assert "killed by signal 9, 2 times over" in second[0]["error"]
    assert [row["status"] for row in (*first, *second, *third)] == ["ok", "failed", "ok"]
    expected = {(r["log"], r["model"]): float(r["ate_rmse_m"]) for r in rows_of(table) if r["estimator"] == "odometry"}
    assert all(row["ate_rmse_m"] == expected[row["log"], row["model"]] for row in (*first, *third))


@pytest.mark.extended
def test_compare_interrupted_leaves_no_process():
    running = run_local(jobs(2), 1, quick)
    next(running)
    running.close()
    children = subprocess.run(["ps", "--ppid", str(os.getpid()), "-o", "args="], capture_output=True, text=True).stdout
    assert "spawn_main" not in children
    assert list(run_local([], 2)) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--estimator", "magic"], "no estimator 'magic'"),
        (["--model", "magic"], "magic"),
        (["--model", ""], "--model is ''"),
        (["--config.step.max-step-s", "0"], "max_step_s of StepConfig is 0"),
        (["--out", "table.txt"], "must end in .csv or .parquet"),
        (["--robot", "nobody"], "nobody"),
        (["--processes", "-3"], "--processes is -3"),
    ],
)
def test_compare_bad_arguments_are_refused(arguments, message, tmp_path, capsys):
    assert compare(tmp_path / "t.csv", *arguments) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert "Traceback" not in shown


@pytest.mark.parametrize("metric", ["beauty", "log", "notes", "corrections"])
def test_compare_unknown_or_text_metrics_are_refused(metric, table, capsys):
    assert compare(table, "--metric", metric) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert f"no result has a number '{metric}'" in printed
    assert "ate_rmse_m" in printed


def test_compare_file_that_is_no_table_is_not_overwritten(tmp_path, capsys):
    for content in (b"precious,data\n1,2\n", b"", b"\x89MCAP0\r\n\x00\x01\xff"):
        (tmp_path / "t.csv").write_bytes(content)
        assert compare(tmp_path / "t.csv") == 2
        assert (tmp_path / "t.csv").read_bytes() == content
        assert "is not a table of a comparison" in capsys.readouterr().err


@pytest.mark.extended
def test_compare_parquet_equals_csv_and_is_continued(table, tmp_path, asked):
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'parquet' is not installed")
    out = tmp_path / "table.parquet"
    assert compare(out, of=logs(2)) == 0
    assert compare(out) == 0  # a log more: it alone is run
    assert [job.log for job in asked] == [str(path) for path in logs(3)]
    asked.clear()
    content = out.read_bytes()
    assert compare(out) == 0
    assert asked == []
    assert out.read_bytes() == content
    found = parquet.read_table(out)  # as others read it
    for row, expected in zip(found.to_pylist(), rows_of(table), strict=True):
        assert {name: "" if value is None else str(value) for name, value in row.items()} == expected  # floats to the last digit
    assert str(found.schema.field("ate_rmse_m").type) == "double"
    assert str(found.schema.field("n_matched").type) == "int64"
    assert str(found.schema.field("error").type) == "string"
    assert (tmp_path / "table.html").exists()


def test_compare_parquet_with_failures_is_read_again(tmp_path):
    pytest.importorskip("pyarrow", reason="the extra 'parquet' is not installed")
    job = jobs(2)
    out = ResultTable(tmp_path / "t.parquet")
    out.put([row for j in job for row in failed_rows(j, "why", "process")])
    out.save(job)  # no number yet
    assert [row["error"] for row in ResultTable(tmp_path / "t.parquet").rows(job)] == ["why"] * 2
    out.put([dict(row, status="ok", ate_rmse_m=0.1, n_matched=3) for row in out.rows(job)[:1]])
    out.save(job)
    again = ResultTable(tmp_path / "t.parquet").rows(job)
    assert again == [dict(row, ate_rmse_m=row.get("ate_rmse_m"), n_matched=row.get("n_matched")) for row in out.rows(job)]
    for content in (b"nonsense", b"PAR1" + bytes(20) + b"PAR1", out.path.read_bytes()[:-9]):
        (tmp_path / "u.parquet").write_bytes(content)
        with pytest.raises(OutputError, match=r"u\.parquet"):
            ResultTable(tmp_path / "u.parquet")


def test_compare_parquet_without_its_extra_names_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert compare(tmp_path / "t.parquet") == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert "pip install 'skidloc[parquet]'" in printed
    assert "Or name a .csv." in printed


def test_compare_folder_gets_table_and_report(table, tmp_path, capsys):
    out = tmp_path / "results"
    assert compare(out) == 0
    assert sorted(path.name for path in out.iterdir()) == ["report.html", "table.csv"]
    assert (out / "table.csv").read_bytes() == table.read_bytes()
    report = (out / "report.html").read_bytes()
    assert compare(out) == 0
    assert (out / "report.html").read_bytes() == report
    capsys.readouterr()
    (out / "report.html").write_text("<title>Replay of a log</title>")
    assert compare(out) == 2
    assert "is not a report of a comparison" in capsys.readouterr().err
    assert (out / "report.html").read_text() == "<title>Replay of a log</title>"


def made_up(table):
    """Rows of numbers: {combination: {log: value}}."""
    return [
        {"log": log, "model": name, "estimator": "ekf", "corrections": "", "status": "ok", "score": value}
        for name, values in table.items()
        for log, value in values.items()
    ]


def test_bootstrap_intervals_cover_the_mean_at_the_stated_rate():
    rng = np.random.default_rng(7)
    hits = 0
    for _ in range(200):
        (mean,) = means(made_up({"a": {str(i): v for i, v in enumerate(rng.gamma(4.0, 1.0, 20))}}), "score")
        hits += mean.low <= 4.0 <= mean.high
    assert 0.87 < hits / 200 < 0.98  # percentile intervals of 20 skewed numbers are a little short


def test_p_values_are_uniform_without_a_difference_and_small_with_one():
    rng = np.random.default_rng(3)
    p = np.array([sign_flip_p(rng.normal(size=8), rng) for _ in range(400)])
    assert np.mean(p <= 0.05) == pytest.approx(0.047, abs=0.035)
    assert np.mean(p <= 0.5) == pytest.approx(0.5, abs=0.08)
    off = rng.normal(0.5, 1.0, 40)
    assert sign_flip_p(off, rng) == pytest.approx(ttest_rel(off, np.zeros(40)).pvalue, abs=0.01)  # another test of the same
    assert sign_flip_p(np.full(5, 1.0), rng) == 2.0 / 2**5  # exact
    assert sign_flip_p(np.zeros(4), rng) == 1.0


def test_differences_are_paired_and_corrected():
    rng = np.random.default_rng(5)
    hard = rng.gamma(2.0, 5.0, 12)  # logs differ far more than models do
    a = {str(i): float(h) for i, h in enumerate(hard)}
    b = {str(i): float(h + 0.5 + 0.05 * rng.normal()) for i, h in enumerate(hard)}
    c = {str(i): float(h + 0.5 * rng.normal()) for i, h in enumerate(hard)}
    found = differences(made_up({"b": b, "a": a, "c": c}), "score")
    first = found[0]
    assert (first.better, first.worse, first.n) == ("a ekf", "b ekf", 12)
    assert first.mean == pytest.approx(np.mean([b[log] - a[log] for log in a]))
    assert 0.4 < first.low < first.mean < first.high < 0.6
    assert first.p_value == pytest.approx(3 * 2.0 / 2**12)  # Holm: times three
    assert [d.p_value for d in found] == sorted(d.p_value for d in found)
    missing = differences(made_up({"a": {"1": 1.0, "2": 2.0}, "b": {"2": 3.0}}), "score")
    assert missing == []  # one log in common


def test_key_changes_with_each_input_of_the_results(tmp_path):
    path, other = logs(2)
    keys = {job_key(str(path), ROBOT, None, TopicOverrides(), ReplayConfig())}
    keys.add(job_key(str(other), ROBOT, None, TopicOverrides(), ReplayConfig()))
    keys.add(job_key(str(path), dataclasses.replace(ROBOT, name="other"), None, TopicOverrides(), ReplayConfig()))
    keys.add(job_key(str(path), ROBOT, "/ground_truth/odom", TopicOverrides(), ReplayConfig()))
    keys.add(job_key(str(path), ROBOT, None, TopicOverrides(imu=""), ReplayConfig()))
    reference = tmp_path / "drive_0.tum"
    for content in ("1 0 0 0 0 0 0 1\n", "2 0 0 0 0 0 0 1\n"):
        reference.write_text(content)
        keys.add(job_key(str(path), ROBOT, str(tmp_path / "{stem}.tum"), TopicOverrides(), ReplayConfig()))
    assert len(keys) == 7
    moved = dataclasses.replace(ROBOT, folder=tmp_path)
    assert job_key(str(path), moved, None, TopicOverrides(), ReplayConfig()) in keys


def start(*command):
    return subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def read_until(process, pattern, seconds=90.0):
    end, printed = time.monotonic() + seconds, ""
    while time.monotonic() < end:
        line = process.stdout.readline()
        printed += line
        if (found := re.search(pattern, line)) is not None:
            return found
        if not line and process.poll() is not None:
            break
    pytest.fail(printed)


@pytest.fixture(scope="module")
def cluster():
    """Address of a Dask scheduler, its process, and those of two workers. The tests end one process after the other."""
    pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    options = ("--host", "127.0.0.1", "--no-dashboard")
    scheduler = (sys.executable, "-m", "distributed.cli.dask_scheduler", *options, "--port", address.rsplit(":", 1)[1])
    worker = (sys.executable, "-m", "distributed.cli.dask_worker", address, *options, "--nthreads", "1", "--no-nanny")
    processes = [start(*command) for command in (scheduler, worker, worker)]  # workers wait for the scheduler
    try:
        for process in processes[1:]:
            read_until(process, "Registered to")
        yield address, processes[0], processes[1:]
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


def compare_until_a_log_is_done(out, address):
    """The command, running, when the first log is in its table."""
    command = ("compare", *logs(3), "--robot", "vaultbot", "--out", out, *PAIRS, "--dask", address)
    running = start(sys.executable, "-m", "localization.cli", *command)
    end = time.monotonic() + 120.0
    while not out.exists() and time.monotonic() < end and running.poll() is None:
        time.sleep(0.02)
    return running


@pytest.mark.slow
def test_dask_killed_worker_gives_the_same_table(table, tmp_path, cluster):
    out = tmp_path / "table.csv"
    address, _, workers = cluster
    running = compare_until_a_log_is_done(out, address)
    workers[0].send_signal(signal.SIGKILL)
    printed = running.communicate(timeout=120)[0]
    assert running.returncode == 0, printed
    assert out.read_bytes() == table.read_bytes()


@pytest.mark.slow
def test_dask_lost_scheduler_ends_the_comparison_and_keeps_results(table, tmp_path, asked, cluster):
    out = tmp_path / "table.csv"
    address, scheduler, workers = cluster
    workers[0].kill()  # with one worker, other logs are not done when the first is
    running = compare_until_a_log_is_done(out, address)
    scheduler.send_signal(signal.SIGKILL)
    printed = running.communicate(timeout=120)[0]
    assert running.returncode == 2, printed
    assert re.fullmatch(
        rf"skidloc: the Dask scheduler at {address} went away \(.+\)\. What was done is kept: run the same again\.\n", printed
    )
    done = rows_of(out)
    assert 0 < len(done) < 6
    assert all(row in rows_of(table) for row in done)
    assert not out.with_suffix(".html").exists()
    assert compare(out) == 0
    assert not {job.log for job in asked} & {row["log"] for row in done}
    assert out.read_bytes() == table.read_bytes()


@pytest.mark.extended
def test_dask_missing_scheduler_is_refused(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    monkeypatch.setattr("localization.comparison.jobs.CONNECT_TIMEOUT_S", 1.0)
    for address in ("tcp://127.0.0.1:1", "nonsense", "nonsense://x:1", "tcp://127.0.0.1"):
        assert compare(tmp_path / "t.csv", "--dask", address) == 2
        printed = " ".join(capsys.readouterr().err.split())
        assert f"no Dask scheduler answers at {address}" in printed or f"'{address}' is not an address" in printed
        assert "Traceback" not in printed


def test_dask_missing_extra_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert compare(tmp_path / "t.csv", "--dask", "tcp://127.0.0.1:1") == 2
    assert "pip install 'skidloc[dask]'" in " ".join(capsys.readouterr().err.split())
