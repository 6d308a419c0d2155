"""Consistency of covariances: NEES and NIS against chi-square bands (Bar-Shalom et al. 2001, 5.4).

A consistent estimator's normalised squared errors ``e^T P^-1 e`` follow chi-square with as many degrees of freedom as ``e`` has dimensions
(Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, sec. 5.4). NEES takes errors against the
truth, NIS innovations against their predicted covariance. Both are needed: innovations can be consistent while the state is not.

The bands are for independent samples. Innovations of a consistent filter are independent; pose errors along one run are not: this second's
error is the last one's plus a little. How many independent samples they are worth follows from their own autocorrelation
(`independent_samples`): one for an offset that stays, two for a random walk, hundreds for a robot that localizes itself in a map.
Errors of dead reckoning are sums of independent increments: two samples cannot show half the sigma, however long the drive. Motions over
stretches one after the other are independent, and their covariances follow from those of the poses: P_j - A P_i A^T, A = Ad(d_ij^-1). That
holds of no estimator that corrects its pose by a map (`stretch_consistency`).

Singular covariances: a direction of zero variance has no information. Where the error is zero too, it is not counted (one degree of
freedom less); where it is not, the square is infinite (a plain pseudo-inverse would take it as zero). Zero is to rounding: each component
is first scaled to its own variance, so that metres and radians do not mix, then eigenvalues below 1e-12 of the largest are zero, as are
errors within three standard deviations of that (3e-6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from localization.errors import EvaluationError
from localization.evaluation.metrics import match
from localization.evaluation.references import ReferenceTrack, with_noise
from localization.trajectory import IntArray, Trajectory
from motion_models import se2
from motion_models.se2 import FloatArray

_MAX_ZERO_EIGENVALUE = 1e-12  # of the largest
_MAX_INSTANTS = 120
"""Whose correlations are computed: the mean over a drive does not change with more."""
_MIN_STEP_M, _MIN_STEP_RAD = 0.01, 0.01
"""Steps from where on a robot has moved: below, its error is the one that it had."""
_STRETCHES = (16, 8)
"""The most that the reference's noise allows. With sixteen, half the sigma of distances alone shows in 95 % of drives: 4 chi2(16) / 16 is
above 1.8, the 97.5th percentile of one that is right."""
_MIN_STRETCHES, _MIN_NEIGHBOURS = 6, 30
_MAX_NOISE_SHARE = 1.0 / 3.0
"""Largest share of the reference in a stretch's variance: neighbours share it, and what is left must show an error of the claim."""


@dataclass(frozen=True)
class Consistency:
    """Mean of normalised squared errors, and its band of ``probability`` for consistent covariances."""

    n: int
    """Samples that count (those with at least one degree of freedom)."""
    n_independent: float
    """How many of them the band takes as independent."""
    dof: float
    """Mean degrees of freedom per sample: what the mean should be."""
    mean: float
    band: tuple[float, float]
    fraction_inside: float
    """Part of the samples below the 95 % quantile of their own chi-square distribution; 0.95 if consistent."""
    probability: float
    n_left_out: int = 0
    """Poses that do not count, as their covariance does not grow from the first match on (`pose_errors`)."""

    @property
    def p_value(self) -> float:
        """Probability of a mean at least as far from the expected one, on either side, if the covariances are consistent."""
        below = float(chi2.cdf(self.mean * self.n_independent, self.n_independent * self.dof))
        return 2.0 * min(below, 1.0 - below)

    @property
    def verdict(self) -> Literal["consistent", "overconfident", "conservative"]:
        """Mean above the band, below it, or inside."""
        if self.mean > self.band[1]:
            return "overconfident"
        return "conservative" if self.mean < self.band[0] else "consistent"


def nees(errors: ArrayLike, covariances: ArrayLike) -> FloatArray:
    """(N,) normalised estimation errors squared of errors (N, d) with covariances (N, d, d).

    Infinite where a covariance of zero variance is contradicted. Raises `EvaluationError` for what is no covariance.
    """
    return normalize(errors, covariances)[0]


