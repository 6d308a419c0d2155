"""`skidloc online`: the picture in the terminal, on a run of the node; and a log whose robot is described wrong."""

from __future__ import annotations

import functools
import io
import math
from pathlib import Path

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from localization.cli import main
from localization.commands.online import terminal_view
from localization.logs import open_log
from localization.ros.diagnostics import ERROR, WARN, Status
from localization.trajectory import read_tum
from motion_models.robot_file import load_robot, robot_toml
from tests.helpers.entrance_drives import Publishing, Vehicle, drive, write
from tests.helpers.extended import cases
from tests.helpers.online import LogTransport, drive_log, run_node

CASES = Path(__file__).parents[1] / "data" / "cases"
pytestmark = pytest.mark.xdist_group("online")
STATUSES = [
    Status("lidar"),
    Status("wheels", WARN, "they turn otherwise than the robot moves: slip"),
    Status("messages", ERROR, "no messages come on /imu/data, /center_of_gravity_by_the_arms"),
]


@functools.cache
def driven():
    return run_node(LogTransport(drive_log()))[0]


def drawn(width):
    node = driven()
    console = Console(file=io.StringIO(), width=width)
    console.print(terminal_view(node.session, node.seconds, STATUSES, node.rates(), "1.0x"))
    return console.file.getvalue().splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("width", cases([16, 30, 45, 80, 132, 300], ("45",)))
def test_terminal_view_fits_any_width_and_loses_nothing(width):
    lines = drawn(width)
    assert max(cell_len(line) for line in lines) <= width
    label_cells = max(len(label) for label in ("messages", "learned"))
    text = "".join(line[label_cells:].strip().replace(" ", "") for line in lines)
    for wanted in ("skid_steer_ekf", "NIS", "/scan12.", "slip", "/center_of_gravity_by_the_arms"):
        assert wanted in text


@pytest.mark.extended
def test_terminal_view_has_a_row_for_each_subject_and_warning():
    rows = {line.split()[0]: line for line in drawn(300)}
    assert list(rows) == ["state", "pose", "sigma", "motion", "rates", "learned", "wheels", "messages"]
    assert rows["rates"].count("Hz") == 3
    assert "+-" in rows["learned"]


def test_terminal_view_before_the_first_estimate_names_what_it_needs():
    node = run_node(LogTransport(drive_log(), lambda messages: messages[:3]))[0]
    console = Console(file=io.StringIO(), width=80)
    console.print(terminal_view(node.session, node.seconds, []))
    assert "no estimate yet" in console.file.getvalue()


WRONG = {
    "H11-lidar-yaw-180": "the LiDAR is turned by 180 deg",
    "H06-right-side-inverted": "joints.reversed = [",
    "H13-wheel-rates-in-rpm": "joints.rate_unit_rad_s = 0.10472",
}


@pytest.mark.parametrize("case", cases(WRONG, ("H11-lidar-yaw-180", "H13-wheel-rates-in-rpm")))
def test_online_of_a_log_corrects_what_contradicts_the_robot_file(case, tmp_path, capsys):
    log, robot = CASES / case / "log.mcap", CASES / case / "robot.toml"
    assert main(["online", str(log), "--robot", str(robot), "--rate", "max", "--out", str(tmp_path / "run.tum")]) == 0
    text = capsys.readouterr().out
    assert WRONG[case] in text
    assert not any(words in text for words in ("LiDAR lost", "differ by more"))
    truth = list(open_log(log, load_robot(robot)).references("/ground_truth/odom"))
    true = truth[-1].position - truth[0].position
    assert np.linalg.norm(read_tum(tmp_path / "run.tum").poses[-1, :2]) == pytest.approx(np.linalg.norm(true), abs=0.05)


@pytest.mark.extended
def test_online_of_a_log_with_a_turned_lidar_writes_what_replay_does(tmp_path):
    vehicle = Vehicle(0.11, 0.4, 0.3, 0.55, scan_hz=8.0, beams=180, seed=78)
    motion = drive(vehicle)
    log = write(tmp_path / "log.mcap", vehicle, motion, Publishing(lidar_yaw=math.pi))
    robot = tmp_path / "robot.toml"
    robot.write_text(robot_toml(vehicle.robot()))
    options = ["--robot", str(robot), "--out"]
    assert main(["online", str(log), "--rate", "max", *options, str(tmp_path / "run.tum")]) == 0
    only = ["--model", "skid_steer", "--estimator", "ekf", "--reference", "none", "--static"]
    assert main(["replay", str(log), *only, *options, str(tmp_path / "replayed")]) == 0
    assert (tmp_path / "run.tum").read_bytes() == (tmp_path / "replayed" / "skid_steer_ekf.tum").read_bytes()
    assert read_tum(tmp_path / "run.tum").poses[-1, :2] == pytest.approx(motion.poses[-1, :2], abs=0.05)
