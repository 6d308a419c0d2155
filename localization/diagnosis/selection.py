"""The search_causes for causes: sets by evidence on their signatures, and the best of them by the predictor itself."""

from __future__ import annotations

import math

import numpy as np

from localization.diagnosis.causes import Cause
from localization.diagnosis.linearization import Linearization, group_of, make_regression
from localization.diagnosis.prediction import DrivePredictor, with_sizes
from localization.diagnosis.subset_selection import MOST_CAUSES, rank_subsets, signature_correlation
from motion_models.errors import CgError, ModelError
from motion_models.se2 import FloatArray

_MIN_ALIAS_CORRELATION = 0.7  # signatures less alike than this are no aliases, however short the drive
_ALIAS_LOG_ODDS = 7.0  # twice the log-likelihood by which a rival may be worse: odds of 1 to 33
_ALIAS_SHARE = 0.02  # or this share of what the cause explains, which no model is right about
_REFINED_SETS = 2  # sets of each number of causes that are tried for real
_MAX_MISSING_SHARE = 0.1  # share of what signatures promise that may be missing
_FEW_CAUSES, _EXTRA_SETS = 2, 4  # then so many sets of up to so many causes are tried whatever signatures say
_NEAR_LOG_EVIDENCE = 30.0
_CLEAR_LOG_EVIDENCE = 200.0  # lead in twice the log-evidence that needs no trial
_MAX_STEPS = 4
_CONVERGED_STEP, _LONG_STEP = 0.02, 0.2  # steps, over typical sizes: one that ends, and one after which signatures are taken anew


def search_causes(predictor: DrivePredictor, linearization: Linearization) -> dict[Cause, float]:
    """Sizes of the best set of causes: the best few sets by signatures are compared by full predictions at their own sizes."""
    causes, problem = linearization.causes, linearization.problem
    groups = [group_of(e) for e in causes]
    ranked = rank_subsets(problem, groups, _bounds(causes))
    least, best = ranked[0]
    nothing = problem.misfit()
    results: dict[tuple[int, ...], tuple[float, dict[Cause, float]]] = {}

    def cost_of(subset: tuple[int, ...]) -> float:
        """Twice the log-odds by the predictor itself; inf for sizes that no robot can have."""
        if subset not in results:
            sizes, cost = _refined_cost(predictor, linearization, _linear_sizes(linearization, subset))
            results[subset] = cost, sizes
        return results[subset][0]

    is_sure = len(ranked) < 2 or ranked[1][0] - least > _CLEAR_LOG_EVIDENCE
    is_nearly_linear = cost_of(best) < nothing + least + max(_MAX_MISSING_SHARE * abs(least), _ALIAS_LOG_ODDS)
    cost_of(())
    margin = max(_NEAR_LOG_EVIDENCE, _MAX_MISSING_SHARE * abs(least)) if is_nearly_linear else _CLEAR_LOG_EVIDENCE
    near = [s for c, s in ranked if c - least < margin]
    for size in range(1, MOST_CAUSES):
        alike = [s for s in near if len(s) == size][:_REFINED_SETS] if not is_sure else []
        if not is_nearly_linear and size <= _FEW_CAUSES:  # where signatures bend, few causes may do what many seem to
            alike += [s for _, s in ranked if len(s) == size][:_EXTRA_SETS]
        for subset in alike:
            cost_of(subset)
    return min(results.values(), key=lambda r: r[0])[1]


def refined_cost(predictor: DrivePredictor, linearization: Linearization, sizes: dict[Cause, float]) -> float:
    """Cost of ``sizes`` by the predictor itself, not by its linearization."""
    return _refined_cost(predictor, linearization, sizes)[1]


