"""Faults of a set-up, hidden in a healthy drive and its room: named, corrected, or honestly open; and the healthy drive accused of none."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import skidloc
from localization.cli import main
from localization.events import WheelSample
from localization.evidence import SetUp, entrance, infer_set_up, open_log_with_set_up
from localization.evidence.alternatives.alternative import mount_correction
from localization.evidence.entrance import infer
from localization.logs import TopicOverrides, open_log
from localization.messages import message
from motion_models.robot import Mount
from motion_models.robot_file import load_robot, robot_toml
from tests.helpers import bags, entrance_drives
from tests.helpers.diagnosis_drives import bag
from tests.helpers.entrance_drives import Publishing, Vehicle
from tests.helpers.extended import cases
from tests.helpers.hostile_mounts import rear_lidar_described_at_the_front
from tests.helpers.wiring import CASES, LEFT, RIGHT, ROBOT_TOML, Change, drive
from tests.studies.set_ups.symptoms import stamp_of

ROBOT = load_robot(ROBOT_TOML)
NOTHING = np.zeros(0)
DEG, TICKS = math.pi / 180.0, math.tau / 2048.0
SIGNS: dict[str, np.ndarray] = {
    "left": np.array([-1.0, -1.0, 1.0, 1.0]),
    "right": np.array([1.0, 1.0, -1.0, -1.0]),
    "all": -np.ones(4),
    "one": np.array([1.0, -1.0, 1.0, 1.0]),
}
SCANNING = Vehicle(0.1, 0.42, 0.34, 0.6, 0.45, 0.9, wheels_hz=20.0, imu_hz=40.0, scan_hz=8.0, beams=160, room=(11.0, 9.0), seed=51)


def signs(kind: str) -> Change:
    return lambda position, velocity: (SIGNS[kind] * position, SIGNS[kind] * velocity)


def scaled(angle: float | None, rate: float | None) -> Change:
    """Positions and velocities in units of ``angle`` [rad] and ``rate`` [rad/s]; None where the driver has none."""
    return lambda position, velocity: (NOTHING if angle is None else position / angle, NOTHING if rate is None else velocity / rate)


def set_up_of(path: Path) -> SetUp:
    return infer_set_up(open_log(path, ROBOT))


def scanned(tmp_path: Path, how: Publishing, vehicle: Vehicle = SCANNING) -> SetUp:
    log = entrance_drives.write(tmp_path / "log.mcap", vehicle, entrance_drives.drive(vehicle), how)
    return infer_set_up(open_log(log, vehicle.robot()))


def faults(found: SetUp) -> set[str]:
    return {row.id for row in found.faults}


@pytest.mark.parametrize("name", ["base-log", "H07-one-message-per-wheel"])
def test_healthy_log_has_no_sentence(name: str) -> None:
    found = open_log_with_set_up(CASES / name / "log.mcap", ROBOT)
    assert (found.set_up.verdict, found.set_up.sentences, found.log.robot) == ("consistent", (), ROBOT)


def test_a_log_is_asked_once_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(entrance, "infer", lambda *question: asked.append(question) or infer(*question))
    log = drive(tmp_path / "log.mcap")
    first, again = open_log_with_set_up(log, ROBOT), open_log_with_set_up(log, ROBOT)
    assert first.set_up is again.set_up
    assert first.log is not again.log
    assert len(asked) == 1
    drive(log, signs("left"))
    assert open_log_with_set_up(log, ROBOT).set_up.verdict == "certain"
    assert len(asked) == 2


@pytest.mark.parametrize(("kind", "reversed_"), cases([("left", LEFT), ("right", RIGHT), ("one", ("rear_left_wheel",))], usual=["left"]))
def test_reversed_wheels_are_corrected_by_a_gyro_alone(tmp_path: Path, kind: str, reversed_: tuple[str, ...]) -> None:
    found = set_up_of(drive(tmp_path / "log.mcap", signs(kind)))
    assert found.robot.joints.reversed == reversed_
    assert "joints.reversed" in found.sentences[0]
    (tmp_path / "r.toml").write_text(robot_toml(found.robot))
    assert infer_set_up(open_log(tmp_path / "log.mcap", load_robot(tmp_path / "r.toml"))).sentences == ()


def test_axles_named_for_sides_are_corrected(tmp_path: Path) -> None:
    found = set_up_of(drive(tmp_path / "log.mcap", names=(LEFT[0], RIGHT[0], LEFT[1], RIGHT[1])))
    assert {*found.robot.joints.left} == {LEFT[0], RIGHT[0]}


@pytest.mark.parametrize(("side", "unit"), cases([("right", 60.0 / math.tau), ("left", 180.0 / math.pi)], ["right"]))
def test_one_side_in_another_unit_is_corrected(tmp_path: Path, side: str, unit: float) -> None:
    factors = np.where(SIGNS[side] < 0.0, unit, 1.0)
    found = set_up_of(drive(tmp_path / "log.mcap", lambda position, velocity: (NOTHING, factors * velocity)))
    multipliers = np.array([unit if side == "left" else 1.0, unit if side == "right" else 1.0]) ** -1
    np.testing.assert_allclose(found.robot.geometry.radius_multipliers, multipliers, rtol=1e-6)


@pytest.mark.extended
@pytest.mark.parametrize("is_gyro", [False, True])
def test_two_sources_that_contradict_blame_none(tmp_path: Path, is_gyro: bool) -> None:
    names = (*LEFT, *RIGHT) if is_gyro else (*RIGHT, *LEFT)
    found = set_up_of(drive(tmp_path / "log.mcap", gyro=-1.0 if is_gyro else 1.0, names=names))
    assert found.is_ambiguous
    assert found.keys == {}
    assert not found.is_gyro_used
    named = {row.id for hypothesis in found.hypotheses for row in hypothesis.rows}
    assert {"wheels.sides_exchanged", "wheels.all_reversed"} <= named
    assert found.robot.wheel_noise.yaw_rad2_per_rad > 1.0


def test_one_source_alone_is_undecidable(tmp_path: Path) -> None:
    path = drive(tmp_path / "log.mcap", names=(*RIGHT, *LEFT))
    found = infer_set_up(open_log(path, ROBOT, TopicOverrides(imu="")))
    assert (found.verdict, found.sentences) == ("undecidable", ())
    assert "/joint_states alone measures the motion" in found.reason


def test_an_encoder_that_counts_nothing_is_left_out(tmp_path: Path) -> None:
    kept = np.array([1.0, 0.0, 1.0, 1.0])
    found = set_up_of(drive(tmp_path / "log.mcap", lambda position, velocity: (kept * position, kept * velocity)))
    assert (found.robot.joints.left, found.robot.joints.right) == (LEFT[:1], RIGHT)
    assert f"{LEFT[1]} counts nothing while another wheel of its side turns" in found.sentences[0]


@pytest.mark.extended
@pytest.mark.parametrize(("unit", "name"), [(math.tau / 60.0, "rpm"), (DEG, "deg/s"), (1.0 / 0.165, "m/s")])
def test_units_of_velocities_alone_are_corrected(tmp_path: Path, unit: float, name: str) -> None:
    found = set_up_of(drive(tmp_path / "log.mcap", scaled(None, unit)))
    assert re.search(f"in (rev/s or )?{name}, not in rad/s", found.sentences[0])
    named = (unit, math.tau) if "rev/s or" in found.sentences[0] else (unit,)  # k is not known to the 4 % that are between the two
    assert any(found.robot.joints.rate_unit_rad_s == pytest.approx(one, rel=1e-3) for one in named)


def test_units_of_positions_alone_are_measured(tmp_path: Path) -> None:
    found = set_up_of(drive(tmp_path / "log.mcap", scaled(TICKS, None)))
    assert any("wheels.factor" in {row.id for row in hypothesis.rows} for hypothesis in found.hypotheses)
    assert found.robot.joints.angle_unit_rad == pytest.approx(TICKS, rel=1.1)  # by the turns alone, whose k is known to a quarter


def test_units_of_positions_beside_right_velocities_are_exact(tmp_path: Path) -> None:
    found = set_up_of(drive(tmp_path / "log.mcap", scaled(TICKS, 1.0)))
    assert found.robot.joints.angle_unit_rad == pytest.approx(TICKS, rel=0.01)
    assert found.robot.joints.rate_unit_rad_s == 1.0


def test_counter_of_16_bits_loses_no_motion(tmp_path: Path) -> None:
    def wrapped(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.mod(position / (TICKS / 16.0) + 60000.0, 65536.0), NOTHING

    log = open_log_with_set_up(drive(tmp_path / "log.mcap", wrapped), ROBOT).log
    assert log.robot.joints.angle_range == 65536.0
    turned = [event.position for event in log.events() if isinstance(event, WheelSample)]
    whole = [event.position for event in open_log(CASES / "base-log" / "log.mcap", ROBOT).events() if isinstance(event, WheelSample)]
    np.testing.assert_allclose(turned[-1] - turned[0], whole[-1] - whole[0], rtol=0.15)


def test_positions_that_are_reset_once_are_no_counter(tmp_path: Path) -> None:
    numbers = itertools.count()

    def reset(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (position - 30.0 if next(numbers) > 500 else position), velocity

    assert set_up_of(drive(tmp_path / "log.mcap", reset)).sentences == ()


@pytest.mark.extended
@pytest.mark.parametrize(("is_first", "since_s", "until_s"), [(True, None, 30.0), (False, 30.0, None)], ids=["until", "since"])
def test_velocities_that_double_within_a_log_are_named_with_the_time(
    tmp_path: Path, is_first: bool, since_s: float | None, until_s: float | None
) -> None:
    numbers = itertools.count()

    def doubled(position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return NOTHING, 2.0 * velocity if (next(numbers) < 300) == is_first else velocity

    (row,) = set_up_of(drive(tmp_path / "log.mcap", doubled)).faults
    assert (row.id, row.since_s, row.until_s) == ("wheels.factor", pytest.approx(since_s, abs=1.0), pytest.approx(until_s, abs=1.0))
    assert row.value == pytest.approx(0.5, rel=0.1)


def test_velocities_without_a_sign_are_named_beside_angles(tmp_path: Path) -> None:
    found = set_up_of(drive(tmp_path / "log.mcap", lambda position, velocity: (position, np.abs(velocity))))
    assert faults(found) == {"wheels.unsigned_velocities"}
    assert found.robot == ROBOT


def test_gyro_in_degrees_is_corrected(tmp_path: Path) -> None:
    found = set_up_of(drive(tmp_path / "log.mcap", gyro=1.0 / DEG))
    assert found.robot.imu.rate_unit_rad_s == pytest.approx(DEG, rel=1e-4)


def test_driver_that_corrects_for_skidding_has_its_multiplier_found() -> None:
    found = infer_set_up(open_log(CASES / "H12-odometry-in-tf-only" / "log.mcap", ROBOT))
    assert found.robot.driver.wheel_separation_multiplier == pytest.approx(1.0 / 0.55, rel=0.05)


MOUNTS: dict[str, tuple[Publishing, set[str]]] = {
    "yaw 90": (Publishing(lidar_yaw=math.pi / 2), {"lidar.yaw"}),
    "yaw 30": (Publishing(lidar_yaw=math.radians(30.0)), {"lidar.yaw"}),
    "upside down": (Publishing(lidar_flip=True), {"lidar.upside_down"}),
    "clock": (Publishing(offsets_s={"/imu/data": 0.6}), {"clock.gyro"}),
    "turned and a clock": (Publishing(lidar_yaw=math.pi, offsets_s={"/imu/data": -0.4}), {"lidar.yaw", "clock.gyro"}),
    "left reversed, yaw -90": (
        Publishing(lambda a, r: (SIGNS["left"] * a, SIGNS["left"] * r), lidar_yaw=-math.pi / 2),
        {"wheels.left_reversed", "lidar.yaw"},
    ),
    "rpm, yaw 60": (Publishing(lambda a, r: (NOTHING, 9.5493 * r), lidar_yaw=math.radians(60.0)), {"wheels.unit", "lidar.yaw"}),
}


@pytest.mark.parametrize("name", cases(MOUNTS, usual=["left reversed, yaw -90"]))
def test_faults_beside_a_lidar_are_found_together(tmp_path: Path, name: str) -> None:
    how, right = MOUNTS[name]
    found = scanned(tmp_path, how)
    assert (found.verdict, faults(found)) == ("certain", right)


@pytest.mark.extended
def test_gyro_reversed_beside_a_turned_lidar_leaves_the_gyro_open_and_turns_the_lidar(tmp_path: Path) -> None:
    """Left and right exchanged beside a LiDAR upside down turn alike, and gravity measures that the gyro is upright.

    The LiDAR is ahead of the front axle: nearer, a load could make up for the place that it has where the robot drives backwards.
    """
    found = scanned(tmp_path, Publishing(gyro=-1.0, lidar_yaw=math.pi, lidar_ahead_m=0.35))
    assert found.is_ambiguous
    assert faults(found) == {"gyro.reversed", "lidar.yaw"}
    assert found.robot.mounts["laser"].yaw == pytest.approx(math.pi)
    assert found.robot.imu.rate_unit_rad_s == 1.0


@pytest.mark.extended
def test_lidar_at_the_rear_that_is_described_at_the_front_or_a_robot_whose_front_is_its_back(tmp_path: Path) -> None:
    """Nothing in the log tells the two apart: both are named, and nothing is corrected."""
    path, vehicle, _ = rear_lidar_described_at_the_front(tmp_path)
    found = open_log_with_set_up(path, vehicle.robot()).set_up
    named = [{row.id for row in hypothesis.rows} for hypothesis in found.hypotheses]
    assert {"lidar.yaw", "lidar.place"} in named
    assert {"wheels.sides_exchanged", "wheels.all_reversed"} in named
    assert found.keys == {}


@pytest.mark.extended
@pytest.mark.parametrize("degrees", [0.0, 3.0])
def test_lidar_yaw_of_a_few_degrees_is_kept(tmp_path: Path, degrees: float) -> None:
    assert scanned(tmp_path, Publishing(lidar_yaw=math.radians(degrees))).sentences == ()


def test_mounts_by_two_rows_have_both_corrections() -> None:
    mount = Mount(0.3, 0.0, 0.2)
    turned = mount_correction("laser", mount, lambda m: replace(m, yaw=1.0))
    moved = mount_correction("laser", mount, lambda m: replace(m, x=-0.3))
    assert moved(turned(ROBOT)).mounts["laser"] == turned(moved(ROBOT)).mounts["laser"] == Mount(-0.3, 0.0, 0.2, yaw=1.0)


NO_GYRO = replace(SCANNING, imu_hz=0.0)


@pytest.mark.extended
@pytest.mark.parametrize("late_s", [0.5, -1.5])
def test_clock_of_two_sources_that_is_not_the_recorders_is_corrected(tmp_path: Path, late_s: float) -> None:
    found = scanned(tmp_path, Publishing(offsets_s={"/scan": late_s}), NO_GYRO)
    assert (found.verdict, faults(found)) == ("certain", {"clock.lidar"})
    assert found.robot.clock.lidar_time_offset_s == pytest.approx(late_s, abs=0.04)


@pytest.mark.extended
def test_clocks_of_two_sources_are_brought_together(tmp_path: Path) -> None:
    """Which of both is off is not in a log recorded by its stamps: the alignment is, and the covariance has the way in that time."""
    records = entrance_drives.records_of(NO_GYRO, entrance_drives.drive(NO_GYRO), Publishing(offsets_s={"/scan": 0.5}))
    by_stamps = [(t, m, stamp_of(m) if hasattr(m, "header") else at) for t, m, at in records]
    path = bags.write_mcap(tmp_path / "log.mcap", sorted(by_stamps, key=lambda record: record[2]))
    found = infer_set_up(open_log(path, NO_GYRO.robot()))
    assert found.is_ambiguous
    assert found.robot.clock.wheel_time_offset_s == pytest.approx(-0.5, abs=0.04)
    assert found.robot.clock.sigma_s == pytest.approx(0.5, abs=0.04)


@pytest.mark.extended
def test_answers_do_not_depend_on_the_names_of_the_sides(tmp_path: Path) -> None:
    """A fault and its mirror image have the same probability."""
    made: list[Callable[[], SetUp]] = [
        lambda kind=kind: set_up_of(drive(tmp_path / f"{kind}.mcap", signs(kind)))  # type: ignore[misc]
        for kind in ("left", "right")
    ]
    left, right = (make().hypotheses[0].probability for make in made)
    assert left == pytest.approx(right, abs=0.01)


def test_log_for_notebooks_has_the_corrected_robot() -> None:
    log = skidloc.open(CASES / "H06-right-side-inverted" / "log.mcap", ROBOT)
    assert log.robot.joints.reversed == RIGHT
    assert "the right side counts backwards" in " ".join(log.log.warnings())


@pytest.mark.parametrize("command", ["calibrate", "diagnose"])
def test_what_is_fitted_has_the_set_up_corrected_and_writes_it(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / ("r.toml" if command == "calibrate" else "r")
    options = ["--robot", str(ROBOT_TOML), "--model", "skid_steer", "--out", str(out)]
    assert main([command, str(CASES / "H06-right-side-inverted" / "log.mcap"), *options]) == 0
    printed = capsys.readouterr().out
    assert 'Written to the robot file: joints.reversed = ["front_right_wheel", "rear_right_wheel"]' in printed
    assert printed.count("the right side counts backwards") == 1
    assert command == "calibrate" or "With that corrected, skid_steer fits this drive" in printed
    assert "Corrected in this run" not in printed
    assert load_robot(str(out if command == "calibrate" else out / "robot.toml")).joints.reversed == RIGHT


@pytest.mark.extended
def test_weigh_names_the_set_up_that_it_corrects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, robot = bag(tmp_path / "drive.mcap", {}, 3, "husky_a200"), load_robot("husky_a200")
    swapped = replace(robot, joints=replace(robot.joints, left=robot.joints.right, right=robot.joints.left))
    given, out = tmp_path / "given.toml", tmp_path / "new.toml"
    given.write_text(robot_toml(swapped))
    assert main(["weigh", str(log), "--robot", str(given), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "left and right wheels are exchanged" in printed
    assert "Written to the robot file: joints.left" in printed
    assert load_robot(str(out)).joints == robot.joints


@pytest.mark.parametrize("command", ["calibrate", "diagnose"])
def test_nothing_is_fitted_where_several_set_ups_remain(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wheels and gyro alone turn to opposite sides: either may be the wrong one."""
    log = CASES / "H06-right-side-inverted" / "log.mcap"
    found = open_log_with_set_up(log, ROBOT)
    open_set_up = replace(
        found.set_up, verdict="ambiguous", sentences=(message("set_up.ambiguous", sources="A and B", ways="C", record=""),)
    )
    monkeypatch.setattr(entrance, "open_log_with_set_up", lambda *given: replace(found, set_up=open_set_up))
    assert main([command, str(log), "--robot", str(ROBOT_TOML)]) == 2
    assert "A and B contradict each other" in (error := capsys.readouterr().err)
    assert "Nothing is fitted to sensors that contradict each other." in error


@pytest.mark.extended
def test_replay_with_the_right_side_inverted_is_as_the_healthy_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--model", "skid_steer", "--estimator", "odometry,ekf", "--reference", str(CASES / "base-log" / "reference.tum")]
    log = CASES / "H06-right-side-inverted" / "log.mcap"
    assert main(["replay", str(log), "--robot", str(ROBOT_TOML), *options, "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert all(result["ate_rmse_m"] < 0.02 for result in metrics["results"])
    text = "the right side counts backwards"
    assert text in capsys.readouterr().out
    assert text in " ".join(metrics["notes"])
    assert text in (tmp_path / "out" / "report.html").read_text()
