"""Statistics of the choice of causes, against their definitions on made-up drives."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.linearization import Linearization, make_regression
from localization.diagnosis.noise import given_noise
from localization.diagnosis.selection import (
    heldout_log_odds,
    is_correction_worse,
    problems_without_a_fold,
    simplest_set,
    strongest_beyond_tolerance,
)
from motion_models.se2 import FloatArray

WINDOWS, SIGMA, TOLERANCE = 40, 0.01, 0.35
USED = tuple(CAUSES[name] for name in ("track_width", "cg_offset_x", "lidar_yaw", "gyro_bias"))
OWN = np.array([cause.plausible for cause in USED])
WITHIN = TOLERANCE * np.array([cause.negligible for cause in USED])


def made_up(sizes: FloatArray, rng: np.random.Generator, windows: slice = slice(None)) -> Linearization:
    """Causes with ``sizes`` (4,) that act in some ``windows``; each shifts x by about one sigma of a window's noise at a tolerated size."""
    signatures = np.full((WINDOWS, 6, len(USED)), np.nan)
    signatures[:, 0] = rng.normal(0.0, 1.0, (WINDOWS, len(USED))) * SIGMA / WITHIN
    acting = np.zeros((WINDOWS, 1))
    acting[windows] = 1.0
    rows = np.full((WINDOWS, 6), np.nan)
    rows[:, 0] = (signatures[:, 0] * acting) @ sizes + rng.normal(0.0, SIGMA, WINDOWS)
    noise = given_noise(rows, np.full(rows.shape, SIGMA), np.zeros(WINDOWS, dtype=bool))
    nuisances = np.zeros((WINDOWS, 6, 0))
    problem = make_regression(rows, signatures, nuisances, noise, USED, TOLERANCE)
    return Linearization(USED, rows, rows, signatures, nuisances, noise, TOLERANCE, problem)


