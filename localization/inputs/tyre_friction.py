"""Slip stiffness and friction coefficient of the tyres, by how a robot turns on slopes.

Gravity turns a robot on a slope, the more the less its tyres hold it, so that the turns of the gyro show how stiff they are and what mu is.
With s the logarithms of both over the robot file's, and h the derivatives of the wheels' turn by them, a step of dt has

    z = turn by the gyro - turn by the wheels = h s + kappa turn + b dt + n

where kappa is an error of the turns on level ground, and b the gyro's bias: both are states beside s.
"""

from __future__ import annotations

import math

import numpy as np

from localization.small_filters import update_in_place
from motion_models.compiled import kernel
from motion_models.se2 import FloatArray

_SIGMAS = 1.0, 0.25
"""Sigmas of s: the stiffness is known to a factor of 3 either way, as in the diagnosis, mu to that between dry and wet concrete."""
_MAX_LOG = math.log(10.0), math.log(2.5)
"""Largest s either way. Tyres that are ten times as stiff slide at once."""
_TURNING_SIGMA, _BIAS_SIGMA = 0.1, 3e-3
"""Sigmas of kappa, as of k by geometry (`motion_models.prior.scaling_sigma`), and of the bias of a gyro that was zeroed at rest [rad/s]."""


class TyreFriction:
    """`update` by each step on a slope."""

    def __init__(self) -> None:
        self._mean = np.zeros(4)
        """(4,) s, kappa, b."""
        self._cov = np.diag(np.square([*_SIGMAS, _TURNING_SIGMA, _BIAS_SIGMA]))

    @property
    def logs(self) -> tuple[float, float]:
        """Logarithms of slip stiffness and mu over the robot file's."""
        stiffness, mu = (min(max(s, -most), most) for s, most in zip(self._mean[:2].tolist(), _MAX_LOG, strict=True))
        return stiffness, mu

    @property
    def cov(self) -> FloatArray:
        """Covariance (2, 2) of `logs`."""
        return self._cov[:2, :2]

    @property
    def turning_error(self) -> float:
        """Share by which turns on level ground are larger than by the model's nominal parameters: kappa."""
        return float(self._mean[2])

    def update(self, error: float, row: FloatArray, variance: float) -> None:
        """Update by the turn ``error`` [rad] of the gyro over that of the wheels at the present `logs`, whose derivatives by the states are
        ``row`` (4,), with its ``variance``."""
        _update(self._mean, self._cov, row, error + float(row[:2] @ self.logs), variance)


@kernel
def _update(mean: FloatArray, cov: FloatArray, row: FloatArray, error: float, variance: float) -> None:
    update_in_place(mean, cov, row, error, variance, np.empty(4))
