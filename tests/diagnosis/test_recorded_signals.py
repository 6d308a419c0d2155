"""Torques and temperatures of a log, as far as they vary."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from localization.diagnosis.recorded_signals import Signal, read_signals
from localization.logs import open_log
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import STORE
from tests.helpers.wiring import LEFT, RIGHT, ROBOT_TOML

_COUNT = 60


def recorded(path: Path, efforts: np.ndarray, kelvin: np.ndarray) -> tuple[Signal, ...]:
    """Signals of a log with the ``efforts`` (n, 4) of `LEFT` and `RIGHT` [N m] and the temperature ``kelvin`` (n,) of a motor."""
    temperature = STORE.types["sensor_msgs/msg/Temperature"]
    records = []
    for i, (effort, degrees) in enumerate(zip(efforts, kelvin, strict=True)):
        stamp = (100 + i) * bags.S // 10
        state = bags.joint_state(stamp, (*LEFT, *RIGHT), np.full(4, 0.1 * i), np.ones(4))
        records.append(("/joint_states", dataclasses.replace(state, effort=effort), stamp))
        records.append(("/motor", temperature(state.header, float(degrees), 0.0), stamp))
    robot = dataclasses.replace(load_robot(ROBOT_TOML), joints=dataclasses.replace(load_robot(ROBOT_TOML).joints, reversed=RIGHT))
    return read_signals(open_log(bags.write_mcap(path, records), robot))


def test_read_signals_sums_the_torques_of_each_side(tmp_path: Path) -> None:
    wave = np.sin(np.arange(_COUNT) / 5.0)
    efforts = np.outer(wave, [1.0, 2.0, -0.5, -0.5]) + np.array([0.5, 0.5, 0.0, 0.0])
    left, right, motor = read = recorded(tmp_path / "log.mcap", efforts, 300.0 + 5.0 * wave)
    assert [signal.name for signal in read] == ["the left wheels' torque", "the right wheels' torque", "the temperature of /motor"]
    assert left.values == pytest.approx(3.0 * wave + 1.0)
    assert right.values == pytest.approx(wave)  # the right motors are mounted in mirror image
    assert motor.values == pytest.approx(300.0 + 5.0 * wave)
    assert left.at(left.stamps_ns) == pytest.approx(3.0 * (wave - wave.mean()))


@pytest.mark.parametrize(
    "efforts", [np.zeros((_COUNT, 4)), np.full((_COUNT, 4), np.nan), np.zeros((_COUNT, 0))], ids=["zero", "nan", "none"]
)
def test_read_signals_without_torques_has_none(efforts: np.ndarray, tmp_path: Path) -> None:
    assert recorded(tmp_path / "log.mcap", efforts, np.full(_COUNT, 300.0)) == ()


def test_read_signals_leaves_out_what_is_not_finite(tmp_path: Path) -> None:
    kelvin = 300.0 + np.arange(_COUNT, dtype=float)
    kelvin[3] = np.nan
    (motor,) = recorded(tmp_path / "log.mcap", np.zeros((_COUNT, 4)), kelvin)
    assert len(motor.values) == _COUNT - 1
    assert np.isfinite(motor.values).all()
