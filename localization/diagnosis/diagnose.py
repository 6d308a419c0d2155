"""The diagnosis: discrepancies, causes, what they gain, and what is left."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from localization.bounded_settings import Count, Probability, Seed, Settings
from localization.calibration.calibrate import describe_clocks
from localization.diagnosis.causes import FROZEN_ENCODER, MISSING_MESSAGES
from localization.diagnosis.causes.cause import Cause, Hypothesis, with_sizes
from localization.diagnosis.causes.slopes import SHOWN_BY_FORCES
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import Baseline, DrivePredictor, Unmodelled
from localization.diagnosis.findings import (
    MAX_NOISE_OVER_REFERENCE,
    Component,
    Diagnosis,
    Finding,
    Gain,
    confirmed_findings,
    correctable_findings,
    describe_encoder_losses,
    describe_loss,
    describe_standstill_turn,
    evidence,
    noise_notes,
)
from localization.diagnosis.handover import check_findings
from localization.diagnosis.linearization import (
    TOLERANCE,
    Linearization,
    candidate_causes,
    is_skid_steer,
    linearize,
    make_predictor,
)
from localization.diagnosis.missing_terms import find_terms
from localization.diagnosis.model_error import (
    COULOMB_LOG_STIFFNESS,
    MissingSlips,
    explains_more_than_slips,
    find_model_error,
    response_error,
    size_error,
    unmodelled_by,
)
from localization.diagnosis.noise import Noise, reference_sigmas
from localization.diagnosis.result import DiagnosisResult, DriveDiscrepancies
from localization.diagnosis.selection import (
    aliases_of,
    bent_causes,
    has_tolerated_substitute,
    heldout_gain,
    heldout_log_odds,
    is_correction_worse,
    max_statistic,
    p_value,
    problems_without_a_fold,
    refined_cost,
    search_causes,
    simplest_set,
    statistic,
    strongest_beyond_tolerance,
)
from localization.diagnosis.spells import find_spells, with_intervals
from localization.diagnosis.verdict import (
    attribute_rows,
    confirming_drive,
    decide,
    find_better_trends,
    find_outliers,
    find_trends,
    general_advice,
    mark_trends,
    model_error_advice,
    noise_excess,
    separating_drive,
)
from localization.messages import Message, message
from motion_models.base import MotionModel
from motion_models.friction import FrictionModel
from motion_models.se2 import FloatArray

_ROUNDS = 5
_SYSTEMATIC_SHARE = 1.0 / 3.0  # systematic part of a size's sigma, over what is negligible: clocks, mounts and physics are no better
_MIN_HELDOUT_GAIN = 0.003  # least held-out gain of a finding
_SUSPICION = 0.2  # family-wise p of a cause that is mentioned, but not named
_DETECTABLE_SIGMAS = 3.0
_PART_LOG_ODDS = 14.0  # twice the log-odds by which a cause in a part of a drive leads: odds of 1000, as hundreds of parts are tried
_MAX_MOMENT_SHARE = 0.25  # 95 % interval of the moment of an event, over the drive: a payload that is taken up has a tenth
_CONTACTS_LOG_ODDS = 7.0
"""Twice the log-odds by which other contacts than the robot file's have to describe a drive better, beside the best causes of each: odds of
33. MuJoCo's drives gain 9 to 90 (five healthy ones), drives of the simulator lose 32 and 60."""
_MAX_ERROR_SHARE, _FOREIGN_LOG_ODDS = 0.5, 500.0
"""Share of the model's error (twice the log-likelihood of slips by kind of motion) that other contacts may leave, and error that they may
leave anyway, for causes to be searched about them. Drives of MuJoCo, healthy or with hidden causes, have 110 at the most (8 developed on,
16 others); laws that no contact has 2,300 to 40,000, and contacts leave 0.85 of the larger ones and more: such searches took half of a
diagnosis of 40 s of CPU. By 200 or 1,000 none of 20 other drives (nulls, causes and laws) is searched otherwise."""
_MIN_GAPS = 3  # fewer gaps between messages are pauses


@dataclass(frozen=True)
class DiagnosisConfig(Settings):
    """Thresholds of a diagnosis."""

    significance: Probability = 0.01
    """Family-wise probability of naming any cause where there is none."""
    fewest_windows: Count = 8
    """Least number of measured windows; fewer are undecidable."""
    moments: Count = 7
    """Number of moments at which a change of the floor is tried."""
    seed: Seed = 0
    """Seed of the random numbers in tests and intervals."""


