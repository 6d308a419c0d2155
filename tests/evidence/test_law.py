"""The law of units, and of bins that contradict each other, on channels that are drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from localization.evidence.alternatives.alternative import TEMPER
from localization.evidence.channel import channel_evidence

BINS = 60
FREE = 50.0
"""Sigma of the logarithm of a scale of which nothing is known."""


def _evidence(z: np.ndarray, floor: np.ndarray, tau: tuple[float, ...], is_scaled: np.ndarray | None = None) -> float:
    """Of one choice: sources (k, n) with floors (k,), which show their scale where ``is_scaled`` (k, n)."""
    k, n = z.shape
    is_scaled = np.ones((k, n)) if is_scaled is None else is_scaled
    floors = np.ascontiguousarray(np.broadcast_to(floor[:, None], (k, n)))[None]
    noise = floors, np.full((1, k), 0.05)
    of_bins, price, _, _ = channel_evidence(
        z[None].copy(), *noise, np.array([tau]), np.zeros(k), 0.5, (np.full(1, 0.02), np.full((1, n), 0.02), is_scaled)
    )
    return float(of_bins.sum() + price[0])


@pytest.mark.parametrize("unit", [math.pi / 180.0, math.tau / 60.0, 2.0, 1000.0])
def test_no_unit_of_a_source_of_unknown_scale_is_preferred(unit: float) -> None:
    rng = np.random.default_rng(11)
    motion = rng.normal(0.0, 0.5, BINS)
    z, floor = np.stack([motion, motion]) + rng.normal(0.0, 0.01, (2, BINS)), np.array([0.01, 0.01])
    scaled = np.array([1.0, unit])
    changed = _evidence(z * scaled[:, None], floor * scaled, (0.03, FREE)) + TEMPER * BINS * math.log(unit)
    assert changed == pytest.approx(_evidence(z, floor, (0.03, FREE)), abs=0.05)


def test_motion_of_a_known_scale_refutes_another_unit() -> None:
    rng = np.random.default_rng(12)
    motion = rng.normal(0.0, 0.5, BINS)
    z, floor = np.stack([motion, motion]) + rng.normal(0.0, 0.01, (2, BINS)), np.array([0.01, 0.01])
    changed = _evidence(z * np.array([[1.0], [2.0]]), floor * np.array([1.0, 2.0]), (0.03, 0.08)) + TEMPER * BINS * math.log(2.0)
    assert changed < _evidence(z, floor, (0.03, 0.08)) - 15.0


@pytest.mark.parametrize("noise", [1e-2, 1e-4, 1e-6])
def test_sources_that_contradict_each_other_have_a_finite_evidence(noise: float) -> None:
    motion = np.random.default_rng(13).normal(0.0, 0.5, BINS)
    found = [
        _evidence(np.stack(signs), np.full(len(signs), noise), (0.03,) * len(signs))
        for signs in (
            (motion, -motion, motion),
            (motion, -motion, -motion, motion),
            (motion, 57.0 * motion, motion),
            (motion, 0.0 * motion, motion),
        )
    ]
    assert np.isfinite(found).all()
    assert max(found) < _evidence(np.stack([motion, motion, motion]), np.full(3, noise), (0.03,) * 3)


def test_encoders_of_a_robot_that_mostly_stands_show_no_scale_at_rest() -> None:
    """Turns in a few bins refute a driver that turns by half; that it counts nothing in all others does not make it probable."""
    rng = np.random.default_rng(14)
    is_moving = np.arange(150) < 10
    motion = np.where(is_moving, 0.5, 0.0)
    gyro = motion + 0.0025 * rng.normal(size=150)
    is_scaled = np.stack([is_moving, np.ones(150)]).astype(float)
    right, half = (_evidence(np.stack([a * motion, gyro]), np.array([2e-3, 6e-4]), (0.2, 0.03), is_scaled) for a in (1.0, 0.5))
    assert right > half
