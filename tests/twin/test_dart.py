"""A robot in DART: its turns, WheelSlip's linear limit, and numbers that are written and read again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("dartpy", reason="needs the extra 'gazebo'")

from localization.cli import main
from localization.twin.gazebo_simulator import read_gazebo_simulator
from localization.twin.robot_sdf import sdf_of
from localization.twin.windows import LEAD_S, Window
from localization.twin.xml_file import load
from motion_models.robot_file import load_robot

ROBOT = load_robot("husky_a200")
SIMULATOR = read_gazebo_simulator(sdf_of(ROBOT), ROBOT)
GRID = Path(__file__).parents[1] / "data" / "vaultbot" / "rotation_grid.csv"


def window(left: float, right: float, seconds: float = 0.6) -> Window:
    return Window(np.array([LEAD_S, seconds]), np.array([[left, right]] * 2), np.zeros(3), np.eye(3), np.zeros(2), "")


def test_straight_drive_goes_as_far_as_its_wheels_roll() -> None:
    played = SIMULATOR.engine.play([window(3.0, 3.0)])
    assert played.poses[0, 0] == pytest.approx(0.6 * 3.0 * ROBOT.geometry.wheel_radius_m, rel=0.01)
    assert played.touch.all_wheels == 1.0


def test_wheel_slip_below_its_limit_turns_as_a_linear_contact() -> None:
    """k = 1 / (1 + (wheelbase / track)^2), which no code of the engine has."""
    g = ROBOT.geometry
    numbers = replace(SIMULATOR.numbers, slip_stiffness=1.0, mu=3.0)
    played = SIMULATOR.compiled(numbers).play([window(-2.0, 2.0), window(2.0, -2.0)])
    ideal = 0.6 * 4.0 * g.wheel_radius_m / g.track_width_m
    k = 1.0 / (1.0 + (g.wheelbase_m / g.track_width_m) ** 2)
    np.testing.assert_allclose(played.poses[:, 2] / ideal, [k, -k], rtol=0.01)


def test_numbers_written_are_those_read_again() -> None:
    new = replace(
        SIMULATOR.numbers, mu=0.6, slip_stiffness=2.0, mass_kg=50.0, cg_x_m=0.03, cg_z_m=0.3, radius_m=0.98 * SIMULATOR.numbers.radius_m
    )
    file = SIMULATOR.with_numbers(replace(new, radius_m=SIMULATOR.numbers.radius_m, radius_scale=0.98))
    again = read_gazebo_simulator(file, ROBOT).numbers
    for name in ("mu", "slip_stiffness", "mass_kg", "cg_x_m", "cg_y_m", "radius_m"):
        assert getattr(again, name) == pytest.approx(getattr(new, name), rel=1e-4, abs=1e-6), name


@pytest.mark.extended
def test_command_mends_an_sdf_by_the_wheel_slip_plugin(tmp_path: Path) -> None:
    robot, out = load_robot("vaultbot"), tmp_path / "twin"
    file = sdf_of(robot)
    step = b"<world name='w'><physics name='p'><max_step_size>0.004</max_step_size></physics></world></sdf>"  # a quarter of the time
    (tmp_path / "vaultbot.sdf").write_bytes(file.files[file.name].replace(b"</sdf>", step))
    small = ["--config.windows", "3", "--config.held-windows", "6", "--config.budget-steps", "1000"]
    assert main(["twin", str(GRID), "--robot", "vaultbot", "--simulator", str(tmp_path / "vaultbot.sdf"), *small, "--out", str(out)]) == 0
    content = json.loads((out / "twin.json").read_text())
    slip = next(repair for repair in content["repairs"] if repair["name"] == "wheel slip")
    assert slip["is_better"]
    written = load(out / "wheel_slip" / "vaultbot.sdf")
    assert len(written.elements("wheel_normal_force")) == 4
    assert "DART" in (out / "report.html").read_text()
