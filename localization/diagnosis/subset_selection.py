"""Which causes: joint generalised least squares on their signatures, best subsets, and tests corrected for the number of causes."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from localization.diagnosis.findings import Gain
from localization.diagnosis.noise import Noise
from motion_models.se2 import FloatArray

MOST_CAUSES = 7
_MANY = 1500  # as many numbers must be measured for sets of more than _FEW causes
_FEW = 4
_DRAWS = 4000
_KEPT = 12
MAX_TOLERANCE_SIGMAS = 3.0
"""Largest size of a cause that is not named, over the sigma of its tolerance: about what is negligible (see `diagnose.TOLERANCES`)."""
_BLOCK_WINDOWS, _FOLDS, _BOOTSTRAP_DRAWS = 4, 5, 1000


@dataclass(frozen=True)
class Regression:
    """Whitened discrepancies and signatures in normal form; nuisances are already projected out, sizes are in units of their sigma
    a priori.

    Every cause is there all the time, if only within its tolerance: robot files, mounts and clocks are never known better. To name a cause
    is to let it have any size. So subsets are weighed by their evidence (marginal likelihood), in which causes outside of the subset
    are noise of a known shape.
    """

    gram: FloatArray
    """(p, p)"""
    moment: FloatArray
    """(p,)"""
    rest: float
    """Sum of squares of the discrepancies without nuisances."""
    count: int
    """How many numbers were measured."""
    scale: FloatArray
    """(p,) prior sigma of each cause in its own unit."""
    tolerance: FloatArray
    """(p,) sigma of each cause that is not named, in units of its prior's."""

    def _variances(self, subset: tuple[int, ...]) -> FloatArray:
        variances = np.square(self.tolerance)
        variances[list(subset)] = 1.0
        return variances

    def _evidence(self, subset: tuple[int, ...]) -> tuple[FloatArray, FloatArray, float]:
        """Factor of the posterior's information, mean of all sizes, and twice the log-evidence but for a constant."""
        variances = self._variances(subset)
        factor = np.linalg.cholesky(self.gram + np.diag(1.0 / variances))
        half = np.linalg.solve(factor, self.moment)
        twice = float(half @ half) - 2.0 * float(np.log(np.diagonal(factor)).sum()) - float(np.log(variances).sum())
        return np.asarray(factor), np.asarray(half), twice

    def fit(self, subset: tuple[int, ...]) -> tuple[FloatArray, FloatArray, float]:
        """Sizes in own units, their covariance, and twice the log-evidence gained over naming nothing."""
        if not subset:
            return np.zeros(0), np.zeros((0, 0)), 0.0
        i = list(subset)
        factor, half, twice = self._evidence(subset)
        sizes = np.linalg.solve(factor.T, half)[i]
        inverse = np.linalg.solve(factor, np.eye(len(factor))[:, i])
        scale = self.scale[i]
        return sizes * scale, (inverse.T @ inverse) * np.outer(scale, scale), twice - self._evidence(())[2]

    def posterior(self, subset: tuple[int, ...]) -> FloatArray:
        """(p,) posterior means of all sizes, in own units, with those outside of ``subset`` held to their tolerance."""
        factor, half, _ = self._evidence(subset)
        return np.asarray(np.linalg.solve(factor.T, half) * self.scale)

    def posterior_sigmas(self, subset: tuple[int, ...]) -> FloatArray:
        """(p,) standard deviations of `posterior`."""
        factor, _, _ = self._evidence(subset)
        return np.asarray(np.linalg.norm(np.linalg.solve(factor, np.eye(len(factor))), axis=0) * self.scale)

    def gain(self, subset: tuple[int, ...]) -> float:
        """Twice the log-evidence gained over naming nothing."""
        return self._evidence(subset)[2] - self._evidence(())[2] if subset else 0.0

    def misfit(self) -> float:
        """Sum of squares that is left where every cause keeps within its tolerance, and what that takes.

        A prior does not hold a size against much data: beyond `MAX_TOLERANCE_SIGMAS` a size would not be tolerated, and is cut there.
        """
        factor, half, _ = self._evidence(())
        x = np.linalg.solve(factor.T, half)
        limit = MAX_TOLERANCE_SIGMAS * self.tolerance
        if np.all(np.abs(x) <= limit):
            return self.rest - float(half @ half)
        x = np.clip(x, -limit, limit)
        return self.rest + float(x @ self.gram @ x - 2.0 * x @ self.moment + np.sum(np.square(x / self.tolerance)))

    def scores(self, given: tuple[int, ...], wanted: list[int]) -> tuple[FloatArray, FloatArray]:
        """(n,) scores of the ``wanted`` causes with those ``given`` free and all others within tolerance, and their (n, n) covariance if
        they were zero."""
        others = [i for i in range(len(self.moment)) if i not in wanted or i in given]
        variances = self._variances(given)[others]
        variances[[n for n, i in enumerate(others) if i in given]] = 1e6
        a = self.gram[np.ix_(others, others)] + np.diag(1.0 / variances)
        across = np.linalg.solve(a, self.gram[np.ix_(others, wanted)])
        cov = self.gram[np.ix_(wanted, wanted)] - self.gram[np.ix_(wanted, others)] @ across
        return self.moment[wanted] - across.T @ self.moment[others], cov


