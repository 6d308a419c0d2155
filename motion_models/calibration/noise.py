"""Wheel noise of a robot, learned from the errors that a calibration leaves on maneuvers to which it was not fitted."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from motion_models.calibration.fit import Fit
from motion_models.calibration.maneuvers import Batch, IntArray, Maneuver, make_batch
from motion_models.calibration.prediction import predict
from motion_models.robot import WheelNoise
from motion_models.se2 import FloatArray

_YAW = ("yaw_rad2_per_rad", "yaw_rad2_per_m", "floor_rad2_per_s")
_MIN_POSES = 20
"""Measured poses below which a variance is not learned: its relative error is sqrt(2 / n)."""
_FACTOR_BOUNDS = (0.05, 20.0)
"""Of a variance against the robot file's. Calibrated Huskies on floor and snow differ by 10 (`WheelNoise`)."""
_QUANTILE, _CHI_SQUARE = 0.75, 1.3233
"""Quantile of the normalized squared errors that is matched, and its value for one degree of freedom: a quarter of the errors may be wrong
matches. Of fr079's positions by scan matching a tenth is beyond four sigma, and the median is that of the usual noise."""
_BISECTIONS = 40


@dataclass(frozen=True)
class LearnedNoise:
    """Factors by which the variances of a robot's wheel noise explain the errors; 1 where too little was measured."""

    yaw: float
    """Of `yaw_rad2_per_rad`, `yaw_rad2_per_m` and `floor_rad2_per_s`."""
    position: float
    """Of the longitudinal and lateral ones, and of `floor_m2_per_s`."""

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
