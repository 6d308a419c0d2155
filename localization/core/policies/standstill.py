"""Whether a robot whose wheels read zero is at rest, and whether the prior of the gyro's bias holds, by the evidence of the gyro."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from localization.core.state import State
from localization.events import Step

BIAS_CHANGE_COV = np.diag([1e-12, 1e-16])
"""Covariance of "bias_change", a variable that is what the bias has changed by since the last rest, as a constant and a slope. It is small
against that of any gyro's bias, and the variable is never estimated: its correlations are what a change does to the other variables
[rad^2/s^2, rad^2/s^4]."""
_BIAS_PRIORS = ((0.8, 1.0, 0.0), (0.15, 0.0, 1.75e-2), (0.05, 0.0, 4.4e-2))
"""Hypotheses on a bias that no rest has measured: prior probability, sigma over that of the robot file, and sigma [rad/s]. Drivers that
zero their gyro at switch-on have the robot file's; the others the sensor's own: 1 deg/s in data sheets of MEMS gyros (BMI088), and a
tolerance of 5 deg/s, taken for two sigmas, in those of the cheapest (MPU-9250)."""
_AT_REST = 0.97
"""Prior probability that a robot whose wheels read zero is at rest, and least posterior to use that."""
_CHANGE = 0.1, 3.5e-2
"""Prior probability that the bias has changed since the rest before, beyond its random walk, and sigma of the change [rad/s]: twice a MEMS
gyro's offset."""
_MIN_REPORTED = 3.0
"""A change may be a fault from this many of the robot file's sigmas of the bias on: drivers that zero their gyro leave less."""
_MAX_RATE_RAD_S, _CONSTANT = 1.0, 0.1
"""Rates of a robot that is turned with its wheels at rest are uniform up to this [rad/s]. Those on a turntable are constant, which is this
share of them; those of one that rolls or is carried vary."""
_MAX_EXPONENT, _MIN_DENSITY = 300.0, 1e-300
_SETTLING_S = 0.2
"""Time in which a robot whose wheels read zero stops, or sets off [s]: their clock may be ahead of the gyro's by a driver's latency
(`clock_offset`), and encoders of few counts begin late."""
_MIN_SPELL_S, _MIN_STEPS = 0.5, 5
"""Shortest standstill after that which is judged: the scatter of the gyro's rates is that of 25 samples."""


class BiasAtRest(NamedTuple):
    """A bias by the time at rest that was not yet used to measure it."""

    prior_variance: float
    """Variance of the prior that holds, or of all together, where it is wider than the filter's [rad^2/s^2]; else 0."""
    change_variance: float
    """Square of the change since the rest before [rad^2/s^2]; 0 where there is none."""
    rate: float
    """Mean of the gyro's rate in the standstill before this step [rad/s]."""
    variance: float
    """[rad^2/s^2]"""


class BiasChange(NamedTuple):
    """A bias that has changed between two rests."""

    end_ns: int
    """Stamp at which it is found."""
    rate: float
    """By how much [rad/s]."""
    log_evidence: float
    """Logarithm of the likelihood of a change over that of none: neither since the last rest, nor of what the filter has meanwhile."""


class _Bias(NamedTuple):
    """A hypothesis on the bias."""

    share: float
    """Prior probability."""
    mean: float
    """[rad/s]"""
    variance: float
    """[rad^2/s^2]"""


