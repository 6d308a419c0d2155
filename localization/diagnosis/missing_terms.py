"""Terms missing in a motion model: sparse regression of what a drive leaves unexplained, through the integration of its windows.

With y discrepancies of the drive, S signatures of causes within their tolerance, N nuisances and T what candidate terms of unit
coefficient move at each measured pose, all whitened by the drive's noise,

    y = S x + N z + T c + e,     x ~ N(0, tolerance^2), c sparse.

Terms and findings of the diagnosis compete: sets are searched by steps that add, drop or exchange one of them, each at the price of the
extended BIC (Chen & Chen 2008), so that a term takes the place of a physical name that explains the drive less well. Stability selection
(Meinshausen & Buehlmann 2010): the share of random halves of the drive in which the same term is found. As a candidate weak form of SINDy
(Messenger & Bortz 2021), rates are never differentiated.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from localization.diagnosis.bound_effects import BoundShape, bound_columns
from localization.diagnosis.causes.cause import Cause, Hypothesis, with_sizes
from localization.diagnosis.drive_predictor import CHANNELS, DrivePredictor, moved_by
from localization.diagnosis.linearization import TOLERANCE, Linearization, linearize, noise_beside
from localization.diagnosis.model_extension import FoundEffect, FoundTerm
from localization.diagnosis.noise import Noise, reference_noise
from localization.diagnosis.parameter_laws import Law, parameter_laws
from localization.diagnosis.placebos import LEVEL, Candidates, free, joint_statistic, modulated, placebo_p, placebo_statistics
from localization.diagnosis.result import DiagnosisResult
from motion_models.calibration.prediction import series_of
from motion_models.extended_model import ExtendedModel
from motion_models.se2 import FloatArray
from motion_models.term_memory import CONSTANTS
from motion_models.terms import COMPONENTS, VARIABLES, Expression, Term, parse_expression, with_memory

_POWERS = ("", "{0}", "abs({0})", "{0}^2", "{0}*abs({0})", "sign({0})", "{0}^3")
"""Shapes of one variable: even and odd, to the third power, as slip grows."""
_ONE_SIDED = ("max({0},0)", "min({0},0)")
"""Shapes that act to one side alone, as a slip in left turns, or in arcs to the left backwards. By abs() such a law is half in a term, and
half in what is tolerated of the causes, which no file holds."""
_OF_CAUSES = frozenset({("vx", "v"), ("vx", "wz"), ("vy", "v"), ("vy", "wz"), ("wz", "v"), ("wz", "wz")})
"""Shapes of causes of the catalogue: radii, rotation scaling, centre of rotation, yaw of the reference. A term has them only where such a
cause would be larger than robots have it."""
_OF_CAUSES_PRICE = 7.0
"""Price of a term with the shape of a cause, in twice the log-odds: 33 robots have the cause for one that turns so without."""
_MORE = {
    "vx": ("dv", "abs(dv)", "sign(v)*abs(dv)", "v*abs(dv)", "dv*abs(v)", "dwz"),
    "vy": ("dwz", "v*dwz", "wz*dv", "v*dv", "dv"),
    "wz": ("dwz", "abs(dwz)*sign(wz)", "wz*abs(dv)", "wz*dv", "v*dwz", "dv"),
}
"""Accelerations."""
_MAX_DEGREE = 4
"""Most powers of speed and yaw rate in a term: products of more fit a drive as well, and are many times too large on a faster one. By
three, less is removed of laws that are no product of so few (`tests.studies.unseen_effects`, draws 5 and 6)."""
_WARMING = {"vx": ("v", "wz", "abs(v)"), "vy": ("v", "wz", "v*wz"), "wz": ("v", "wz", "abs(wz)")}
"""Motions whose share changes while tyres and gears warm up, by component."""
_TIME_CONSTANTS = (0.125, 0.25, 0.5, 1.0)
"""Time constants of what warms up, over the drive's length: with the last it is nearly a drift with t, which has no bound on longer drives,
and what is faster is over before it is measured."""
_SHORTEST_S = 16.0
"""Drive in which what warms up can be measured: eight windows [s]."""
_OF_CG = [f"{motion}*cg_{axis}" for motion in ("v", "wz", "abs(v)", "abs(wz)", "wz*abs(wz)") for axis in "xy"]
"""Motions whose share differs with the posture: a radius by the load on it, how far turns go, and slip to the side."""
_LAGS_S = (0.15, 0.3, 0.6, 1.2)
_SWINGS = tuple(itertools.product((0.3, 0.5, 0.8, 1.3), (0.1, 0.3)))
"""Frequencies [Hz] and damping ratios of loads that swing."""
_PLAYS = (0.15, 0.4)
"""Half the width of a hysteresis, over the root mean square of its variable."""
_PROFILED = (1.5, 1.25, 1.25, 1.12, 1.12, 1.06, 1.06)
"""Ratios by which constants of a memory are changed, one after the other: from a half of the steps of the library to 6 %."""
_LEAST_PLAY = 0.01
"""Rate below which a hysteresis is noise [m/s, rad/s]."""
_CG_MOVES_M = 0.005
_COLLINEAR = 0.02  # least share of a column's squares that those already chosen leave
_ASYMMETRIC_PRICE = 2.0 * math.log(3.0)
"""Price of a term that a robot with equal sides does not have; two in three robots have such sides."""
_COMPLEXITY_PRICE = 1.5
"""Price of each factor beyond the first, in twice the log-odds: of two shapes that fit alike the simpler is taken."""
_OWN_MOTIONS = {"vx": ("v",), "vy": ("v", "wz"), "wz": ("wz",)}
"""Motions whose share of a component may change along a drive."""
_SHORTEST_CHANGE_S = 16.0
"""Period of the fastest such change: two blocks of four windows [s]."""
_ROUNDS, _STEPS = 4, 12
_SIZE_SHARE = 0.75
"""Largest size of a cause in the search, over the largest that robots have: by full predictions, and by half of a drive, it differs."""
_TRIED = 6
"""Columns that are tried in one place, until one has a size that robots have."""
_MOST = 4
"""Most terms of one extension."""
_HALVES = 40
_ALIKE = 0.9
"""Correlation of two candidates that one drive does not separate."""
_SAME_LAG = 2.0
"""Ratio of the gains in speed and in turning rate up to which they may be one clock."""
_MIN_STABILITY = 0.5
SEARCHED = ("log", "windows")
"""Kinds of drives whose windows have all kinds of motion."""
_NEWTON_STEPS = 2
_RIVAL_LOG_ODDS = 7.0
"""Twice the log-likelihood by which terms have to be better than others in their place: odds of 33."""
_LEAST_SHARE = 0.02
"""Least share of all that is explained for a term: accuracy of columns, which are those of small terms."""


@dataclass(frozen=True)
class Candidate:
    """A law of the library, and its price in twice the log-odds."""

    law: Law
    price: float


class Regressor:
    """Least squares on candidates beside what is tolerated, in normal form; columns of candidates have unit length."""

    def __init__(self, y: FloatArray, base: FloatArray, columns: FloatArray) -> None:
        """Whitened ``y`` (n,); ``base`` (n, b) times its prior sigma; ``columns`` (n, K)."""
        self.lengths = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
        T = columns / self.lengths
        factor = np.linalg.cholesky(base.T @ base + np.eye(base.shape[1]))
        half_t, half_y = np.linalg.solve(factor, base.T @ T), np.linalg.solve(factor, base.T @ y)
        self.gram, self.moment = T.T @ T - half_t.T @ half_t, T.T @ y - half_t.T @ half_y

    def gain(self, chosen: Sequence[int]) -> float:
        """Twice the log-likelihood that the ``chosen`` columns gain."""
        if not chosen:
            return 0.0
        i = list(chosen)
        return float(self.moment[i] @ np.linalg.solve(self.gram[np.ix_(i, i)] + 1e-9 * np.eye(len(i)), self.moment[i]))

    def fit(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Coefficients (k,) of the ``chosen`` columns in their own units, and their covariance."""
        i = list(chosen)
        cov = np.linalg.inv(self.gram[np.ix_(i, i)] + 1e-9 * np.eye(len(i)))
        scale = 1.0 / self.lengths[i]
        return cov @ self.moment[i] * scale, cov * np.outer(scale, scale)

    def gains_beside(self, chosen: Sequence[int]) -> FloatArray:
        """(K,) twice the log-likelihood that each column would gain beside those ``chosen``; 0 where these leave nothing of it."""
        i = list(chosen)
        across = np.linalg.solve(self.gram[np.ix_(i, i)] + 1e-9 * np.eye(len(i)), self.gram[i]) if i else np.zeros((0, len(self.moment)))
        score = self.moment - across.T @ self.moment[i]
        left = np.diagonal(self.gram) - np.sum(across * self.gram[i], axis=0)
        is_usable = left > _COLLINEAR * np.maximum(np.diagonal(self.gram), 0.05)
        return np.asarray(np.where(is_usable, score**2 / np.maximum(left, 1e-9), 0.0))


