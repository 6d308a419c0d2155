"""Wheel noise learned from held-out errors, on maneuvers whose noise is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from motion_models import se2
from motion_models.calibration.cross_validation import learn_noise
from motion_models.calibration.fit import Fit, FitConfig, fit
from motion_models.calibration.maneuvers import Maneuver
from motion_models.preintegration import preintegrate
from motion_models.registry import make_model
from motion_models.robot import WheelNoise
from motion_models.robot_file import load_robot

ROBOT = load_robot("vaultbot")
MODEL = make_model("diff_drive", ROBOT)


def made(scale: float, rng: np.random.Generator, correlation: float = 0.0, outliers: int = 0) -> tuple[Fit, list[Maneuver]]:
    """Two-second maneuvers whose slip has ``scale`` times the usual variances; ``correlation`` between neighbours of a group of three."""
    found, before = [], np.zeros(3)
    for i in range(300):
        rates = np.repeat(rng.uniform(-4.0, 4.0, (1, 2)), 20, axis=0)
        motion = preintegrate(MODEL, np.full(20, 0.1), rates, np.zeros(2), MODEL.nominal, WheelNoise())
        white = rng.normal(size=3) if i % 3 == 0 else correlation * before + np.sqrt(1.0 - correlation**2) * rng.normal(size=3)
        before = white
        slip = np.linalg.cholesky(scale * motion.cov) @ white * (30.0 if i < outliers else 1.0)
        measured = se2.compose(se2.compose(motion.delta, se2.exp(slip)), se2.exp(rng.normal(0, 1e-3, 3)))
        cov = np.diag([1e-6] * 3)
        found.append(Maneuver(np.full(20, 0.1), rates, measured[None], np.array([20]), cov=cov, group=str(i // 3)))
    config = FitConfig(noise=WheelNoise(), strict=False)
    return dataclasses.replace(fit(MODEL, found, ("wheel_separation_multiplier",), config), params=MODEL.nominal), found


@pytest.mark.parametrize("scale", [0.2, 1.0, 5.0])
def test_learn_noise_finds_the_variances_that_made_the_errors(scale: float) -> None:
    found, maneuvers = made(scale, np.random.default_rng(0))
    noise = learn_noise(found, maneuvers, found.residuals(maneuvers))
    assert noise.yaw == pytest.approx(scale, rel=0.3)
    assert noise.position == pytest.approx(scale, rel=0.3)
    assert noise.scaled(WheelNoise()).yaw_rad2_per_m == pytest.approx(noise.yaw * WheelNoise().yaw_rad2_per_m, rel=5e-3)  # three digits


def test_learn_noise_covers_slip_that_is_correlated_over_neighbours() -> None:
    """With a correlation of 0.9 the sum of three has 2.6 times the variance of independent ones: that is what a filter must cover."""
    found, maneuvers = made(1.0, np.random.default_rng(1), correlation=0.9)
    noise = learn_noise(found, maneuvers, found.residuals(maneuvers))
    assert 1.8 < noise.yaw < 3.6
    assert 1.8 < noise.position < 3.6


def test_learn_noise_of_a_few_wrong_matches_is_unchanged() -> None:
    found, maneuvers = made(1.0, np.random.default_rng(2), outliers=3)
    assert learn_noise(found, maneuvers, found.residuals(maneuvers)).yaw < 2.0


def test_learn_noise_of_few_maneuvers_keeps_the_robots() -> None:
    found, maneuvers = made(5.0, np.random.default_rng(3))
    noise = learn_noise(found, maneuvers[:10], found.residuals(maneuvers[:10]))
    assert (noise.yaw, noise.position) == (1.0, 1.0)
