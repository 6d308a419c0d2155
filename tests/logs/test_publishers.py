"""Two publishers of one topic are distinguished from one whose speeds are noise, steps of coarse encoders, or now and then outliers."""

from __future__ import annotations

import ctypes
import math

import numpy as np
import pytest

from localization.logs.event_decoder import PublisherSeparator
from motion_models.se2 import FloatArray
from tests.helpers.extended import cases

DURATION_S = 60
SEEDS = range(12)


def left_out(values: FloatArray, hz: float) -> float:
    """Share of readings ``values`` (n, k) that are left out."""
    separator = PublisherSeparator()
    admitted = [separator.admit(int((1.0 + i / hz) * 1e9), row.tolist(), abs(float(row[0]))) for i, row in enumerate(values)]
    return 1.0 - float(np.mean(admitted))


def wandering(rng: np.random.Generator, count: int, hz: float) -> FloatArray:
    """(count,) a speed that changes within seconds."""
    step = max(int(hz * rng.uniform(1.0, 6.0)), 1)
    points = rng.normal(0.0, 0.5, count // step + 2)
    return np.interp(np.arange(count) / step, np.arange(len(points)), points)


def topic(seed: int, kind: str) -> tuple[FloatArray, float]:
    """Readings (n, k) of one publisher, and how many come each second."""
    rng = np.random.default_rng([31, seed])
    hz = float(rng.choice([10, 20, 50]))
    count = int(DURATION_S * hz)
    speed, turn, noise = np.clip(0.3 + wandering(rng, count, hz), 0.0, 1.0), wandering(rng, count, hz), rng.uniform(0.05, 0.5)
    heading = np.cumsum(turn) / hz
    sides = np.column_stack([speed - 0.3 * turn, speed + 0.3 * turn])
    step = rng.uniform(0.1, 0.3)  # of a rate by counts [m/s]
    started = np.clip((np.arange(count) / hz - 2.0) * 0.5, 0.0, 0.4)[:, None] * np.array([1.0, rng.uniform(0.9, 1.1)])
    counts = np.floor(np.cumsum(started, axis=0) / step + rng.uniform(0.0, 1.0, 2))
    return {
        "noisy turn rates": np.column_stack([speed, turn + rng.normal(0.0, noise, count)]),
        "noisy wheels": sides + rng.normal(0.0, 0.3 * noise, (count, 2)),
        "coarse encoders": np.round(100.0 * sides * hz + rng.uniform(0.0, 1.0, (count, 2))) / (100.0 * hz),
        "few counts from rest on": step * np.diff(counts, axis=0, prepend=0.0),
        "outliers": np.column_stack([speed, turn + 0.1 * rng.standard_t(1.5, count)]),
        "places alone": np.cumsum(speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0) / hz,
    }[kind], hz


@pytest.mark.parametrize(
    "kind",
    cases(
        ["noisy turn rates", "noisy wheels", "coarse encoders", "few counts from rest on", "outliers", "places alone"],
        usual=["noisy wheels", "few counts from rest on"],
    ),
)
def test_single_publisher_loses_no_reading(kind: str) -> None:
    assert [left_out(*topic(seed, kind)) for seed in SEEDS] == [0.0] * len(SEEDS)


@pytest.mark.extended
@pytest.mark.parametrize("kind", ["noisy turn rates", "coarse encoders"])
def test_publisher_of_zeros_between_is_left_out(kind: str) -> None:
    for seed in SEEDS:
        values, hz = topic(seed, kind)
        both = np.repeat(values, 2, axis=0)
        both[1::2] = 0.0
        assert 0.25 < left_out(both, 2.0 * hz) <= 0.55


def test_outlier_among_constant_speeds_makes_no_second_publisher() -> None:
    values = np.tile([0.4, 0.1], (200, 1))
    values[[50, 120]] = 1e5, -1e300
    values[160] = np.inf, np.nan
    assert left_out(values, 20.0) == 0.0


def test_unknown_places_are_admitted_after_a_number_beyond_the_range_of_c() -> None:
    """Twists have no place. CPython 3.11's abs() of a complex NaN raises OverflowError while errno is ERANGE, as JIT compilers leave it."""
    separator, unknown, strtod = PublisherSeparator(), complex(math.nan, math.nan), ctypes.CDLL(None).strtod
    assert separator.admit(0, [0.4, unknown], 0.4)
    strtod(b"1e999", None)
    assert separator.admit(20_000_000, [0.4, unknown], 0.4)