def diagnose(drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None, baseline: Baseline | None = None) -> Diagnosis:
    """What is wrong with ``model`` on ``drive``, why, and the gain of correcting it; causes count from ``baseline``, by default the robot
    file (see `localization.diagnosis.baseline`)."""
    return examine(drive, model, config, baseline).diagnosis


def examine(
    drive: Drive,
    model: MotionModel,
    config: DiagnosisConfig | None = None,
    baseline: Baseline | None = None,
    names: Sequence[Cause] | None = None,
) -> DiagnosisResult:
    """Diagnosis as by `diagnose`, with what pictures, patches and other methods start from; of all causes, or of those of ``names``."""
    config = config or DiagnosisConfig()
    if len(drive.maneuvers) < config.fewest_windows:
        return DiagnosisResult(_with_data_errors(_undecidable(drive, model, config), drive), None, None)
    rng = np.random.default_rng(config.seed)
    predictor = make_predictor(drive, model, baseline)
    searched = _search_contacts(predictor, config) if names is None else _with_given(_start(predictor, config), names)
    chosen = _drop_insignificant(searched.linearization, searched.chosen, rng, config)
    if chosen and _is_worse_with(searched.predictor, searched.linearization, chosen):
        searched, chosen = searched._replace(linearization=searched.first), ()
    found = _without_harmful_names(searched, _conclude(searched, chosen, rng, config), config)
    found = _with_confirmed_names(searched, found, config)
    return dataclasses.replace(_without_names_of_terms(searched, found, config), names=names)


def _without_harmful_names(searched: _Searched, found: DiagnosisResult, config: DiagnosisConfig) -> DiagnosisResult:
    """``found`` without names with which windows that were held out get worse, one round after the other."""
    while (check := found.diagnosis.handover) is not None and check.harmful:
        keys = {f.definition.key for f in found.diagnosis.findings if not f.is_counted} - {*check.harmful}
        linearization = searched.linearization if keys else searched.first
        chosen = tuple(i for i, cause in enumerate(linearization.causes) if cause.key in keys)
        if len(chosen) >= sum(not f.is_counted for f in found.diagnosis.findings):
            break
        searched = searched._replace(linearization=linearization)
        found = _conclude(searched, chosen, np.random.default_rng(config.seed), config)
    return found


def _with_confirmed_names(searched: _Searched, found: DiagnosisResult, config: DiagnosisConfig) -> DiagnosisResult:
    """``found`` with the names alone that improve what they were not fitted to, where a part of the drive stays unexplained, and those
    of sizes that no robot has: others stand for what has no name, and what they had taken of it is unexplained as well."""
    d = found.diagnosis
    confirmed = confirmed_findings(d)
    kept = {f.definition.key for f in d.findings if f in confirmed or f.is_counted or not f.is_plausible}
    if d.verdict != "unexplained" or all(f.definition.key in kept for f in d.findings):
        return found
    return _with_names(searched, found, kept, config)


def _without_names_of_terms(searched: _Searched, found: DiagnosisResult, config: DiagnosisConfig) -> DiagnosisResult:
    """``found`` without the names in whose place terms explain the drive better, where a part of it stays unexplained, or where the robot
    file with these names improves nothing: what such a name explains is then the term's."""
    d = found.diagnosis
    named = {f.definition.key for f in d.findings if not f.is_counted}
    is_open = d.verdict == "unexplained" or not d.is_confirmed
    search = find_terms(found, np.random.default_rng(config.seed)) if named and is_open else None
    if search is None or not (search.terms or search.effects):
        return found
    kept = named & {search.state.causes[i].key for i in search.kept}
    return found if kept == named else _with_names(searched, found, kept, config)


def _with_names(searched: _Searched, found: DiagnosisResult, kept: Set[str], config: DiagnosisConfig) -> DiagnosisResult:
    """The diagnosis with the causes alone whose keys are ``kept``, where it stays unexplained; else ``found``."""
    linearization = searched.linearization if kept else searched.first
    chosen = tuple(i for i, cause in enumerate(linearization.causes) if cause.key in kept)
    again = _conclude(searched._replace(linearization=linearization), chosen, np.random.default_rng(config.seed), config)
    return again if again.diagnosis.verdict == "unexplained" else found


