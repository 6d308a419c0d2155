"""The search for causes: sets by evidence on their signatures, and the best of them by the pipeline itself."""

from __future__ import annotations

import math

import numpy as np

from localization.diagnosis.causes import Effect
from localization.diagnosis.linearization import Look, group_of, normal_form
from localization.diagnosis.prediction import DrivePredictor, with_sizes
from localization.diagnosis.subset_selection import MOST_CAUSES, likeness, ranked_subsets
from motion_models.errors import CgError, ModelError
from motion_models.se2 import FloatArray

_ALIKE = 0.7  # signatures less alike than this are no aliases, however short the drive
_CLOSE = 7.0  # twice the log-likelihood by which a rival may be worse: odds of 1 to 33
_CLOSE_SHARE = 0.02  # or this share of what the cause explains, which no model is right about
_REFINED = 2  # sets of each number of causes that are tried for real
_FORETOLD = 0.1  # share of what signatures promise that may be missing
_PLAIN, _TRIED = 2, 4  # then so many sets of up to so many causes are tried whatever signatures say
_NEAR = 30.0
_SURE = 200.0  # lead in twice the log-evidence that needs no trial
_STEPS = 4
_SHORT, _LONG = 0.02, 0.2  # steps, over usual sizes: one that ends, and one after which signatures are taken anew


def search(pipeline: DrivePredictor, state: Look) -> dict[Effect, float]:
    """The best set of causes. The best few by signatures around the state compete with what they really explain, at their own sizes."""
    effects, problem = state.effects, state.problem
    groups = [group_of(e) for e in effects]
    ranked = ranked_subsets(problem, groups, _bounds(effects))
    least, best = ranked[0]
    nothing = problem.misfit()
    results: dict[tuple[int, ...], tuple[float, dict[Effect, float]]] = {}

    def real(subset: tuple[int, ...]) -> float:
        """Twice the log-odds by the pipeline itself; inf for sizes that no robot can have."""
        if subset not in results:
            sizes, cost = _tried(pipeline, state, _linear_sizes(state, subset))
            results[subset] = cost, sizes
        return results[subset][0]

    is_sure = len(ranked) < 2 or ranked[1][0] - least > _SURE
    as_foretold = real(best) < nothing + least + max(_FORETOLD * abs(least), _CLOSE)
    real(())
    margin = max(_NEAR, _FORETOLD * abs(least)) if as_foretold else _SURE
    near = [s for c, s in ranked if c - least < margin]
    for size in range(1, MOST_CAUSES):
        alike = [s for s in near if len(s) == size][:_REFINED] if not is_sure else []
        if not as_foretold and size <= _PLAIN:  # where signatures bend, few causes may do what many seem to
            alike += [s for _, s in ranked if len(s) == size][:_TRIED]
        for subset in alike:
            real(subset)
    return min(results.values(), key=lambda r: r[0])[1]


def true_cost(pipeline: DrivePredictor, state: Look, sizes: dict[Effect, float]) -> float:
    return _tried(pipeline, state, sizes)[1]


def aliases_of(pipeline: DrivePredictor, state: Look, chosen: tuple[int, ...], i: int) -> tuple[tuple[str, float], ...]:
    """Causes that could stand in for ``i`` and explain the drive about as well: by their signatures, and then by the pipeline itself."""
    problem, effects = state.problem, state.effects
    others = tuple(j for j in chosen if j != i)
    base, own = problem.gain(others), problem.gain(chosen)
    tolerance = max(_CLOSE, _CLOSE_SHARE * (own - base))
    found: dict[str, tuple[float, int]] = {}
    for j, effect in enumerate(effects):
        if j in chosen or group_of(effect) == group_of(effects[i]) or any(group_of(effect) == group_of(effects[k]) for k in others):
            continue
        if abs(likeness(problem, others, i, j)) < _ALIKE:
            continue
        subset = (*others, j)
        gain = problem.gain(subset)
        size = float(problem.fit(subset)[0][-1])
        if own - gain > tolerance or (effect.one_sided and size < 0.0) or abs(size) > 10.0 * effect.usual:
            continue
        if effect.id not in found or gain > found[effect.id][0]:
            found[effect.id] = gain, j
    if not found:
        return ()
    best = true_cost(pipeline, state, _linear_sizes(state, chosen))
    costs = []
    for _, j in found.values():
        sizes, cost = _tried(pipeline, state, _linear_sizes(state, (*others, j)))
        if cost - best <= tolerance:
            costs.append((cost, effects[j].id, sizes[effects[j]]))
    return tuple((name, size) for _, name, size in sorted(costs))


def _cost(state: Look, sizes: dict[Effect, float], rows: FloatArray) -> float:
    """What ``rows`` (M, 6), which ``sizes`` leave, are off beyond all tolerances, and the price of so many causes."""
    whole = normal_form(rows, state.signatures, state.nuisances, state.noise, state.effects, state.tolerance)
    k, groups = len(sizes), len({group_of(e) for e in state.effects})
    return whole.misfit() + k * math.log(max(whole.count, 2)) + 2.0 * math.log(math.comb(groups, k))


def _tried(pipeline: DrivePredictor, state: Look, start: dict[Effect, float]) -> tuple[dict[Effect, float], float]:
    """Sizes by the pipeline itself, and what they cost; inf for sizes that no robot can have."""
    try:
        sizes, rows = _refined(pipeline, state, start)
        return sizes, _cost(state, sizes, rows)
    except (CgError, ModelError):
        return start, math.inf


def _refined(pipeline: DrivePredictor, state: Look, sizes: dict[Effect, float]) -> tuple[dict[Effect, float], FloatArray]:
    """Gauss-Newton on the sizes by the real pipeline, with the signatures that are at hand until a step is long; and the discrepancies
    (M, 6) that they leave."""
    order = list(sizes)
    limits = _bounds(tuple(order))
    values = np.array([_bounded(e, sizes[e]) for e in order])
    rows = pipeline.discrepancies(with_sizes(dict(zip(order, values, strict=True))))
    own = state.signatures[..., [state.effects.index(e) for e in order]]
    usual = np.array([e.usual for e in order])
    for _ in range(_STEPS if order else 0):
        problem = normal_form(rows, own, state.nuisances, state.noise, tuple(order), state.tolerance)
        change = np.linalg.solve(problem.gram + 1e-9 * np.eye(len(order)), problem.moment) * problem.scale
        new = np.clip(values + change, limits[:, 0], limits[:, 1])
        moved = float(np.max(np.abs(new - values) / usual))
        if moved < _SHORT:
            break
        values = new
        belief = with_sizes(dict(zip(order, values, strict=True)))
        rows = pipeline.discrepancies(belief)
        if moved > _LONG:
            own = np.stack([pipeline.signature(belief, e, rows) for e in order], axis=-1)
    return dict(zip(order, (float(v) for v in values), strict=True)), rows


def _linear_sizes(state: Look, subset: tuple[int, ...]) -> dict[Effect, float]:
    return {state.effects[i]: float(v) for i, v in zip(subset, state.problem.fit(subset)[0], strict=True)}


def _bounds(effects: tuple[Effect, ...]) -> FloatArray:
    return np.array([(0.0 if e.one_sided else -10.0 * e.usual, 10.0 * e.usual) for e in effects])


def _bounded(effect: Effect, size: float) -> float:
    return max(size, 0.0) if effect.one_sided else size
