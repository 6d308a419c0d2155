"""Signs, sides and units of wheels and gyro that contradict the robot file: corrected by a third source, else named as alternatives."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import skidloc
from localization.calibration.wheel_signals import read_signals
from localization.calibration.wheel_wiring import WiringReport, check_wiring, open_checked, without_dead
from localization.cli import main
from localization.logs import TopicOverrides, open_log
from motion_models.robot_file import load_robot, robot_toml
from tests.helpers import bags, entrance_drives
from tests.helpers.entrance_drives import Publishing, Vehicle
from tests.helpers.extended import cases
from tests.helpers.wiring import CASES, LEFT, RIGHT, ROBOT_TOML, Change, drive

ROBOT = load_robot(ROBOT_TOML)
SIGNS: dict[str, np.ndarray] = {
    "left": np.array([-1.0, -1.0, 1.0, 1.0]),
    "right": np.array([1.0, 1.0, -1.0, -1.0]),
    "all": -np.ones(4),
    "one": np.array([1.0, -1.0, 1.0, 1.0]),
}


def signs(kind: str) -> Change:
    return lambda position, velocity: (SIGNS[kind] * position, SIGNS[kind] * velocity)


def report_of(path: Path) -> WiringReport:
    return check_wiring(open_log(path, ROBOT))


@pytest.mark.parametrize("name", ["base-log", "H07-one-message-per-wheel"])
def test_wiring_of_healthy_log_has_no_finding(name: str) -> None:
    log, report = open_checked(CASES / name / "log.mcap", ROBOT)
    assert (report.findings, report.keys, log.robot) == ((), {}, ROBOT)


@pytest.mark.parametrize("has_odometry", [False, True])
@pytest.mark.parametrize(("kind", "reversed_"), [("left", LEFT), ("right", RIGHT), ("one", ("rear_left_wheel",))])
def test_wiring_with_reversed_wheels_is_corrected(tmp_path: Path, kind: str, reversed_: tuple[str, ...], has_odometry: bool) -> None:
    report = report_of(drive(tmp_path / "log.mcap", signs(kind), has_odometry=has_odometry))
    assert report.robot.joints.reversed == reversed_
    assert "joints.reversed" in report.findings[0]
    (tmp_path / "r.toml").write_text(robot_toml(report.robot))
    corrected = check_wiring(open_log(tmp_path / "log.mcap", load_robot(tmp_path / "r.toml")))
    assert corrected.findings == ()


def test_wiring_of_wheels_on_rollers_is_named(tmp_path: Path) -> None:
    """Mecanum wheels: front and rear ones turn against each other, which moves the robot to the side."""
    to_the_side = np.array([-1.0, 1.0, 1.0, -1.0])

    def rolling(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turned = math.sin(0.2 * float(np.abs(position).sum()))
        return position + to_the_side * turned, velocity + 1.5 * to_the_side * turned

    report = report_of(drive(tmp_path / "log.mcap", rolling))
    (text,) = report.findings
    assert "mecanum or omni wheels" in text
    assert report.keys == {}
    assert report.robot == ROBOT


def test_wiring_of_wheels_that_count_half_is_named(tmp_path: Path) -> None:
    """Of both sides, which would be on rollers by the signs alone."""
    rear = np.array([1.0, 0.5, 1.0, 0.5])
    (text,) = report_of(drive(tmp_path / "log.mcap", lambda position, velocity: (rear * position, rear * velocity))).findings
    assert text.count("turns 0.50 times as fast as") == 2
    assert "mecanum" not in text


def test_wiring_of_one_side_whose_wheels_differ_is_none_on_rollers(tmp_path: Path) -> None:
    def spinning(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turned = math.sin(0.2 * float(np.abs(position).sum()))
        return position, velocity + 1.5 * np.array([-1.0, 1.0, 0.0, 0.0]) * turned

    assert not any("mecanum" in text for text in report_of(drive(tmp_path / "log.mcap", spinning)).findings)


def test_wiring_without_an_encoder_that_counts_nothing(tmp_path: Path) -> None:
    kept = np.array([1.0, 0.0, 1.0, 1.0])
    report = report_of(drive(tmp_path / "log.mcap", lambda position, velocity: (kept * position, kept * velocity)))
    assert report.robot.joints.left == LEFT[:1]
    assert report.robot.joints.right == RIGHT
    assert report.keys == {"joints.left": f'["{LEFT[0]}"]'}
    assert "its encoder counts nothing" in report.findings[0]


def test_wiring_without_a_wheel_of_no_data_blames_no_encoder(tmp_path: Path) -> None:
    signals = read_signals(open_log(drive(tmp_path / "log.mcap"), ROBOT))
    assert signals is not None
    rates, angle_rates = signals.rates.copy(), signals.angle_rates.copy()
    rates[:, 1] = angle_rates[:, 1] = np.nan
    report = without_dead(ROBOT, replace(signals, rates=rates, angle_rates=angle_rates))
    assert report is not None
    assert report.findings[0].startswith(f"{LEFT[1]}: has no data")
    assert "encoder" not in report.findings[0]
    assert report.robot.joints.left == LEFT[:1]


def test_wiring_without_two_encoders_that_count_nothing_names_both(tmp_path: Path) -> None:
    kept = np.array([1.0, 0.0, 1.0, 0.0])
    report = report_of(drive(tmp_path / "log.mcap", lambda position, velocity: (kept * position, kept * velocity)))
    assert f"{LEFT[1]}, {RIGHT[1]}: their encoders count nothing" in report.findings[0]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_wiring_of_a_driver_with_a_reversed_side_is_named(tmp_path: Path, side: float) -> None:
    """Its ways are turns, and its turns ways: nothing of it can be used."""
    vehicle = Vehicle(seed=71)

    def circling(record: bags.Record) -> bags.Record:
        topic, message, log = record
        if topic != "/odom":
            return record
        v, w = message.twist.twist.linear.x, message.twist.twist.angular.z
        half = 0.5 * vehicle.track
        return topic, bags.odometry(log - bags.S // 100, 0.0, 0.0, 0.0, side * half * w, side * v / half), log

    records = entrance_drives.records_of(vehicle, entrance_drives.drive(vehicle), Publishing(forms="odometry"))
    report = check_wiring(open_log(bags.write_mcap(tmp_path / "log.mcap", map(circling, records)), vehicle.robot()))
    assert report.is_ambiguous
    assert "counts backwards in its driver" in report.findings[0]


def test_wiring_with_all_reversed_needs_a_third_source(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", signs("all"), has_odometry=True))
    assert set(report.robot.joints.reversed) == {*LEFT, *RIGHT}


def test_wiring_with_sides_swapped_is_corrected_by_odometry(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", names=(*RIGHT, *LEFT), has_odometry=True))
    assert (report.robot.joints.left, report.robot.joints.right) == (RIGHT, LEFT)


def test_wiring_with_axles_for_sides_is_corrected(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", names=(LEFT[0], RIGHT[0], LEFT[1], RIGHT[1])))
    assert {*report.robot.joints.left} == {LEFT[0], RIGHT[0]}


def test_wiring_of_axles_that_turn_alike_is_no_alternative(tmp_path: Path) -> None:
    """Left and right swapped, the wheels of a side equal up to rounding: front against rear is no turn."""

    def swap(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        order = np.array([2, 2, 0, 0])
        return position[order], velocity[order] * [1.0, 1.0 + 1e-15, 1.0, 1.0 + 1e-15]

    report = report_of(drive(tmp_path / "log.mcap", swap, has_odometry=True))
    assert not report.is_ambiguous
    assert report.robot.joints.left == RIGHT


def test_wiring_with_gyro_opposite_is_corrected_by_odometry(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", gyro=-1.0, has_odometry=True))
    assert (report.robot.imu.rate_unit_rad_s, report.robot.joints) == (-1.0, ROBOT.joints)


@pytest.mark.parametrize(("side", "unit"), cases([("right", 60.0 / math.tau), ("left", 180.0 / math.pi)], ["right"]))
def test_wiring_with_one_side_in_another_unit_is_corrected(tmp_path: Path, side: str, unit: float) -> None:
    factors = np.where(SIGNS[side] < 0.0, unit, 1.0)
    report = report_of(drive(tmp_path / "log.mcap", lambda position, velocity: (np.zeros(0), factors * velocity)))
    multipliers = np.array([unit if side == "left" else 1.0, unit if side == "right" else 1.0]) ** -1
    np.testing.assert_allclose(report.robot.geometry.radius_multipliers, multipliers, rtol=1e-6)
    assert f"rates of the {side} wheels are" in report.findings[0]


@pytest.mark.parametrize("is_gyro", [False, True])
def test_wiring_of_two_sensors_that_contradict_blames_none(tmp_path: Path, is_gyro: bool) -> None:
    names = (*LEFT, *RIGHT) if is_gyro else (*RIGHT, *LEFT)
    report = report_of(drive(tmp_path / "log.mcap", gyro=-1.0 if is_gyro else 1.0, names=names))
    assert report.is_ambiguous
    assert report.keys == {}
    assert "left and right wheels are swapped, or the gyro's sign is reversed" in report.findings[0]


def replay_metrics(tmp_path: Path, log: Path) -> dict[str, object]:
    options = ["--model", "skid_steer", "--estimator", "odometry,ekf", "--reference", str(CASES / "base-log" / "reference.tum")]
    assert main(["replay", str(log), "--robot", str(ROBOT_TOML), *options, "--out", str(tmp_path / "out")]) == 0
    found: dict[str, object] = json.loads((tmp_path / "out" / "metrics.json").read_text())
    return found


@pytest.mark.extended
def test_replay_with_the_right_side_inverted_is_as_the_healthy_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    metrics = replay_metrics(tmp_path, CASES / "H06-right-side-inverted" / "log.mcap")
    for result in metrics["results"]:  # type: ignore[attr-defined]
        assert result["ate_rmse_m"] < 0.02
    text = "the right side counts backwards"
    assert text in capsys.readouterr().out
    assert text in " ".join(metrics["notes"])  # type: ignore[call-overload]
    assert text in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("is_gyro", cases([False, True], ("False",)))
def test_replay_of_two_sensors_that_contradict_has_a_wide_covariance(tmp_path: Path, is_gyro: bool) -> None:
    names = (*LEFT, *RIGHT) if is_gyro else (*RIGHT, *LEFT)
    log = drive(tmp_path / "log.mcap", gyro=-1.0 if is_gyro else 1.0, names=names)
    for result in replay_metrics(tmp_path, log)["results"]:  # type: ignore[attr-defined]
        if is_gyro:
            assert result["nees_mean"] < 6.0
        else:  # the reference, too, turns opposite to the wheels: nothing decides which is right, and no covariance is judged
            assert "left and right wheels are swapped" in " ".join(result["reference_contradictions"])
            assert result["nees_mean"] is None


def test_calibrate_with_the_right_side_inverted_names_the_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--robot", str(ROBOT_TOML), "--model", "skid_steer", "--out", str(tmp_path / "r.toml")]
    assert main(["calibrate", str(CASES / "H06-right-side-inverted" / "log.mcap"), *options]) == 2
    error = capsys.readouterr().err
    assert 'Write: joints.reversed = ["front_right_wheel", "rear_right_wheel"]' in error
    assert "Corrected in this run" not in error


def test_log_for_notebooks_has_the_corrected_robot() -> None:
    log = skidloc.open(CASES / "H06-right-side-inverted" / "log.mcap", ROBOT)
    assert log.robot.joints.reversed == RIGHT
    assert "the right side counts backwards" in " ".join(log.log.warnings())


def test_wiring_without_gyro_has_no_sentence_about_it(tmp_path: Path) -> None:
    with_gyro = report_of(drive(tmp_path / "log.mcap", names=(*RIGHT, *LEFT))).findings[0]
    assert "the gyro's must be positive" in with_gyro
    assert "record a LiDAR or the driver's odometry" in with_gyro
    without = check_wiring(open_log(tmp_path / "log.mcap", ROBOT, TopicOverrides(imu="")))
    assert without.findings == ()


ROVER = Vehicle(0.06, 0.3, 0.24, 0.5, 0.3, 0.9, wheels_hz=15.0, imu_hz=30.0, scan_hz=7.0, beams=120, room=(9.0, 8.0), seed=52)


def front_report(tmp_path: Path, ahead_m: float, is_turned: bool) -> WiringReport:
    """Of wheels that all count backwards; or whose sides are swapped, with a LiDAR that ``is_turned``. The gyro contradicts both."""
    how = Publishing(lambda a, r: (-a, -r), lidar_ahead_m=ahead_m)
    if is_turned:
        how = Publishing(lambda a, r: (a[[2, 3, 0, 1]], r[[2, 3, 0, 1]]), lidar_ahead_m=ahead_m, lidar_yaw=math.pi)
    log = entrance_drives.write(tmp_path / "log.mcap", ROVER, entrance_drives.drive(ROVER), how)
    return check_wiring(open_log(log, ROVER.robot()))


FRONTS = {"swapped": (0.15, True), "backwards": (0.15, False), "swapped, LiDAR behind": (-0.12, True)}


@pytest.mark.parametrize("name", cases(FRONTS, usual=["swapped"]))
def test_front_is_at_the_end_where_the_lidar_moves_sideways(tmp_path: Path, name: str) -> None:
    ahead_m, is_turned = FRONTS[name]
    joints = front_report(tmp_path, ahead_m, is_turned).robot.joints
    everything = (*ROVER.left, *ROVER.right)
    assert (joints.left, joints.reversed) == ((ROVER.right, ()) if is_turned else (ROVER.left, everything))
    assert joints.is_front_known


def test_front_of_a_robot_with_its_lidar_in_the_middle_is_not_known(tmp_path: Path) -> None:
    report = front_report(tmp_path, 0.03, is_turned=True)
    assert not report.robot.joints.is_front_known
    assert "which end of the robot is its front" in report.findings[0]
    assert report.keys["joints.is_front_known"] == "false"


SCANNING = Vehicle(0.1, 0.42, 0.34, 0.6, 0.45, 0.9, wheels_hz=20.0, imu_hz=40.0, scan_hz=8.0, beams=160, room=(11.0, 9.0), seed=51)


def _checked(tmp_path: Path, how: Publishing, vehicle: Vehicle = SCANNING) -> WiringReport:
    log = entrance_drives.write(tmp_path / "log.mcap", vehicle, entrance_drives.drive(vehicle), how)
    return open_checked(log, vehicle.robot())[1]


def test_gyro_of_the_other_sign_beside_a_lidar_that_is_mounted_backwards_is_corrected(tmp_path: Path) -> None:
    """Wheels that all count backwards beside a LiDAR upside down have the same signs: the end at which it moves in turns decides."""
    report = _checked(tmp_path, Publishing(gyro=-1.0, lidar_yaw=math.pi))
    assert dict(report.keys) == {"imu.rate_unit_rad_s": "-1"}
    assert "the LiDAR is turned by 180 deg" in report.findings[0]
    backwards = Publishing(lambda a, r: (-a, -r), lidar_flip=True)
    assert list(_checked(tmp_path, backwards).keys) == ["joints.reversed"]


@pytest.mark.parametrize("yaw_deg", [-90.0, 60.0])
def test_unit_is_found_by_a_lidar_that_is_turned_to_the_side(tmp_path: Path, yaw_deg: float) -> None:
    vehicle = replace(SCANNING, imu_hz=0.0)
    report = _checked(tmp_path, Publishing(lambda a, r: (np.zeros(0), 9.5493 * r), lidar_yaw=math.radians(yaw_deg)), vehicle)
    assert dict(report.keys) == {"joints.rate_unit_rad_s": "0.10472"}


def test_driver_that_never_turns_is_named(tmp_path: Path) -> None:
    report = _checked(tmp_path, Publishing(forms="odometry", odometry_k=0.0))
    assert "never turns, while the robot turns by" in report.findings[0]
    assert report.keys == {}
    assert report.robot.wheel_noise.floor_rad2_per_s > 0.1