def _is_worse_with(predictor: DrivePredictor, linearization: Linearization, chosen: tuple[int, ...]) -> bool:
    """Whether a correction of the causes ``chosen`` alone, at the sizes that are named, makes discrepancies larger than they are."""
    sizes = linearization.problem.fit_by_likelihood(chosen)[0]
    named = with_sizes({linearization.causes[i]: float(size) for i, size in zip(chosen, sizes, strict=True)})
    return is_correction_worse(predictor, linearization.noise, predictor.discrepancies(named))


class _Searched(NamedTuple):
    """A drive in which causes were searched."""

    predictor: DrivePredictor
    first: Linearization
    """About the robot file."""
    linearization: Linearization
    """About the best causes."""
    chosen: tuple[int, ...]
    """Indices of the best causes."""
    error: MissingSlips
    """What the contacts are off beside the best causes."""


def _search_contacts(predictor: DrivePredictor, config: DiagnosisConfig) -> _Searched:
    """The best causes about the contacts that describe the drive best: the robot file's; Coulomb's friction, where the model's error shows;
    and contacts that creep by the speed of the slip, where these describe it better already beside the best causes so far."""
    start = _start(predictor, config)
    found = _search(start)
    if found.error.is_shown and found.predictor.unmodelled.has_stiffness:
        stiff = _start(dataclasses.replace(predictor, unmodelled=Unmodelled(log_stiffness=COULOMB_LOG_STIFFNESS)), config)
        other = _about(stiff, start, found)
        if other.chosen or not _describes_better(other, found):  # else contacts alone explain what causes seemed to
            found = _with_parts(found)
        found = other if _describes_better(other, found) else found
    else:
        found = _with_parts(found)
    if found.predictor.unmodelled.has_stiffness and _costs_less_creeping(found):
        creeping = _start(dataclasses.replace(predictor, unmodelled=Unmodelled(stiffness_exponent=1.0)), config)
        other = _about(creeping, start, found)
        found = other if _describes_better(other, found) else found
    return found


def _start(predictor: DrivePredictor, config: DiagnosisConfig) -> _Searched:
    """The drive about the robot file with the contacts of ``predictor``, before causes are searched."""
    predictor, first, error = _linearize_with_model_error(predictor, config)
    return _Searched(predictor, first, first, (), error)


def _about(new: _Searched, start: _Searched, found: _Searched) -> _Searched:
    """The best causes about the contacts of ``new``, where these may be what those of the ``start`` are off; else the causes of ``found``,
    which were searched from there."""
    if _is_error_less(new, start):
        return _with_parts(_search(new))
    sizes = {
        found.linearization.causes[i]: float(s) for i, s in zip(found.chosen, found.linearization.problem.fit(found.chosen)[0], strict=True)
    }
    lasting = {cause: size for cause, size in sizes.items() if cause.spell is None}
    index = {cause.key: i for i, cause in enumerate(new.first.causes)}
    linearization = linearize(new.predictor, new.first.causes, lasting, TOLERANCE)
    return _with_error(new._replace(linearization=linearization, chosen=tuple(sorted(index[cause.key] for cause in lasting))))


def _is_error_less(new: _Searched, old: _Searched) -> bool:
    """Whether the contacts of ``new`` may be what those of ``old`` are off: beside them and all causes at any plausible size less than half
    of the model's error is left, or not clearly more than a wrong contact leaves."""
    return new.error.log_odds < max(_MAX_ERROR_SHARE * old.error.log_odds, _FOREIGN_LOG_ODDS)


def _with_given(start: _Searched, names: Sequence[Cause]) -> _Searched:
    """The causes of ``names`` about the contacts of the ``start``, with those that hold in a part of the drive, at the sizes that it
    shows."""
    known = {cause.key for cause in start.first.causes}
    causes = (*start.first.causes, *(cause for cause in names if cause.key not in known and cause.spell is not None))
    state = linearize(start.predictor, causes, {}, TOLERANCE)
    chosen = tuple(i for i, cause in enumerate(causes) if cause.key in {named.key for named in names})
    sizes = {causes[i]: float(np.clip(s, *causes[i].bounds)) for i, s in zip(chosen, state.problem.fit(chosen)[0], strict=True)}
    return start._replace(linearization=linearize(start.predictor, causes, sizes, TOLERANCE), chosen=chosen)


