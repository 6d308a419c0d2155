"""Which causes: joint generalised least squares on their signatures, best subsets, and a test that pays for having looked at them all."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from motion_models.se2 import FloatArray

MOST_CAUSES = 4
_DRAWS = 4000
_TRIPLES = 40


@dataclass(frozen=True)
class Regression:
    """Whitened discrepancies and signatures in normal form; nuisances are already projected out, sizes are in units of their sigma
    before looking (the prior)."""

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

    def fit(self, subset: tuple[int, ...]) -> tuple[FloatArray, FloatArray, float]:
        """Sizes in own units, their covariance, and twice the log-likelihood gained, prior included."""
        if not subset:
            return np.zeros(0), np.zeros((0, 0)), 0.0
        i = np.array(subset)
        a = self.gram[np.ix_(i, i)] + np.eye(len(i))
        x = np.linalg.solve(a, self.moment[i])
        cov = np.linalg.inv(a)
        return x * self.scale[i], cov * np.outer(self.scale[i], self.scale[i]), float(self.moment[i] @ x)

    def gain(self, subset: tuple[int, ...]) -> float:
        return self.fit(subset)[2]


def regression(y: FloatArray, signatures: FloatArray, nuisances: FloatArray, scale: FloatArray) -> Regression:
    """From whitened rows (K,), signatures (K, p) and nuisances (K, q)."""
    s = signatures * scale
    used = np.linalg.norm(nuisances, axis=0) > 1e-9 if nuisances.size else np.zeros(0, dtype=bool)
    if used.any():
        q, r = np.linalg.qr(nuisances[:, used])
        q = q[:, np.abs(np.diag(r)) > 1e-9 * np.abs(np.diag(r)).max()]
        y, s = y - q @ (q.T @ y), s - q @ (q.T @ s)
    return Regression(s.T @ s, s.T @ y, float(y @ y), int(np.count_nonzero(np.abs(signatures).sum(axis=1) + np.abs(y))), scale)


def best_subset(problem: Regression, groups: list[str], allowed: FloatArray, gamma: float = 0.5) -> tuple[int, ...]:
    """The causes that the extended BIC (Chen & Chen 2008) prefers. Causes of one group exclude each other; ``allowed`` (p, 2) bounds
    their sizes in own units."""
    p = len(groups)

    def cost(subset: tuple[int, ...]) -> float:
        k = len(subset)
        penalty = k * math.log(max(problem.count, 2)) + 2.0 * gamma * math.log(math.comb(len(set(groups)), k))
        return penalty - problem.gain(subset)

    def fits(subset: tuple[int, ...]) -> bool:
        if len({groups[i] for i in subset}) < len(subset):
            return False
        sizes = problem.fit(subset)[0]
        return all(allowed[i, 0] <= size <= allowed[i, 1] for i, size in zip(subset, sizes, strict=True))

    best: tuple[int, ...] = ()
    best_cost = 0.0
    layer: list[tuple[int, ...]] = [()]
    for k in range(1, MOST_CAUSES + 1):
        # all pairs; beyond that, what extends the best sets of the size before
        tried = itertools.combinations(range(p), k) if k <= 2 else {tuple(sorted({*s, i})) for s in layer for i in range(p) if i not in s}
        scored = sorted((cost(s), s) for s in tried if len(s) == k)
        layer = []
        for c, s in scored:
            if not fits(s):
                continue
            layer.append(s)
            if c < best_cost - 1e-9:
                best, best_cost = s, c
            if len(layer) >= _TRIPLES:
                break
    return best


def max_statistic(problem: Regression, given: tuple[int, ...], rng: np.random.Generator, df: int) -> FloatArray:
    """(draws,) largest |t| over all causes not ``given`` that noise alone would show, as correlated as their signatures are."""
    left = [i for i in range(len(problem.moment)) if i not in given]
    cov = _projected(problem.gram, given, left)
    sigma = np.sqrt(np.maximum(np.diag(cov), 1e-12))
    seen = np.diag(cov) > 1e-6
    correlation = cov[np.ix_(seen, seen)] / np.outer(sigma[seen], sigma[seen])
    if not seen.any():
        return np.zeros(_DRAWS)
    values, vectors = np.linalg.eigh(correlation)
    draws = rng.standard_normal((_DRAWS, int(seen.sum()))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    draws /= np.sqrt(rng.chisquare(df, size=(_DRAWS, 1)) / df)
    return np.asarray(np.abs(draws).max(axis=1))


def statistic(problem: Regression, given: tuple[int, ...], cause: int) -> float:
    """t of ``cause`` beside those ``given``."""
    cov = _projected(problem.gram, given, [cause])
    moment = problem.moment[cause]
    if given:
        g = np.array(given)
        moment = moment - problem.gram[cause, g] @ np.linalg.solve(problem.gram[np.ix_(g, g)] + 1e-9 * np.eye(len(g)), problem.moment[g])
    return float(moment / math.sqrt(max(cov[0, 0], 1e-12)))


def p_value(t: float, draws: FloatArray) -> float:
    """Family-wise; beyond the draws, by the tail that their upper part has (log-linear in t^2)."""
    above = float(np.mean(draws >= abs(t)))
    if above >= 20.0 / len(draws):
        return above
    q = np.quantile(draws, [0.9, 0.99])
    slope = math.log(10.0) / max(q[1] ** 2 - q[0] ** 2, 1e-9)
    return float(min(0.01 * math.exp(-slope * (t**2 - q[1] ** 2)), 1.0))


def _projected(gram: FloatArray, given: tuple[int, ...], left: list[int]) -> FloatArray:
    cov = gram[np.ix_(left, left)]
    if given:
        g = np.array(given)
        across = gram[np.ix_(left, list(given))]
        cov = cov - across @ np.linalg.solve(gram[np.ix_(g, g)] + 1e-9 * np.eye(len(g)), across.T)
    return np.asarray(cov)


def likeness(problem: Regression, given: tuple[int, ...], a: int, b: int) -> float:
    """Correlation of two signatures once those ``given`` are taken out of both."""
    cov = _projected(problem.gram, given, [a, b])
    return float(cov[0, 1] / math.sqrt(max(cov[0, 0] * cov[1, 1], 1e-18)))
