"""A computer's clock that is set forward on the way, and recorders that pause."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from localization.events import WheelSample
from localization.logs import open_log
from motion_models.robot_file import load_robot
from tests.helpers import bags
from tests.helpers.bags import START, Record, S

NAMES = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")
STEP_S = 600.0


def drive(path: Path, angle: Callable[[float], float], has_rates: bool = True, is_odometry: bool = False) -> Path:
    """20 s of wheels and gyro; all clocks jump by `STEP_S` after 10 s. ``angle``: of the time of the robot's own clock."""
    records: list[Record] = []
    for i in range(400):
        t = i / 20.0 + (STEP_S if i >= 200 else 0.0)
        stamp = START + round(t * S)
        angles = np.full(4, angle(t))
        rates = np.full(4, 2.0) if has_rates else []
        if is_odometry:
            records.append(("/odom", bags.odometry(stamp, 0.165 * angle(t), 0.0, 0.0, 0.33, 0.0), stamp + S // 100))
        else:
            records.append(("/joint_states", bags.joint_state(stamp, NAMES, angles, rates), stamp + S // 100))
        records.append(("/imu/data", bags.imu(stamp, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), "imu_link"), stamp + S // 100))
    return bags.write_mcap(path, records)


def as_if_set(t: float) -> float:
    """Angle of a wheel that turns at 2 rad/s, whose clock is set after 10 s."""
    return 2.0 * (t - (STEP_S if t > 100.0 else 0.0))


@pytest.mark.parametrize("is_odometry", [False, True])
def test_clock_set_forward_while_wheels_turn_is_undone(tmp_path: Path, is_odometry: bool) -> None:
    log = open_log(drive(tmp_path / "log.mcap", as_if_set, is_odometry=is_odometry), load_robot("husky_a200"))
    stamps = np.array([event.stamp_ns for event in log.events() if isinstance(event, WheelSample)])
    assert np.diff(stamps).max() < S // 5
    assert "clock was set forward by 600.0 s, 10.0 s after the start" in " ".join(log.warnings())


def test_message_stamped_before_the_clock_was_set_keeps_its_stamp(tmp_path: Path) -> None:
    """It was on its way while the clock was set: recorded after it."""
    records = []
    for i in range(400):
        measured, jump = START + i * S // 20, round(STEP_S * S)
        stamp, recorded = (measured + (jump if i >= at else 0) for at in (201, 200))
        records.append(("/joint_states", bags.joint_state(stamp, NAMES, np.full(4, i / 10.0), np.full(4, 2.0)), recorded + S // 100))
    log = open_log(bags.write_mcap(tmp_path / "log.mcap", records), load_robot("husky_a200"))
    stamps = np.array([event.stamp_ns for event in log.events() if isinstance(event, WheelSample)])
    np.testing.assert_allclose(np.diff(stamps) * 1e-9, 0.05, atol=1e-6)
    assert "clock was set forward by 600.0 s" in " ".join(log.warnings())


@pytest.mark.parametrize(
    "angle",
    [
        pytest.param(lambda t: 2.0 * t, id="they turned on"),
        pytest.param(lambda t: 3.0, id="they stand"),
        pytest.param(lambda t: 2.0 * t if t < 100.0 else 2.0 * (t - STEP_S) + 1.5, id="another angle"),
    ],
)
def test_pause_of_the_recorder_is_none(tmp_path: Path, angle: Callable[[float], float]) -> None:
    log = open_log(drive(tmp_path / "log.mcap", angle), load_robot("husky_a200"))
    last = max(event.stamp_ns for event in log.events())
    assert last > START + round(STEP_S * S)
    assert "set forward by" not in " ".join(log.warnings())
