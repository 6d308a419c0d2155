"""Sentences of all commands on logs without a sensor: none is about one that was not there."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from localization.cli import main
from tests.helpers import bags
from tests.helpers.bags import S
from tests.helpers.entrance_drives import Publishing, Vehicle, drive, write
from tests.helpers.extended import cases

START = 1_700_000_000 * S
GYRO = r"gyro's|by (the )?gyro|and gyro|gyro alone|only headings|headings alone|gyro \+|axes of IMU"
LIDAR = r"LiDAR alone|by (the )?LiDAR|and LiDAR|scan matching|wheels and scans|mount of LiDAR|along walls"
WHEELS = r"by (the )?wheels|and wheels|wheels alone|wheels' (stamps|clock|radius)|dead reckoning|wheels and scans|slip"
REFERENCE = r"against /|position error|mean NEES|covers only"
COMMANDS = {
    "info": (),
    "init": ("--out", "new.toml"),
    "check": ("--out", "out"),
    "weigh": (),
    "diagnose": ("--out", "out"),
    "calibrate": (),
    "replay": ("--model", "skid_steer", "--out", "out"),
    "compare": ("--model", "skid_steer", "--out", "out"),
}


def log_of(path: Path, has_imu: bool) -> Path:
    """Half a minute of wheels that stand, drive straight and turn both ways, and the gyro's rates of k = 0.5."""
    records, angles = [], np.zeros(2)
    names = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")
    for i in range(600):
        stamp = START + i * S // 20
        rates = np.array([(0.0, 0.0), (3.0, 3.0), (-2.0, 2.0), (3.0, 3.0), (2.0, -2.0), (3.0, 2.0)][i // 100])
        angles = angles + rates / 20.0
        records.append(("/joint_states", bags.joint_state(stamp, names, np.repeat(angles, 2), np.repeat(rates, 2)), stamp))
        if has_imu:
            turn = 0.5 * 0.165 / 0.555 * (rates[1] - rates[0])
            records.append(("/imu/data", bags.imu(stamp, (0.0, 0.0, turn), (0.0, 0.0, 9.81), "imu_link"), stamp))
    return bags.write_mcap(path, records)


def texts(command: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """All that a command prints."""
    options: Sequence[str] = [str(tmp_path / option) if option in ("out", "new.toml") else option for option in COMMANDS[command]]
    robot = ("--like", "husky_a200") if command == "init" else ("--robot", "husky_a200")
    assert main([command, str(log), *robot, *options]) in (0, 2)
    shown = capsys.readouterr()
    return " ".join((shown.out + shown.err).split())


@pytest.mark.parametrize("command", cases(COMMANDS, usual=["info", "weigh", "diagnose", "calibrate"]))
def test_sentences_on_wheels_alone_name_no_other_sensor(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = texts(command, log_of(tmp_path / "log.mcap", has_imu=False), tmp_path, capsys)
    assert text
    assert re.findall(f"{GYRO}|{LIDAR}|{REFERENCE}", text) == []


@pytest.mark.extended
@pytest.mark.parametrize("command", COMMANDS)
def test_sentences_on_wheels_and_lidar_name_no_gyro(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = Vehicle(0.165, 0.555, 0.512, 0.5, imu_hz=0.0, scan_hz=5.0, beams=120, seed=61)
    motion = drive(vehicle)
    text = texts(command, write(tmp_path / "log.mcap", vehicle, motion, Publishing()), tmp_path, capsys)
    assert re.findall(f"{GYRO}|{REFERENCE}", text) == []


@pytest.mark.extended
@pytest.mark.parametrize("command", COMMANDS)
def test_sentences_on_wheels_and_gyro_name_no_other_sensor(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = texts(command, log_of(tmp_path / "log.mcap", has_imu=True), tmp_path, capsys)
    assert re.findall(f"{LIDAR}|{REFERENCE}", text) == []
    assert "without it or a gyro" not in text


@pytest.mark.extended
def test_sentences_on_lidar_and_gyro_name_no_wheels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = Vehicle(0.165, 0.555, 0.512, 0.5, scan_hz=5.0, beams=120, seed=62)
    log = write(tmp_path / "log.mcap", vehicle, drive(vehicle), Publishing(forms="none"))
    options = ["--robot", "husky_a200", "--estimator", "lidar", "--model", "skid_steer", "--out", str(tmp_path / "out")]
    assert main(["replay", str(log), *options]) == 0
    shown = capsys.readouterr()
    assert re.findall(f"{WHEELS}|{REFERENCE}", shown.out + shown.err) == []
    for command in ("check", "calibrate", "diagnose", "weigh"):
        text = texts(command, log, tmp_path / command, capsys)
        assert "no wheels" in text
        assert re.findall(f"{WHEELS}|{REFERENCE}", text) == []
