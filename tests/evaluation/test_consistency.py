"""Consistency tests, by counting: errors of the stated covariance pass at the stated rate, others fail.

Bounds on counts are binomial at one in a million, so that a correct implementation fails with no seed in practice.
"""

import math

import numpy as np
import pytest
from filterpy.stats import NEES
from scipy.stats import binom, chi2, kstest

from localization.errors import EvaluationError
from localization.evaluation.consistency import (
    claimed_samples,
    consistency,
    degrees_of_freedom,
    independent_samples,
    mean_band,
    nees,
    nis,
    pose_consistency,
    pose_errors,
    position_consistency,
    stretch_consistency,
)
from localization.evaluation.references import ReferenceTrack, with_noise
from localization.trajectory import Trajectory
from motion_models import se2
from tests.helpers.extended import cases

SECOND = 10**9


def random_covariances(rng, n, d=3):
    a = rng.normal(size=(n, d, d)) * np.array([0.1, 0.02, 0.003])[:d, None]
    return a @ np.swapaxes(a, 1, 2) + 1e-8 * np.eye(d)


def draw(rng, covariances):
    return np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), rng.normal(size=covariances.shape[:2]))


def as_often_as(count, n, probability):
    low, high = binom.ppf([5e-7, 1 - 5e-7], n, probability)
    return low <= count <= high


def test_nees_is_that_of_the_inverse_covariance():
    rng = np.random.default_rng(0)
    p = random_covariances(rng, 100)
    e = rng.normal(size=(100, 3))
    expected = [x @ np.linalg.solve(c, x) for x, c in zip(e, p, strict=True)]
    np.testing.assert_allclose(nees(e, p), expected, rtol=1e-6)
    np.testing.assert_array_equal(nis(e, p), nees(e, p))


def test_nees_is_that_of_filterpy():
    rng = np.random.default_rng(2)
    p = random_covariances(rng, 200)
    truth, estimate = rng.normal(size=(2, 200, 3))
    np.testing.assert_allclose(nees(truth - estimate, p), NEES(truth, estimate, p), rtol=1e-6)


def test_nees_does_not_depend_on_units():
    rng = np.random.default_rng(1)
    p, scale = random_covariances(rng, 50), np.array([1e3, 1.0, 180 / math.pi])
    e = draw(rng, p)
    np.testing.assert_allclose(nees(e * scale, p * np.outer(scale, scale)), nees(e, p), rtol=1e-9)


def test_nees_of_drawn_errors_is_chi_square():
    rng = np.random.default_rng(2)
    p = random_covariances(rng, 20_000)
    values = nees(draw(rng, p), p)
    assert kstest(values, chi2(3).cdf).pvalue > 1e-6
    assert as_often_as(np.count_nonzero(values <= chi2.ppf(0.95, 3)), 20_000, 0.95)


@pytest.mark.parametrize("probability", [0.8, 0.95, 0.99])
def test_is_consistent_right_covariance_passes_at_the_stated_rate(probability):
    inside = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        p = random_covariances(rng, 50)
        inside += consistency(draw(rng, p), p, probability).verdict == "consistent"
    assert as_often_as(inside, 400, probability)


@pytest.mark.parametrize(("factor", "verdict"), [(0.5, "overconfident"), (2.0, "conservative")])
def test_is_consistent_variance_wrong_by_two_fails(factor, verdict):
    found = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        p = random_covariances(rng, 50)
        found.append(consistency(draw(rng, p), factor * p))
    # 50 samples of 3: the mean moves by 8 of its standard deviations one way, by 5 the other
    assert [c.verdict for c in found] == [verdict] * 200
    assert np.mean([c.mean for c in found]) == pytest.approx(3.0 / factor, rel=0.02)
    assert all((c.fraction_inside < 0.95) == (verdict == "overconfident") for c in found if abs(c.fraction_inside - 0.95) > 0.05)


def test_band_is_that_of_the_mean():
    rng = np.random.default_rng(3)
    means = chi2.rvs(3, size=(20_000, 10), random_state=rng).mean(axis=1)
    low, high = mean_band(10, 3)
    assert as_often_as(np.count_nonzero(means < low), 20_000, 0.025)
    assert as_often_as(np.count_nonzero(means > high), 20_000, 0.025)
    # Bar-Shalom et al. 2001, example in sec. 5.4.2: 50 runs of dimension 2, two-sided 95 %: [1.5, 2.6]
    assert np.round(mean_band(50, 2), 1).tolist() == [1.5, 2.6]


