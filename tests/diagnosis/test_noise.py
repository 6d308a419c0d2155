"""Noise of a drive, estimated from what all causes together leave, against the noise that was drawn."""

from __future__ import annotations

import numpy as np
import pytest

from localization.diagnosis.linearization import CHANNELS, estimate_noise
from motion_models.se2 import FloatArray

WINDOWS, SIGMA, CREEP = 60, 3e-4, 6e-3
YAW, FORCE = CHANNELS.index("yaw"), CHANNELS.index("force_x")


def estimated(left: FloatArray, creep: FloatArray) -> FloatArray:
    """(M,) sigmas of the yaw, where the reference claims `SIGMA` and only a constant variance is possible."""
    features = np.column_stack([np.ones(WINDOWS), np.zeros((WINDOWS, 2))])
    rows, by_model = np.full((WINDOWS, 6), np.nan), np.zeros((WINDOWS, 6))
    rows[:, YAW], by_model[:, YAW] = left, creep
    claimed = np.full((WINDOWS, 6), SIGMA)
    return estimate_noise(rows, features, np.zeros(WINDOWS, dtype=bool), np.zeros(6), (claimed, 5.0), by_model).sigmas[:, YAW]


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_slow_turns_is_not_that_of_other_windows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    creep = np.where(np.arange(WINDOWS) % 3 == 0, CREEP, 0.0)
    found = estimated(rng.normal(0.0, np.hypot(SIGMA, creep)), creep)
    np.testing.assert_allclose(found[creep == 0.0], SIGMA, rtol=0.4)
    np.testing.assert_allclose(found[creep > 0.0], CREEP, rtol=0.05)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_noise_without_slow_turns_is_that_of_the_drive(factor: float) -> None:
    rng = np.random.default_rng(0)
    found = estimated(rng.normal(0.0, factor * SIGMA, WINDOWS), np.zeros(WINDOWS))
    np.testing.assert_allclose(found, factor * SIGMA, rtol=0.25)


def test_noise_of_few_windows_is_the_claimed_one() -> None:
    left = np.full(WINDOWS, np.nan)
    left[[3, 20, 41]] = 0.001
    assert (estimated(left, np.zeros(WINDOWS))[[3, 20, 41]] == SIGMA).all()


def test_noise_below_its_sigma_takes_no_other_channel_for_its_own() -> None:
    """A reference that is far better than it claims: its yaw and the force err alike, by a hundredth of their sigmas."""
    left, claimed = np.full((WINDOWS, 6), np.nan), np.full((WINDOWS, 6), 0.01)
    left[:, YAW] = left[:, FORCE] = np.random.default_rng(0).normal(0.0, 1e-4, WINDOWS)
    features = np.column_stack([np.ones(WINDOWS), np.zeros((WINDOWS, 2))])
    noise = estimate_noise(left, features, np.zeros(WINDOWS, dtype=bool), np.zeros(6), (claimed, 5.0), np.zeros((WINDOWS, 6)))
    turn = np.zeros((WINDOWS, 6))
    turn[:, YAW] = 0.01
    assert np.abs(noise.whiten(turn)[:, FORCE]).max() < 0.01 * np.abs(noise.whiten(turn)[:, YAW]).min()
