"""The study `honesty`, in small: noise is drawn as described, and covariances hold under some that the filter does not model."""

from __future__ import annotations

import numpy as np
import pytest

from localization.evaluation.consistency import mean_band
from tests.helpers.rooms import ROBOT
from tests.studies.honesty import NOISES, Noise, draw_slip, drive_nees, drive_with, make_rooms, verdict


@pytest.mark.parametrize("noise", [Noise(slip_s=0.0), Noise(slip_s=0.1), Noise(slip_s=0.1, heavy_slip=True), Noise(2.0, slip_s=0.5)])
def test_draw_slip_over_long_times_has_the_variance_of_the_wheels(noise: Noise) -> None:
    """600 pieces of 10 s on a straight drive at 0.5 m/s."""
    driven = np.tile([0.5, 0.0, 0.0], (5000, 1))
    rng = np.random.default_rng(0)
    ends = np.array([0.002 * draw_slip(driven, noise, rng).sum(axis=0) for _ in range(600)])
    w = ROBOT.wheel_noise
    expected = 5.0 * np.array([w.longitudinal_m2_per_m, w.lateral_m2_per_m, w.yaw_rad2_per_m]) + 10.0 * np.array([1e-6, 1e-6, 1e-6])
    np.testing.assert_allclose(ends.var(axis=0), noise.wheels**2 * expected, rtol=0.25)


@pytest.mark.extended
@pytest.mark.parametrize("name", ["slip correlated over 0.1 s", "wheel noise twice"])
def test_nees_under_noise_unknown_to_the_filter_is_not_above_its_band(name: str) -> None:
    found = [drive_nees(drive_with(room, NOISES[name], seed), "ekf") for room in make_rooms(2) for seed in range(2)]
    assert 0.5 < np.mean(found) < mean_band(len(found), 3.0)[1]


def test_verdict_compares_the_mean_with_its_band() -> None:
    assert [verdict(mean, (2.0, 4.0)) for mean in (1.9, 3.0, 4.1)] == ["conservative", "holds", "over-confident"]
