"""`skidloc simulate --engine mujoco`: a bag of a drive in the user's file, which replays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'twin'")

from localization.cli import main
from localization.errors import SimulationError
from localization.twin.mujoco_simulator import read_simulator
from localization.twin.robot_mjcf import mjcf_of
from localization.twin.simulated_drive import simulate_in_mujoco
from motion_models.registry import make_model
from motion_models.robot_file import load_robot

ROBOT = load_robot("husky_a200")


def test_drive_goes_through_mujoco_and_starts_where_the_experiment_does() -> None:
    """With the contact law its turns in place are those of the friction model, whose code moves nothing here."""
    simulator = read_simulator(mjcf_of(ROBOT), ROBOT)
    numbers = replace(simulator.numbers, mu=0.6, slip_stiffness=10.0, servo_gain=20.0 * simulator.numbers.servo_gain)
    lawful = read_simulator(simulator.with_numbers(numbers), ROBOT)
    assert lawful.numbers.slip_stiffness == pytest.approx(10.0)
    simulation = simulate_in_mujoco("laps", ROBOT, lawful)
    start = np.array(simulation.experiment.start)
    rates = np.array([[-2.0, 2.0]])
    first = simulation._move(np.arange(75) * simulation.config.vehicle.step_s, rates.repeat(75, axis=0))
    rows = simulation._move(np.arange(200) * simulation.config.vehicle.step_s, rates.repeat(200, axis=0))
    np.testing.assert_allclose(first[0, :2], start[:2], atol=0.01)
    model = make_model("friction", ROBOT)
    turned = rows[-1, 2] - rows[0, 2]
    angles = (rows[-1, 8:10] - rows[0, 8:10]) / (199 * simulation.config.vehicle.step_s)
    expected = model.twist(angles, ROBOT.center_of_gravity, model.nominal).value[2] * 199 * simulation.config.vehicle.step_s
    assert turned == pytest.approx(expected, rel=0.08)
    assert rows[-1, 5] == pytest.approx(turned / (199 * simulation.config.vehicle.step_s), rel=0.1)


def test_effects_of_the_body_are_refused() -> None:
    with pytest.raises(SimulationError, match="leave out effects of its body"):
        simulate_in_mujoco("laps", ROBOT, read_simulator(mjcf_of(ROBOT), ROBOT), 0, {"wheel_radius_scale": 0.02})


def test_file_without_its_engine_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "laps", "--robot", "husky_a200", "--simulator", "x.xml", "--out", str(tmp_path / "a.mcap")]) == 2
    assert "add --engine mujoco" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.slow
def test_bag_of_a_lap_in_mujoco_replays(tmp_path: Path) -> None:
    log, out = tmp_path / "lap.mcap", tmp_path / "replay"
    assert main(["simulate", "laps", "--robot", "husky_a200", "--engine", "mujoco", "--out", str(log)]) == 0
    assert main(["replay", str(log), "--robot", "husky_a200", "--out", str(out)]) == 0
    errors = {of["estimator"]: of["ate_rmse_m"] for of in json.loads((out / "metrics.json").read_text())["results"]}
    assert errors["ekf"] < 0.1 < errors["odometry"]