def nis(innovations: ArrayLike, covariances: ArrayLike) -> FloatArray:
    """(N,) normalised innovations squared of innovations (N, d) with their predicted covariances (N, d, d): the same sum as `nees`."""
    return nees(innovations, covariances)


def degrees_of_freedom(covariances: ArrayLike) -> NDArray[np.int64]:
    """(N,) directions in which the covariances (N, d, d) admit any error: d, less those of zero variance."""
    p = np.asarray(covariances, dtype=float)
    return normalize(np.zeros(p.shape[:-1]), p)[1]


def mean_band(n: float, dof: float, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of the mean of ``n`` independent chi-square variables of ``dof`` degrees of freedom each."""
    if n < 1 or dof <= 0.0 or not 0.0 < probability < 1.0:
        raise EvaluationError(f"no band for {n:g} samples of {dof:g} degrees of freedom at probability {probability:g}.")
    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], n * dof) / n
    return float(low), float(high)


def consistency(
    errors: ArrayLike,
    covariances: ArrayLike,
    probability: float = 0.95,
    n_independent: float | None = None,
) -> Consistency:
    """Test errors (N, d), or (R, N, d) of R runs, against their covariances of shape (..., d, d).

    ``n_independent``: by default all samples; give the number of runs for errors that are correlated within a run.
    Raises `EvaluationError` if nothing is left to test.
    """
    e, p = np.asarray(errors, dtype=float), np.asarray(covariances, dtype=float)
    d = e.shape[-1] if e.ndim else 0
    values, dof, _ = normalize(e.reshape(-1, d), p.reshape(-1, d, d))
    counted = (dof > 0) | np.isinf(values)  # a broken claim of certainty counts even if nothing else was admitted
    values, dof = values[counted], np.maximum(dof[counted], 1)
    if not values.size:
        raise EvaluationError("no sample with an uncertain error: consistency cannot be tested on covariances that are zero.")
    independent = values.size if n_independent is None else n_independent
    mean_dof = float(dof.mean())
    return Consistency(
        n=values.size,
        n_independent=independent,
        dof=mean_dof,
        mean=float(values.mean()),
        band=mean_band(independent, mean_dof, probability),
        fraction_inside=float(np.mean(values <= chi2.ppf(0.95, dof))),
        probability=probability,
    )


def independent_samples(whitened: FloatArray, weights: FloatArray | None = None) -> float:
    """Number of independent samples whose mean square varies as that of these errors (N, d) of unit covariance along one run.

    Squares of Gaussians with the correlation rho have the correlation rho^2, so that the mean over samples with ``weights`` w (N,) has the
    variance 2 d sum_ij w_i w_j rho_ij^2 / (sum w)^2, which independent ones have in the number of 1 over that without 2 d (Bartlett 1946;
    Satterthwaite 1946 for the band). The autocorrelation is estimated about zero, by lag, up to its first zero (Geyer 1992).
    It does not depend on the size of the covariances. At least 1.
    """
    n = len(whitened)
    w = np.ones(n) if weights is None else weights
    lagged = _autocovariance(whitened).sum(axis=1)
    if n < 2 or lagged[0] <= 0.0:
        return 1.0
    rho = np.minimum(lagged / lagged[0] * n / (n - np.arange(n)), 1.0)
    rho[int(np.argmax(rho <= 0.0)) if (rho <= 0.0).any() else n :] = 0.0
    pairs = _autocovariance(w[:, None])[:, 0]
    return float(w.sum() ** 2 / (pairs[0] + 2.0 * np.sum(pairs[1:] * rho[1:] ** 2)))


def claimed_samples(rows: FloatArray, covariances: FloatArray, motions: FloatArray) -> float:
    """Number of independent samples that errors ``rows[i] @ e_i`` of unit covariance (N, k, 3) are worth, if increments are independent.

    With the covariances P (N, 3, 3) and motions d (N, 3) since the start, e_j has Ad(d_ij^-1) P_i with an earlier e_i. Independent samples
    in the mean square follow as in `independent_samples`.
    """
    pick = np.unique(np.linspace(0, len(motions) - 1, _MAX_INSTANTS).round().astype(int))
    h, p, d = rows[pick], covariances[pick], motions[pick]
    n, k = h.shape[:2]
    total = float(n * k)
    for i in range(n - 1):
        a = se2.adjoint(se2.inverse(se2.between(d[i], d[i + 1 :])))
        total += 2.0 * float(np.sum((h[i + 1 :] @ a @ p[i] @ h[i].T) ** 2))
    return float(k * n**2 / total)


def _autocovariance(values: FloatArray) -> FloatArray:
    """(N, d) sums over i of ``values[i] * values[i + k]`` by lag k, of values (N, d)."""
    n = len(values)
    return np.asarray(np.fft.irfft(np.abs(np.fft.rfft(values, 2 * n, axis=0)) ** 2, 2 * n, axis=0)[:n])


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of a trajectory in the tangent space of its own poses, since the first match with the reference."""

    stamps_ns: IntArray
    """(N,)"""
    errors: FloatArray
    """(N, 3) ``log(between(estimate, truth))``, body frame [m, m, rad]."""
    covariances: FloatArray | None
    """(N, 3, 3) covariances of the estimator, or None if it has none."""
    n_left_out: int = 0
    """Matches left out because the growth of the covariance since the first match is no covariance."""
    motions: FloatArray | None = None
    """(N, 3) estimated motion since the first match [m, m, rad]."""
    claimed: FloatArray | None = None
    """(N, 3, 3) covariances without the reference's noise."""
    rows: FloatArray | None = None
    """(N, k, 3) that take an error of the pose, in the body frame, to one of unit covariance."""


def pose_errors(trajectory: Trajectory, reference: ReferenceTrack, max_gap_s: float = 1.0) -> PoseErrors:
    """Errors of an odometry-like trajectory against a reference with headings, for `consistency`.

    Odometry estimates the motion since its start, not where the start lies in the reference's plane: both motions count from the first
    match. It is left out itself, as is what comes before the estimate first moves (only the reference's jitter would be tested there).
    With ``d`` the estimated and ``r`` the true motion since then, the error is ``log(between(d, r))``.

    If the estimator was already uncertain at the first match, by ``P_0``, its increments since have ``P_k - A P_0 A^T`` with
    ``A = adjoint(inverse(d))``: exact to first order if increments are independent, as in odometry. Where that is no covariance they are
    not, and the match is left out. Where the reference has a covariance, it is added, of this sample and of the first; so are the squared
    errors of the interpolation to the reference's stamps, which are not the estimator's.

    Raises `EvaluationError` if the reference has no headings or too few samples match.
    """
    estimate, part = match(trajectory, reference, max_gap_s)
    truth = part.poses
    d, r = se2.between(estimate[0], estimate[1:]), se2.between(truth[0], truth[1:])
    errors, stamps = se2.local(d, r), part.stamps_ns[1:]
    known = trajectory.covariances_at(part.stamps_ns)
    if known is None:
        return PoseErrors(stamps, errors, None, motions=d)
    grown = known[1:] - moved_covariances(known[0], d)
    stands = (np.abs(d).max(axis=1) < 1e-9) & (np.abs(grown).max(axis=(1, 2)) < 1e-15)
    grows = is_covariance(grown)
    use, left_out = grows & ~stands, int(np.count_nonzero(~grows & ~stands))
    claimed = grown
    grown = grown + np.eye(3) * trajectory.interpolation_errors_at(stamps)[:, None, :] ** 2
    if part.covariances is not None:
        noise = covariances_in_body(part.covariances, truth[:, 2])
        grown = grown + noise[1:] + moved_covariances(noise[0], r)
    return PoseErrors(stamps[use], errors[use], grown[use], left_out, d[use], claimed[use], _roots(grown[use]))


def _is_moved(poses: FloatArray) -> NDArray[np.bool_]:
    """(N,) whether the robot has moved since the last of ``poses`` (N, 3) of which this is true: while it stands, its error stays."""
    found = np.zeros(len(poses), dtype=bool)
    last = None
    for i, pose in enumerate(poses):
        if last is None or np.abs(pose[:2] - last[:2]).max() > _MIN_STEP_M or abs(pose[2] - last[2]) > _MIN_STEP_RAD:
            found[i], last = True, pose
    return found


def pose_consistency(
    trajectory: Trajectory,
    reference: ReferenceTrack,
    probability: float = 0.95,
    max_gap_s: float = 1.0,
    is_dead_reckoning: bool = False,
) -> Consistency | None:
    """NEES of a trajectory along one run, 3 expected; None without covariances, headings or motion to test.

    The band is that of as many independent samples as the errors are worth (`independent_samples`); for dead reckoning, whose increments
    are independent, of no more than its covariances claim (`claimed_samples`).
    """
    if trajectory.covariances is None or reference.yaws is None:
        return None
    found = pose_errors(trajectory, reference, max_gap_s)
    if found.covariances is None or not found.covariances.any():
        return None
    return replace(_along_one_run(found, probability, is_dead_reckoning), n_left_out=found.n_left_out)


@dataclass(frozen=True)
class ScatterConsistency:
    """NEES with the noise of a reference that has no covariances, as its poses scatter from one to the next."""

    consistency: Consistency
    sigma_m: float
    sigma_rad: float


def scatter_consistency(trajectory: Trajectory, reference: ReferenceTrack, max_gap_s: float = 1.0) -> ScatterConsistency | None:
    """NEES of a trajectory with white noise of the reference: half the mean square of the errors' change from one pose to the next.

    Slow errors, as of covariances that are too small, are not in it. None where `pose_consistency` has none, or of too few neighbours.
    """
    if trajectory.covariances is None or reference.yaws is None:
        return None
    found = pose_errors(trajectory, reference, max_gap_s)
    near = np.diff(found.stamps_ns) < max_gap_s * 1e9
    if found.covariances is None or found.motions is None or near.sum() < _MIN_NEIGHBOURS:
        return None
    change = np.diff(_start_R_body(found.motions) @ found.errors[..., None], axis=0)[near, :, 0]
    x, y, yaw = 0.5 * np.mean(change**2, axis=0)
    sigma_m, sigma_rad = math.sqrt(0.5 * float(x + y)), math.sqrt(float(yaw))
    consistent = pose_consistency(trajectory, with_noise(reference, sigma_m, sigma_rad), max_gap_s=max_gap_s)
    return None if consistent is None else ScatterConsistency(consistent, sigma_m, sigma_rad)


def _start_R_body(motions: FloatArray) -> FloatArray:
    """(N, 3, 3) rotations of errors in the body to the frame of the start, by ``motions`` (N, 3)."""
    c, s, o = np.cos(motions[:, 2]), np.sin(motions[:, 2]), np.zeros(len(motions))
    return np.stack([np.stack([c, -s, o], -1), np.stack([s, c, o], -1), np.stack([o, o, o + 1.0], -1)], axis=-2)


def _along_one_run(found: PoseErrors, probability: float, is_dead_reckoning: bool) -> Consistency:
    assert found.covariances is not None
    assert found.motions is not None
    errors, covariances = found.errors, found.covariances
    if errors.shape[1] == 3:  # an offset in the plane stays, while its components in the body turn with the robot
        start_R_body = _start_R_body(found.motions)
        errors = np.einsum("nij,nj->ni", start_R_body, errors)
        covariances = start_R_body @ covariances @ np.swapaxes(start_R_body, 1, 2)
    _, dof, whitened = normalize(errors, covariances)
    use = dof > 0
    starts = np.flatnonzero(_is_moved(found.motions) & use)
    weights = np.diff(np.append(np.searchsorted(np.flatnonzero(use), starts), np.count_nonzero(use))).astype(float)
    n = independent_samples(whitened[starts], weights) if len(starts) else 1.0
    if is_dead_reckoning and found.claimed is not None and found.rows is not None:
        n = max(min(n, claimed_samples(found.rows, found.claimed, found.motions)), 1.0)
    return consistency(found.errors, found.covariances, probability, n_independent=n)


def position_consistency(
    trajectory: Trajectory,
    reference: ReferenceTrack,
    lever_sigma_m: float = 0.0,
    probability: float = 0.95,
    max_gap_s: float = 1.0,
    is_dead_reckoning: bool = False,
) -> Consistency | None:
    """NEES of a trajectory by positions without headings: of its distances from the first match, 1 expected.

    Where the start lies and which way the robot faced there is unknown, and distances do not depend on it. With the estimated displacement
    d and the positions' displacement r the error is ``|r| - |d|``, of variance ``u^T (P_d + R_k + R_0) u`` along u = d / |d|, plus
    ``2 (1 - cos dyaw) lever_sigma_m^2`` for an antenna that is somewhere around the body frame's origin. Displacements shorter than five
    sigma of the positions have no direction and are left out. None without covariances of both, or without motion.
    """
    if trajectory.covariances is None or reference.covariances is None:
        return None
    estimate, part = match(trajectory, reference, max_gap_s)
    known = trajectory.covariances_at(part.stamps_ns)
    assert known is not None
    assert part.covariances is not None
    d = se2.between(estimate[0], estimate[1:])
    grown = known[1:] - moved_covariances(known[0], d)
    c, s = np.cos(d[:, 2]), np.sin(d[:, 2])
    noise = np.trace(part.covariances[:, :2, :2], axis1=1, axis2=2) / 2.0
    length = np.hypot(d[:, 0], d[:, 1])
    of_positions = noise[1:] + noise[0]
    u = d[:, :2] / np.maximum(length, 1e-12)[:, None]
    in_body = np.stack([c * u[:, 0] + s * u[:, 1], -s * u[:, 0] + c * u[:, 1]], axis=1)
    variance = np.einsum("ni,nij,nj->n", in_body, grown[:, :2, :2], in_body) + of_positions + 2.0 * (1.0 - c) * lever_sigma_m**2
    variance += trajectory.interpolation_errors_at(part.stamps_ns[1:])[:, 0] ** 2
    use = is_covariance(grown) & np.isfinite(variance) & (length > 5.0 * np.sqrt(of_positions)) & (length > _MIN_STEP_M) & (variance > 0.0)
    if not use.any():
        return None
    # noise across a displacement makes it longer by sigma^2 / (2 l) in the mean
    measured = np.hypot(*(part.positions[1:] - part.positions[0]).T)
    errors = measured - length - of_positions / (2.0 * np.maximum(length, _MIN_STEP_M))
    rows = np.column_stack([in_body, np.zeros(len(d))])[use, None] / np.sqrt(variance[use])[:, None, None]
    left_out = int(np.count_nonzero(~use))
    found = PoseErrors(part.stamps_ns[1:][use], errors[use, None], variance[use, None, None], left_out, d[use], grown[use], rows)
    return _along_one_run(found, probability, is_dead_reckoning)


def _roots(covariances: FloatArray) -> FloatArray:
    """(N, d, d) that take errors of ``covariances`` (N, d, d) to unit covariance; zero where the variance is."""
    sigma, values, vectors = _spectrum(covariances)
    free = (values > _MAX_ZERO_EIGENVALUE * values[:, -1:]) & (values > 0.0)
    scale = np.where(free, 1.0 / np.sqrt(np.where(free, values, 1.0)), 0.0)
    roots: FloatArray = scale[:, :, None] * np.swapaxes(vectors, 1, 2) / sigma[:, None, :]
    return roots


def moved_covariances(covariances: FloatArray, motions: FloatArray) -> FloatArray:
    """(N, 3, 3) what covariances (3, 3) or (N, 3, 3) at the start are at the ends of motions (N, 3)."""
    a = se2.adjoint(se2.inverse(motions))
    moved: FloatArray = a @ covariances @ np.swapaxes(a, 1, 2)
    return moved


def covariances_in_body(covariances: FloatArray, yaws: FloatArray) -> FloatArray:
    """(N, 3, 3) covariances of x, y, yaw in the plane, turned into the body frame; zero where unknown."""
    c, s, o = np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)
    plane_T_body = np.stack([np.stack([c, -s, o], -1), np.stack([s, c, o], -1), np.stack([o, o, o + 1.0], -1)], axis=-2)
    known = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    turned: FloatArray = np.swapaxes(plane_T_body, 1, 2) @ np.where(known[:, None, None], covariances, 0.0) @ plane_T_body
    return turned


