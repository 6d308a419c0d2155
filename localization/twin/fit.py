"""Maximum a posteriori of an engine's numbers: Gauss-Newton with steps that are damped (Levenberg 1944, Marquardt 1963).

    x = argmin  sum_w |L_w^-1 r_w(x)|^2 + sum_i ((x_i - m_i) / sigma_i)^2

r_w is the motion that the engine makes of a window relative to the measured one, and its wheels' rates relative to the measured ones; L_w
the root of their covariance. Engines are chaotic where wheels hop: a change of any number by 2 % of its prior's sigma moves a Husky's
window by 3 mm and 12 mrad. Derivatives are therefore secants as long as a prior's sigma, which each step updates (Broyden 1965), and the
scatter counts as noise, whose size is that of the residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from localization.errors import SimulationError
from localization.twin.engine import Played
from localization.twin.parameters import Hypotheses
from localization.twin.simulator import Numbers, Simulator
from localization.twin.windows import Window, motion_of_point
from motion_models import se2
from motion_models.se2 import FloatArray

SECANT = 0.7
"""Least length of a secant over the prior's sigma. At 0.15 the chaos of a Husky's contacts is 5 times the effect of its radius. A secant
reaches to the prior's centre where that is farther: chaos along a shorter one, extrapolated, would weigh against that value."""
RATE_SIGMA = (0.02, 0.02)
"""Sigma of a wheel's mean rate in a window: absolute [rad/s], the smallest step of encoders and servos, and relative, that of a servo."""
AIRBORNE_SIGMA = 0.1
"""Share of the time that a wheel of a robot on a floor is in the air, mean over the windows: none, but for rough ground."""
_MAX_STEP = 3.0
"""Longest step of a parameter in an iteration, over its prior sigma."""
_DAMPING, _DAMPINGS = 1e-2, 5
_SMALL = 0.3
"""Change over the prior's sigma that is small."""
_STARTS = 2
_MAX_LEVERAGE, _NOISE_PASSES = 0.9, 3
_CHAOS = 0.01
"""Change of a number over its prior's sigma that an engine shows by its chaos alone."""
_CONVERGED = 1.0
"""Gain of an iteration [nats] below which the search ends."""
NOISE_BOUNDS = (0.01, 10.0)
"""Bounds of the factor of a component's covariance that residuals show."""
MOTION_ALONE = np.array([1.0, 1.0, 1.0, 1.0, 1.0, np.inf])
"""Noise of the components with which wheels in the air are no evidence: they guide the search, and name no number."""


@dataclass(frozen=True)
class Point:
    """A simulator as it was tried."""

    x: FloatArray
    """(p,) as searched."""
    base: Numbers
    """Numbers of the file with switches applied."""
    residuals: FloatArray
    """(W, 6) motion relative to the measured one [m, m, rad], rates less the measured ones [rad/s], share of the time in the air."""
    cost: float
    """Negative logarithm of the posterior, without constants [nats]."""


