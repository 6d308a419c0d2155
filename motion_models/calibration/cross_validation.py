"""How well a calibration predicts drives that it was not fitted to, with confidence intervals, and the wheel noise that they show."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from motion_models.calibration.fit import Fit
from motion_models.calibration.maneuvers import Batch, IntArray, Maneuver, make_batch
from motion_models.calibration.prediction import predict
from motion_models.errors import CalibrationError
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray

_YAW = ("yaw_rad2_per_rad", "yaw_rad2_per_m", "floor_rad2_per_s")
_MIN_POSES = 20
"""Measured poses below which a variance is not learned: its relative error is sqrt(2 / n)."""
_FACTOR_BOUNDS = (0.05, 20.0)
"""Bounds of the factor of a variance against the robot file's. Calibrated Huskies on floor and snow differ by 10 (`WheelNoise`)."""
_QUANTILE, _CHI_SQUARE = 0.75, 1.3233
"""Quantile of the normalized squared errors that is matched, and its value for one degree of freedom: a quarter of the errors may be wrong
matches. Of fr079's positions by scan matching a tenth is beyond four sigma, and the median is that of the usual noise."""
_BISECTIONS = 40


class TrainedPredictor(Protocol):
    """What training returns; `motion_models.calibration.fit.Fit` is one."""

    def residuals(self, maneuvers: Sequence[Maneuver]) -> FloatArray:
        """(M, 3) predicted poses relative to the measured ones."""


Train = Callable[[Sequence[Maneuver]], TrainedPredictor]
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
    predictors: tuple[TrainedPredictor, ...]
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


def learning_curve(
    train: Train, maneuvers: Sequence[Maneuver], counts: Sequence[int], draws: int, rng: np.random.Generator
) -> dict[int, FloatArray]:
    """Root mean square position error [m] on all other groups after training on so many of ``counts``: (draws,), groups drawn at random."""
    names = list(dict.fromkeys(m.group for m in maneuvers))
    curve = {}
    for count in counts:
        errors = []
        for _ in range(draws):
            taken = set(rng.choice(names, count, replace=False).tolist())
            predictor = train([m for m in maneuvers if m.group in taken])
            off = predictor.residuals([m for m in maneuvers if m.group not in taken])
            errors.append(float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1)))))
        curve[count] = np.array(errors)
    return curve


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


@dataclass(frozen=True)
class LearnedNoise:
    """Factors by which the variances of a robot's wheel noise explain the errors; 1 where too little was measured."""

    yaw: float
    """Factor of `yaw_rad2_per_rad`, `yaw_rad2_per_m` and `floor_rad2_per_s`."""
    position: float
    """Factor of the longitudinal and lateral variances, and of `floor_m2_per_s`."""

    def scaled(self, noise: WheelNoise) -> WheelNoise:
        """``noise`` with its variances multiplied, to three digits: a variance is known no better."""
        factors = {name: self.yaw if name in _YAW else self.position for name in _values(noise)}
        return WheelNoise(**{name: float(f"{value * factors[name]:.3g}") for name, value in _values(noise).items()})


def learn_noise(fit: Fit, maneuvers: Sequence[Maneuver], residuals: FloatArray) -> LearnedNoise:
    """Both factors by the `_QUANTILE` of normalized ``residuals`` (M, 3) of ``maneuvers``, predicted by fits without them.

    The covariance of a predicted pose is linear in the variances: C = a_yaw C_yaw + a_position C_position + R, with the measurement's R.
    Headings give a_yaw, positions then a_position. What is correlated within a maneuver (slip over 0.1 to 2 s) is in the errors at its
    end, and so in the factors; what is correlated between neighbours is in the sums of their errors over each group, and the larger of
    both factors counts.
    """
    batch = make_batch(maneuvers)
    if len(residuals) < _MIN_POSES:
        return LearnedNoise(1.0, 1.0)
    values = _values(fit.config.noise)
    yaw, position = (
        _covariances(fit, batch, WheelNoise(**{name: value if (name in _YAW) == is_yaw else 0.0 for name, value in values.items()}))
        for is_yaw in (True, False)
    )
    measured = np.diagonal(batch.cov, axis1=1, axis2=2)
    heading = np.isfinite(measured[:, 2])
    group = batch.group
    a_yaw = _larger_factor(residuals[heading, 2], yaw[heading, 2, 2], measured[heading, 2], group[heading])
    known = np.isfinite(measured[:, :2]).all(axis=1)
    slip, rest = (
        np.concatenate([values[known, 0, 0], values[known, 1, 1]])
        for values in (position, a_yaw * yaw + np.where(batch.cov < np.inf, batch.cov, 0.0))
    )
    a_position = _larger_factor(
        residuals[known, :2].T.ravel(), slip, rest, np.concatenate([group[known], group[known] + len(batch.groups)])
    )
    return LearnedNoise(a_yaw, a_position)


def _larger_factor(errors: FloatArray, slip: FloatArray, rest: FloatArray, group: IntArray) -> float:
    """`_factor` of ``errors`` (n,) one by one, or of their sums over each ``group`` (n,), whichever is larger."""
    single = _factor(errors**2, slip, rest)
    errors_sum, slip_sum, rest_sum = (np.asarray(np.bincount(group, values), dtype=np.float64) for values in (errors, slip, rest))
    together = _factor(errors_sum**2, slip_sum, rest_sum)
    return max(single, together) if np.count_nonzero(slip_sum) >= _MIN_POSES else single


def _factor(squares: FloatArray, slip: FloatArray, rest: FloatArray) -> float:
    """a for which the quantile of ``squares`` / (a ``slip`` + ``rest``), each (n,), is that of a unit normal's square: bisection."""
    usable = slip > 0.0
    squares, slip, rest = squares[usable], slip[usable], rest[usable]
    if len(squares) < _MIN_POSES:
        return 1.0
    low, high = (math.log(bound) for bound in _FACTOR_BOUNDS)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        is_low = np.quantile(squares / (math.exp(middle) * slip + rest), _QUANTILE) > _CHI_SQUARE
        low, high = (middle, high) if is_low else (low, middle)
    return math.exp(0.5 * (low + high))


def _covariances(fit: Fit, batch: Batch, noise: WheelNoise) -> FloatArray:
    """(M, 3, 3) of the predicted poses by ``noise`` alone."""
    return predict(fit.model, batch, fit.params, fit.reference_params, np.empty(0, dtype=np.int64), noise)[2]


def _values(noise: WheelNoise) -> dict[str, float]:
    return {f.name: float(getattr(noise, f.name)) for f in dataclasses.fields(noise)}