def regression(
    y: FloatArray, signatures: FloatArray, nuisances: FloatArray, scale: FloatArray, tolerance: FloatArray | None = None
) -> Regression:
    """From whitened rows (K,), signatures (K, p) and nuisances (K, q); ``scale`` and ``tolerance`` (p,) in the causes' own units."""
    s = signatures * scale
    used = np.linalg.norm(nuisances, axis=0) > 1e-9 if nuisances.size else np.zeros(0, dtype=bool)
    if used.any():
        q, r = np.linalg.qr(nuisances[:, used])
        q = q[:, np.abs(np.diag(r)) > 1e-9 * np.abs(np.diag(r)).max()]
        y, s = y - q @ (q.T @ y), s - q @ (q.T @ s)
    count = int(np.count_nonzero(np.abs(signatures).sum(axis=1) + np.abs(y)))
    within = np.full(len(scale), 1e-6) if tolerance is None else np.maximum(tolerance / scale, 1e-6)
    return Regression(s.T @ s, s.T @ y, float(y @ y), count, scale, within)


def cost(problem: Regression, groups: list[str], subset: tuple[int, ...]) -> float:
    """Twice the negative log-odds of ``subset`` against naming nothing: every number of causes is as likely as the next, and so are all
    sets of one number (the prior of the extended BIC of Chen & Chen 2008, with gamma = 1)."""
    k = len(subset)
    return 2.0 * math.log(math.comb(len(set(groups)), k)) + k * math.log(max(problem.count, 2)) - problem.gain(subset)


def rank_subsets(problem: Regression, groups: list[str], allowed: FloatArray, kept: int = _KEPT) -> list[tuple[float, tuple[int, ...]]]:
    """The best sets of causes by `cost`, best first, the empty one among them. Causes of one group exclude each other; ``allowed`` (p, 2)
    bounds sizes in own units."""
    p = len(groups)

    def fits(subset: tuple[int, ...]) -> bool:
        if len({groups[i] for i in subset}) < len(subset):
            return False
        sizes = problem.fit(subset)[0]
        return all(allowed[i, 0] <= size <= allowed[i, 1] for i, size in zip(subset, sizes, strict=True))

    found: list[tuple[float, tuple[int, ...]]] = [(0.0, ())]
    layer: list[tuple[int, ...]] = [()]
    for k in range(1, (MOST_CAUSES if problem.count >= _MANY else _FEW) + 1):
        # all pairs; beyond that, what extends the best sets of the size before
        tried = (
            set(itertools.combinations(range(p), k)) if k <= 2 else {tuple(sorted({*s, i})) for s in layer for i in range(p) if i not in s}
        )
        scored = sorted((cost(problem, groups, s), s) for s in tried if len({groups[i] for i in s}) == k)
        best = list(itertools.islice(((c, s) for c, s in scored if fits(s)), kept))
        found += best
        layer = [s for _, s in best]
        if not layer or found[-len(layer)][0] > min(c for c, _ in found) + 30.0:
            break
    return sorted(found)