def test_nees_accepts_stacked_runs():
    rng = np.random.default_rng(5)
    p = random_covariances(rng, 60)
    e = draw(rng, p)
    flat, stacked = consistency(e, p), consistency(e.reshape(6, 10, 3), p.reshape(6, 10, 3, 3), n_independent=6)
    assert stacked.mean == flat.mean
    assert (stacked.n, stacked.n_independent) == (60, 6)
    assert stacked.band == mean_band(6, 3)


# --- singular covariances


def test_nees_direction_of_zero_variance_without_error_is_not_counted():
    rng = np.random.default_rng(6)
    basis = np.linalg.qr(rng.normal(size=(5_000, 3, 3)))[0][:, :, :2]  # errors lie in a plane, another one each time
    p = basis @ np.array([[0.4, 0.1], [0.1, 0.2]]) @ np.swapaxes(basis, 1, 2)
    e = np.einsum("nij,nj->ni", basis, rng.multivariate_normal([0, 0], [[0.4, 0.1], [0.1, 0.2]], 5_000))
    assert set(degrees_of_freedom(p)) == {2}
    assert kstest(nees(e, p), chi2(2).cdf).pvalue > 1e-6
    found = consistency(e, p)
    assert (found.dof, found.verdict) == (2.0, "consistent")


def test_nees_direction_of_zero_variance_with_error_is_infinite():
    p = np.diag([0.01, 0.0, 0.01])
    assert nees([[0.1, 0.0, 0.0]], [p])[0] == pytest.approx(1.0)
    assert nees([[0.1, 1e-3, 0.0]], [p])[0] == np.inf
    assert nees([[0.1, 1e-9, 0.0]], [p])[0] == pytest.approx(1.0)  # a nanometre is rounding
    found = consistency([[0.1, 1e-3, 0.0], [0.1, 0.0, 0.0]], [p, p])
    assert (found.mean, found.verdict, found.fraction_inside) == (np.inf, "overconfident", 0.5)
    assert consistency([[1.0, 0.0, 0.0]], np.zeros((1, 3, 3))).verdict == "overconfident"


def test_nees_of_certain_samples_without_error_is_untested():
    rng = np.random.default_rng(7)
    p = random_covariances(rng, 10)
    e = draw(rng, p)
    padded = consistency(np.vstack([np.zeros((5, 3)), e]), np.concatenate([np.zeros((5, 3, 3)), p]))
    assert padded == consistency(e, p)
    with pytest.raises(EvaluationError, match="no sample with an uncertain error"):
        consistency(np.zeros((5, 3)), np.zeros((5, 3, 3)))


@pytest.mark.parametrize(
    ("errors", "covariances", "complaint"),
    [
        (np.zeros((2, 3)), np.zeros((2, 2, 2)), r"found \(2, 3\) and \(2, 2, 2\)"),
        (np.zeros(3), np.eye(3), "shape"),
        ([[0.0, np.nan]], [np.eye(2)], "error number 0 .* not finite"),
        ([[0.0, 0.0]], [np.full((2, 2), np.inf)], "covariance number 0 .* not finite"),
        ([[0.0, 0.0]] * 2, [np.eye(2), [[1.0, 0.5], [0.0, 1.0]]], "covariance number 1 is not symmetric"),
        ([[0.0, 0.0]], [[[1.0, 2.0], [2.0, 1.0]]], "negative eigenvalue"),
        ([[0.0, 0.0]], [[[1.0, 0.0], [0.0, -1.0]]], "negative eigenvalue"),
        ([[0.0, 0.0]], [[[0.0, 0.1], [0.1, 1.0]]], "no covariance"),
    ],
)
def test_nees_invalid_covariance_is_refused(errors, covariances, complaint):
    with pytest.raises(EvaluationError, match=complaint):
        nees(errors, covariances)


@pytest.mark.parametrize(("n", "dof", "probability"), [(0, 3, 0.95), (5, 0, 0.95), (5, 3, 1.0)])
def test_band_of_no_samples_is_refused(n, dof, probability):
    with pytest.raises(EvaluationError, match="no band"):
        mean_band(n, dof, probability)


# --- pose errors

STEP_COVARIANCE = np.array([[4e-4, 1e-5, 0.0], [1e-5, 1e-4, 2e-5], [0.0, 2e-5, 4e-5]])


