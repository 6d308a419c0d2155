"""Which numbers of a simulator are wrong: Bayesian selection among all of them, at the simulator that explains the motion.

About the fitted simulator, motion is linear in its numbers: y = J z + e with whitened noise e, z over the priors' sigmas, and z = 0 the
file's own value. A set S of wrong numbers has the evidence (MacKay 2003, ch. 28)

    ln p(y | S) = -(c - b' M^-1 b) / 2 - ln det M / 2,    M = I + J_S' J_S,  b = J_S' (y - J_S m),  c = |y - J_S m|^2

with m the robot file's value, and a prior: each number is right with odds of 20 to 1, times its likelihood by the robot file.
Numbers that may take another's place in S within odds of 20 to 1 cannot be separated from it by these data. Where wheels hop, the best of
many plays is better by chance: sets are compared by further plays of each, and odds count beyond the scatter of their means.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from localization.twin.fit import Point, Problem
from localization.twin.parameters import GROUNDED, Switch, value_of
from localization.twin.simulator import Numbers
from motion_models.se2 import FloatArray

SEPARATED_NATS = math.log(20.0)
"""Odds of 20 to 1."""
_ITERATIONS = 6
_MOST_PURSUED, _TRIED, _TRIED_ITERATIONS = 3, 3, 3
"""Numbers that are added one after another, how many are tried for each by their own fits, and the iterations of these."""
_REPLICATES, _SCATTERS = 6, 2.0
"""How often an engine that may be chaotic plays each of two fits whose odds are compared, and how many standard errors of their difference
these must exceed."""
CONTACTS = "contacts"
_HOP = "contacts at which the wheels hop, time that a wheel is on the ground"
_HOPS = 0.1
"""Share of the time that contacts return a wheel to the ground from which on they are named together."""


@dataclass(frozen=True)
class Candidate:
    """One number that would explain the motion."""

    field: str
    meaning: str
    unit: str
    attribute: str
    area: str
    file: float
    """Value of the file."""
    value: float
    """Value that explains the motion."""
    evidence: float
    """Logarithm of the odds that the file's value is wrong [nats]."""

    def describe(self) -> str:
        """One sentence.

        >>> Candidate("mu", "friction of the wheels' contacts", "", "geom friction[0]", "contact", 0.5, 1.0, 9.0).describe()
        "friction of the wheels' contacts: 1 explains the motion, the file has 0.5"
        """
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.meaning}: {self.value:.3g}{unit} explains the motion, the file has {self.file:.3g}{unit}"


@dataclass(frozen=True)
class Finding:
    """A number that is wrong, or one of those that cannot be separated."""

    best: Candidate
    rivals: tuple[Candidate, ...]
    """Those that data cannot separate from it, best first."""

    def describe(self) -> str:
        """One sentence, with the rivals."""
        if not self.rivals:
            return f"{self.best.describe()}."
        others = ", ".join(f"{r.meaning} ({r.file:.3g} -> {r.value:.3g})" for r in self.rivals)
        return f"{self.best.describe()}; these data cannot separate it from: {others}."


@dataclass(frozen=True)
class Selection:
    """Linear model of a simulator's numbers about a fitted one."""

    information: FloatArray
    """(p, p) J' J."""
    projection: FloatArray
    """(p,) J' y."""
    square: float
    """|y|^2"""
    priors: FloatArray
    """(p,) values of the robot file over the priors' sigmas."""
    free: tuple[int, ...]
    """Numbers of the reference: never the simulator's fault."""

    def evidence(self, chosen: Sequence[int]) -> float:
        """Logarithm of the posterior of the set ``chosen`` without constants [nats]."""
        M, b, c = self.system(chosen)
        root = np.linalg.cholesky(M)
        half = np.linalg.solve(root, b)
        right = [i for i in range(len(self.priors)) if i not in chosen and i not in self.free]
        return float(
            -0.5 * (c - half @ half) - np.log(np.diag(root)).sum() - 0.5 * (self.priors[right] ** 2).sum() - SEPARATED_NATS * len(chosen)
        )

    def values(self, chosen: Sequence[int]) -> FloatArray:
        """(p,) posterior means over the priors' sigmas; 0 for numbers that are not ``chosen``."""
        M, b, _ = self.system(chosen)
        index = [*self.free, *chosen]
        z = np.zeros(len(self.priors))
        z[index] = self.priors[index] + np.linalg.solve(M, b)
        return z

    def system(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray, float]:
        """M (s, s), b (s,) and c of the equation above, of the reference's numbers and those ``chosen``."""
        index = [*self.free, *chosen]
        G, g, m = self.information[np.ix_(index, index)], self.projection[index], self.priors[index]
        return np.eye(len(index)) + G, g - G @ m, self.square - 2.0 * float(m @ g) + float(m @ G @ m)

    def best_set(self) -> tuple[int, ...]:
        """The set of highest posterior: the best pair, then added to, dropped from and exchanged as long as that is better."""
        others = [i for i in range(len(self.priors)) if i not in self.free]
        best = max((s for n in range(3) for s in itertools.combinations(others, n)), key=self.evidence)
        while True:
            more = [(*best, j) for j in others if j not in best]
            fewer = [tuple(k for k in best if k != i) for i in best]
            exchanged = [(*rest, j) for rest in fewer for j in others if j not in best]
            better = max((*more, *fewer, *exchanged), key=self.evidence)
            if self.evidence(better) <= self.evidence(best):
                return best
            best = better