def normalize(errors: ArrayLike, covariances: ArrayLike) -> tuple[FloatArray, NDArray[np.int64], FloatArray]:
    """Normalised squares (N,), degrees of freedom (N,) and errors brought to unit covariance (N, d), singular directions as above."""
    e, p = np.asarray(errors, dtype=float), np.asarray(covariances, dtype=float)
    if e.ndim != 2 or p.shape != (*e.shape, e.shape[-1]):
        raise EvaluationError(f"errors must have shape (N, d) and covariances (N, d, d), found {e.shape} and {p.shape}.")
    _check_finite(e, p)
    sigma, values, vectors = _spectrum(p)
    largest = values[:, -1:]
    if not np.all(is_covariance(p)):
        i = int(np.flatnonzero(~is_covariance(p))[0])
        raise EvaluationError(f"covariance number {i} is not symmetric or has a negative eigenvalue; it is no covariance:\n{p[i]}")
    free = (values > _MAX_ZERO_EIGENVALUE * largest) & (largest > 0.0)
    along = np.einsum("nji,nj->ni", vectors, e / sigma)
    whitened = np.where(free, along / np.sqrt(np.where(free, values, 1.0)), 0.0)
    broken = (~free & (np.abs(along) > 3.0 * math.sqrt(_MAX_ZERO_EIGENVALUE))).any(axis=1)
    squares = np.where(broken, np.inf, np.sum(whitened**2, axis=1))
    return squares, free.sum(axis=1), np.einsum("nij,nj->ni", vectors, whitened)


