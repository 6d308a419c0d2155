"""Healthy logs of the suite are healthy: their channels are what the robot file declares, and nothing of them is accused."""

from __future__ import annotations

import importlib.util

import pytest

from tests.helpers.cut_logs import REAL
from tests.helpers.extended import cases
from tests.studies.healthy_set_ups import KINDS, check, check_window, seed_of

if importlib.util.find_spec("localization.evidence") is None:
    pytest.skip("the inference of set-ups is not there", allow_module_level=True)

USUAL = ["encoder of 90 to 200 counts", "turns less at speed", "load that moves"]
SOURCES = {
    "short range": ("wheels", "gyro", "lidar"),
    "load that moves": ("wheels", "gyro", "lidar"),
    "yaw rate that jitters": ("driver", "gyro", "lidar"),
}


@pytest.mark.parametrize("kind", cases(KINDS, usual=USUAL))
def test_healthy_drive_of_a_kind_is_accused_of_nothing(kind: str) -> None:
    assert check(kind, 20, SOURCES.get(kind, ("wheels", "gyro"))).accusations == ()


@pytest.mark.extended
@pytest.mark.parametrize("seed", [1301, 1905])
def test_side_of_a_circle_shows_no_unit(seed: int) -> None:
    """On a circle to the left the left wheels hardly roll, and the sides' slip is more than the sensors' noise: another unit of a side was
    the more probable one."""
    assert check("circles one way", seed_of(seed, 4), ("wheels", "gyro", "lidar", "reference")).accusations == ()


@pytest.mark.extended
@pytest.mark.parametrize("kind", ["mostly standing", "caster in the joint states", "turns less at speed", "vibration", "load that moves"])
def test_replay_of_a_healthy_drive_of_a_kind_warns_of_nothing(kind: str) -> None:
    assert check(kind, 21, ("driver", "gyro", "lidar"), "replay").accusations == ()


WINDOWS = [(log, begin) for log in REAL[:3] for begin in (60.0, 200.0)]


@pytest.mark.extended
@pytest.mark.parametrize(("log", "begin"), WINDOWS, ids=[f"{log.name} {begin:.0f}" for log, begin in WINDOWS])
def test_part_of_a_real_log_is_accused_of_nothing(log: object, begin: float) -> None:
    assert check_window(log, begin, 110.0, ("reference", "driver") if len(dict(log.topics)) > 2 else ()).accusations == ()
