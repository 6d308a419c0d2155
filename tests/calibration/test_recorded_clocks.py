"""Clocks that are off by the times of recording, where turns of another sensor confirm it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from localization.calibration import recorded_clocks
from localization.calibration.wheel_signals import read_signals
from localization.calibration.wheel_wiring import WiringReport, check_wiring
from localization.logs import open_log
from tests.helpers import bags
from tests.helpers.bags import START, Record, S
from tests.helpers.entrance_drives import Publishing, Vehicle, drive, records_of, with_times

GYRO = Vehicle(seed=501)
LIDAR = Vehicle(imu_hz=0.0, scan_hz=8.0, beams=120, seed=502)


def report_of(folder: Path, vehicle: Vehicle, edit: Callable[[Record], Record]) -> WiringReport:
    records = sorted((edit(r) for r in records_of(vehicle, drive(vehicle), Publishing())), key=lambda record: record[2])
    return check_wiring(open_log(bags.write_mcap(folder / "log.mcap", records), vehicle.robot()))


def restamped(topic: str, late_s: Callable[[float], float]) -> Callable[[Record], Record]:
    """Stamps later by a function of the time of measurement [s]; recorded as before."""

    def edit(record: Record) -> Record:
        if record[0] != topic:
            return record
        return topic, with_times(record[1], lambda ns: ns + round(late_s((ns - START) / S) * S)), record[2]

    return edit


def queued(topic: str, late_s: Callable[[float], float]) -> Callable[[Record], Record]:
    """Recorded later by a function of the time of measurement [s]; stamps as before."""
    return lambda r: (r[0], r[1], r[2] + round(late_s((r[2] - START) / S) * S)) if r[0] == topic else r


@pytest.mark.parametrize(
    ("vehicle", "topic", "key", "late_s"),
    [
        (GYRO, "/imu/data", "gyro_time_offset_s", 0.4),
        (GYRO, "/joint_states", "wheel_time_offset_s", -0.4),
        (LIDAR, "/scan", "lidar_time_offset_s", 0.6),
        (LIDAR, "/joint_states", "wheel_time_offset_s", -0.6),
    ],
)
def test_recorded_clock_of_one_of_two_sensors_is_corrected(tmp_path: Path, vehicle: Vehicle, topic: str, key: str, late_s: float) -> None:
    report = report_of(tmp_path, vehicle, restamped(topic, lambda t: late_s))
    assert list(report.keys) == [f"clock.{key}"]
    assert getattr(report.robot.clock, key) == pytest.approx(late_s, abs=0.03)
    assert topic in report.findings[0]


@pytest.mark.parametrize(("topic", "key", "rate"), [("/imu/data", "gyro_rate_error", -0.012), ("/joint_states", "wheel_rate_error", 0.015)])
def test_recorded_clock_of_another_rate_is_corrected(tmp_path: Path, topic: str, key: str, rate: float) -> None:
    report = report_of(tmp_path, GYRO, restamped(topic, lambda t: rate * t))
    assert list(report.keys) == [f"clock.{key}"]
    assert getattr(report.robot.clock, key) == pytest.approx(rate, rel=0.1)


@pytest.mark.parametrize("late_s", [lambda t: 0.5, lambda t: 0.012 * t])
def test_recorded_clock_of_stamps_that_are_right_is_left(tmp_path: Path, late_s: Callable[[float], float]) -> None:
    """A queue delivers late what was stamped as it was measured."""
    assert report_of(tmp_path, GYRO, queued("/imu/data", late_s)).keys == {}
    assert "/imu/data" in {suspect.topic for suspect in recorded_clocks.find_suspects(open_log(tmp_path / "log.mcap", GYRO.robot()))}


def test_recorded_clock_of_the_center_of_gravity_is_none_of_a_sensor(tmp_path: Path) -> None:
    records = [*records_of(GYRO, drive(GYRO), Publishing())]
    records += [
        ("/center_of_gravity", bags.point_stamped(log + round(0.015 * (log - START)), 0.0, 0.0), log)
        for topic, _, log in records
        if topic == "/joint_states"
    ]
    log = open_log(bags.write_mcap(tmp_path / "log.mcap", sorted(records, key=lambda record: record[2])), GYRO.robot())
    assert "/center_of_gravity" in log.rate_errors()
    assert check_wiring(log).keys == {}


def test_recorded_clock_of_an_undecided_rate_does_not_hide_an_offset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records = sorted(records_of(GYRO, drive(GYRO), Publishing()), key=lambda record: record[2])
    log = open_log(bags.write_mcap(tmp_path / "log.mcap", records), GYRO.robot())
    signals = read_signals(log)
    assert signals is not None
    suspects = [
        recorded_clocks.Suspect("gyro", "/imu/data", "gyro_rate_error", 0.01, "of another rate"),
        recorded_clocks.Suspect("gyro", "/imu/data", "gyro_time_offset_s", 0.4, "late"),
    ]
    monkeypatch.setattr(recorded_clocks, "find_suspects", lambda log: iter(suspects))
    noise = np.random.default_rng(3).normal(size=len(signals.turns["gyro"]))
    found = recorded_clocks.find_recorded_clock(log, signals, lambda of: np.resize(noise, len(of.turns["gyro"])))
    assert found is not None
    assert "gyro_time_offset_s" in found.text
    assert found.robot.clock.sigma_s == pytest.approx(0.4)


def test_recorded_clock_that_turns_do_not_show_is_named(tmp_path: Path) -> None:
    """Of wheels that slip so much that they agree with the gyro at no offset."""
    rng = np.random.default_rng(7)
    late = restamped("/imu/data", lambda t: -0.4)

    def edit(record: Record) -> Record:
        topic, message, log = late(record)
        if topic == "/imu/data":
            message.angular_velocity.z += 0.8 * rng.normal() + 0.8 * np.sin(0.9 * (log - START) / S)
        return topic, message, log

    report = report_of(tmp_path, GYRO, edit)
    assert report.keys == {}
    assert "waits in a queue" in report.findings[0]
    assert report.robot.clock.sigma_s == pytest.approx(0.41, abs=0.03)
