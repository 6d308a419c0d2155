"""`skidloc init` where URDF, controller and log contradict each other: the log decides, and every source is named."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from localization.cli import main
from motion_models.robot import Robot, Topics
from motion_models.robot_file import load_robot
from tests.helpers.entrance_drives import Publishing, Vehicle, drive, write
from tests.helpers.urdf_texts import urdf_of

CASES = Path(__file__).parents[1] / "data" / "cases"
BASE_LOG = CASES / "base-log" / "log.mcap"


def init(tmp_path: Path, log: Path, *options: str) -> Robot:
    """The robot that `skidloc init` writes."""
    assert main(["init", str(log), "--out", str(tmp_path / "r.toml"), *options]) == 0
    return load_robot(tmp_path / "r.toml")


def case(tmp_path: Path, name: str) -> Robot:
    """The robot of a case's log and URDF."""
    return init(tmp_path, CASES / name / "log.mcap", "--urdf", str(CASES / name / "robot.urdf"))


@pytest.mark.extended
def test_init_with_names_against_positions_takes_the_logs_sides(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = case(tmp_path, "H01-urdf-names-against-sides")
    assert {*robot.joints.left} == {"front_left_wheel", "rear_left_wheel"}
    printed = capsys.readouterr().out
    assert "Contradictions" in printed
    assert "by the sides of the URDF's wheels" in printed
    assert "CONTRADICTION: left wheels = front_right_wheel" in (tmp_path / "r.toml").read_text()


@pytest.mark.extended
def test_init_with_plugin_against_joints_takes_what_the_log_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = case(tmp_path, "H02-urdf-plugin-contradicts-joints")
    assert (robot.geometry.track_width_m, robot.geometry.wheel_radius_m) == (0.35, 0.12)
    printed = capsys.readouterr().out
    assert "0.22 m" in printed
    assert "k = 0.43 by 0.35 m" in printed


def test_init_with_an_inverted_side_names_it_and_fits_the_radius(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = CASES / "H06-right-side-inverted" / "log.mcap"
    robot = init(tmp_path, log, "--track-width-m", "0.57", "--wheelbase-m", "0.51")
    assert robot.geometry.wheel_radius_m == pytest.approx(0.165, rel=0.02)
    assert robot.driver.wheel_separation_multiplier == pytest.approx(1.875, rel=0.02)
    assert robot.joints.reversed == ("front_right_wheel", "rear_right_wheel")
    assert "the right side (front_right_wheel, rear_right_wheel) is inverted" in capsys.readouterr().out


@pytest.mark.extended
def test_init_with_a_cg_beside_a_symmetric_robot_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    init(tmp_path, BASE_LOG, "--urdf", str(CASES / "H10-urdf-base-inertial-axes-swapped" / "robot.urdf"))
    printed = capsys.readouterr().out
    assert load_robot(tmp_path / "r.toml").geometry.cg_y_m == 0.0
    assert "8 cm off the middle of a symmetric robot (to the right): check" in printed
    assert "0.165 m (R^2" in printed  # the URDF has 0.1 m


_CONTROLLER = """
diff_drive_base_controller:
  ros__parameters:
    left_wheel_names: ["front_left_wheel", "rear_left_wheel"]
    right_wheel_names: ["front_right_wheel", "rear_right_wheel"]
    wheel_separation: 0.57
    wheel_radius: 0.165
    wheel_separation_multiplier: 1.8
"""


def test_init_with_a_controller_yaml_takes_its_parameters(tmp_path: Path) -> None:
    (tmp_path / "control.yaml").write_text(_CONTROLLER)
    robot = init(tmp_path, BASE_LOG, "--controller", str(tmp_path / "control.yaml"), "--wheelbase-m", "0.51")
    assert (robot.geometry.track_width_m, robot.geometry.wheel_radius_m) == (0.57, 0.165)
    assert (robot.driver.wheel_separation_multiplier, robot.joints.left) == (pytest.approx(1.8), ("front_left_wheel", "rear_left_wheel"))


@pytest.mark.parametrize("text", ["", "a: [", "a: {b: 1}", "- 1", "wheel_separation: wide"])
def test_init_with_a_yaml_without_controller_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.yaml").write_text(text)
    assert main(["init", str(BASE_LOG), "--out", str(tmp_path / "r.toml"), "--controller", str(tmp_path / "c.yaml")]) == 2
    assert capsys.readouterr().err.count("--controller") == 1


def test_cg_of_a_urdf_with_swapped_axes_has_a_wide_sigma(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = CASES / "H10-urdf-base-inertial-axes-swapped" / "robot.urdf"
    assert main(["cg", "--robot", "husky_a200", "--urdf", str(urdf), "--json", str(tmp_path / "cg.json")]) == 0
    assert json.loads((tmp_path / "cg.json").read_text())["sigma_m"] == pytest.approx([0.005, 0.078], abs=1e-3)
    assert "8 cm off the middle of a symmetric robot" in capsys.readouterr().out


def test_init_of_a_log_with_ground_truth_alone_takes_no_wheels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = init(tmp_path, BASE_LOG, "--track-width-m", "0.57", "--wheelbase-m", "0.51")
    assert (robot.topics.reference, robot.topics.odometry) == ("/ground_truth/odom", Topics().odometry)
    assert "topics.odometry" not in capsys.readouterr().out


_STEERING = "type: ackermann_steering_controller/AckermannSteeringController\n"
_MECANUM = "mecanum_drive_controller: {ros__parameters: {kinematics: {wheels_radius: 0.1}}}\n"


def test_init_with_a_steering_controller_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "control.yaml").write_text(_STEERING + _CONTROLLER)
    init(tmp_path, BASE_LOG, "--controller", str(tmp_path / "control.yaml"), "--wheelbase-m", "0.51")
    assert "steered wheels, by control.yaml: steering is not modelled" in capsys.readouterr().out


def test_init_with_a_mecanum_controller_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "control.yaml").write_text(_MECANUM)
    assert main(["init", str(BASE_LOG), "--out", str(tmp_path / "r.toml"), "--controller", str(tmp_path / "control.yaml")]) == 2
    assert "it is of mecanum wheels" in " ".join(capsys.readouterr().err.split())


_RPM_LOG = CASES / "H13-wheel-rates-in-rpm" / "log.mcap"


@pytest.mark.extended
@pytest.mark.parametrize(("known", "radius"), [("0.165", 0.165), ("0.15", 0.15)])
def test_init_with_rates_in_rpm_writes_their_unit(known: str, radius: float, tmp_path: Path) -> None:
    robot = init(tmp_path, _RPM_LOG, "--wheel-radius-m", known, "--track-width-m", "0.57", "--wheelbase-m", "0.51")
    assert (robot.joints.rate_unit_rad_s, robot.geometry.wheel_radius_m) == (pytest.approx(0.10472, rel=1e-4), radius)


@pytest.mark.extended
def test_init_with_rates_in_rpm_and_a_wrong_urdf_has_both(tmp_path: Path) -> None:
    robot = init(tmp_path, _RPM_LOG, "--urdf", str(CASES / "H10-urdf-base-inertial-axes-swapped" / "robot.urdf"))
    assert robot.joints.rate_unit_rad_s == pytest.approx(0.10472, rel=1e-4)
    assert robot.geometry.wheel_radius_m == pytest.approx(0.165, rel=0.01)


def test_init_with_rates_in_rpm_alone_asks_for_the_radius(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lengths = ("--track-width-m", "0.57", "--wheelbase-m", "0.51")
    assert main(["init", str(_RPM_LOG), "--out", str(tmp_path / "r.toml"), *lengths]) == 2
    assert "0.165 m by revolutions per minute" in " ".join(capsys.readouterr().out.split())


def test_init_of_a_log_with_odometry_on_tf_names_its_wheels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lengths = ("--wheel-radius-m", "0.165", "--track-width-m", "0.57", "--wheelbase-m", "0.51")
    init(tmp_path, CASES / "H12-odometry-in-tf-only" / "log.mcap", *lengths)
    printed = capsys.readouterr().out
    assert "wheels: the motion on /tf" in printed
    assert "! wheels" not in printed


def test_init_of_two_joints_that_turn_like_four_is_skid_steer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sides = ("--left", "front_left_wheel", "--right", "front_right_wheel", "--track-width-m", "0.57", "--wheelbase-m", "0.51")
    assert init(tmp_path, BASE_LOG, *sides).drive == "skid_steer"
    assert "k = 0.55: skid_steer is written" in capsys.readouterr().out


def test_init_with_a_urdf_of_other_joint_names_names_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (CASES / "H10-urdf-base-inertial-axes-swapped" / "robot.urdf").read_text()
    (tmp_path / "r.urdf").write_text(text.replace("_wheel", "_tyre_wheel"))
    init(tmp_path, BASE_LOG, "--urdf", str(tmp_path / "r.urdf"))
    assert "CONTRADICTION: joints = front_left_tyre_wheel" in " ".join((tmp_path / "r.toml").read_text().split())


def prefixed_urdf(tmp_path: Path, name: str, prefix: str) -> str:
    """The URDF of a case, whose wheels' joints have a ``prefix``."""
    text = (CASES / name / "robot.urdf").read_text()
    path = tmp_path / "prefixed.urdf"
    path.write_text(re.sub(r'(<joint name=")(\w*wheel)', rf"\g<1>{prefix}\g<2>", text))
    assert prefix in path.read_text()
    return str(path)


def test_init_with_a_prefix_in_the_urdf_takes_its_sides(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The sides of the URDF contradict the names: they count as they do without the prefix."""
    name = "H01-urdf-names-against-sides"
    robot = init(tmp_path, CASES / name / "log.mcap", "--urdf", prefixed_urdf(tmp_path, name, "j100_0000/"))
    assert {*robot.joints.left} == {"front_left_wheel", "rear_left_wheel"}
    printed = capsys.readouterr().out
    assert "of the log is the URDF's j100_0000/" in printed
    assert "by the sides of the URDF's wheels" in printed


def test_init_with_a_controller_of_another_prefix_compares_its_sides(tmp_path: Path) -> None:
    """In a node of a namespace, below the parameters of all nodes; its sides are not those of the names and the gyro."""
    own = _CONTROLLER.replace("diff_drive_base_controller", "/j100/velocity_controller").replace('"front', '"j100/front')
    own = own.replace('"rear', '"j100/rear').replace("left_wheel_names", "x").replace("right_wheel_names", "left_wheel_names")
    own = own.replace("x:", "right_wheel_names:")
    (tmp_path / "control.yaml").write_text("/**:\n  ros__parameters: {use_sim_time: false}" + own)
    robot = init(tmp_path, BASE_LOG, "--controller", str(tmp_path / "control.yaml"), "--wheelbase-m", "0.5")
    assert robot.geometry.track_width_m == 0.57
    assert "left wheels = front_right_wheel, rear_right_wheel (by control.yaml" in (tmp_path / "r.toml").read_text()


def test_init_of_a_urdf_with_an_axle_in_place_of_two_asks_for_the_sides(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = Vehicle(left=("left_wheel",), right=("right_wheel",))
    (tmp_path / "robot.urdf").write_text(urdf_of(vehicle, ("left_wheel", "right_wheel")))
    options = ["--urdf", str(tmp_path / "robot.urdf"), "--out", str(tmp_path / "r.toml")]
    assert main(["init", str(BASE_LOG), *options]) == 2
    assert "left_wheel of the URDF may be front_left_wheel or rear_left_wheel" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.extended
def test_init_decides_sides_by_the_gyro_where_no_odometry_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = Vehicle(seed=301)
    log = write(tmp_path / "log.mcap", vehicle, drive(vehicle), Publishing())
    (tmp_path / "robot.urdf").write_text(urdf_of(vehicle, (*vehicle.right, *vehicle.left)))
    assert init(tmp_path, log, "--urdf", str(tmp_path / "robot.urdf")).joints.left == vehicle.left
    printed = capsys.readouterr().out
    assert "the log does not decide" not in printed
    assert "by turns" in printed
