"""Which sensor turns the other way, or in another unit, by the turns of all; windows are drawn from what robots do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from localization.sensor_checks.faults import FaultLog, SensorFault
from localization.sensor_checks.inflation import CovarianceInflation
from localization.sensor_checks.pairs import GYRO_WHEELS, usual_errors
from localization.sensor_checks.turn_votes import GYRO_OPPOSITE, GYRO_UNIT, LIDAR_OPPOSITE, WHEELS_OPPOSITE, TurnVotes
from localization.sensor_checks.window import Bins, Window
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.robot_file import load_robot
from tests.helpers.extended import cases

_WHEELS, _GYRO, _LIDAR = 3, 4, 7
_BIN_S = 0.25
_JACKAL = load_robot("jackal")
_NARROW = replace(_JACKAL, drive=DIFF_DRIVE, geometry=replace(_JACKAL.geometry, track_width_m=0.23))
"""Two wheels and a caster: a side that slips turns it more than most of its turns."""


def _rows(rng: np.random.Generator, kind: str, slip_changes: bool = False, robot: Robot = _JACKAL) -> np.ndarray:
    """(24, 12) of a healthy robot that drives ``kind``. One side slips by 3 % of its way, all the time or by a share that changes within
    4 s; a Jackal's wheels turn up to twice as far as it does; the gyro has a bias and a scale of a few percent, and the wheels' clock is
    late by up to 0.1 s."""
    t = _BIN_S * np.arange(24)
    rates = {
        "along a rail": 0.0 * t,
        "straight": 0.0 * t,
        "curves": rng.uniform(0.1, 1.0) * np.sin(rng.uniform(0.3, 1.5) * t + rng.uniform(0.0, 6.0)),
        "an arc": rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 1.0) + 0.0 * t,
        "turns on the spot": np.where(t % 3.0 < 1.5, rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.5), 0.0),
    }
    rate = rates[kind] + 0.01 * rng.normal(size=24) * (kind != "along a rail")
    way = np.full(24, 0.0 if kind == "turns on the spot" else rng.uniform(0.05, 0.3))
    rows = np.zeros((24, 12))
    rows[:, 0], rows[:, 1] = _BIN_S, way
    late = np.gradient(rate) / _BIN_S * rng.uniform(-0.1, 0.1)
    slow = np.convolve(rng.normal(size=24 + 15), np.full(16, 0.25), "valid") if slip_changes else rng.normal()
    slip = 0.03 * math.sqrt(2.0) * way / robot.geometry.track_width_m * slow
    rows[:, _WHEELS] = (
        (_BIN_S * (rate + late)) * (rng.uniform(0.9, 2.0) if robot is _JACKAL else rng.normal(1.0, 0.03))
        + slip
        + 2e-3 * rng.normal(size=24)
    )
    rows[:, _GYRO] = _BIN_S * (rate * rng.normal(1.0, 0.03) + 0.01 * rng.normal()) + 5e-4 * rng.normal(size=24)
    rows[:, _LIDAR] = _BIN_S * rate + 3e-3 * rng.normal(size=24)
    return rows


def _compare(rows: np.ndarray, robot: Robot = _JACKAL) -> tuple[bool, TurnVotes, FaultLog]:
    window = Window({}, None)  # type: ignore[arg-type]  # no scan is registered here
    window.bins, window.end_s = Bins.of(rows), 6.0
    log = FaultLog(CovarianceInflation())
    votes = TurnVotes(log, usual_errors(robot)[GYRO_WHEELS])
    return votes.compare(window, has_gyro=True), votes, log


_TURNING = ("curves", "an arc", "turns on the spot")
_KINDS = ("straight", *_TURNING, "along a rail")
_FAULTS: Mapping[str, tuple[int, float, SensorFault]] = {
    "wheels swapped": (_WHEELS, -1.0, WHEELS_OPPOSITE),
    "gyro reversed": (_GYRO, -1.0, GYRO_OPPOSITE),
    "gyro in deg/s": (_GYRO, math.degrees(1.0), GYRO_UNIT),
    "LiDAR upside down": (_LIDAR, -1.0, LIDAR_OPPOSITE),
}


def _without(rows: np.ndarray, column: int | None) -> np.ndarray:
    if column is not None:
        rows[:, column] = np.nan
    return rows


@pytest.mark.parametrize("missing", [None, _WHEELS, _GYRO, _LIDAR], ids=["all sensors", "no wheels", "no gyro", "no LiDAR"])
@pytest.mark.parametrize("kind", _KINDS)
@pytest.mark.parametrize(
    ("robot", "slip_changes"), cases([(_JACKAL, False), (_JACKAL, True), (_NARROW, True)], ["slips"], ["jackal", "slips", "narrow"])
)
def test_healthy_robots_are_accused_of_nothing(kind: str, missing: int | None, robot: Robot, slip_changes: bool) -> None:
    rng = np.random.default_rng([5, _KINDS.index(kind)])
    found = [_compare(_without(_rows(rng, kind, slip_changes, robot), missing), robot)[2].declared for _ in range(500)]
    assert sum(map(bool, found)) == 0


@pytest.mark.parametrize("name", _FAULTS)
@pytest.mark.parametrize("kind", _TURNING)
def test_the_sensor_that_two_others_contradict_is_at_fault(name: str, kind: str) -> None:
    """Nearly all windows show it, of wheels, which slip for seconds, one in four; on one arc these may as well have a side that loses
    counts. None shows anything else."""
    column, factor, fault = _FAULTS[name]
    rng, found = np.random.default_rng([6, _KINDS.index(kind)]), []
    for _ in range(200):
        rows = _rows(rng, kind)
        rows[:, column] *= factor
        found.append(list(_compare(rows)[2].declared))
    least = 0.85 if column != _WHEELS else 0.25 if kind != "an arc" else 0.0
    assert sum(each == [fault] for each in found) >= least * len(found)
    assert all(each in ([fault], []) for each in found)


@pytest.mark.parametrize(("column", "missing"), [(_GYRO, _LIDAR), (_LIDAR, _GYRO)], ids=["gyro", "LiDAR"])
def test_of_two_sensors_the_wheels_are_named_as_well(column: int, missing: int) -> None:
    rows = _without(_rows(np.random.default_rng(7), "curves"), missing)
    rows[:, column] *= -1.0
    _, votes, log = _compare(rows)
    (found,) = log.declared.values()
    assert "left and right" in found.message
    assert votes.excluded == {_GYRO: "gyro", _LIDAR: "LiDAR"}[column]


def test_turns_show_that_all_is_well_only_where_the_robot_turns() -> None:
    rng = np.random.default_rng(8)
    shown = {kind: sum(_compare(_rows(rng, kind))[0] for _ in range(100)) for kind in _KINDS}
    assert max(shown["along a rail"], shown["straight"]) <= 5
    assert min(shown[kind] for kind in _TURNING) >= 90