def odometry_runs(seed, runs=1, n=60, first_covariance=None):
    """Truths (runs, n + 1, 3), and the one odometry (n + 1, 3) of them all, in another plane, with the covariance that first-order
    propagation gives it."""
    motion = np.array([0.2, 0.0, 0.05])
    noise = np.random.default_rng(seed).multivariate_normal(np.zeros(3), STEP_COVARIANCE, (runs, n))
    truths, estimate = [np.zeros((runs, 3))], [np.array([4.0, -2.0, 1.0])]
    covariances = [np.zeros((3, 3)) if first_covariance is None else first_covariance]
    a = se2.adjoint(se2.inverse(se2.exp(motion)))
    for k in range(n):
        estimate.append(se2.compose(estimate[-1], se2.exp(motion)))
        truths.append(se2.compose(truths[-1], se2.compose(se2.exp(motion), se2.exp(noise[:, k]))))
        covariances.append(a @ covariances[-1] @ a.T + STEP_COVARIANCE)
    return np.stack(truths, axis=1), np.array(estimate), np.array(covariances)


def odometry_run(seed, **more):
    truths, estimate, covariances = odometry_runs(seed, **more)
    return truths[0], estimate, covariances


def as_track(truth, **more):
    return ReferenceTrack(np.arange(len(truth)) * SECOND, truth[:, :2], truth[:, 2], **more)


def as_trajectory(estimate, covariances):
    return Trajectory(np.arange(len(estimate)) * SECOND, estimate, covariances)


def test_pose_errors_start_at_the_first_match_in_the_estimate_frame():
    truth, estimate, covariances = odometry_run(9)
    found = pose_errors(as_trajectory(estimate, covariances), as_track(truth))
    assert len(found.errors) == 60  # the first match is the alignment itself
    start = se2.compose(truth[0], se2.inverse(estimate[0]))
    # right perturbation: the aligned estimate, moved by the error, is the truth
    np.testing.assert_allclose(se2.compose(se2.compose(start, estimate[1:]), se2.exp(found.errors)), truth[1:], atol=1e-12)
    np.testing.assert_array_equal(found.covariances, covariances[1:])
    assert found.n_left_out == 0


@pytest.mark.parametrize("first", [None, np.diag([0.04, 0.01, 0.01])])
def test_pose_nees_of_right_odometry_passes_whatever_its_first_sigma(first):
    truths, estimate, p = odometry_runs(14, runs=200, first_covariance=first)
    found = [pose_errors(as_trajectory(estimate, p), as_track(truth)) for truth in truths]
    values = np.array([nees(f.errors, f.covariances) for f in found])
    # at each of the instants the mean of 200 independent runs; instants are correlated, hence three of them only, at 99.9 %
    means, (low, high) = values.mean(axis=0), mean_band(200, 3, probability=0.999)
    assert np.all((means[[0, 30, 59]] > low) & (means[[0, 30, 59]] < high))


def test_pose_nees_of_half_the_variance_fails_over_runs():
    truths, estimate, p = odometry_runs(15, runs=100)
    found = [pose_errors(as_trajectory(estimate, 0.5 * p), as_track(truth)) for truth in truths]
    means = np.mean([nees(f.errors, f.covariances) for f in found], axis=0)
    assert np.all(means > mean_band(100, 3)[1])


@pytest.mark.extended
def test_nees_of_one_dead_reckoning_counts_as_two_samples_and_by_stretches():
    """A random walk's normalised errors have the correlation sqrt(s / t): in the mean of their squares that is two samples, which show half
    the sigma in some drives; sixteen stretches show it in all. Of right covariances 95 % are called consistent."""
    truths, estimate, p = odometry_runs(16, runs=100)
    noise = np.tile(np.diag([25e-6, 25e-6, 1e-6]), (61, 1, 1))
    tracks = [as_track(truth, covariances=noise) for truth in truths]
    right, halved = as_trajectory(estimate, p), as_trajectory(estimate, 0.25 * p)
    found = [pose_consistency(right, track, is_dead_reckoning=True) for track in tracks]
    assert 1.2 < np.median([one.n_independent for one in found]) < 2.1
    assert as_often_as([one.verdict for one in found].count("consistent"), 100, 0.97)
    assert [pose_consistency(halved, track, is_dead_reckoning=True).verdict for track in tracks].count("overconfident") > 50
    stretches = [stretch_consistency(right, track) for track in tracks]
    assert [one.n for one in stretches] == [16] * 100
    assert as_often_as([one.verdict for one in stretches].count("consistent"), 100, 0.95)
    assert {stretch_consistency(halved, track).verdict for track in tracks} == {"overconfident"}


