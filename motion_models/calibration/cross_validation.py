"""How well a calibration predicts drives that it was not fitted to, with confidence intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from motion_models.calibration.maneuvers import Maneuver
from motion_models.errors import CalibrationError
from motion_models.se2 import FloatArray


class Predictor(Protocol):
    """What training returns; `motion_models.calibration.fit.Fit` is one."""

    def residuals(self, maneuvers: Sequence[Maneuver]) -> FloatArray:
        """(M, 3) predicted poses relative to the measured ones."""


Train = Callable[[Sequence[Maneuver]], Predictor]
"""The whole procedure, choices included: a choice made outside it would have used the held-out maneuvers."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % confidence interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


@dataclass(frozen=True)
class HeldOut:
    """Errors of every measured pose, each predicted by a fit without its group."""

    residuals: FloatArray
    """(M, 3) predicted poses relative to the measured ones [m, m, rad], in the order of the maneuvers."""
    group: NDArray[np.int64]
    """(M,) group of each."""
    predictors: tuple[Predictor, ...]
    """One a fold."""

    @property
    def squared_distance(self) -> FloatArray:
        """(M,) [m^2]"""
        return np.asarray(np.sum(self.residuals[:, :2] ** 2, axis=1))

    @property
    def squared_angle(self) -> FloatArray:
        """(M,) [rad^2]"""
        return np.asarray(self.residuals[:, 2] ** 2)


def cross_validate(train: Train, maneuvers: Sequence[Maneuver], folds: int = 10) -> HeldOut:
    """Hold out each of ``folds`` sets of groups in turn; group i (in order of appearance) belongs to fold i modulo ``folds``.

    Raises `CalibrationError` where there are fewer groups than folds.
    """
    names = list(dict.fromkeys(m.group for m in maneuvers))
    if not 2 <= folds <= len(names):
        raise CalibrationError(
            f"cannot cross-validate {len(names)} groups of maneuvers in {folds} folds; it takes 2 to as many folds as groups."
        )
    number = {name: i for i, name in enumerate(names)}
    group = np.array([number[m.group] for m in maneuvers])
    counts = np.array([len(m.ends) for m in maneuvers])
    residuals = np.empty((int(counts.sum()), 3))
    predictors = []
    for fold in range(folds):
        out = group % folds == fold
        predictor = train([m for m, held in zip(maneuvers, out, strict=True) if not held])
        residuals[np.repeat(out, counts)] = predictor.residuals([m for m, held in zip(maneuvers, out, strict=True) if held])
        predictors.append(predictor)
    return HeldOut(residuals, np.repeat(group, counts), tuple(predictors))


def root_mean(squares: FloatArray, group: NDArray[np.int64], rng: np.random.Generator, draws: int = 2000) -> Interval:
    """Root of the mean of ``squares`` (M,), with a bootstrap interval over whole groups (errors within one are correlated)."""
    return _bootstrap(lambda weights, sums, counts: np.sqrt((weights @ sums[0]) / (weights @ counts)), [squares], group, rng, draws)


def root_mean_gain(
    before: FloatArray, after: FloatArray, group: NDArray[np.int64], rng: np.random.Generator, draws: int = 2000
) -> Interval:
    """Root mean square of ``before`` (M,) minus that of ``after`` (M,) on the same poses; resampled in pairs, so narrower than either."""

    def gain(weights: FloatArray, sums: list[FloatArray], counts: FloatArray) -> FloatArray:
        n = weights @ counts
        return np.asarray(np.sqrt((weights @ sums[0]) / n) - np.sqrt((weights @ sums[1]) / n))

    return _bootstrap(gain, [before, after], group, rng, draws)


def _bootstrap(
    statistic: Callable[[FloatArray, list[FloatArray], FloatArray], FloatArray],
    values: list[FloatArray],
    group: NDArray[np.int64],
    rng: np.random.Generator,
    draws: int,
) -> Interval:
    groups = int(group.max()) + 1
    sums = [np.asarray(np.bincount(group, weights=v, minlength=groups), dtype=np.float64) for v in values]
    counts = np.bincount(group, minlength=groups).astype(np.float64)
    weights = rng.multinomial(groups, np.full(groups, 1.0 / groups), size=draws).astype(np.float64)
    low, high = np.quantile(statistic(weights, sums, counts), [0.025, 0.975])
    value = statistic(np.ones((1, groups)), sums, counts)[0]
    return Interval(float(value), float(low), float(high))
