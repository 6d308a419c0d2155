"""Which causes: best subsets by evidence on their signatures, tests corrected for their number, and the best sets by full prediction."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from localization.diagnosis.causes import CAUSES
from localization.diagnosis.causes.cause import Cause, Hypothesis, with_sizes
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.findings import Gain
from localization.diagnosis.gate import FOLD_BLOCK, folds
from localization.diagnosis.linearization import (
    Linearization,
    Regression,
    make_regression,
    regression,
)
from localization.diagnosis.noise import FLAT, Noise
from motion_models.errors import CgError, ModelError
from motion_models.se2 import FloatArray

MOST_CAUSES = 7
_MANY = 1500  # as many numbers must be measured for sets of more than _FEW causes
_FEW = 4
_DRAWS = 4000
_KEPT = 12
_BOOTSTRAP_DRAWS = 1000


def cost(problem: Regression, groups: list[str], subset: tuple[int, ...]) -> float:
    """Twice the negative log-odds of ``subset`` against naming nothing: every number of causes is as likely as the next, and so are all
    sets of one number (the prior of the extended BIC of Chen & Chen 2008, with gamma = 1)."""
    return price(problem.count, len(set(groups)), len(subset)) - problem.gain(subset)


def price(count: int, choices: int, k: int) -> float:
    """Twice the negative log-prior of one set of ``k`` of so many ``choices``, on ``count`` numbers."""
    return 2.0 * math.log(math.comb(choices, k)) + k * math.log(max(count, 2))


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
    return _largest_of_noise(problem.scores(given, left)[1], rng, df)


def _largest_of_noise(cov: FloatArray, rng: np.random.Generator, df: float) -> FloatArray:
    """(draws,) largest |t| of numbers with the covariance ``cov`` (n, n), of which those without a variance are never seen."""
    sigma = np.sqrt(np.maximum(np.diag(cov), 1e-12))
    is_observable = np.diag(cov) > 1e-6
    correlation = cov[np.ix_(is_observable, is_observable)] / np.outer(sigma[is_observable], sigma[is_observable])
    if not is_observable.any():
        return np.zeros(_DRAWS)
    values, vectors = np.linalg.eigh(correlation)
    draws = rng.standard_normal((_DRAWS, int(is_observable.sum()))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    draws /= np.sqrt(rng.chisquare(df, size=(_DRAWS, 1)) / df)
    return np.asarray(np.abs(draws).max(axis=1))


def strongest_beyond_tolerance(problem: Regression, rng: np.random.Generator, df: float) -> tuple[int, float]:
    """The cause whose size is largest for what is tolerated of it, and the family-wise p of a robot all of whose causes are tolerated.

    With prior T = diag(tolerance^2) and posterior V = (G + T^-1)^-1, G the information of the drive, estimates x = V m of such a robot
    have the covariance T - V.
    """
    T = np.diag(np.square(problem.tolerance))
    V = np.linalg.inv(problem.gram + np.linalg.inv(T))
    cov = (T - V) / np.outer(problem.tolerance, problem.tolerance)
    x = V @ problem.moment / problem.tolerance
    z = x / np.sqrt(np.maximum(np.diagonal(cov), 1e-6))
    i = int(np.argmax(np.abs(z)))
    return i, p_value(float(z[i]), _largest_of_noise(cov, rng, df), df)


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


def problems_without_a_fold(state: Linearization) -> list[Regression]:
    """The drive without each fold of its windows."""
    y, s, z = (state.noise.whiten(rows) for rows in (state.linear, state.signatures, state.nuisances))
    found = []
    for held in folds(len(y)):
        rest = y[~held].ravel()
        parts = s[~held].reshape(len(rest), -1), z[~held].reshape(len(rest), -1)
        found.append(regression(rest, *parts, state.problem.scale, state.problem.scale * state.problem.tolerance))
    return found


def heldout_log_odds(problem: Regression, without: Sequence[Regression], chosen: tuple[int, ...], others: tuple[int, ...]) -> float:
    """Twice the log-odds of the causes ``chosen`` against ``others`` alone by windows that sizes were not fitted to, beside all that is
    tolerated: of each fold given the rest, p(fold | rest) = p(all) / p(rest), with the regressions ``without`` one."""
    return sum(problem.gain_over(chosen, others) - rest.gain_over(chosen, others) for rest in without)


def heldout_gain(state: Linearization, chosen: tuple[int, ...], others: tuple[int, ...], rng: np.random.Generator) -> Gain:
    """Root mean square of held-out whitened discrepancies by ``others`` and by ``chosen``."""
    problem = state.problem
    squares = []
    for subset in (others, chosen):
        spreads = problem.scale * np.isin(np.arange(len(problem.scale)), subset)
        squares.append(heldout_squares(state.linear, state.signatures, state.nuisances, state.noise, spreads))
    block = np.arange(len(state.linear)) // FOLD_BLOCK
    counts = np.bincount(block, weights=np.isfinite(state.linear).sum(axis=1))
    sums = [np.bincount(block, weights=s) for s in squares]
    rms = [float(np.sqrt(s.sum() / counts.sum())) for s in sums]
    draws = rng.multinomial(len(counts), np.full(len(counts), 1.0 / len(counts)), size=_BOOTSTRAP_DRAWS)
    before, after = (np.sqrt((draws @ s) / np.maximum(draws @ counts, 1.0)) for s in sums)
    low, high = np.quantile(1.0 - after / np.maximum(before, 1e-12), [0.025, 0.975])
    return Gain(rms[0], rms[1], 1.0 - rms[1] / max(rms[0], 1e-12), float(low), float(high))


def heldout_squares(linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, noise: Noise, spreads: FloatArray) -> FloatArray:
    """(M,) sum of squares of each window, predicted from the others by causes with the prior sigmas ``spreads`` (p,), 0 for none."""
    y = noise.whiten(linear)
    used = spreads > 0.0
    columns = [noise.whiten(signatures[..., used]) * spreads[used], noise.whiten(nuisances) * FLAT]
    design = np.concatenate(columns, axis=-1)
    out = np.zeros(len(y))
    for held in folds(len(y)):
        a = design[~held].reshape(-1, design.shape[-1])
        x = np.linalg.solve(a.T @ a + np.eye(a.shape[1]), a.T @ y[~held].ravel())
        out[held] = np.sum((y[held] - design[held] @ x) ** 2, axis=1)
    return out


_TIE_LOG_ODDS = 1.0  # difference of twice the log-odds that decides nothing
_ALIAS_LOG_ODDS = 7.0  # twice the log-likelihood by which a rival may be worse: odds of 1 to 33
_ALIAS_SHARE = 0.02  # or this share of what the cause explains: accuracy of the model
_BASELINE_SHARE = 0.05  # the same for a robot that does not follow the friction model when nothing is wrong
_MOTION = 3  # channels of the motion itself
_MAX_LARGER_SQUARES = 2.0
"""Squares of the discrepancies once causes are corrected, over those before. What is tolerated may hide a part of a cause: of one of 3.7
times the sigma that it is known by, as it takes to be named, in 1.5 % of robots so much that correcting it makes squares twice as large."""
_FOREIGN_SHARE = 0.1
"""`_BASELINE_SHARE` where the contacts are not the model's and no healthy drive shows what they do: loads move the centre of rotation by a
quarter more or less, so that 6 % of their squares are left; a CG 68 mm aside in MuJoCo's Warthog explains 8 % less than a LiDAR 69 mm
aside."""
_FOREIGN_MISSING_SHARE = 0.5
"""Share of what signatures promise that may be missing there: about the other explanation, that CG promises 45 % less."""
_REFINED_SETS = 2  # sets of each number of causes that are tried by full prediction
_MAX_MISSING_SHARE = 0.1  # share of what signatures promise that may be missing
_FEW_CAUSES, _EXTRA_SETS = 2, 4  # then so many sets of up to so many causes are tried by full prediction
_MAX_BEND = 0.3  # of the whole change: of sizes off by so much other causes make up for the rest
_NEAR_LOG_EVIDENCE = 30.0
_CLEAR_LOG_EVIDENCE = 200.0  # lead in twice the log-evidence that needs no trial
_MAX_STEPS, _SHORTER_STEP = 6, 0.3
_CONVERGED_STEP, _LONG_STEP = 0.02, 0.2  # steps, over typical sizes: one that ends, and one after which signatures are taken anew


def bent_causes(predictor: DrivePredictor, first: Linearization) -> tuple[int, ...]:
    """Causes whose signatures about the robot file mislead at their typical sizes: how far a robot turns grows with the square of how far
    its load lies off the middle, so that a step of a tenth need not even have the sign of the whole."""
    return tuple(i for i, cause in enumerate(first.causes) if any(_is_bent(predictor, first, i, start) for start in _half_sizes(cause)))


def _half_sizes(cause: Cause) -> tuple[float, ...]:
    """Half the typical size, to both sides where it has two."""
    return (0.5 * cause.typical,) if cause.one_sided else (0.5 * cause.typical, -0.5 * cause.typical)


def _is_bent(predictor: DrivePredictor, first: Linearization, i: int, half: float) -> bool:
    """Whether twice the size ``half`` of cause ``i`` does not act as its signature promises, or is one that no such robot can have."""
    size = 2.0 * half
    try:
        whole = first.noise.whiten(first.rows - predictor.discrepancies(with_sizes({first.causes[i]: size})))
    except (CgError, ModelError):
        return True
    off = float(np.sum((whole - first.noise.whiten(first.signatures[..., i] * size)) ** 2))
    return off > max(_MAX_BEND**2 * float(np.sum(whole**2)), _ALIAS_LOG_ODDS)


def search_causes(predictor: DrivePredictor, linearization: Linearization, bent: tuple[int, ...] = ()) -> dict[Cause, float]:
    """Sizes of the best set of causes: the best few sets by signatures are compared by full predictions at their own sizes, and so is each
    of the ``bent`` causes alone, from half its typical size to both sides."""
    causes, problem = linearization.causes, linearization.problem
    groups = [e.group for e in causes]
    ranked = rank_subsets(problem, groups, _bounds(causes))
    least, best = ranked[0]
    sizes = _linear_sizes(linearization, best)
    left = linearization.linear - linearization.signatures[..., list(best)] @ np.array(list(sizes.values()))
    promised = _cost(linearization, sizes, left)
    results: dict[tuple[int, ...], tuple[float, dict[Cause, float]]] = {}

    def cost_of(subset: tuple[int, ...]) -> float:
        """Twice the log-odds by the predictor itself; inf for sizes that no robot can have."""
        if subset not in results:
            sizes, cost = _refined_cost(predictor, linearization, _linear_sizes(linearization, subset))
            results[subset] = cost, sizes
        return results[subset][0]

    is_sure = len(ranked) < 2 or ranked[1][0] - least > _CLEAR_LOG_EVIDENCE
    missing = cost_of(best) - promised
    is_nearly_linear = missing < max(_MAX_MISSING_SHARE * (cost_of(()) - promised), _ALIAS_LOG_ODDS)
    margin = max(_NEAR_LOG_EVIDENCE, _MAX_MISSING_SHARE * abs(least)) if is_nearly_linear else _CLEAR_LOG_EVIDENCE
    near = [s for c, s in ranked if c - least < margin]
    if not is_nearly_linear:  # single causes also from the edge, where their signatures lead beyond it
        for i in sorted(range(len(causes)), key=lambda i: cost(problem, groups, (i,)))[:_EXTRA_SETS]:
            cost_of((i,))
    for size in range(1, MOST_CAUSES):
        alike = [s for s in near if len(s) == size][:_REFINED_SETS] if not is_sure else []
        if not is_nearly_linear and size <= _FEW_CAUSES:  # where signatures bend, few causes may do what many seem to
            alike += [s for _, s in ranked if len(s) == size][:_EXTRA_SETS]
        for subset in alike:
            cost_of(subset)
    for i in bent:
        for start in _half_sizes(causes[i]):
            refined, single_cost = _refined_cost(predictor, linearization, {causes[i]: start})
            if single_cost < results.get((i,), (math.inf, {}))[0]:
                results[(i,)] = single_cost, refined
    return simplest_set(list(results.values()), cost_of(()), predictor)


def simplest_set(tried: Sequence[tuple[float, dict[Cause, float]]], nothing: float, predictor: DrivePredictor) -> dict[Cause, float]:
    """The set with the least of the costs ``tried``; of a robot that does not follow the friction model, the best one of the fewest causes
    that explain as much of ``nothing``, the cost of no cause, but for the model's accuracy.

    By more causes a set would only repair how this robot responds to one of them. Among equally good sets of one number (two clocks that
    differ, and nothing that shows which is wrong) the order of the catalogue decides, not rounding. Errors of a reference, which is no part
    of the robot, come first.
    """
    least = min(cost for cost, _ in tried)
    margin = max(_ALIAS_LOG_ODDS, _BASELINE_SHARE * (nothing - least)) if predictor.has_baseline else 0.0
    number, best = min((len(sizes), cost) for cost, sizes in tried if cost <= least + margin)
    equal = [sizes for cost, sizes in tried if len(sizes) == number and cost <= best + _TIE_LOG_ODDS]
    of_reference = [] if predictor.drive.is_lidar_reference else [c.id for c in CAUSES.values() if c.reference_words is not None]
    order = {name: i for i, name in enumerate(dict.fromkeys((*of_reference, *CAUSES)))}
    return min(equal, key=lambda sizes: sorted(order.get(cause.id, len(order)) for cause in sizes))


def refined_cost(predictor: DrivePredictor, linearization: Linearization, sizes: dict[Cause, float]) -> float:
    """Cost of ``sizes`` by the predictor itself, not by its linearization."""
    return _refined_cost(predictor, linearization, sizes)[1]


def aliases_of(predictor: DrivePredictor, linearization: Linearization, chosen: tuple[int, ...], i: int) -> tuple[tuple[str, float], ...]:
    """Causes that could stand in for ``i`` and explain the drive about as well: by their signatures, and then by the predictor itself."""
    problem, causes = linearization.problem, linearization.causes
    others = tuple(j for j in chosen if j != i)
    base, own = problem.gain(others), problem.gain(chosen)
    tolerance = max(_ALIAS_LOG_ODDS, _ALIAS_SHARE * (own - base))
    # without faults the robot does not follow the model: signatures may miss more, and the predictor itself decides
    is_foreign = predictor.unmodelled.slip_share > 0.0
    missing_share = _FOREIGN_MISSING_SHARE if is_foreign else _MAX_MISSING_SHARE
    promised = max(tolerance, missing_share * (own - base)) if predictor.has_baseline or is_foreign else tolerance
    found: dict[str, tuple[float, int]] = {}
    for j in _substitutes(causes, chosen):
        cause = causes[j]
        subset = (*others, j)
        gain = problem.gain(subset)
        size = float(problem.fit(subset)[0][-1])
        if own - gain > promised or not cause.bounds[0] <= size <= cause.bounds[1]:
            continue
        if cause.id not in found or gain > found[cause.id][0]:
            found[cause.id] = gain, j
    if not found:
        return ()
    best = refined_cost(predictor, linearization, _linear_sizes(linearization, chosen))
    if predictor.has_baseline or is_foreign:
        explained = refined_cost(predictor, linearization, _linear_sizes(linearization, others)) - best
        tolerance = max(_ALIAS_LOG_ODDS, (_FOREIGN_SHARE if is_foreign else _BASELINE_SHARE) * explained)
    costs = []
    for _, j in found.values():
        sizes, cost = _refined_cost(predictor, linearization, _linear_sizes(linearization, (*others, j)))
        if cost - best <= tolerance and abs(sizes[causes[j]]) <= causes[j].largest_plausible:
            costs.append((cost, causes[j].id, sizes[causes[j]]))
    return tuple((name, size) for _, name, size in sorted(costs))


def has_tolerated_substitute(linearization: Linearization, chosen: tuple[int, ...], i: int, largest: FloatArray) -> bool:
    """Whether one cause no larger than what is tolerated of it, ``largest`` (p,), explains the drive about as well as ``i``, or as ``i``
    and another one of those ``chosen`` together, as where these two nearly cancel."""
    problem, causes = linearization.problem, linearization.causes
    groups = [e.group for e in causes]
    most = cost(problem, groups, chosen) + _ALIAS_LOG_ODDS
    for k in chosen:
        rest = tuple(j for j in chosen if j not in (i, k))
        for j in _substitutes(causes, chosen):
            size = float(problem.fit((*rest, j))[0][-1])
            is_tolerated = abs(size) <= largest[j] and not (causes[j].one_sided and size < 0.0)
            if is_tolerated and cost(problem, groups, (*rest, j)) <= most:
                return True
    return False


def _substitutes(causes: tuple[Cause, ...], chosen: tuple[int, ...]) -> list[int]:
    """Causes that could take the place of one of those ``chosen``."""
    groups = {causes[k].group for k in chosen}
    return [j for j, cause in enumerate(causes) if cause.group not in groups]


def _cost(linearization: Linearization, sizes: dict[Cause, float], rows: FloatArray) -> float:
    """What ``rows`` (M, 6), which ``sizes`` leave, are off beyond all tolerances, and the price of so many causes."""
    whole = _regression_of(linearization, rows, linearization.signatures)
    return whole.misfit() + price(whole.count, len({e.group for e in linearization.causes}), len(sizes))


def _regression_of(linearization: Linearization, rows: FloatArray, signatures: FloatArray) -> Regression:
    """Regression of other ``rows`` (M, 6) and ``signatures`` (M, 6, p) in the same noise."""
    return make_regression(rows, signatures, linearization.nuisances, linearization.noise, linearization.causes, linearization.tolerance)


def _refined_cost(predictor: DrivePredictor, linearization: Linearization, start: dict[Cause, float]) -> tuple[dict[Cause, float], float]:
    """Sizes by the predictor itself, and what they cost; inf for sizes that no robot can have, and for causes whose correction makes
    all discrepancies larger: they cancel each other or what is tolerated, which no correction has."""
    try:
        sizes, rows = _refine_sizes(predictor, linearization, start)
        if any(size in cause.limits for cause, size in sizes.items()):  # the drive asks for more than is considered
            return sizes, math.inf
        if is_correction_worse(predictor, linearization.noise, rows):
            return sizes, math.inf
        return sizes, _cost(linearization, sizes, rows)
    except (CgError, ModelError):
        return start, math.inf


def is_correction_worse(predictor: DrivePredictor, noise: Noise, rows: FloatArray) -> bool:
    """Whether ``rows`` (M, 6), which corrected causes leave, are larger than the discrepancies by the robot file: none of the channels of
    the motion shrinks, and all together grow beyond what is tolerated; over the noise, without outliers."""
    scale = noise.weights[:, None] / noise.sigmas
    before, after = (np.nansum(((r * scale) ** 2)[:, :_MOTION], axis=0) for r in (predictor.discrepancies(Hypothesis()), rows))
    return bool(np.all(after >= before)) and float(after.sum()) > _MAX_LARGER_SQUARES * float(before.sum())


def _refine_sizes(
    predictor: DrivePredictor, linearization: Linearization, sizes: dict[Cause, float]
) -> tuple[dict[Cause, float], FloatArray]:
    """Gauss-Newton on the sizes, with their priors, by the real predictor; and the discrepancies (M, 6) that they leave.

    All other causes may take what they are tolerated. The signatures at hand are used until a step is long or makes it worse; then a step
    is shortened.
    """
    order = list(sizes)
    own = [linearization.causes.index(e) for e in order]
    limits, typical = _bounds(tuple(order)), np.array([e.typical for e in order])
    signatures, share, is_fresh = linearization.signatures, 1.0, False

    def predict(values: FloatArray) -> tuple[Hypothesis, FloatArray]:
        hypothesis = with_sizes(dict(zip(order, values, strict=True)))
        return hypothesis, predictor.discrepancies(hypothesis)

    def with_own(hypothesis: Hypothesis, rows: FloatArray) -> FloatArray:
        changed = signatures.copy()
        changed[..., own] = np.stack([predictor.signature(hypothesis, e, rows) for e in order], axis=-1)
        return changed

    values = np.clip([sizes[e] for e in order], limits[:, 0], limits[:, 1]) if order else np.zeros(0)
    hypothesis, rows = predict(values)
    problem = _regression_of(linearization, rows, signatures)
    scale = problem.scale[own]
    least = problem.misfit() + float(np.sum(np.square(values / scale)))
    for _ in range(_MAX_STEPS if order else 0):
        score, information = problem.scores((), own)
        change = np.linalg.solve(information + np.eye(len(order)), score - values / scale) * scale
        new = np.clip(values + share * change, limits[:, 0], limits[:, 1])
        moved = float(np.max(np.abs(new - values) / typical))
        if moved < _CONVERGED_STEP:
            break
        tried_hypothesis, tried_rows = predict(new)
        tried = _regression_of(linearization, tried_rows, signatures)
        off = tried.misfit() + float(np.sum(np.square(new / scale)))
        if off <= least:
            values, hypothesis, rows, problem, least, share, is_fresh = new, tried_hypothesis, tried_rows, tried, off, 1.0, False
        elif is_fresh:
            share *= _SHORTER_STEP
        if not is_fresh and (off > least or moved > _LONG_STEP):
            signatures, is_fresh = with_own(hypothesis, rows), True
            problem = _regression_of(linearization, rows, signatures)
    return dict(zip(order, (float(v) for v in values), strict=True)), rows


def _linear_sizes(linearization: Linearization, subset: tuple[int, ...]) -> dict[Cause, float]:
    return {linearization.causes[i]: float(v) for i, v in zip(subset, linearization.problem.fit(subset)[0], strict=True)}


def _bounds(causes: tuple[Cause, ...]) -> FloatArray:
    return np.array([e.bounds for e in causes])