def _search(start: _Searched) -> _Searched:
    """The best lasting causes from the ``start``."""
    linearization, chosen = _choose_causes(start.predictor, start.first)
    return _with_error(start._replace(linearization=linearization, chosen=chosen))


def _with_parts(searched: _Searched) -> _Searched:
    """``searched`` with causes in a part of the drive, where these explain it better."""
    linearization, chosen = _choose_parts(searched.predictor, searched.first, searched.linearization, searched.chosen)
    if linearization is searched.linearization:
        return searched
    return _with_error(searched._replace(linearization=linearization, chosen=chosen))


def _with_error(searched: _Searched) -> _Searched:
    """``searched`` with the error of the contacts about its causes, where it shows: the bent signature of a large cause looks like one."""
    if not searched.error.is_shown:
        return searched
    searched = searched._replace(error=find_model_error(searched.predictor, searched.linearization))
    return searched if searched.error.is_shown or not searched.chosen else _without_slips(searched)


def _without_slips(searched: _Searched) -> _Searched:
    """``searched`` without slips of other contacts, where each of its causes explains the drive clearly better than these do: a centre of
    gravity 30 mm farther back turned a Jackal by so much less that it looked like other contacts about the robot file.
    """
    predictor, state = searched.predictor, searched.linearization
    if not explains_more_than_slips(predictor, state, searched.chosen):
        return searched
    plain = dataclasses.replace(predictor, unmodelled=dataclasses.replace(predictor.unmodelled, slip_share=0.0))
    sizes = {state.causes[i]: float(s) for i, s in zip(searched.chosen, state.problem.fit(searched.chosen)[0], strict=True)}
    first, about = (linearize(plain, causes, at, TOLERANCE) for causes, at in ((searched.first.causes, {}), (state.causes, sizes)))
    return searched._replace(predictor=plain, first=first, linearization=about)


def _costs_less_creeping(searched: _Searched) -> bool:
    """Whether contacts that creep describe the drive better than those of ``searched``, beside the same causes."""
    predictor, state = searched.predictor, searched.linearization
    creeping = dataclasses.replace(predictor.unmodelled, log_stiffness=0.0, stiffness_exponent=1.0)
    causes = tuple(state.causes[i] for i in searched.chosen)
    sizes = dict(zip(causes, (float(s) for s in state.problem.fit(searched.chosen)[0]), strict=True))
    tried = dataclasses.replace(predictor, unmodelled=creeping)
    other = dataclasses.replace(linearize(tried, state.causes, {}, TOLERANCE), noise=state.noise)
    return refined_cost(tried, other, sizes) < refined_cost(predictor, state, sizes)


def _describes_better(new: _Searched, old: _Searched) -> bool:
    """Whether the contacts and causes of ``new`` describe the drive clearly better than those of ``old``, by the noise of either."""

    def cost(searched: _Searched, noise: Noise) -> float:
        state = dataclasses.replace(searched.linearization, noise=noise)
        sizes = state.problem.fit(searched.chosen)[0]
        return refined_cost(searched.predictor, state, {state.causes[i]: float(s) for i, s in zip(searched.chosen, sizes, strict=True)})

    return all(cost(new, noise) < cost(old, noise) - _CONTACTS_LOG_ODDS for noise in (old.linearization.noise, new.linearization.noise))


def _linearize_with_model_error(predictor: DrivePredictor, config: DiagnosisConfig) -> tuple[DrivePredictor, Linearization, MissingSlips]:
    """The drive about the robot file, beside what the friction model is off on other contacts; a healthy drive shows that, so that nothing
    is added to its baseline."""
    drive = predictor.drive
    is_searched = predictor.model.name == FrictionModel.name and is_skid_steer(drive.robot) and drive.kind in ("log", "windows")
    if not is_searched or predictor.has_baseline:
        return predictor, linearize(predictor, candidate_causes(predictor, config.moments), {}, TOLERANCE), MissingSlips(0.0, 0.0)
    predictor = dataclasses.replace(predictor, unmodelled=dataclasses.replace(predictor.unmodelled, has_stiffness=True))
    causes = candidate_causes(predictor, config.moments)
    first = linearize(predictor, causes, {}, TOLERANCE)
    error = find_model_error(predictor, first)
    if unmodelled_by(predictor, error) != predictor.unmodelled:
        predictor = dataclasses.replace(predictor, unmodelled=unmodelled_by(predictor, error))
        first = linearize(predictor, causes, {}, TOLERANCE)
    return predictor, first, error


