"""Wheel noise of a robot, learned from the errors that a calibration leaves on maneuvers to which it was not fitted."""

from __future__ import annotations

import dataclasses
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
_CLIP_SIGMA = 2.5
"""Errors count as if they were at most this many standard deviations, so that lost matches, up to a tenth, do not set the noise."""
_CLIPPED_MEAN = 0.978
"""Mean of the square of a unit normal number that is clipped there."""
_STEPS = 50


@dataclass(frozen=True)
class LearnedNoise:
    """Factors by which the variances of a robot's wheel noise explain the errors; 1 where too little was measured."""

    yaw: float
    """Of `yaw_rad2_per_rad`, `yaw_rad2_per_m` and `floor_rad2_per_s`."""
    position: float
    """Of the longitudinal and lateral ones, and of `floor_m2_per_s`."""

    def scaled(self, noise: WheelNoise) -> WheelNoise:
        """``noise`` with its variances multiplied."""
        return WheelNoise(**{name: value * (self.yaw if name in _YAW else self.position) for name, value in _values(noise).items()})


def learn_noise(fit: Fit, maneuvers: Sequence[Maneuver], residuals: FloatArray) -> LearnedNoise:
    """Maximum likelihood of both factors for ``residuals`` (M, 3) of ``maneuvers``, predicted by fits that have not seen them.

    The covariance of a predicted pose is linear in the variances: C = a_yaw C_yaw + a_position C_position + R, with the measurement's R.
    Headings give a_yaw, positions then a_position. What is correlated within a maneuver (slip over 0.1 to 2 s) is in the errors at its
    end, and so in the factors; what is correlated between neighbours is in the sums of their errors over each group, and the larger of
    both factors counts.
    """
    batch = make_batch(maneuvers)
    values = _values(fit.config.noise)
    yaw, position = (
        _covariances(fit, batch, WheelNoise(**{name: value if (name in _YAW) == is_yaw else 0.0 for name, value in values.items()}))
        for is_yaw in (True, False)
    )
    measured = np.diagonal(batch.cov, axis1=1, axis2=2)
    heading = np.isfinite(measured[:, 2])
    group = batch.group
    a_yaw = _larger_factor(residuals[heading, 2:], yaw[heading, 2, 2], measured[heading, 2], group[heading])
    known = np.isfinite(measured[:, :2]).all(axis=1)
    rest = a_yaw * np.trace(yaw[known, :2, :2], axis1=1, axis2=2) + measured[known, :2].sum(axis=1)
    a_position = _larger_factor(residuals[known, :2], np.trace(position[known, :2, :2], axis1=1, axis2=2), rest, group[known])
    return LearnedNoise(a_yaw, a_position)


def _larger_factor(errors: FloatArray, slip: FloatArray, rest: FloatArray, group: IntArray) -> float:
    """`_factor` of ``errors`` (n, c) one by one, or of their sums over each ``group`` (n,), whichever is larger."""
    single = _factor(np.sum(errors**2, axis=1), slip, rest)
    sums = np.stack([np.bincount(group, column) for column in errors.T], axis=-1)
    slip_sum, rest_sum = (np.asarray(np.bincount(group, values), dtype=np.float64) for values in (slip, rest))
    together = _factor(np.sum(sums**2, axis=1), slip_sum, rest_sum)
    return max(single, together) if np.count_nonzero(slip_sum) >= _MIN_POSES else single


def _factor(squares: FloatArray, slip: FloatArray, rest: FloatArray) -> float:
    """a by which variances a ``slip`` + ``rest`` explain ``squares``, each (n,): scoring steps of the Gaussian likelihood."""
    usable = slip > 0.0
    squares, slip, rest = squares[usable], slip[usable], rest[usable]
    if len(squares) < _MIN_POSES:
        return 1.0
    a = 1.0
    for _ in range(_STEPS):
        variance = a * slip + rest
        clipped = np.minimum(squares, _CLIP_SIGMA**2 * variance)
        weight = (slip / variance) ** 2
        a = float(np.clip(np.sum(weight * (clipped / _CLIPPED_MEAN - rest) / slip) / np.sum(weight), *_FACTOR_BOUNDS))
    return a


def _covariances(fit: Fit, batch: Batch, noise: WheelNoise) -> FloatArray:
    """(M, 3, 3) of the predicted poses by ``noise`` alone."""
    return predict(fit.model, batch, fit.params, fit.reference_params, np.empty(0, dtype=np.int64), noise)[2]


def _values(noise: WheelNoise) -> dict[str, float]:
    return {f.name: float(getattr(noise, f.name)) for f in dataclasses.fields(noise)}
