"""What a log has beside its windows: commands are played where wheels follow them, and slopes where the accelerometers show them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'twin'")

from localization.cli import main
from localization.logs import Log, open_log
from localization.logs.event_decoder import driven_wheels
from localization.twin.log_drive import with_commands, with_slopes
from localization.twin.mujoco_simulator import read_simulator
from localization.twin.robot_mjcf import mjcf_of
from localization.twin.stretch import end_of, longest_stretch
from localization.twin.windows import Window, windows_of
from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError
from motion_models.registry import make_model
from motion_models.robot_file import load_robot
from motion_models.se2 import FloatArray
from motion_models.slope import Slope
from tests.helpers import bags
from tests.helpers.bags import START, S
from tests.logs.test_wheel_messages import ROBOT, joints
from tests.twin.test_engine import window

NAMES = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")
WINDOW_S, WINDOWS = 2, 8
TURN = 1.2
"""Commanded turn rate [rad/s]; the speed is 0.3 m/s."""


def set_points() -> FloatArray:
    """(2,) what the driver makes of the command."""
    return driven_wheels(np.array([0.3, TURN]), ROBOT.driver.half_track_m, ROBOT.driver.wheel_radius_m)


def drive(share: float, straight: float = 1.0) -> tuple[list[Maneuver], np.ndarray]:
    """Windows in which the sides' difference is this ``share`` of the command's, their mean ``straight`` times it; and their spans."""
    left, right = set_points()
    mean, half = straight * (left + right) / 2.0, share * (right - left) / 2.0
    rates = np.tile([mean - half, mean + half], (20, 1))
    one = Maneuver(np.full(20, 0.1), rates, np.array([[0.6, 0.0, 0.5]]), np.array([20]))
    starts = START + S * WINDOW_S * np.arange(1, WINDOWS + 1)
    return [replace(one, group=f"{i}") for i in range(WINDOWS)], np.column_stack([starts, starts + S * WINDOW_S])


def log_with(tmp_path: Path, turns: list[float], kind: str = "Twist") -> Log:
    """A log with a command every 0.1 s; ``turns`` are the commanded turn rates, one after another."""
    records = []
    for i in range(10 * WINDOW_S * (WINDOWS + 2)):
        stamp = START + i * S // 10
        value = bags.STORE.types["geometry_msgs/msg/Twist"](bags.vector(0.3), bags.vector(0.0, 0.0, turns[i % len(turns)]))
        message = value if kind == "Twist" else bags.STORE.types["geometry_msgs/msg/TwistStamped"](bags.header(stamp, "base_link"), value)
        records += [("/cmd_vel", message, stamp), ("/joint_states", joints(stamp, NAMES), stamp)]
    return open_log(bags.write_mcap(tmp_path / "run.mcap", records), ROBOT)


@pytest.mark.parametrize("kind", ["Twist", "TwistStamped"])
def test_constant_commands_are_the_set_points_of_a_servo_that_gives_way_in_turns(tmp_path: Path, kind: str) -> None:
    maneuvers, spans = drive(0.8)
    found, note = with_commands(maneuvers, spans, log_with(tmp_path, [TURN], kind))
    assert f"in {WINDOWS} windows" in note
    for m in found:
        assert m.commands is not None
        np.testing.assert_allclose(m.commands, np.tile(set_points(), (20, 1)))
    assert windows_of(found, ROBOT)[0].set_points[0] == pytest.approx(set_points())


@pytest.mark.parametrize(("share", "straight"), [(0.3, 1.0), (0.8, 1.4)])
def test_commands_in_another_scale_are_not_played(tmp_path: Path, share: float, straight: float) -> None:
    found, note = with_commands(*drive(share, straight), log_with(tmp_path, [TURN]))
    assert all(m.commands is None for m in found)
    assert "is not what the wheels were given" in note


def test_commands_that_change_are_not_played(tmp_path: Path) -> None:
    found, note = with_commands(*drive(0.8), log_with(tmp_path, [TURN, 1.1 * TURN]))
    assert all(m.commands is None for m in found)
    assert "constant in 0 windows" in note


def test_commands_that_are_missing_are_named_or_silent(tmp_path: Path) -> None:
    maneuvers, spans = drive(0.8)
    log = log_with(tmp_path, [TURN])
    with pytest.raises(CalibrationError, match=r"no topic /other\. Topics of commands: /cmd_vel"):
        with_commands(maneuvers, spans, log, "/other")
    found, note = with_commands(maneuvers, spans, log, "")
    assert note == ""
    assert all(m.commands is None for m in found)


def test_weak_servo_shows_where_commands_are_played_and_not_by_measured_rates() -> None:
    """The error of a servo at 2 rad/s is its torque over its gain: three times as large with a third of the gain."""
    robot = load_robot("husky_a200")
    file = read_simulator(mjcf_of(robot), robot)
    weak = file.compiled(replace(file.numbers, servo_gain=file.numbers.servo_gain / 3.0))
    commanded = window(-2.0, 2.0)
    reached = file.engine.play([commanded]).rates
    of_command = replace(commanded, rates=reached.repeat(2, axis=0), commands=commanded.rates)
    assert file.engine.play([of_command]).rates == pytest.approx(reached, rel=0.05)
    lacking, weakly = (2.0 - np.abs(rates).mean() for rates in (reached, weak.play([of_command]).rates))
    assert lacking > 0.1
    assert weakly == pytest.approx(3.0 * lacking, rel=0.1)


@pytest.mark.parametrize("heading", [0.0, math.pi / 2.0])
def test_contact_law_slides_downhill_as_the_friction_model_on_a_slope(heading: float) -> None:
    """A turn in place on 5 degrees in MuJoCo against the model's equilibrium at each heading, which shares no code with it."""
    robot = load_robot("husky_a200")
    model, simulator = make_model("friction", robot), read_simulator(mjcf_of(robot), robot)
    mu, stiffness = (float(model.nominal[model.param_names.index(name)]) for name in ("mu", "slip_stiffness"))
    numbers = replace(simulator.numbers, mu=mu, slip_stiffness=stiffness, servo_gain=20.0 * simulator.numbers.servo_gain)
    downhill = math.tan(math.radians(5.0)) * np.array([math.cos(heading), -math.sin(heading)])
    one = replace(window(-2.0, 2.0, 2.0), downhill=downhill)
    played = simulator.compiled(numbers).play([one])
    pose, height = np.zeros(3), simulator.numbers.cg_z_m
    for _ in range(200):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        turned = np.array([[c, s], [-s, c]]) @ downhill
        vx, vy, wz = model.twist_on_slope(played.rates[0], robot.center_of_gravity, model.nominal, Slope(turned, height)).twist.value
        pose += 0.01 * np.array([c * vx - s * vy, s * vx + c * vy, wz])
    along = downhill / np.linalg.norm(downhill)
    assert played.poses[0, 2] == pytest.approx(pose[2], rel=0.06)
    assert along @ played.poses[0, :2] == pytest.approx(along @ pose[:2], abs=0.015)
    assert along @ pose[:2] > 0.03


