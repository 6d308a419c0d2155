"""Innovations of two sensors that measure one quantity, over windows of seconds, and what explains them best.

A filter that is right has white innovations nu_k with the variances S_k that it computes: over any window the sum of nu has the variance
sum of S (Bar-Shalom, Li, Kirubarajan 2001, 5.4: time-average test).
"""

from __future__ import annotations

import bisect
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from localization.events import Step
from localization.messages import phrase
from motion_models.se2 import FloatArray

BIN_S = 0.5
WINDOWS_S = (2.0, 10.0, 60.0)
SLIP_S = 5.0
"""Time for which half of what healthy sensors err by lasts, as slip does; the other half is of the whole window, as a floor is [s]."""
_MIN_FILLED = 0.9
"""Part of a window that must have been measured."""
SECONDS, TURN, WAY, TURN_CHANGE = range(4)
"""What a cause is proportional to, in each bin: time [s], turn [rad] and way [m] by the wheels, change of the turn rate from begin to end
[rad/s]."""


Regressors = tuple[float, float, float, float]
NO_REGRESSORS: Regressors = (0.0, 0.0, 0.0, 0.0)


class Pair(NamedTuple):
    """Two sensors that measure one quantity."""

    first: str
    second: str
    quantity: Literal["turns", "ways"]
    floor: float
    """Standard deviation over a window of what no model has [rad, m]."""

    @property
    def is_of_gyro(self) -> bool:
        """Whether one of them is the gyro."""
        return "gyro" in (self.first, self.second)


class Cause(NamedTuple):
    """What may be the reason for innovations."""

    regressor: int
    """What it is proportional to."""
    sigma: float
    """Standard deviation of the factor where this is the reason, in the unit of innovations per that of the regressor."""
    describe: Callable[[float], str]
    """Sentence by the factor."""


Causes = Sequence[Cause]


class Explanation(NamedTuple):
    """A cause of the innovations of a window."""

    regressor: int
    sentence: str
    log_odds: float
    """Logarithm of the evidence for it over that for healthy sensors."""
    sigmas: float
    """Size of its factor by what healthy sensors err by."""


class Bin(NamedTuple):
    """Sums up to the end of half a second or more, since the first."""

    end_s: float
    innovation: float
    variance: float
    seconds: float
    regressors: Regressors
    """What faults would add within this bin alone."""
    bias_sigma: float
    """Standard deviation of the gyro's bias then [rad/s]; 0 for pairs without a gyro."""
    poses: FloatArray
    """(6, 3) at its end, as `Reckoning` has them."""


class InnovationWindow(NamedTuple):
    """The innovations of the last seconds."""

    bins: list[Bin]
    """The last bin before the window, then those in it."""
    seconds: float
    innovation: float
    """Their sum [rad, m]."""
    sigmas: float
    """Size of the sum by the noise of both sensors alone."""

    def explain(self, pair: Pair, causes: Causes, usual: Mapping[int, float]) -> Explanation:
        """The most probable of ``causes`` of a ``pair``, where healthy sensors err by ``usual`` standard deviations per unit of what causes
        are proportional to."""
        rows = np.array([(b.innovation, b.variance) for b in self.bins])
        innovation, variance = np.diff(rows, axis=0).T
        X = np.array([b.regressors for b in self.bins[1:]])
        end_s = np.array([b.end_s for b in self.bins[1:]])
        C = np.diag(variance) + (pair.floor / len(X)) ** 2
        lasting = 0.5 + 0.5 * np.exp(-np.abs(end_s[:, None] - end_s) / SLIP_S)
        of_bias = X[:, SECONDS] * [b.bias_sigma for b in self.bins[1:]]
        for x in (of_bias, *(sigma * X[:, regressor] for regressor, sigma in usual.items())):
            C += np.outer(x, x) * lasting
        weighted = np.linalg.solve(C, np.column_stack([X, innovation]))
        found = [_explanation(cause, X[:, cause.regressor], weighted[:, [cause.regressor, -1]]) for cause in causes]
        best = max(found, key=operator.attrgetter("log_odds"))
        if np.allclose(X[:, [TURN, WAY]], 0.0):
            return best._replace(regressor=SECONDS, sentence=_describe_standing(pair))
        return best


_END_S = operator.attrgetter("end_s")


