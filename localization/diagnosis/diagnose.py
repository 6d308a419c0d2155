"""The diagnosis: discrepancies, causes, what they gain, and what is left."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from localization.diagnosis import residue
from localization.diagnosis.attribution import (
    MOST_CAUSES,
    Regression,
    likeness,
    max_statistic,
    p_value,
    ranked_subsets,
    regression,
    statistic,
)
from localization.diagnosis.drive import Drive
from localization.diagnosis.effects import EFFECTS, EXTRA, Belief, Effect, friction_change, slope_across
from localization.diagnosis.findings import Component, Diagnosis, Finding, Gain, Verdict
from localization.diagnosis.heldout import heldout_gain
from localization.diagnosis.next_drive import general_advice, separating_drive
from localization.diagnosis.noise import Noise, estimated_noise, plain_noise, regressors
from localization.diagnosis.prediction import CHANNEL_UNITS, CHANNELS, Pipeline, with_sizes
from localization.diagnosis.sweep_lag import sweep_lag
from localization.diagnosis.words import evidence, sentence
from motion_models.base import MotionModel
from motion_models.errors import CgError, ModelError
from motion_models.se2 import FloatArray

_PRIOR = 4.0  # sigma of a size before looking, over the usual one
_ALIKE = 0.7  # signatures less alike than this are no aliases, however short the drive
_CLOSE = 7.0  # twice the log-likelihood by which a rival may be worse: odds of 1 to 33
_CLOSE_SHARE = 0.02  # or this share of what the cause explains, which no model is right about
_ROUNDS = 5
_TOLERANCE = 0.35  # sigma of causes that nobody names, over what is negligible
_REFINED = 2  # sets of each number of causes that are tried for real
_FORETOLD = 0.1  # share of what signatures promise that may be missing
_PLAIN, _TRIED = 2, 4  # then so many sets of up to so many causes are tried whatever signatures say
_SURE = 200.0  # lead in twice the log-evidence that needs no trial
_STEPS = 3
_UNSURE = 1.0 / 3.0  # systematic part of a size's sigma, over what is negligible: clocks, mounts and physics are no better
_PAYS = 0.003  # least held-out gain of a finding
_CLEAR = 0.05
_FEW_WINDOWS = 64


@dataclass(frozen=True)
class DiagnosisConfig:
    """How sure a diagnosis must be."""

    significance: float = 0.01
    """Family-wise probability of naming any cause where there is none."""
    fewest_windows: int = 8
    """Fewer measured windows than this decide nothing."""
    moments: int = 9
    """At how many moments a change of the floor is looked for."""
    seed: int = 0
    """Of the random numbers in tests and intervals."""


@dataclass(frozen=True)
class _State:
    """One linearisation: everything about the drive around a belief."""

    effects: tuple[Effect, ...]
    rows: FloatArray
    """(M, 6) at the belief."""
    linear: FloatArray
    """(M, 6) the same, as if nothing were believed yet."""
    signatures: FloatArray
    """(M, 6, p)"""
    nuisances: FloatArray
    """(M, 6, q)"""
    noise: Noise
    problem: Regression


@dataclass(frozen=True)
class Residuals:
    """Discrepancies, for pictures."""

    rows: FloatArray
    """(M, 6) measured minus predicted, as `CHANNELS`."""
    left: FloatArray
    """(M, 6) once all findings are corrected."""
    sigmas: FloatArray
    """(M, 6) their noise."""
    names: tuple[str, ...]
    """Keys of the causes that were tried."""
    alike: FloatArray
    """(p, p) correlations of their signatures on this drive, in its noise."""


@dataclass(frozen=True)
class Examined:
    """A diagnosis and what it was made of."""

    diagnosis: Diagnosis
    pipeline: Pipeline | None
    """None where there was too little to look at."""
    residuals: Residuals | None
    state: _State | None = None
    """The last look at the drive: its signatures, and its noise."""


def diagnose(drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None) -> Diagnosis:
    """What is wrong with ``model`` on ``drive``, why, and what saying so gains."""
    return examine(drive, model, config).diagnosis


def examine(drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None) -> Examined:
    """The same, with what pictures, patches and other methods start from."""
    config = config or DiagnosisConfig()
    if len(drive.maneuvers) < config.fewest_windows:
        why = f"only {len(drive.maneuvers)} windows of motion were measured; it takes {config.fewest_windows}."
        return Examined(_undecidable(drive, model, drive.notes[0] if drive.witness == "none" else why), None, None)
    rng = np.random.default_rng(config.seed)
    pipeline = _pipeline(drive, model)
    effects = _candidates(pipeline, config)
    state = _linearise(pipeline, effects, {})
    first = state
    current: dict[Effect, float] = {}
    visited: list[dict[Effect, float]] = []
    seen: list[frozenset[str]] = []
    for _ in range(_ROUNDS):
        sizes = _search(pipeline, state)
        keys = frozenset(e.key for e in sizes)
        if keys == frozenset(e.key for e in current):
            break
        current = sizes
        visited.append(sizes)
        state = _linearise(pipeline, effects, current)
        if keys in seen:
            break
        seen.append(keys)
    if len(visited) > 1:  # later looks need not be better: all that were preferred once are compared by one noise
        best = min(visited, key=lambda sizes: _true_cost(pipeline, state, sizes))
        if set(best) != set(current):
            current = best
            state = _linearise(pipeline, effects, current)
    index = {e.key: i for i, e in enumerate(effects)}
    chosen = _tested(state, tuple(sorted(index[e.key] for e in current)), rng, config)
    return _conclude(pipeline, first, state, chosen, rng, config)


def _search(pipeline: Pipeline, state: _State) -> dict[Effect, float]:
    """The best set of causes. The best few by signatures around the state compete with what they really explain, at their own sizes."""
    effects, problem = state.effects, state.problem
    groups = [_group(e) for e in effects]
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
    near = [s for c, s in ranked if c - least < _SURE]
    for size in range(1, MOST_CAUSES):
        alike = [s for s in near if len(s) == size][:_REFINED] if not is_sure else []
        if not as_foretold and size <= _PLAIN:  # where signatures bend, few causes may do what many seem to
            alike += [s for _, s in ranked if len(s) == size][:_TRIED]
        for subset in alike:
            real(subset)
    return min(results.values(), key=lambda r: r[0])[1]


def _cost(state: _State, sizes: dict[Effect, float], rows: FloatArray) -> float:
    """What ``rows`` (M, 6), which ``sizes`` leave, are off beyond all tolerances, and the price of so many causes."""
    whole = _normal(rows, state.signatures, state.nuisances, state.noise, state.effects)
    k, groups = len(sizes), len({_group(e) for e in state.effects})
    return whole.misfit() + k * math.log(max(whole.count, 2)) + 2.0 * math.log(math.comb(groups, k))


def _tried(pipeline: Pipeline, state: _State, start: dict[Effect, float]) -> tuple[dict[Effect, float], float]:
    """Sizes by the pipeline itself, and what they cost; inf for sizes that no robot can have."""
    try:
        sizes, rows = _refined(pipeline, state, start)
        return sizes, _cost(state, sizes, rows)
    except (CgError, ModelError):
        return start, math.inf


def _true_cost(pipeline: Pipeline, state: _State, sizes: dict[Effect, float]) -> float:
    return _tried(pipeline, state, sizes)[1]


def _refined(pipeline: Pipeline, state: _State, sizes: dict[Effect, float]) -> tuple[dict[Effect, float], FloatArray]:
    """Gauss-Newton on the sizes by the real pipeline; and the discrepancies (M, 6) that they leave."""
    order = list(sizes)
    values = np.array([_bounded(e, sizes[e]) for e in order])
    rows = pipeline.discrepancies(with_sizes(dict(zip(order, values, strict=True))))
    for _ in range(_STEPS if order else 0):
        belief = with_sizes(dict(zip(order, values, strict=True)))
        own = np.stack([pipeline.signature(belief, e, rows) for e in order], axis=-1)
        problem = _normal(rows, own, state.nuisances, state.noise, tuple(order))
        change = np.linalg.solve(problem.gram + 1e-9 * np.eye(len(order)), problem.moment) * problem.scale
        limits = _bounds(tuple(order))
        new = np.clip(values + change, limits[:, 0], limits[:, 1])
        values, moved = new, np.abs(new - values) / np.array([e.usual for e in order])
        rows = pipeline.discrepancies(with_sizes(dict(zip(order, values, strict=True))))
        if moved.max() < 0.02:
            break
    return dict(zip(order, (float(v) for v in values), strict=True)), rows


def _bounds(effects: tuple[Effect, ...]) -> FloatArray:
    return np.array([(0.0 if e.one_sided else -10.0 * e.usual, 10.0 * e.usual) for e in effects])


def _pipeline(drive: Drive, model: MotionModel) -> Pipeline:
    """With inertia where that describes the drive better (or is what the friction model leaves out by its nature)."""
    plain = Pipeline(drive, model, settling=False)
    if drive.kind != "log":
        return plain
    with_inertia = Pipeline(drive, model, settling=True)
    squares = []
    for pipeline in (plain, with_inertia):
        rows = pipeline.discrepancies(Belief())[:, :3]
        known = np.isfinite(rows).any(axis=0)
        squares.append(np.nanmedian(np.abs(rows[:, known]), axis=0))
    better = np.sum(np.log(np.maximum(squares[0], 1e-9)) - np.log(np.maximum(squares[1], 1e-9))) > 0.0
    return with_inertia if better or model.name == "friction" else plain


def _candidates(pipeline: Pipeline, config: DiagnosisConfig) -> tuple[Effect, ...]:
    drive = pipeline.drive
    out = set()
    if drive.gyro is None and not drive.gyro_is_witness:
        out.add("gyro_bias")
    if not pipeline.dropout_seen:
        out.add("encoder_dropout")
    if drive.gyro_is_witness:
        out |= {"lidar_offset_x", "lidar_offset_y", "lidar_yaw", "lidar_time_offset", "lateral_slip_speed", "longitudinal_slip_turning"}
    if drive.kind == "rotations":
        out |= {"lidar_time_offset", "wheel_time_offset", "slope", "lateral_slip_speed", "rotation_slip_speed", "longitudinal_slip_turning"}
    found = [e for e in EFFECTS.values() if e.id not in out]
    if drive.kind == "log" and not drive.gyro_is_witness:
        found.append(slope_across())
        length = float(drive.starts_s[-1])
        if len(drive.maneuvers) >= 24:
            found += [friction_change(length * q) for q in np.linspace(0.1, 0.9, config.moments)]
    if drive.kind == "windows":
        found += list(EXTRA.values())
    elif pipeline.model.name != "friction":  # its own number for how far it turns is not the floor's
        found.append(EXTRA["rotation_scale"])
    return tuple(found)


def _linearise(pipeline: Pipeline, effects: tuple[Effect, ...], sizes: dict[Effect, float]) -> _State:
    belief = with_sizes(sizes)
    rows = pipeline.discrepancies(belief)
    signatures = np.stack([pipeline.signature(belief, e, rows) for e in effects], axis=-1)
    linear = rows.copy()
    for effect, size in sizes.items():
        linear += signatures[..., [e.key for e in effects].index(effect.key)] * size
    nuisances = _nuisances(pipeline, rows)
    noise = _noise(pipeline, linear, signatures, nuisances, effects)
    return _State(effects, rows, linear, signatures, nuisances, noise, _normal(linear, signatures, nuisances, noise, effects))


def _nuisances(pipeline: Pipeline, rows: FloatArray) -> FloatArray:
    """(M, 6, 4) accelerometers and the floor under the IMU are never quite level, and sweeps lag."""
    level = np.zeros((*rows.shape, 2))
    level[:, 4, 0] = level[:, 5, 1] = 1.0
    found = np.concatenate([level, sweep_lag(pipeline)], axis=-1)
    return np.where(np.isfinite(rows)[..., None], found, np.nan)


def _normal(linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, noise: Noise, effects: tuple[Effect, ...]) -> Regression:
    y = noise.whiten(linear).ravel()
    s = noise.whiten(signatures).reshape(len(y), -1)
    z = noise.whiten(nuisances).reshape(len(y), -1)
    return regression(y, s, z, _PRIOR * np.array([e.usual for e in effects]), _TOLERANCE * np.array([e.negligible for e in effects]))


def _noise(pipeline: Pipeline, linear: FloatArray, signatures: FloatArray, nuisances: FloatArray, effects: tuple[Effect, ...]) -> Noise:
    """Estimated from what all causes together leave, in a few rounds as sizes and noise hang on each other."""
    batch, drive = pipeline.batch, pipeline.drive
    g = drive.robot.geometry
    features = regressors(batch, g.wheel_radius_m, g.track_width_m)
    starts = np.r_[True, batch.owner[1:] != batch.owner[:-1]]
    follows = ~starts
    if len(drive.spans_ns):
        follows = np.r_[False, drive.spans_ns[1:, 0] - drive.spans_ns[:-1, 1] < 10_000_000]
    given = np.sqrt(np.where(np.isfinite(np.diagonal(batch.cov, axis1=1, axis2=2)), np.diagonal(batch.cov, axis1=1, axis2=2), 1.0))
    sigmas = np.ones_like(linear)
    sigmas[:, :3] = given
    sigmas[:, 3] = np.hypot(given[:, 2], 1e-3)
    sigmas[:, 4:] = 0.05
    noise = plain_noise(linear, sigmas, follows)
    scale = _PRIOR * np.array([e.usual for e in effects])
    known = np.isfinite(linear)
    for _ in range(3):
        y = noise.whiten(linear).ravel()
        design = np.hstack([noise.whiten(signatures).reshape(len(y), -1) * scale, noise.whiten(nuisances).reshape(len(y), -1) * 1e3])
        inverse = np.linalg.inv(design.T @ design + np.eye(design.shape[1]))
        x = inverse @ (design.T @ y)
        spent = np.sum((design @ inverse) * design, axis=1).reshape(linear.shape).sum(axis=0)
        p = len(effects)
        left = linear - signatures @ (x[:p] * scale) - nuisances @ (x[p:] * 1e3)
        noise = estimated_noise(np.where(known, left, np.nan), features, follows, spent, sigmas)
    return noise


def _tested(state: _State, chosen: tuple[int, ...], rng: np.random.Generator, config: DiagnosisConfig) -> tuple[int, ...]:
    """``chosen``, less what does not stand up to the test."""
    while chosen:
        p = []
        for i in chosen:
            others = tuple(j for j in chosen if j != i)
            p.append(_p_value(state, others, i, rng))
        worst = int(np.argmax(p))
        if p[worst] <= config.significance:
            break
        chosen = tuple(i for n, i in enumerate(chosen) if n != worst)
    return chosen


def _p_value(state: _State, others: tuple[int, ...], i: int, rng: np.random.Generator) -> float:
    df = state.noise.freedom
    return p_value(statistic(state.problem, others, i), max_statistic(state.problem, others, rng, df), df)


def _group(effect: Effect) -> str:
    return effect.id if effect.id != "slope" else effect.key


def _bounded(effect: Effect, size: float) -> float:
    return max(size, 0.0) if effect.one_sided else size


def _conclude(
    pipeline: Pipeline, first: _State, state: _State, chosen: tuple[int, ...], rng: np.random.Generator, config: DiagnosisConfig
) -> Examined:
    drive, problem, effects = pipeline.drive, state.problem, state.effects

    def held(with_these: tuple[int, ...], without: tuple[int, ...]) -> Gain:
        data = state.linear, state.signatures, state.nuisances, state.noise, problem.scale
        return heldout_gain(*data, with_these, without, np.random.default_rng(config.seed))

    within: dict[str, tuple[float, float]] = {}
    while chosen:  # what nobody would correct, or does not pay where its size was not fitted to, is not named
        sizes, cov, _ = problem.fit(chosen)
        gains = [held(chosen, tuple(j for j in chosen if j != i)) for i in chosen]
        small = [n for n, i in enumerate(chosen) if abs(sizes[n]) < effects[i].negligible or not _pays(gains[n], len(state.rows))]
        if not small:
            break
        worst = min(small, key=lambda n: gains[n].relative)
        within[effects[chosen[worst]].id] = float(sizes[worst]), float(math.sqrt(cov[worst, worst]))
        chosen = tuple(i for n, i in enumerate(chosen) if n != worst)
    sizes, cov, gained = problem.fit(chosen)
    findings = []
    for n, i in enumerate(chosen):
        effect, size = effects[i], float(sizes[n])
        sigma = math.hypot(math.sqrt(cov[n, n]), _UNSURE * effect.negligible)
        if effect.id == "encoder_dropout":  # a share that comes in spells of random length is as sure as there were many
            sigma = math.hypot(sigma, size * math.sqrt(2.0 / max(pipeline.dropout_spells, 2)))
        others = tuple(j for j in chosen if j != i)
        p = _p_value(state, others, i, rng)
        aliases = _aliases(pipeline, state, chosen, i)
        told = evidence(effect, state.signatures[..., i] * size, state.noise, problem.gain(chosen) - problem.gain(others))
        findings.append(Finding(effect, size, sigma, p, aliases, told, gains[n]))
    findings.sort(key=lambda f: f.gain.relative, reverse=True)
    total = held(chosen, ()) if chosen else None
    findings = _merged(findings)
    left = state.linear - state.signatures[..., list(chosen)] @ sizes
    spreads = problem.scale * np.where(np.isin(np.arange(len(effects)), chosen), 1.0, problem.tolerance)
    found_shapes, left_gain = residue.shapes(pipeline, state.noise, left, state.signatures, state.nuisances, spreads, rng)
    share = left_gain / max(left_gain + gained, 1e-9) if found_shapes else 0.0
    visible: dict[str, float] = {}
    for i, effect in enumerate(effects):
        size = 3.0 * problem.scale[i] / math.sqrt(problem.gram[i, i] + 1.0)
        visible[effect.id] = min(visible.get(effect.id, math.inf), float(size))
    blind = [e for e in effects if visible[e.id] > e.usual]
    verdict: Verdict
    if found_shapes and (not findings or share > 0.3):
        verdict = "unexplained"
    elif any(f.aliases for f in findings):
        verdict = "ambiguous"
    elif findings:
        verdict = "explained"
    elif len(blind) > 0.5 * len(effects):
        verdict = "undecidable"
    else:
        verdict = "consistent"
    discrepancy = _components(first, state, left)
    drive_next = separating_drive(pipeline, findings, state, chosen) if findings else general_advice(verdict, [e.id for e in blind])
    belief = with_sizes({f.effect: f.size for f in findings})
    result = Diagnosis(
        *(drive.name, drive.robot.name, pipeline.model.name, drive.witness, verdict, discrepancy, tuple(findings), found_shapes),
        left_share=share,
        next_drive=drive_next,
        sentence="",
        within=within,
        visible=visible,
        gain=total,
        windows=len(drive.maneuvers),
        notes=drive.notes,
        belief=belief,
    )
    scale = np.sqrt(np.diagonal(problem.gram) + 1e-12)
    alike = problem.gram / np.outer(scale, scale)
    residuals = Residuals(first.rows, left, state.noise.sigmas, tuple(e.key for e in effects), alike)
    return Examined(dataclasses.replace(result, sentence=sentence(result)), pipeline, residuals, state)


def _aliases(pipeline: Pipeline, state: _State, chosen: tuple[int, ...], i: int) -> tuple[tuple[str, float], ...]:
    """Causes that could stand in for ``i`` and explain the drive about as well: by their signatures, and then by the pipeline itself."""
    problem, effects = state.problem, state.effects
    others = tuple(j for j in chosen if j != i)
    base, own = problem.gain(others), problem.gain(chosen)
    tolerance = max(_CLOSE, _CLOSE_SHARE * (own - base))
    found: dict[str, tuple[float, int]] = {}
    for j, effect in enumerate(effects):
        if j in chosen or _group(effect) == _group(effects[i]) or any(_group(effect) == _group(effects[k]) for k in others):
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
    best = _true_cost(pipeline, state, _linear_sizes(state, chosen))
    costs = []
    for _, j in found.values():
        sizes, cost = _tried(pipeline, state, _linear_sizes(state, (*others, j)))
        if cost - best <= tolerance:
            costs.append((cost, effects[j].id, sizes[effects[j]]))
    return tuple((name, size) for _, name, size in sorted(costs))


def _linear_sizes(state: _State, subset: tuple[int, ...]) -> dict[Effect, float]:
    return {state.effects[i]: float(v) for i, v in zip(subset, state.problem.fit(subset)[0], strict=True)}


def _pays(gain: Gain, windows: int) -> bool:
    """On windows that sizes were not fitted to. An interval from a few blocks of windows is wider than it says: there a clear gain does."""
    return gain.relative >= _PAYS and (gain.low > 0.0 or (windows < _FEW_WINDOWS and gain.relative > _CLEAR))


def _merged(findings: list[Finding]) -> list[Finding]:
    """Both directions of a slope are one finding."""
    slopes = [f for f in findings if f.cause == "slope"]
    if len(slopes) < 2:
        return findings
    size = math.hypot(slopes[0].size, slopes[1].size)
    whole = dataclasses.replace(slopes[0], size=math.copysign(size, slopes[0].size))
    return [whole if f is slopes[0] else f for f in findings if f is not slopes[1]]


def _components(first: _State, state: _State, left: FloatArray) -> dict[str, Component]:
    """Per channel: what there was, what noise alone makes, and what is left."""
    found = {}
    white = state.noise.whiten(first.rows)
    for c, name in enumerate(CHANNELS):
        known = np.isfinite(first.rows[:, c])
        if not known.any():
            continue
        rms, left_rms = (float(np.sqrt(np.mean(r[known, c] ** 2))) for r in (first.rows, left))
        expected = float(np.sqrt(np.mean(state.noise.sigmas[known, c] ** 2)))
        if c >= 4:
            rms, left_rms = (float(np.std(r[known, c])) for r in (first.rows, left))
        squares = float(np.sum(white[known, c] ** 2)) if c < 4 else float(known.sum())
        found[name] = Component(CHANNEL_UNITS[c], rms, expected, float(chi2.sf(squares, int(known.sum()))), left_rms)
    return found


def _undecidable(drive: Drive, model: MotionModel, why: str) -> Diagnosis:
    advice = general_advice("undecidable", [])
    return Diagnosis(
        *(drive.name, drive.robot.name, model.name, drive.witness, "undecidable", {}, (), ()),
        left_share=0.0,
        next_drive=advice,
        sentence=f"Nothing can be said of {model.name} on this drive: {why} {advice}",
        windows=len(drive.maneuvers),
        notes=drive.notes,
    )
