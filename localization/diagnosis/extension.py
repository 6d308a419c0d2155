"""A motion model that is extended by terms: found on a drive, written to a robot file, read again, and replayed on the half held out.

The gate is that of all corrections (`handover.check_written`): with sizes and coefficients of one half of the drive alone the file is
written, read from disk, and predicts and replays the windows of the other half. Only what shrinks errors beyond their scatter is kept; the
file that a user gets has the coefficients of all windows.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.corrected_robot import CorrectedRobot, correct_robot
from localization.diagnosis.diagnose import DiagnosisConfig, examine
from localization.diagnosis.drive import Drive
from localization.diagnosis.drive_predictor import DrivePredictor
from localization.diagnosis.findings import CLEAR_SIGMAS, MAX_NOISE_OVER_REFERENCE, Attribution, Component, HandoverCheck
from localization.diagnosis.handover import CandidateRobot, Reader, check_written
from localization.diagnosis.linearization import Linearization
from localization.diagnosis.missing_terms import (
    SEARCHED,
    FoundEffect,
    FoundTerm,
    Search,
    extended_model,
    find_terms,
    halves,
    merge_terms,
    sizes_on,
)
from localization.diagnosis.noise import reference_sigmas
from localization.diagnosis.result import DiagnosisResult
from localization.diagnosis.verdict import noise_ratios
from localization.events import Turn
from localization.gyro import GyroRecord
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.calibration.maneuvers import IntArray
from motion_models.robot import Robot
from motion_models.se2 import FloatArray
from motion_models.terms import Term

_FEWEST_WINDOWS = 16
"""Fewest windows of a drive: eight in each half, as many as a diagnosis takes."""
_TWO_SIDED_95 = 1.96
_NS = 1e-9
_NOT_WRITTEN = {
    "time": "another drive begins after another way",
    "place": "a robot file has no map",
    "wheel angle": "the angle at the start differs from drive to drive",
    "tilt": "models have no tilt as an input",
    "sensor": "it does not move the robot",
}
"""Why a robot file does not hold an effect, by what it is bound to."""
_CHANNEL_OF = {"vx": "x", "vy": "y", "wz": "yaw"}


@dataclass(frozen=True)
class Extension:
    """Terms missing in a model on a drive, and what a robot file with them gains."""

    model: str
    terms: tuple[FoundTerm, ...]
    replaced: tuple[str, ...]
    """Findings of the plain model in whose place the terms explain the drive better."""
    check: HandoverCheck | None
    """Check of its file on the half of the drive that it was not fitted to; None without terms, and where nothing was measured there."""
    effects: tuple[FoundEffect, ...] = ()
    """Effects bound to time, place or sensors, which are not written."""
    refusal: str = ""
    """Why the terms are not written, whatever the half held out shows; empty without a reason."""

    @property
    def is_better(self) -> bool:
        """Whether nothing refuses the terms, and their file is better on the half held out, beyond its scatter."""
        return not self.refusal and self.check is not None and self.check.is_better

    def describe_effects(self) -> str:
        """The bound effects as sentences; empty without any."""
        return " ".join(f"{describe_effect(e)[0].upper()}{describe_effect(e)[1:]}." for e in self.effects)

    def describe(self) -> str:
        """The terms and their gain, as a sentence."""
        if not self.terms:
            return self.describe_effects().removesuffix(".")
        parts = [describe_term(t.term) for t in self.terms]
        known = "no physical cause known"
        if self.replaced:
            known += f"; it explains the drive better than {' and '.join(self.replaced)}"
        if any("t" in t.term.expression.variables for t in self.terms):
            known += "; t counts from the start of each drive, so that it holds for drives that start as this one did"
        text = f"{', and '.join(parts)} beyond {self.model} ({known}); "
        if self.refusal:
            return f"{text}{self.refusal}, so that it is not written"
        if self.check is None or not self.is_better:
            return f"{text}on the other half of the drive it improves nothing beyond the noise, so it is not written"
        fallen = [
            f"{name} falls from {r.before_m:.3g} to {r.after_m:.3g} m" for name, r in self.check.replays.items() if r.after_m < r.before_m
        ]
        if not fallen:
            return f"{text}with it in robot.toml, {self.check.describe()}"
        return f"{text}with it in robot.toml {' and '.join(fallen)} a window on the other half"

    def table(self) -> list[tuple[str, ...]]:
        """Component, term or effect, value, 95 % interval, unit, stability and log-likelihood of each, as text."""
        content = self.to_dict()
        return [
            (
                row["component"],
                row.get("expression", row.get("along", "")),
                *_rounded((row["value"],), row["sigma"]),
                " to ".join(_rounded(row["interval"], row["sigma"])),
                row["unit"],
                f"{100 * row['stability']:.0f} %",
                f"{row['log_likelihood']:+.0f}",
            )
            for row in (*content["terms"], *content["effects"])
        ]

    def to_dict(self) -> dict[str, Any]:
        """For `diagnose --json`: sizes in SI units with their 95 % intervals."""
        terms = [
            {
                "component": t.term.component,
                "expression": str(t.term.expression),
                "value": t.term.value,
                "sigma": t.term.sigma,
                "interval": [t.term.value - _TWO_SIDED_95 * t.term.sigma, t.term.value + _TWO_SIDED_95 * t.term.sigma],
                "unit": t.term.unit,
                "stability": t.stability,
                "log_likelihood": 0.5 * t.gain,
                "alike": list(t.alike),
            }
            for t in self.terms
        ]
        effects = [
            {
                "component": e.shape.component,
                "along": e.shape.along,
                "bound_to": e.shape.kind,
                "value": e.value,
                "sigma": e.sigma,
                "interval": [e.value - _TWO_SIDED_95 * e.sigma, e.value + _TWO_SIDED_95 * e.sigma],
                "unit": e.shape.unit,
                "stability": e.stability,
                "log_likelihood": 0.5 * e.gain,
            }
            for e in self.effects
        ]
        heldout = None if self.check is None else self.check.to_dict()
        return {"model": self.model, "terms": terms, "effects": effects, "replaced": list(self.replaced), "heldout": heldout}


@dataclass(frozen=True)
class ExtendedResult:
    """A diagnosis with the model extended, where that is better; and what was found."""

    found: DiagnosisResult
    """Diagnosis with the extended model, where its file is better on the half held out; else with the plain one."""
    extension: Extension | None
    """None where no term explains the drive."""
    robot: Robot | None = None
    """The robot with terms and findings, where its file is better."""


EXTENSION_HEADS = ("component", "term", "value", "95 %", "unit", "stability", "log-likelihood")
"""Heads of `Extension.table`."""


def _rounded(values: Sequence[float], sigma: float) -> list[str]:
    """``values`` with two digits of their ``sigma``."""
    decimals = max(0, 1 - math.floor(math.log10(max(sigma, 1e-9))))
    return [f"{value:+.{decimals}f}" for value in values]


def describe_term(term: Term) -> str:
    """A term as an addition to its component, as ``vy is -0.12 (+- 0.01) m s x wz*abs(wz)``."""
    unit = "" if term.unit == "1" else f" {term.unit}"
    return f"{term.component} is {term.value:+.3g} (+- {term.sigma:.1g}){unit} x {term.expression}"


def describe_effect(effect: FoundEffect) -> str:
    """A bound effect with its size, unit and what it follows, as a part of a sentence."""
    unit = "" if effect.shape.unit == "1" else f" {effect.shape.unit}"
    size = f"{effect.value:+.3g} (+- {effect.sigma:.1g}){unit}"
    why = f"bound to a {effect.shape.kind} and not written: {_NOT_WRITTEN[effect.shape.kind]}"
    return f"{effect.shape.component} is {size} x {effect.shape.along} off, {why}"


def extend(
    found: DiagnosisResult, drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None, reader: Reader | None = None
) -> ExtendedResult:
    """Search terms for the drive of ``found``, the diagnosis of ``model``; diagnose the extended model where its file is better.

    With a ``reader`` the log is replayed with the file; else its windows are predicted.
    """
    config = config or DiagnosisConfig()
    search = find_terms(found, np.random.default_rng(config.seed)) if len(drive.maneuvers) >= _FEWEST_WINDOWS else None
    if search is None or not (search.terms or search.effects) or found.linearization is None or found.predictor is None:
        return ExtendedResult(found, None)
    predictor, causes = found.predictor, search.state.causes
    search, check = _with_improving_terms(predictor, search, reader)
    if not (search.terms or search.effects):
        return ExtendedResult(found, None)
    kept = {causes[i].id for i in search.kept}
    replaced = tuple(dict.fromkeys(f.cause for f in found.diagnosis.findings if f.cause in {c.id for c in causes} - kept))
    whole, sizes = _robot_by(predictor, search, np.ones(len(predictor.batch.owner), dtype=bool))
    refusal = _refusal(predictor, search, CandidateRobot(whole, sizes, np.ones(len(drive.maneuvers), dtype=bool)))
    extension = Extension(model.name, search.terms, replaced, check, search.effects, refusal)
    if not extension.is_better:
        return ExtendedResult(_with_effects(found, extension, search, model, config), extension)
    left = _without(drive, predictor, search.removed) if search.effects else drive
    again = examine(left, extended_model(predictor, [t.term for t in search.terms]), config, predictor.baseline, found.names)
    return ExtendedResult(_with_extension(again, extension, found), extension, whole.robot)


def _with_improving_terms(predictor: DrivePredictor, search: Search, reader: Reader | None) -> tuple[Search, HandoverCheck | None]:
    """``search`` with the terms whose component the file of a half improves on the other half, and the check of that file.

    Terms of one component may hide what those of another make worse: on a third of fr079 vy = .018 sign(v) took y from 38 to 26 mm, and
    wz = .079 dwz beside it yaw from 27 to 34 mrad; their file was worse than none on the next third.
    """
    while True:
        check = _check(predictor, search, reader)
        if check is None or len({t.term.component for t in search.terms}) < 2:
            return search, check
        channels = {c: _CHANNEL_OF[c] for c in (t.term.component for t in search.terms)}
        worse = [c for c, channel in channels.items() if check.after.get(channel, 0.0) > check.before.get(channel, math.inf)]
        weak = [t for t in search.terms if t.term.component in worse]
        if not weak:
            return search, check
        weakest = min(weak, key=lambda t: t.gain)
        search = search._replace(terms=tuple(t for t in search.terms if t is not weakest))


def _check(predictor: DrivePredictor, search: Search, reader: Reader | None) -> HandoverCheck | None:
    """The file with terms of the half of the drive that measures them better, on the other half; None without terms.

    In a drive of a minute one half may not have the motions that separate two terms, as v |wz| and |v| wz without arcs backwards.
    """
    if not search.terms:
        return None

    def relative_sigma(used: NDArray[np.bool_]) -> float:
        """Sigma of the term that these windows measure worst, over its size on the whole drive."""
        measured = sizes_on(predictor, search, used[predictor.batch.owner])[1]
        return max(t.sigma / abs(whole.term.value) for t, whole in zip(measured, search.terms, strict=True))

    first, second = halves(len(predictor.drive.maneuvers))
    used, held = min((first, second), (second, first), key=lambda pair: relative_sigma(pair[0]))
    by_half, sizes = _robot_by(predictor, search, used[predictor.batch.owner])
    return check_written(predictor, search.state.noise, CandidateRobot(by_half, sizes, held), reader)


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
    part = np.arange(len(whole.held)) * _PARTS // len(whole.held)
    checks = [check_written(predictor, search.state.noise, dataclasses.replace(whole, held=part == k), None) for k in range(_PARTS)]
    left = _noise_left(search.state, predictor)
    if left > MAX_NOISE_OVER_REFERENCE:
        return f"beside it {left:.0f} times the noise of the reference is left, so that more is missing"
    if _differ_between_parts([check for check in checks if check is not None]):
        return "its size differs from part to part of the drive by more than a half"
    return ""


def _noise_left(state: Linearization, predictor: DrivePredictor) -> float:
    """Noise of the drive beside the terms, over that of its motion reference, in the component of a log that has most, as the median of the
    windows: what a term is off in some motions is no sign of another one. 1 for tables, whose noise is as they give it.

    Of 50 laws (`tests.studies.unseen_effects`, draws 5 to 8) four leave 5 times the noise of scan matching and more, and their terms remove
    0.26 of the law on a fresh drive at most (least -12); others leave up to 1.7 times in x and y.
    """
    stated = reference_sigmas(predictor) if predictor.drive.kind == "log" else None
    known = np.isfinite(state.rows)
    ratios = [noise_ratios(state, stated, known[:, c], c) for c in range(3)]
    return max((float(np.median(r)) for r in ratios if len(r)), default=1.0)


def _differ_between_parts(checks: Sequence[HandoverCheck]) -> bool:
    """Whether a part of the drive clearly shows another size of the terms than all ``checks`` of parts together, by what matters to the
    mean part."""
    shares, sigmas = np.array([check.shown for check in checks]).reshape(-1, 2).T
    squares = sigmas**-2.0  # of what the terms change
    size = float(np.average(shares, weights=squares))
    off = np.abs(shares - size)
    return bool(np.any((off > CLEAR_SIGMAS * sigmas) & (off**2 * squares > _MOST_LEFT * size**2 * squares.mean())))


def _with_effects(
    found: DiagnosisResult, extension: Extension, search: Search, model: MotionModel, config: DiagnosisConfig
) -> DiagnosisResult:
    """The diagnosis of the drive without its bound effects, which are in its table and its sentence."""
    if not extension.effects or found.predictor is None:
        return found
    drive, removed, before = found.predictor.drive, search.removed, found.diagnosis
    again = examine(_without(drive, found.predictor, removed), model, config, found.predictor.baseline, found.names)
    d = again.diagnosis
    rows = dict(d.discrepancy)
    for effect in extension.effects:
        name = _CHANNEL_OF.get(effect.shape.component, effect.shape.component)
        if name in rows and name in before.discrepancy:
            old, row = before.discrepancy[name], dataclasses.replace(rows[name], rms=before.discrepancy[name].rms)
            share = 1.0 - min((rows[name].rms / max(old.rms, 1e-12)) ** 2, 1.0)
            attributions = (Attribution(effect.shape.name, effect.value, share, True), *row.attributions)
            row = dataclasses.replace(row, p_value=old.p_value)
            rows[name] = row if row.status == "unexplained" else row.with_status("attributed", attributions)
    rest = "" if d.verdict == "consistent" else f" {d.sentence}"
    d = dataclasses.replace(
        d,
        verdict="explained" if d.verdict == "consistent" else d.verdict,
        discrepancy=rows,
        sentence=f"{extension.describe_effects()}{rest}",
        warnings=before.warnings,
    )
    return dataclasses.replace(again, diagnosis=d)


def _without(drive: Drive, predictor: DrivePredictor, removed: FloatArray) -> Drive:
    """``drive`` as it would have been measured without what effects ``removed`` (M, 6) in the discrepancies."""
    motions = [
        dataclasses.replace(m, measured=se2.retract(m.measured, -row))
        for m, row in zip(drive.maneuvers, np.split(removed[:, :3], np.flatnonzero(np.diff(predictor.batch.owner)) + 1), strict=True)
    ]
    forces = None if drive.forces is None else drive.forces - removed[:, 4:]
    gyro = drive.gyro
    if gyro is not None and removed[:, 3].any():
        seconds = predictor.window_times_s[1] - predictor.window_times_s[0]
        gyro = CorrectedGyro(gyro, drive.spans_ns, removed[:, 3] / seconds)
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
    rest = "" if d.verdict == "consistent" else f" {d.sentence}"
    rest = f" {extension.describe_effects()}{rest}" if extension.effects else rest
    if d.verdict == "consistent" and d.suspected is not None:  # too weak to be named, and so is the drive that would settle it
        d = dataclasses.replace(d, suspected=None, next_drive="")
    return dataclasses.replace(again, diagnosis=dataclasses.replace(d, verdict=verdict, sentence=f"{extension.describe()}.{rest}"))


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
        own = [t for t in terms if _CHANNEL_OF[t.term.component] == name] or [t for t in terms if is_turned]
        row = dataclasses.replace(row, rms=old.rms, p_value=old.p_value)
        parts = tuple(Attribution(t.term.name, t.term.value, share / len(own), True) for t in own)
        status = row.status if row.status == "unexplained" or not own else "attributed"
        found[name] = row.with_status(status, (*parts, *row.attributions))
    return found


def _robot_by(predictor: DrivePredictor, search: Search, used: NDArray[np.bool_]) -> tuple[CorrectedRobot, dict[Cause, float]]:
    """The robot with terms and kept causes as the windows ``used`` (M,) alone have them, and the sizes of these causes."""
    by_index, terms = sizes_on(predictor, search, used)
    causes, old, name = search.state.causes, predictor.drive.robot.terms, predictor.model.name
    sizes = {causes[i]: size for i, size in by_index.items()}
    corrected = correct_robot(predictor, sizes)
    robot = dataclasses.replace(corrected.robot, terms={**old, name: merge_terms(old.get(name, ()), terms)})
    return dataclasses.replace(corrected, robot=robot), sizes


EXTEND_ADVICE = "diagnose with --extend, which searches a term of the model for it."
"""What to do where `suggests_extension`."""


def suggests_extension(found: DiagnosisResult) -> bool:
    """Whether a search for terms is worth its time: something is left that no cause explains, and windows of motion may show its shape."""
    return found.diagnosis.verdict == "unexplained" and found.predictor is not None and found.predictor.drive.kind in SEARCHED