def _check_finite(e: FloatArray, p: FloatArray) -> None:
    if not len(p):
        return
    for name, array in (("error", e), ("covariance", p)):
        infinite = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
        if infinite.size:
            raise EvaluationError(f"{name} number {infinite[0]} (and {infinite.size - 1} more) is not finite.")


def is_covariance(p: FloatArray) -> NDArray[np.bool_]:
    """(N,) True for matrices (N, d, d) that are symmetric and have no negative eigenvalue, but for rounding."""
    sigma, values, _ = _spectrum(p)
    lopsided = np.abs(p - np.swapaxes(p, 1, 2)) > 1e-6 * sigma[:, :, None] * sigma[:, None, :]
    return np.asarray(~lopsided.any(axis=(1, 2)) & (values >= -1e-9 * np.maximum(values[:, -1:], 0.0)).all(axis=1))


def _spectrum(p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard deviations (N, d), 1 where the variance is zero, and eigenvalues, eigenvectors of the correlations (zero where it is)."""
    variance = np.diagonal(p, axis1=1, axis2=2)
    sigma = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    correlations = p / (sigma[:, :, None] * sigma[:, None, :])
    values, vectors = np.linalg.eigh(0.5 * (correlations + np.swapaxes(correlations, 1, 2)))
    return sigma, values, vectors


def stretch_consistency(
    trajectory: Trajectory, reference: ReferenceTrack, lever_sigma_m: float = 0.0, probability: float = 0.95, max_gap_s: float = 1.0
) -> Consistency | None:
    """NEES of dead reckoning's motions over up to sixteen stretches of equal way, 3 expected.

    Where the reference has no headings, of their distances, 1 expected; ``lever_sigma_m`` is then where on the robot it measures. None
    without covariances of both, and where the reference's noise hides the claimed errors of all but five stretches.
    """
    if trajectory.covariances is None or reference.covariances is None:
        return None
    estimate, part = match(trajectory, reference, max_gap_s)
    known = trajectory.covariances_at(part.stamps_ns)
    assert known is not None
    way = np.append(0.0, np.cumsum(np.abs(se2.between(estimate[:-1], estimate[1:])).sum(axis=1)))
    for most in _STRETCHES:
        at = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], most + 1)).clip(0, len(way) - 1))
        ends = at[:-1], at[1:]
        d = se2.between(*(estimate[i] for i in ends))
        grown = known[at[1:]] - moved_covariances(known[at[:-1]], d)
        compared = _distances(part, ends, d, grown, lever_sigma_m) if reference.yaws is None else _poses(part, ends, d, grown)
        if len(compared[0]) >= _MIN_STRETCHES:
            return consistency(*compared, probability)
    return None


def _poses(part: ReferenceTrack, ends: tuple[IntArray, IntArray], d: FloatArray, grown: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 3) and covariances of motions ``d`` (n, 3) between the ``ends`` whose claimed covariances (n, 3, 3) exceed the noise."""
    first, last = ends
    truth = part.poses
    r = se2.between(truth[first], truth[last])
    assert part.covariances is not None
    in_body = covariances_in_body(part.covariances, truth[:, 2])
    noise = in_body[last] + moved_covariances(in_body[first], r)
    claimed, of_noise = (np.trace(m[:, :2, :2], axis1=1, axis2=2) for m in (grown, noise))
    use = is_covariance(grown) & (of_noise <= _MAX_NOISE_SHARE * (claimed + of_noise)) & (claimed > 0.0)
    return se2.local(d, r)[use], (grown + noise)[use]


def _distances(
    part: ReferenceTrack, ends: tuple[IntArray, IntArray], d: FloatArray, grown: FloatArray, lever_sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 1) and variances (n, 1, 1) of the lengths of motions ``d``, as `_poses` has those of the motions."""
    first, last = ends
    assert part.covariances is not None
    noise = np.trace(part.covariances[:, :2, :2], axis1=1, axis2=2) / 2.0
    length = np.hypot(d[:, 0], d[:, 1])
    c, s = np.cos(d[:, 2]), np.sin(d[:, 2])
    along = d[:, :2] / np.maximum(length, 1e-12)[:, None]
    in_body = np.stack([c * along[:, 0] + s * along[:, 1], -s * along[:, 0] + c * along[:, 1]], axis=1)  # the error is the end's
    claimed = np.einsum("ni,nij,nj->n", in_body, grown[:, :2, :2], in_body)
    of_noise = noise[last] + noise[first] + 2.0 * (1.0 - c) * lever_sigma_m**2
    use = is_covariance(grown) & (of_noise <= _MAX_NOISE_SHARE * (claimed + of_noise)) & (claimed > 0.0)
    use &= length**2 > 25.0 * (claimed + of_noise)
    measured = np.hypot(*(part.positions[last] - part.positions[first]).T)
    # noise across a displacement makes it longer by sigma^2 / (2 l) in the mean
    errors = measured - length - of_noise / (2.0 * np.maximum(length, 1e-12))
    return errors[use, None], (claimed + of_noise)[use, None, None]
