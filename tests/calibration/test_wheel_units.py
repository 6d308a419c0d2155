"""Units of wheels and gyro: what each of a healthy drive's rates and angles becomes in the units that drivers publish."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from localization.calibration.unsigned_speeds import describe_unsigned
from localization.calibration.wheel_signals import WheelSignals
from localization.calibration.wheel_units import check_length_unit, check_units, name_speed, without_outliers
from localization.calibration.wheel_wiring import WiringReport, check_wiring, open_checked
from localization.events import WheelSample
from localization.logs import open_log
from motion_models.robot_file import load_robot, robot_toml
from tests.helpers import bags
from tests.helpers.bags import START, S
from tests.helpers.wiring import CASES, ROBOT_TOML, Change, drive

ROBOT = load_robot(ROBOT_TOML)
RADIUS = 0.165
NOTHING = np.zeros(0)
DEG, TICKS = math.pi / 180.0, math.tau / 2048.0


def scaled(angle: float | None, rate: float | None) -> Change:
    """Positions and velocities in units of ``angle`` [rad] and ``rate`` [rad/s]; None where the driver has none."""
    return lambda position, velocity: (NOTHING if angle is None else position / angle, NOTHING if rate is None else velocity / rate)


def report_of(path: Path) -> WiringReport:
    return check_wiring(open_log(path, ROBOT))


@pytest.mark.parametrize(
    ("unit", "name"),
    [(math.tau / 60.0, "revolutions per minute"), (DEG, "degrees per second"), (1.0 / RADIUS, "metres per second")],
)
@pytest.mark.parametrize("has_odometry", [False, True])
def test_units_of_velocities_alone_are_named_and_corrected(tmp_path: Path, unit: float, name: str, has_odometry: bool) -> None:
    report = report_of(drive(tmp_path / "log.mcap", scaled(None, unit), has_odometry=has_odometry))
    assert name in report.findings[0]
    assert report.robot.joints.rate_unit_rad_s == pytest.approx(unit, rel=0.05)
    assert load_toml(tmp_path, report).findings == ()


def load_toml(tmp_path: Path, report: WiringReport) -> WiringReport:
    """What is found with the corrected robot's file."""
    (tmp_path / "r.toml").write_text(robot_toml(report.robot))
    return check_wiring(open_log(tmp_path / "log.mcap", load_robot(tmp_path / "r.toml")))


@pytest.mark.parametrize(("unit", "name"), [(DEG, "degrees"), (1.0 / RADIUS, "metres"), (TICKS, "counts, about 2")])
def test_units_of_positions_alone_are_named_and_corrected(tmp_path: Path, unit: float, name: str) -> None:
    report = report_of(drive(tmp_path / "log.mcap", scaled(unit, None)))
    assert name in report.findings[0]
    assert report.robot.joints.angle_unit_rad == pytest.approx(unit, rel=0.1)


