"""Blind diagnoses of drives by MuJoCo's physics: a few of `tests.studies.mujoco_blind`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")

from localization.diagnosis.diagnose import examine
from localization.diagnosis.drive import drive_of_log
from localization.logs import open_log
from localization.simulation.sensors import SensorConfig
from localization.simulation.simulator import SimulationConfig, write_simulation
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from tests.helpers.diagnosis_drives import drive
from tests.helpers.mujoco_vehicle import MujocoSimulation
from tests.studies.mujoco_blind import diagnose_mujoco, healthy
from tests.studies.nulls import Null


@pytest.mark.extended
def test_diagnose_mujoco_hidden_cause_is_named() -> None:
    cause, size = "lidar_offset_x", 0.05
    found = diagnose_mujoco("husky_a200", "40s", {cause: size}, 7, healthy("husky_a200", drive("tour"))).diagnosis
    first = found.findings[0]
    named = {first.cause: first.size, **dict(first.aliases)}
    assert cause in named
    assert named[cause] == pytest.approx(size, rel=0.3)


@pytest.mark.slow
def test_diagnose_mujoco_height_of_the_cg_is_named_on_a_level_floor() -> None:
    """The centripetal force of curves shifts loads; without the height as a candidate a track 155 mm wider was named."""
    found = diagnose_mujoco("husky_a200", "tour", {"cg_height": 0.2}, 7312, healthy("husky_a200")).diagnosis
    (only,) = found.findings
    assert only.cause == "cg_height"
    assert abs(only.size - 0.2) < 3.0 * only.sigma


@pytest.mark.slow
@pytest.mark.parametrize("shift_m", [0.0, 0.02])
def test_diagnose_stiff_contacts_nothing_wrong_or_the_right_shift(tmp_path: Path, shift_m: float) -> None:
    """MuJoCo's contacts are eight times as stiff as the file's: a healthy Jackal is consistent, and a CG that lies farther ahead is found
    about stiff contacts, at its size. Poses are MuJoCo's own with noise of 1 mm and 0.5 mrad in each window."""
    robot, sigmas, path = load_robot("jackal"), np.array([1e-3, 1e-3, 5e-4]), tmp_path / "drive.mcap"
    config = SimulationConfig(sensors=SensorConfig(lidar="none"))
    write_simulation(path, MujocoSimulation(drive("tour"), robot, 5, {"cg_offset_x": shift_m} if shift_m else {}, config))
    exact = drive_of_log(open_log(path, robot), "reference", "/ground_truth/odom", reference_sigmas=(7e-4, 3.5e-4))  # of each end
    noise = sigmas * np.random.default_rng(5).normal(size=(len(exact.maneuvers), 1, 3))
    measured = (dataclasses.replace(m, measured=se2.compose(m.measured, e)) for m, e in zip(exact.maneuvers, noise, strict=True))
    found = examine(dataclasses.replace(exact, maneuvers=tuple(measured)), make_model("friction", robot))
    if not shift_m:
        assert (found.diagnosis.verdict, found.diagnosis.findings) == ("consistent", ())
        return
    assert found.predictor is not None
    assert found.predictor.unmodelled.log_stiffness > 0.0
    first, *others = found.diagnosis.findings
    assert not others
    sizes = {first.cause: first.size, **dict(first.aliases)}
    assert sizes["cg_offset_x"] == pytest.approx(shift_m, rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("number", [1001, 1009])
def test_diagnose_creeping_contacts_of_a_healthy_robot_are_consistent(number: int) -> None:
    """Friction that grows to 0.15 m/s of slip: about the file's contacts a Warthog's wheels would shrink by 1 %, and a Husky's be late."""
    drive_of_null = Null(number).drive()
    found = examine(drive_of_null, make_model("friction", drive_of_null.robot))
    assert found.predictor is not None
    assert found.predictor.unmodelled.stiffness_exponent == 1.0
    assert (found.diagnosis.verdict, found.diagnosis.findings) == ("consistent", ())
