"""SDFs and URDFs: their rigid bodies and wheels, and MJCF of them with what is left out named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'twin'")

from localization.errors import SimulationError
from localization.twin.gazebo_file import read_gazebo, wheel_centre
from localization.twin.gazebo_mjcf import mjcf_of_gazebo
from localization.twin.mujoco_simulator import read_simulator
from localization.twin.robot_mjcf import mjcf_of
from localization.twin.robot_sdf import sdf_of
from localization.twin.xml_file import XmlFile, load, parse
from motion_models.robot_file import load_robot

VAULTBOT = Path(__file__).parents[2] / "motion_models/robots/vaultbot.urdf"
HUSKY = load_robot("husky_a200")


def edited(old: str, new: str) -> XmlFile:
    text = sdf_of(HUSKY).files["husky_a200.sdf"].decode()
    assert old in text
    return parse({"husky_a200.sdf": text.replace(old, new).encode()}, Path("husky_a200.sdf"), "sdf")


def test_urdf_of_vaultbot_weighs_and_stands_as_its_robot() -> None:
    robot = load_robot("vaultbot")
    mjcf, notes = mjcf_of_gazebo(load(VAULTBOT), robot)
    numbers = read_simulator(mjcf, robot).numbers
    assert numbers.mass_kg == pytest.approx(robot.geometry.mass_kg, rel=1e-3)
    assert numbers.track_m == pytest.approx(robot.geometry.track_width_m, rel=1e-3)
    assert numbers.radius_m == pytest.approx(robot.geometry.wheel_radius_m)
    assert any("no round shape to touch with" in note for note in notes)


def test_sdf_of_robot_has_the_numbers_of_its_mjcf() -> None:
    from_sdf = read_simulator(mjcf_of_gazebo(sdf_of(HUSKY), HUSKY)[0], HUSKY).numbers
    usual = read_simulator(mjcf_of(HUSKY), HUSKY).numbers
    for name in ("mass_kg", "cg_x_m", "cg_y_m", "cg_z_m", "radius_m", "track_m", "wheelbase_m"):
        assert getattr(from_sdf, name) == pytest.approx(getattr(usual, name), abs=2e-4), name


def test_what_mujoco_does_not_have_is_named(tmp_path: Path) -> None:
    path = tmp_path / "r.urdf"
    path.write_text(VAULTBOT.read_text().replace("</robot>", "<gazebo reference='x'><mu1>1</mu1></gazebo></robot>"))
    _, notes = mjcf_of_gazebo(load(path), load_robot("vaultbot"))
    assert any("<mu1> are not converted" in note for note in notes)


def test_poses_follow_the_frames_that_they_are_relative_to() -> None:
    """The same robot with its wheels placed by a frame that is turned and moved."""
    frame = '<frame name="f" attached_to="base_link"><pose>0.1 0 0 0 0 1.5707963267948966</pose></frame>'
    x, y, r = 0.5 * HUSKY.geometry.wheelbase_m, 0.5 * HUSKY.geometry.track_width_m, HUSKY.geometry.wheel_radius_m
    file = edited(
        f'<pose relative_to="base_link">{x:.6g} {y:.6g} {r:.6g} 0 0 0</pose>',
        f'<pose relative_to="f">{y:.6g} {0.1 - x:.6g} {r:.6g} 0 0 -1.5707963267948966</pose>',
    )
    text = file.files["husky_a200.sdf"].decode().replace("</model>", frame + "</model>")
    source = read_gazebo(parse({"husky_a200.sdf": text.encode()}, Path("husky_a200.sdf"), "sdf"), HUSKY)
    centres = sorted((wheel_centre(w)[:2] for w in source.driven), key=lambda c: tuple(np.round(c, 3)))
    np.testing.assert_allclose(centres[-1], [x, y], atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="revolute"', 'type="fixed"', "no model with two revolute joints"),
        ("<mass>", "<mass>nan", "must be a finite number"),
        ('relative_to="base_link"', 'relative_to="nowhere"', "no frame 'nowhere'"),
        ("<child>", "<child>x", "no frame 'x"),
    ],
)
def test_sdf_that_cannot_be_used_is_refused_in_one_sentence(old: str, new: str, message: str) -> None:
    with pytest.raises(SimulationError, match=message):
        read_gazebo(edited(old, new), HUSKY)
