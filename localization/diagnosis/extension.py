"""A motion model that is extended by terms: found on a drive, written to a robot file, read again, and replayed on the half held out.

The gate is that of all corrections (`gate`): with sizes and coefficients of one half of the drive alone the file is written, read from
disk, and predicts and replays the windows of the other half, or those of other drives. Each term, effect and cause has to improve held-out
windows beside all others, and terms have to hold in kinds of motion to which they were not fitted. The file that a user gets has the
coefficients of all windows.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.corrected_robot import CorrectedRobot, correct_robot
from localization.diagnosis.diagnose import DiagnosisConfig, examine
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.findings import Attribution, Component
from localization.diagnosis.gate import (
    CLEAR_SIGMAS,
    HandoverCheck,
    HeldRows,
    compare_rows,
    find_supported,
    folds,
    interleaved_halves,
    reason,
)
from localization.diagnosis.handover import CandidateRobot, Reader, check_written
from localization.diagnosis.missing_terms import SEARCHED, Search, extended_model, find_terms, fit_on, merge_terms, terms_of
from localization.diagnosis.model_extension import Extension, FoundTerm
from localization.diagnosis.result import DiagnosisResult
from localization.events import Turn
from localization.inputs.gyro import GyroRecord
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.maneuvers import IntArray
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_FEWEST_WINDOWS = 16
"""Fewest windows of a drive: eight in each half, as many as a diagnosis takes."""
_FEWEST_OF_A_KIND = 4
"""Fewest windows of a kind of motion that is held out."""
_MAX_RELATIVE_SIGMA = 0.5
"""Sigma of a coefficient over its size on the whole drive, up to which the other kinds of motion measure it."""
_ACTING = 9.0
"""Squares of what terms do in a kind of motion, over its noise, from which on it tests them: three sigma. Where they do nothing, before and
after are equal."""
_TURNING_SHARE = 0.35
"""Half the angle between (q_l + q_r, q_r - q_l) and its axis in which a motion is straight, or a turn in place [rad]: gentle arcs, of
which the sides differ by a quarter, lie at its edge."""
_NS = 1e-9
_CHANNEL_OF = {"vx": "x", "vy": "y", "wz": "yaw"}


@dataclass(frozen=True)
class ExtendedResult:
    """A diagnosis with the model extended, where that is better; and what was found."""

    found: DiagnosisResult
    """Diagnosis with the extended model, where its file is better on the half held out; else with the plain one."""
    extension: Extension | None
    """None where no term explains the drive."""
    robot: Robot | None = None
    """The robot with terms and findings, where its file is better."""


def extend(
    found: DiagnosisResult,
    drive: Drive,
    model: MotionModel,
    config: DiagnosisConfig | None = None,
    reader: Reader | None = None,
    others: Sequence[Reader] = (),
) -> ExtendedResult:
    """Search terms for the drive of ``found``, the diagnosis of ``model``; diagnose the extended model where its file is better.

    With a ``reader`` the log is replayed with the file; else its windows are predicted. With ``others`` the file is judged by other drives.
    """
    config = config or DiagnosisConfig()
    search = find_terms(found, np.random.default_rng(config.seed)) if len(drive.maneuvers) >= _FEWEST_WINDOWS else None
    if search is None or found.predictor is None:
        return ExtendedResult(found, None)
    predictor, causes = found.predictor, search.state.causes
    search = _with_supported(predictor, search)
    if not (search.terms or search.effects or search.refused):
        return ExtendedResult(found, None)
    check = _check(predictor, search, reader, others)
    kept = {causes[i].id for i in search.kept}
    is_changed = bool(search.terms or search.effects)
    replaced = (
        tuple(dict.fromkeys(f.cause for f in found.diagnosis.findings if f.cause in {c.id for c in causes} - kept)) if is_changed else ()
    )
    whole, sizes = _robot_by(predictor, search, np.ones(len(predictor.batch.owner), dtype=bool))
    refusal = _refusal(predictor, search, CandidateRobot(whole, sizes, np.ones(len(drive.maneuvers), dtype=bool), is_beside=True))
    extension = Extension(model.name, search.terms, replaced, check, search.effects, refusal, search.refused)
    if not extension.is_better:
        return ExtendedResult(_with_effects(found, extension, search, model, config), extension)
    left = _without(drive, predictor, search.removed) if search.effects else drive
    again = examine(left, extended_model(predictor, terms_of([t.law for t in search.terms])), config, predictor.baseline, found.names)
    return ExtendedResult(_with_extension(again, extension, found), extension, whole.robot)


def _with_supported(predictor: DrivePredictor, search: Search) -> Search:
    """``search`` with what improves held-out windows beside all others alone, and bound effects that pass the whole gate."""
    rows: dict[tuple[str, ...], HeldRows] = {}
    noise, parts = search.state.noise, folds(len(predictor.drive.maneuvers))

    def rows_of(names: tuple[str, ...]) -> HeldRows:
        if names not in rows:
            rows[names] = _predicted(predictor, search.only(names, {}), [part[predictor.batch.owner] for part in parts])
        return rows[names]

    def check(fewer: tuple[str, ...], more: tuple[str, ...]) -> HandoverCheck | None:
        return compare_rows(rows_of(fewer), rows_of(more), noise.sigmas, noise.weights)

    kept, refused = find_supported(search.names, check)
    why = {name: reason(one) for name, one in refused.items()}
    effects = [e.shape.name for e in search.effects if e.shape.name in kept]
    if effects:
        rest = tuple(name for name in kept if name not in effects)
        gate = check(rest, kept)
        if gate is not None and gate.objection:
            why, kept = {**why, **dict.fromkeys(effects, gate.objection)}, rest
    return search.only(kept, why)


def _predicted(predictor: DrivePredictor, search: Search, held: Sequence[NDArray[np.bool_]]) -> HeldRows:
    """All windows, those of each part ``held`` (M,) by sizes of the rest, to first order."""
    rows = search.state.linear.copy()
    columns = search.design.columns
    for part in held:
        if columns.shape[-1]:
            sizes = search.design.problem(search.state.noise, ~part).fit(range(columns.shape[-1]))[0]
            rows[part] -= columns[part] @ sizes
    return HeldRows(rows, predictor.batch.measured, search.tolerated)


def _check(predictor: DrivePredictor, search: Search, reader: Reader | None, others: Sequence[Reader]) -> HandoverCheck | None:
    """The file with terms of the half of the drive that measures them better, on the other half, or by the whole drive on ``others``; None
    without terms.

    In a drive of a minute one half may not have the motions that separate two terms, as v |wz| and |v| wz without arcs backwards.
    """
    if not search.terms:
        return None

    def relative_sigma(used: NDArray[np.bool_]) -> float:
        """Sigma of the term that these windows measure worst, over its size on the whole drive."""
        measured = fit_on(predictor, search, used[predictor.batch.owner]).laws
        return max(law.sigma / abs(whole.law.value) for law, whole in zip(measured, search.terms, strict=True))

    first, second = interleaved_halves(len(predictor.drive.maneuvers))
    used, held = min((first, second), (second, first), key=lambda pair: relative_sigma(pair[0]))
    by_half, sizes = _robot_by(predictor, search, np.ones(len(predictor.batch.owner), bool) if others else used[predictor.batch.owner])
    return check_written(predictor, search.state, CandidateRobot(by_half, sizes, held, is_beside=True), reader, others)


_PARTS = 4
"""Parts of a drive in which terms have to hold."""
_MOST_LEFT = 0.25
"""Squares that the terms leave in a part that shows another size of them than the whole drive, over those of the mean part at that size,
beyond which they are no law: half of the root mean square. Of the laws of `tests.studies.unseen_effects`, draws 5 to 8, those whose file is
right leave 0.13 at most; one that follows sin(t/9) leaves 0.38, in a part in which it hardly acts."""


def _refusal(predictor: DrivePredictor, search: Search, whole: CandidateRobot) -> str:
    """Why the terms of the robot ``whole``, by all windows, are no law of the motion; empty where the drive does not show that.

    What acts in a part of the drive alone, or differs with time, terms may describe by the motions of that part.
    """
    if not search.terms:
        return ""
    if not search.has_sides:
        return (
            "other terms, which differ from it in turns to the other side, explain this drive as well (drive arcs to both sides, ahead and"
            " back)"
        )
    if not search.is_lasting:
        return "motions whose share changes along the drive explain it better"
    if why := _extrapolates_badly(predictor, search):
        return why
    part = np.arange(len(whole.held)) * _PARTS // len(whole.held)
    checks = [check_written(predictor, search.state, dataclasses.replace(whole, held=part == k), None) for k in range(_PARTS)]
    if _differ_between_parts([check for check in checks if check is not None]):
        return "its size differs from part to part of the drive by more than a half"
    return ""


def kinds_of_motion(predictor: DrivePredictor) -> IntArray:
    """(M,) kind of each window's motion: straight, in place, arcs to the left and to the right."""
    found = np.zeros(len(predictor.batch.ends), dtype=np.int64)
    for i, inside in enumerate(predictor.batch.intervals()):
        ways = np.sum(predictor.batch.wheels[inside] * predictor.batch.dt[inside, None], axis=0)
        ahead, turn = ways[0] + ways[1], ways[1] - ways[0]
        angle = math.atan2(abs(turn), abs(ahead))
        if angle >= _TURNING_SHARE:
            found[i] = 1 if angle > 0.5 * math.pi - _TURNING_SHARE else 2 + int(turn < 0.0)
    return found


