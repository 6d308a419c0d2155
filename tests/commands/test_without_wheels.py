"""Commands that need wheels end with exit code 2 on a log without, and name what its odometry is instead."""

from pathlib import Path

import pytest

from localization.cli import main
from localization.comparison.jobs import run_job
from tests.helpers import bags
from tests.helpers.bags import S

START = 1_700_000_000 * S


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of ground truth, scans and gyro, and no wheels."""
    records = []
    for i in range(40):
        stamp = START + i * S // 20
        truth = bags.odometry(stamp, x=0.05 * i, vx=1.0)
        records += [("/vrpn/robot/odom", truth, stamp), ("/scan", bags.laser_scan(stamp), stamp), ("/imu/data", bags.imu(stamp), stamp)]
    return bags.write_mcap(tmp_path_factory.mktemp("log") / "truth.mcap", records)


COMMANDS = {
    "replay": ("--model", "skid_steer", "--out"),
    "replay default": ("--out",),
    "replay with truth as reference": ("--reference", "/vrpn/robot/odom", "--model", "skid_steer", "--estimator", "ekf", "--out"),
    "compare": ("--reference", "/vrpn/robot/odom", "--model", "skid_steer", "--estimator", "odometry", "--out"),
    "calibrate": ("--model", "skid_steer", "--out"),
    "diagnose": (),
    "weigh": (),
    "check": (),
    "online": ("--rate", "max"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_command_without_wheels_ends_with_exit_code_2(
    command: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # in this process: another one takes seconds to start
    monkeypatch.setattr("localization.commands.compare.run_local", lambda jobs, processes: ((job, run_job(job)) for job in jobs))
    options = COMMANDS[command]
    out = [str(tmp_path / ("robot.toml" if command == "calibrate" else "out"))] if "--out" in options else []
    assert main([command.split()[0], str(log), "--robot", "husky_a200", *options, *out]) == 2
    shown = capsys.readouterr()
    assert "no wheels" in " ".join((shown.out + shown.err).split())
    assert "/vrpn/robot/odom is a reference" in " ".join((shown.out + shown.err).split())


def test_info_without_wheels_names_the_reference(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(log), "--robot", "husky_a200"]) == 0
    assert "/vrpn/robot/odom is a reference or another estimate by its name" in " ".join(capsys.readouterr().out.split())
