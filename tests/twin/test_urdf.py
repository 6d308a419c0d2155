"""URDFs as MJCF: what is converted, and what is named as left out."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="needs the extra 'twin'")

from localization.twin.numbers import read_simulator
from localization.twin.urdf import is_urdf, mjcf_of_urdf
from motion_models.robot_file import load_robot

VAULTBOT = Path(__file__).parents[2] / "motion_models/robots/vaultbot.urdf"


def test_urdf_of_vaultbot_weighs_and_stands_as_its_robot() -> None:
    robot = load_robot("vaultbot")
    mjcf, notes = mjcf_of_urdf(VAULTBOT, robot)
    numbers = read_simulator(mjcf, robot).numbers
    assert numbers.mass_kg == pytest.approx(robot.geometry.mass_kg, rel=1e-3)
    assert numbers.track_m == pytest.approx(robot.geometry.track_width_m, rel=1e-3)
    assert numbers.radius_m == pytest.approx(robot.geometry.wheel_radius_m)
    assert any("no shape to touch with" in note for note in notes)


def test_what_is_gazebos_is_named_as_not_converted(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    text = VAULTBOT.read_text().replace("</robot>", "<gazebo reference='x'><mu1>1</mu1></gazebo></robot>")
    path.write_text(text)
    assert is_urdf(path)
    _, notes = mjcf_of_urdf(path, load_robot("vaultbot"))
    assert any("<gazebo>" in note for note in notes)