@dataclass
class Problem:
    """Windows, a simulator, and what of it may be wrong; counts the time."""

    simulator: Simulator
    hypotheses: Hypotheses
    windows: Sequence[Window]
    budget_steps: int
    """Time steps after which no new iteration is begun: steps, as seconds would make the result depend on the load of the machine."""
    noise: FloatArray = field(default_factory=lambda: np.ones(6))
    """(6,) factors of the covariances of the components."""
    steps: int = 0
    """Time steps that were computed."""

    def point(self, base: Numbers, x: FloatArray) -> Point | None:
        """``x`` tried on ``base``; None where the robot does not stand or drive with it."""
        numbers = self.hypotheses.applied(base, x)
        try:
            engine = self.simulator.compiled(numbers)
            played = engine.play(self.windows)
        except SimulationError:
            return None
        self.steps += played.steps
        return self.scored(base, x, residuals_of(self.windows, played, self.frame(x)))

    def frame(self, x: FloatArray) -> FloatArray:
        """(2,) point of the body whose motion was measured [m]."""
        return x[list(self.hypotheses.of_reference)]

    def scored(self, base: Numbers, x: FloatArray, residuals: FloatArray) -> Point:
        """A `Point` of these residuals under the present noise."""
        z = (x - self.hypotheses.priors) / self.hypotheses.sigmas
        return Point(x, base, residuals, 0.5 * float((self.whitened(residuals) ** 2).sum() + (z**2).sum()))

    def misfit(self, at: Point) -> float:
        """Negative logarithm of the likelihood of these windows, without constants [nats]."""
        return 0.5 * float((self.whitened(at.residuals) ** 2).sum())

    def whitened(self, residuals: FloatArray) -> FloatArray:
        """Residuals (..., W, 6) over their sigmas; 0 where nothing was measured."""
        return np.asarray(residuals / self.sigmas())

    def sigmas(self) -> FloatArray:
        """(W, 6) of the components; inf for what was not measured."""
        return sigmas_of(self.windows) * np.sqrt(self.noise)

    def rescored(self, at: Point) -> Point:
        """The point under the present noise."""
        return self.scored(at.base, at.x, at.residuals)

    def misfits(self, at: Point, count: int) -> FloatArray:
        """(count,) misfits of these windows by a point whose numbers are changed by too little for anything but chaos; 0 without any."""
        rng, found = np.random.default_rng(0), np.zeros(count)
        for i in range(count if self.windows else 0):
            x = at.x + _CHAOS * self.hypotheses.sigmas * rng.normal(size=len(at.x))
            tried = self.point(at.base, np.clip(x, *self.hypotheses.bounds(at.base)))
            found[i] = np.inf if tried is None else self.misfit(tried)
        return found

    def explains(self, at: Point) -> bool:
        """Whether what is left ``at`` a point is within its noise in each component of the motion, and wheels keep to the ground."""
        squares, known = self.whitened(at.residuals) ** 2, np.isfinite(self.sigmas())
        known[1:, 5] = False  # the windows share the contacts: one measurement
        return bool((squares.sum(axis=0) <= known.sum(axis=0)).all())

    @property
    def is_late(self) -> bool:
        """Whether the budget is spent."""
        return self.steps > self.budget_steps

    def jacobian(self, at: Point, columns: Sequence[int]) -> FloatArray:
        """(W, 6, c) secants of the whitened residuals; NaN-free: 0 where the robot does not stand."""
        J = np.zeros((*at.residuals.shape, len(columns)))
        low, high = self.hypotheses.bounds(at.base)
        for c, i in enumerate(columns):
            step, toward = SECANT * self.hypotheses.sigmas[i], self.hypotheses.priors[i] - at.x[i]
            step = toward if abs(toward) > step else -step if at.x[i] + step > high[i] else step
            x = at.x.copy()
            x[i] += step
            if self.hypotheses.parameters[i].area == "reference":
                other = residuals_moved(self.windows, at.residuals, self.frame(at.x), self.frame(x))
            else:
                found = self.point(at.base, x) if x[i] >= low[i] else None
                if found is None:
                    continue
                other = found.residuals
            J[..., c] = self.whitened(other - at.residuals) / step
        return J

    def minimize(self, at: Point, columns: Sequence[int], iterations: int) -> Point:
        """Gauss-Newton from ``at`` in the parameters ``columns``, with secants that steps update."""
        chosen = list(columns)
        if self.is_late:
            return at
        low, high = (bound[chosen] for bound in self.hypotheses.bounds(at.base))
        sigmas, priors = self.hypotheses.sigmas[chosen], self.hypotheses.priors[chosen]
        damping, J, is_new = _DAMPING, self._scaled_jacobian(at, chosen), True
        for _ in range(iterations):
            if self.is_late:
                break
            better = None
            for _ in range(_DAMPINGS):
                A, b = J.T @ J + np.eye(len(chosen)), J.T @ self.whitened(at.residuals).ravel() + (at.x[chosen] - priors) / sigmas
                step = -np.linalg.solve(A + damping * np.diag(np.diag(A)), b)
                step *= min(1.0, _MAX_STEP / max(float(np.abs(step).max()), 1e-12))
                x = at.x.copy()
                x[chosen] = np.clip(x[chosen] + step * sigmas, low, high)
                tried = self.point(at.base, x)
                if tried is not None:
                    J = self._updated(J, (x - at.x)[chosen] / sigmas, tried.residuals - at.residuals)
                if tried is not None and tried.cost < at.cost:
                    better, damping = tried, damping * 0.2
                    break
                damping *= 8.0
            gained = 0.0 if better is None else at.cost - better.cost
            at = better or at
            if gained < _CONVERGED:
                if is_new:
                    break
                damping, J, is_new = _DAMPING, self._scaled_jacobian(at, chosen), True
            else:
                is_new = False
        return at

    def _scaled_jacobian(self, at: Point, columns: Sequence[int]) -> FloatArray:
        """(6 W, c) secants of the whitened residuals by the prior's sigmas."""
        return np.asarray(self.jacobian(at, columns).reshape(-1, len(columns)) * self.hypotheses.sigmas[list(columns)])

    def _updated(self, J: FloatArray, step: FloatArray, moved: FloatArray) -> FloatArray:
        """``J`` (6 W, c) that agrees with what a ``step`` (c,) has ``moved`` (W, 6), where that is longer than chaos (Broyden 1965)."""
        square = float(step @ step)
        return J if square < SECANT**2 else J + np.outer(self.whitened(moved).ravel() - J @ step, step) / square

    def estimate_noise(self, at: Point) -> Point:
        """Scale the components' covariances to the scatter of the residuals ``at`` a point, and return it under them.

        A residual of leverage h has the variance (1 - h) sigma^2: fitted numbers follow a part of the noise.
        """
        J = self._scaled_jacobian(at, range(len(at.x)))
        known = np.isfinite(sigmas_of(self.windows))
        squares = (at.residuals / sigmas_of(self.windows)) ** 2
        for _ in range(_NOISE_PASSES):
            leverage = np.einsum("ij,ji->i", J, np.linalg.solve(J.T @ J + np.eye(J.shape[1]), J.T)).reshape(squares.shape)
            left = squares / (1.0 - np.minimum(leverage, _MAX_LEVERAGE))
            factors = [float(np.mean(left[known[:, c], c])) if known[:, c].any() else 1.0 for c in range(5)]
            noise = np.append(np.clip(factors, *NOISE_BOUNDS), 1.0)
            J *= np.tile(np.sqrt(self.noise / noise), len(self.windows))[:, None]
            self.noise = noise
        return self.rescored(at)


