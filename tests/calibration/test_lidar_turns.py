"""Turns by scans against wheels and gyro: a LiDAR upside down, or with another clock."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from localization.calibration.lidar_turns import GyroHeading, LidarTurns, compare_clocks, compare_turns
from localization.events import ImuSample

S = 1_000_000_000


def _compared(
    late_s: float = 0.0, sign: float = 1.0, wheels: float = 1.0, seconds: float = 40.0, wheels_late_s: float = 0.0
) -> LidarTurns | None:
    """Of a robot that turns both ways; its scans' and wheels' stamps are late, its wheels turn ``wheels`` times as far."""
    rng = np.random.default_rng(0)

    def heading(t: np.ndarray) -> np.ndarray:
        return 0.9 * np.sin(0.6 * t) + 0.2 * np.sin(1.7 * t)

    t = np.arange(0.0, seconds, 0.02)
    gyro = GyroHeading({})
    for at, rate in zip(t, np.gradient(heading(t), t), strict=True):
        gyro.add(ImuSample(round(at * S), np.array([0.0, 0.0, rate + 0.02]), np.array([0.0, 0.0, 9.81])))
    ends = np.arange(0.5, seconds, 0.5)
    turns = sign * (heading(ends - late_s) - heading(ends - 0.5 - late_s)) + 0.003 * rng.normal(size=len(ends))
    rows = [(round((end - 0.5) * S), round(end * S), np.array([0.1, 0.0, turn])) for end, turn in zip(ends, turns, strict=True)]
    return compare_turns(rows, (t, 0.7 * wheels * heading(t - wheels_late_s)), gyro, 0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("late_s", [0.35, -0.2, 1.2, 3.4, 0.0])
def test_lidar_clock_and_side_are_measured_by_turns(late_s: float, sign: float) -> None:
    found = _compared(late_s, sign)
    assert found is not None
    assert found.is_opposite == (sign < 0.0)
    assert found.sensor == "lidar"
    assert found.late_s == pytest.approx(late_s, abs=0.03)


@pytest.mark.parametrize(("scans_s", "wheels_s", "sensor", "late_s"), [(0.35, 0.35, "gyro", -0.35), (0.0, -0.3, "wheel", -0.3)])
def test_clock_of_the_one_of_three_sensors_that_is_odd_is_named(scans_s: float, wheels_s: float, sensor: str, late_s: float) -> None:
    found = _compared(scans_s, wheels_late_s=wheels_s)
    assert found is not None
    assert found.sensor == sensor
    assert found.late_s == pytest.approx(late_s, abs=0.03)


def test_clocks_that_all_differ_are_left_alone() -> None:
    assert _compared(0.35, wheels_late_s=-0.35) == LidarTurns()


@pytest.mark.parametrize("late_s", [0.0, 0.1, -0.1])
def test_lidar_clock_within_latencies_is_left_to_the_filter(late_s: float) -> None:
    assert _compared(late_s) == LidarTurns()


def test_lidar_is_not_blamed_where_wheels_and_gyro_disagree() -> None:
    assert _compared(0.35, -1.0, wheels=-1.0) == LidarTurns()


def test_lidar_turns_too_few_show_nothing() -> None:
    assert _compared(seconds=4.0) is None


def _wheels_late_s(late_s: float, heading: Callable[[np.ndarray], np.ndarray] = np.sin, seconds: float = 30.0) -> float | None:
    rng, t, ends = np.random.default_rng(1), np.arange(-2.0, seconds, 0.02), np.arange(0.5, seconds - 2.0, 0.5)
    turns = heading(ends) - heading(ends - 0.5) + 0.003 * rng.normal(size=len(ends))
    rows = [(round((end - 0.5) * S), round(end * S), np.array([0.1, 0.0, turn])) for end, turn in zip(ends, turns, strict=True)]
    return compare_clocks(rows, (t, 0.7 * heading(t - late_s)), 0)


@pytest.mark.parametrize("late_s", [0.5, -0.25, 1.2])
def test_clocks_of_wheels_and_lidar_alone_are_measured_by_turns(late_s: float) -> None:
    assert _wheels_late_s(late_s) == pytest.approx(late_s, abs=0.03)


@pytest.mark.parametrize("late_s", [0.0, 0.15, -0.15])
def test_clocks_of_wheels_and_lidar_within_latencies_are_left_to_the_filter(late_s: float) -> None:
    assert _wheels_late_s(late_s) == 0.0


def test_clocks_are_unknown_while_the_turn_rate_is_constant() -> None:
    assert _wheels_late_s(0.5, lambda t: 0.4 * t) is None
    assert _wheels_late_s(0.5, seconds=6.0) is None