def max_statistic(problem: Regression, given: tuple[int, ...], rng: np.random.Generator, df: float, among: int | None = None) -> FloatArray:
    """(draws,) largest |t| over all causes (or the first ``among``) not ``given`` that noise alone would show, as correlated as their
    signatures are."""
    left = [i for i in range(len(problem.moment) if among is None else among) if i not in given]
    cov = problem.scores(given, left)[1]
    sigma = np.sqrt(np.maximum(np.diag(cov), 1e-12))
    is_observable = np.diag(cov) > 1e-6
    correlation = cov[np.ix_(is_observable, is_observable)] / np.outer(sigma[is_observable], sigma[is_observable])
    if not is_observable.any():
        return np.zeros(_DRAWS)
    values, vectors = np.linalg.eigh(correlation)
    draws = rng.standard_normal((_DRAWS, int(is_observable.sum()))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    draws /= np.sqrt(rng.chisquare(df, size=(_DRAWS, 1)) / df)
    return np.asarray(np.abs(draws).max(axis=1))


def statistic(problem: Regression, given: tuple[int, ...], cause: int) -> float:
    """t of ``cause`` beside those ``given``."""
    score, cov = problem.scores(given, [cause])
    return float(score[0] / math.sqrt(max(float(cov[0, 0]), 1e-12)))


def statistics(problem: Regression, given: tuple[int, ...], wanted: list[int]) -> FloatArray:
    """(n,) t of each of the ``wanted`` causes beside those ``given``, without the other wanted ones."""
    score, cov = problem.scores(given, wanted)
    return np.asarray(score / np.sqrt(np.maximum(np.diagonal(cov), 1e-12)))


def p_value(t: float, draws: FloatArray, df: float) -> float:
    """Family-wise; beyond the ``draws`` (of ``df`` degrees of freedom) by the tail that their upper part has."""
    above = float(np.mean(draws >= abs(t)))
    if above >= 20.0 / len(draws):
        return above
    q = df * np.log1p(np.quantile(draws, [0.9, 0.99]) ** 2 / df)  # in which tails of Student's t are straight
    slope = math.log(10.0) / max(q[1] - q[0], 1e-9)
    return float(min(0.01 * math.exp(-slope * (df * math.log1p(t**2 / df) - q[1])), 1.0))


def signature_correlation(problem: Regression, given: tuple[int, ...], a: int, b: int) -> float:
    """Correlation of two signatures once those ``given`` are taken out of both."""
    cov = problem.scores(given, [a, b])[1]
    return float(cov[0, 1] / math.sqrt(max(float(cov[0, 0] * cov[1, 1]), 1e-18)))


def heldout_gain(
    linear: FloatArray,
    signatures: FloatArray,
    nuisances: FloatArray,
    noise: Noise,
    scale: FloatArray,
    chosen: tuple[int, ...],
    others: tuple[int, ...],
    rng: np.random.Generator,
) -> Gain:
    """Root mean square of held-out whitened discrepancies by ``others`` and by ``chosen``; folds are of blocks of 4 windows."""
    squares = [heldout_squares(linear, signatures, nuisances, noise, scale, subset) for subset in (others, chosen)]
    n = len(linear)
    block = np.arange(n) // _BLOCK_WINDOWS
    counts = np.bincount(block, weights=np.isfinite(linear).sum(axis=1))
    sums = [np.bincount(block, weights=s) for s in squares]
    rms = [float(np.sqrt(s.sum() / counts.sum())) for s in sums]
    draws = rng.multinomial(len(counts), np.full(len(counts), 1.0 / len(counts)), size=_BOOTSTRAP_DRAWS)
    before, after = (np.sqrt((draws @ s) / np.maximum(draws @ counts, 1.0)) for s in sums)
    low, high = np.quantile(1.0 - after / np.maximum(before, 1e-12), [0.025, 0.975])
    return Gain(rms[0], rms[1], 1.0 - rms[1] / max(rms[0], 1e-12), float(low), float(high))


def heldout_squares(
    linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, noise: Noise, scale: FloatArray, subset: tuple[int, ...]
) -> FloatArray:
    """(M,) sum of squares of each window."""
    y = noise.whiten(linear)
    columns = [noise.whiten(signatures[..., list(subset)]) * scale[list(subset)], noise.whiten(nuisances) * 1e3]
    design = np.concatenate(columns, axis=-1)
    fold = (np.arange(len(y)) // _BLOCK_WINDOWS) % _FOLDS
    out = np.zeros(len(y))
    for f in range(_FOLDS):
        held = fold == f
        if not held.any() or held.all():
            continue
        a = design[~held].reshape(-1, design.shape[-1])
        x = np.linalg.solve(a.T @ a + np.eye(a.shape[1]), a.T @ y[~held].ravel())
        out[held] = np.sum((y[held] - design[held] @ x) ** 2, axis=1)
    return out