def _extrapolates_badly(predictor: DrivePredictor, search: Search) -> str:
    """Why terms do not hold in kinds of motion to which they were not fitted, as a clause; empty where they do.

    Kinds are held out one by one, as far as the others measure each coefficient and the terms act in them.
    """
    kinds, noise, columns = kinds_of_motion(predictor), search.state.noise, search.design.columns
    whole = search.design.problem(noise).fit(range(columns.shape[-1]))[0]
    parts = []
    for kind in np.unique(kinds):
        part = kinds == kind
        if part.sum() < _FEWEST_OF_A_KIND or (~part).sum() < _FEWEST_OF_A_KIND:
            continue
        cov = search.design.problem(noise, ~part).fit(range(columns.shape[-1]))[1]
        acts = np.nansum((columns[part] @ whole / noise.sigmas[part]) ** 2) > _ACTING
        if acts and np.all(np.sqrt(np.diagonal(cov)) < _MAX_RELATIVE_SIGMA * np.abs(whole)):
            parts.append(part)
    if not parts:
        return ""
    held = np.any(parts, axis=0)
    before = HeldRows(search.state.linear, predictor.batch.measured, search.tolerated)
    check = compare_rows(before.part(held), _predicted(predictor, search, parts).part(held), noise.sigmas[held], noise.weights[held])
    if check is None or (not check.worse and check.gain.high > 0.0):
        return ""
    changed = ", ".join(f"{c} {check.before[c]:.3g} -> {check.after[c]:.3g}" for c in check.worse or check.before)
    return f"in kinds of motion to which it was not fitted it does not hold ({changed})"


