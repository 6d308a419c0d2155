"""Robot files: shipped ones, their reference, [clock] and the wheels' radius multipliers."""

from __future__ import annotations

import dataclasses
import json
from importlib import resources

import pytest

from localization.cli import main
from motion_models.errors import RobotError
from motion_models.robot import DIFF_DRIVE, Clock, Lidar, Mount, Tf
from motion_models.robot_file import load_robot, parse_robot, reference, robot_toml
from motion_models.robot_names import robot_names

# Wheel radius, track, wheelbase [m], mass [kg], product of the driver's track and multiplier [m], from the sources in each file.
SOURCES = {
    "jackal": (0.098, 0.37559, 0.262, 16.523, 0.37559 * 1.5),
    "husky_a300": (0.1651, 0.562, 0.512, 70 + 4 * 2.5, 0.562 * 1.75),
    "warthog": (0.3, 2 * 0.56821, 2 * 0.457367, 100 + 2 * 50 + 4 * 15, 1.5 * 1.125),
    "scout_2": (1.6459e-01, 0.58306, 0.498, 40 + 4 * 3, 0.58306),
    "scout_mini": (1.6e-01, 0.416503, 0.463951, (22.5 + 23.5) / 2, 0.416503),
    "leo": (0.0625, 0.358, 0.3052, 1.584994 + 2 * 1.387336 + 4 * 0.283642 + 0.001237, 0.358 * 1.76),
    "rover_pro": (0.122, 2 * 0.18, 2 * 0.145 - 0.0035, 4.53592 + 4 * 1.25, 2 * 0.18),
    "rosbot": (0.0425 * 0.95, 0.192, 0.106, 1.728 + 4 * 0.074, 0.186 * 1.36),
    "rosbot_xl": (0.048, 0.248, 0.170, 3.5 + 4 * 0.051, 0.248 * 1.3),
    "pioneer_3at": (0.111, 2 * (0.156 + 0.041), 0.135 + 0.134, 10 + 4 * 0.5 + 3 * 0.1 + 8 * 0.1, 2 * (0.156 + 0.041)),
    "pioneer_3dx": (0.091, 2 * 0.158, 0.185 + 0.026, 3.5 + 2 * 0.5 + 0.2, 2 * 0.158),
    "turtlebot3_burger": (0.033, 0.16, 0.081, 0.82573504 + 2 * 0.02849894 + 0.005 + 0.114, 0.16),
}


@pytest.mark.parametrize("name", SOURCES)
def test_gallery_robot_has_the_numbers_of_its_sources(name: str) -> None:
    robot = load_robot(name)
    g, d = robot.geometry, robot.driver
    found = (g.wheel_radius_m, g.track_width_m, g.wheelbase_m, g.mass_kg, d.track_width_m * d.wheel_separation_multiplier)
    assert found == pytest.approx(SOURCES[name], rel=1e-3)
    assert (robot.drive == DIFF_DRIVE) == (name in ("pioneer_3dx", "turtlebot3_burger"))
    assert len(robot.joints.left) == len(robot.joints.right)


@pytest.mark.parametrize("name", SOURCES)
def test_gallery_robot_names_the_source_of_every_number(name: str) -> None:
    text = (resources.files("motion_models") / "robots" / f"{name}.toml").read_text(encoding="utf-8")
    assert "github.com/" in text.split("[geometry]")[0]
    sections = text.split("[geometry]")[1].split("[topics]")[0].split("[joints]")[0]
    numbers = [line for line in sections.splitlines() if "=" in line]
    assert len(numbers) >= 7
    assert all("#" in line for line in numbers)


def test_robots_lists_all_with_k_and_its_source(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "robots.json"
    assert main(["robots", "--json", str(path)]) == 0
    found = {each["robot"]: each for each in json.loads(path.read_text())["robots"]}
    assert list(found) == robot_names()
    assert found["jackal"]["k"] == pytest.approx(0.66, abs=0.01)
    assert (found["jackal"]["k_from"], found["vaultbot"]["k_from"]) == ("geometry", "its file")
    assert "turtlebot3_burger" in capsys.readouterr().out


def test_robots_with_a_name_prints_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "leo"]) == 0
    assert "robot_angular_velocity_multiplier" in capsys.readouterr().out
    assert main(["robots", "nobot"]) == 2


def test_reference_of_robot_files_is_up_to_date() -> None:
    """Else: python -m motion_models.robot_file > motion_models/robots/README.md"""
    assert (resources.files("motion_models") / "robots" / "README.md").read_text(encoding="utf-8") == reference()


def test_reference_explains_every_key() -> None:
    rows = [line for line in reference().splitlines() if line.startswith("| `")]
    assert len(rows) > 80
    assert all(line.split("|")[-2].strip() for line in rows)


def test_robot_toml_clock_and_multipliers_round_trip() -> None:
    robot = load_robot("husky_a200")
    geometry = dataclasses.replace(robot.geometry, left_wheel_radius_multiplier=1.01, right_wheel_radius_multiplier=0.99)
    changed = dataclasses.replace(robot, geometry=geometry, clock=Clock(wheel_time_offset_s=-0.114))
    assert parse_robot(robot_toml(changed), "test") == changed


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("[clock]\nwheel_time_offset_s = 60.0", "clock.wheel_time_offset_s is 60"),
        ("[clock]\nwheels = 0.1", "unknown entry wheels"),
        ('[clock]\nwheel_time_offset_s = "late"', "clock.wheel_time_offset_s must be a finite number"),
    ],
)
def test_parse_robot_bad_clock_is_refused(line: str, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        parse_robot(robot_toml(load_robot("husky_a200")).split("\n[clock]")[0] + "\n" + line + "\n", "test")


def test_robot_toml_lidar_and_overridden_frames_round_trip() -> None:
    robot = load_robot("husky_a200")
    changed = dataclasses.replace(robot, lidar=Lidar(1.02, 0.03), tf=Tf(("laser",)), mounts={**robot.mounts, "laser": Mount(0.4)})
    assert parse_robot(robot_toml(changed), "test") == changed
    transforms = {"laser": Mount(0.1), "other": Mount(0.2)}
    assert changed.with_mounts(transforms)["laser"] == Mount(0.4)
    assert robot.with_mounts(transforms)["laser"] == Mount(0.1)
    assert changed.with_mounts(transforms)["other"] == Mount(0.2)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("[lidar]\nrange_scale = 1000.0", "lidar.range_scale is 1000; it must be near 1"),
        ("[lidar]\nrange_offset_m = 30.0", "lidar.range_offset_m is 30 m"),
        ('[tf]\noverridden = ["camera"]', "tf.overridden names camera, of which there is no"),
    ],
)
def test_parse_robot_bad_lidar_or_frames_are_refused(line: str, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        parse_robot(f"{robot_toml(load_robot('husky_a200'))}\n{line}\n", "test")


def test_parse_robot_multiplier_far_from_one_is_refused() -> None:
    text = robot_toml(load_robot("husky_a200")).replace("[geometry]\n", "[geometry]\nleft_wheel_radius_multiplier = 0.0\n")
    with pytest.raises(RobotError, match="must be near 1"):
        parse_robot(text, "test")