class StandstillTest:
    """`add` each step. A standstill is a time of zero wheels; by Bayes' rule on the gyro's turns in it, with their own scatter for noise:

    - at rest, the turns are those of one bias, which has the filter's variance, in the first rest one of `_BIAS_PRIORS`, or has changed, or
      is what the gyro read in the last standstill, as probably as that was a rest;
    - moved, they are those of any rate, constant as on a turntable, or varying as of a robot that rolls or is carried.

    A gyro that never scatters tells nothing about its noise: the robot file's is taken. Vibration scatters, and is no motion.
    """

    def __init__(self, bias_sigma: float) -> None:
        """``bias_sigma``: of the robot file [rad/s]."""
        self._bias_sigma = bias_sigma
        self.since_rest_s = 0.0
        """Time since the robot was last known to be at rest [s]."""
        self.change: BiasChange | None = None
        """The last one that is a fault."""
        self._priors = [(share, factor * bias_sigma + sigma) for share, factor, sigma in _BIAS_PRIORS]
        self.bias_sigma = math.sqrt(sum(share * sigma**2 for share, sigma in self._priors))
        """Standard deviation of the bias by a prior that no rest has tested [rad/s]; 0 once one has."""
        self._turns: list[tuple[float, float, float]] = []  # angle, time, variance of each step of the standstill
        self._bias = 0.0, 0.0  # mean and variance at its begin
        self._unsure: _Bias | None = None  # of the last standstill, where that may have been a rest
        self._rested: tuple[float, float] | None = None  # mean and variance of the rate in the last one that was
        self._stood_s = 0.0
        self._is_prior_tested = False
        self._rest = 0.0  # probability
        self._fits_rest = True  # the turn of this step is one at rest
        self._angle = 0.0  # of the gyro, in all of the standstill
        self._is_moved = False

    @property
    def is_at_rest(self) -> bool:
        """Whether the robot is at rest, by the standstill up to now and in this step: one that sets off turns before its wheels count."""
        return self._rest > _AT_REST and self._fits_rest

    @property
    def is_bias_open(self) -> bool:
        """Whether wheels read zero and the gyro has not shown that they are right: its turn is no measurement of its bias then."""
        return self._stood_s > 0.0 and not self.is_at_rest

    def unknown_turns(self, step: Step) -> tuple[float, float]:
        """Variances of the yaw of a robot that is moved while its wheels read zero: of the turn in ``step``, and, as that is found, of the
        turn before it, which was taken for none [rad^2]; else 0."""
        if not self._is_long or self._rest >= 1.0 - _AT_REST:
            return 0.0, 0.0
        before, self._is_moved = 0.0 if self._is_moved else self._angle, True
        return (_MAX_RATE_RAD_S * step.duration) ** 2, before**2

    def add(self, state: State, step: Step) -> tuple[Step, BiasAtRest | None]:
        """``step``, with a gyro of its own noise where it shows rest; and the bias, where rest is found, or contradicts its prior.
        ``state``: at the start of the step."""
        self.since_rest_s = 0.0 if self.is_at_rest else self.since_rest_s + step.duration
        if not step.is_standing or not step.has_wheels or step.turn is None or step.duration <= 0.0:
            if self._turns:
                self._end_standstill()
            self._rest = self._stood_s = self._angle = 0.0
            self._is_moved = False
            return step, None
        self._stood_s += step.duration
        self._angle += step.turn.angle
        if self._stood_s <= _SETTLING_S:
            return step, None
        if not self._turns:
            self._bias = state.number("gyro_bias"), state.variance("gyro_bias")
        found, turn = self._judge(step.start_ns), step.turn
        self._fits_rest = self._rest <= _AT_REST or self._is_of_rest(turn.angle / turn.duration, turn.duration)
        self._turns.append((turn.angle, turn.duration, turn.scatter_variance or turn.variance))
        return (replace(step, turn=replace(turn, variance=self._density() * turn.duration)) if self.is_at_rest else step), found

    @property
    def _is_long(self) -> bool:
        """Whether the standstill is long enough to be judged."""
        return len(self._turns) >= _MIN_STEPS and sum(seconds for _, seconds, _ in self._turns) >= _MIN_SPELL_S

    def _judge(self, now_ns: int) -> BiasAtRest | None:
        """Set the probability of rest; return the bias, where rest is found now, or another prior holds than the filter has."""
        if not self._is_long:
            return None
        rate, noise = self._rate()
        biases = self._biases()
        densities = [_normal(rate - b.mean, b.variance + noise) for b in biases]
        likelihoods = [b.share * density for b, density in zip(biases, densities, strict=True)]
        at_rest = _AT_REST * sum(likelihoods)
        moved = (1.0 - _AT_REST) * 0.5 / _MAX_RATE_RAD_S * (_CONSTANT + (1.0 - _CONSTANT) * math.exp(self._variation(rate)))
        was_resting, self._rest = self._rest > _AT_REST, at_rest / (at_rest + moved)
        best = int(np.argmax(likelihoods))
        if self._rest <= _AT_REST or (was_resting and best == 0):
            return None
        self.bias_sigma = 0.0
        if not best:
            return BiasAtRest(0.0, 0.0, rate, noise) if self._is_prior_tested else _mixed(biases, likelihoods, rate, noise)
        is_first, change = not self._is_prior_tested, rate - self._bias[0]
        self._is_prior_tested, self._bias = True, (rate, noise)
        if is_first:
            return BiasAtRest(max(biases[best].variance, change**2), 0.0, rate, noise)
        if self._rested is not None and abs(rate - self._rested[0]) > _MIN_REPORTED * self._bias_sigma:
            mean, variance = self._rested
            unchanged = max(densities[0], _normal(rate - mean, variance + biases[0].variance + noise), _MIN_DENSITY)
            self.change = BiasChange(now_ns, rate - mean, math.log(densities[best] / unchanged))
        return BiasAtRest(0.0, change**2, rate, noise)

    def _biases(self) -> list[_Bias]:
        """Hypotheses on the bias in this standstill, that of the filter first."""
        share, sigma = _CHANGE
        mean, variance = self._bias
        biases = [_Bias(1.0 - share, mean, variance), _Bias(share, mean, variance + sigma**2)]
        if not self._is_prior_tested:
            (share, _), *others = self._priors
            biases = [_Bias(share, mean, variance), *(_Bias(share, 0.0, sigma**2) for share, sigma in others)]
        unsure = self._unsure
        return biases if unsure is None else [*(b._replace(share=b.share * (1.0 - unsure.share)) for b in biases), unsure]

    def _end_standstill(self) -> None:
        """Keep the bias by a standstill that may have been a rest."""
        if self._is_long:
            self._is_prior_tested |= self._rest > _AT_REST
            self._rested = self._settled_rate() if self._rest > _AT_REST else self._rested
            is_unsure = 1.0 - _AT_REST < self._rest <= _AT_REST
            self._unsure = _Bias(self._rest, *self._rate()) if is_unsure else None
        self._turns.clear()

    def _is_of_rest(self, rate: float, seconds: float) -> bool:
        """Whether a ``rate`` [rad/s] over ``seconds`` is that of a robot which still rests, as certainly as that is to be."""
        mean, noise = self._rate()
        at_rest = _AT_REST * _normal(rate - mean, noise + self._density() / seconds)
        return at_rest > _AT_REST * (at_rest + (1.0 - _AT_REST) * 0.5 / _MAX_RATE_RAD_S)

    def _settled_rate(self) -> tuple[float, float]:
        """`_rate` without the end of the standstill, at which the robot may set off before its wheels count."""
        until_end = np.cumsum([seconds for _, seconds, _ in reversed(self._turns)])[::-1].tolist()
        return self._rate([turn for turn, left in zip(self._turns, until_end, strict=True) if left > _SETTLING_S])

    def _rate(self, turns: Sequence[tuple[float, float, float]] = ()) -> tuple[float, float]:
        """Mean of the gyro's rate in this standstill [rad/s], or in those of its ``turns``, and its variance [rad^2/s^2]."""
        angle, seconds, _ = np.array(turns or self._turns).sum(axis=0).tolist()
        return angle / seconds, self._density() / seconds

    def _density(self) -> float:
        """Variance of the turns of this standstill, by the scatter in all of it [rad^2/s]."""
        _, seconds, variance = np.array(self._turns).sum(axis=0).tolist()
        return float(variance / seconds)

    def _variation(self, rate: float) -> float:
        """By how much the turns fit better by rates that vary, with a variance of their own, than by the constant ``rate``: log of the
        likelihood ratio, less half the logarithm of their number for that parameter (Schwarz 1978)."""
        turns = np.array(self._turns)
        n = len(turns)
        ratio = float(np.sum((turns[:, 0] - rate * turns[:, 1]) ** 2 / turns[:, 1])) / (n * self._density())
        gain = 0.5 * n * (ratio - 1.0 - math.log(ratio)) if ratio > 1.0 else 0.0
        return min(gain - 0.5 * math.log(n), _MAX_EXPONENT)


def _mixed(biases: Sequence[_Bias], likelihoods: Sequence[float], rate: float, noise: float) -> BiasAtRest:
    """The bias by a ``rate`` that leaves several priors probable, as a rest of half a second does: the prior and the measurement that have
    the mean and the variance of all of them together, each with its probability (moment matching: Bar-Shalom et al. 2001, 1.4.16)."""
    p = np.array(likelihoods) / sum(likelihoods)
    mean, variance = np.array([(b.mean, b.variance) for b in biases]).T
    gain = variance / (variance + noise)
    means = mean + gain * (rate - mean)
    mixed, whole = float(p @ gain), float(p @ (gain * noise + (means - p @ means) ** 2))
    return BiasAtRest(whole / (1.0 - mixed), 0.0, rate, whole / mixed)


def _normal(residual: float, variance: float) -> float:
    """Density of a normal distribution."""
    return math.exp(-0.5 * residual**2 / variance) / math.sqrt(math.tau * variance)
