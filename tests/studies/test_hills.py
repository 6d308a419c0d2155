"""The slope tables against MuJoCo's measurements."""

import math

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")

from tests.helpers.hills import RAMP, rolling_drive
from tests.helpers.mujoco_hills import Wander, drive
from tests.studies.hill_reckoning import along, in_body, reckon
from tests.studies.hills import HEADINGS, TURNINGS, over_headings, turn

_TO_15_DEG = [row for row in TURNINGS if row.slope_deg < 15.0]


@pytest.mark.parametrize("row", _TO_15_DEG, ids=lambda r: f"{r.slope_deg:.0f} deg, mu {r.mu}, CG {r.cg_height_m}")
def test_hills_slide_of_turns_in_place_is_that_of_mujoco(row):
    """The flat model misses all of it; from 15 degrees on MuJoCo's k rises faster than the law's."""
    x, _, yaw = turn(row)
    assert -x == pytest.approx(row.slid_m, rel=0.15 if row.slope_deg == 5.0 else 0.2)
    assert yaw / math.radians(540.0) - 1.0 == pytest.approx(row.turned_more, abs=0.09)


@pytest.mark.parametrize("row", HEADINGS, ids=lambda r: f"{r.robot}, {r.slope_deg:.0f} deg")
def test_hills_centre_of_rotation_moves_as_in_mujoco(row):
    """A constant k and centre of rotation have ranges of zero."""
    law = over_headings(row)
    assert law.x_m == pytest.approx(row.x_m, rel=0.2)
    assert law.y_m == pytest.approx(row.y_m, rel=0.3)
    assert law.k == pytest.approx(row.k, abs=0.085)


def test_hills_ramp_has_the_gradient_of_its_height():
    """15 degrees up and down, level before and after."""
    x, d = np.linspace(0.0, 18.0, 200), 1e-5
    differences = (RAMP.height(x + d, 0.0 * x) - RAMP.height(x - d, 0.0 * x)) / (2.0 * d)
    slopes = np.array([RAMP.gradient(a, 0.0)[0] for a in x.tolist()])
    np.testing.assert_allclose(slopes, differences, atol=1e-6)
    assert [RAMP.gradient(a, 0.0)[0] for a in (1.0, 7.0, 11.0, 17.0)] == pytest.approx([0.0, 0.268, -0.268, 0.0], abs=1e-3)


def test_reckoning_parts_of_a_true_drive_are_zero():
    """Body motions along their own rotations give the way again, so that each part has its own error alone."""
    made = rolling_drive(8.0)
    R, ways = made.rotations, made.positions - made.positions[0]
    np.testing.assert_allclose(along(in_body(ways, R), R), ways, atol=1e-4)


@pytest.fixture(scope="module")
def nees_of_reckoning():
    """Sum at the end of eight drives of 30 s over hills by wheels and IMU, 24 degrees of freedom. None of these seeds was used in
    development."""
    return sum(reckon(drive(Wander(seed), 30.0, seed=seed)).nees for seed in range(61, 69))


@pytest.mark.slow
def test_reckoning_over_seeds_is_not_overconfident(nees_of_reckoning):
    assert nees_of_reckoning < 45.6  # 99.5 % of chi-square


@pytest.mark.slow
@pytest.mark.xfail(reason="8.6: sigmas are 1.7 times too wide after 30 s, where the tyres' prior counts, in range after 2 min", strict=True)
def test_reckoning_over_seeds_is_not_conservative(nees_of_reckoning):
    assert nees_of_reckoning > 9.9  # 0.5 %
