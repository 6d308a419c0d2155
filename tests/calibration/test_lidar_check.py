"""The yaw of a LiDAR's mount by the direction of travel."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from localization.calibration.lidar_check import LidarCheck, check_lidar, corrected, open_log_checked, with_priors
from localization.evaluation.references import reference_track
from localization.evaluation.scores import score
from localization.events import ImuSample, Scan, WheelSample
from localization.log_replay import replay
from localization.logs import Log, open_log
from localization.pipeline import Trial
from motion_models import se2
from motion_models.registry import make_model
from motion_models.robot import Mount
from motion_models.robot_file import load_robot
from tests.helpers.bags import S, write_mcap
from tests.helpers.entrance_drives import Publishing, Vehicle, drive, records_of, write
from tests.helpers.extended import cases
from tests.helpers.hostile_logs import Case, write_case
from tests.helpers.hostile_mounts import rear_lidar_described_at_the_front
from tests.helpers.online import ROBOT, drive_log
from tests.studies.lidar_mounts import found_on

CASE = Path(__file__).parents[1] / "data" / "cases" / "H11-lidar-yaw-180"


def opened() -> Log:
    return open_log(CASE / "log.mcap", load_robot(CASE / "robot.toml"))


def turned(log: Log, degrees: float) -> Log:
    """``log`` with its LiDAR's mount turned by ``degrees`` from the right one."""
    right = math.pi  # of the case
    mounts = {**log.mounts, "laser": dataclasses.replace(log.mounts["laser"], yaw=right + math.radians(degrees))}
    log.__dict__["mounts"] = mounts
    return log


@pytest.mark.extended
def test_lidar_yaw_of_180_deg_is_named_and_corrected() -> None:
    """Four scans of 80 beams a second."""
    log = opened()
    found = check_lidar(log)
    assert found is not None
    assert found.mount is not None
    assert found.mount.yaw == pytest.approx(math.pi)
    assert "the yaw of 'laser' is wrong by 180 deg" in found.text
    trial = Trial(make_model("skid_steer", log.robot), "ekf")
    (run,) = replay(log.events(), [trial], log.robot, corrected(log.mounts, found), has_lidar=True)
    result = score([run], reference_track(log.references("/ground_truth/odom"), "/ground_truth/odom"))[0]
    assert result.metrics(log.duration_s, with_timing=False)["ate_rmse_m"] < 0.02
    assert all("times of their points" in warning for warning in run.warnings)


@pytest.mark.parametrize("shift", cases([0.45, -0.45, 0.1], ("0.45", "0.1")))
def test_lidar_that_is_elsewhere_along_the_robot_is_found_in_turns(tmp_path: Path, shift: float) -> None:
    """Up to half the wheelbase of 0.4 m it may be the point about which the robot turns."""
    vehicle = Vehicle(scan_hz=8.0, seed=21)
    log = open_log(write(tmp_path / "log.mcap", vehicle, drive(vehicle), Publishing(lidar_ahead_m=0.15)), vehicle.robot())
    right = log.mounts["laser"]
    log.__dict__["mounts"] = {**log.mounts, "laser": dataclasses.replace(right, x=right.x + shift)}
    found = check_lidar(log)
    if abs(shift) < 0.2:
        assert found is None
        return
    assert found is not None
    assert found.mount is not None
    assert found.mount.x == pytest.approx(right.x, abs=0.02)
    assert f"{abs(shift):.2f} m {'behind' if shift > 0.0 else 'ahead of'} the mount of 'laser'" in found.text


@pytest.mark.extended
def test_robot_that_slides_outwards_in_one_curve_has_its_lidar_where_it_is(tmp_path: Path) -> None:
    """12 s of a simulated lap in which a turn begins within an interval."""
    log = write_case(Case(0, "laps", "mcap-file", "none", ""), tmp_path, 1)
    assert check_lidar(open_log(log, load_robot("vaultbot"))) is None


@pytest.mark.extended
@pytest.mark.parametrize("shift", [-0.45, 0.0, 0.45])
def test_place_of_a_lidar_shows_in_wide_curves(shift: float) -> None:
    """Laps of a robot that slides outwards, with its centre of gravity aside."""
    effects = {"cg_offset_x": 0.03, "lateral_slip_speed": 0.05, "lidar_offset_x": shift}
    found, _, left_m = found_on("pioneer_3at", "laps", 5, effects)
    assert len(found) == (shift != 0.0)
    assert abs(left_m) < 0.1


