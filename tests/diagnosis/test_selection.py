"""Statistics of the choice of causes, against their definitions on made-up drives."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.linearization import Regression, given_noise, make_regression
from localization.diagnosis.selection import strongest_beyond_tolerance
from motion_models.se2 import FloatArray

WINDOWS, SIGMA, TOLERANCE = 40, 0.01, 0.35
USED = tuple(CAUSES[name] for name in ("track_width", "cg_offset_x", "lidar_yaw", "gyro_bias"))
WITHIN = TOLERANCE * np.array([cause.negligible for cause in USED])


def made_up(sizes: FloatArray, rng: np.random.Generator) -> Regression:
    """Causes with ``sizes`` (4,), of which each shifts x by about one sigma of a window's noise at a tolerated size."""
    signatures = np.full((WINDOWS, 6, len(USED)), np.nan)
    signatures[:, 0] = rng.normal(0.0, 1.0, (WINDOWS, len(USED))) * SIGMA / WITHIN
    rows = np.full((WINDOWS, 6), np.nan)
    rows[:, 0] = signatures[:, 0] @ sizes + rng.normal(0.0, SIGMA, WINDOWS)
    noise = given_noise(rows, np.full(rows.shape, SIGMA), np.zeros(WINDOWS, dtype=bool))
    return make_regression(rows, signatures, np.zeros((WINDOWS, 6, 0)), noise, USED, TOLERANCE)


def test_strongest_beyond_tolerance_p_is_uniform_for_tolerated_sizes() -> None:
    rng = np.random.default_rng(1)
    p = [strongest_beyond_tolerance(made_up(rng.normal(0.0, WITHIN), rng), rng, 1e6)[1] for _ in range(300)]
    assert np.mean(np.array(p) < 0.2) == pytest.approx(0.2, abs=3.0 * np.sqrt(0.16 / 300))
    assert np.mean(p) == pytest.approx(0.5, abs=3.0 / np.sqrt(12 * 300))


@pytest.mark.parametrize("cause", range(len(USED)))
def test_strongest_beyond_tolerance_is_the_hidden_cause(cause: int) -> None:
    rng = np.random.default_rng(cause)
    sizes = np.zeros(len(USED))
    sizes[cause] = 5.0 * WITHIN[cause]
    problem = made_up(sizes, rng)
    found, p = strongest_beyond_tolerance(problem, rng, 1e6)
    assert found == cause
    assert p < 1e-3
    weak = dataclasses.replace(problem, moment=problem.moment * 0.3)
    assert strongest_beyond_tolerance(weak, rng, 1e6)[1] > 0.05
