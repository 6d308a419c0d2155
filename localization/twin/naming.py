"""Which numbers of a simulator are wrong: one after another, each the one that explains most of what is left, beside its rivals.

Evidence of a number is the gain of the posterior by it alone, less what a free number gains by chance (Laplace's approximation;
MacKay 2003, ch. 28): D = cost before - cost after - ln(1 + sigma^2 J^T J) / 2. Numbers whose evidence is within ``SEPARATED_NATS`` of the
best cannot be separated from it by these data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from localization.twin.fit import Point, Problem
from localization.twin.numbers import Numbers
from localization.twin.parameters import GROUNDED, Parameter, value_of

SEPARATED_NATS = math.log(20.0)
"""Odds of 20 to 1."""
_MOST_FINDINGS = 4
_TRIED = 6
"""Numbers that are searched for themselves, the best ones by secants."""
_ITERATIONS = 2
_CONVERGING = 8
"""Iterations after which a finding's own number has converged: else what is left of it is taken for another's."""
CONTACTS = "contacts"
_HOP = "contacts at which the wheels hop, time that a wheel is on the ground"


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
    """[nats]"""

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


def name_causes(problem: Problem, start: Point, floor: float) -> tuple[list[Finding], Point]:
    """Findings, strongest first, and the simulator with all of them; until nothing has evidence, or ``floor`` is reached: the cost of the
    simulator whose numbers are all fitted [nats]."""
    found: list[Finding] = []
    at = start
    chosen = [i for i, p in enumerate(problem.hypotheses.parameters) if p.area == "reference"]
    at = problem.minimize(at, chosen, _ITERATIONS) if chosen else at
    while len(found) < _MOST_FINDINGS and at.cost > floor + SEPARATED_NATS and not problem.is_late:
        tried = _tried(problem, at, chosen)
        if not tried or tried[0][0].evidence < SEPARATED_NATS:
            break
        best, point, columns = tried[0]
        rivals = tuple(c for c, _, _ in tried[1:] if c.evidence > best.evidence - SEPARATED_NATS)
        found.append(Finding(best, rivals))
        at, chosen = problem.minimize(point, columns, _CONVERGING), columns
    return found, at


def _tried(problem: Problem, at: Point, chosen: list[int]) -> list[tuple[Candidate, Point, list[int]]]:
    """Candidates beside those that are ``chosen``, best first, each with its simulator."""
    h = problem.hypotheses
    others = [i for i in range(len(h.parameters)) if i not in chosen]
    J = problem.jacobian(at, others).reshape(-1, len(others)) * h.sigmas[others]
    z = (at.x[others] - h.priors[others]) / h.sigmas[others]
    b = J.T @ problem.whitened(at.residuals).ravel() + z
    information = 1.0 + (J**2).sum(axis=0)
    promise = 0.5 * b**2 / information
    tried = []
    for k in np.argsort(-promise)[:_TRIED]:
        if promise[k] < 1.0:
            break
        columns = [*chosen, others[k]]
        point = problem.minimize(at, columns, _ITERATIONS)
        evidence = at.cost - point.cost - 0.5 * math.log(information[k])
        tried.append((_candidate(h.parameters[others[k]], at.base, point, others[k], evidence), point, columns))
    if not any(h.parameters[i].field in GROUNDED for i in chosen) and (hopping := _grounded(problem, at, chosen)) is not None:
        tried.append(hopping)
    for switch in h.switches:
        base = replace(at.base, **{switch.field: switch.value})
        switched = problem.point(base, at.x)
        if switched is not None and getattr(at.base, switch.field) != getattr(base, switch.field):
            file = float(getattr(at.base, switch.field))
            candidate = Candidate(
                switch.field, switch.meaning, "", switch.attribute, "contact", file, switch.value, at.cost - switched.cost
            )
            tried.append((candidate, switched, chosen))
    return sorted(tried, key=lambda of: -of[0].evidence)


def _grounded(problem: Problem, at: Point, chosen: list[int]) -> tuple[Candidate, Point, list[int]] | None:
    """All numbers of the contacts together, from where wheels keep to the ground."""
    h = problem.hypotheses
    columns = [*chosen, *(i for i, p in enumerate(h.parameters) if p.field in GROUNDED or p.field == "mu")]
    columns = list(dict.fromkeys(columns))
    starts = []
    for is_elliptic in (0.0, 1.0):
        base = replace(at.base, is_elliptic=is_elliptic)
        x = np.where(np.isin(np.arange(len(at.x)), columns[len(chosen) :]), h.grounded(base), at.x)
        starts.append(problem.point(base, x))
    stood = [start for start in starts if start is not None]
    if not stood:
        return None
    point = problem.minimize(min(stood, key=lambda start: start.cost), columns, _ITERATIONS)
    J = problem.jacobian(point, columns[len(chosen) :]).reshape(-1, len(columns) - len(chosen)) * h.sigmas[columns[len(chosen) :]]
    occam = 0.5 * float(np.linalg.slogdet(np.eye(J.shape[1]) + J.T @ J)[1])
    old, new = (100.0 * (1.0 - float(of.residuals[:, 5].mean())) for of in (at, point))
    candidate = Candidate(
        CONTACTS, _HOP, "%", "geom solref, solimp; option impratio, cone", "contact", old, new, at.cost - point.cost - occam
    )
    return candidate, point, columns


def _candidate(p: Parameter, file: Numbers, point: Point, index: int, evidence: float) -> Candidate:
    old = value_of(file, p)
    new = old * math.exp(point.x[index]) if p.is_log else old + point.x[index]
    return Candidate(p.field, p.meaning, p.unit, p.attribute, p.area, old, float(new), evidence)


def changed_numbers(problem: Problem, at: Point) -> list[tuple[Parameter, float, float]]:
    """Each number that differs from the file's, with the file's value and its own."""
    found = []
    for i, p in enumerate(problem.hypotheses.parameters):
        old = value_of(at.base, p)
        new = old * math.exp(at.x[i]) if p.is_log else old + float(at.x[i])
        if at.x[i] != 0.0:
            found.append((p, old, new))
    return found
