"""A motion model that is extended by terms: found on a drive, written to a robot file, read again, and replayed on the half held out.

The gate is that of all corrections (`handover.check_written`): with sizes and coefficients of one half of the drive alone the file is
written, read from disk, and predicts and replays the windows of the other half. Only what shrinks errors beyond their scatter is kept; the
file that a user gets has the coefficients of all windows.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.causes.cause import Cause
from localization.diagnosis.corrected_robot import CorrectedRobot, correct_robot
from localization.diagnosis.diagnose import DiagnosisConfig, DiagnosisResult, examine
from localization.diagnosis.drive import Drive
from localization.diagnosis.findings import HandoverCheck
from localization.diagnosis.handover import Candidate, Reader, check_written
from localization.diagnosis.prediction import DrivePredictor
from localization.diagnosis.terms import SEARCHED, FoundTerm, Search, extended_model, find_terms, halves, merge_terms, sizes_on
from motion_models.base import MotionModel
from motion_models.robot import Robot
from motion_models.terms import Term

_FEWEST_WINDOWS = 16
"""Of a drive: eight in each half, as many as a diagnosis takes."""
_TWO_SIDED_95 = 1.96


@dataclass(frozen=True)
class Extension:
    """Terms that a model lacks on a drive, and what a robot file with them gains."""

    model: str
    terms: tuple[FoundTerm, ...]
    replaced: tuple[str, ...]
    """Findings of the plain model in whose place the terms explain the drive better."""
    check: HandoverCheck | None
    """Of its file on the half of the drive that it was not fitted to; None where nothing was measured there."""

    @property
    def is_better(self) -> bool:
        """Whether the file is better on the half held out, beyond its scatter."""
        return self.check is not None and self.check.is_better

    def describe(self) -> str:
        """The terms and their gain, as a sentence."""
        parts = [describe_term(t.term) for t in self.terms]
        known = "no physical cause known"
        if self.replaced:
            known += f"; it explains the drive better than {' and '.join(self.replaced)}"
        text = f"{', and '.join(parts)} beyond {self.model} ({known}); "
        if self.check is None or not self.is_better:
            return f"{text}on the other half of the drive it improves nothing beyond the noise, so it is not written"
        fallen = [
            f"{name} falls from {r.before_m:.3g} to {r.after_m:.3g} m" for name, r in self.check.replays.items() if r.after_m < r.before_m
        ]
        return f"{text}with it in robot.toml {' and '.join(fallen) or self.check.describe()} a window on the other half"

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
        return {
            "model": self.model,
            "terms": terms,
            "replaced": list(self.replaced),
            "heldout": None if self.check is None else self.check.to_dict(),
        }


@dataclass(frozen=True)
class ExtendedResult:
    """A diagnosis with the model extended, where that is better; and what was found."""

    found: DiagnosisResult
    """Of the extended model, where its file is better on the half held out; else of the plain one."""
    extension: Extension | None
    """None where no term explains the drive."""
    robot: Robot | None = None
    """The robot with terms and findings, where its file is better."""


def describe_term(term: Term) -> str:
    """A term as an addition to its component, as ``vy is -0.12 (+- 0.01) m s x wz*abs(wz)``."""
    unit = "" if term.unit == "1" else f" {term.unit}"
    return f"{term.component} is {term.value:+.3g} (+- {term.sigma:.1g}){unit} x {term.expression}"


def extend(
    found: DiagnosisResult, drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None, reader: Reader | None = None
) -> ExtendedResult:
    """Search terms for the drive of ``found``, the diagnosis of ``model``; diagnose the extended model where its file is better.

    With a ``reader`` the log is replayed with the file; else its windows are predicted.
    """
    config = config or DiagnosisConfig()
    search = find_terms(found, np.random.default_rng(config.seed)) if len(drive.maneuvers) >= _FEWEST_WINDOWS else None
    if search is None or not search.terms or found.linearization is None or found.predictor is None:
        return ExtendedResult(found, None)
    predictor, causes = found.predictor, search.state.causes
    used, held = halves(len(drive.maneuvers))
    by_half, sizes = _robot_by(predictor, search, used[predictor.batch.owner])
    check = check_written(predictor, search.state.noise, Candidate(by_half, sizes, held), reader)
    kept = {causes[i].id for i in search.kept}
    replaced = tuple(dict.fromkeys(f.cause for f in found.diagnosis.findings if f.cause in {c.id for c in causes} - kept))
    extension = Extension(model.name, search.terms, replaced, check)
    if not extension.is_better:
        return ExtendedResult(found, extension)
    whole = _robot_by(predictor, search, np.ones(len(predictor.batch.owner), dtype=bool))[0]
    again = examine(drive, extended_model(predictor, [t.term for t in search.terms]), config)
    return ExtendedResult(_with_extension(again, extension), extension, whole.robot)


def _with_extension(again: DiagnosisResult, extension: Extension) -> DiagnosisResult:
    """The diagnosis of the extended model, with the terms in its sentence, and its verdict where nothing is left unexplained."""
    d = again.diagnosis
    verdict = "extended" if d.verdict in ("consistent", "explained") else d.verdict
    rest = "" if d.verdict == "consistent" else f" {d.sentence}"
    text = extension.describe()
    return dataclasses.replace(again, diagnosis=dataclasses.replace(d, verdict=verdict, sentence=f"{text[0].upper()}{text[1:]}.{rest}"))


def _robot_by(predictor: DrivePredictor, search: Search, used: NDArray[np.bool_]) -> tuple[CorrectedRobot, dict[Cause, float]]:
    """The robot with terms and kept causes as the windows ``used`` (M,) alone have them, and the sizes of these causes."""
    by_index, terms = sizes_on(predictor, search, used)
    causes, old, name = search.state.causes, predictor.drive.robot.terms, predictor.model.name
    sizes = {causes[i]: size for i, size in by_index.items() if abs(size) <= causes[i].largest_plausible}
    corrected = correct_robot(predictor, sizes)
    robot = dataclasses.replace(corrected.robot, terms={**old, name: merge_terms(old.get(name, ()), terms)})
    return dataclasses.replace(corrected, robot=robot), sizes


def suggests_extension(found: DiagnosisResult) -> bool:
    """Whether a search for terms is worth its time: something is left that no cause explains, and windows of motion may show its shape."""
    return found.diagnosis.verdict == "unexplained" and found.predictor is not None and found.predictor.drive.kind in SEARCHED