def _choose_causes(predictor: DrivePredictor, first: Linearization) -> tuple[Linearization, tuple[int, ...]]:
    """The best set of causes, and the drive linearized about a hypothesis that hardly differs from it."""
    causes, linearization, bent = first.causes, first, bent_causes(predictor, first)
    current: dict[Cause, float] = {}
    visited: list[dict[Cause, float]] = []
    visited_keys: list[frozenset[str]] = []
    for _ in range(_ROUNDS):
        sizes = search_causes(predictor, linearization, bent)
        keys = frozenset(e.key for e in sizes)
        if keys == frozenset(e.key for e in current):
            break
        current = sizes
        visited.append(sizes)
        linearization = linearize(predictor, causes, current, TOLERANCE)
        if keys in visited_keys:
            break
        visited_keys.append(keys)
    if len(visited) > 1:  # later rounds need not be better: all sets that were preferred once are compared by one noise
        tried = [(refined_cost(predictor, linearization, sizes), sizes) for sizes in visited]
        best = simplest_set(tried, refined_cost(predictor, linearization, {}), predictor)
        if set(best) != set(current):
            current = best
            linearization = linearize(predictor, causes, current, TOLERANCE)
    index = {e.key: i for i, e in enumerate(causes)}
    return linearization, tuple(sorted(index[e.key] for e in current))


def _choose_parts(
    predictor: DrivePredictor, first: Linearization, linearization: Linearization, chosen: tuple[int, ...]
) -> tuple[Linearization, tuple[int, ...]]:
    """The drive and the causes ``chosen`` on it, or the best set with causes in a part of the drive, where these explain it better."""
    spells = find_spells(predictor, linearization, chosen)
    if not spells:
        return linearization, chosen
    state, best = _choose_causes(predictor, linearize(predictor, (*first.causes, *spells), {}, TOLERANCE))
    if not any(state.causes[i].spell for i in best):
        return linearization, chosen
    more = find_spells(predictor, state, best)
    if more:
        kept = [state.causes[i] for i in best if state.causes[i].spell]
        state, best = _choose_causes(predictor, linearize(predictor, (*first.causes, *kept, *more), {}, TOLERANCE))
    located = with_intervals(predictor, state, best)
    if not located or _is_error_of_contacts(predictor, state, best, located.values()):
        return linearization, chosen
    causes = tuple(located.get(i, cause) for i, cause in enumerate(state.causes))
    sizes = {causes[i]: float(size) for i, size in zip(best, state.problem.fit(best)[0], strict=True)}
    return linearize(predictor, causes, sizes, TOLERANCE), best


def _is_error_of_contacts(predictor: DrivePredictor, state: Linearization, chosen: tuple[int, ...], located: Iterable[Cause]) -> bool:
    """Whether those of ``chosen`` that hold in a part of the drive may be errors of the contacts, which differ from part to part, as its
    motions do: they gain no more than such errors still do beside them, or have no moment (``located``), as an event has."""
    if not predictor.unmodelled.slip_share:
        return False
    whole = float(predictor.window_times_s[1][-1])
    widths = [high - low for cause in located if cause.spell_95 is not None for low, high in cause.spell_95 if high < math.inf]
    if max(widths, default=0.0) > _MAX_MOMENT_SHARE * whole:
        return True
    error = find_model_error(predictor, state)
    lasting = tuple(i for i in chosen if state.causes[i].spell is None)
    return error.is_shown and state.problem.gain(chosen) - state.problem.gain(lasting) < error.log_odds + _PART_LOG_ODDS


def _drop_insignificant(
    linearization: Linearization, chosen: tuple[int, ...], rng: np.random.Generator, config: DiagnosisConfig
) -> tuple[int, ...]:
    """``chosen`` without causes that are not significant."""
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