def _describe_standing(pair: Pair) -> str:
    if pair.quantity == "turns":
        return phrase("sensor_pairs.standing_turns", first=pair.first)
    return phrase("sensor_pairs.standing_ways", first=pair.first)


def _explanation(cause: Cause, x: FloatArray, weighted: FloatArray) -> Explanation:
    """How well a factor on ``x`` (n,) explains innovations of covariance C: its evidence against none, with the factor integrated out over
    its prior (Bar-Shalom, Li, Kirubarajan 2001, 1.4; a Bayes factor of two Gaussians). ``weighted`` (n, 2): C^-1 x and C^-1 innovation."""
    power, product = (x @ weighted).tolist()
    chi_square = product**2 / power if power else 0.0
    log_odds = log_bayes_factor(chi_square, cause.sigma**2 * power)
    return Explanation(cause.regressor, cause.describe(product / power if power else 0.0), log_odds, math.sqrt(chi_square))


def log_bayes_factor(chi_square: float, gain: float) -> float:
    """Logarithm of the evidence that a normal variable has 1 + ``gain`` times its variance, over that for the variance; ``chi_square`` is
    its square over the latter."""
    return 0.5 * chi_square * gain / (1.0 + gain) - 0.5 * math.log1p(gain)


def add_step(totals: Regressors, step: Step) -> Regressors:
    """``totals`` of what causes are proportional to, with ``step``: seconds, turn and way are sums, the rate is that at its end."""
    if step.duration == 0.0:
        return totals
    seconds, turns, ways, _ = totals
    way, _, turn = step.predicted.delta.tolist() if step.has_wheels else (0.0, 0.0, 0.0)
    rate = (turn if step.turn is None else step.turn.angle) / step.duration
    return seconds + step.duration, turns + turn, ways + way, rate


class InnovationWindows:
    """The innovations of one pair over the last minute: `add` each measurement."""

    def __init__(self, pair: Pair) -> None:
        self.pair, self._is_of_gyro = pair, pair.is_of_gyro
        self.bins: list[Bin] = []
        self._innovation = self._variance = self._seconds = 0.0
        self._regressors = self._totals = NO_REGRESSORS

    def add(self, innovation: float, variance: float, totals: Regressors, now_s: float, bias_sigma: float, poses: FloatArray) -> bool:
        """Add an ``innovation`` with its ``variance``; whether it ends a bin. ``totals`` since the first step, as `add_step` has them;
        ``bias_sigma``: of the gyro; ``poses`` (6, 3) after it."""
        bias_sigma = bias_sigma if self._is_of_gyro else 0.0
        (a, b, c, d), (e, f, g, h), self._totals = totals, self._totals, totals
        regressors = a - e, b - f, c - g, d - h
        if not self.bins:
            self.bins.append(Bin(now_s - regressors[SECONDS], 0.0, 0.0, 0.0, NO_REGRESSORS, bias_sigma, poses))
        self._innovation, self._variance = self._innovation + innovation, self._variance + variance
        (a, b, c, d), (e, f, g, h) = self._regressors, regressors
        self._regressors = a + e, b + f, c + g, d + h
        self._seconds += regressors[SECONDS]
        if self._regressors[SECONDS] < BIN_S:
            return False
        self.bins.append(Bin(now_s, self._innovation, self._variance, self._seconds, self._regressors, bias_sigma, poses))
        self._regressors = NO_REGRESSORS
        while self.bins[1].end_s < now_s - WINDOWS_S[-1]:
            del self.bins[0]
        return True

    def worst(self) -> InnovationWindow | None:
        """The window ending now whose sum of innovations is farthest from zero, in sigmas; None before the shortest window is full."""
        bins, last, worst = self.bins, self.bins[-1], None
        for seconds in WINDOWS_S:
            before = max(bisect.bisect_right(bins, last.end_s - seconds, key=_END_S) - 1, 0)
            first = bins[before]
            if last.seconds - first.seconds < _MIN_FILLED * seconds:
                continue
            total, variance = last.innovation - first.innovation, last.variance - first.variance
            sigmas = abs(total) / math.sqrt(variance + self.pair.floor**2)
            if worst is None or sigmas > worst.sigmas:
                worst = InnovationWindow(bins[before:], seconds, total, sigmas)
        return worst
