"""Summary of scores against a reference with noise of its own: errors below it are not ranked."""

import dataclasses

import numpy as np
import pytest

from localization.evaluation.references import ReferenceTrack, with_noise
from localization.evaluation.scores import score
from localization.report.summary import verdict
from tests.helpers.report import run, track

SIGMA_M = 0.6
NOISE_M = SIGMA_M * np.sqrt(2.0)


def gps(sigma_m: float = SIGMA_M) -> ReferenceTrack:
    """Positions with independent noise of ``SIGMA_M``, and covariances of ``sigma_m``."""
    exact = track(yaws=False)
    noise = np.random.default_rng(7).normal(scale=SIGMA_M, size=exact.positions.shape)
    return with_noise(dataclasses.replace(exact, positions=exact.positions + noise), sigma_m, 0.0)


def runs(odometry_m: float, ekf_m: float) -> list:
    return [run("diff_drive", "odometry", noise=odometry_m), run("diff_drive", "ekf", noise=ekf_m)]


def test_position_noise_is_root_mean_square_of_its_covariances():
    assert gps().position_noise_m == pytest.approx(NOISE_M)
    assert track().position_noise_m is None


def test_summary_of_errors_below_the_noise_ranks_none():
    text = verdict(score(runs(0.2, 0.002), gps()), gps())
    assert "cannot be seen with /ground_truth/odom, by its own covariances" in text
    assert "% less" not in text
    assert "Use ekf" not in text
    assert "takes a reference of less noise" in text


def test_summary_of_errors_above_the_noise_ranks_them():
    text = verdict(score(runs(3.0, 2.0), gps()), gps())
    assert "cannot be seen" not in text
    assert "% less than dead reckoning" in text


def test_summary_noise_hides_the_best_run_but_not_the_others():
    text = verdict(score(runs(3.0, 0.002), gps()), gps())
    assert "% less than dead reckoning" in text
    assert "Use ekf" in text
    assert "Errors below 0.849 m cannot be seen" in text


def test_summary_of_covariances_too_large_takes_the_errors_found():
    text = verdict(score(runs(3.0, 0.002), gps(sigma_m=10.0)), gps(sigma_m=10.0))
    assert "Errors below 0.797 m" in text
    assert "by its own covariances of 14.1 m" in text
    assert "% less than dead reckoning" in text