def aliases_of(predictor: DrivePredictor, linearization: Linearization, chosen: tuple[int, ...], i: int) -> tuple[tuple[str, float], ...]:
    """Causes that could stand in for ``i`` and explain the drive about as well: by their signatures, and then by the predictor itself."""
    problem, causes = linearization.problem, linearization.causes
    others = tuple(j for j in chosen if j != i)
    base, own = problem.gain(others), problem.gain(chosen)
    tolerance = max(_ALIAS_LOG_ODDS, _ALIAS_SHARE * (own - base))
    found: dict[str, tuple[float, int]] = {}
    for j, cause in enumerate(causes):
        if j in chosen or group_of(cause) == group_of(causes[i]) or any(group_of(cause) == group_of(causes[k]) for k in others):
            continue
        if abs(signature_correlation(problem, others, i, j)) < _MIN_ALIAS_CORRELATION:
            continue
        subset = (*others, j)
        gain = problem.gain(subset)
        size = float(problem.fit(subset)[0][-1])
        if own - gain > tolerance or (cause.one_sided and size < 0.0) or abs(size) > cause.largest:
            continue
        if cause.id not in found or gain > found[cause.id][0]:
            found[cause.id] = gain, j
    if not found:
        return ()
    best = refined_cost(predictor, linearization, _linear_sizes(linearization, chosen))
    costs = []
    for _, j in found.values():
        sizes, cost = _refined_cost(predictor, linearization, _linear_sizes(linearization, (*others, j)))
        if cost - best <= tolerance:
            costs.append((cost, causes[j].id, sizes[causes[j]]))
    return tuple((name, size) for _, name, size in sorted(costs))


def _cost(linearization: Linearization, sizes: dict[Cause, float], rows: FloatArray) -> float:
    """What ``rows`` (M, 6), which ``sizes`` leave, are off beyond all tolerances, and the price of so many causes."""
    whole = make_regression(
        rows, linearization.signatures, linearization.nuisances, linearization.noise, linearization.causes, linearization.tolerance
    )
    k, groups = len(sizes), len({group_of(e) for e in linearization.causes})
    return whole.misfit() + k * math.log(max(whole.count, 2)) + 2.0 * math.log(math.comb(groups, k))


def _refined_cost(predictor: DrivePredictor, linearization: Linearization, start: dict[Cause, float]) -> tuple[dict[Cause, float], float]:
    """Sizes by the predictor itself, and what they cost; inf for sizes that no robot can have."""
    try:
        sizes, rows = _refine_sizes(predictor, linearization, start)
        return sizes, _cost(linearization, sizes, rows)
    except (CgError, ModelError):
        return start, math.inf


def _refine_sizes(
    predictor: DrivePredictor, linearization: Linearization, sizes: dict[Cause, float]
) -> tuple[dict[Cause, float], FloatArray]:
    """Gauss-Newton on the sizes by the real predictor, with the signatures that are at hand until a step is long; and the discrepancies
    (M, 6) that they leave."""
    order = list(sizes)
    limits = _bounds(tuple(order))
    values = np.array([_bounded(e, sizes[e]) for e in order])
    rows = predictor.discrepancies(with_sizes(dict(zip(order, values, strict=True))))
    own = linearization.signatures[..., [linearization.causes.index(e) for e in order]]
    typical = np.array([e.typical for e in order])
    for _ in range(_MAX_STEPS if order else 0):
        problem = make_regression(rows, own, linearization.nuisances, linearization.noise, tuple(order), linearization.tolerance)
        change = np.linalg.solve(problem.gram + 1e-9 * np.eye(len(order)), problem.moment) * problem.scale
        new = np.clip(values + change, limits[:, 0], limits[:, 1])
        moved = float(np.max(np.abs(new - values) / typical))
        if moved < _CONVERGED_STEP:
            break
        values = new
        hypothesis = with_sizes(dict(zip(order, values, strict=True)))
        rows = predictor.discrepancies(hypothesis)
        if moved > _LONG_STEP:
            own = np.stack([predictor.signature(hypothesis, e, rows) for e in order], axis=-1)
    return dict(zip(order, (float(v) for v in values), strict=True)), rows


def _linear_sizes(linearization: Linearization, subset: tuple[int, ...]) -> dict[Cause, float]:
    return {linearization.causes[i]: float(v) for i, v in zip(subset, linearization.problem.fit(subset)[0], strict=True)}


def _bounds(causes: tuple[Cause, ...]) -> FloatArray:
    return np.array([(0.0 if e.one_sided else -e.largest, e.largest) for e in causes])


def _bounded(cause: Cause, size: float) -> float:
    return max(size, 0.0) if cause.one_sided else size
