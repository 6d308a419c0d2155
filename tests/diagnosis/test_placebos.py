"""Placebo searches have the level that they state, and leave a law its place."""

from __future__ import annotations

import numpy as np
from scipy.stats import binom

from localization.diagnosis.placebos import LEVEL, Candidates, block_length, permute_blocks, placebo_p, placebo_statistics
from tests.studies.placebos import p_values


def test_placebo_search_of_noise_has_its_level() -> None:
    """Of 300 drives as many are below 5 % as that, within the 99.9 % interval; by the placebos' own number p is at least 1 / 101."""
    p = p_values("husky_a200", 24, 300, 0.0, placebos=100)
    assert p.min() >= 1.0 / 101.0
    assert binom.ppf(0.0005, 300, 0.05) <= np.count_nonzero(p <= 0.05) <= binom.ppf(0.9995, 300, 0.05)


def test_placebo_search_finds_a_law_among_many_candidates() -> None:
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(60, 6, 40))
    searched = Candidates(columns, np.full(40, 12.0), np.zeros_like(columns), np.zeros((60, 40)))
    y = (0.5 * columns[..., 7] + rng.normal(size=(60, 6))).reshape(-1, 1)
    real, placebos = placebo_statistics(y, np.zeros((360, 1)), searched, rng)
    assert int(np.argmax(real)) == 7
    assert placebo_p(float(real.max()), placebos[:, 0]) <= LEVEL


def test_permute_blocks_keeps_neighbours_together() -> None:
    order = permute_blocks(60, 6, np.random.default_rng(1))
    assert sorted(order) == list(range(60))
    steps = np.abs(np.diff(order))
    assert np.mean((steps == 1) | (steps == 59)) >= 0.8


def test_block_length_grows_with_the_correlation_of_the_columns() -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(size=(120, 6, 20))
    slow = np.repeat(rng.normal(size=(15, 6, 20)), 8, axis=0)
    assert block_length(white) == 4
    assert block_length(slow) >= 6
