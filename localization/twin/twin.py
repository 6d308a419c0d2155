"""The twin of a drive: the user's simulator is compared with it, its wrong numbers are found on one half and judged on the other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from localization.twin import fit
from localization.twin.discrepancy import Row, compare, words
from localization.twin.engine import Engine, Played
from localization.twin.naming import Finding, name_causes, pursue
from localization.twin.parameters import hypotheses_of, law_hypotheses
from localization.twin.simulator import NumberChange, Numbers, Simulator
from localization.twin.stretch import Stretch, end_of, longest_stretch
from localization.twin.windows import Window, halves, spread, windows_of
from localization.twin.xml_file import XmlFile
from motion_models.calibration.cross_validation import Interval, root_mean_gain
from motion_models.calibration.maneuvers import IntArray, Maneuver
from motion_models.friction.model import FrictionModel
from motion_models.robot import Robot
from motion_models.se2 import FloatArray

_CUT = "the time steps of --config.budget-steps were spent before the search for wrong numbers ended: none is named."
_FEWEST_WINDOWS, _CHANGES = 4, 10
"""Windows that are fitted at least, and times that a search changes each number: 8 to 12 in MuJoCo."""


@dataclass(frozen=True)
class TwinConfig:
    """Settings of the search."""

    windows: int = 20
    """Windows that numbers are fitted to, those that differ most among one half of the drive; fewer, where the budget does not suffice."""
    budget_steps: int = 6_000_000
    """Time steps that the search may take, and half of them again for the law: 4 minutes on two cores. Those of DART count 3 times."""
    held_windows: int = 150
    """Windows of the other half on which the simulator is judged, those that differ most."""
    threads: int = 2
    """Threads of the engine. The result does not depend on them."""


@dataclass(frozen=True)
class Judged:
    """A simulator on the windows that are held out."""

    rows: tuple[Row, ...]
    touch: str
    """How its wheels stand on the ground."""
    errors: FloatArray
    """(W,) squared error of each window, headings times half the track width [m^2]."""
    played: Played
    frame: FloatArray
    """(2,) point of the body whose motion was measured, as estimated with it [m]."""


@dataclass(frozen=True)
class Mended:
    """The simulator with the numbers that explain the motion."""

    name: str
    """numbers, contact law, or wheel slip."""
    numbers: Numbers
    file: XmlFile
    beside: Mapping[str, str]
    """Files that are written beside it, by name."""
    changes: tuple[NumberChange, ...]
    judged: Judged
    gain: Interval
    """Root mean square error of the file less that of this one, on the windows held out [m]."""

    @property
    def is_better(self) -> bool:
        """The gate: better on windows that it was not fitted to, beyond their scatter."""
        return self.gain.low > 0.0

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "name": self.name,
            "rows": [row.to_dict() for row in self.judged.rows],
            "touch": self.judged.touch,
            "frame_m": self.judged.frame.tolist(),
            "changes": [change.to_dict() for change in self.changes],
            "gain_m": [self.gain.value, self.gain.low, self.gain.high],
            "is_better": self.is_better,
        }


@dataclass(frozen=True)
class TwinResult:
    """What `examine` finds."""

    simulator: Simulator
    windows: tuple[Window, ...]
    """Those that are held out."""
    fitted: int
    """Number of windows that numbers were fitted to."""
    before: Judged
    findings: tuple[Finding, ...]
    mended: Mended
    """With other numbers of the engine."""
    extended: Mended | None
    """With friction in proportion to slip; None where the file has it, or the robot does not stand with it."""
    notes: tuple[str, ...]
    steps: int
    """Time steps that the search took."""
    words: tuple[str, ...] = field(default=())
    ends: tuple[Stretch, ...] = ()
    """Where the longest stretch without a gap ends, in the file and with each repair; empty for tables. Half of it was fitted."""

    @property
    def repaired(self) -> tuple[Mended, ...]:
        """Both repairs, or one."""
        return (self.mended,) if self.extended is None else (self.mended, self.extended)

    @property
    def best(self) -> Mended:
        """The repair with the smallest errors on the windows held out."""
        return max(self.repaired, key=lambda m: m.gain.value)

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        best = self.best
        row, after = self.before.rows[-1], best.judged.rows[-1]
        if not self.words:
            return "The simulator moves as the robot did, within the scatter of these windows."
        first = f"The simulator is wrong: {self.words[0]}."
        if not best.is_better:
            return f"{first} No numbers of its engine make it better on windows held out, nor does the {self.simulator.law_name}."
        means = "other numbers" if best.name == "numbers" else f"the {best.name}"
        errors = [
            f"{old:.3f} to {new:.3f} {unit}"
            for old, new, unit in (
                (row.position_rms_m, after.position_rms_m, "m"),
                (row.heading_rms_rad, after.heading_rms_rad, "rad"),
            )
            if math.isfinite(old)
        ]
        return f"{first} With {means}, errors on windows held out fall from {' and from '.join(errors)}."

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "sentence": self.sentence,
            "wrong": list(self.words),
            "windows": {"fitted": self.fitted, "held_out": len(self.windows)},
            "findings": [{**f.best.__dict__, "rivals": [r.__dict__ for r in f.rivals]} for f in self.findings],
            "before": {"rows": [r.to_dict() for r in self.before.rows], "touch": self.before.touch},
            "repairs": [m.to_dict() for m in self.repaired],
            "stretch": [end.__dict__ for end in self.ends],
            "notes": list(self.notes),
        }


def examine(maneuvers: Sequence[Maneuver], robot: Robot, simulator: Simulator, config: TwinConfig | None = None) -> TwinResult:
    """Compare the ``simulator`` of ``robot`` with measured ``maneuvers``, find its wrong numbers and judge them on the other half.

    Raises `SimulationError` for a file without a robot on wheels, `CalibrationError` for a drive that shows nothing.
    """
    config = config or TwinConfig()
    windows, hypotheses = windows_of(maneuvers, robot), hypotheses_of(simulator, robot)
    first, second = halves(windows)
    count = _affordable(simulator, windows[first[0]], len(hypotheses.parameters), config)
    chosen = first[spread([windows[i] for i in first], robot, count)]
    fitted, rest = [windows[i] for i in chosen], [windows[i] for i in first if i not in chosen]
    held = [windows[i] for i in second[spread([windows[i] for i in second], robot, config.held_windows)]]
    problem = fit.Problem(simulator, hypotheses, fitted, config.budget_steps)
    start, findings, best = _search(problem, [rest[i] for i in spread(rest, robot, config.windows)] if rest else [])
    before = judge(simulator, simulator.numbers, held, robot, _frame_alone(problem, start))
    mended = mend("numbers", problem, fit.pruned(problem, best), held, robot, before)
    extended = extend(problem, held, robot, before)
    tried = [("file", simulator.numbers, before), *((m.name, m.numbers, m.judged) for m in (mended, extended) if m is not None)]
    return TwinResult(
        simulator,
        tuple(held),
        len(fitted),
        before,
        tuple(findings or ()) if mended.is_better else (),  # no cause that the windows held out contradict
        mended,
        extended,
        (*simulator.notes, *((_CUT,) if findings is None else ())),
        problem.steps,
        tuple(words(before.rows)),
        tuple(_ends(simulator, tried, longest_stretch(windows))),
    )


def _affordable(simulator: Simulator, window: Window, numbers: int, config: TwinConfig) -> int:
    """Windows that the budget can play with each of the ``numbers`` changed ten times, by the time steps of one ``window``."""
    steps = simulator.engine.play([window]).steps
    return min(config.windows, max(_FEWEST_WINDOWS, config.budget_steps // (_CHANGES * numbers * steps)))


def _search(problem: fit.Problem, other: Sequence[Window]) -> tuple[fit.Point, list[Finding] | None, fit.Point]:
    """The file, the numbers that are wrong (None where the budget was spent before they were searched) and the best point found.

    ``other`` windows are predicted: nothing is fitted to them, and nothing judged by them.
    """
    motion = replace(problem, noise=fit.MOTION_ALONE)
    start = fit.start(motion)
    pursued = pursue(motion, start)
    is_cut = motion.is_late
    problem.steps = motion.steps
    start, pursued = problem.rescored(start), problem.rescored(pursued)
    is_explained = not is_cut and problem.explains(pursued)
    whole = pursued if is_explained else fit.fit_all(problem, start)
    if is_cut:
        return start, None, whole
    if problem.rescored(pursued).cost <= whole.cost:
        problem.estimate_noise(pursued)
        whole = problem.rescored(whole)
    motion = replace(problem, noise=problem.noise * fit.MOTION_ALONE)
    tried = [motion.rescored(p) for p in ((pursued,) if is_explained else (whole, pursued))]
    findings, sparse = name_causes(motion, motion.rescored(start), tried, replace(motion, windows=other))
    problem.steps, sparse = motion.steps, problem.rescored(sparse)
    return start, findings, whole if whole.cost < sparse.cost - _occam(problem, whole, sparse) else sparse


def _ends(simulator: Simulator, tried: Sequence[tuple[str, Numbers, Judged]], stretch: Sequence[Window]) -> list[Stretch]:
    """Where a ``stretch`` ends with the numbers of each simulator that was ``tried``."""
    found = []
    for name, numbers, judged in tried if stretch else ():
        found.append(end_of(name, stretch, _engine(simulator, numbers).play(stretch), judged.frame))
    return found


def _engine(simulator: Simulator, numbers: Numbers) -> Engine:
    return simulator.engine if numbers == simulator.numbers else simulator.compiled(numbers)


def _frame_alone(problem: fit.Problem, start: fit.Point) -> FloatArray:
    """The point that was measured, by the file's own numbers: errors of the reference's frame are no errors of the simulator."""
    return problem.frame(problem.minimize(start, problem.hypotheses.of_reference, 3).x)


def _occam(problem: fit.Problem, whole: fit.Point, sparse: fit.Point) -> float:
    """What the numbers that only the ``whole`` fit changes gain by chance [nats]: half the logarithm of the shrinking of each prior."""
    columns = [i for i in range(len(whole.x)) if whole.x[i] != 0.0 and sparse.x[i] == 0.0]
    if not columns:
        return 0.0
    J = problem.jacobian(whole, columns).reshape(-1, len(columns)) * problem.hypotheses.sigmas[columns]
    return 0.5 * float(np.linalg.slogdet(np.eye(len(columns)) + J.T @ J)[1])


def judge(simulator: Simulator, numbers: Numbers, windows: Sequence[Window], robot: Robot, frame: FloatArray) -> Judged:
    """The simulator with ``numbers`` on ``windows``."""
    return judged(_engine(simulator, numbers).play(windows), windows, robot, frame)


def judged(played: Played, windows: Sequence[Window], robot: Robot, frame: FloatArray) -> Judged:
    """What an engine played of ``windows``, compared with the measured motion."""
    off = fit.residuals_of(windows, played, frame)[:, :3] * np.array([1.0, 1.0, 0.5 * robot.geometry.track_width_m])
    errors = np.where(np.isfinite(np.array([np.diagonal(w.cov) for w in windows])), off, 0.0)
    rows = compare(windows, played, robot, frame)
    return Judged(tuple(rows), played.touch.describe(), np.asarray((errors**2).sum(axis=1)), played, frame)


def extend(problem: fit.Problem, windows: Sequence[Window], robot: Robot, before: Judged) -> Mended | None:
    """The simulator with friction in proportion to slip in place of its own, from the robot's friction model's on, judged as `mend`."""
    simulator, model = problem.simulator, FrictionModel.from_robot(robot)
    if not math.isnan(simulator.numbers.slip_stiffness):
        return None
    mu, stiffness = (float(model.nominal[model.param_names.index(name)]) for name in ("mu", "slip_stiffness"))
    of_law = fit.Problem(simulator, law_hypotheses(simulator, problem.hypotheses), problem.windows, problem.budget_steps // 2)
    at = fit.fit_law(of_law, simulator.with_law(mu, stiffness))
    problem.steps += of_law.steps
    return None if at is None else mend(simulator.law_name, of_law, fit.pruned(of_law, at), windows, robot, before)


def mend(name: str, problem: fit.Problem, at: fit.Point, windows: Sequence[Window], robot: Robot, before: Judged) -> Mended:
    """The simulator ``at`` a point, judged on ``windows`` against ``before``."""
    simulator = problem.simulator
    numbers = problem.hypotheses.applied(at.base, at.x)
    after = judge(simulator, numbers, windows, robot, problem.frame(at.x))
    changed = [(p.field, p.meaning, p.attribute) for p in problem.hypotheses.parameters if p.area != "reference"]
    changed += [(switch.field, switch.meaning, switch.attribute) for switch in problem.hypotheses.switches]
    values = [(float(getattr(simulator.numbers, field)), float(getattr(numbers, field))) for field, _, _ in changed]
    changes = [NumberChange(*of, old, new) for of, (old, new) in zip(changed, values, strict=True) if old != new]
    gain = root_mean_gain(before.errors, after.errors, _blocks(windows), np.random.default_rng(0))
    beside = {} if name == "numbers" else simulator.law_files
    return Mended(name, numbers, simulator.with_numbers(numbers), beside, tuple(changes), after, gain)


def _blocks(windows: Sequence[Window]) -> IntArray:
    """(W,) index of the group of each window, whose errors are alike."""
    names = {name: i for i, name in enumerate(dict.fromkeys(w.group for w in windows))}
    return np.array([names[w.group] for w in windows], dtype=np.int64)


def provenance(result: TwinResult, m: Mended, source: str) -> str:
    """Comment of a written file: where its numbers are from, and how well they do."""
    lines = [f"Numbers found by skidloc twin on {source}: {result.fitted} windows fitted, {len(result.windows)} held out."]
    lines += [change.describe() for change in m.changes]
    lines += [f"The wheels' friction is that of {name} beside this file: without it they have none." for name in m.beside]
    lines.append(f"Held out: error (position, heading times half the track) smaller by {m.gain} m; {m.judged.touch}.")
    return "\n     ".join(lines)
