"""An offset of the centre of gravity: found, written where every source of that number passes, and better on another drive."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from localization.commands.diagnose import Diagnose
from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import drive_of_log
from localization.diagnosis.linearization import make_predictor
from localization.events import CgSample
from localization.logs import open_log
from localization.simulation.experiments import ExperimentConfig
from localization.simulation.scanners import ScannerConfig
from localization.simulation.sensors import ImuConfig, SensorConfig
from localization.simulation.simulator import Simulation, SimulationConfig, write_simulation
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.benchmarks.diagnosis import drive_of
from tests.helpers.diagnosis_drives import TYPICAL, drive, robot_named
from tests.studies.sensitivity import hidden

_OFFSET_M = 0.02


def record(path: Path, robot: str, route: str, seed: int, offset_m: float, has_topic: bool) -> Path:
    """A log in which the centre of gravity lies ``offset_m`` farther ahead than its source has it."""
    sensors = SensorConfig(scanner=ScannerConfig(beams=121), imu=ImuConfig(rate_hz=50.0), center_of_gravity=has_topic)
    config = SimulationConfig(experiment=ExperimentConfig(laps=1, payload_kg=0.0), sensors=sensors)
    effects = {"cg_offset_x": offset_m} if offset_m else {}
    write_simulation(path, Simulation(drive(route), robot_named(robot), seed, effects, config))
    return path


@pytest.mark.parametrize(("robot", "has_topic", "source"), [("vaultbot", True, "topic"), ("vaultbot", False, "arms")])
def test_offset_moves_the_center_of_gravity_of_topic_and_arms(tmp_path: Path, robot: str, has_topic: bool, source: str) -> None:
    log = record(tmp_path / "drive.mcap", robot, "5s", 1, 0.0, has_topic)
    plain = load_robot(robot)
    moved = dataclasses.replace(plain, geometry=dataclasses.replace(plain.geometry, cg_offset_x_m=0.02, cg_offset_y_m=-0.01))
    found = [[e.position for e in open_log(log, r).events() if isinstance(e, CgSample)] for r in (plain, moved)]
    assert len(found[0]) == len(found[1]) > 0
    np.testing.assert_allclose(np.array(found[1]) - np.array(found[0]), [[0.02, -0.01]] * len(found[0]), atol=1e-12)
    np.testing.assert_allclose(moved.center_of_gravity - plain.center_of_gravity, [0.02, -0.01])
    assert drive_of_log(open_log(log, moved)).cg_source == source


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "has_topic"), [("vaultbot", True), ("vaultbot", False), ("husky_a200", True), ("husky_a200", False)])
def test_diagnose_offset_is_written_and_removed_from_another_drive(tmp_path: Path, robot: str, has_topic: bool) -> None:
    """Whatever the source of the centre of gravity is; three quarters of the heading's discrepancies at least."""
    log = record(tmp_path / "drive.mcap", robot, "tour", 61, _OFFSET_M, has_topic)
    Diagnose(log, robot, out=tmp_path / "out", static=True).run(Console(file=(tmp_path / "printed.txt").open("w")))
    written = load_robot(tmp_path / "out" / "robot.toml")
    other = record(tmp_path / "other.mcap", robot, "random_62", 62, _OFFSET_M, has_topic)
    rms = []
    for r in (load_robot(robot), written):
        predictor = make_predictor(drive_of_log(open_log(other, r)), make_model("friction", r))
        rms.append(float(np.sqrt(np.nanmean(predictor.discrepancies(Hypothesis())[:, 2] ** 2))))
    assert rms[1] < 0.25 * rms[0], (tmp_path / "printed.txt").read_text()


@pytest.mark.extended
def test_cg_that_looks_like_other_contacts_about_the_robot_file_has_its_name(tmp_path: Path) -> None:
    """30 mm of a Jackal's wheelbase of 262 mm: slips of other contacts explain it about the robot file, and it explains more."""
    measured = drive_of(hidden(list(TYPICAL).index("cg_offset_x"), 1.0), tmp_path)
    found = examine(measured, make_model("friction", measured.robot)).diagnosis
    assert [finding.cause for finding in found.findings] == ["cg_offset_x"]
    assert found.findings[0].size == pytest.approx(-0.03, abs=3.0 * found.findings[0].sigma)
    assert found.is_confirmed