@pytest.mark.slow
def test_slope_of_a_ramp_is_found_at_the_start_of_each_window(tmp_path: Path) -> None:
    path = tmp_path / "ramp.mcap"
    assert main(["simulate", "ramp", "--robot", "husky_a200", "--seed", "5", "--out", str(path)]) == 0
    log = open_log(path, load_robot("husky_a200"))
    starts = log.start_ns + S * np.arange(5, 180, 7)
    maneuvers, _ = drive(0.8)
    found = with_slopes([maneuvers[0]] * len(starts), np.column_stack([starts, starts + S]), log)
    steep = np.array([math.degrees(math.atan(np.hypot(*m.downhill))) for m in found])
    assert steep == pytest.approx(8.0, abs=0.6)


def test_stretch_is_the_longest_without_a_gap_and_ends_where_its_windows_do() -> None:
    one = Window(np.array([0.6, 1.0]), np.ones((2, 2)), np.array([0.5, 0.0, 0.1]), np.eye(3), np.zeros(2), "")
    windows = [replace(one, start_s=float(s)) for s in (0, 1, 2, 7, 8, 9, 10, 11, 12)]
    stretch = longest_stretch(windows)
    assert [w.start_s for w in stretch] == [7.0, 8.0, 9.0, 10.0, 11.0, 12.0]
    robot = load_robot("husky_a200")
    played = read_simulator(mjcf_of(robot), robot).engine.play([window(3.0, 3.0)] * len(stretch))
    exact = replace(played, poses=np.array([w.measured for w in stretch]))
    assert end_of("file", stretch, exact, np.zeros(2)).position_error_m == pytest.approx(0.0, abs=1e-12)
    turned = replace(exact, poses=exact.poses + np.array([0.0, 0.0, 0.1]))
    end = end_of("file", stretch, turned, np.zeros(2))
    assert (end.duration_s, end.way_m) == pytest.approx((6.0, 3.0))
    assert end.heading_error_rad == pytest.approx(0.6)
    assert longest_stretch(windows[:3]) == []