def _conclude(searched: _Searched, chosen: tuple[int, ...], rng: np.random.Generator, config: DiagnosisConfig) -> DiagnosisResult:
    """Findings, the table with its attributions, and the verdict that follows from it."""
    predictor, first, linearization, _, error = searched
    drive, problem, causes = predictor.drive, linearization.problem, linearization.causes
    stated = reference_sigmas(predictor) if drive.kind == "log" else None
    excess = [noise_excess(linearization, stated, np.isfinite(first.rows[:, c]), c) for c in range(3)]
    is_noise_own = max(excess) <= MAX_NOISE_OVER_REFERENCE and not predictor.unmodelled.slip_share
    chosen, gains, dropped = _keep_useful(linearization, chosen, config, is_noise_own)
    sizes, gained = problem.fit_by_likelihood(chosen)[0], problem.gain(chosen)
    findings = _make_findings(predictor, linearization, chosen, gains, rng)
    has_other_contacts = error.is_shown or any(predictor.unmodelled.contacts)
    if has_other_contacts:
        findings = [dataclasses.replace(f, sigma=math.hypot(f.sigma, size_error(predictor, f.definition))) for f in findings]
    by_contacts = _by_contacts(predictor, first)
    rows = attribute_rows(first, linearization, chosen, sizes, config.significance, stated, by_contacts)
    left = linearization.linear - linearization.signatures[..., list(chosen)] @ sizes
    spreads = problem.scale * np.where(np.isin(np.arange(len(causes)), chosen), 1.0, problem.tolerance)
    trends, left_gain = find_trends(predictor, linearization.noise, left, linearization.signatures, linearization.nuisances, spreads, rng)
    share = left_gain / max(left_gain + gained, 1e-9) if trends else 0.0
    trends = (*find_better_trends(predictor, linearization, chosen), *trends)
    detectable = _detectable_sizes(linearization)
    undetectable = [e for e in causes if detectable[e.id] > e.typical]
    rows = mark_trends(rows, trends, share, bool(findings))
    verdict = decide(findings, tuple(rows.values()), len(undetectable) / max(len(causes), 1))
    suspected = _suspect(predictor, linearization, rng) if verdict == "consistent" and not findings else None
    if suspected is not None:
        next_drive = suspected[1]
    elif findings:
        next_drive = separating_drive(predictor, findings)
    else:
        next_drive = general_advice(verdict, [e.id for e in undetectable if e.id not in SHOWN_BY_FORCES])
    if has_other_contacts:
        next_drive = f"{next_drive} {model_error_advice(findings)}".strip()
    within = {**dropped, **_within_tolerance(linearization, chosen, sizes, rows)}
    result = Diagnosis(
        *(drive.name, drive.robot.name, predictor.model.name, drive.motion_reference, verdict, rows, tuple(findings), trends),
        left_share=share,
        next_drive=next_drive,
        within=within,
        tolerances={e.id: e.negligible for e in causes if e.id in within},
        detectable_sizes=detectable,
        gain=_heldout(linearization, chosen, (), config) if chosen else None,
        outliers_s=tuple(float(t) for t in drive.starts_s[predictor.batch.owner][find_outliers(linearization)]),
        windows=len(drive.maneuvers),
        warnings=(*_clock_warnings(predictor, findings), *noise_notes(rows), *_contact_notes(predictor, error), *drive.warnings),
        suspected=None if suspected is None else suspected[0],
        joint_p=problem.joint_p(chosen, sizes),
    )
    named = [f.definition.key for f in correctable_findings(result)] or [causes[i].key for i in chosen]
    result = dataclasses.replace(result, handover=check_findings(predictor, linearization, named))
    result = _with_data_errors(result, drive)
    residuals = DriveDiscrepancies(first.rows + by_contacts, left + by_contacts, linearization.noise.sigmas)
    return DiagnosisResult(result, predictor, residuals, linearization)


def _by_contacts(predictor: DrivePredictor, first: Linearization) -> FloatArray:
    """(M, 6) by how much discrepancies by the robot file are more than those by the contacts about which the drive is linearized."""
    if predictor.by_file is predictor:
        return np.zeros_like(first.rows)
    return predictor.by_file.discrepancies(Hypothesis()) - first.rows


def _contact_notes(predictor: DrivePredictor, error: MissingSlips) -> tuple[Message, ...]:
    """That the contacts are not those of the robot file, or not those of the friction model."""
    if predictor.unmodelled.stiffness_exponent:
        return message("contacts.creep"), *error.notes
    if not predictor.unmodelled.log_stiffness:
        return error.notes
    return message("contacts.stiff", times=math.exp(predictor.unmodelled.log_stiffness)), *error.notes


