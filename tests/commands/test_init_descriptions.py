"""`skidloc init` beside descriptions as makers and forums have them: a row is a URDF, a controller and what is right."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from localization.cli import main
from motion_models.robot_file import load_robot
from tests.helpers.entrance_drives import Publishing, Vehicle, drive, write
from tests.helpers.extended import cases
from tests.helpers.urdf_texts import cylinder, link, urdf_of

ROBOT = Vehicle(seed=2)
NAMES = (*ROBOT.left, *ROBOT.right)
NUMBERED = replace(ROBOT, left=("wheel_1", "wheel_2"), right=("wheel_3", "wheel_4"))
LETTERS = replace(ROBOT, left=("FrontLeftWheel", "RearLeftWheel"), right=("FrontRightWheel", "RearRightWheel"))
MESH = '<visual><geometry><mesh filename="package://r/meshes/wheel.dae"/></geometry></visual>'
PLUGIN = (
    '<gazebo><plugin filename="{0}" name="d">'
    f"<left_joint>{NAMES[0]}</left_joint><left_joint>{NAMES[1]}</left_joint>"
    f"<right_joint>{NAMES[2]}</right_joint><right_joint>{NAMES[3]}</right_joint>"
    f"<wheel_separation>{{1}}</wheel_separation><wheel_radius>{ROBOT.radius}</wheel_radius></plugin></gazebo>"
)
CONTROLLER = f"""
joint_state_broadcaster:
  type: joint_state_broadcaster/JointStateBroadcaster
diff_drive_base_controller:
  ros__parameters:
    left_wheel_names: ["{NAMES[0]}", "{NAMES[1]}"]
    right_wheel_names: ["{NAMES[2]}", "{NAMES[3]}"]
    wheel_separation: {{0}}
    wheel_radius: {ROBOT.radius}
"""
FOOTPRINT = link("base_link") + '<joint name="b" type="fixed"><parent link="base_footprint"/><child link="base_link"/></joint>'
LYING = f'<collision><geometry><cylinder radius="{ROBOT.radius}" length="0.02"/></geometry></collision>'
TURNED = urdf_of(NUMBERED, (*NUMBERED.right, *NUMBERED.left))


@dataclass(frozen=True)
class Description:
    """One row."""

    urdf: str
    words: tuple[str, ...] = ()
    """In the output."""
    without: tuple[str, ...] = ()
    """Not in it."""
    how: Publishing = Publishing()  # noqa: RUF009 (frozen)
    vehicle: Vehicle = ROBOT
    controller: str = ""
    is_open: bool = False
    """Whether nothing in the log decides the sides."""


DESCRIPTIONS = {
    "wheels that are numbered": Description(urdf_of(NUMBERED, (*NUMBERED.left, *NUMBERED.right)), vehicle=NUMBERED),
    "numbered, the URDF turned about": Description(
        TURNED, ("left and right wheels are exchanged", "all wheels count backwards"), vehicle=NUMBERED, is_open=True
    ),
    "turned about, driver's odometry": Description(TURNED, ("left wheels",), how=Publishing(has_odometry=True), vehicle=NUMBERED),
    "camel case": Description(urdf_of(LETTERS, (*LETTERS.left, *LETTERS.right), children="{}Link"), vehicle=LETTERS),
    "base footprint as root": Description(urdf_of(ROBOT, NAMES, base="base_footprint", more=FOOTPRINT)),
    "axes to the right": Description(urdf_of(ROBOT, NAMES, axis="0 -1 0")),
    "frames of wheels turned": Description(urdf_of(ROBOT, NAMES, LYING, axis="0 0 1", rpy="-1.5708 0 0")),
    "gz plugin, meshes": Description(urdf_of(ROBOT, NAMES, MESH, PLUGIN.format("gz-sim-diff-drive-system", ROBOT.track))),
    "plugin of a wider track": Description(
        urdf_of(ROBOT, NAMES, more=PLUGIN.format("libgazebo_ros_diff_drive.so", 1.5 * ROBOT.track)),
        ("track_width_m",),
        how=Publishing(has_odometry=True),
    ),
    "radius twice": Description(urdf_of(ROBOT, NAMES, cylinder(2.0 * ROBOT.radius)), ("radius",), how=Publishing(has_odometry=True)),
    "controller with a broadcaster": Description(urdf_of(ROBOT, NAMES), without=("caster",), controller=CONTROLLER.format(ROBOT.track)),
    "controller's track wrong": Description(urdf_of(ROBOT, NAMES), ("track_width_m",), controller=CONTROLLER.format(1.4 * ROBOT.track)),
}
USUAL = ["numbered, the URDF turned about", "controller with a broadcaster", "radius twice"]


@pytest.mark.extended
@pytest.mark.parametrize("name", cases(list(DESCRIPTIONS), usual=USUAL))
def test_init_with_a_description_has_the_robots_lengths_and_sides(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    row = DESCRIPTIONS[name]
    log = write(tmp_path / "log.mcap", row.vehicle, drive(row.vehicle), row.how)
    (tmp_path / "robot.urdf").write_text(row.urdf)
    options = ["--urdf", str(tmp_path / "robot.urdf"), "--out", str(tmp_path / "r.toml")]
    if row.controller:
        (tmp_path / "control.yaml").write_text(row.controller)
        options += ["--controller", str(tmp_path / "control.yaml")]
    assert main(["init", str(log), *options]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert all(word in printed for word in row.words), printed
    assert not any(word in printed for word in row.without), printed
    robot = load_robot(tmp_path / "r.toml")
    found = robot.geometry.wheel_radius_m, robot.geometry.track_width_m, robot.geometry.wheelbase_m
    assert found == pytest.approx((row.vehicle.radius, row.vehicle.track, row.vehicle.wheelbase), rel=0.05)
    assert row.is_open or {*robot.joints.left} == {*row.vehicle.left}
