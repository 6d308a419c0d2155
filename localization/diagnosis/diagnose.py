"""The diagnosis: discrepancies, causes, what they gain, and what is left."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from localization.diagnosis.causes import Cause
from localization.diagnosis.drive import Drive
from localization.diagnosis.findings import Component, Diagnosis, Finding, Gain, Verdict
from localization.diagnosis.linearization import Linearization, candidate_causes, linearize, make_predictor, with_tolerance
from localization.diagnosis.prediction import CHANNEL_UNITS, CHANNELS, DrivePredictor, with_sizes
from localization.diagnosis.recommendations import general_advice, separating_drive
from localization.diagnosis.selection import aliases_of, refined_cost, search_causes
from localization.diagnosis.subset_selection import heldout_gain, max_statistic, p_value, statistic
from localization.diagnosis.summary import evidence, sentence
from localization.diagnosis.trends import find_trends
from localization.settings import Count, Probability, Seed, Settings
from motion_models.base import MotionModel
from motion_models.se2 import FloatArray

_ROUNDS = 5
TOLERANCES = (0.35, 0.1)  # sigma of causes that nobody names, over what is negligible: first as robots are, then as files say
_STRICT_FACTOR = 2.0  # with the stricter of them, sizes must be so many times what is negligible
_SYSTEMATIC_SHARE = 1.0 / 3.0  # systematic part of a size's sigma, over what is negligible: clocks, mounts and physics are no better
_MIN_HELDOUT_GAIN = 0.003  # least held-out gain of a finding
_CLEAR_HELDOUT_GAIN = 0.05
_FEW_WINDOWS = 64


@dataclass(frozen=True)
class DiagnosisConfig(Settings):
    """How sure a diagnosis must be."""

    significance: Probability = 0.01
    """Family-wise probability of naming any cause where there is none."""
    fewest_windows: Count = 8
    """Fewer measured windows than this decide nothing."""
    moments: Count = 9
    """At how many moments a change of the floor is looked for."""
    seed: Seed = 0
    """Of the random numbers in tests and intervals."""


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
class DiagnosisResult:
    """A diagnosis and what it was made of."""

    diagnosis: Diagnosis
    predictor: DrivePredictor | None
    """None where there was too little to look at."""
    residuals: Residuals | None
    linearization: Linearization | None = None
    """The last look at the drive: its signatures, and its noise."""


def diagnose(drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None) -> Diagnosis:
    """What is wrong with ``model`` on ``drive``, why, and what saying so gains."""
    return examine(drive, model, config).diagnosis


def examine(drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None) -> DiagnosisResult:
    """The same, with what pictures, patches and other methods start from."""
    config = config or DiagnosisConfig()
    if len(drive.maneuvers) < config.fewest_windows:
        why = f"only {len(drive.maneuvers)} windows of motion were measured; it takes {config.fewest_windows}."
        return DiagnosisResult(_undecidable(drive, model, drive.warnings[0] if drive.motion_reference == "none" else why), None, None)
    predictor = make_predictor(drive, model)
    causes = candidate_causes(predictor, config.moments)
    first = linearize(predictor, causes, {}, TOLERANCES[0])
    found = _diagnose_within(predictor, first, config)
    if found.diagnosis.verdict == "consistent":  # within what robots are: is it what their files say?
        strict = _diagnose_within(predictor, with_tolerance(first, TOLERANCES[1]), config)
        if strict.diagnosis.verdict != "consistent":
            return strict
    return found


def _diagnose_within(predictor: DrivePredictor, first: Linearization, config: DiagnosisConfig) -> DiagnosisResult:
    """With everything that is not named within the tolerance of the ``first`` look."""
    rng = np.random.default_rng(config.seed)
    causes, tolerance = first.causes, first.tolerance
    linearization = first
    current: dict[Cause, float] = {}
    visited: list[dict[Cause, float]] = []
    visited_keys: list[frozenset[str]] = []
    for _ in range(_ROUNDS):
        sizes = search_causes(predictor, linearization)
        keys = frozenset(e.key for e in sizes)
        if keys == frozenset(e.key for e in current):
            break
        current = sizes
        visited.append(sizes)
        linearization = linearize(predictor, causes, current, tolerance)
        if keys in visited_keys:
            break
        visited_keys.append(keys)
    if len(visited) > 1:  # later looks need not be better: all that were preferred once are compared by one noise
        best = min(visited, key=lambda sizes: refined_cost(predictor, linearization, sizes))
        if set(best) != set(current):
            current = best
            linearization = linearize(predictor, causes, current, tolerance)
    index = {e.key: i for i, e in enumerate(causes)}
    chosen = _drop_insignificant(linearization, tuple(sorted(index[e.key] for e in current)), rng, config)
    return _conclude(predictor, first, linearization, chosen, rng, config)


def _drop_insignificant(
    linearization: Linearization, chosen: tuple[int, ...], rng: np.random.Generator, config: DiagnosisConfig
) -> tuple[int, ...]:
    """``chosen``, less what does not stand up to the test."""
    while chosen:
        p = []
        for i in chosen:
            others = tuple(j for j in chosen if j != i)
            p.append(_p_value(linearization, others, i, rng))
        worst = int(np.argmax(p))
        if p[worst] <= config.significance:
            break
        chosen = tuple(i for n, i in enumerate(chosen) if n != worst)
    return chosen


def _p_value(linearization: Linearization, others: tuple[int, ...], i: int, rng: np.random.Generator) -> float:
    df = linearization.noise.freedom
    return p_value(statistic(linearization.problem, others, i), max_statistic(linearization.problem, others, rng, df), df)


def _conclude(
    predictor: DrivePredictor,
    first: Linearization,
    linearization: Linearization,
    chosen: tuple[int, ...],
    rng: np.random.Generator,
    config: DiagnosisConfig,
) -> DiagnosisResult:
    drive, problem, causes = predictor.drive, linearization.problem, linearization.causes

    def held(with_these: tuple[int, ...], without: tuple[int, ...]) -> Gain:
        data = linearization.linear, linearization.signatures, linearization.nuisances, linearization.noise, problem.scale
        return heldout_gain(*data, with_these, without, np.random.default_rng(config.seed))

    within: dict[str, tuple[float, float]] = {}
    least = 1.0 if linearization.tolerance >= TOLERANCES[0] else _STRICT_FACTOR
    while chosen:  # what nobody would correct, or does not pay where its size was not fitted to, is not named
        sizes, cov, _ = problem.fit(chosen)
        gains = [held(chosen, tuple(j for j in chosen if j != i)) for i in chosen]
        small = [
            n
            for n, i in enumerate(chosen)
            if abs(sizes[n]) < least * causes[i].negligible or not _is_gain_significant(gains[n], len(linearization.rows))
        ]
        if not small:
            break
        worst = min(small, key=lambda n: gains[n].relative)
        within[causes[chosen[worst]].id] = float(sizes[worst]), float(math.sqrt(cov[worst, worst]))
        chosen = tuple(i for n, i in enumerate(chosen) if n != worst)
    sizes, cov, gained = problem.fit(chosen)
    findings = []
    for n, i in enumerate(chosen):
        cause, size = causes[i], float(sizes[n])
        sigma = math.hypot(math.sqrt(cov[n, n]), _SYSTEMATIC_SHARE * cause.negligible)
        if cause.id == "encoder_dropout":  # a share that comes in spells of random length is as sure as there were many
            sigma = math.hypot(sigma, size * math.sqrt(2.0 / max(predictor.dropout_count, 2)))
        others = tuple(j for j in chosen if j != i)
        p = _p_value(linearization, others, i, rng)
        aliases = aliases_of(predictor, linearization, chosen, i)
        text = evidence(cause, linearization.signatures[..., i] * size, linearization.noise, problem.gain(chosen) - problem.gain(others))
        findings.append(Finding(cause, size, sigma, p, aliases, text, gains[n]))
    findings.sort(key=lambda f: f.gain.relative, reverse=True)
    total = held(chosen, ()) if chosen else None
    findings = _merge_slopes(findings)
    left = linearization.linear - linearization.signatures[..., list(chosen)] @ sizes
    spreads = problem.scale * np.where(np.isin(np.arange(len(causes)), chosen), 1.0, problem.tolerance)
    found_trends, left_gain = find_trends(
        predictor, linearization.noise, left, linearization.signatures, linearization.nuisances, spreads, rng
    )
    share = left_gain / max(left_gain + gained, 1e-9) if found_trends else 0.0
    detectable_sizes: dict[str, float] = {}
    for i, cause in enumerate(causes):
        size = 3.0 * problem.scale[i] / math.sqrt(problem.gram[i, i] + 1.0)
        detectable_sizes[cause.id] = min(detectable_sizes.get(cause.id, math.inf), float(size))
    undetectable = [e for e in causes if detectable_sizes[e.id] > e.typical]
    verdict: Verdict
    if found_trends and (not findings or share > 0.3):
        verdict = "unexplained"
    elif any(f.aliases for f in findings):
        verdict = "ambiguous"
    elif findings:
        verdict = "explained"
    elif len(undetectable) > 0.5 * len(causes):
        verdict = "undecidable"
    else:
        verdict = "consistent"
    discrepancy = _components(first, linearization, left)
    drive_next = (
        separating_drive(predictor, findings, linearization, chosen) if findings else general_advice(verdict, [e.id for e in undetectable])
    )
    hypothesis = with_sizes({f.definition: f.size for f in findings})
    result = Diagnosis(
        *(drive.name, drive.robot.name, predictor.model.name, drive.motion_reference, verdict, discrepancy, tuple(findings), found_trends),
        left_share=share,
        next_drive=drive_next,
        sentence="",
        within=within,
        detectable_sizes=detectable_sizes,
        gain=total,
        windows=len(drive.maneuvers),
        warnings=drive.warnings,
        hypothesis=hypothesis,
    )
    scale = np.sqrt(np.diagonal(problem.gram) + 1e-12)
    alike = problem.gram / np.outer(scale, scale)
    residuals = Residuals(first.rows, left, linearization.noise.sigmas, tuple(e.key for e in causes), alike)
    return DiagnosisResult(dataclasses.replace(result, sentence=sentence(result)), predictor, residuals, linearization)


def _is_gain_significant(gain: Gain, windows: int) -> bool:
    """On windows that sizes were not fitted to. An interval from a few blocks of windows is wider than it says: there a clear gain does."""
    return gain.relative >= _MIN_HELDOUT_GAIN and (gain.low > 0.0 or (windows < _FEW_WINDOWS and gain.relative > _CLEAR_HELDOUT_GAIN))


def _merge_slopes(findings: list[Finding]) -> list[Finding]:
    """Both directions of a slope are one finding."""
    slopes = [f for f in findings if f.cause == "slope"]
    if len(slopes) < 2:
        return findings
    size = math.hypot(slopes[0].size, slopes[1].size)
    whole = dataclasses.replace(slopes[0], size=math.copysign(size, slopes[0].size))
    return [whole if f is slopes[0] else f for f in findings if f is not slopes[1]]


def _components(first: Linearization, linearization: Linearization, left: FloatArray) -> dict[str, Component]:
    """Per channel: what there was, what noise alone makes, and what is left."""
    found = {}
    white = linearization.noise.whiten(first.rows)
    for c, name in enumerate(CHANNELS):
        known = np.isfinite(first.rows[:, c])
        if not known.any():
            continue
        rms, left_rms = (float(np.sqrt(np.mean(r[known, c] ** 2))) for r in (first.rows, left))
        expected = float(np.sqrt(np.mean(linearization.noise.sigmas[known, c] ** 2)))
        if c >= 4:
            rms, left_rms = (float(np.std(r[known, c])) for r in (first.rows, left))
        squares = float(np.sum(white[known, c] ** 2)) if c < 4 else float(known.sum())
        found[name] = Component(CHANNEL_UNITS[c], rms, expected, float(chi2.sf(squares, int(known.sum()))), left_rms)
    return found


def _undecidable(drive: Drive, model: MotionModel, why: str) -> Diagnosis:
    advice = general_advice("undecidable", [])
    return Diagnosis(
        *(drive.name, drive.robot.name, model.name, drive.motion_reference, "undecidable", {}, (), ()),
        left_share=0.0,
        next_drive=advice,
        sentence=f"Nothing can be said of {model.name} on this drive: {why} {advice}",
        windows=len(drive.maneuvers),
        warnings=drive.warnings,
    )
