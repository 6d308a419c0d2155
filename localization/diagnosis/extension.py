"""A motion model that is extended by terms: found on a drive, written to a robot file, read again, and replayed on the half held out.

The gate: with sizes and coefficients of one half of the drive alone, the file is written, read from disk, and predicts the windows of the
other half by the plain model that replay uses; then the halves change places. Only what shrinks discrepancies beyond the scatter of the
gain is kept; the file that a user gets has the coefficients of all windows.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from localization.diagnosis.causes.cause import Hypothesis
from localization.diagnosis.corrected_robot import correct_robot
from localization.diagnosis.diagnose import DiagnosisConfig, DiagnosisResult, examine
from localization.diagnosis.drive import Drive
from localization.diagnosis.findings import Gain
from localization.diagnosis.prediction import DrivePredictor
from localization.diagnosis.terms import SEARCHED, FoundTerm, Search, extended_model, find_terms, halves, merge_terms, sizes_on
from motion_models import se2
from motion_models.base import MotionModel
from motion_models.registry import make_model
from motion_models.robot import Robot
from motion_models.robot_file import load_robot, relocated, robot_toml
from motion_models.se2 import FloatArray
from motion_models.terms import Term

_BLOCK_WINDOWS, _DRAWS = 4, 1000
_FEWEST_WINDOWS = 16
"""Of a drive: eight in each half, as many as a diagnosis takes."""
_TWO_SIDED_95 = 1.96


@dataclass(frozen=True)
class HeldOutReplay:
    """Windows of a drive by the robot's file, and by the one with terms that were fitted to the half in which a window is not."""

    gain: Gain
    """Of discrepancies over their noise."""
    path_before: float
    """Root mean square of the distance between the wheels' path and the measured one, end to end over the held-out windows whose positions
    were measured [m]; of the headings where these alone were measured in all [rad]."""
    path_after: float
    unit: str
    windows: int

    @property
    def is_better(self) -> bool:
        """Whether discrepancies shrink beyond the scatter of the gain, and the path is no worse."""
        return self.gain.low > 0.0 and self.path_after <= self.path_before

    def to_dict(self) -> dict[str, Any]:
        """For `diagnose --json`."""
        paths = {"path_error_before": self.path_before, "path_error_after": self.path_after, "unit": self.unit, "windows": self.windows}
        return {**self.gain.to_dict(), **paths, "is_better": self.is_better}


@dataclass(frozen=True)
class Extension:
    """Terms that a model lacks on a drive, and what a robot file with them gains."""

    model: str
    terms: tuple[FoundTerm, ...]
    replaced: tuple[str, ...]
    """Findings of the plain model in whose place the terms explain the drive better."""
    replay: HeldOutReplay

    def describe(self) -> str:
        """The terms and their gain, as a sentence."""
        parts = [describe_term(t.term) for t in self.terms]
        known = "no physical cause known"
        if self.replaced:
            known += f"; it explains the drive better than {' and '.join(self.replaced)}"
        text = f"{', and '.join(parts)} beyond {self.model} ({known}); "
        r = self.replay
        if not r.is_better:
            return f"{text}on the other half of the drive it improves nothing beyond the noise, so it is not written"
        return f"{text}with it in robot.toml odometry falls from {r.path_before:.3g} to {r.path_after:.3g} {r.unit} on the other half"

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
        return {"model": self.model, "terms": terms, "replaced": list(self.replaced), "heldout": self.replay.to_dict()}


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


def extend(found: DiagnosisResult, drive: Drive, model: MotionModel, config: DiagnosisConfig | None = None) -> ExtendedResult:
    """Search terms for the drive of ``found``, the diagnosis of ``model``; diagnose the extended model where its file is better."""
    config = config or DiagnosisConfig()
    search = find_terms(found, np.random.default_rng(config.seed)) if len(drive.maneuvers) >= _FEWEST_WINDOWS else None
    if search is None or not search.terms or found.linearization is None or found.predictor is None:
        return ExtendedResult(found, None)
    robot, replay = _gate(found.predictor, search)
    causes = search.state.causes
    kept = {causes[i].id for i in search.kept}
    replaced = tuple(dict.fromkeys(f.cause for f in found.diagnosis.findings if f.cause in {c.id for c in causes} - kept))
    extension = Extension(model.name, search.terms, replaced, replay)
    if not replay.is_better:
        return ExtendedResult(found, extension)
    again = examine(drive, extended_model(found.predictor, [t.term for t in search.terms]), config)
    return ExtendedResult(_with_extension(again, extension), extension, robot)


def _with_extension(again: DiagnosisResult, extension: Extension) -> DiagnosisResult:
    """The diagnosis of the extended model, with the terms in its sentence, and its verdict where nothing is left unexplained."""
    d = again.diagnosis
    verdict = "extended" if d.verdict in ("consistent", "explained") else d.verdict
    rest = "" if d.verdict == "consistent" else f" {d.sentence}"
    text = extension.describe()
    return dataclasses.replace(again, diagnosis=dataclasses.replace(d, verdict=verdict, sentence=f"{text[0].upper()}{text[1:]}.{rest}"))


