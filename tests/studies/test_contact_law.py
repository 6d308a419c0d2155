"""Contact laws on measured data (tests/studies/contact_law.py), and the second implementation behind them."""

import numpy as np
import pytest

from motion_models.friction import FrictionModel
from motion_models.friction.contact import SATURATION
from tests.studies.contact_law import (
    choose_stiffness,
    husky_curvature,
    husky_errors,
    paired_gain,
    relative,
    rival,
    rms,
    shipped,
    terrain_curvature,
)
from tests.studies.friction_grid import FITTED, fitted, friction
from tests.studies.rival_laws import SHAPES, RivalFriction

LAWS = (shipped("thesis", 13.333), shipped("isotropic", 10.0))


@pytest.mark.parametrize("centripetal", [False, True])
def test_second_implementation_gives_the_shipped_motion(centripetal):
    rng = np.random.default_rng(0)
    params = friction().nominal.copy()
    params[[8, 7, 10]] += (0.1, 0.01, 0.05)
    wheels, cg = rng.uniform(-4, 4, (500, 2)), rng.uniform(-0.1, 0.1, (500, 2))
    shipped_twist = FrictionModel(params, SATURATION["isotropic"], centripetal).twist(wheels, cg, params).value
    found = RivalFriction(params, centripetal=centripetal).twist(wheels, cg, params).value
    np.testing.assert_allclose(found, shipped_twist, atol=1e-9)


@pytest.mark.parametrize("shape", list(SHAPES))
def test_rival_law_is_proportional_first_and_saturates(shape):
    z = np.array([0.0, 1e-6, 50.0])
    np.testing.assert_allclose(SHAPES[shape](z), [0.0, 1e-6, 1.0], rtol=1e-5)


@pytest.mark.extended
def test_grid_does_not_separate_brush_and_exponential_tyre():
    brush = fitted(FITTED, rival("brush", 8.0).model("VaultBot"))[1]
    exponential = fitted(FITTED)[1]
    assert brush.ratio == pytest.approx(exponential.ratio, rel=0.15)


def test_k_of_two_huskies_does_not_fall_on_gentle_arcs():
    """DRIVE by ICP and BorealTC by gyro: k over that of the sharpest turns, on the two gentlest kinds of arc together."""
    for bins in (husky_curvature(LAWS), terrain_curvature(LAWS)):
        found = [relative(b, bins[-1]) for b in bins[:2]]
        weights = np.array([sigma**-2 for _, sigma, _ in found])
        share = np.average([share for share, _, _ in found], weights=weights)
        by_thesis, by_isotropic = (np.average([p[i] for _, _, p in found], weights=weights) for i in (0, 1))
        sigma = weights.sum() ** -0.5
        assert abs(share - by_isotropic) < 2.5 * sigma
        assert share - by_thesis > 3.5 * sigma


def test_husky_unfitted_error_is_that_of_the_thesis_law():
    errors = husky_errors(LAWS[1].model("Husky"))
    assert np.sqrt(2.0) * rms(errors[:, :2]) <= 0.31


def test_stiffness_is_chosen_without_the_data_that_score_it():
    scores = np.array([[1.0, 9.0, 9.0], [9.0, 1.0, 1.0], [3.0, 3.0, 3.0]])
    assert choose_stiffness(scores, 0) == 1
    assert choose_stiffness(scores, 1) == 0 or choose_stiffness(scores, 1) == 1
    scores[1, 2] = 20.0
    assert choose_stiffness(scores, 1) == 0


def test_gain_is_that_of_the_errors_with_an_interval():
    rng = np.random.default_rng(1)
    before = rng.normal(size=(200, 2))
    gain, low, high = paired_gain(before, 0.8 * before + 0.05 * rng.normal(size=(200, 2)), np.arange(200) // 4)
    assert low < gain < high
    assert gain == pytest.approx(0.2, abs=0.02)
    assert high - low < 0.05