def test_lidar_at_the_rear_that_is_described_at_the_front_is_turned_and_moved(tmp_path: Path) -> None:
    log, vehicle, _ = rear_lidar_described_at_the_front(tmp_path)
    checked = open_log_checked(log, vehicle.robot())
    assert len(checked.lidar) == 2
    assert checked.mounts["laser"].x == pytest.approx(-0.3, abs=0.05)
    assert abs(checked.mounts["laser"].yaw) == pytest.approx(math.pi)


@pytest.mark.parametrize("late_s", [-0.4, 0.4])
def test_clock_of_a_gyro_is_found_beside_a_lidar_that_is_turned(tmp_path: Path, late_s: float) -> None:
    """The yaw is certain before the first turns show the clock."""
    vehicle = Vehicle(0.165, 0.555, 0.512, 0.5, scan_hz=8.0, beams=180, seed=91)
    how = Publishing(lidar_yaw=math.pi, offsets_s={"/imu/data": late_s})
    checked = open_log_checked(write(tmp_path / "log.mcap", vehicle, drive(vehicle), how), vehicle.robot())
    assert abs(checked.mounts["laser"].yaw) == pytest.approx(math.pi)
    assert checked.log.robot.clock.gyro_time_offset_s == pytest.approx(late_s, abs=0.03)
    assert len(checked.lidar) == 2


def test_place_of_a_lidar_is_open_on_a_circle() -> None:
    """Its yaw would explain the same motion."""
    sizes: list[tuple[float, float]] = []
    for way in (np.full(60, 0.4), np.linspace(-0.4, 0.4, 60)):
        turn = np.full(60, 0.2)
        columns = np.stack([np.sin(turn), 0.8 * turn * way, way], axis=1)
        sizes.append(with_priors(columns, 0.45 * np.sin(turn), np.array([math.inf, 0.1, 0.35])))
    (_, on_circle), (place, both_ways) = sizes
    assert on_circle > 0.3
    assert place == pytest.approx(0.45, abs=0.01)
    assert both_ways < 0.01


@pytest.mark.parametrize("degrees", cases([90.0, -90.0, 45.0, 30.0, 178.0], ("178.0",)))
def test_lidar_yaw_of_any_size_is_corrected(degrees: float) -> None:
    found = check_lidar(turned(opened(), degrees))
    assert found is not None
    assert found.mount is not None
    assert math.remainder(found.mount.yaw - math.pi, math.tau) == pytest.approx(0.0, abs=math.radians(2.5))


def test_lidar_whose_plane_stands_on_edge_is_taken_as_level() -> None:
    """A planar scan in an optical frame, whose z axis is ahead; its yaw, then zero, is wrong as well."""
    log = opened()
    mount = log.mounts["laser"]
    upright = Mount(mount.x, mount.y, mount.z, -math.pi / 2, 0.0, -math.pi / 2)
    log.__dict__["mounts"] = {**log.mounts, "laser": upright}
    found = check_lidar(log)
    assert found is not None
    assert found.mount is not None
    assert "stands on edge" in found.text
    assert (found.mount.roll, found.mount.pitch) == (0.0, 0.0)
    assert math.remainder(found.mount.yaw - math.pi, math.tau) == pytest.approx(0.0, abs=math.radians(2.5))


@pytest.mark.parametrize("degrees", cases([12.0, -7.0, 18.0], ("12.0",)))
def test_lidar_yaw_of_a_slides_size_shows_in_straight_driving(tmp_path: Path, degrees: float) -> None:
    """Over 3 m: skid-steer robots slide in turns."""
    vehicle = Vehicle(scan_hz=10.0, beams=180, imu_hz=0.0, seed=9)
    how = Publishing(lidar_yaw=math.radians(degrees))
    found = check_lidar(open_log(write(tmp_path / "log.mcap", vehicle, drive(vehicle), how), vehicle.robot()))
    assert found is not None
    assert found.mount is not None
    assert math.degrees(found.mount.yaw) == pytest.approx(degrees, abs=1.0)


@pytest.mark.parametrize("degrees", [0.0, 3.0])
def test_lidar_yaw_of_a_few_degrees_is_kept(tmp_path: Path, degrees: float) -> None:
    vehicle = Vehicle(scan_hz=10.0, beams=180, seed=10)
    how = Publishing(lidar_yaw=math.radians(degrees))
    assert check_lidar(open_log(write(tmp_path / "log.mcap", vehicle, drive(vehicle), how), vehicle.robot())) is None


def test_lidar_with_beams_on_the_robot_keeps_its_yaw(tmp_path: Path) -> None:
    """They stand still about it, which shortens and turns the way by the scans."""
    log = write_case(Case(0, "laps", "mcap", "30 % of beams on the robot", ""), tmp_path, 1)
    assert check_lidar(open_log(log, load_robot("vaultbot"))) is None