def _gate(predictor: DrivePredictor, search: Search) -> tuple[Robot, HeldOutReplay]:
    """The robot by all windows, and the replay of each half by a file of the other half's sizes."""
    state = search.state
    both = [half[predictor.batch.owner] for half in halves(len(predictor.drive.maneuvers))]

    def robot_of(used: FloatArray) -> tuple[Robot, FloatArray]:
        sizes, terms = sizes_on(predictor, search, used)
        plausible = {state.causes[i]: size for i, size in sizes.items() if abs(size) <= state.causes[i].largest_plausible}
        corrected = correct_robot(predictor, plausible)
        old = predictor.drive.robot.terms
        name = predictor.model.name
        return dataclasses.replace(corrected.robot, terms={**old, name: merge_terms(old.get(name, ()), terms)}), corrected.cg_shift

    before = replay_rows(predictor, predictor.drive.robot, np.zeros_like(predictor.batch.cg))
    after = np.empty_like(before)
    for used, held in (both, both[::-1]):
        half_robot, shift = robot_of(used)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.toml"
            path.write_text(robot_toml(relocated(half_robot, Path(folder))), encoding="utf-8")
            after[held] = replay_rows(predictor, load_robot(path), shift)[held]
    return robot_of(np.ones(len(before), dtype=bool))[0], _compare(predictor, before, after, state.noise.sigmas, both[1])


def replay_rows(predictor: DrivePredictor, robot: Robot, shift: FloatArray) -> FloatArray:
    """(M, 3) discrepancies of every window by the plain model of ``robot``, as replay predicts it; its CG is moved by ``shift`` (N, 2)."""
    drive = predictor.drive
    factors = robot.geometry.radius_multipliers / drive.robot.geometry.radius_multipliers
    shifts = np.split(shift, np.cumsum([len(m.wheels) for m in drive.maneuvers])[:-1])
    maneuvers = tuple(dataclasses.replace(m, wheels=m.wheels * factors, cg=m.cg + s) for m, s in zip(drive.maneuvers, shifts, strict=True))
    changed = dataclasses.replace(drive, robot=robot, maneuvers=maneuvers)
    plain = DrivePredictor(changed, make_model(predictor.model.name, robot), has_inertia=False, baseline=predictor.baseline)
    return plain.discrepancies(Hypothesis())[:, :3]


def _compare(predictor: DrivePredictor, before: FloatArray, after: FloatArray, sigmas: FloatArray, used: FloatArray) -> HeldOutReplay:
    """Both on all windows, each by a file of the half in which it is not; the path on the windows ``used`` (M,)."""
    scaled = [np.nansum((rows / sigmas[:, :3]) ** 2, axis=1) for rows in (before, after)]
    counts = np.isfinite(before).sum(axis=1).astype(float)
    block = np.arange(len(before)) // _BLOCK_WINDOWS
    sums = [np.bincount(block, weights=s) for s in scaled]
    number = np.bincount(block, weights=counts)
    draws = np.random.default_rng(0).multinomial(len(number), np.full(len(number), 1.0 / len(number)), size=_DRAWS)
    old, new = (np.sqrt((draws @ s) / np.maximum(draws @ number, 1.0)) for s in sums)
    rms = [math.sqrt(float(s.sum() / max(number.sum(), 1.0))) for s in sums]
    low, high = np.quantile(1.0 - new / np.maximum(old, 1e-12), [0.025, 0.975])
    gain = Gain(rms[0], rms[1], 1.0 - rms[1] / max(rms[0], 1e-12), float(low), float(high))
    positioned = np.logical_and(used, np.isfinite(before[:, 0]))
    has_positions = bool(positioned.any())
    shown = positioned if has_positions else used
    old_path, new_path = (_path_error(predictor.batch.measured[shown], rows[shown], has_positions) for rows in (before, after))
    return HeldOutReplay(gain, old_path, new_path, "m" if has_positions else "rad", int(shown.sum()))


def _path_error(measured: FloatArray, rows: FloatArray, has_positions: bool) -> float:
    """Root mean square distance [m] of the predicted path from the measured one, windows end to end; or of the headings [rad]."""
    if not has_positions:
        return float(np.sqrt(np.nanmean(np.cumsum(np.nan_to_num(rows[:, 2])) ** 2)))
    truth, path, squares = np.zeros(3), np.zeros(3), []
    for motion, off in zip(measured, rows, strict=True):
        truth = se2.compose(truth, motion)
        path = se2.compose(path, se2.compose(motion, se2.inverse(off)))
        squares.append(float(np.sum((truth - path)[:2] ** 2)))
    return math.sqrt(sum(squares) / max(len(squares), 1))


def suggests_extension(found: DiagnosisResult) -> bool:
    """Whether a search for terms is worth its time: something is left that no cause explains, and windows of motion may show its shape."""
    return found.diagnosis.verdict == "unexplained" and found.predictor is not None and found.predictor.drive.kind in SEARCHED