def _clock_warnings(predictor: DrivePredictor, findings: Sequence[Finding]) -> tuple[Message, ...]:
    """Where headings or positions alone give the wheels another clock than ``findings`` do."""
    shifts = [(predictor.wheel_shift(with_sizes({f.definition: f.size})), f.sigma) for f in findings if f.definition.is_clock]
    offset, sigma = sum(shift for shift, _ in shifts), math.hypot(*(sigma for shift, sigma in shifts if shift))
    if not offset or predictor.drive.kind != "log":
        return ()
    found = describe_clocks(offset, sigma, predictor.drive.maneuvers, predictor.drive.robot)
    return () if found is None else (found,)


def _heldout(linearization: Linearization, chosen: tuple[int, ...], others: tuple[int, ...], config: DiagnosisConfig) -> Gain:
    return heldout_gain(linearization, chosen, others, np.random.default_rng(config.seed))


def _keep_useful(
    linearization: Linearization, chosen: tuple[int, ...], config: DiagnosisConfig, is_noise_own: bool
) -> tuple[tuple[int, ...], list[Gain], dict[str, tuple[float, float]]]:
    """``chosen`` without those within tolerance, those for which another cause within its tolerance would do, and those that do not predict
    windows to which they were not fitted; the gain of each; size and sigma of those within tolerance.

    In short drives tolerated differences mask the gain in discrepancies, but not in likelihood, if the noise is that of the reference
    and the contacts are the model's.
    """
    within: dict[str, tuple[float, float]] = {}
    causes, problem = linearization.causes, linearization.problem
    largest = np.array([e.negligible for e in causes])
    folds = problems_without_a_fold(linearization)
    while True:
        sizes, cov, _ = problem.fit(chosen)
        without = [tuple(j for j in chosen if j != i) for i in chosen]
        gains = [_heldout(linearization, chosen, others, config) for others in without]
        odds = [heldout_log_odds(problem, folds, chosen, others) for others in without]
        tolerated = [
            abs(size) < largest[i] or has_tolerated_substitute(linearization, chosen, i, largest)
            for size, i in zip(sizes, chosen, strict=True)
        ]
        predicts = [_is_gain_significant(gain) or (is_noise_own and odd > 0.0) for gain, odd in zip(gains, odds, strict=True)]
        small = [n for n in range(len(chosen)) if tolerated[n] or not predicts[n]]
        if not small:
            return chosen, gains, within
        worst = min(small, key=lambda n: odds[n])
        if abs(sizes[worst]) < largest[chosen[worst]]:
            within[causes[chosen[worst]].id] = float(sizes[worst]), float(math.sqrt(cov[worst, worst]))
        chosen = tuple(i for n, i in enumerate(chosen) if n != worst)


def _make_findings(
    predictor: DrivePredictor, linearization: Linearization, chosen: tuple[int, ...], gains: list[Gain], rng: np.random.Generator
) -> list[Finding]:
    """Findings, strongest evidence first; ``gains`` by windows that were held out."""
    problem, causes = linearization.problem, linearization.causes
    sizes, cov = problem.fit_by_likelihood(chosen)
    found: list[tuple[float, Finding]] = []
    for n, i in enumerate(chosen):
        cause, size = causes[i], float(sizes[n])
        sigma = math.hypot(math.sqrt(cov[n, n]), _SYSTEMATIC_SHARE * cause.negligible, response_error(predictor, cause, size))
        if cause.id == "encoder_dropout":  # spells of random length: the share is as certain as they are many
            sigma = math.hypot(sigma, size * math.sqrt(2.0 / max(predictor.dropout_count, 2)))
        others = tuple(j for j in chosen if j != i)
        p = _p_value(linearization, others, i, rng)
        aliases = aliases_of(predictor, linearization, chosen, i)
        gained = problem.gain(chosen) - problem.gain(others)
        text = evidence(cause, linearization.signatures[..., i] * size, linearization.noise, gained)
        moves = {causes[j].id: float(cov[n, m] / cov[m, m] * sizes[m]) for m, j in enumerate(chosen) if m != n}
        found.append((gained, Finding(cause, size, sigma, p, aliases, text, gains[n], moves)))
    return [finding for _, finding in sorted(found, key=lambda pair: pair[0], reverse=True)]


