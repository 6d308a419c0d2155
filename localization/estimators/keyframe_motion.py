"""Preintegration of the wheels' motion from keyframe to keyframe, linear in the corrections of the motion model (Forster 2017)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from motion_models import se2
from motion_models.motion import Motion
from motion_models.online_calibration import Corrections
from motion_models.se2 import FloatArray, Pose2


@dataclass(frozen=True)
class PreintegratedMotion:
    """The wheels' motion from keyframe to keyframe, by any motion model."""

    delta: Pose2
    """(3,) at the corrections ``at``."""
    cov: FloatArray
    """(3, 3)"""
    by_corrections: FloatArray
    """(3, c) its derivative (right perturbation)."""
    at: FloatArray
    """(c,)"""


class MotionPreintegration:
    """Preintegrates steps from keyframe to keyframe, for a factor between both poses and the ``n`` corrections."""

    def __init__(self, n: int) -> None:
        self._delta, self._cov = np.zeros(3), np.zeros((3, 3))
        self._by_corrections, self._straight = np.zeros((3, n)), np.zeros((3, n))
        self._corrected = np.zeros(3)  # share of the corrections in the motion
        self._prior = np.zeros((n, n))

    def add(self, motion: Motion, corrections: Corrections, is_turning: bool, at: FloatArray) -> None:
        """Add the next step, predicted with the corrections ``at`` (n,). Nearly straight motion does not excite the corrections: there they
        are one error of the whole motion."""
        A = se2.adjoint(se2.inverse(motion.delta))
        self._delta = se2.compose(self._delta, motion.delta)
        self._cov = A @ self._cov @ A.T + motion.cov
        D = motion.d_params @ corrections.directions if motion.d_params.shape[1] else np.zeros_like(self._straight)
        excited, straight = (D, np.zeros_like(D)) if is_turning else (np.zeros_like(D), D)
        self._by_corrections = A @ self._by_corrections + excited
        self._straight = A @ self._straight + straight
        self._corrected = A @ self._corrected + excited @ at
        self._prior = corrections.cov

    def with_corrections(self, at: FloatArray) -> PreintegratedMotion:
        """All of it, as predicted with the corrections ``at`` (n,)."""
        cov = self._cov + self._straight @ self._prior @ self._straight.T + 1e-10 * np.eye(3)
        delta = se2.compose(self._delta, se2.exp(self._by_corrections @ at - self._corrected))
        by_scale = np.append(-se2.inverse(delta)[:2], 0.0)  # R^T (x, y), yaw 0: turns have a scale of their own, k
        return PreintegratedMotion(delta, cov, np.column_stack([self._by_corrections, by_scale]), np.append(at, 0.0))