def test_claimed_samples_of_a_random_walk_are_two():
    """Squared correlations s / t have the mean 1/2 over all pairs of times."""
    n = 400
    p = np.eye(3) * np.arange(1, n + 1)[:, None, None]
    rows = np.eye(3) / np.sqrt(np.arange(1, n + 1))[:, None, None]
    assert claimed_samples(rows, p, np.zeros((n, 3))) == pytest.approx(2.0, rel=0.02)


def correlated(rng, n, d, samples):
    """(n, d) standard normal errors that stay alike for so many ``samples``; for infinitely many they are one offset."""
    if math.isinf(samples):
        return np.repeat(rng.normal(size=(1, d)), n, axis=0)
    phi, noise, z = math.exp(-1.0 / samples), rng.normal(size=(n, d)), np.empty((n, d))
    z[0] = noise[0]
    for i in range(1, n):
        z[i] = phi * z[i - 1] + math.sqrt(1.0 - phi**2) * noise[i]
    return z


@pytest.mark.extended
@pytest.mark.parametrize(("samples", "n_expected"), cases([(1e-3, 400.0), (8.0, 50.0), (40.0, 10.0), (math.inf, 1.0)], ("8.0",)))
def test_p_value_of_correlated_errors_is_uniform(samples, n_expected):
    """Of consistent errors 95 % are called so, whatever their correlation; of half the sigma nearly all are called overconfident."""
    rng, p = np.random.default_rng(20), np.tile(np.eye(3), (400, 1, 1))
    runs = [correlated(rng, 400, 3, samples) for _ in range(250)]
    found = [consistency(e, p, n_independent=independent_samples(e)) for e in runs]
    assert np.median([one.n_independent for one in found]) == pytest.approx(n_expected, rel=0.2)
    assert kstest([one.p_value for one in found], "uniform").pvalue > 1e-3
    assert [one.verdict for one in found].count("consistent") >= binom.ppf(1e-3, 250, 0.93)
    halved = [consistency(e, 0.25 * p, n_independent=independent_samples(e)).verdict for e in runs]
    assert halved.count("overconfident") >= (0.95 if n_expected > 2.0 else 0.4) * 250


def test_independent_samples_of_a_robot_that_stands_are_those_of_its_drive():
    """An error that stays while the robot stands is one sample, however many messages have it."""
    z = correlated(np.random.default_rng(21), 100, 3, 1e-3)
    assert independent_samples(z, np.append(np.ones(99), 400.0)) == pytest.approx(499.0**2 / (99.0 + 400.0**2), rel=0.05)
    assert independent_samples(z[:1]) == 1.0


def test_position_nees_of_odometry_without_headings_follows_its_covariance():
    """The frame of the positions is turned: right covariances are consistent, half the sigma shows over stretches, and where the positions'
    noise hides it, nothing is claimed."""
    truths, estimate, p = odometry_runs(22, runs=100)
    rng, verdicts, by_stretches, halved, means = np.random.default_rng(23), [], [], [], []
    for truth in truths:
        seen = se2.compose([3.0, -2.0, 1.1], truth)[:, :2] + 0.005 * rng.normal(size=(len(truth), 2))
        track = ReferenceTrack(np.arange(len(truth)) * SECOND, seen, None, np.tile(np.diag([25e-6, 25e-6, 0.0]), (len(truth), 1, 1)))
        found = position_consistency(as_trajectory(estimate, p), track, is_dead_reckoning=True)
        verdicts.append(found.verdict)
        means.append(found.mean)
        by_stretches.append(stretch_consistency(as_trajectory(estimate, p), track).verdict)
        halved.append(stretch_consistency(as_trajectory(estimate, 0.25 * p), track).verdict)
    assert as_often_as(verdicts.count("consistent"), 100, 0.98)
    assert np.mean(means) == pytest.approx(1.0, abs=0.25)
    assert as_often_as(by_stretches.count("consistent"), 100, 0.95)
    assert halved.count("overconfident") >= 85  # 96 % of 200 drives
    coarse = ReferenceTrack(np.arange(61) * SECOND, truths[0][:, :2], None, np.tile(np.diag([1.0, 1.0, 0.0]), (61, 1, 1)))
    assert stretch_consistency(as_trajectory(estimate, p), coarse) is None


def test_position_nees_without_covariances_or_motion_is_none():
    truth, estimate, p = odometry_run(24)
    positions = ReferenceTrack(np.arange(61) * SECOND, truth[:, :2])
    assert position_consistency(as_trajectory(estimate, p), positions) is None
    parked = ReferenceTrack(np.arange(61) * SECOND, np.zeros((61, 2)), None, np.tile(np.eye(3), (61, 1, 1)))
    assert position_consistency(as_trajectory(np.zeros((61, 3)), p), parked) is None