def _suspect(predictor: DrivePredictor, linearization: Linearization, rng: np.random.Generator) -> tuple[Finding, str] | None:
    """The strongest cause, where nothing is named and fewer healthy drives than `_SUSPICION` would show one as strong; and the drive that
    would settle it, in words."""
    i, p = strongest_beyond_tolerance(linearization.problem, rng, linearization.noise.freedom)
    if p > _SUSPICION:
        return None
    found = _make_findings(predictor, linearization, (i,), [heldout_gain(linearization, (i,), (), rng)], rng)[0]
    is_tolerated = abs(found.size) < found.definition.negligible
    if is_tolerated or not found.is_plausible or (found.definition.one_sided and found.size < 0.0):
        return None
    return dataclasses.replace(found, p_value=p), confirming_drive(predictor, linearization, i, found.size)


def _detectable_sizes(linearization: Linearization) -> dict[str, float]:
    found: dict[str, float] = {}
    for cause, size in zip(linearization.causes, linearization.problem.detectable_sizes(_DETECTABLE_SIGMAS), strict=True):
        found[cause.id] = min(found.get(cause.id, math.inf), float(size))
    return found


def _within_tolerance(
    linearization: Linearization, chosen: tuple[int, ...], named: FloatArray, rows: Mapping[str, Component]
) -> dict[str, tuple[float, float]]:
    """Size and sigma of the causes that are not named, beside the sizes ``named`` (k,), and yet account for a part of a significant row."""
    listed = {a.cause for row in rows.values() for a in row.attributions if not a.is_named}
    sizes, sigmas = linearization.problem.tolerated(chosen, named), linearization.problem.posterior_sigmas(chosen)
    found: dict[str, tuple[float, float]] = {}
    for i, cause in enumerate(linearization.causes):
        if cause.id in listed and i not in chosen and abs(sizes[i]) > abs(found.get(cause.id, (0.0, 0.0))[0]):
            found[cause.id] = float(sizes[i]), float(sigmas[i])
    return found


def _with_data_errors(d: Diagnosis, drive: Drive) -> Diagnosis:
    """``d`` with what was counted where the log was read as findings, and without a consistent verdict where
    measurements contradict each other."""
    verdict, findings = d.verdict, (*_counted_findings(d, drive), *d.findings)
    verdict = "explained" if verdict == "consistent" and (findings or drive.set_up) else verdict
    contradictions = () if drive.standstill_turn is None else (describe_standstill_turn(drive.standstill_turn),)
    if contradictions and verdict == "consistent":
        verdict = "unexplained"
    suspected, next_drive = (d.suspected, d.next_drive) if verdict == d.verdict or d.suspected is None else (None, "")
    return dataclasses.replace(
        d,
        verdict=verdict,
        findings=findings,
        contradictions=contradictions,
        suspected=suspected,
        next_drive=next_drive,
        set_up=drive.set_up,
    )


def _counted_findings(d: Diagnosis, drive: Drive) -> list[Finding]:
    """Missing messages, and the encoder that lost most, beyond what is tolerated; their shares are as certain as their spells are many."""
    loss, frozen = drive.message_loss, sorted(drive.encoder_losses, key=lambda one: -one.share)
    shares = []
    if loss is not None and loss.gaps >= _MIN_GAPS:
        shares.append((MISSING_MESSAGES, loss.share, loss.gaps, describe_loss(loss)))
    if frozen:
        shares.append((FROZEN_ENCODER, frozen[0].share, frozen[0].spells, describe_encoder_losses(frozen)))
    none = Gain(*(float("nan"),) * 2, 0.0, 0.0, 0.0) if d.gain is None else Gain(d.gain.after, d.gain.after, 0.0, 0.0, 0.0)
    return [
        Finding(cause, share, share * math.sqrt(2.0 / spells), 0.0, (), text, none)
        for cause, share, spells, text in shares
        if share > cause.negligible
    ]


def _is_gain_significant(gain: Gain) -> bool:
    """On windows that sizes were not fitted to."""
    return gain.relative >= _MIN_HELDOUT_GAIN and gain.low > 0.0


def _undecidable(drive: Drive, model: MotionModel, config: DiagnosisConfig) -> Diagnosis:
    why = f"only {len(drive.maneuvers)} windows of motion were measured; it takes {config.fewest_windows}."
    return Diagnosis(
        *(drive.name, drive.robot.name, model.name, drive.motion_reference, "undecidable", {}, (), ()),
        left_share=0.0,
        next_drive=general_advice("undecidable", []),
        windows=len(drive.maneuvers),
        warnings=drive.warnings,
        too_little=drive.warnings[0] if drive.motion_reference == "none" else why,
    )
