"""Direction of travel by the LiDAR, with its error."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.sensor_checks.travel_direction import SLIDE_RAD, Direction, direction_of
from localization.sensor_checks.window import Bins

_TURNS = [[0.0] * 7, [0.07] * 24, [0.07] * 12 + [-0.05] * 12]
"""Ahead; an arc of 1 m, in which slides look like another direction; and an S [rad]."""


def _direction_of_ways(rng: np.random.Generator, degrees: float, noise_m: float, turns: list[float], slide_m_per_rad: float) -> Direction:
    """Of wheels that travel 7 cm ahead and turn by ``turns`` [rad] in each bin, and scans with noise, in the direction ``degrees``, of a
    robot that slides in turns."""
    turn, noise = np.array(turns), noise_m * rng.normal(size=(2, len(turns)))
    ways = (0.07 + 1j * slide_m_per_rad * turn) * np.exp(1j * math.radians(degrees)) + noise[0] + 1j * noise[1]
    rows = np.zeros((len(turn), 12))
    rows[:, 0], rows[:, 1], rows[:, 3], rows[:, 5], rows[:, 6] = 0.25, 0.07, turn, ways.real, ways.imag
    rows[:, 9], rows[:, 11] = ways.imag, 1.0
    return direction_of(Bins.of(rows))


def _direction_in_corridor(rng: np.random.Generator, degrees: float, bearing_deg: float = 0.0, wheels: float = 1.0) -> Direction:
    """Of a robot that travels 7 cm in each bin along a corridor, which lies ``bearing_deg`` to its left; its LiDAR is turned by
    ``degrees``, and its wheels count ``wheels`` times the way."""
    normal = np.exp(1j * math.radians(bearing_deg + degrees + 90.0))
    way = 0.07 * np.exp(1j * math.radians(degrees))
    rows = np.full((24, 12), np.nan)
    rows[:, 0], rows[:, 1:4] = 0.25, (0.07 * wheels, 0.0, 0.0)
    rows[:, 7], rows[:, 9] = 0.0, (way * normal.conjugate()).real + 0.005 * rng.normal(size=24)
    rows[:, 10:] = normal.real, normal.imag
    return direction_of(Bins.of(rows))


@pytest.mark.parametrize("noise_m", [0.005, 0.02, 0.06])
def test_direction_accuses_no_noise_of_its_own(noise_m: float) -> None:
    """Short bins with scans as noisy as their way: hardly any window is beyond a limit that the true direction is on."""
    rng = np.random.default_rng(0)
    found = [_direction_of_ways(rng, math.degrees(SLIDE_RAD), noise_m, turns, 0.5 * rng.normal()) for _ in range(1000) for turns in _TURNS]
    assert sum(each.least > SLIDE_RAD for each in found) <= 0.002 * len(found)


@pytest.mark.parametrize("turns", [_TURNS[0], _TURNS[2]], ids=["straight", "curves"])
def test_direction_of_a_turned_lidar_is_certain(turns: list[float]) -> None:
    found = _direction_of_ways(np.random.default_rng(1), 26.0, 0.005, turns, 0.5)
    assert found.angle - found.bound > SLIDE_RAD
    assert not found.is_equal
    assert math.degrees(found.angle) == pytest.approx(26.0, abs=math.degrees(found.bound))


@pytest.mark.parametrize("degrees", [-26.0, 20.0])
def test_direction_of_a_turned_lidar_is_certain_where_scans_show_no_way_along_a_corridor(degrees: float) -> None:
    found = _direction_in_corridor(np.random.default_rng(4), degrees)
    assert math.degrees(found.angle) == pytest.approx(degrees, abs=math.degrees(found.bound))
    assert found.least > SLIDE_RAD


@pytest.mark.parametrize("wheels", [1.0, 1.5, 3.0])
def test_direction_accuses_no_lidar_of_wheels_that_spin_along_a_corridor(wheels: float) -> None:
    found = [_direction_in_corridor(np.random.default_rng(seed), 0.0, wheels=wheels) for seed in range(1000)]
    assert sum(each.least > math.radians(2.0) for each in found) <= 2
    assert all(each.is_equal for each in found)


def test_direction_is_unknown_towards_a_wall() -> None:
    """No wall along the way shows its direction."""
    assert _direction_in_corridor(np.random.default_rng(5), 0.0, bearing_deg=90.0).bound > SLIDE_RAD


def test_one_scan_at_a_wrong_place_in_a_corridor_does_not_show_a_robot_that_goes_back():
    """Bins across the walls fit both directions of travel; a bin with a way ahead is evidence, one alone is none."""
    rows = np.full((16, 12), np.nan)
    rows[:, 0], rows[:, 1:4], rows[:, 7], rows[:, 9:] = 0.3, (0.19, 0.0, 0.0), 0.0, (0.0, 0.0, 1.0)
    rows[3, 5:7] = -0.32, 0.0
    assert direction_of(Bins.of(rows)).bound == math.inf
    rows[:8, 5:7] = -0.19, 0.0
    turned = direction_of(Bins.of(rows))
    assert turned.least > math.radians(130.0)
