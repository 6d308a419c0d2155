"""Claims about `center_of_rotation`: it finds the point of eqs. 4.2-4.5, and its covariance is the spread of its errors."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motion_models.calibration.center_of_rotation import _final_point, center_from_end_poses, center_of_arc
from motion_models.errors import CalibrationError
from motion_models.se2 import compose, exp

POSE_SIGMA = np.array([0.002, 0.002, 0.002])
COV = np.diag(POSE_SIGMA**2)


def arc(center, start, turns):
    """Poses (n, 3) of a body that has turned by ``turns`` (n,) about its own point ``center`` (2,)."""
    turns = np.asarray(turns, dtype=float)
    c, s = np.cos(turns), np.sin(turns)
    x, y = center
    about = np.stack([x - c * x + s * y, y - s * x - c * y, turns], axis=-1)
    return compose(start, about)


def noisy(poses, rng):
    return compose(poses, exp(rng.normal(size=poses.shape) * POSE_SIGMA))


coordinate = st.floats(-3, 3)
angle = st.floats(0.05, 3.0).flatmap(lambda a: st.sampled_from([a, -a]))


@given(coordinate, coordinate, coordinate, angle)
@settings(deadline=None)
def test_centers_of_a_perfect_arc_are_exact(x, y, heading, turn):
    poses = arc((x, y), [0.3, -1.2, heading], np.linspace(0, turn, 12))
    by_ends = center_from_end_poses(poses[0], poses[-1], COV, COV)
    by_all = center_of_arc(poses, COV)
    np.testing.assert_allclose(by_ends.value, [x, y], atol=1e-9)
    np.testing.assert_allclose(by_all.value, [x, y], atol=1e-7)
    assert by_all.chi_square < 1e-9
    # More poses cannot know less than two of them.
    assert np.linalg.eigvalsh(by_ends.cov - by_all.cov).min() > -1e-6 * by_ends.cov.max()


@given(coordinate, coordinate, angle)
@settings(deadline=None)
def test_center_of_arc_of_two_poses_is_that_of_end_poses(x, y, turn):
    poses = arc((x, y), [0.0, 0.0, 0.0], [0, turn])
    by_ends, by_all = center_from_end_poses(*poses, COV, COV), center_of_arc(poses, COV)
    np.testing.assert_allclose(by_all.value, by_ends.value, atol=1e-6)
    np.testing.assert_allclose(by_all.cov, by_ends.cov, rtol=1e-3, atol=1e-9 + 1e-3 * by_ends.cov.max())


def test_center_from_end_poses_is_the_formula_of_the_thesis():
    """4.4 and 4.5 with the start at the origin, typed in again."""
    x, y, t = 0.31, -0.12, 0.7
    value = center_from_end_poses([0, 0, 0], [x, y, t]).value
    c_x = ((1 - math.cos(t)) * x + math.sin(t) * -y) / (2 * (1 - math.cos(t)))
    c_y = ((1 - math.cos(t)) * y + math.sin(t) * x) / (2 * (1 - math.cos(t)))
    np.testing.assert_allclose(value, [c_x, c_y], rtol=1e-14)


@given(coordinate, coordinate, angle)
@settings(deadline=None)
def test_center_from_end_poses_derivative_is_a_difference(x, y, turn):
    delta = arc((x, y), [0, 0, 0], [turn])[0]
    _, jacobian = _final_point(delta)
    h = 1e-6
    for j in range(3):
        e = h * np.eye(3)[j]
        difference = (_final_point(compose(delta, exp(e)))[0] - _final_point(compose(delta, exp(-e)))[0]) / (2 * h)
        np.testing.assert_allclose(jacobian[:, j], difference, rtol=1e-5, atol=1e-5 * (1 + np.abs(jacobian).max()))


@pytest.mark.parametrize("turn", [0.02, 0.1, 1.5, 4.0])
def test_center_from_end_poses_covariance_covers(turn):
    rng = np.random.default_rng(3)
    truth = np.array([-0.1, 0.4])
    poses = arc(truth, [1.0, 2.0, 0.4], [0, turn])
    inside = 0
    for _ in range(2000):
        got = center_from_end_poses(*noisy(poses, rng), COV, COV)
        error = got.value - truth
        inside += error @ np.linalg.solve(got.cov, error) < 5.991  # 95 % of chi square with two degrees of freedom
    assert 0.93 < inside / 2000 < 0.97  # five binomial sigmas are 0.024


@pytest.mark.parametrize("turn", [0.05, 0.3, 1.5, 7.0])
def test_center_of_arc_covariance_and_chi_square_cover(turn):
    rng = np.random.default_rng(4)
    truth = np.array([-0.1, 0.4])
    poses = arc(truth, [1.0, 2.0, 0.4], np.linspace(0, turn, 25))
    inside, chi_square, errors, covs = 0, [], [], []
    for _ in range(1000):
        got = center_of_arc(noisy(poses, rng), COV)
        error = got.value - truth
        inside += error @ np.linalg.solve(got.cov, error) < 5.991
        chi_square.append(got.chi_square / got.degrees_of_freedom)
        errors.append(error)
        covs.append(got.cov)
    assert 0.925 < inside / 1000 < 0.98
    assert abs(np.mean(chi_square) - 1) < 0.03
    # and it is not biased: the mean error is within four of its own sigmas
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4 * np.sqrt(np.diagonal(np.mean(covs, axis=0)) / 1000))


def test_center_sigma_of_small_turns_grows_as_one_over_angle():
    turns = np.array([0.02, 0.01, 0.005, 0.0025])
    sigma = []
    for turn in turns:
        poses = arc((0.1, 0.2), [0, 0, 0], [0, turn])
        sigma.append(math.sqrt(np.trace(center_from_end_poses(*poses, COV, COV).cov)))
    slope = np.polyfit(np.log(turns), np.log(sigma), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.01)


def test_centers_without_a_turn_are_refused():
    with pytest.raises(CalibrationError, match="without a turn"):
        center_from_end_poses([0, 0, 0.3], [1, 0, 0.3])
    with pytest.raises(CalibrationError, match="without a turn"):
        center_of_arc([[0, 0, 0.3], [1, 0, 0.3], [2, 0, 0.3]], COV)


@pytest.mark.parametrize("poses", [[[0, 0, 0]], [[0, 0, 0], [np.nan, 0, 1]], [[0, 0], [1, 1]], []])
def test_center_of_arc_of_bad_poses_is_refused(poses):
    with pytest.raises(CalibrationError, match="two finite poses"):
        center_of_arc(poses, COV)


def test_center_of_arc_of_certain_poses_is_refused():
    with pytest.raises(CalibrationError, match="positive definite"):
        center_of_arc(arc((0.1, 0), [0, 0, 0], [0, 1]), np.zeros((3, 3)))


@pytest.mark.parametrize("turn", [1e-3, 1e-4])
def test_center_of_arc_below_its_noise_is_refused_or_uncertain(turn):
    """Turned by half a sigma of one heading, and by a twentieth: never a centre that claims to be known to a decimetre."""
    rng = np.random.default_rng(5)
    poses = arc((0.1, 0.4), [0, 0, 0], np.linspace(0, turn, 5))
    for _ in range(200):
        try:
            got = center_of_arc(noisy(poses, rng), COV)
        except CalibrationError:
            continue
        assert math.sqrt(np.linalg.eigvalsh(got.cov).max()) > 0.1