def _differ_between_parts(checks: Sequence[HandoverCheck]) -> bool:
    """Whether a part of the drive clearly shows another size of the terms than all ``checks`` of parts together, by what matters to the
    mean part."""
    shares, sigmas = np.array([check.shown_beside for check in checks]).reshape(-1, 2).T
    squares = sigmas**-2.0  # of what the terms change
    size = float(np.average(shares, weights=squares))
    off = np.abs(shares - size)
    return bool(np.any((off > CLEAR_SIGMAS * sigmas) & (off**2 * squares > _MOST_LEFT * size**2 * squares.mean())))


def _with_effects(
    found: DiagnosisResult, extension: Extension, search: Search, model: MotionModel, config: DiagnosisConfig
) -> DiagnosisResult:
    """The diagnosis of the drive without its bound effects, which are in its table and its sentence."""
    if not extension.effects or found.predictor is None:
        return dataclasses.replace(found, diagnosis=dataclasses.replace(found.diagnosis, extension=extension))
    drive, removed, before = found.predictor.drive, search.removed, found.diagnosis
    again = examine(_without(drive, found.predictor, removed), model, config, found.predictor.baseline, found.names)
    d = again.diagnosis
    rows = dict(d.discrepancy)
    for effect, component in ((each, name) for each in extension.effects for name in each.shape.components):
        name = _CHANNEL_OF.get(component, component)
        if name in rows and name in before.discrepancy:
            old, row = before.discrepancy[name], dataclasses.replace(rows[name], rms=before.discrepancy[name].rms)
            share = 1.0 - min((rows[name].rms / max(old.rms, 1e-12)) ** 2, 1.0)
            attributions = (Attribution(effect.shape.name, effect.value, share, True), *row.attributions)
            row = dataclasses.replace(row, p_value=old.p_value)
            rows[name] = row if row.status == "unexplained" else row.with_status("attributed", attributions)
    verdict = "explained" if d.verdict == "consistent" else d.verdict
    d = dataclasses.replace(d, verdict=verdict, discrepancy=rows, extension=extension, warnings=before.warnings)
    return dataclasses.replace(again, diagnosis=d)


def _without(drive: Drive, predictor: DrivePredictor, removed: FloatArray) -> Drive:
    """``drive`` as it would have been measured without what effects ``removed`` (M, 6) in the discrepancies: the robot turns less, by its
    motion reference as by its gyro, and the gyro measures what it alone is off."""
    motions = [
        dataclasses.replace(m, measured=se2.retract(m.measured, -row))
        for m, row in zip(drive.maneuvers, np.split(removed[:, :3], np.flatnonzero(np.diff(predictor.batch.owner)) + 1), strict=True)
    ]
    forces = None if drive.forces is None else drive.forces - removed[:, 4:]
    gyro, turned = drive.gyro, removed[:, 2] + removed[:, 3]
    if gyro is not None and turned.any():
        seconds = predictor.window_times_s[1] - predictor.window_times_s[0]
        gyro = CorrectedGyro(gyro, drive.spans_ns, turned / seconds)
    return dataclasses.replace(drive, maneuvers=tuple(motions), forces=forces, gyro=gyro)