def test_units_of_positions_with_right_velocities_are_exact(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", scaled(TICKS, 1.0)))
    assert report.robot.joints.angle_unit_rad == pytest.approx(TICKS, rel=0.01)
    assert report.robot.joints.rate_unit_rad_s == 1.0


def test_units_of_counters_of_16_bits_lose_no_motion(tmp_path: Path) -> None:
    def wrapped(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.mod(position / (TICKS / 16.0) + 60000.0, 65536.0), NOTHING

    log, report = open_checked(drive(tmp_path / "log.mcap", wrapped), ROBOT)
    assert report.robot.joints.angle_range == 65536.0
    turned = [event.position for event in log.events() if isinstance(event, WheelSample)]
    whole = [event.position for event in open_log(CASES / "base-log" / "log.mcap", ROBOT).events() if isinstance(event, WheelSample)]
    np.testing.assert_allclose(turned[-1] - turned[0], whole[-1] - whole[0], rtol=0.1)


def test_units_of_angles_within_two_turns_lose_no_motion(tmp_path: Path) -> None:
    log, report = open_checked(drive(tmp_path / "log.mcap", lambda position, velocity: (np.mod(position, 4.0 * math.pi), NOTHING)), ROBOT)
    value = report.robot.joints.angle_range
    assert value == pytest.approx(4.0 * math.pi, rel=0.02)
    assert any(f"joints.angle_range = {value:.6g}" in finding for finding in report.findings)
    turned = [event.position for event in log.events() if isinstance(event, WheelSample)]
    whole = [event.position for event in open_log(CASES / "base-log" / "log.mcap", ROBOT).events() if isinstance(event, WheelSample)]
    np.testing.assert_allclose(turned[-1] - turned[0], whole[-1] - whole[0], rtol=0.02)


def test_units_of_positions_that_are_reset_once_are_no_counter(tmp_path: Path) -> None:
    """The driver starts anew half way."""

    numbers = itertools.count()

    def reset(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (position - 30.0 if next(numbers) > 500 else position), velocity

    assert report_of(drive(tmp_path / "log.mcap", reset)).findings == ()


def test_units_of_velocities_without_a_sign_are_named(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", lambda position, velocity: (position, np.abs(velocity))))
    assert any("velocities of the wheels have no sign" in text for text in report.findings)
    assert not any("no sign" in text for text in report_of(drive(tmp_path / "healthy.mcap", scaled(1.0, 1.0))).findings)


def test_speeds_without_a_sign_or_angles_are_named_and_leave_the_gyro_in_use(tmp_path: Path) -> None:
    log, report = open_checked(drive(tmp_path / "log.mcap", lambda position, velocity: (NOTHING, np.abs(velocity))), ROBOT)
    assert "speeds without a sign" in report.findings[0]
    assert "turns in place by the gyro" in report.findings[0]
    assert log.sources.imu is not None
    assert report.robot.wheel_noise.longitudinal_m2_per_m > 1.0


def test_speeds_without_a_sign_that_a_lidar_sees_go_back_are_named() -> None:
    """Straight on and back, at one speed of all wheels."""
    n = 60
    speed = np.repeat([0.5, -0.5], n // 2)
    rates = np.outer(np.abs(speed), np.ones(4)) / RADIUS
    signals = WheelSignals(tuple("abcd"), 2, rates, np.full((n, 4), np.nan), {"LiDAR": np.zeros(n)}, {"LiDAR": speed})
    assert "goes backwards by the LiDAR" in describe_unsigned(signals, ROBOT)
    assert describe_unsigned(replace(signals, speeds={"LiDAR": np.abs(speed)}), ROBOT) == ""
    assert describe_unsigned(replace(signals, rates=np.outer(speed, np.ones(4)) / RADIUS), ROBOT) == ""


@pytest.mark.parametrize("left", [0.0, 0.5, 1.0])
def test_wheels_that_only_go_ahead_are_no_speeds_without_a_sign(left: float) -> None:
    """Arcs, and a turn about the left wheels."""
    n = 60
    rates = np.column_stack([np.full((n, 2), 3.0 * left), np.full((n, 2), 3.0)])
    turn = 0.5 * RADIUS / ROBOT.geometry.track_width_m * 3.0 * (1.0 - left) * np.ones(n)
    signals = WheelSignals(tuple("abcd"), 2, rates, np.full((n, 4), np.nan), {"gyro": turn}, {})
    assert describe_unsigned(signals, ROBOT) == ""


@pytest.mark.parametrize(("unit_m", "name"), [(0.0254, "inches"), (0.01, "centimetres"), (0.001, "millimetres")])
def test_radius_of_the_file_in_another_unit_is_named(unit_m: float, name: str) -> None:
    n = 60
    speed = 0.4 * np.sin(np.arange(n) / 5.0)
    signals = WheelSignals(tuple("abcd"), 2, np.outer(speed, np.ones(4)) / RADIUS, np.full((n, 4), np.nan), {}, {"LiDAR": speed})
    wrong = replace(ROBOT, geometry=replace(ROBOT.geometry, wheel_radius_m=RADIUS / unit_m))
    assert f"wheel_radius_m of the robot file is in {name}" in check_units(signals, wrong).findings[0]
    assert check_units(signals, ROBOT).findings == ()


def test_wheels_faster_than_their_robot_are_named() -> None:
    """Revolutions per minute of a slow drive are a usual speed, but not this robot's."""
    n = 60
    rates = np.full((n, 4), 0.24 / RADIUS * 60.0 / math.tau)
    signals = WheelSignals(tuple("abcd"), 2, rates, np.full((n, 4), np.nan), {"gyro": np.zeros(n)}, {})
    slow = replace(ROBOT, driver=replace(ROBOT.driver, max_speed_m_s=1.0))
    assert "1 m/s at most (driver.max_speed_m_s)" in name_speed(check_units(signals, slow), signals).findings[0]
    assert name_speed(check_units(signals, ROBOT), signals).findings == ()


@pytest.mark.parametrize(("unit", "is_named"), [(1.0, False), (math.tau / 60.0, True), (DEG, True)])
def test_units_of_wheels_that_never_turn_are_named_by_speeds_that_no_robot_has(unit: float, is_named: bool) -> None:
    """Straight on at 1 m/s: nothing else shows the unit."""
    n = 60
    rates = np.outer(np.minimum(np.arange(n) / 10.0, 1.0), np.ones(4)) / RADIUS / unit
    signals = WheelSignals(tuple("abcd"), 2, rates, np.full((n, 4), np.nan), {"gyro": np.zeros(n)}, {})
    found = name_speed(check_units(signals, ROBOT), signals)
    assert bool(found.findings) == is_named
    assert (found.robot.wheel_noise.longitudinal_m2_per_m > 1.0) == is_named


def test_units_of_gyro_in_degrees_are_corrected(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", gyro=1.0 / DEG))
    assert report.robot.imu.rate_unit_rad_s == pytest.approx(DEG, rel=1e-4)
    assert "deg/s" in report.findings[0]
    assert load_toml(tmp_path, report).findings == ()


def test_driver_that_corrects_for_skidding_has_its_multiplier_found() -> None:
    report = check_wiring(open_log(CASES / "H12-odometry-in-tf-only" / "log.mcap", ROBOT))
    assert report.robot.driver.wheel_separation_multiplier == pytest.approx(1.0 / 0.55, rel=0.05)


def test_driver_odometry_opposite_to_the_gyro_blames_none(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", gyro=-1.0, has_odometry=True, has_joints=False))
    assert report.is_ambiguous
    assert "or the gyro's sign is reversed" in report.findings[0]


def test_units_of_gyro_in_degrees_beside_odometry_are_corrected(tmp_path: Path) -> None:
    report = report_of(drive(tmp_path / "log.mcap", gyro=1.0 / DEG, has_odometry=True, has_joints=False))
    assert report.robot.imu.rate_unit_rad_s == pytest.approx(DEG, rel=1e-4)


def test_driver_odometry_in_millimetres_is_named(tmp_path: Path) -> None:
    records = []
    for i in range(200):
        stamp, way = START + i * S // 20, 25.0 * max(i - 40, 0)
        records.append(("/odom", bags.odometry(stamp, way, 0.0, 0.0, 500.0 if i > 40 else 0.0), stamp))
    report = report_of(bags.write_mcap(tmp_path / "log.mcap", records))
    assert "another unit than metres" in report.findings[0]
    assert report.robot.wheel_noise.longitudinal_m2_per_m > ROBOT.wheel_noise.longitudinal_m2_per_m


@pytest.mark.parametrize(("unit", "name"), [(1e-2, "centimetres"), (1e-3, "millimetres"), (1.0 / 3.6, "km/h"), (0.1, "another unit")])
def test_length_unit_of_the_drivers_odometry_is_named_by_the_lidar(unit: float, name: str) -> None:
    speed = np.r_[np.zeros(10), np.full(20, 0.4), np.zeros(5), np.full(20, -0.2)]
    report = check_length_unit(speed / unit, speed + 0.005 * np.random.default_rng(1).normal(size=len(speed)), ROBOT)
    assert name in report.findings[0]
    assert report.robot.driver.length_unit_m == pytest.approx(unit, rel=0.05)


def test_length_unit_of_metres_is_left_as_it_is() -> None:
    speed = np.r_[np.zeros(10), np.full(20, 0.4)]
    assert not check_length_unit(speed, 0.6 * speed, ROBOT).findings
    assert not check_length_unit(speed, 1.3 * speed, ROBOT).findings
    assert not check_length_unit(1000.0 * speed, None, ROBOT).findings


def test_length_unit_where_a_corridor_hides_half_of_the_speeds_and_some_scans_match_backwards() -> None:
    speed = 0.5 * np.ones(180)
    by_scans = speed.copy()
    by_scans[:80], by_scans[80:92] = np.nan, -0.5
    report = check_length_unit(3.3 * speed, by_scans, ROBOT)
    assert float(report.keys["driver.length_unit_m"]) == pytest.approx(1.0 / 3.3, rel=0.03)


def test_length_unit_of_ways_at_half_their_size_is_another_wheel_radius() -> None:
    """No slip makes a LiDAR faster than the wheels."""
    speed = 0.5 * np.sin(0.2 * np.arange(100.0))
    report = check_length_unit(0.5 * speed, speed + 0.005 * np.random.default_rng(1).normal(size=len(speed)), ROBOT)
    assert float(report.keys["driver.length_unit_m"]) == pytest.approx(2.0, rel=0.03)
    assert "another wheel radius" in report.findings[0]


def test_length_unit_of_the_robot_file_scales_odometry(tmp_path: Path) -> None:
    records = [("/odom", bags.odometry(START + i * S // 20, 25.0 * i, 0.0, 0.0, 500.0), START + i * S // 20) for i in range(100)]
    log = bags.write_mcap(tmp_path / "log.mcap", records)
    robot = replace(ROBOT, driver=replace(ROBOT.driver, length_unit_m=1e-3))
    found = [event for event in open_log(log, robot).events() if isinstance(event, WheelSample)]
    np.testing.assert_allclose([event.velocity for event in found], 0.5 / ROBOT.driver.wheel_radius_m)


@pytest.mark.filterwarnings("error")
def test_units_of_lengths_by_a_lidar_that_matched_nothing_warn_of_nothing() -> None:
    assert np.isnan(without_outliers(np.linspace(0.1, 1.0, 40), np.full(40, np.nan))).all()