@pytest.mark.parametrize("degrees", [0.0, 10.0, -10.0])
def test_lidar_yaw_that_slides_explain_is_kept(degrees: float) -> None:
    """Of a drive with less than 3 m straight ahead."""
    assert check_lidar(turned(opened(), degrees)) is None


def test_lidar_that_is_turned_on_the_way_is_named_and_not_corrected(monkeypatch: pytest.MonkeyPatch) -> None:
    """By 40 deg after 5 s: no mount is right for the whole drive."""
    log = turned(opened(), 0.0)
    events = list(log.events())
    c, s = math.cos(math.radians(40.0)), math.sin(math.radians(40.0))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    bump_ns = events[0].stamp_ns + 5_000_000_000
    bumped = [dataclasses.replace(e, points=e.points @ R) if isinstance(e, Scan) and e.stamp_ns > bump_ns else e for e in events]
    monkeypatch.setattr(log, "events", lambda: iter(bumped))
    found = check_lidar(log)
    assert found is not None
    assert "was turned on the way" in found.text
    assert not found.is_corrected


def test_lidar_yaw_of_a_healthy_drive_is_kept() -> None:
    assert check_lidar(open_log(drive_log(), ROBOT)) is None


def test_lidar_yaw_without_a_turn_names_both_causes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wheels that all count backwards look alike while the robot drives straight on."""
    log, straight = opened(), []
    for event in log.events():
        if isinstance(event, WheelSample) and abs(event.velocity[0] - event.velocity[1]) > 0.05:
            break
        if not isinstance(event, ImuSample):
            straight.append(event)
    monkeypatch.setattr(log, "events", lambda: iter(straight))
    found = check_lidar(log)
    assert found is not None
    assert found.mount is None
    assert "or all wheels count backwards" in found.text


@pytest.mark.parametrize("late_s", [0.0, 0.35])
def test_lidar_that_begins_to_move_late_is_contradicted_by_wheels(tmp_path: Path, late_s: float) -> None:
    """As live: in order of arrival, with stamps of another clock; while it drives straight on, before a turn shows the clock."""
    vehicle = Vehicle(scan_hz=10.0, beams=90, seed=7)
    log = open_log(write(tmp_path / "log.mcap", vehicle, drive(vehicle), Publishing()), vehicle.robot())
    check, found = LidarCheck(log.mounts, log.robot, "/scan", has_gyro=True), []
    for event in log.events():
        late_ns = round(late_s * 1e9) if isinstance(event, Scan) else 0
        check.add(dataclasses.replace(event, stamp_ns=event.stamp_ns + late_ns))
        found.append(check.contradicted_way_m)
        if check.is_done or len(found) > 600:
            break
    assert max(found) == pytest.approx(0.5 * late_s, abs=0.1) if late_s else max(found) == 0.0


@pytest.mark.extended
def test_lidar_clock_apart_from_wheels_alone_is_in_the_covariance(tmp_path: Path) -> None:
    """From the first metre on; scans wait in a queue and are stamped as they leave it: neither a third sensor nor the times of recording
    show which of both clocks is off."""
    vehicle = Vehicle(scan_hz=8.0, imu_hz=0.0, seed=5)
    motion = drive(vehicle)
    records = records_of(vehicle, motion, Publishing(offsets_s={"/scan": 0.4}))
    queued = sorted(((t, m, log + (2 * S // 5 if t == "/scan" else 0)) for t, m, log in records), key=lambda record: record[2])
    checked = open_log_checked(write_mcap(tmp_path / "log.mcap", queued), vehicle.robot())
    assert checked.log.robot.clock.wheel_time_offset_s == pytest.approx(-0.4, abs=0.03)
    trial = Trial(make_model("skid_steer", checked.log.robot), "ekf")
    (run,) = replay(checked.log.events(), [trial], checked.log.robot, checked.mounts, has_lidar=True)
    truth, found = motion.trajectory(), run.trajectory
    inside = (found.stamps_ns >= truth.stamps_ns[0]) & (found.stamps_ns <= truth.stamps_ns[-1])
    true = truth.at(found.stamps_ns[inside])
    errors = np.linalg.norm((found.poses[inside] - se2.between(true[0], true))[:, :2], axis=1)
    assert found.covariances is not None
    sigmas = np.sqrt(np.trace(found.covariances[inside][:, :2, :2], axis1=1, axis2=2))
    assert (errors > 0.1).any()
    assert ((errors > 5.0 * sigmas) & (errors > 0.1)).mean() < 0.03  # where it begins to move, 0.4 s before that is measured