class CorrectedGyro(GyroRecord):
    """The record of a gyro less ``rates`` (W,) [rad/s] in the ``spans_ns`` (W, 2)."""

    def __init__(self, inner: GyroRecord, spans_ns: IntArray, rates: FloatArray) -> None:
        self._inner, self._spans, self._rates = inner, spans_ns, rates

    def turn(self, start_ns: int, end_ns: int, by_wheels: float) -> Turn | None:
        """See `GyroRecord.turn`."""
        found = self._inner.turn(start_ns, end_ns, by_wheels)
        inside = np.minimum(end_ns, self._spans[:, 1]) - np.maximum(start_ns, self._spans[:, 0])
        off = float(np.maximum(inside, 0) @ self._rates) * _NS
        return None if found is None else dataclasses.replace(found, angle=found.angle - off)


def _with_extension(again: DiagnosisResult, extension: Extension, before: DiagnosisResult) -> DiagnosisResult:
    """The diagnosis of the extended model, with the terms in its sentence, its verdict where nothing is left unexplained, and pictures that
    begin with the discrepancies of the plain model ``before``."""
    d = again.diagnosis
    if again.residuals is not None and before.residuals is not None:
        again = dataclasses.replace(again, residuals=dataclasses.replace(again.residuals, rows=before.residuals.rows))
    d = dataclasses.replace(d, discrepancy=_with_terms_in_rows(d.discrepancy, before.diagnosis.discrepancy, extension.terms))
    verdict = "extended" if d.verdict in ("consistent", "explained") else d.verdict
    if d.verdict == "consistent" and d.suspected is not None:  # too weak to be named, and so is the drive that would settle it
        d = dataclasses.replace(d, suspected=None, next_drive="")
    return dataclasses.replace(again, diagnosis=dataclasses.replace(d, verdict=verdict, extension=extension))


def _with_terms_in_rows(rows: Mapping[str, Component], before: Mapping[str, Component], terms: Sequence[FoundTerm]) -> dict[str, Component]:
    """``rows`` of the extended model that begin with the discrepancies of the plain one (``before``), and attribute to each term what its
    component no longer has."""
    found = dict(rows)
    for name, row in rows.items():
        old = before.get(name)
        if old is None or name not in _CHANNEL_OF.values():
            continue
        share = 1.0 - min((row.rms / max(old.rms, 1e-12)) ** 2, 1.0)
        is_turned = name != "yaw" and old.status != "noise"  # what acts sideways acts along the end of an arc as well
        own = [t for t in terms if name in {_CHANNEL_OF[part.component] for part in t.law.parts}] or [t for t in terms if is_turned]
        row = dataclasses.replace(row, rms=old.rms, p_value=old.p_value)
        parts = tuple(Attribution(t.law.name, t.law.value, share / len(own), True) for t in own)
        status = row.status if row.status == "unexplained" or not own else "attributed"
        found[name] = row.with_status(status, (*parts, *row.attributions))
    return found


def _robot_by(predictor: DrivePredictor, search: Search, used: NDArray[np.bool_]) -> tuple[CorrectedRobot, dict[Cause, float]]:
    """The robot with terms and kept causes as the windows ``used`` (M,) alone have them, and the sizes of these causes."""
    fit, old, name = fit_on(predictor, search, used), predictor.drive.robot.terms, predictor.model.name
    terms, sizes = terms_of(fit.laws), {search.state.causes[i]: float(size) for i, size in zip(fit.kept, fit.sizes, strict=True)}
    corrected = correct_robot(predictor, sizes)
    robot = dataclasses.replace(corrected.robot, terms={**old, name: merge_terms(old.get(name, ()), terms)})
    return dataclasses.replace(corrected, robot=robot), sizes


EXTEND_ADVICE = "diagnose with --extend, which searches a term of the model for it."
"""What to do where `suggests_extension`."""


def suggests_extension(found: DiagnosisResult) -> bool:
    """Whether a search for terms is worth its time: something is left that no cause explains, and windows of motion may show its shape."""
    return found.diagnosis.verdict == "unexplained" and found.predictor is not None and found.predictor.drive.kind in SEARCHED