class Design(NamedTuple):
    """Rows and columns of the regression, before whitening."""

    linear: FloatArray
    base: FloatArray
    """(M, 6, b) times prior sigma."""
    columns: FloatArray
    """(M, 6, K) causes, then candidates."""

    def problem(self, noise: Noise, used: NDArray[np.bool_] | None = None) -> Regressor:
        """Whitened, of the windows ``used`` (M,) or all."""
        y, b, t = noise.whiten(self.linear), noise.whiten(self.base), noise.whiten(self.columns)
        if used is not None:
            y, b, t = y[used], b[used], t[used]
        return Regressor(y.ravel(), b.reshape(y.size, -1), t.reshape(y.size, -1))


class Search(NamedTuple):
    """Result of `find_terms`."""

    terms: tuple[FoundTerm, ...]
    kept: tuple[int, ...]
    """Causes beside the terms, as indices of the linearization's."""
    sizes: FloatArray
    """(k,) of the kept causes, in their units."""
    state: Linearization
    """The drive as it was searched, in the noise that is left beside the terms."""
    effects: tuple[FoundEffect, ...]
    """What is bound to time, place or sensors, strongest first."""
    effect_columns: FloatArray
    """(M, 6, e) what each effect of unit size adds to the discrepancies, in their order."""
    design: Design
    """What is regressed: the columns of the kept causes, then terms, then effects, all in their order."""
    has_sides: bool = True
    """Whether the drive shows what the terms are in mirrored motions; else terms with other signs there explain it as well."""
    is_lasting: bool = True
    """Whether the terms explain the drive better than the same motions whose share changes along it."""
    refused: Mapping[str, str] = {}
    """Terms and effects by name that are none, and why."""

    @property
    def removed(self) -> FloatArray:
        """(M, 6) what the effects add to the discrepancies."""
        return np.asarray(self.effect_columns @ np.array([e.value for e in self.effects]))

    @property
    def tolerated(self) -> FloatArray:
        """(M, 6, b) what is tolerated beside the kept causes, times its prior sigma."""
        return self.state.tolerated([self.state.causes[i] for i in self.kept])

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each column of the `design`."""
        causes = (self.state.causes[i].key for i in self.kept)
        return (*causes, *(t.law.name for t in self.terms), *(e.shape.name for e in self.effects))

    def only(self, names: Collection[str], refused: Mapping[str, str]) -> Search:
        """With the causes, terms and effects of these ``names`` alone; the others are ``refused``, with the reason."""
        is_kept = [name in names for name in self.names]
        k, n = len(self.kept), len(self.kept) + len(self.terms)
        return self._replace(
            kept=tuple(i for i, used in zip(self.kept, is_kept[:k], strict=True) if used),
            sizes=self.sizes[np.array(is_kept[:k], dtype=bool)],
            terms=tuple(term for term, used in zip(self.terms, is_kept[k:n], strict=True) if used),
            effects=tuple(effect for effect, used in zip(self.effects, is_kept[n:], strict=True) if used),
            effect_columns=self.effect_columns[..., np.array(is_kept[n:], dtype=bool)],
            design=self.design._replace(columns=self.design.columns[..., np.array(is_kept, dtype=bool)]),
            refused={**self.refused, **refused},
        )


def candidate_terms(predictor: DrivePredictor, count: int, others: int = 0) -> tuple[Candidate, ...]:
    """Candidates for a drive in which ``count`` numbers were measured, beside so many ``others``; CG products only where the CG moves."""
    powers = list(itertools.product(_POWERS, _POWERS))[1:]
    powers += [pair for x, y in itertools.product(_ONE_SIDED, _POWERS) for pair in ((x, y), (y, x))]
    powers += itertools.product(_ONE_SIDED, _ONE_SIDED)
    texts = ["*".join(p for p in (a.format("v"), b.format("wz")) if p) for a, b in powers]
    has_cg = bool(np.std(predictor.batch.cg, axis=0).max() > _CG_MOVES_M)
    whole = float(predictor.batch.t.max(initial=0.0))
    rises = [f"rise(t,{float(f'{share * whole:.2g}'):g})" for share in _TIME_CONSTANTS if whole > _SHORTEST_S]
    memory = _with_memory(predictor) if predictor.drive.kind == "log" and whole > _SHORTEST_S else []
    found: dict[tuple[str, Expression], None] = {}
    for component in COMPONENTS:
        warming = [f"{motion}*{rise}" for motion in _WARMING[component] for rise in rises]
        for text in (*texts, *_MORE[component], *warming, *memory, *(_OF_CG if has_cg else ())):
            expression = parse_expression(text)
            if _degree(expression) <= _MAX_DEGREE:
                found.setdefault((component, expression))
    laws = [Law(component, expression) for component, expression in found]
    laws += parameter_laws(predictor.effective_track_m, has_cg)
    base = 2.0 * math.log(len(laws) + others) + math.log(max(count, 2))
    more = {Law(c, parse_expression(text)): _OF_CAUSES_PRICE for c, text in _OF_CAUSES}
    return tuple(Candidate(law, base + _complexity(law.term) + more.get(law, 0.0)) for law in laws)


def _with_memory(predictor: DrivePredictor) -> list[str]:
    """Texts of what follows late, swings, or has a hysteresis."""
    twist = predictor.corrected_twist(Hypothesis())
    found = []
    for name, values in (("v", twist[:, 0]), ("wz", twist[:, 2])):
        size = float(np.sqrt(np.mean(values**2)))
        found += [f"lag({name},{constant:g})" for constant in _LAGS_S]
        found += [f"swing({name},{frequency:g},{damping:g})" for frequency, damping in _SWINGS]
        found += [f"play({name},{share * size:.2g})" for share in _PLAYS if share * size > _LEAST_PLAY]
    return found


def _fading_pairs(candidates: Sequence[Candidate]) -> list[tuple[int, int]]:
    """Indices of terms that make what fades, c exp(-t/T) = c - c rise(t,T), of a motion c: neither is an improvement by itself."""
    index = {(c.law.component, str(c.law.expression)): i for i, c in enumerate(candidates) if not c.law.tied}
    texts = ((component, motion, text) for component, text in index for motion in _WARMING[component] if text.startswith(f"{motion}*rise("))
    return [(index[component, motion], index[component, text]) for component, motion, text in texts]


def _degree(expression: Expression) -> int:
    """Powers of motions in it; signs and rises have none."""
    return sum(f.power for f in expression.factors if f.form not in ("sign", "rise") and VARIABLES[f.variable].is_motion)


def _complexity(term: Term) -> float:
    factors = sum(f.power + f.has_memory * len(f.constants) for f in term.expression.factors)
    return _COMPLEXITY_PRICE * (factors - 1) + (0.0 if term.is_symmetric else _ASYMMETRIC_PRICE)


def term_columns(predictor: DrivePredictor, hypothesis: Hypothesis, laws: Sequence[Law], path: FloatArray | None = None) -> FloatArray:
    """(M, 6, K) change of the discrepancies per unit of each law's coefficient, with the sign of what the term removes, about the
    motion of the twists ``path`` (N, 3), by default the predicted ones."""
    batch, twist = predictor.batch, predictor.corrected_twist(hypothesis)
    path = twist if path is None else path
    series = series_of(batch)
    rate = np.divide(1.0, series.dt, out=np.zeros(len(series.dt)), where=series.dt > 0.0)
    v, wz = twist[:, 0], twist[:, 2]
    values = {"v": v, "wz": wz, "cg_x": batch.cg[:, 0], "cg_y": batch.cg[:, 1], "t": series.t}
    values |= {"dv": np.diff(v, prepend=v[:1]) * rate, "dwz": np.diff(wz, prepend=wz[:1]) * rate}
    expressions = {e: i for i, e in enumerate(dict.fromkeys(part.expression for law in laws for part in law.parts))}
    values = with_memory(expressions, values, series)
    shapes = np.column_stack([e.evaluate(values)[0] for e in expressions])
    moved = np.zeros((len(batch.ends), 3, 3, len(expressions)))
    for i, inside in enumerate(batch.intervals()):
        moved[i] = moved_by(path[inside], batch.dt[inside], shapes[inside] * batch.dt[inside, None])
    columns = np.full((len(batch.ends), len(CHANNELS), len(laws)), 0.0)
    for k, law in enumerate(laws):
        columns[:, :3, k] = sum(p.factor * moved[:, :, COMPONENTS.index(p.component), expressions[p.expression]] for p in law.parts)
    return columns


def _best_set(
    problem: Regressor, prices: FloatArray, limits: FloatArray, start: tuple[int, ...], most: int
) -> tuple[float, tuple[int, ...]]:
    """Set of columns of least cost (prices less gains), by adding, dropping and exchanging one at a time from ``start``; none with a
    coefficient beyond its ``limits`` (K, 2)."""

    def cost(chosen: tuple[int, ...]) -> float:
        i = list(chosen)
        sizes = problem.fit(chosen)[0] if chosen else np.zeros(0)
        is_possible = bool(np.all((limits[i, 0] <= sizes) & (sizes <= limits[i, 1])))
        return float(prices[i].sum()) - problem.gain(chosen) if is_possible else math.inf

    def with_one_more(rest: tuple[int, ...], left: tuple[int, ...]) -> tuple[float, tuple[int, ...]]:
        gains = problem.gains_beside(rest) - prices
        gains[[*rest, *left]] = -math.inf
        tried = ((cost((*rest, int(i))), (*rest, int(i))) for i in np.argsort(-gains)[:_TRIED])
        return next((one for one in tried if one[0] < math.inf), (math.inf, rest))

    current, least = start, cost(start)
    for _ in range(_STEPS):
        tried: list[tuple[float, tuple[int, ...]]] = []
        for left in ((), *((i,) for i in current)):  # what is dropped
            rest = tuple(i for i in current if i not in left)
            if left:
                tried.append((cost(rest), rest))
            if len(rest) < most:
                tried.append(with_one_more(rest, left))
        better, chosen = min(tried)
        if better >= least - 1e-6:
            break
        current, least = chosen, better
    return least, current


def find_terms(found: DiagnosisResult, rng: np.random.Generator) -> Search | None:
    """Terms that explain the drive of ``found`` better than its findings do, or what these leave; None where it was not searched."""
    state, predictor = found.linearization, found.predictor
    if state is None or predictor is None or predictor.drive.kind not in SEARCHED:
        return None
    sizes = {finding.definition: finding.size for finding in found.diagnosis.findings if finding.definition in state.causes}
    if found.diagnosis.verdict == "unexplained":  # signatures about findings that are wrong would mislead
        sizes = {}
        state = dataclasses.replace(linearize(predictor, state.causes, sizes, TOLERANCE), noise=state.noise)
    named, f = tuple(i for i, cause in enumerate(state.causes) if cause in sizes), len(state.causes)
    bound = bound_columns(predictor, with_sizes(sizes))
    shapes = bound.shapes
    candidates = candidate_terms(predictor, state.problem.count, len(shapes))
    design = _make_design(predictor, state, with_sizes(sizes), range(f), candidates, bound.columns)
    own = 2.0 * math.log(len({cause.group for cause in state.causes})) + math.log(max(state.problem.count, 2))
    least = min(c.price for c in candidates)
    allowed = {cause.key for cause in (state.causes if found.names is None else found.names)}
    prices = np.array(
        [
            *(own if cause.key in allowed else math.inf for cause in state.causes),
            *(c.price for c in candidates),
            *(least + s.price for s in shapes),
        ]
    )
    limits = np.full((len(prices), 2), (-math.inf, math.inf))
    limits[:f] = _size_limits(state)
    noise, chosen, previous = state.noise, named, None
    fading = [tuple(f + i for i in pair) for pair in _fading_pairs(candidates)]
    if found.diagnosis.verdict == "unexplained":
        noise = _noise_beside_terms(predictor, state, design, prices)
    for _ in range(_ROUNDS):
        problem = design.problem(noise)
        starts = sorted({chosen, named, (), *fading})
        _, chosen = min(_best_set(problem, prices, limits, start, len(named) + _MOST) for start in starts)
        terms = tuple(sorted(i for i in chosen if i >= f))
        if terms == previous:
            break
        previous = terms
        noise = noise_beside(predictor, state, design.columns[..., list(terms)])
    if any(finding.definition.is_clock for finding in found.diagnosis.findings):
        chosen = _with_clock_for_gains(design.problem(noise), state.causes, candidates, chosen)
    design, candidates = _profiled(predictor, with_sizes(sizes), design, noise, (candidates, f), chosen)
    chosen, stability = _supported(design, noise, chosen, f, rng)
    searched = _searched_candidates(design, noise, prices, f, bound.motions)
    chosen, placebos = _beyond_placebos(design, noise, (chosen, f), searched, rng)
    names = [*(c.law.name for c in candidates), *(s.name for s in shapes)]
    refused = {names[i - f]: why for i, why in placebos.items()}
    has_sides = not _has_mirrored_rival(design.problem(noise), prices, limits, chosen, dict(enumerate(candidates, f)))
    laws = {i: candidates[i - f].law for i in chosen if f <= i < f + len(candidates)}
    changes = _has_rival_in_time(predictor, with_sizes(sizes), design, noise, (chosen, prices, laws))
    return _describe(predictor, design, state, noise, chosen, (candidates, shapes), stability)._replace(
        has_sides=has_sides, is_lasting=not changes, refused=refused
    )


def _profiled(
    predictor: DrivePredictor,
    hypothesis: Hypothesis,
    design: Design,
    noise: Noise,
    known: tuple[Sequence[Candidate], int],
    chosen: tuple[int, ...],
) -> tuple[Design, tuple[Candidate, ...]]:
    """``design`` and the ``known`` candidates, from a first column on: those of the ``chosen`` columns that have a memory have the
    constants by which they gain most beside the others, by steps that become smaller."""
    found, f, columns = list(known[0]), known[1], design.columns.copy()
    remembering = [i for i in chosen if f <= i < f + len(found) and any(x.has_memory for x in found[i - f].law.expression.factors)]
    for ratio, i in itertools.product(_PROFILED, remembering):
        near, others = _near(found[i - f], ratio), [j for j in chosen if j != i]
        tried = np.concatenate([columns[..., [i]], term_columns(predictor, hypothesis, [c.law for c in near])], axis=-1)
        problem = design._replace(columns=np.concatenate([columns[..., others], tried], axis=-1)).problem(noise)
        best = int(np.argmax(problem.gains_beside(range(len(others)))[len(others) :]))
        if best:
            found[i - f], columns[..., i] = near[best - 1], tried[..., best]
    return design._replace(columns=columns), tuple(found)


def _near(candidate: Candidate, ratio: float) -> list[Candidate]:
    """``candidate`` with one constant of a memory larger or smaller by this ``ratio``."""
    factors, found = candidate.law.expression.factors, []
    for n, factor in enumerate(factors):
        for k, (low, high) in enumerate(CONSTANTS.get(factor.form, ())):
            for constant in (factor.constants[k] * ratio, factor.constants[k] / ratio):
                constants = (*factor.constants[:k], float(f"{min(max(constant, low), high):.3g}"), *factor.constants[k + 1 :])
                changed = Expression((*factors[:n], factor._replace(constants=constants), *factors[n + 1 :]))
                found.append(dataclasses.replace(candidate, law=Law(candidate.law.component, changed)))
    return found


def _searched_candidates(design: Design, noise: Noise, prices: FloatArray, f: int, motions: FloatArray) -> Candidates:
    """Terms and bound effects, the columns from ``f`` on; the last ones modulate ``motions`` (M, 6, K)."""
    columns, of_motions = noise.whiten(design.columns[..., f:]), np.zeros((*design.linear.shape, design.columns.shape[-1] - f))
    of_motions[..., of_motions.shape[-1] - motions.shape[-1] :] = noise.whiten(motions)
    return modulated(columns, of_motions, prices[f:])


def _beyond_placebos(
    design: Design, noise: Noise, found: tuple[tuple[int, ...], int], searched: Candidates, rng: np.random.Generator
) -> tuple[tuple[int, ...], dict[int, str]]:
    """The ``found`` columns (and the first of a term) without terms and effects that are no better than the best of a placebo search beside
    the others; and why these are none. Columns of which the drive shows the sum alone are one group, for which k placebos count."""
    (chosen, f), refused = found, {}  # type: tuple[tuple[int, ...], int], dict[int, str]
    y, base = noise.whiten(design.linear).ravel(), noise.whiten(design.base).reshape(design.linear.size, -1)
    columns = {i: noise.whiten(design.columns[..., i]).ravel() for i in chosen}
    while any(i >= f for i in chosen):
        p: dict[tuple[int, ...], float] = {}
        for group in _inseparable(design.problem(noise), [i for i in chosen if i >= f]):
            others = np.column_stack([np.zeros(len(y)), *(columns[j] for j in chosen if j not in group)])
            beside = np.concatenate([base, free(others)], axis=1)
            price = float(sum(searched.prices[i - f] for i in group))
            real = joint_statistic(y, beside, np.column_stack([columns[i] for i in group]), price)
            p[group] = placebo_p(real, len(group) * placebo_statistics(y[:, None], beside, searched, rng)[1][:, 0])
        worst = max(p, key=lambda group: p[group])
        if p[worst] <= LEVEL:
            break
        why = f"placebo terms of this drive explain as much (p = {p[worst]:.2g} over the whole search)"
        refused |= dict.fromkeys(worst, why)
        chosen = tuple(j for j in chosen if j not in worst)
    return chosen, refused


def _inseparable(problem: Regressor, chosen: Sequence[int]) -> list[tuple[int, ...]]:
    """The ``chosen`` columns in groups of those that leave nothing of each other beside all that is tolerated."""
    groups: list[tuple[int, ...]] = []
    for i in chosen:
        G = problem.gram
        near = [g for g in groups if any(G[i, j] ** 2 > (1.0 - _COLLINEAR) * G[i, i] * G[j, j] for j in g)]
        groups = [g for g in groups if g not in near] + [(*(j for g in near for j in g), i)]
    return groups


def _with_clock_for_gains(
    problem: Regressor, causes: Sequence[Cause], candidates: Sequence[Candidate], chosen: tuple[int, ...]
) -> tuple[int, ...]:
    """``chosen`` with the wheels' clock, which is named, in the place of gains in speed and in turning rate that are alike: to first order
    late stamps are vx = c dv and wz = c dwz.

    On MIT-CSAIL, whose positions and headings give clocks of -217 and -152 ms, the two terms explain the drive better, by -183 and -164 ms.
    """
    names = {c.law.name: len(causes) + n for n, c in enumerate(candidates)}
    gains = [names[name] for name in ("vx[dv]", "wz[dwz]") if names.get(name) in chosen]
    clock = next((i for i, cause in enumerate(causes) if cause.id == "wheel_time_offset"), None)
    if len(gains) < 2 or clock is None:
        return chosen
    sizes = dict(zip(chosen, problem.fit(chosen)[0], strict=True))
    ratio = sizes[gains[0]] / sizes[gains[1]]
    return tuple(sorted({*chosen, clock} - {*gains})) if 1.0 / _SAME_LAG < ratio < _SAME_LAG else chosen


def _noise_beside_terms(predictor: DrivePredictor, state: Linearization, design: Design, prices: FloatArray) -> Noise:
    """Noise of a drive of which a part is unexplained, beside that part.

    Noise that contains what is unexplained hides it, most where it is largest. So terms are added one by one by the noise that the motion
    reference states, and by that of the drive, as many as pay their price by the noise that is left beside them.
    """
    best = _twice_log_determinant(state.noise), state.noise
    stated = reference_noise(predictor, state.linear, state.causes)
    for first in (state.noise, dataclasses.replace(stated, weights=state.noise.weights)):
        problem, given, terms = design.problem(first), (), []  # type: Regressor, tuple[int, ...], list[int]
        while len(terms) < _MOST:
            gains = problem.gains_beside(given) - prices
            gains[list(given)] = -math.inf
            strongest = int(np.argmax(gains))
            if gains[strongest] <= 0.0:
                break
            given = (*given, strongest)
            if strongest >= len(state.causes):  # causes are beside all noise
                terms.append(strongest)
                noise = noise_beside(predictor, state, design.columns[..., terms])
                best = min(best, (_twice_log_determinant(noise) + float(prices[terms].sum()), noise), key=lambda pair: pair[0])
    return best[1]


def _twice_log_determinant(noise: Noise) -> float:
    """Twice the sum of the logarithms of its sigmas: less twice the log-likelihood of a drive by its own noise, but for a constant."""
    return 2.0 * float(np.log(noise.sigmas[noise.known]).sum())


def _has_mirrored_rival(
    problem: Regressor, prices: FloatArray, limits: FloatArray, chosen: tuple[int, ...], candidates: Mapping[int, Candidate]
) -> bool:
    """Whether for a component whose ``chosen`` terms have one mirror symmetry, as many terms with the other one explain the drive as well.

    Where the robot turned left whenever it drove ahead, and right whenever it drove back, v^2 sign(wz) is v |v|, and what the robot does in
    other turns is a guess. ``candidates`` are those of the columns that are terms; what acts to one side alone is no rival, as two of them
    are a symmetric one.
    """
    symmetry = {
        i: (c.law.component, c.law.term.is_symmetric)
        for i, c in candidates.items()
        if i in chosen or (c.law.expression.mirror and not c.law.tied)
    }
    found = {symmetry[i] for i in chosen if i in symmetry}
    least = min(c.price for c in candidates.values())
    for component, is_symmetric in found:
        other = component, not is_symmetric
        allowed = np.array([i in chosen or symmetry.get(i) == other for i in range(len(prices))])
        allowed[[i for i in chosen if symmetry.get(i) == (component, is_symmetric)]] = False
        if other in found:
            continue
        start = tuple(i for i in chosen if allowed[i])
        _, rival = _best_set(problem, np.where(allowed, prices, math.inf), limits, start, len(chosen) + 1)
        if problem.gain(rival) - least * len(rival) > problem.gain(chosen) - least * len(chosen) - _RIVAL_LOG_ODDS:
            return True
    return False


def _has_rival_in_time(
    predictor: DrivePredictor,
    hypothesis: Hypothesis,
    design: Design,
    noise: Noise,
    found: tuple[tuple[int, ...], FloatArray, Mapping[int, Law]],
) -> bool:
    """Whether in the place of the laws (by column) among the chosen columns, at their prices, motions explain the drive better whose share
    changes along it, as a Fourier series that is slower than the shortest change; at the price of the BIC.

    A law that follows time as sin(t/9) was sign(v) wz^2 on a drive that turned that way by chance, and its file four times worse than none
    on another (`tests.studies.unseen_effects`, draw 52, case 12).
    """
    chosen, prices, laws = found
    if not laws or predictor.drive.kind != "log":
        return False
    components = sorted({part.component for law in laws.values() for part in law.parts})
    motions = [Law(c, parse_expression(motion)) for c in components for motion in _OWN_MOTIONS[c]]
    begins, ends = predictor.window_times_s
    middle, whole = 0.5 * (begins + ends), float(ends[-1])
    waves = np.pi * np.outer(middle, np.arange(1, int(2.0 * whole / _SHORTEST_CHANGE_S) + 1)) / whole
    shares = np.concatenate([np.cos(waves), np.sin(waves)], axis=1)
    columns = noise.whiten(term_columns(predictor, hypothesis, motions))[..., None] * shares[:, None, None]
    y, size = noise.whiten(design.linear).ravel(), design.linear.size
    others = [i for i in chosen if i not in laws]
    base = [noise.whiten(design.base).reshape(size, -1), free(noise.whiten(design.columns[..., others]).reshape(size, -1))]
    beside, own = np.concatenate(base, axis=1), noise.whiten(design.columns[..., list(laws)]).reshape(size, -1)
    by_laws = joint_statistic(y, beside, own, float(prices[list(laws)].sum()))
    varying = columns.reshape(size, -1)
    return joint_statistic(y, beside, varying, varying.shape[1] * math.log(max(int(np.count_nonzero(y)), 2))) > by_laws


def _size_limits(state: Linearization) -> FloatArray:
    """(p, 2) sizes of causes that the search considers: others take the place of a term, and no robot file may hold them."""
    bounds = np.array([cause.bounds for cause in state.causes])
    most = _SIZE_SHARE * np.array([cause.largest_plausible for cause in state.causes])[:, None]
    return np.asarray(np.clip(bounds, -most, most))


def _supported(
    design: Design, noise: Noise, chosen: tuple[int, ...], f: int, rng: np.random.Generator
) -> tuple[tuple[int, ...], dict[int, float]]:
    """``chosen`` without terms (from column ``f`` on) that random halves of the drive do not show again, or that are within the accuracy of
    columns: they repair what others miss; and the stability of each.

    A large gain does not take the place of stability: laws that follow time as sin(t/9) had terms of 400 to 1,100 of twice the
    log-likelihood that one half in twenty shows again, and their files were worse than none on another drive
    (`tests.studies.unseen_effects`, draw 6, case 19, and draw 8, case 24)."""
    problem = design.problem(noise)
    while True:
        stability = _stability(design, noise, chosen, rng)
        whole = problem.gain(chosen)
        gains = {i: whole - problem.gain(tuple(j for j in chosen if j != i)) for i in chosen if i >= f}
        weak = [i for i, gain in gains.items() if stability[i] < _MIN_STABILITY or gain < _LEAST_SHARE * whole]
        if not weak:
            return chosen, stability
        worst = min(weak, key=lambda i: gains[i])
        chosen = tuple(i for i in chosen if i != worst)


def _describe(
    predictor: DrivePredictor,
    design: Design,
    state: Linearization,
    noise: Noise,
    chosen: tuple[int, ...],
    known: tuple[Sequence[Candidate], Sequence[BoundShape]],
    stability: Mapping[int, float],
) -> Search:
    """The ``chosen`` columns of causes, then candidates, then bound shapes, with sizes by Gauss-Newton steps."""
    problem, (candidates, shapes) = design.problem(noise), known
    f, g = len(state.causes), len(state.causes) + len(candidates)
    names = [*(c.law.name for c in candidates), *(s.name for s in shapes)]
    start, cov = problem.fit(chosen)
    gains = {i: problem.gain(chosen) - problem.gain(tuple(j for j in chosen if j != i)) for i in chosen}
    effects = [
        FoundEffect(shapes[i - g], float(start[n]), float(math.sqrt(cov[n, n])), stability[i], gains[i])
        for n, i in enumerate(chosen)
        if i >= g
    ]
    kept, terms = tuple(i for i in chosen if i < f), [i for i in chosen if f <= i < g]
    plain = tuple(candidates[i - f].law.with_value(float(start[chosen.index(i)])) for i in terms)
    sizes = np.array([start[n] for n, i in enumerate(chosen) if i < f])
    last = dataclasses.replace(state, noise=noise)
    of_effects = [i for i in chosen if i >= g]
    fit = Fit(kept, sizes, plain, np.array([e.value for e in effects]))
    fit = refine(predictor, last, fit, design.columns[..., of_effects])
    found = [
        FoundTerm(law, stability[i], gains[i], _alike(problem, i, tuple(j for j in chosen if j != i), names, f))
        for i, law in zip(terms, fit.laws, strict=True)
    ]
    effects = [e._replace(value=float(value)) for e, value in zip(effects, fit.effects, strict=True)]
    order = sorted(range(len(found)), key=lambda n: -found[n].gain), sorted(range(len(effects)), key=lambda n: -effects[n].gain)
    columns = [*kept, *(terms[n] for n in order[0]), *(of_effects[n] for n in order[1])]
    return Search(
        terms=tuple(found[n] for n in order[0]),
        kept=kept,
        sizes=fit.sizes,
        state=last,
        effects=tuple(effects[n] for n in order[1]),
        effect_columns=design.columns[..., [of_effects[n] for n in order[1]]],
        design=design._replace(columns=design.columns[..., columns]),
    )


def _make_design(
    predictor: DrivePredictor,
    state: Linearization,
    hypothesis: Hypothesis,
    causes: Sequence[int],
    candidates: Sequence[Candidate],
    bound: FloatArray,
) -> Design:
    """Rows, what is tolerated, and columns of ``causes``, of ``candidates`` about ``hypothesis``, and the ``bound`` ones (M, 6, k)."""
    T = term_columns(predictor, hypothesis, [c.law for c in candidates])
    S = np.nan_to_num(state.signatures)
    return Design(state.linear, state.tolerated(), np.concatenate([S[..., list(causes)], T, bound], axis=-1))


class Fit(NamedTuple):
    """Sizes of everything that was found, by some windows."""

    kept: tuple[int, ...]
    """Indices of the causes."""
    sizes: FloatArray
    """(k,) of the causes."""
    laws: tuple[Law, ...]
    effects: FloatArray
    """(e,) of the bound effects."""


def refine(
    predictor: DrivePredictor, state: Linearization, start: Fit, effect_columns: FloatArray, used: NDArray[np.bool_] | None = None
) -> Fit:
    """Sizes and sigmas from a ``start``, on the windows ``used`` (M,) or all, with bound effects of these columns (M, 6, e).

    Gauss-Newton: discrepancies by the model with the terms, and columns about the motion that it predicts. First-order columns are off by
    sigmas where a term turns the robot by much: 95 % intervals held 90 % of coefficients, and hold 95 % after two steps.
    """
    kept, sizes, laws, effects = start
    causes, k, n = [state.causes[i] for i in kept], len(kept), len(kept) + len(laws)
    if not laws and not len(effects):
        return start
    for _ in range(_NEWTON_STEPS):
        hypothesis = with_sizes({cause: float(s) for cause, s in zip(causes, sizes, strict=True)})
        extended = dataclasses.replace(predictor, model=extended_model(predictor, terms_of(laws))) if laws else predictor
        rows = extended.discrepancies(hypothesis)
        S = np.stack([extended.signature(hypothesis, c) for c in causes], axis=-1) if causes else np.zeros((*rows.shape, 0))
        T = np.zeros((*rows.shape, 0))
        if laws:
            T = term_columns(predictor, hypothesis, laws, extended.corrected_twist(hypothesis))
        columns = np.concatenate([np.nan_to_num(S), T, effect_columns], -1)
        linear = rows + columns[..., :n] @ np.r_[sizes, [law.value for law in laws]]
        values, cov = Design(linear, state.tolerated(), columns).problem(state.noise, used).fit(range(columns.shape[-1]))
        sigmas, sizes, effects = np.sqrt(np.diagonal(cov))[k:n], values[:k], values[n:]
        laws = tuple(law.with_value(float(v), float(sigma)) for law, v, sigma in zip(laws, values[k:n], sigmas, strict=True))
    return Fit(kept, sizes, laws, effects)


def terms_of(laws: Sequence[Law]) -> tuple[Term, ...]:
    """All terms of ``laws``; coefficients of the same term are summed."""
    return merge_terms((), [term for law in laws for term in law.terms])


def _alike(problem: Regressor, i: int, others: tuple[int, ...], names: list[str], f: int) -> tuple[str, ...]:
    """Names of the candidates that would gain nearly as much as column ``i`` beside the ``others``, best first."""
    gains = problem.gains_beside(others)
    near = [j for j in np.argsort(-gains) if j >= f and j != i and gains[j] > gains[i] - _RIVAL_LOG_ODDS]
    return tuple(names[j - f] for j in near[:3])


def _stability(design: Design, noise: Noise, chosen: tuple[int, ...], rng: np.random.Generator) -> dict[int, float]:
    """Share of random halves of the drive's blocks in which each of the ``chosen`` columns, or one like it, is the best in its place."""
    blocks = np.arange(len(design.linear)) // 4
    count = int(blocks[-1]) + 1
    hits = dict.fromkeys(chosen, 0)
    y, b, t = noise.whiten(design.linear), noise.whiten(design.base), noise.whiten(design.columns)
    for _ in range(_HALVES):
        used = np.isin(blocks, rng.permutation(count)[: max(count // 2, 1)])
        n = int(used.sum()) * y.shape[1]
        problem = Regressor(y[used].ravel(), b[used].reshape(n, -1), t[used].reshape(n, -1))
        for i in chosen:
            others = tuple(j for j in chosen if j != i)
            gains = problem.gains_beside(others)
            best = int(np.argmax(gains))
            G = problem.gram
            alike = abs(G[best, i]) / math.sqrt(max(G[best, best] * G[i, i], 1e-18))
            hits[i] += best == i or alike > _ALIKE or gains[i] > gains[best] - _RIVAL_LOG_ODDS
    return {i: hit / _HALVES for i, hit in hits.items()}


def extended_model(predictor: DrivePredictor, terms: Sequence[Term]) -> ExtendedModel:
    """The predictor's model with ``terms`` beside those that it has."""
    model = predictor.model
    if isinstance(model, ExtendedModel):
        return dataclasses.replace(model, terms=merge_terms(model.terms, terms))
    return ExtendedModel(model, tuple(terms))


def merge_terms(own: Sequence[Term], added: Sequence[Term]) -> tuple[Term, ...]:
    """``own`` terms with those ``added``: coefficients of the same term are summed."""
    found: dict[str, Term] = {t.name: t for t in own}
    for term in added:
        old = found.get(term.name)
        found[term.name] = term if old is None else dataclasses.replace(term, value=old.value + term.value)
    return tuple(found.values())


def fit_on(predictor: DrivePredictor, search: Search, used: NDArray[np.bool_]) -> Fit:
    """Sizes of everything found as the windows ``used`` (M,) alone have them."""
    start = Fit(search.kept, search.sizes, tuple(t.law for t in search.terms), np.array([e.value for e in search.effects]))
    return refine(predictor, search.state, start, search.effect_columns, used)
