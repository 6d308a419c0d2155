"""k of a robot without a calibration, as replay, compare and online print and write it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from localization.cli import main
from tests.helpers import bags

START, STEP_NS = 1_700_000_000_000_000_000, 20_000_000
NOTE = "bare: [models.skid_steer] has no k_0, so k = 0.66 +- 0.07 from geometry; 20 s of turning make it +- 0.02"
ROBOT = """
name = "bare"
[geometry]
wheel_radius_m = 0.098
track_width_m = 0.37559
wheelbase_m = 0.262
mass_kg = 16.5
"""


@pytest.fixture
def inputs(tmp_path: Path) -> tuple[str, str]:
    """A log of 5 s of wheels, and a robot without coefficients."""
    (tmp_path / "bare.toml").write_text(ROBOT)
    stamps = [START + i * STEP_NS for i in range(250)]
    records = [("/joint_states", bags.joint_state(s, velocity=[2.0, 3.0, 2.0, 3.0]), s) for s in stamps]
    records += [("/truth", bags.pose_stamped(s, 0.1 * i), s) for i, s in enumerate(stamps)]
    return str(bags.write_mcap(tmp_path / "drive.mcap", sorted(records, key=lambda r: r[2]))), str(tmp_path / "bare.toml")


def test_replay_of_an_uncalibrated_robot_writes_its_prior(
    inputs: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, robot = inputs
    assert main(["replay", log, "--robot", robot, "--estimator", "odometry", "--out", str(tmp_path / "out")]) == 0
    assert NOTE in capsys.readouterr().out
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["notes"][0].startswith(NOTE)
    assert metrics["k_prior"]["k"] == pytest.approx(0.661, abs=0.001)
    assert metrics["k_prior"]["sigma_after_turning"] < metrics["k_prior"]["sigma"] / 3
    assert NOTE in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.extended
def test_compare_of_an_uncalibrated_robot_reports_its_prior(
    inputs: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, robot = inputs
    arguments = ["compare", log, "--robot", robot, "--estimator", "odometry", "--reference", "/truth", "--processes", "1"]
    assert main([*arguments, "--out", str(tmp_path / "out"), "--json", str(tmp_path / "c.json")]) == 0
    assert NOTE in capsys.readouterr().out
    assert json.loads((tmp_path / "c.json").read_text())["notes"][0].startswith(NOTE)
    assert NOTE in (tmp_path / "out" / "report.html").read_text().replace("\N{NO-BREAK SPACE}", " ")


def test_online_of_an_uncalibrated_robot_prints_its_prior(inputs: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    log, robot = inputs
    assert main(["online", log, "--robot", robot, "--estimator", "odometry", "--rate", "max"]) == 0
    assert NOTE in capsys.readouterr().out
    assert main(["online", log, "--robot", robot, "--estimator", "odometry", "--model", "diff_drive", "--rate", "max"]) == 0
    assert "from geometry" not in capsys.readouterr().out
