"""`skidloc check`: verdicts of a healthy robot and of robots that are wired or described wrong."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from localization.cli import main
from localization.logs import open_log
from motion_models.robot_file import load_robot, robot_toml
from tests.helpers import entrance_drives
from tests.helpers.entrance_drives import Publishing, Vehicle, write
from tests.helpers.extended import cases
from tests.helpers.wiring import CASES, LEFT, RIGHT, ROBOT_TOML, drive

DATA = Path(__file__).parents[1] / "data"


def check(tmp_path: Path, log: Path, *options: str) -> dict[str, Any]:
    """The JSON of a check."""
    given = options or ("--robot", str(ROBOT_TOML))
    assert main(["check", str(log), *given, "--out", str(tmp_path / "out")]) == 0
    found: dict[str, Any] = json.loads((tmp_path / "out" / "check.json").read_text())
    return found


def quantities(found: dict[str, Any], verdict: str) -> set[str]:
    return {row["quantity"] for row in found["rows"] if row["verdict"] == verdict}


def test_check_of_healthy_robot_has_no_contradiction(tmp_path: Path) -> None:
    found = check(tmp_path, CASES / "base-log" / "log.mcap")
    assert quantities(found, "contradiction") == set()
    assert {
        "signs and sides of wheels",
        "units of wheels",
        "axis and sign of gyro",
        "track and multiplier",
        "stamps",
        "reference",
    } <= quantities(found, "ok")
    assert quantities(found, "cannot be seen") == {"topic of LiDAR", "wheel radius"}
    robot = load_robot(tmp_path / "out" / "robot.toml")
    assert robot.models["skid_steer"]["k_0"] == pytest.approx(0.55, abs=0.01)
    assert "wheel_separation_multiplier: 1.8" in (tmp_path / "out" / "diff_drive_controller.yaml").read_text()
    assert "vyaw" in (tmp_path / "out" / "robot_localization.yaml").read_text()


@pytest.mark.extended
def test_check_compares_gps_where_the_first_minute_is_too_even(tmp_path: Path) -> None:
    """The Husky outdoors drives its first minute at an even speed; ways of two minutes by wheels and by GPS agree."""
    found = check(tmp_path, DATA / "husky-outdoor-gps" / "test1.bag", "--robot", "husky_a200")
    (row,) = (row for row in found["rows"] if row["quantity"] == "reference")
    assert row["verdict"] == "ok"
    assert 0.95 < float(row["second_source"].split("distance ")[1].split()[0]) < 1.05


@pytest.mark.extended
def test_check_of_a_log_that_breaks_off_says_so(tmp_path: Path) -> None:
    whole = (CASES / "base-log" / "log.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 7 // 10])
    found = check(tmp_path, tmp_path / "cut.mcap")
    (row,) = (row for row in found["rows"] if row["quantity"] == "log file")
    assert row["verdict"] == "note"
    assert "log file" not in quantities(found, "cannot be seen")
    assert found["sentence"].startswith(f"{sum(row['verdict'] == 'ok' for row in found['rows'])} of {len(found['rows']) - 1} quantities")
    assert "the log file is damaged, incomplete or corrected." in found["sentence"]
    assert "its end is missing" in (tmp_path / "out" / "check.html").read_text()
    assert "cut.mcap" in row["advice"]
    assert "its end is missing" in row["advice"]


@pytest.mark.extended
def test_check_with_inverted_side_writes_the_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = check(tmp_path, CASES / "H06-right-side-inverted" / "log.mcap")
    assert quantities(found, "contradiction") == {"sensors"}
    assert load_robot(tmp_path / "out" / "robot.toml").joints.reversed == RIGHT
    assert "the right side counts backwards" in capsys.readouterr().out
    assert "the right side counts backwards" in (tmp_path / "out" / "check.html").read_text()


def test_check_of_two_sensors_that_contradict_corrects_none(tmp_path: Path) -> None:
    found = check(tmp_path, drive(tmp_path / "log.mcap", names=(*RIGHT, *LEFT)))
    assert "sensors" in quantities(found, "contradiction")
    robot = load_robot(tmp_path / "out" / "robot.toml")
    assert (robot.joints, robot.wheel_noise) == (load_robot(ROBOT_TOML).joints, load_robot(ROBOT_TOML).wheel_noise)


@pytest.mark.extended
def test_check_with_urdf_names_what_the_log_contradicts(tmp_path: Path) -> None:
    case = CASES / "H02-urdf-plugin-contradicts-joints"
    found = check(tmp_path, case / "log.mcap", "--urdf", str(case / "robot.urdf"))
    assert quantities(found, "contradiction") == {"track_width_m"}


def test_check_without_any_length_asks_for_a_robot(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(CASES / "base-log" / "log.mcap")]) == 2
    assert "give --robot" in capsys.readouterr().err


def test_check_without_wheels_ends_with_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = drive(tmp_path / "log.mcap", has_joints=False)
    assert main(["check", str(log), "--robot", str(ROBOT_TOML)]) == 2
    assert "has no wheels" in capsys.readouterr().err


def test_check_without_gyro_has_no_sentence_about_it(tmp_path: Path) -> None:
    found = check(tmp_path, CASES / "base-log" / "log.mcap", "--robot", str(ROBOT_TOML), "--topic.imu", "")
    texts = [row for row in found["rows"] if "by the gyro" in row["second_source"] or "gyro" in row["quantity"]]
    assert texts == []
    assert open_log(CASES / "base-log" / "log.mcap", load_robot(ROBOT_TOML)).sources.imu is not None


def spoiled_reference(path: Path, scale: float = 1.0, late_s: float = 0.0, mirror: float = 1.0) -> Path:
    """The reference of the base log in another unit, on another clock, or left-handed."""
    rows = np.loadtxt(CASES / "base-log" / "reference.tum")
    rows[:, 1:3] *= [scale, scale * mirror]
    rows[:, 6] *= mirror
    rows[:, 0] += late_s
    np.savetxt(path, rows, fmt="%.9f")
    return path


SPOILED = cases(
    [
        ("scale is 1000", {"scale": 1000.0}),
        ("18.0 s ahead of", {"late_s": 18.0}),
        ("mirrored", {"mirror": -1.0}),
        ("none lies within the trajectory's time", {"late_s": -30 * 86400.0}),
    ],
    usual=["18.0 s ahead of", "none lies within the trajectory's time"],
)


@pytest.mark.extended
@pytest.mark.parametrize(("text", "change"), SPOILED)
def test_check_of_reference_names_its_unit_and_clock(tmp_path: Path, text: str, change: dict[str, float]) -> None:
    reference = spoiled_reference(tmp_path / "reference.tum", **change)
    options = ("--robot", str(ROBOT_TOML), "--reference", str(reference))
    found = check(tmp_path, CASES / "base-log" / "log.mcap", *options)
    assert [text in row["advice"] for row in found["rows"] if row["quantity"] == "reference"] == [True]


@pytest.mark.parametrize("command", cases(["calibrate", "diagnose", "weigh"], usual=["calibrate"]))
@pytest.mark.parametrize(("text", "change"), SPOILED)
def test_spoiled_reference_is_named_and_nothing_is_fitted_to_it(
    tmp_path: Path, command: str, text: str, change: dict[str, float], capsys: pytest.CaptureFixture[str]
) -> None:
    reference = spoiled_reference(tmp_path / "reference.tum", **change)
    out = tmp_path / "out.toml"
    args = [command, str(CASES / "base-log" / "log.mcap"), "--robot", str(ROBOT_TOML), "--reference", str(reference), "--out", str(out)]
    assert main(args) == 2
    assert text in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.extended
def test_check_with_a_wrong_radius_has_k_of_the_measured_one(tmp_path: Path) -> None:
    """No sentence on what only follows from the radius, and a robot file in which radius and k belong together."""
    vehicle = Vehicle(0.165, 0.555, 0.512, 0.5, scan_hz=8.0, beams=180, seed=77)
    log = write(tmp_path / "log.mcap", vehicle, entrance_drives.drive(vehicle), Publishing())
    right = vehicle.robot()
    wrong = dataclasses.replace(right, geometry=dataclasses.replace(right.geometry, wheel_radius_m=0.215))
    (tmp_path / "wrong.toml").write_text(robot_toml(wrong))
    found = check(tmp_path, log, "--robot", str(tmp_path / "wrong.toml"))
    assert quantities(found, "contradiction") == {"wheel radius"}
    robot = load_robot(tmp_path / "out" / "robot.toml")
    assert robot.geometry.wheel_radius_m == pytest.approx(0.165, rel=0.03)  # scans over 0.2 s are up to 3 % low
    assert robot.models["skid_steer"]["k_0"] == pytest.approx(0.5, abs=0.02)