def predictive_log_density(state: Linearization, chosen: tuple[int, ...]) -> float:
    """Of every fold of five, by the mean and the covariance that the rest predicts, from the definition; the first cause is not
    tolerated."""
    y, s = state.rows[:, 0] / SIGMA, state.signatures[:, 0] / SIGMA
    number = np.arange(len(USED))
    prior = np.diag(np.where(np.isin(number, chosen), OWN, np.where(number == 0, 1e-6 * OWN, WITHIN)) ** 2)
    fold = (np.arange(WINDOWS) // 4) % 5
    total = 0.0
    for f in range(5):
        a, b = s[fold != f], s[fold == f]
        V = np.linalg.inv(a.T @ a + np.linalg.inv(prior))
        total += multivariate_normal(b @ V @ a.T @ y[fold != f], b @ V @ b.T + np.eye(len(b))).logpdf(y[fold == f])
    return total


def test_is_correction_worse_where_discrepancies_grow() -> None:
    """What is tolerated of one cause is no harm, ten times that is; windows that are outliers do not count."""
    state = made_up(np.zeros(4), np.random.default_rng(0))
    predictor = cast(DrivePredictor, SimpleNamespace(discrepancies=lambda hypothesis: state.rows))
    large = 10.0 * WITHIN[0] * state.signatures[..., 0]
    assert is_correction_worse(predictor, state.noise, state.rows + large)
    assert not is_correction_worse(predictor, state.noise, state.rows + 0.1 * large)
    weights = np.where(np.arange(WINDOWS) < 4, 0.0, 1.0)
    outliers = np.where(weights[:, None] == 0.0, 1.0, 0.0)
    assert not is_correction_worse(predictor, dataclasses.replace(state.noise, weights=weights), state.rows + outliers)


@pytest.mark.parametrize("seed", range(3))
def test_heldout_log_odds_are_of_predicted_folds(seed: int) -> None:
    state = made_up(np.array([0.02, 0.0, 0.0, 0.0]), np.random.default_rng(seed))
    odds = heldout_log_odds(state.problem, problems_without_a_fold(state), (0, 2), (2,))
    assert 0.5 * odds == pytest.approx(predictive_log_density(state, (0, 2)) - predictive_log_density(state, (2,)), rel=1e-6)
    assert odds > 20.0


def test_heldout_log_odds_of_what_acts_in_one_block_are_negative() -> None:
    state = made_up(np.array([0.1, 0.0, 0.0, 0.0]), np.random.default_rng(0), slice(8, 12))
    problem = state.problem
    assert problem.gain((0,)) > 10.0
    assert heldout_log_odds(problem, problems_without_a_fold(state), (0,), ()) < 0.0


def test_strongest_beyond_tolerance_p_is_uniform_for_tolerated_sizes() -> None:
    rng = np.random.default_rng(1)
    p = [strongest_beyond_tolerance(made_up(rng.normal(0.0, WITHIN), rng).problem, rng, 1e6)[1] for _ in range(300)]
    assert np.mean(np.array(p) < 0.2) == pytest.approx(0.2, abs=3.0 * np.sqrt(0.16 / 300))
    assert np.mean(p) == pytest.approx(0.5, abs=3.0 / np.sqrt(12 * 300))


@pytest.mark.parametrize("cause", range(len(USED)))
def test_strongest_beyond_tolerance_is_the_hidden_cause(cause: int) -> None:
    rng = np.random.default_rng(cause)
    sizes = np.zeros(len(USED))
    sizes[cause] = 5.0 * WITHIN[cause]
    problem = made_up(sizes, rng).problem
    found, p = strongest_beyond_tolerance(problem, rng, 1e6)
    assert found == cause
    assert p < 1e-3
    weak = dataclasses.replace(problem, moment=problem.moment * 0.3)
    assert strongest_beyond_tolerance(weak, rng, 1e6)[1] > 0.05


def test_simplest_set_of_equally_good_clocks_takes_the_wheels() -> None:
    """Whatever rounding says: the estimators' poses bear the stamps of the scans."""
    wheels, lidar, other = ({CAUSES[name]: 0.1} for name in ("wheel_time_offset", "lidar_time_offset", "track_width"))
    predictor = cast(DrivePredictor, SimpleNamespace(has_baseline=False, drive=SimpleNamespace(is_lidar_reference=True)))
    for off in (-1e-9, 0.0, 1e-9):
        assert simplest_set([(-50.0, lidar), (-50.0 + off, wheels), (-30.0, other)], 0.0, predictor) == wheels
    assert simplest_set([(-50.0, lidar), (-40.0, wheels)], 0.0, predictor) == lidar


def test_fit_by_likelihood_weak_size_is_unbiased_with_its_sigma() -> None:
    """A drive that shows a cause as well as its prior does: `fit` pulls the size halfway to zero."""
    problem = made_up(np.zeros(4), np.random.default_rng(0)).problem
    weak = dataclasses.replace(problem, gram=np.eye(4), moment=np.array([6.0, 0.0, 0.0, 0.0]))
    sizes, cov = weak.fit_by_likelihood((0,))
    assert sizes[0] == pytest.approx(6.0 * weak.scale[0], rel=1e-4)
    assert np.sqrt(cov[0, 0]) == pytest.approx(weak.scale[0], rel=1e-4)
    assert weak.fit((0,))[0][0] == pytest.approx(3.0 * weak.scale[0])


def test_detectable_sizes_are_beside_what_is_tolerated() -> None:
    """Where a second cause has nearly the signature of the first, its tolerance hides as much of it."""
    problem = made_up(np.zeros(4), np.random.default_rng(0)).problem
    alike = np.eye(4)
    alike[0, 1] = alike[1, 0] = 0.99
    alone, beside = (dataclasses.replace(problem, gram=1e6 * gram).detectable_sizes(3.0) for gram in (np.eye(4), alike))
    assert beside[0] > 2.0 * alone[0]
    assert beside[2] == pytest.approx(alone[2])


def test_simplest_set_of_equally_good_clocks_takes_that_of_a_reference() -> None:
    """It is no part of the robot, whose file would put the wheels off against its LiDAR."""
    wheels, reference = ({CAUSES[name]: 0.1} for name in ("wheel_time_offset", "lidar_time_offset"))
    predictor = cast(DrivePredictor, SimpleNamespace(has_baseline=False, drive=SimpleNamespace(is_lidar_reference=False)))
    for off in (-1e-9, 0.0, 1e-9):
        assert simplest_set([(-50.0, reference), (-50.0 + off, wheels)], 0.0, predictor) == reference


def test_joint_p_of_healthy_robots_has_its_level() -> None:
    """Of 400 robots off their files by what is tolerated, 5 % are below 5 %, within the 99.9 % interval."""
    rng = np.random.default_rng(5)
    p = np.array([made_up(WITHIN * rng.normal(size=len(USED)), rng).problem.joint_p((), np.zeros(0)) for _ in range(400)])
    assert binom.ppf(0.0005, 400, 0.05) <= np.count_nonzero(p <= 0.05) <= binom.ppf(0.9995, 400, 0.05)


def test_joint_p_of_sizes_that_are_each_tolerated_is_small() -> None:
    """2.5 sigma of every cause at once, of which each by itself is a robot in eighty."""
    problem = made_up(2.5 * WITHIN, np.random.default_rng(5)).problem
    assert problem.joint_p((), np.zeros(0)) < 1e-3
    assert problem.joint_p((0, 1, 2, 3), 2.5 * WITHIN) == 1.0  # nothing is left to be tolerated
