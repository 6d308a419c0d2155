"""Angles of wheels as drivers publish them: those on a circle lose nothing, and of two publishers one is read."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.evidence.angles import of_one_publisher, on_circle
from localization.logs.decode import JointReading, MessageStats
from localization.logs.event_decoder import JointsToWheels
from tests.helpers.bags import S

RNG = np.random.default_rng(5)


def turned(seconds: float, hz: float, fastest: float = 9.0) -> np.ndarray:
    """Angles (m, 4) of wheels that speed up and slow down, and their rates."""
    t = np.arange(0.0, seconds, 1.0 / hz)
    rates = fastest * np.stack([np.sin(0.3 * t + phase) for phase in (0.0, 0.1, 1.0, 1.1)], axis=1)
    return np.cumsum(rates, axis=0) / hz


@pytest.mark.parametrize("hz", [10.0, 50.0])
@pytest.mark.parametrize("least", [-math.pi, 0.0, 1.0])
def test_angles_on_a_circle_have_all_turns(hz: float, least: float) -> None:
    angles = turned(60.0, hz)
    wrapped = (angles - least) % math.tau + least
    found = on_circle(wrapped, math.tau)
    np.testing.assert_allclose(np.diff(found, axis=0), np.diff(angles, axis=0), atol=1e-9)


def test_angles_beyond_one_period_are_as_they_are() -> None:
    angles = turned(60.0, 10.0)
    angles[300:] -= 5.0  # a restart, on no circle
    np.testing.assert_array_equal(on_circle(angles, math.tau), angles)


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("other", [0.0, 3.0])
def test_of_two_publishers_the_one_whose_wheels_turn_is_read(every: int, other: float) -> None:
    angles = turned(40.0, 20.0)
    rows, is_first = list[np.ndarray](), list[bool]()
    for i, row in enumerate(angles):
        rows.append(row)
        is_first.append(True)
        if i % every == 0:
            rows.append(np.full(4, other))
            is_first.append(False)
    found = of_one_publisher(np.array(rows))
    assert (found == np.array(is_first)).mean() > 0.98


@pytest.mark.parametrize(
    "angles",
    [
        turned(40.0, 20.0),
        np.round(turned(40.0, 20.0) / 0.07) * 0.07,
        turned(40.0, 20.0) * 40.0 % 360.0,
        np.vstack([turned(20.0, 20.0), turned(20.0, 20.0)]),
        0.07 * RNG.integers(0, 2, (500, 4)),
        RNG.normal(size=(800, 4)),
    ],
    ids=["smooth", "coarse", "another period", "restarted", "flickers at rest", "noise"],
)
def test_one_publisher_is_not_taken_for_two(angles: np.ndarray) -> None:
    assert of_one_publisher(angles).all()


@pytest.mark.parametrize("radius_m", [0.03, 0.1, 0.3])
@pytest.mark.parametrize("has_rates", [True, False])
def test_small_wheels_that_wrap_lose_no_turn(radius_m: float, has_rates: bool) -> None:
    angles = turned(60.0, 50.0)
    rates = np.gradient(angles, axis=0) * 50.0
    convert = JointsToWheels(("a", "b"), ("c", "d"), radius_m, "/joint_states", MessageStats())
    samples = []
    for i, (angle, rate) in enumerate(zip((angles + math.pi) % math.tau - math.pi, rates, strict=True)):
        samples += convert(JointReading(i * S // 50, angle, rate if has_rates else np.full(4, math.nan)))
    moved = samples[-1].position - samples[0].position
    np.testing.assert_allclose(moved, (angles[-1] - angles[0]).reshape(2, 2).mean(axis=1), atol=1e-6)
