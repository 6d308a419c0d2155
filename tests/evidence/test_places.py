"""Where a LiDAR is along the robot: a load moves the centre of rotation as far as a mount that is wrong would seem to be off."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from localization.evidence.alternatives.places import PlacePrior, side_evidence, usual_place
from motion_models.robot import DIFF_DRIVE, Robot
from motion_models.robot_file import load_robot

WARTHOG = load_robot("warthog")
WRONG, WRONG_ODDS = PlacePrior(0.6), math.log(1e-3)


@pytest.mark.parametrize("ahead", [0.0, 0.3, -0.6])
@pytest.mark.parametrize("sigma", [0.005, 0.1, 3.0])
def test_evidence_is_the_mean_of_the_likelihood_over_the_prior(ahead: float, sigma: float) -> None:
    prior = PlacePrior(0.07, 0.9, 0.3)

    def density(place: float) -> float:
        flat = norm.cdf((0.45 - place) / 0.07) - norm.cdf((-0.45 - place) / 0.07)
        return float(0.7 * norm.pdf(place, 0.0, 0.07) + 0.3 * flat / 0.9)

    mean, _ = quad(lambda place: density(place) * math.exp(-0.5 * ((place - ahead) / sigma) ** 2), -2.0, 2.0, points=[ahead, 0.0])
    found = prior.log_evidence(np.array([ahead]), np.array([sigma**2]))[0]
    assert found == pytest.approx(math.log(mean), abs=1e-3)


def test_spread_is_the_standard_deviation_of_the_prior() -> None:
    drawn = np.random.default_rng(1)
    loaded = drawn.random(400_000) < 0.3
    places = drawn.normal(0.0, 0.07, 400_000) + np.where(loaded, drawn.uniform(-0.45, 0.45, 400_000), 0.0)
    assert PlacePrior(0.07, 0.9, 0.3).spread_m == pytest.approx(places.std(), rel=5e-3)


def odds(robot: Robot, ahead_m: float) -> float:
    """Logarithm of the odds of a mount that is wrong, by turns in place with a sensor so far ahead of its place with the centre of
    rotation."""
    rng = np.random.default_rng(3)
    turn, way = rng.uniform(-0.6, 0.6, 60), rng.normal(0.0, 0.01, 60)
    side = ahead_m * turn + rng.normal(0.0, 0.01, 60)
    wrong, usual = (side_evidence(side, way, turn, place) for place in (WRONG, usual_place(0.07, robot)))
    assert wrong.ahead_m == pytest.approx(ahead_m, abs=0.02)
    assert wrong.by_bin.shape == side.shape
    return wrong.evidence + WRONG_ODDS - usual.evidence


def test_centre_of_rotation_of_a_loaded_robot_accuses_no_mount() -> None:
    assert odds(WARTHOG, 0.3) < math.log(0.02)


def test_place_beyond_the_axles_is_of_the_mount() -> None:
    assert odds(WARTHOG, 0.5 * WARTHOG.geometry.wheelbase_m + 0.35) > math.log(50.0)


def test_robot_with_casters_turns_about_its_axle_with_any_load() -> None:
    assert odds(replace(WARTHOG, drive=DIFF_DRIVE), 0.4) > math.log(50.0)
