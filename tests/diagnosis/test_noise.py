"""Noise of a drive, estimated from what all causes together leave, against the noise that was drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from localization.diagnosis.drive_predictor import CHANNELS, DrivePredictor
from localization.diagnosis.noise import Noise, count_sigmas, estimate_noise, given_noise
from motion_models.registry import make_model
from motion_models.se2 import FloatArray
from tests.helpers.law_drives import law_drive

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


CHAIN = 0.7  # share of the error of the window before
MIXED = np.eye(6) + 0.6 * (np.eye(6, k=1) + np.eye(6, k=-1))


def correlated_noise(rng: np.random.Generator, drives: int, length: int) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(M, 6) stationary AR(1) errors with the covariance `MIXED` in each window, in ``drives`` parts, and what follows what."""
    root = np.linalg.cholesky(MIXED + 0.3 * np.eye(6))
    root /= np.linalg.norm(root, axis=1, keepdims=True)
    white = rng.standard_normal((drives, length, 6))
    white[:, 1:] *= np.sqrt(1.0 - CHAIN**2)
    for i in range(1, length):
        white[:, i] += CHAIN * white[:, i - 1]
    follows = np.arange(drives * length) % length > 0
    return white.reshape(-1, 6) @ root.T, follows


def exact_noise(rows: FloatArray, follows: NDArray[np.bool_]) -> Noise:
    root = np.linalg.cholesky(MIXED + 0.3 * np.eye(6))
    root /= np.linalg.norm(root, axis=1, keepdims=True)
    given = given_noise(rows, np.full(rows.shape, SIGMA), follows)
    return replace(given, correlation=root @ root.T, autocorrelation=np.full(6, CHAIN))


def test_whitened_noise_has_unit_variance_at_each_place_of_a_drive() -> None:
    """Monte Carlo: windows without a predecessor have the process's variance, not 1 / (1 - rho^2) of it."""
    rows, follows = correlated_noise(np.random.default_rng(0), 2000, 6)
    white = exact_noise(rows, follows).whiten(SIGMA * rows).reshape(2000, 6, 6)
    np.testing.assert_allclose(white.var(axis=0), 1.0, atol=0.13)  # four sigma of a variance by 2,000 numbers
    numbers = white.reshape(2000, -1)
    off = np.corrcoef(numbers.T) - np.eye(36)
    assert np.abs(off).max() < 5.0 / np.sqrt(2000)


def test_whitened_noise_with_a_silent_channel_has_unit_variance() -> None:
    """Monte Carlo: what a window did not measure is 0, and takes no part in the others."""
    rng = np.random.default_rng(1)
    rows, follows = correlated_noise(rng, 2000, 2)
    rows[rng.random(rows.shape) < 0.3] = np.nan
    exact = replace(exact_noise(rows, follows), autocorrelation=np.zeros(6))
    white = exact.whiten(SIGMA * rows)
    assert (white[np.isnan(rows)] == 0.0).all()
    for channel in range(6):
        assert white[np.isfinite(rows[:, channel]), channel].var() == pytest.approx(1.0, abs=0.11)


def test_estimated_noise_whitens_what_it_was_estimated_by() -> None:
    """Monte Carlo over drives of 120 windows: mean square within 15 % of 1, as correlations are shrunk; no correlation along windows."""
    variances, correlations = [], []
    for seed in range(40):
        rows, follows = correlated_noise(np.random.default_rng(seed), 1, 120)
        claimed, features = np.full(rows.shape, SIGMA), np.column_stack([np.ones(120), np.zeros((120, 2))])
        noise = estimate_noise(SIGMA * rows, features, follows, np.zeros(6), (claimed, 5.0), np.zeros(rows.shape))
        white = noise.whiten(SIGMA * rows)
        variances.append(np.square(white).mean(axis=0))
        correlations.append((white[1:] * white[:-1]).mean(axis=0))
    assert np.mean(variances) == pytest.approx(1.0, abs=0.15)
    assert abs(np.mean(correlations)) < 0.05


def test_count_sigmas_are_those_of_counted_ways() -> None:
    """Of a Husky whose wheels roll between two of 20,000 angles, counted in steps, on a floor where k is 0.554."""
    drive, step = replace(law_drive("husky_a200"), encoder_step_rad=0.01), 0.01
    g = drive.robot.geometry
    starts = np.random.default_rng(0).uniform(0.0, 1.0, (10_000, 2))
    way = 2.0 + np.random.default_rng(1).uniform(0.0, 1.0, (10_000, 2))
    off = (np.floor((starts + way) / step) - np.floor(starts / step)) * step - way
    x, turn = g.wheel_radius_m * off.mean(axis=1), 0.554 * g.wheel_radius_m * (off[:, 1] - off[:, 0]) / g.track_width_m
    found = count_sigmas(DrivePredictor(drive, make_model("friction", drive.robot), has_inertia=False))
    assert found[[0, 2]] == pytest.approx([x.std(), turn.std()], rel=0.05)