def pursue(problem: Problem, start: Point) -> Point:
    """The few numbers by which the file comes nearest to the motion: one after another, the one that is best after its own fit.

    A search in all numbers at once may end where many small changes stand for one, as friction that was halved is far from what a linear
    model about the file foresees.
    """
    h = problem.hypotheses
    free = h.of_reference
    chosen: tuple[int, ...] = ()
    at = problem.minimize(start, free, 2)
    while len(chosen) < _MOST_PURSUED and not problem.is_late:
        about = Linear.about(problem, at)
        others = [i for i in range(len(h.parameters)) if i not in free and i not in chosen]
        others.sort(key=lambda j: -about.selection.evidence((*chosen, j)))
        fits = [(j, problem.minimize(at, [*free, *chosen, j], _TRIED_ITERATIONS)) for j in others[:_TRIED]]
        added, best = max(fits, key=lambda fit: about.posterior(fit[1], (*chosen, fit[0])))
        if about.posterior(best, (*chosen, added)) <= about.posterior(at, chosen):
            break
        at, chosen = best, (*chosen, added)
    return at


@dataclass(frozen=True)
class Linear:
    """The numbers' linear model about a point."""

    at: Point
    selection: Selection
    file: Numbers

    @classmethod
    def about(cls, problem: Problem, at: Point) -> Linear:
        """By secants ``at`` a point."""
        h = problem.hypotheses
        J = (problem.jacobian(at, range(len(h.parameters))) * h.sigmas).reshape(-1, len(h.parameters))
        y = J @ (at.x / h.sigmas) - problem.whitened(at.residuals).ravel()
        selection = Selection(J.T @ J, J.T @ y, float(y @ y), h.priors / h.sigmas, h.of_reference)
        return cls(at, selection, problem.simulator.numbers)

    def posterior(self, fit: Point, chosen: Sequence[int]) -> float:
        """Logarithm of the posterior of the set ``chosen`` by its own ``fit``, without constants [nats]."""
        M, _, _ = self.selection.system(chosen)
        wrong = len(chosen) + (fit.base != self.file)
        return -fit.cost - 0.5 * float(np.linalg.slogdet(M)[1]) - SEPARATED_NATS * wrong


def name_causes(problem: Problem, start: Point, tried: Sequence[Point], other: Problem) -> tuple[list[Finding], Point]:
    """Findings, strongest first, and the simulator with their numbers alone. ``start`` is the file; about each point that was ``tried`` a
    set of wrong numbers is chosen and fitted, and that of the highest posterior counts, without what it can do without.

    A number is named where its odds to be wrong are above 20 to 1, by these windows and by what the fits predict of the ``other`` ones:

        ln p(y, y' | S) = ln p(y | S) + ln p(y' | y, S)
    """
    sets = [_sparse(problem, at) for at in tried]
    about, chosen, sparse = max(sets, key=lambda of: of[0].posterior(of[2], of[1]))
    chosen, sparse, scatter = _without_needless(problem, about, chosen, sparse, other)
    margin = SEPARATED_NATS + _SCATTERS * scatter
    findings = [_finding(problem, about.selection, chosen, i, about.at.base, margin) for i in chosen]
    findings += [Finding(c, ()) for s in problem.hypotheses.switches if (c := _switched(problem, start, sparse, s)) is not None]
    findings += [Finding(c, ()) for c in (_coarse_step(problem, sparse),) if c is not None]
    findings = _together(findings, start, about.at)
    return sorted(findings, key=lambda finding: -finding.best.evidence), sparse


def _sparse(problem: Problem, at: Point) -> tuple[Linear, tuple[int, ...], Point]:
    """The best set of numbers by the linear model about a point, and its fit."""
    about, h = Linear.about(problem, at), problem.hypotheses
    chosen = about.selection.best_set()
    low, high = h.bounds(at.base)
    first = problem.point(at.base, np.clip(about.selection.values(chosen) * h.sigmas, low, high))
    columns = [*about.selection.free, *chosen]
    second = problem.point(at.base, np.where(np.isin(np.arange(len(at.x)), columns), at.x, 0.0))
    starts = [p for p in (first, second) if p is not None]
    return about, chosen, problem.minimize(min(starts, key=lambda p: p.cost), columns, _ITERATIONS) if starts else at


