"""Factor on the robot file's wheel noise, estimated from the innovations of gyro and scans."""

from __future__ import annotations

import math

import numpy as np

from localization.core.filter import Innovation
from localization.core.state import State
from localization.events import Step
from localization.lidar import OUTLIER_SIGMAS
from localization.small_filters import FORGETTING
from motion_models.se2 import Cov3, FloatArray

_MIN_INFORMATION = 30.0
"""Information about the factor on the wheels' noise, at least: that of ten scans."""
_MAX_NOISE_SCALE = 20.0
"""Largest factor on the wheels' noise, as of `calibrate`. The least is 1: slip lasts, and what fits the innovation of one scan is too small
for the sum of many (ACES with a least scale of 1/4 for each axis: 0.099 -> 0.138 m)."""


class WheelNoiseScale:
    """`start_step` before the prediction, `learn` from each update of the step."""

    def __init__(self) -> None:
        self.value = 1.0
        """Factor on variances."""
        self._information, self._slip_cov = 0.0, np.zeros((0, 0))  # Fisher information; the part of P that is this step's slip

    def start_step(self, state: State, step: Step) -> Cov3:
        """(3, 3) of the wheels' motion in ``step``, which begins at ``state``, with the factor where the wheels move."""
        is_driving = step.has_wheels and not step.is_standing
        cov, rows = step.cov * (self.value if is_driving else 1.0), state.layout.rows["pose"]
        self._slip_cov = np.zeros_like(state.P)
        self._slip_cov[rows, rows] = cov * is_driving
        return cov

    def learn(self, innovation: Innovation) -> None:
        """One step of Fisher scoring for log a, where S = a dS/da + ... and a dS/da = H (slip) H^T (maximum likelihood; Mehra 1970):

        2 d log p / d log a = y^T S^-1 (a dS/da) S^-1 y - tr(S^-1 a dS/da), twice the information tr((S^-1 a dS/da)^2), innovation y.

        Where slip has little share in S (wide priors, directions that the scene leaves open), there is little information.
        """
        H, slip = innovation.H, self._slip_cov
        S_inv, slip_in_S = np.asarray(np.linalg.inv(innovation.S), dtype=float), H @ slip @ H.T
        share, gain = S_inv @ slip_in_S, S_inv @ innovation.residual
        expected = float(np.trace(share))
        score = min(float(gain @ slip_in_S @ gain), OUTLIER_SIGMAS**2 * expected) - expected
        self._information = FORGETTING * self._information + float(np.trace(share @ share))
        self.value *= math.exp(score / max(self._information, _MIN_INFORMATION))
        self.value = min(max(self.value, 1.0), _MAX_NOISE_SCALE)
        A: FloatArray = np.eye(len(slip)) - innovation.K @ H
        self._slip_cov = A @ slip @ A.T