def residuals_of(windows: Sequence[Window], played: Played, frame: FloatArray) -> FloatArray:
    """(W, 6) motion of the point ``frame`` (2,) of the body relative to the measured one, rates less the measured ones, and air."""
    measured = np.array([w.measured for w in windows])
    moved = motion_of_point(played.poses, frame)
    return np.column_stack([se2.between(measured, moved), played.rates - np.array([w.mean_rates for w in windows]), played.touch.airborne])


def residuals_moved(windows: Sequence[Window], residuals: FloatArray, old: FloatArray, new: FloatArray) -> FloatArray:
    """``residuals`` (W, 6) by the point ``old`` as they are by the point ``new`` of the body."""
    measured = np.array([w.measured for w in windows])
    moved = se2.compose(measured, residuals[:, :3])
    moved = motion_of_point(moved, new - old)
    return np.column_stack([se2.between(measured, moved), residuals[:, 3:]])


def sigmas_of(windows: Sequence[Window]) -> FloatArray:
    """(W, 6) sigmas of the residuals' components before the drive's own scatter is known."""
    poses = np.sqrt(np.array([np.diagonal(w.cov) for w in windows]))
    rates = np.array([w.mean_rates for w in windows])
    largest = np.abs(rates).max(axis=1, keepdims=True)
    of_rates = np.broadcast_to(RATE_SIGMA[0] + RATE_SIGMA[1] * largest, rates.shape)
    airborne = AIRBORNE_SIGMA * np.sqrt(len(windows))  # they share the engine's contacts
    return np.column_stack([poses, of_rates, np.full(len(windows), airborne)])


def start(problem: Problem) -> Point:
    """The file as it is. Raises `SimulationError`."""
    numbers = problem.simulator.numbers
    x = np.zeros(len(problem.hypotheses.parameters))
    played = problem.simulator.engine.play(problem.windows)
    problem.steps += played.steps
    return problem.scored(numbers, x, residuals_of(problem.windows, played, problem.frame(x)))


def fit_all(problem: Problem, first: Point, iterations: int = 12) -> Point:
    """All numbers together, from the file as it is (``first``), with the robot file's robot, with each switch and on grounded contacts;
    then again under the noise that is left."""
    columns = list(range(len(problem.hypotheses.parameters)))
    switched = [replace(first.base, **{s.field: s.value}) for s in problem.hypotheses.switches]
    starts = [first, *(p for base in switched if (p := problem.point(base, first.x)) is not None)]
    for base in (first.base, *switched) if problem.hypotheses.has_grounded else ():
        at = problem.point(base, problem.hypotheses.grounded(base))
        starts += [] if at is None else [at]
    described = problem.point(first.base, problem.hypotheses.priors)
    starts += [] if described is None else [described]
    tried = [problem.minimize(s, columns, 2) for s in sorted(starts, key=lambda point: point.cost)[:_STARTS]]
    best = min(tried, key=lambda point: point.cost)
    best = problem.minimize(best, columns, iterations)
    best = problem.estimate_noise(best)
    return problem.minimize(best, columns, iterations)


def fit_law(problem: Problem, base: Numbers, iterations: int = 4) -> Point | None:
    """The few numbers of a simulator with the contact law, from ``base``, under the noise that they leave; None where the robot does not
    stand with it."""
    columns = list(range(len(problem.hypotheses.parameters)))
    first = problem.point(base, np.zeros(len(columns)))
    if first is None:
        return None
    at = problem.minimize(first, columns, iterations - 1)
    return at if problem.is_late else problem.minimize(problem.estimate_noise(at), columns, iterations)


def pruned(problem: Problem, at: Point) -> Point:
    """``at`` without the changes that are small against their priors, where all of them together bring less than half a nat each."""
    small = (at.x != 0.0) & (np.abs(at.x) < _SMALL * problem.hypotheses.sigmas)
    small &= np.array([p.area != "reference" for p in problem.hypotheses.parameters])
    without = problem.point(at.base, np.where(small, 0.0, at.x)) if small.any() else None
    return at if without is None or without.cost > at.cost + 0.5 * small.sum() else without