def _without_needless(
    problem: Problem, about: Linear, chosen: tuple[int, ...], fit: Point, other: Problem
) -> tuple[tuple[int, ...], Point, float]:
    """The set without each number whose odds, by a fit of the others, are less than 20 to 1 beyond the engine's scatter; its fit; and that
    scatter [nats]."""

    def posteriors(of: Point, numbers: Sequence[int]) -> FloatArray:
        played = problem.misfits(of, _REPLICATES) + other.misfits(of, _REPLICATES)
        return about.posterior(of, numbers) + problem.misfit(of) - played

    whole, is_smaller = posteriors(fit, chosen), True
    while is_smaller:
        is_smaller = False
        for rest, without in _left_out(problem, about, chosen, fit):
            of_rest = posteriors(without, rest)
            if _odds(whole, of_rest) < SEPARATED_NATS:
                chosen, fit, whole, is_smaller = rest, without, of_rest, True
                break
    return chosen, fit, float(whole.std(ddof=1))


def _odds(of: FloatArray, against: FloatArray) -> float:
    """How much the posteriors ``of`` (n,) a set exceed those ``against`` it (n,) at least, by the scatter of their means [nats]."""
    error = math.sqrt(float(of.var(ddof=1) + against.var(ddof=1)) / len(of))
    return float(of.mean() - against.mean()) - _SCATTERS * error


def _left_out(problem: Problem, about: Linear, chosen: tuple[int, ...], fit: Point) -> list[tuple[tuple[int, ...], Point]]:
    """Fits of the ``chosen`` numbers without one of them, that of the weakest first."""
    found = []
    for i in chosen:
        rest = tuple(j for j in chosen if j != i)
        first = problem.point(fit.base, np.where(np.arange(len(fit.x)) == i, 0.0, fit.x))
        if first is not None:
            found.append((rest, problem.minimize(first, [*about.selection.free, *rest], _TRIED_ITERATIONS)))
    return sorted(found, key=lambda of: -about.posterior(of[1], of[0]))


def _finding(problem: Problem, selection: Selection, chosen: Sequence[int], index: int, file: Numbers, margin: float) -> Finding:
    """The number ``index`` of those that are ``chosen``, with those that may take its place within a ``margin`` of evidence [nats]."""
    rest = tuple(i for i in chosen if i != index)
    alone, whole = selection.evidence(rest), selection.evidence(chosen)
    rivals = []
    for j in range(len(selection.priors)):
        if j not in selection.free and j not in chosen and (other := selection.evidence((*rest, j))) > whole - margin:
            rivals.append(_candidate(problem, selection, (*rest, j), j, file, other - alone))
    best = _candidate(problem, selection, chosen, index, file, whole - alone)
    return Finding(best, tuple(sorted(rivals, key=lambda c: -c.evidence)))


def _candidate(problem: Problem, selection: Selection, chosen: Sequence[int], index: int, file: Numbers, evidence: float) -> Candidate:
    p = problem.hypotheses.parameters[index]
    old, z = value_of(file, p), float(selection.values(chosen)[index]) * p.sigma
    return Candidate(p.field, p.meaning, p.unit, p.attribute, p.area, old, old * math.exp(z) if p.is_log else old + z, evidence)


def _switched(problem: Problem, start: Point, whole: Point, switch: Switch) -> Candidate | None:
    """A choice of the file that ``whole`` has changed, with its evidence there."""
    old, new = (float(getattr(of.base, switch.field)) for of in (start, whole))
    kept = None if old == new else problem.point(start.base, whole.x)
    if kept is None:
        return None
    evidence = _odds(-problem.misfits(whole, _REPLICATES), -problem.misfits(kept, _REPLICATES)) - SEPARATED_NATS
    if evidence < 0.0:
        return None
    return Candidate(switch.field, switch.meaning, "", switch.attribute, "contact", old, new, evidence)


def _coarse_step(problem: Problem, at: Point) -> Candidate | None:
    """The engine's time step, where half of it brings the motion nearer to the measured one by odds of 20 to 1."""
    old = at.base.time_step_s
    if "time_step_s" in problem.simulator.absent:
        return None
    halved = problem.point(replace(at.base, time_step_s=0.5 * old), at.x)
    evidence = -math.inf if halved is None else at.cost - halved.cost - SEPARATED_NATS
    if evidence < SEPARATED_NATS:
        return None
    return Candidate("time_step_s", "time step", "s", "option timestep", "engine", old, 0.5 * old, evidence)


def _together(findings: list[Finding], start: Point, whole: Point) -> list[Finding]:
    """Numbers of contacts at which wheels hop as one finding, where the motion takes contacts at which they do not."""
    of_hop = [f for f in findings if f.best.field in GROUNDED or f.best.field == "is_elliptic"]
    old, new = (1.0 - float(of.residuals[:, 5].mean()) for of in (start, whole))
    if len(of_hop) < 2 or new - old < _HOPS:
        return findings
    evidence = max(f.best.evidence for f in of_hop)
    attribute = "geom solref, solimp; option impratio, cone"
    together = Candidate(CONTACTS, _HOP, "%", attribute, "contact", 100.0 * old, 100.0 * new, evidence)
    return [Finding(together, ()), *(f for f in findings if f not in of_hop)]