def test_pose_nees_with_reference_noise_counts_it_where_given():
    noise = np.diag([0.09, 0.0009, 0.0025])  # along and across the plane's x, not the robot's
    truths, estimate, p = odometry_runs(17, runs=400, n=10)
    rng = np.random.default_rng(18)
    whitened = []
    for truth in truths:
        seen = se2.compose([0, 0, 0.7], truth) + rng.multivariate_normal(np.zeros(3), noise, len(truth))
        found = pose_errors(as_trajectory(estimate, p), as_track(seen, covariances=np.broadcast_to(noise, (len(seen), 3, 3))))
        whitened.append(np.linalg.solve(np.linalg.cholesky(found.covariances[-1]), found.errors[-1]))
    # 400 draws: a variance is estimated to 7 %, a correlation to 5 %; five of these
    np.testing.assert_allclose(np.cov(whitened, rowvar=False), np.eye(3), atol=0.35)
    unknown = np.full((11, 3, 3), np.nan)
    np.testing.assert_array_equal(pose_errors(as_trajectory(estimate, p), as_track(truths[0], covariances=unknown)).covariances, p[1:])


def test_pose_nees_before_the_first_motion_is_left_out():
    truth, estimate, p = odometry_run(10)
    stands = 20
    truth, estimate = (np.vstack([np.repeat(a[:1], stands, axis=0), a]) for a in (truth, estimate))
    p = np.concatenate([np.zeros((stands, 3, 3)), p])
    jitter = np.random.default_rng(11).normal(0, 1e-3, (len(truth), 3))
    found = pose_consistency(as_trajectory(estimate, p), as_track(truth + jitter))
    assert found.n == 60
    assert math.isfinite(found.mean)


def test_pose_nees_shrinking_covariance_is_left_out_and_counted():
    truth, estimate, p = odometry_run(12, first_covariance=np.diag([0.04, 0.01, 0.01]))
    p[40] = 1e-3 * np.eye(3)  # an absolute fix: less than the start's uncertainty carried along
    found = pose_errors(as_trajectory(estimate, p), as_track(truth))
    assert found.n_left_out == 1
    assert 40 * SECOND not in found.stamps_ns
    assert pose_consistency(as_trajectory(estimate, p), as_track(truth)).n_left_out == 1


def test_pose_nees_untestable_is_none_or_refused():
    truth, estimate, p = odometry_run(13)
    positions = ReferenceTrack(np.arange(61) * SECOND, truth[:, :2])
    assert pose_consistency(as_trajectory(estimate, p), positions) is None
    assert pose_consistency(Trajectory(np.arange(61) * SECOND, estimate), as_track(truth)) is None
    assert pose_errors(Trajectory(np.arange(61) * SECOND, estimate), as_track(truth)).covariances is None
    parked = as_trajectory(np.zeros((61, 3)), np.zeros((61, 3, 3)))
    assert pose_consistency(parked, as_track(np.zeros((61, 3)))) is None
    with pytest.raises(EvaluationError, match="has positions only"):
        pose_errors(as_trajectory(estimate, p), positions)


def test_pose_consistency_with_noise_of_the_reference_counts_it() -> None:
    """Poses that are exact but for the reference's noise: overconfident without it, consistent with it."""
    rng, n, sigma = np.random.default_rng(3), 4000, np.array([0.02, 0.02, 0.01])
    stamps = np.arange(n, dtype=np.int64) * 100_000_000
    truth = np.column_stack([0.01 * np.arange(n), np.zeros(n), np.zeros(n)])
    estimate = Trajectory(stamps, truth, np.tile(1e-8 * np.eye(3), (n, 1, 1)) * np.arange(1, n + 1)[:, None, None])
    noisy = truth + rng.normal(size=(n, 3)) * sigma
    noisy[0] = truth[0]
    reference = ReferenceTrack(stamps, noisy[:, :2], noisy[:, 2])
    exact, known = pose_consistency(estimate, reference), pose_consistency(estimate, with_noise(reference, 0.02, 0.01))
    assert exact is not None
    assert known is not None
    assert exact.mean > 100.0
    assert 0.2 < known.mean < 3.5
    with pytest.raises(EvaluationError, match="both must be 0 or more"):
        with_noise(reference, -1.0, 0.0)
